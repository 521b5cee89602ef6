"""Prediction: laws of the forecast, gaps and bad poses, intervals that keep their claim; surprise is doubted."""

from __future__ import annotations

import pickle
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from estimation import se3
from estimation.forecast.predictor import HORIZONS, MAX_OUTLIER_DURATION_S, InnovationGate, PoseHistory, Predictor
from estimation.pose import Forecast, SurfacePose, TrackState, body_twist, radius
from estimation.se3 import Array
from tests.slow_cases import slowly

MOVED = se3.exp(np.array([0.7, -1.1, 0.4, 300.0, -200.0, 500.0]))


def breathing(stamps: Array, noise: float = 0.05, seed: int = 0) -> Array:
    """Poses (T, 4, 4) of a rise and fall of 8 mm with a little turn, every third breath deeper, and noise, mm."""
    draw = np.random.default_rng(seed)
    phase = 2 * np.pi * 0.27 * stamps
    lift = 4 * np.cos(phase) ** 4 * (1 + 0.2 * np.cos(phase / 3)) + 0.3 * np.sin(0.05 * stamps)
    steps = np.outer(lift, [0.01, 0.002, 0, 0.1, 0.2, 1.0])
    return se3.exp(steps + noise * draw.normal(size=steps.shape) / [60, 60, 60, 1, 1, 1])


def seen(stamps: Array, poses: Array) -> list[SurfacePose]:
    """Tracked poses with the velocity since the one before."""
    twists = np.zeros((len(stamps), 6))
    twists[1:] = se3.log(se3.inverse(poses[:-1]) @ poses[1:]) / np.diff(stamps)[:, None]
    sure = 1e-6 * np.eye(6)
    rows = zip(stamps.tolist(), poses, twists, strict=True)
    return [SurfacePose(stamp, pose, sure, twist, TrackState.TRACKING) for stamp, pose, twist in rows]


def forecasts(poses: list[SurfacePose]) -> list[Forecast | None]:
    predictor = Predictor()
    return [predictor.add(pose) for pose in poses]


def last_forecast(poses: list[SurfacePose]) -> Forecast:
    last = forecasts(poses)[-1]
    assert last is not None
    return last


@pytest.fixture(scope="module")
def stamps() -> Array:
    return np.arange(0, 40, 0.1)


@pytest.fixture(scope="module")
def usual(stamps: Array) -> Forecast:
    """The last forecast of plain breathing."""
    return last_forecast(seen(stamps, breathing(stamps)))


def test_constant_velocity_is_predicted_exactly(stamps: Array) -> None:
    twist = np.array([0.01, -0.02, 0.005, 3.0, 1.0, -2.0])
    last = last_forecast(seen(stamps[:200], se3.exp(stamps[:200, None] * twist)))
    assert np.abs(last.increments - HORIZONS[:, None] * twist).max() < 1e-6


def test_the_base_frame_does_not_matter(stamps: Array, usual: Forecast) -> None:
    there = last_forecast(seen(stamps, MOVED @ breathing(stamps)))
    assert np.allclose(usual.increments, there.increments, atol=1e-6)
    assert np.allclose(usual.covariances, there.covariances, rtol=1e-4, atol=1e-9)


@pytest.mark.parametrize("period", [0.1, 1 / 30, 0.137, *slowly(1 / 60)])
def test_breathing_is_predicted_far_better_than_by_its_velocity(period: float) -> None:
    stamps = np.arange(0, 40, period)
    poses, truth = seen(stamps, breathing(stamps)), breathing(stamps, noise=0.0)
    errors = []
    for pose, forecast in zip(poses, forecasts(poses), strict=True):
        later = min(int(np.searchsorted(stamps, pose.stamp + 0.3 - 1e-9)), len(stamps) - 1)
        if forecast is not None and stamps[later] - pose.stamp < 0.5:
            guesses = [
                p.predicted_poses(stamps[later : later + 1])[0, :3, 3] for p in (pose, replace(pose, forecast=forecast))
            ]
            errors.append([np.linalg.norm(guess - truth[later, :3, 3]) for guess in guesses])
    steady, ours = np.sqrt((np.array(errors)[100:] ** 2).mean(0))
    assert ours < 0.5 * steady


def test_a_step_of_a_still_surface_does_not_overshoot(stamps: Array) -> None:
    noise = 0.02 * np.random.default_rng(3).normal(size=(len(stamps), 6)) / [60, 60, 60, 1, 1, 1]
    at = 0.3 * (np.floor(stamps / 7) % 2)
    poses = se3.exp(noise + np.outer(at, [0, 0, 0, 0, 0, 1.0]))
    furthest = max(np.abs(f.increments[:, 5]).max() for f in forecasts(seen(stamps, poses)) if f is not None)
    assert furthest < 0.5  # by its velocity alone the surface would be 1.5 mm away


def test_nothing_is_forecast_before_enough_is_known_nor_after_a_gap(stamps: Array) -> None:
    poses = breathing(stamps)
    gone = (stamps < 20) | (stamps > 20.8)
    given = [f is not None for f in forecasts(seen(stamps[gone], poses[gone]))]
    times = stamps[gone]
    assert not any(np.array(given)[times < 8]) and all(np.array(given)[(times > 10) & (times < 20)])
    assert not any(np.array(given)[(times > 20.8) & (times < 23.7)]) and all(np.array(given)[times > 24.1])


def test_a_pose_that_is_not_finite_changes_nothing(stamps: Array) -> None:
    poses = seen(stamps[:150], breathing(stamps[:150]))
    bad = [
        replace(poses[100], base_from_surface=np.full((4, 4), np.nan)),
        replace(poses[100], twist=np.full(6, np.inf)),
    ]
    plain, mixed = last_forecast(poses), last_forecast([*poses[:100], *bad, *poses[100:]])
    assert plain.increments.tobytes() == mixed.increments.tobytes()


def test_nothing_is_loaded_once_it_follows() -> None:
    """The first forecast comes seconds after the first pose, while an arm already moves by it."""
    code = """
import sys
import numpy as np
from estimation.forecast.predictor import Predictor
from tests.test_predictor import breathing, seen
stamps = np.arange(0, 12, 0.1)
poses, predictor = seen(stamps, breathing(stamps)), Predictor()
before = set(sys.modules)
found = [predictor.add(pose) for pose in poses]
found[-1].at(np.array([0.05]))
print(sorted(set(sys.modules) - before))
"""
    root = Path(__file__).parents[1]
    done = subprocess.run([sys.executable, "-c", code], cwd=root, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_a_short_outage_or_a_wild_jump_leaves_forecasts_finite(stamps: Array) -> None:
    poses = breathing(stamps)
    poses[200:] = se3.exp(np.array([2.0, 1.0, 0.5, 80.0, 0, 0])) @ poses[200:]
    kept = np.ones(len(stamps), bool)
    kept[250:254] = False
    for forecast in forecasts(seen(stamps[kept], poses[kept])):
        if forecast is not None:
            assert np.isfinite(forecast.increments).all()
            assert np.linalg.eigvalsh(forecast.covariances).min() > 0


@pytest.mark.parametrize("memory", [0.5, pytest.param(0.9, marks=pytest.mark.slow)])
def test_ninety_percent_intervals_hold_ninety_percent(memory: float) -> None:
    draw = np.random.default_rng(5)
    count = 1500
    shocks = draw.standard_t(4, size=(count, 6)) * 0.2 / [60, 60, 60, 1, 1, 1]
    values = np.zeros((count, 6))
    for t in range(1, count):
        values[t] = memory * values[t - 1] + shocks[t]
    stamps, poses = 0.1 * np.arange(count), se3.exp(values)
    points = 60 * np.concatenate([np.zeros((1, 3)), np.eye(3), -np.eye(3)])
    tracked = seen(stamps, poses)
    made = forecasts(tracked)
    for k in (1, 5):
        inside = []
        for i, forecast in enumerate(made[:-k]):
            if i > 300 and i % 4 == 0:
                later = replace(tracked[i], forecast=forecast).predict(float(stamps[i + k]))
                places = (se3.transform_points(pose, points) for pose in (later.base_from_surface, poses[i + k]))
                inside.append(np.linalg.norm(np.subtract(*places), axis=1) <= later.radius_at(points))
        assert 0.88 <= np.mean(inside) <= 0.92


def test_an_irregular_time_widens_the_intervals(stamps: Array, usual: Forecast) -> None:
    wild = breathing(stamps)
    wild[370:] = wild[370:] @ se3.exp(np.random.default_rng(2).normal(size=(30, 6)) * [0, 0, 0, 1, 1, 1])
    irregular = last_forecast(seen(stamps, wild))
    assert np.trace(irregular.covariances[0]) > 4 * np.trace(usual.covariances[0])


def test_memory_stays_what_it_is() -> None:
    stamps = np.arange(0, 28, 1 / 30)
    predictor = Predictor()
    sizes = []
    for i, pose in enumerate(seen(stamps, breathing(stamps))):
        predictor.add(pose)
        if i in (450, 800):
            sizes.append(len(pickle.dumps(predictor)))
    assert sizes[1] < 1.02 * sizes[0]


def some_forecast() -> Forecast:
    steps = np.outer(HORIZONS, [0.02, 0.01, -0.01, 1.0, 2.0, 3.0]) + np.outer(HORIZONS**2, [0.1, 0, 0, 0, -3.0, 5.0])
    return Forecast(HORIZONS, steps, np.stack([h * np.diag([1e-4] * 3 + [0.1] * 3) for h in HORIZONS]))


def pose_with(forecast: Forecast | None) -> SurfacePose:
    return SurfacePose(2.0, MOVED, 1e-6 * np.eye(6), np.ones(6), TrackState.TRACKING, forecast=forecast)


def test_a_forecast_begins_at_the_pose_and_passes_its_horizons() -> None:
    forecast = some_forecast()
    pose = pose_with(forecast)
    assert pose.predict(2.0).base_from_surface.tobytes() == pose.base_from_surface.tobytes()
    assert np.allclose(pose.predict(2.0 + 1e-9).covariance, pose.covariance, atol=1e-8)
    for k, ahead in enumerate(HORIZONS):
        later = pose.predict(2.0 + float(ahead))
        assert np.allclose(later.base_from_surface, MOVED @ se3.exp(forecast.increments[k]), atol=1e-9)
        assert np.allclose(later.covariance, forecast.covariances[k])


@pytest.mark.parametrize("ahead", [-0.2, 0.0, 0.05, 0.33, 0.5, 0.7])
def test_many_instants_at_once_are_where_each_alone_is(ahead: float) -> None:
    pose = pose_with(some_forecast())
    assert np.allclose(
        pose.predicted_poses(np.array([2.0 + ahead]))[0], pose.predict(2.0 + ahead).base_from_surface, atol=1e-6
    )


def test_two_steps_of_a_forecast_end_where_one_does() -> None:
    pose = pose_with(some_forecast())
    once, twice = pose.predict(2.4), pose.predict(2.13).predict(2.4)
    assert np.allclose(once.base_from_surface, twice.base_from_surface, atol=1e-3)
    assert np.allclose(once.twist, twice.twist, atol=2e-2)


def test_the_predicted_twist_is_the_rate_of_the_predicted_pose() -> None:
    pose = pose_with(some_forecast())
    before, after = pose.predicted_poses(np.array([2.249, 2.251]))
    assert np.allclose(se3.log(se3.inverse(before) @ after) / 0.002, pose.predict(2.25).twist, atol=1e-3)
    assert np.allclose(body_twist(np.zeros(6), np.arange(6.0)), np.arange(6.0))


def test_a_forecast_crosses_to_another_process() -> None:
    copy = pickle.loads(pickle.dumps(some_forecast()))
    assert copy.increments.tobytes() == some_forecast().increments.tobytes()


@pytest.mark.parametrize("sigmas", [(1.0, 1.0, 1.0), (1.0, 0.1, 0.1), (1.0, 0.5, 0.0), (2.0, 0.0, 0.0)])
def test_the_radius_holds_nine_tenths_of_normal_errors(sigmas: tuple[float, float, float]) -> None:
    drawn = np.random.default_rng(0).normal(size=(200_000, 3)) * sigmas
    inside = np.linalg.norm(drawn, axis=1) < radius(np.diag(np.square(sigmas)))
    assert abs(inside.mean() - 0.9) < 0.01


def test_increments_of_the_past_are_those_of_the_group() -> None:
    draw = np.random.default_rng(4)
    poses, stamps = se3.exp(draw.normal(size=(30, 6)) * [0.8, 0.8, 0.8, 50, 50, 50]), 0.1 * np.arange(30)
    history = PoseHistory(2.0)
    for stamp, pose in zip(stamps.tolist(), poses, strict=True):
        history.add(stamp, pose)
    expected = se3.log(se3.inverse(poses[-1]) @ poses[15:])
    assert np.allclose(history.increments(np.tile(poses[-1], (15, 1, 1)), stamps[15:]), expected, atol=1e-9)
    assert history.duration == pytest.approx(2.0, abs=0.11)


RATE = 30.0
AT = 18.0  # s at which something happens
STAMPS = np.arange(0, 24, 1 / RATE)


def surprise_breathing(jump: Array, noise: float = 0.02) -> Array:
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
    return float(np.sqrt(np.linalg.eigvalsh(forecast.covariances[0][3:, 3:])[-1]))


def test_a_breath_is_no_surprise() -> None:
    claims = [claim(forecast) for forecast in followed(surprise_breathing(np.zeros(len(STAMPS))))[400:]]
    assert max(claims) < 2 * float(np.median(claims))


@pytest.mark.parametrize("speed", [40.0, *slowly(80.0, 200.0)])
def test_what_runs_away_is_doubted_within_two_poses(speed: float) -> None:
    away = np.clip(STAMPS - AT, 0.0, None)
    forecasts = followed(surprise_breathing(speed / np.pi * np.sin(np.pi * np.minimum(away, 1.0)) ** 2))
    begun = int(np.searchsorted(STAMPS, AT + 1e-6))
    calm = max(claim(f) for f in forecasts[begun - 90 : begun])
    assert max(claim(f) for f in forecasts[begun : begun + 2]) > max(0.3, 4 * calm)


def test_a_jump_is_forgotten_once_the_surface_goes_on_as_before() -> None:
    forecasts = followed(surprise_breathing(np.where(STAMPS > AT, 3.0, 0.0)))
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
    poses = surprise_breathing(away(begin, 120.0, 0.5))
    forecasts, after = followed(poses), int(np.searchsorted(STAMPS, begin + 0.5 + 0.2))
    for k in range(after, int(np.searchsorted(STAMPS, begin + 5.0)) - 3):
        if (forecast := forecasts[k]) is not None:
            off = se3.log(se3.inverse(poses[k] @ se3.exp(forecast.increments[0])) @ poses[k + 3])
            assert claim(forecast) < 0.5 and np.linalg.norm(off[3:]) < 0.5


def test_what_surprises_is_not_what_is_usual() -> None:
    surprise, draw = InnovationGate(), np.random.default_rng(2)
    calm = [0.01 * draw.normal(size=6) for _ in range(200)]
    for off in [*calm, *draw.normal(size=(30, 6)), *calm[:20]]:
        surprise(off, 1 / RATE, 0.1, 1e-4 * np.eye(6))
    assert not surprise.active
    assert surprise(0.1 * np.ones(6), 1 / RATE, 0.1, 1e-4 * np.eye(6))


@given(scale=st.floats(1e-3, 10.0), seed=st.integers(0, 99))
@settings(max_examples=20)
def test_what_is_usual_is_learned_whatever_its_size(scale: float, seed: int) -> None:
    surprise, draw = InnovationGate(), np.random.default_rng(seed)
    for _ in range(200):
        surprise(scale * draw.normal(size=6), 1 / RATE, 0.1, scale**2 * np.eye(6))
    assert not surprise.active
    assert surprise(30 * scale * np.ones(6), 1 / RATE, 0.1, scale**2 * np.eye(6))


def test_what_goes_on_surprising_becomes_usual() -> None:
    surprise, draw = InnovationGate(), np.random.default_rng(1)
    for _ in range(300):
        surprise(0.01 * draw.normal(size=6), 1 / RATE, 0.1, 1e-4 * np.eye(6))
    asides = [surprise(0.3 * draw.normal(size=6), 1 / RATE, 0.1, 1e-4 * np.eye(6)) for _ in range(200)]
    first = int(MAX_OUTLIER_DURATION_S * RATE)
    assert all(asides[: first - 1]) and not any(asides[first + 2 :])
    assert not surprise.active and not surprise.velocity.any()


def test_an_unknown_velocity_fades() -> None:
    surprise = InnovationGate()
    for off in (0.01, 0.01, 1.0):
        surprise(off * np.ones(6), 1 / RATE, 0.1, 1e-4 * np.eye(6))
    widest = np.trace(surprise.velocity_covariance)
    for _ in range(30):
        surprise(0.01 * np.ones(6), 1 / RATE, 0.1, 1e-4 * np.eye(6))
    assert 0 < np.trace(surprise.velocity_covariance) < 1e-3 * widest
