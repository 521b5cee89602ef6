"""The warp: a smooth field without a rigid part, followed from tracks, silent while nothing deforms."""

from __future__ import annotations

import pickle
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from estimation import se3
from estimation.online.deformation import WarpFilter, WarpModes, modes_from_map
from estimation.online.estimator import Estimator
from estimation.online.surface_state import StateSettings
from estimation.pose import SurfacePose, TrackState
from estimation.pose_solver import PointTracks, solve_pose
from estimation.se3 import Array
from estimation.surface_map import SurfaceMap, Warp
from estimation.synthetic.world import BASE_FROM_REST, arc_rig, observations, patch
from hardware.simulator.scene.shape import Deformation
from tests.rendered_sets import Motion, breathing, still
from tests.slow_cases import slowly

RIG = arc_rig()
LANDMARKS = patch(100, np.random.default_rng(3)).points
MAP = SurfaceMap(LANDMARKS, np.tile([0.0, 0.0, 1.0], (len(LANDMARKS), 1)), np.zeros((300, 300)))
CHECKPOINTS = 0.6 * patch(30, np.random.default_rng(4)).points
CHECKPOINTS[:, 2] = np.sqrt(70.0**2 - CHECKPOINTS[:, 1] ** 2) - 70.0  # back onto the cylinder
MODES = modes_from_map(MAP)
BULGE = Deformation((0.03, 0.01), 1.5, 25.0)


def warp_of(seed: int, size: float = 1.0, modes: WarpModes = MODES) -> Warp:
    """A warp of `size` mm root mean square and any shape."""
    drawn = np.random.default_rng(seed).normal(size=len(modes.share)) * np.sqrt(modes.share)
    return modes.warp(size * drawn / np.linalg.norm(drawn), 1e-4 * np.eye(len(drawn)), 0.01)


@settings(max_examples=30)
@given(seed=st.integers(0, 10**6), size=st.floats(0.01, 3.0))
def test_a_warp_moves_the_landmarks_by_its_size_and_neither_shifts_nor_turns_them(seed: int, size: float) -> None:
    moved = warp_of(seed, size).displacement(LANDMARKS)
    assert np.sqrt((moved**2).sum(1).mean()) == pytest.approx(size, rel=1e-6)
    assert np.abs(moved.mean(0)).max() < 1e-6 * size
    assert np.abs(np.cross(LANDMARKS - LANDMARKS.mean(0), moved).mean(0)).max() < 1e-4 * size


@settings(max_examples=30)
@given(seed=st.integers(0, 10**6), size=st.floats(0.0, 2.0))
def test_a_warp_is_undone_and_poses_are_carried_there_and_back(seed: int, size: float) -> None:
    warp = warp_of(seed, size or 1e-9)
    assert warp.undo(warp.apply(CHECKPOINTS)) == pytest.approx(CHECKPOINTS, abs=2e-3 * max(size, 1e-3))
    poses = se3.make(se3.exp_rotation(0.3 * np.random.default_rng(seed).normal(size=(30, 3))), CHECKPOINTS)
    carried = warp.apply_to_poses(poses)
    assert carried[:, :3, 3] == pytest.approx(warp.apply(CHECKPOINTS), abs=1e-12)
    assert warp.undo_on_poses(carried) == pytest.approx(poses, abs=3e-3 * max(size, 1e-3))
    assert all(se3.is_transform(pose) for pose in carried)


def test_a_pose_turns_with_the_tissue_by_the_polar_decomposition_of_the_gradient() -> None:
    warp, step = warp_of(5, 0.5), 1e-4
    poses = se3.make(np.eye(3), CHECKPOINTS)
    slopes = [warp.displacement(CHECKPOINTS + step * a) - warp.displacement(CHECKPOINTS - step * a) for a in np.eye(3)]
    u, _, vt = np.linalg.svd(np.eye(3) + np.stack(slopes, -1) / (2 * step))
    assert se3.angle_of(np.swapaxes(u @ vt, -1, -2) @ warp.apply_to_poses(poses)[:, :3, :3]).max() < np.deg2rad(0.1)


def test_many_points_are_moved_like_each_alone_and_far_away_nothing_is() -> None:
    warp = warp_of(2)
    singly = np.concatenate([warp.apply(p[None]) for p in CHECKPOINTS])
    np.testing.assert_allclose(singly, warp.apply(CHECKPOINTS), atol=1e-12)
    assert np.abs(warp.displacement(np.array([[0.0, 0.0, 300.0]]))).max() < 1e-6


def test_a_warp_survives_a_pipe() -> None:
    warp = warp_of(1)
    back = pickle.loads(pickle.dumps(warp))
    assert back.apply(CHECKPOINTS).tobytes() == warp.apply(CHECKPOINTS).tobytes()


def test_a_warp_is_known_the_less_the_older_it_is_and_the_pose_says_so() -> None:
    warp = warp_of(1)
    pose = SurfacePose(0.0, BASE_FROM_REST, np.zeros((6, 6)), np.zeros(6), TrackState.TRACKING, warp=warp)
    now, later = pose.error_at(CHECKPOINTS), pose.predict(0.2).error_at(CHECKPOINTS)
    assert (later > now).all() and (now > 0).all()
    assert replace(pose, warp=None).error_at(CHECKPOINTS) == pytest.approx(np.zeros(30))


class Follow:
    """The estimator on a surface that deforms; what it said, and how far its checkpoints were from the tissue."""

    def __init__(
        self, deformation: Deformation, motion: Motion = breathing, seconds: float = 6.0, refined_at: float = np.inf
    ) -> None:
        """The surface is rigid for a second. refined_at: s, when the map takes in half of the deformation."""
        self.estimator = Estimator(RIG)
        self.estimator.begin(0.0, motion(0.0), MAP)
        self.poses: list[SurfacePose] = []
        self.errors: list[Array] = []  # (30,) mm each, with the warp
        self.rigid: list[Array] = []  # without
        for k in range(1, round(30 * seconds)):
            stamp = k / 30
            amount = 0.5 * (1 - np.cos(0.5 * np.pi * max(stamp - 1.0, 0.0)))
            landmarks = LANDMARKS + deformation.displacement(LANDMARKS, amount)
            seen = observations(RIG, landmarks, motion(stamp), stamp, np.random.default_rng([k, 5]), 0.1)
            fit = self.estimator.fit(seen, self.estimator.predict(stamp))
            pose = self.estimator.accept(fit, seen)
            if abs(stamp - refined_at) < 1e-6:
                half = MODES.modes_of(deformation.displacement(LANDMARKS, 0.5))
                points = np.concatenate([LANDMARKS + MODES.landmarks @ half, CHECKPOINTS])  # and there are new ones
                normals, covariance = np.tile([0.0, 0.0, 1.0], (len(points), 1)), np.zeros((3 * len(points),) * 2)
                self.estimator.replace_map(SurfaceMap(points, normals, covariance))
            true = se3.transform_points(motion(stamp), CHECKPOINTS + deformation.displacement(CHECKPOINTS, amount))
            self.poses.append(pose)
            for points, errors in ((CHECKPOINTS, self.rigid), (_warped(pose), self.errors)):
                there = se3.transform_points(pose.base_from_surface, points)
                errors.append(np.linalg.norm(there - true, axis=1))


def _warped(pose: SurfacePose) -> Array:
    return CHECKPOINTS if pose.warp is None else pose.warp.apply(CHECKPOINTS)


FIRST = StateSettings().averaged_poses  # frame sets until a pose is given out


@pytest.fixture(scope="module")
def bulging() -> Follow:
    return Follow(BULGE)


@pytest.mark.parametrize("motion", [breathing, *slowly(still)])
def test_a_rigid_motion_gives_no_warp_at_all(motion: Motion) -> None:
    rigid = Follow(Deformation(), motion, seconds=3.0)
    assert all(pose.warp is None and pose.deformation == 0.0 for pose in rigid.poses)
    assert all(pose.state is TrackState.TRACKING for pose in rigid.poses[FIRST:])


@pytest.mark.slow
def test_a_warp_keeps_the_checkpoints_on_the_tissue(bulging: Follow) -> None:
    with_warp, without = (np.percentile(errors, 95) for errors in (bulging.errors, bulging.rigid))
    assert without > 0.4
    assert with_warp < without / 5


def test_the_error_that_is_left_is_the_one_predicted(bulging: Follow) -> None:
    predicted = np.stack([pose.error_at(CHECKPOINTS) for pose in bulging.poses[60:]])
    errors = np.stack(bulging.errors[60:])
    assert np.mean(errors < 3 * predicted) > 0.95
    assert np.median(predicted) < 0.1


def test_a_deformed_surface_is_degraded_between_two_thresholds(bulging: Follow) -> None:
    settings = bulging.estimator.settings.states
    sizes = np.array([pose.deformation for pose in bulging.poses])
    degraded = np.array(["deformed" in pose.reason for pose in bulging.poses])
    assert all(pose.state is TrackState.DEGRADED for pose in bulging.poses[FIRST:] if pose.reason)
    assert sizes.max() > 0.45 and sizes.min() == 0.0
    assert degraded[sizes > settings.leave_deformation].all()
    assert not degraded[sizes <= settings.enter_deformation].any()
    between = (sizes > settings.enter_deformation) & (sizes <= settings.leave_deformation)
    assert between[1:].any() and (degraded[1:] == degraded[:-1])[between[1:]].all()
    assert "deformed by" in bulging.poses[int(np.argmax(sizes))].reason


def test_a_map_that_takes_in_the_mean_deformation_leaves_the_checkpoints_on_the_tissue() -> None:
    refined = Follow(BULGE, seconds=4.0, refined_at=2.5)
    assert np.percentile(refined.errors[90:], 95) < 0.3 * np.percentile(refined.rigid[90:], 95)


def _filtered(amounts: Array, seed: int = 0) -> WarpFilter:
    """A filter that has seen the cylinder bulge by so much in frame sets 1/30 s apart."""
    warps, rng = WarpFilter(MAP), np.random.default_rng(seed)
    for k, amount in enumerate(amounts):
        bent = LANDMARKS + BULGE.displacement(LANDMARKS, float(amount))
        seen = observations(RIG, bent, BASE_FROM_REST, k / 30, rng, 0.1)
        points = warps.points(MAP)[seen.track]
        fit = solve_pose(RIG, PointTracks.from_observations(seen, points), BASE_FROM_REST)
        warps.learn(seen, fit, seen.sigma, np.zeros(6), 0.0)
    return warps


BREATH = 0.5 * (1 - np.cos(np.linspace(0.0, 2 * np.pi, 60)))


def test_a_chest_that_rests_between_two_breaths_is_as_lively_as_before() -> None:
    moving, resting = _filtered(BREATH), _filtered(np.concatenate([BREATH, np.zeros(60)]))
    assert moving.liveliness > 0
    assert 0.8 * moving.liveliness < resting.liveliness <= moving.liveliness


def test_a_rigid_surface_is_never_lively() -> None:
    assert _filtered(np.zeros(90)).liveliness == 0.0


def test_what_the_map_is_told_of_its_error_was_no_deformation() -> None:
    """A map that is found to have been wrong by what looked like a deformation leaves none."""
    warps = _filtered(BREATH[:25])
    bent = warps.points(MAP)
    before = warps.warp.deformation
    warps.replace_map(replace(MAP, points=bent), undeformed=True)
    after = np.linalg.norm(warps.points(replace(MAP, points=bent)) - bent, axis=1)
    assert np.sqrt(np.mean(after**2)) < 0.15 * before
