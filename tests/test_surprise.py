"""Surprise: a surface that runs away is doubted from the next pose on, and what nobody could know spoils nothing."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from estimation import se3
from estimation.forecast import Forecast
from estimation.forecast.innovation_gate import PATIENCE, Surprise
from estimation.forecast.predictor import Predictor
from estimation.pose import SurfacePose, TrackState
from estimation.se3 import Array
from tests.slowly import slowly

RATE = 30.0
AT = 30.0  # s at which something happens
STAMPS = np.arange(0, 36, 1 / RATE)


def breathing(jump: Array, noise: float = 0.02) -> Array:
    """Poses (T, 4, 4) that rise and fall by 6 mm; jump: (T,) mm that nothing foretells."""
    lift = 3 * np.sin(2 * np.pi * 0.25 * STAMPS)
    steps = np.outer(lift, [0.005, 0, 0, 0.1, 0.2, 1.0]) + np.outer(jump, [0, 0, 0, 0.6, 0.0, 0.8])
    return se3.exp(steps + noise * np.random.default_rng(3).normal(size=steps.shape) / [60, 60, 60, 1, 1, 1])


def followed(poses: Array) -> list[Forecast | None]:
    """The forecast at each pose, whose velocity is that since the one before, known as well as its noise says."""
    twists = np.zeros((len(STAMPS), 6))
    twists[1:] = se3.log(se3.inverse(poses[:-1]) @ poses[1:]) * RATE
    predictor, sure, lever = Predictor(), 1e-6 * np.eye(6), np.array([1 / 60] * 3 + [1.0] * 3)
    known = np.diag(lever**2), 10 * lever**2  # mm^2/s^2 and mm^2/s^3
    rows = zip(STAMPS.tolist(), poses, twists, strict=True)
    return [
        predictor.add(SurfacePose(stamp, pose, sure, twist, TrackState.TRACKING, *known)) for stamp, pose, twist in rows
    ]


def claim(forecast: Forecast | None) -> float:
    """Standard deviation, mm, of the position a tenth of a second ahead, along its worst direction."""
    assert forecast is not None
    return float(np.sqrt(np.linalg.eigvalsh(forecast.covariances[0][3:, 3:])[-1]))


def test_a_breath_is_no_surprise() -> None:
    claims = [claim(forecast) for forecast in followed(breathing(np.zeros(len(STAMPS))))[600:]]
    assert max(claims) < 2 * float(np.median(claims))


@pytest.mark.parametrize("speed", [40.0, *slowly(80.0, 200.0)])
def test_what_runs_away_is_doubted_within_two_poses(speed: float) -> None:
    away = np.clip(STAMPS - AT, 0.0, None)
    forecasts = followed(breathing(speed / np.pi * np.sin(np.pi * np.minimum(away, 1.0)) ** 2))
    begun = int(np.searchsorted(STAMPS, AT + 1e-6))
    calm = max(claim(f) for f in forecasts[begun - 90 : begun])
    assert max(claim(f) for f in forecasts[begun : begun + 2]) > max(0.3, 4 * calm)


def test_a_jump_is_forgotten_once_the_surface_goes_on_as_before() -> None:
    forecasts = followed(breathing(np.where(STAMPS > AT, 3.0, 0.0)))
    begun = int(np.searchsorted(STAMPS, AT + 1e-6))
    calm = max(claim(f) for f in forecasts[begun - 90 : begun])
    assert claim(forecasts[begun]) > 1.0
    assert max(claim(f) for f in forecasts[begun + 120 :]) < 10 * calm


def away(begin: float, speed: float, seconds: float) -> Array:
    """(T,) mm of a surface that runs away from `begin` s on, that fast at most, and is back after so many seconds."""
    phase = np.clip((STAMPS - begin) / seconds, 0.0, 1.0)
    return np.asarray(speed * seconds / np.pi * np.sin(np.pi * phase) ** 2)


@pytest.mark.parametrize("begin", [3.2, 9.5, *slowly(6.0, 14.0)])
def test_what_ran_away_is_over_soon_after_it_is_back_however_little_was_learned(begin: float) -> None:
    poses = breathing(away(begin, 120.0, 0.5))
    forecasts, after = followed(poses), int(np.searchsorted(STAMPS, begin + 0.5 + 0.2))
    for k in range(after, int(np.searchsorted(STAMPS, begin + 5.0)) - 3):
        if (forecast := forecasts[k]) is not None:
            off = se3.log(se3.inverse(poses[k] @ se3.exp(forecast.increments[0])) @ poses[k + 3])
            assert claim(forecast) < 0.5 and np.linalg.norm(off[3:]) < 0.5


def test_what_surprises_is_not_what_is_usual() -> None:
    surprise, draw = Surprise(), np.random.default_rng(2)
    calm = [0.01 * draw.normal(size=6) for _ in range(200)]
    for off in [*calm, *draw.normal(size=(30, 6)), *calm[:20]]:
        surprise(off, 1 / RATE, 0.1, 1e-4 * np.eye(6))
    assert not surprise.active
    assert surprise(0.1 * np.ones(6), 1 / RATE, 0.1, 1e-4 * np.eye(6))


@given(scale=st.floats(1e-3, 10.0), seed=st.integers(0, 99))
@settings(max_examples=20, deadline=None)
def test_what_is_usual_is_learned_whatever_its_size(scale: float, seed: int) -> None:
    surprise, draw = Surprise(), np.random.default_rng(seed)
    for _ in range(200):
        surprise(scale * draw.normal(size=6), 1 / RATE, 0.1, scale**2 * np.eye(6))
    assert not surprise.active
    assert surprise(30 * scale * np.ones(6), 1 / RATE, 0.1, scale**2 * np.eye(6))


def test_what_goes_on_surprising_becomes_usual() -> None:
    surprise, draw = Surprise(), np.random.default_rng(1)
    for _ in range(300):
        surprise(0.01 * draw.normal(size=6), 1 / RATE, 0.1, 1e-4 * np.eye(6))
    asides = [surprise(0.3 * draw.normal(size=6), 1 / RATE, 0.1, 1e-4 * np.eye(6)) for _ in range(200)]
    first = int(PATIENCE * RATE)
    assert all(asides[: first - 1]) and not any(asides[first + 2 :])
    assert not surprise.active and not surprise.drift.any()


def test_an_unknown_velocity_fades() -> None:
    surprise = Surprise()
    for off in (0.01, 0.01, 1.0):
        surprise(off * np.ones(6), 1 / RATE, 0.1, 1e-4 * np.eye(6))
    widest = np.trace(surprise.unknown)
    for _ in range(30):
        surprise(0.01 * np.ones(6), 1 / RATE, 0.1, 1e-4 * np.eye(6))
    assert 0 < np.trace(surprise.unknown) < 1e-3 * widest
