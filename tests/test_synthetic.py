"""The synthetic session is what it says: pictures where the rig projects, same seed same bytes, files read back."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from estimation import se3
from estimation.pose_solver import solve_pose
from estimation.rig import pixels_from_points
from hardware.session import open_session
from hardware.tum import read_tum
from tests import skin
from tests.scene import Scene
from tests.synthetic import (
    REST,
    SCAN_FROM_SURFACE,
    breathing,
    frame_sets,
    observations,
    render,
    rig,
    rois,
    scan_of,
    still,
    tracks,
    write_session,
)

SMALL = rig(size=(640, 360), focal=700.0)
TURNED = REST @ se3.exp([0.06, -0.08, 0.3, 4.0, -3.0, 6.0])
CLEAN = Scene(noise=0.0)
DOTS = np.stack(np.meshgrid(np.arange(-30.0, 31, 12), np.arange(-20.0, 21, 10)), -1).reshape(-1, 2) + [0.37, -0.21]


def centroids(image: np.ndarray, near: np.ndarray) -> np.ndarray:
    """Centres of brightness (N, 2) in the 11 px windows about `near` (N, 2)."""
    out = []
    for x, y in np.rint(near).astype(int):
        part = image[y - 5 : y + 6, x - 5 : x + 6].astype(float)
        part = np.clip(part - part.min() - 3, 0, None)
        gy, gx = np.mgrid[y - 5 : y + 6, x - 5 : x + 6]
        out.append([(part * gx).sum() / part.sum(), (part * gy).sum() / part.sum()])
    return np.array(out)


@pytest.mark.parametrize("radius", [70.0, np.inf])
def test_a_point_of_the_texture_is_imaged_where_the_rig_projects_it(radius: float) -> None:
    texture = skin.dots((80.0, 60.0), 0.1, DOTS, 0.5)
    scene = Scene(radius=radius, texture=texture, texel=0.1, noise=0.0, colour=False)
    views = rig()
    points = se3.transform_points(TURNED, scene.points(DOTS))
    for camera, image in zip(views.cameras, render(scene, views, TURNED, np.random.default_rng(0)), strict=True):
        pixels, _ = pixels_from_points(camera, points)
        error = centroids(image, pixels) - pixels
        assert len(error) == len(DOTS)
        assert (
            np.abs(error.mean(0)).max() < 0.015
        )  # no shift of the whole picture (a bent dot's own centroid moves by 0.01)
        assert np.median(np.linalg.norm(error, axis=1)) < 0.02
        assert np.linalg.norm(error, axis=1).max() < 0.05


@pytest.mark.parametrize("radius", [70.0, np.inf])
def test_rays_meet_the_surface_at_the_point_they_were_aimed_at(radius: float) -> None:
    scene = Scene(radius=radius, texture=skin.dots((80.0, 60.0), 0.5, DOTS, 0.5), texel=0.5)
    flat = scene.grid(3.0)
    origin = np.array([30.0, 120.0, 380.0])
    found = scene.intersect(origin, 0.7 * (scene.points(flat) - origin))
    np.testing.assert_allclose(found, flat, atol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(scene.normals(flat), axis=1), 1.0)


def test_same_seed_same_pictures_and_another_seed_others() -> None:
    def pictures(seed: int) -> list[np.ndarray]:
        rng = np.random.default_rng(seed)
        sets = frame_sets(Scene(seed), SMALL, breathing, [0.0, 0.3], rng)
        return [frame.image for frames in sets for frame in frames.frames]

    one, same, other = pictures(4), pictures(4), pictures(5)
    assert all((a == b).all() for a, b in zip(one, same, strict=True))
    assert all((a != b).any() for a, b in zip(one, other, strict=True))


def test_noise_is_new_in_every_frame_and_as_strong_as_asked() -> None:
    scene, rng = Scene(noise=2.0, colour=False), np.random.default_rng(1)
    a, b = (render(scene, SMALL, still(0.0), rng)[0].astype(float) for _ in range(2))
    assert np.std(a - b) == pytest.approx(2.0 * np.sqrt(2), rel=0.05)


def test_only_the_patch_moves() -> None:
    scene, rng = CLEAN, np.random.default_rng(1)
    before, after = render(scene, SMALL, REST, rng), render(scene, SMALL, TURNED, rng)
    for camera, a, b in zip(SMALL.cameras, before, after, strict=True):
        outline = np.concatenate(
            [
                pixels_from_points(camera, se3.transform_points(t, scene.points(scene.grid(2.0))))[0]
                for t in (REST, TURNED)
            ]
        )
        changed = np.argwhere((a != b).any(-1))[:, ::-1]
        assert len(changed) > 2000
        assert (changed >= outline.min(0) - 1.5).all() and (changed <= outline.max(0) + 1.5).all()


def test_a_patch_out_of_view_leaves_the_background() -> None:
    scene, rng = CLEAN, np.random.default_rng(1)
    away = REST @ se3.make(np.eye(3), [5000.0, 0.0, 0.0])
    for camera, image in zip(SMALL.cameras, render(scene, SMALL, away, rng), strict=True):
        assert (image == scene.view(camera).background).all()


def test_the_views_are_rich_enough_to_track() -> None:
    for image in render(Scene(colour=False), rig(), REST, np.random.default_rng(2)):
        corners = cv2.goodFeaturesToTrack(image[300:440, 560:740], 500, 0.05, 5)
        assert len(corners) > 150


def difference(a: np.ndarray, b: np.ndarray) -> float:
    """Mean difference of two BGR images in grey levels."""
    grey = [cv2.cvtColor(image, cv2.COLOR_BGR2GRAY).astype(float) for image in (a, b)]
    return float(np.abs(grey[0] - grey[1]).mean())


@pytest.mark.parametrize("video", [True, False])
def test_a_written_session_reads_back(tmp_path: Path, video: bool) -> None:
    truth = write_session(tmp_path, 0.1, seed=3, video=video, cameras=SMALL)
    session = open_session(tmp_path)
    assert [c.name for c in session.rig.cameras] == ["cam_0", "cam_1", "cam_2"]
    np.testing.assert_array_equal(session.rig.matrices, SMALL.matrices)
    assert [len(s.frames) for s in session.frame_sets()] == [3, 3, 3]
    assert session.truth is not None and session.truth.exact
    np.testing.assert_array_equal(session.truth.stamps, truth.stamps)
    np.testing.assert_allclose(session.truth.base_from_surface, truth.base_from_surface, rtol=0, atol=1e-12)
    assert [r.camera for r in session.roi] == [0, 1, 2] and session.surface is None
    drawn = frame_sets(Scene(3), SMALL, breathing, truth.stamps, np.random.default_rng([3, 3]))
    pairs = zip(session.frame_sets(), drawn, strict=True)
    worst = max(difference(a.image, b.image) for x, y in pairs for a, b in zip(x.frames, y.frames, strict=True))
    assert worst < (2.0 if video else 1e-9)


def test_a_lossless_video_keeps_every_pixel(tmp_path: Path) -> None:
    write_session(tmp_path, 0.1, seed=3, cameras=SMALL, lossless=True)
    drawn = frame_sets(Scene(3), SMALL, breathing, np.arange(3) / 30, np.random.default_rng([3, 3]))
    for read, want in zip(open_session(tmp_path).frame_sets(), drawn, strict=True):
        for a, b in zip(read.frames, want.frames, strict=True):
            np.testing.assert_array_equal(a.image, b.image)


def test_a_session_with_a_scan_tells_the_truth_of_the_scan(tmp_path: Path) -> None:
    write_session(tmp_path, 0.05, cameras=SMALL, scan=True)
    session = open_session(tmp_path)
    assert session.surface == tmp_path / "surface.ply" and session.truth is not None
    scan_points, _ = scan_of(CLEAN)
    placed = se3.transform_points(read_tum(tmp_path / "truth.tum", True).base_from_surface[0], scan_points)
    scene = CLEAN
    np.testing.assert_allclose(placed, se3.transform_points(breathing(0.0), scene.points(scene.grid(1.0))), atol=1e-9)
    np.testing.assert_allclose(session.truth.base_from_surface[0] @ SCAN_FROM_SURFACE, breathing(0.0), atol=1e-9)


def test_a_region_holds_the_wound_and_lies_on_the_patch() -> None:
    scene = CLEAN
    for roi, camera in zip(rois(scene, SMALL, REST, 0.0), SMALL.cameras, strict=True):
        polygon = roi.polygon.astype(np.float32)
        middle, _ = pixels_from_points(camera, se3.transform_points(REST, scene.points(np.zeros((1, 2)))))
        edge, _ = pixels_from_points(camera, se3.transform_points(REST, scene.points(scene.grid(80.0))))
        assert cv2.pointPolygonTest(polygon, middle[0].tolist(), False) > 0
        assert all(cv2.pointPolygonTest(polygon, p.tolist(), False) < 0 for p in edge)


def test_observations_have_the_noise_and_the_outliers_they_claim() -> None:
    made = tracks(seconds=2.0, count=60, sigma=0.3, outliers=0.1, seed=2)
    residual = []
    for pose, seen in zip(made.truth.base_from_surface, made.observations, strict=True):
        clean = observations(made.rig, made.landmarks, pose, 0.0, np.random.default_rng(0), sigma=0.0)
        assert (clean.track == seen.track).all() and (clean.camera == seen.camera).all()
        residual.append(seen.pixels - clean.pixels)
    error = np.concatenate(residual)
    wrong = np.abs(error).max(1) > 1.8
    assert wrong.mean() == pytest.approx(0.1, abs=0.01)
    assert error[~wrong].std() == pytest.approx(0.3, rel=0.03)


def test_hidden_landmarks_are_not_observed() -> None:
    made = tracks(seconds=0.05, count=20)
    visible = np.ones((3, 20), bool)
    visible[1, 5:] = False
    pose = made.truth.base_from_surface[0]
    seen = observations(made.rig, made.landmarks, pose, 0.0, np.random.default_rng(0), visible=visible)
    assert set(seen.track[seen.camera == 1]) == set(range(5))
    assert set(seen.track[seen.camera == 0]) == set(range(20))


def test_a_pose_solver_finds_the_truth_in_the_tracks() -> None:
    made = tracks(seconds=0.5, sigma=0.1, seed=8)
    errors = []
    for pose, o in zip(made.truth.base_from_surface, made.observations, strict=True):
        start = made.truth.base_from_surface[0]
        fit = solve_pose(made.rig, o.camera, made.landmarks[o.track], o.pixels, o.sigma, start)
        errors.append(se3.log(se3.inverse(pose) @ fit.base_from_surface))
    assert np.sqrt(np.mean(np.square(np.array(errors)[:, 3:]))) < 0.02
