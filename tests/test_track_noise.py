"""The parts of the tracks' scatter: what is new each time, what lasts, and what never changes."""

from __future__ import annotations

import numpy as np
import pytest

from estimation.observations import Observations
from estimation.online.fit import residual_scatter
from estimation.online.reported_covariance import TrackNoise
from estimation.pose_solver import PoseFit
from estimation.se3 import Array

COUNT, CAMERAS = 120, 3
SIGMA = np.full(COUNT, 0.25)


def seen(stamp: float) -> Observations:
    rows = np.arange(COUNT)
    return Observations(stamp, rows % CAMERAS, rows, np.zeros((COUNT, 2)), SIGMA)


def fitted(residuals: Array) -> PoseFit:
    square = (residuals**2).sum(1) / SIGMA**2
    weights = (1 + square / 9) ** -2
    return PoseFit(np.eye(4), np.eye(6), residuals, weights, np.zeros((COUNT, 2, 6)), 1.0)


def learned(new: float, slow: float, fixed: float, seconds: float = 8.0) -> TrackNoise:
    """From tracks with errors that are new with each frame set, that change over a second, and that never do; px."""
    rng, noise, keep = np.random.default_rng(5), TrackNoise(CAMERAS), np.exp(-1 / 15)
    never, drift = fixed * rng.normal(size=(COUNT, 2)), slow * rng.normal(size=(COUNT, 2))
    for k in range(round(30 * seconds)):
        drift = keep * drift + slow * np.sqrt(1 - keep**2) * rng.normal(size=(COUNT, 2))
        noise.learn(seen(k / 30), fitted(never + drift + new * rng.normal(size=(COUNT, 2))), SIGMA)
    return noise


def test_white_noise_is_all_new() -> None:
    noise = learned(0.1, 0.0, 0.0)
    assert noise.new == pytest.approx(1.0, abs=0.03) and noise.lasting < 0.03


def test_what_changes_over_seconds_lasts() -> None:
    noise = learned(0.05, 0.1, 0.0)
    assert 0.2 < noise.new < 0.4 and noise.new + noise.lasting == pytest.approx(1.0, abs=0.15)


def test_what_never_changes_is_neither() -> None:
    noise = learned(0.05, 0.0, 0.1)
    assert noise.new == pytest.approx(0.2, abs=0.05) and noise.lasting < 0.05


def test_before_anything_is_seen_all_is_new() -> None:
    assert (TrackNoise(CAMERAS).new, TrackNoise(CAMERAS).lasting) == (1.0, 0.0)


@pytest.mark.parametrize("size", [0.1, 0.3, 1.0])
def test_the_scatter_is_that_of_the_residuals(size: float) -> None:
    rng = np.random.default_rng(3)
    noises = [size * SIGMA[:, None] * rng.normal(size=(COUNT, 2)) for _ in range(40)]
    found = [residual_scatter(seen(0.0), fitted(noise)) for noise in noises]
    assert np.mean(found) == pytest.approx(size**2, rel=0.1, abs=0.12)


def test_wrong_tracks_hardly_count_in_the_scatter() -> None:
    residuals = 0.3 * SIGMA[:, None] * np.random.default_rng(4).normal(size=(COUNT, 2))
    residuals[: COUNT // 10] = 20.0
    assert residual_scatter(seen(0.0), fitted(residuals)) < 0.3
