"""What tests look at is what it says: same seed same pictures, and files that read back."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from estimation import se3
from estimation.rig import pixels_from_points
from estimation.synthetic.arc_rig import REST, arc_rig
from hardware.files.session import open_session
from hardware.simulator.scene.scene import rois
from hardware.simulator.sensor import Sensor
from hardware.tum import read_tum
from perception.features import grey
from tests.slowly import slowly
from tests.synthetic import (
    AWAY,
    CLEAN,
    NOISY,
    SCAN_FROM_SURFACE,
    breathing,
    frame_sets,
    patch,
    pictures,
    scan_of,
    write_session,
)

SMALL = arc_rig(size=(640, 360), focal=700.0)
TURNED = REST @ se3.exp([0.06, -0.08, 0.3, 4.0, -3.0, 6.0])
SCENE = patch()


def test_same_seed_same_pictures_and_another_seed_others() -> None:
    def drawn(seed: int) -> list[np.ndarray]:
        rng = np.random.default_rng(seed)
        sets = frame_sets(patch(seed), SMALL, breathing, [0.0, 0.3], rng)
        return [frame.image for frames in sets for frame in frames.frames]

    one, same, other = drawn(4), drawn(4), drawn(5)
    assert all((a == b).all() for a, b in zip(one, same, strict=True))
    assert all((a != b).any() for a, b in zip(one, other, strict=True))


def test_noise_is_new_in_every_picture_and_as_strong_as_asked() -> None:
    rng, cameras = np.random.default_rng(1), (SMALL.cameras[0],) * 2
    first = pictures(SCENE, cameras, REST, rng, Sensor(noise=2.0))
    images = [image.astype(float) for image in first + pictures(SCENE, cameras, REST, rng, Sensor(noise=2.0))]
    for i in range(4):
        for k in range(i):
            assert np.std(images[i] - images[k]) == pytest.approx(2.0 * np.sqrt(2), rel=0.05)


def test_only_the_patch_moves() -> None:
    rng = np.random.default_rng(1)
    before, after = (pictures(SCENE, SMALL.cameras, pose, rng, CLEAN) for pose in (REST, TURNED))
    for camera, a, b in zip(SMALL.cameras, before, after, strict=True):
        edges = [se3.transform_points(t, SCENE.shape.points(SCENE.shape.grid(2.0))) for t in (REST, TURNED)]
        outline = np.concatenate([pixels_from_points(camera, points)[0] for points in edges])
        changed = np.argwhere((a != b).any(-1))[:, ::-1]
        assert len(changed) > 2000
        assert (changed >= outline.min(0) - 1.5).all() and (changed <= outline.max(0) + 1.5).all()


def test_what_is_out_of_view_leaves_the_room() -> None:
    rng = np.random.default_rng(1)
    away = pictures(SCENE, SMALL.cameras, AWAY, rng, CLEAN)
    behind = pictures(SCENE, SMALL.cameras, REST @ se3.make(np.eye(3), [0.0, 0.0, 5000.0]), rng, CLEAN)
    here = pictures(SCENE, SMALL.cameras, REST, rng, CLEAN)
    for a, b, c in zip(away, behind, here, strict=True):
        assert (a == b).all() and (a != c).any()


def test_the_views_are_rich_enough_to_track() -> None:
    """Corners that stand out of the grain, in the middle of the patch."""

    def strength(image: np.ndarray) -> np.ndarray:
        return cv2.cornerMinEigenVal(grey(image)[300:440, 560:740], 3)

    grain = np.rint(128 + NOISY.noise * np.random.default_rng(2).standard_normal((720, 1280, 3))).astype(np.uint8)
    for image in pictures(SCENE, arc_rig().cameras, REST, np.random.default_rng(2)):
        found = strength(image)
        peaks = found == cv2.dilate(found, np.ones((9, 9)))
        assert (peaks & (found > 2 * strength(grain).max())).sum() > 150


@pytest.mark.parametrize("quality", [95, *slowly(None)])
def test_a_written_session_reads_back(tmp_path: Path, quality: int | None) -> None:
    truth = write_session(tmp_path, 0.1, seed=3, quality=quality, cameras=SMALL)
    session = open_session(tmp_path)
    assert [c.name for c in session.rig.cameras] == ["cam_0", "cam_1", "cam_2"]
    np.testing.assert_array_equal(session.rig.matrices, SMALL.matrices)
    assert [len(s.frames) for s in session.frame_sets()] == [3, 3, 3]
    assert session.truth is not None and session.truth.exact
    np.testing.assert_array_equal(session.truth.stamps, truth.stamps)
    np.testing.assert_allclose(session.truth.base_from_surface, truth.base_from_surface, rtol=0, atol=1e-12)
    assert [r.camera for r in session.roi] == [0, 1, 2] and session.surface is None
    drawn = frame_sets(patch(3), SMALL, breathing, truth.stamps, np.random.default_rng([3, 3]))
    pairs = zip(session.frame_sets(), drawn, strict=True)
    frames = [pair for x, y in pairs for pair in zip(x.frames, y.frames, strict=True)]
    worst = max(np.abs(grey(a.image).astype(float) - grey(b.image)).mean() for a, b in frames)
    assert worst < 2.0 if quality else worst == 0.0


def test_a_session_with_a_scan_tells_the_truth_of_the_scan(tmp_path: Path) -> None:
    write_session(tmp_path, 0.05, cameras=SMALL, scan=True)
    session = open_session(tmp_path)
    assert session.surface == tmp_path / "surface.ply" and session.truth is not None
    scan_points, _ = scan_of(SCENE)
    placed = se3.transform_points(read_tum(tmp_path / "truth.tum", True).base_from_surface[0], scan_points)
    true = se3.transform_points(breathing(0.0), SCENE.shape.points(SCENE.shape.grid(1.0)))
    np.testing.assert_allclose(placed, true, atol=1e-9)
    np.testing.assert_allclose(session.truth.base_from_surface[0] @ SCAN_FROM_SURFACE, breathing(0.0), atol=1e-9)


def test_a_region_holds_the_wound_and_lies_on_the_patch() -> None:
    for roi, camera in zip(rois(SCENE, SMALL, REST, 0.0), SMALL.cameras, strict=True):
        polygon = roi.polygon.astype(np.float32)
        middle, _ = pixels_from_points(camera, se3.transform_points(REST, SCENE.shape.points([[0.0, 0.0]])))
        corners = SCENE.shape.points(np.array(SCENE.shape.size) / 2 * [[-1, -1], [-1, 1], [1, -1], [1, 1]])
        edge, _ = pixels_from_points(camera, se3.transform_points(REST, corners))
        assert cv2.pointPolygonTest(polygon, middle[0].tolist(), False) > 0
        assert all(cv2.pointPolygonTest(polygon, p.tolist(), False) < 0 for p in edge)
