"""Offsets and shifts of whole cameras: found where they show, not confused, and nothing made up where they do not."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from estimation.online.camera_errors import CameraErrors, Clocks, Variance
from estimation.online.pose_solver import SharedFit
from estimation.synthetic.follow import Follower, beginning
from estimation.synthetic.world import synthetic_world
from tests.test_estimator import begun, lively, look, stamps, step


def learned(offsets: tuple[float, float, float], seconds: float) -> CameraErrors:
    """After following a world whose cameras are `offsets` late, s."""
    estimator = begun(lively)
    for t in stamps(seconds):
        step(estimator, look(lively, float(t), 6, delays=offsets))
    return estimator.cameras


@pytest.mark.parametrize("offsets", [(0.0, 0.0, 0.0), (0.016, 0.0, -0.016), (0.002, -0.009, 0.013)])
def test_offsets_are_found_to_two_milliseconds_in_two_seconds(offsets: tuple[float, float, float]) -> None:
    cameras = learned(offsets, 2.0)
    apart = cameras.offset - (np.array(offsets) - np.mean(offsets))
    assert (np.abs(apart) < 2e-3).all() and (np.abs(apart) < 4 * cameras.offset_sigma).all()


def test_cameras_in_step_with_a_steady_clock_are_known_to_be() -> None:
    assert learned((0, 0, 0), 4.0).delays.sigma < 0.002


def test_a_surface_at_rest_teaches_nothing_of_the_offsets() -> None:
    estimator = begun(lambda stamp: lively(0.0))
    before = estimator.cameras.offset_sigma
    for t in stamps(2.0):
        step(estimator, look(lambda stamp: lively(0.0), float(t), 6, delays=(0.016, 0.0, -0.016)))
    assert (estimator.cameras.offset_sigma > 0.5 * before).all()
    assert (np.abs(estimator.cameras.offset) < 2 * before).all()


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1])
def test_a_lens_that_is_off_is_not_taken_for_a_late_clock(seed: int) -> None:
    offsets = (0.0, 0.016, -0.016)
    world = synthetic_world("breathing", 20.0, offsets=offsets, calibration=0.3, seed=seed)
    seen = world.observations()
    first = next(seen)
    follower = Follower(world.rig, first, beginning(world, first, "seen"), refine=True)
    for observations in seen:
        follower.idle()
        follower(observations)
    assert (np.abs(follower.estimator.cameras.offset - offsets) < 2e-3).all()


def test_what_all_clocks_have_in_common_is_never_made_up() -> None:
    cameras = learned((0.01, 0.01, 0.01), 2.0)
    assert abs(cameras.offset.sum()) < 1e-12 and (np.abs(cameras.offset) < 1e-3).all()


@given(st.integers(0, 1000))
def test_offsets_do_not_depend_on_the_order_of_the_cameras(seed: int) -> None:
    rng = np.random.default_rng(seed)
    order = rng.permutation(3)
    place = np.concatenate([order, 3 + order, 6 + order])
    root = rng.normal(size=(9, 9)) * 30
    information, pull = root @ root.T, rng.normal(size=9)
    one, other = CameraErrors(3), CameraErrors(3)
    one.learn(SharedFit(information, pull), 0.03)
    other.learn(SharedFit(information[np.ix_(place, place)], pull[place]), 0.03)
    np.testing.assert_allclose(one.offset[order], other.offset, atol=1e-9)


@pytest.mark.parametrize("sigma", [0.3, 1.0, 3.0])
@pytest.mark.parametrize("noise", [0.1, 1.0])
def test_a_variance_is_learned_through_noise(sigma: float, noise: float) -> None:
    rng, variance = np.random.default_rng(1), Variance(1.0, 0.01, 0.05)
    for _ in range(2000):
        variance.take(sigma * rng.normal() + noise * rng.normal(), noise**2)
    assert 0.6 * sigma < np.sqrt(variance.value) < 1.6 * sigma


def test_values_that_tell_nothing_change_nothing() -> None:
    variance = Variance(1.0, 0.01, 0.05)
    before = variance.value
    for _ in range(100):
        variance.take(3.0, 1e9)
    assert variance.value == pytest.approx(before, rel=1e-3)


def test_clocks_go_back_to_what_was_known_some_seconds_ago() -> None:
    early, late = learned((0.0, 0.01, -0.01), 1.0), learned((0.0, 0.05, -0.05), 1.0)
    clocks = Clocks(early)
    clocks.keep(0.0, early)
    clocks.keep(1.0, late)  # what a deformation is taken for
    assert np.array_equal(clocks.before.offset, early.offset)
    clocks.keep(2.5, late)
    assert np.array_equal(clocks.before.offset, early.offset)
    clocks.keep(5.0, late)
    assert np.array_equal(clocks.before.offset, late.offset)
