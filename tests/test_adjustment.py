"""Refining the map: the true shape comes out of key frames, the surface frame stays where it is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from estimation import se3
from estimation.mapping.bundle_adjustment import AdjustedMap, KeyFrame, adjust, frame_change, remove_rigid_motion
from estimation.observations import Observations
from estimation.online.camera_errors import Delays
from estimation.pose_solver import PointTracks, solve_pose
from estimation.se3 import Array
from estimation.surface_map import SurfaceMap
from estimation.synthetic.world import BASE_FROM_REST, arc_rig, observations, patch
from tests.test_estimator import joined

RIG = arc_rig()


def swaying(stamp: float) -> Array:
    """A livelier motion than breathing: about 20 mm/s, and 10 degrees of turn."""
    w = 0.15 * np.sin(stamp * np.array([1.1, 1.7, 0.8]) + [0, 1, 2])
    return BASE_FROM_REST @ se3.make(se3.exp_rotation(w), 8.0 * np.sin(stamp * np.array([1.6, 1.2, 2.3]) + [2, 0, 1]))


def landmarks(seed: int = 0, count: int = 40) -> Array:
    return patch(count, np.random.default_rng([seed, 3])).points


def as_map(points: Array, sigma: float = 0.5) -> SurfaceMap:
    return SurfaceMap(points, np.tile([0.0, 0.0, 1.0], (len(points), 1)), sigma**2 * np.eye(3 * len(points)))


def look(
    points: Array, stamp: float, seed: int, noise: float = 0.3, delays: Sequence[float] = (0, 0, 0)
) -> Observations:
    """What the cameras see, each `delays` s late."""
    parts = []
    for c, delay in enumerate(delays):
        only = np.zeros((len(RIG), len(points)), bool)
        only[c] = True
        draw = np.random.default_rng([seed, c, round(1000 * stamp)])
        parts.append(observations(RIG, points, swaying(stamp + delay), stamp, draw, noise, visible=only))
    seen = joined(stamp, parts)
    return replace(seen, sigma=np.maximum(seen.sigma, 0.1))


def fitted(seen: Observations, points: Array, start: Array) -> Array:
    return solve_pose(
        RIG, PointTracks.from_observations(seen, points[seen.track]), start, scales=(4.0, 1.0)
    ).base_from_surface


def key_frames(seen: list[Observations], points: Array) -> list[KeyFrame]:
    """Key frames with the poses that the map `points` gives, as the estimator publishes them."""
    frames = []
    for o in seen:
        twist = se3.log(se3.inverse(swaying(o.stamp - 0.01)) @ swaying(o.stamp + 0.01)) / 0.02
        frames.append(KeyFrame(fitted(o, points, swaying(o.stamp)), o, twist))
    return frames


def shape_error(found: Array, true: Array) -> float:
    """Root mean square distance, mm, of points (N, 3) from the true ones, after the best rigid motion."""
    a, b = found - found.mean(0), true - true.mean(0)
    u, _, v = np.linalg.svd(a.T @ b)
    flip = np.diag([1, 1, np.linalg.det(u @ v)])
    return float(np.sqrt(np.mean(np.sum((a @ u @ flip @ v - b) ** 2, axis=1))))


def size(points: Array) -> float:
    return float(np.sqrt(np.mean(np.sum((points - points.mean(0)) ** 2, axis=1))))


STAMPS = np.arange(8) * 0.4


def unsure(skew: float) -> Delays:
    """Nothing known of the delays but their standard deviation, s."""
    return Delays(np.zeros(3), skew**2 * np.eye(3))


def refine(
    true: Array, wrong: Array, seed: int = 1, noise: float = 0.3, delays: Sequence[float] = (0, 0, 0), skew: float = 0.0
) -> tuple[AdjustedMap, list[KeyFrame]]:
    frames = key_frames([look(true, float(t), seed, noise, delays) for t in STAMPS], wrong)
    adjusted = adjust(RIG, as_map(wrong), frames, unsure(skew))
    assert adjusted is not None
    return adjusted, frames


@pytest.mark.parametrize("shrink", [0.99, 1.01])
def test_a_skewed_first_map_gets_its_true_shape_and_size(shrink: float) -> None:
    true = landmarks()
    wrong = true * shrink + 0.1 * np.random.default_rng(5).normal(size=true.shape)
    adjusted, _ = refine(true, wrong)
    assert shape_error(wrong, true) > 0.2 and shape_error(adjusted.map.points, true) < 0.06
    assert abs(size(adjusted.map.points) / size(true) - 1) < 0.001 and adjusted.agrees.all()


def test_exact_pixels_give_the_exact_shape() -> None:
    true = landmarks(2)
    wrong = true * 0.99 + 0.1 * np.random.default_rng(6).normal(size=true.shape)
    adjusted, _ = refine(true, wrong, noise=0.0)
    assert shape_error(adjusted.map.points, true) < 2e-4


@pytest.mark.parametrize("delays", [(0.0, 0.016, -0.016), (0.03, 0.0, -0.01)])
def test_cameras_at_different_instants_do_not_distort_the_map(delays: tuple[float, ...]) -> None:
    true = landmarks(1)
    adjusted, _ = refine(true, true, delays=delays, skew=0.015)
    assert shape_error(adjusted.map.points, true) < 0.08 and abs(size(adjusted.map.points) / size(true) - 1) < 0.001
    assert adjusted.agrees.all()


def test_a_landmark_that_stays_while_the_rest_moves_is_found() -> None:
    true = landmarks(3)
    still, seen = np.array([4, 17, 30]), []
    for t in STAMPS:
        moving, resting = look(true, float(t), 2), look(true, 0.0, 2)
        stuck = np.isin(moving.track, still)
        seen.append(replace(moving, pixels=np.where(stuck[:, None], resting.pixels, moving.pixels)))
    adjusted = adjust(RIG, as_map(true), key_frames(seen, true), unsure(0.0))
    assert adjusted is not None and np.flatnonzero(~adjusted.agrees).tolist() == still.tolist()
    rest = np.setdiff1d(np.arange(len(true)), still)
    assert shape_error(adjusted.map.points[rest], true[rest]) < 0.06


def test_the_joint_covariance_is_as_wide_as_the_errors() -> None:
    ratios = []
    for seed in range(5):
        true = landmarks(seed, 25)
        wrong = true * 0.995 + 0.1 * np.random.default_rng([seed, 5]).normal(size=true.shape)
        points, covariance = (adjusted := refine(true, wrong, seed)[0]).map.points, adjusted.map.covariance
        motion = np.concatenate([-se3.hat(true), np.broadcast_to(np.eye(3), (len(true), 3, 3))], -1).reshape(-1, 6)
        basis = np.linalg.qr(motion)[0]
        error = (points - true).ravel()
        error -= basis @ (basis.T @ error)
        values, vectors = np.linalg.eigh(covariance)
        free = values > 1e-8 * values[-1]
        assert (~free).sum() == 6
        ratios.append(np.sum((vectors[:, free].T @ error) ** 2 / values[free]) / free.sum())
    assert 0.6 < np.mean(ratios) < 1.3


def test_the_frame_does_not_jump() -> None:
    """Plain fits to the same pixels with the old map and with the new agree in the mean."""
    true = landmarks(4)
    draw = np.random.default_rng(8)
    tilt = se3.exp(np.r_[0.02 * draw.normal(size=3), draw.normal(size=3)])
    wrong = se3.transform_points(tilt, true * 0.99 + 0.1 * draw.normal(size=true.shape))
    adjusted, frames = refine(true, wrong)
    new = np.stack([fitted(f.observations, adjusted.map.points, f.base_from_surface) for f in frames])
    changes = se3.log(se3.inverse(np.stack([f.base_from_surface for f in frames])) @ new)
    assert np.abs(changes.mean(0)[3:]).max() < 2e-3 and np.abs(changes.mean(0)[:3]).max() < 1e-4
    assert np.abs(changes).max() < 0.3


def test_the_change_of_frame_undoes_a_constant_one() -> None:
    true = landmarks(5)
    frames = key_frames([look(true, float(t), 3) for t in STAMPS], true)
    change = se3.exp(np.array([0.01, -0.02, 0.03, 1.0, -2.0, 0.5]))
    refined = np.stack([f.base_from_surface @ change for f in frames])
    assert np.allclose(frame_change(frames, refined, 0.01), change, atol=1e-9)


def test_a_covariance_without_its_frame_has_no_rigid_motion_left() -> None:
    points = landmarks(6, 12)
    motion = np.concatenate([-se3.hat(points), np.broadcast_to(np.eye(3), (12, 3, 3))], -1).reshape(-1, 6)
    a = np.random.default_rng(9).normal(size=(36, 40))
    left = remove_rigid_motion(a @ a.T, points)
    values = np.linalg.eigvalsh(left)
    assert np.allclose(left, left.T) and np.abs(values[:6]).max() < 1e-9 < values[6]
    whole = motion @ np.diag([0.1, 0.2, 0.1, 3.0, 1.0, 2.0]) @ motion.T
    assert np.abs(remove_rigid_motion(whole, points)).max() < 1e-9 * np.abs(whole).max()


def test_a_point_that_is_hardly_known_lends_nothing_to_the_others() -> None:
    points = landmarks(6, 12)
    known = 0.01 * np.eye(36)
    vague = known.copy()
    vague[2, 2] = 40.0**2
    before, after = np.diag(remove_rigid_motion(known, points))[3:], np.diag(remove_rigid_motion(vague, points))[3:]
    assert (after < before + 0.01 * 12 / 11 / 6).all()  # no more than one holder of the frame less accounts for


def test_normals_stay_unit_and_on_their_side() -> None:
    adjusted, _ = refine(landmarks(7), landmarks(7))
    assert np.allclose(np.linalg.norm(adjusted.map.normals, axis=1), 1) and (adjusted.map.normals[:, 2] > 0).all()


def test_a_landmark_seen_too_seldom_stays_where_it_was() -> None:
    true = landmarks(8)
    seen = []
    for i, t in enumerate(STAMPS):
        o = look(true, float(t), 4)
        keep = (o.track != 0) | ((o.camera < 2) & (i == 0))
        seen.append(o.select(keep))
    wrong = true.copy()
    wrong[0] += [0.0, 0.0, 5.0]
    adjusted = adjust(RIG, as_map(wrong), key_frames(seen, wrong), unsure(0.0))
    assert adjusted is not None and np.linalg.norm(adjusted.map.points[0] - wrong[0]) < 0.05 and adjusted.agrees[0]
    assert np.allclose(adjusted.map.covariance[:3, :3], 0.25 * np.eye(3))


@pytest.mark.parametrize(("frames", "count"), [(1, 40), (8, 8)])
def test_too_little_to_go_by_gives_no_map(frames: int, count: int) -> None:
    true = landmarks(9, count)
    seen = [look(true, float(t), 5) for t in STAMPS[:frames]]
    assert adjust(RIG, as_map(true), key_frames(seen, true), unsure(0.0)) is None


def test_two_runs_give_the_same_bits() -> None:
    a, b = (refine(landmarks(1), landmarks(1) * 0.99)[0].map for _ in range(2))
    assert a.points.tobytes() == b.points.tobytes() and a.covariance.tobytes() == b.covariance.tobytes()
