"""The Cramer-Rao bound: what an efficient estimate reaches and none passes, and how it changes with what is seen."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from estimation import se3
from estimation.observations import Observations
from estimation.online.pose_solver import solve_pose
from estimation.synthetic.bound import filtered_bound, pose_bound, pose_information, position_and_turn
from estimation.synthetic.world import World, synthetic_world

PSD = np.array([1e-3] * 3 + [30.0] * 3)


def information(world: World, seen: Observations) -> np.ndarray:
    pose = world.base_from_surface(np.array(seen.stamp))
    return pose_information(world.true_rig, pose, world.landmarks.points, seen)


def test_least_squares_reaches_the_bound_and_does_not_pass_it() -> None:
    world = synthetic_world("still", seconds=10.0, count=60, noise=0.3, seed=2)
    true = world.truth.base_from_surface[0]
    errors = []
    for seen in world:
        points = world.landmarks.points[seen.track]
        plain = solve_pose(world.rig, seen.camera, points, seen.pixels, seen.sigma, true, gate=1e6)
        errors.append(se3.log(se3.inverse(plain.base_from_surface) @ true))
    bound = pose_bound(information(world, seen))
    nees = np.einsum("ni,ij,nj->n", errors, np.linalg.inv(bound), errors)
    assert nees.mean() / 6 == pytest.approx(1.0, abs=0.08)  # 300 draws: one sigma is 0.033


@given(st.integers(0, 100), st.floats(0.05, 2.0))
@settings(max_examples=10)
def test_the_bound_grows_with_the_noise_and_shrinks_with_every_track(seed: int, noise: float) -> None:
    world = synthetic_world("still", seconds=0.1, count=40, noise=noise, seed=seed)
    seen = next(iter(world))
    whole = pose_bound(information(world, seen))
    half = Observations(seen.stamp, seen.camera[::2], seen.track[::2], seen.pixels[::2], seen.sigma[::2])
    louder = Observations(seen.stamp, seen.camera, seen.track, seen.pixels, 2 * seen.sigma)
    assert np.linalg.eigvalsh(pose_bound(information(world, half)) - whole).min() > 0
    np.testing.assert_allclose(pose_bound(information(world, louder)), 4 * whole)


def test_cameras_apart_hold_each_others_depth() -> None:
    """The order of magnitude of one, two and three cameras at 400 mm, f 1100 px, 100 tracks of 0.25 px."""
    world = synthetic_world("still", seconds=0.1, count=100, noise=0.25)
    seen = next(iter(world))
    sigma = []
    for cameras in ([0], [0, 1], [0, 1, 2]):
        mine = np.isin(seen.camera, cameras)
        part = Observations(seen.stamp, seen.camera[mine], seen.track[mine], seen.pixels[mine], seen.sigma[mine])
        sigma.append(position_and_turn(pose_bound(information(world, part)))[0])
    assert 0.1 < sigma[0] < 0.3 and 0.015 < sigma[1] < 0.05 and 0.008 < sigma[2] < 0.02


def test_frames_before_help_the_less_the_livelier_the_motion() -> None:
    world = synthetic_world("still", seconds=2.0, count=60)
    each = [information(world, seen) for seen in world]
    alone = pose_bound(each[-1])
    calm, lively = (filtered_bound(each, 1 / 30, psd) for psd in (PSD, 1e8 * PSD))
    assert len(calm) == len(world)
    np.testing.assert_allclose(calm[0], pose_bound(each[0]), rtol=1e-5)
    np.testing.assert_allclose(lively[-1], alone, rtol=1e-2)
    assert np.linalg.eigvalsh(alone - calm[-1]).min() > 0
    assert (np.diff([np.trace(c) for c in calm]) < 1e-12).all()


def test_a_motion_without_noise_is_averaged_for_good() -> None:
    """At constant velocity the newest of n poses is known to 4 / n of one alone: the end of a fitted line."""
    each = [np.diag([1e4] * 3 + [1e2] * 3)] * 200
    bound = filtered_bound(each, 1 / 30, np.zeros(6))[-1]
    np.testing.assert_allclose(bound, pose_bound(each[0]) * 4 / 200, rtol=0.02, atol=1e-12)
