"""SurfacePose: the laws of prediction, and the error it claims at a point."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from estimation import se3
from estimation.pose import Forecast, SurfacePose, TrackState
from tests.slow_cases import slowly


def pose(seed: int) -> SurfacePose:
    draw = np.random.default_rng(seed)
    a, b = draw.normal(size=(2, 6, 6)) * np.array([0.01, 0.01, 0.01, 0.1, 0.1, 0.1])[:, None]
    return SurfacePose(
        stamp=draw.uniform(0, 100),
        base_from_surface=se3.exp(draw.normal(size=6) * [1, 1, 1, 300, 300, 300]),
        covariance=a @ a.T,
        twist=draw.normal(size=6) * [0.2, 0.2, 0.2, 20, 20, 20],
        state=TrackState.TRACKING,
        twist_covariance=b @ b.T,
        acceleration_psd=draw.uniform(0.1, 2, 6),
        reason="because",
    )


seeds = st.integers(0, 10_000)


@given(seeds)
def test_predicting_to_its_own_stamp_changes_nothing(seed: int) -> None:
    p = pose(seed)
    same = p.predict(p.stamp)
    assert np.array_equal(same.base_from_surface, p.base_from_surface)
    assert np.allclose(same.covariance, p.covariance, atol=1e-15)
    assert np.array_equal(same.twist_covariance, p.twist_covariance)
    assert (same.stamp, same.state, same.reason) == (p.stamp, p.state, p.reason)


@given(seeds, st.floats(0, 0.5), st.floats(0, 0.5))
def test_two_steps_end_where_one_does(seed: int, first: float, second: float) -> None:
    p = pose(seed)
    twice = p.predict(p.stamp + first).predict(p.stamp + first + second)
    once = p.predict(p.stamp + first + second)
    assert np.abs(twice.base_from_surface - once.base_from_surface).max() < 1e-8
    assert np.array_equal(twice.twist, once.twist)
    assert np.allclose(twice.twist_covariance, once.twist_covariance)


@given(seeds, st.floats(-0.5, 0.5))
def test_there_and_back_is_the_same_place(seed: int, dt: float) -> None:
    p = pose(seed)
    back = p.predict(p.stamp + dt).predict(p.stamp)
    assert np.abs(back.base_from_surface - p.base_from_surface).max() < 1e-8


@given(seeds, st.floats(-1, 1))
def test_covariance_stays_symmetric_and_positive(seed: int, dt: float) -> None:
    later = pose(seed).predict(pose(seed).stamp + dt)
    assert np.array_equal(later.covariance, later.covariance.T)
    assert np.linalg.eigvalsh(later.covariance).min() > -1e-12
    assert np.linalg.eigvalsh(later.twist_covariance).min() > -1e-12


@given(seeds, st.floats(0.001, 1))
def test_a_resting_surface_is_known_less_the_longer_it_is_not_seen(seed: int, dt: float) -> None:
    p = pose(seed)
    resting = replace(p, twist=np.zeros(6))
    for sign in (1, -1):
        later, much_later = resting.predict(p.stamp + sign * dt), resting.predict(p.stamp + 2 * sign * dt)
        assert np.linalg.eigvalsh(later.covariance - p.covariance).min() > 0
        assert np.linalg.eigvalsh(much_later.covariance - later.covariance).min() > 0
        assert np.array_equal(later.base_from_surface, p.base_from_surface)


@given(seeds, st.floats(0.01, 1))
def test_motion_carries_the_volume_of_the_covariance_and_only_noise_adds(seed: int, dt: float) -> None:
    p = pose(seed)
    noiseless = SurfacePose(p.stamp, p.base_from_surface, p.covariance, p.twist, p.state)
    later = noiseless.predict(p.stamp + dt)
    assert np.isclose(np.linalg.slogdet(later.covariance)[1], np.linalg.slogdet(p.covariance)[1], atol=1e-4)
    assert np.linalg.slogdet(p.predict(p.stamp + dt).covariance)[1] > np.linalg.slogdet(p.covariance)[1]


def test_the_predicted_covariance_is_that_of_predicted_samples() -> None:
    p, draw, dt = pose(4), np.random.default_rng(4), 0.3
    noiseless = SurfacePose(p.stamp, p.base_from_surface, p.covariance, p.twist, p.state)
    later = noiseless.predict(p.stamp + dt)
    samples = p.base_from_surface @ se3.exp(draw.multivariate_normal(np.zeros(6), p.covariance, 20_000))
    moved = samples @ se3.exp(p.twist * dt)
    found = np.cov(se3.log(se3.inverse(later.base_from_surface) @ moved).T)
    scale = np.sqrt(np.outer(np.diag(later.covariance), np.diag(later.covariance)))
    assert (np.abs(found - later.covariance) / scale).max() < 0.05


@pytest.mark.parametrize("seed", [0, 1, *slowly(2, 3)])
@pytest.mark.parametrize("dt", [0.15, 0.4])
def test_velocity_and_acceleration_widen_a_prediction_as_they_scatter_samples(seed: int, dt: float) -> None:
    """Samples of pose and twist, under white noise on acceleration; none of the three is small beside the others."""
    draw, start, steps, count = np.random.default_rng(seed), pose(seed), 30, 20_000
    start = replace(
        start,
        covariance=1e-2 * start.covariance,
        twist=0.1 * start.twist,
        twist_covariance=0.01 * start.twist_covariance / dt**2,
        acceleration_psd=draw.uniform(1, 4, 6) * [1e-6, 1e-6, 1e-6, 1e-4, 1e-4, 1e-4] / dt**3,
    )
    later = start.predict(start.stamp + dt)
    places = start.base_from_surface @ se3.exp(draw.multivariate_normal(np.zeros(6), start.covariance, count))
    twists = start.twist + draw.multivariate_normal(np.zeros(6), start.twist_covariance, count)
    for _ in range(steps):
        jolts = np.sqrt(start.acceleration_psd * dt / steps) * draw.normal(size=(count, 6))
        places = places @ se3.exp((twists + jolts / 2) * dt / steps)
        twists = twists + jolts
    scattered = se3.log(se3.inverse(later.base_from_surface) @ places)
    for claimed, found in ((later.covariance, scattered), (later.twist_covariance, twists)):
        sigma = np.sqrt(np.diag(claimed))
        assert (np.abs(np.cov(found.T) - claimed) / np.outer(sigma, sigma)).max() < 0.05


def test_the_error_at_a_point_is_that_of_samples() -> None:
    p, draw = pose(9), np.random.default_rng(9)
    points = np.array([[0.0, 0, 0], [30, 0, 0], [-20, 10, 5]])
    moves = se3.exp(draw.multivariate_normal(np.zeros(6), p.covariance / 100, 20_000))  # small: to first order
    seen = se3.transform_points(moves, points)  # (20000, 3, 3)
    worst = [10 * np.sqrt(np.linalg.eigvalsh(np.cov(seen[:, i].T))[-1]) for i in range(3)]
    assert np.allclose(p.error_at(points), worst, rtol=0.05)


def test_only_tracking_and_degraded_are_measured() -> None:
    assert [s for s in TrackState if s.measured] == [TrackState.TRACKING, TrackState.DEGRADED]


@given(st.integers(0, 2**32 - 1), st.floats(-0.3, 0.8))
def test_the_error_ahead_is_that_of_the_prediction(seed: int, dt: float) -> None:
    start, places = pose(seed), np.array([[0.0, 0, 0], [30.0, -20, 5]])
    if seed % 2:
        steps = np.array([0.1, 0.3, 0.5])
        grown = [(1 + k) * start.covariance for k in steps]
        start = replace(start, forecast=Forecast(steps, steps[:, None] * start.twist, np.stack(grown)))
    then = start.stamp + dt
    assert np.allclose(start.predicted_error(then, places), start.predict(then).error_at(places))
