"""Benches of the closed loop, of consistency, latency and growth: what is measured, how it is judged, what is shown."""

from __future__ import annotations

import argparse

import numpy as np
import pytest

from estimation import se3
from estimation.pose import SurfacePose, TrackState
from estimation.se3 import Array
from hardware.bench.prediction import (
    FORECAST_INPUT,
    MOTION_INPUTS,
    Print,
    StillBed,
    at_rest,
    loop_page,
    steady,
)
from hardware.bench.recordings import latency_figures
from perception.tracking.step import STAGES
from tests.campaigns import growth
from tests.campaigns.estimator import SETTLING_SETS, consistency_figures, scene_errors
from tests.campaigns.growth import CostAxis, axes_for, growth_figures, slope

TWIST = np.array([0.0, 0.0, 0.1, 5.0, 0.0, -2.0])


def pose(stamp: float, state: TrackState = TrackState.TRACKING) -> SurfacePose:
    return SurfacePose(stamp, se3.exp(TWIST * stamp), 1e-4 * np.eye(6), TWIST, state, 1e-2 * np.eye(6), np.ones(6))


def test_each_way_knows_of_the_future_what_it_says() -> None:
    seen = pose(1.0)
    then = seen.stamp + 0.1
    assert np.allclose(at_rest(seen).predict(then).base_from_surface, seen.base_from_surface)
    assert np.allclose(steady(seen).predict(then).base_from_surface, se3.exp(TWIST * then))
    assert MOTION_INPUTS[FORECAST_INPUT]()(seen) is seen
    for way in (at_rest, steady):
        assert way(seen).predict(then).error_at(np.zeros((1, 3)))[0] < 1e-9
        assert (way(seen).stamp, way(seen).state) == (seen.stamp, seen.state)


def test_a_still_bed_stays_at_the_first_measured_pose() -> None:
    told = StillBed()
    assert np.allclose(told(pose(0.5, TrackState.INITIALISING)).base_from_surface, pose(0.5).base_from_surface)
    told(pose(1.0))
    for stamp in (1.1, 7.0):
        assert np.allclose(told(pose(stamp)).predict(stamp + 1).base_from_surface, pose(1.0).base_from_surface)
        assert told(pose(stamp)).stamp == stamp


def test_a_print_counts_what_leaves_the_nozzle() -> None:
    error = np.array([np.nan, 0.1, 0.2, np.nan, 0.3, np.nan])
    one = Print(np.arange(6.0), error)
    assert (one.percentile(100), one.duty) == (0.3, 0.75)
    nothing = Print(np.arange(6.0), np.full(6, np.nan))
    assert np.isnan(nothing.percentile(100)) and np.isnan(nothing.percentile(95)) and nothing.duty == 0.0


def test_the_page_shows_every_way_of_every_scenario() -> None:
    one = Print(np.arange(0, 1, 0.001), np.abs(np.sin(np.arange(0, 1, 0.001))))
    never = Print(one.stamps, np.full(1000, np.nan))
    prints = {(name, way): one if way == FORECAST_INPUT else never for name in "ab" for way in MOTION_INPUTS}
    page = loop_page(prints, {})
    assert all(page.count(f">{way}: 95 %") == 2 for way in MOTION_INPUTS) and page.count("<h2>") == 2


COUNT = 600
SIGMA = np.array([1e-4, 2e-4, 1e-4, 0.01, 0.01, 0.02])  # rad, mm
OTHER = se3.exp(np.array([0.3, -0.2, 0.5, 12.0, -7.0, 3.0]))  # true_from_own, of the surface frames


def poses(claimed: float, truth: Array, waiting: int = 5) -> list[SurfacePose]:
    """Poses with noise of SIGMA in their own surface frame, claimed `claimed` times as wide, TRACKING after a while."""
    draw, covariance = np.random.default_rng(3), np.diag((claimed * SIGMA) ** 2)
    own = truth @ OTHER
    rates = se3.log(se3.inverse(own) @ np.roll(own, -1, axis=0)) * 30
    made = []
    for k, pose in enumerate(own):
        noise = np.zeros(6) if k <= waiting else SIGMA * draw.normal(size=6)
        state = TrackState.TRACKING if k >= waiting else TrackState.INITIALISING
        twist = (rates[k - 1] + rates[k]) / 2 + 30 * SIGMA * draw.normal(size=6)
        made.append(SurfacePose(k / 30, pose @ se3.exp(noise), covariance, twist, state, 900 * covariance))
    return made


def figures(claimed: float, count: int = COUNT, waiting: int = 5) -> dict[str, float]:
    phase = np.arange(count)[:, None] / 20
    truth = se3.exp(np.sin(phase) * np.array([0.02, 0.01, 0.0, 1.0, 2.0, 3.0]))
    run = scene_errors(poses(claimed, truth, waiting), truth)
    return {f.what: f.value for f in consistency_figures("x", [run])}


@pytest.mark.parametrize(("claimed", "inside"), [(0.5, 0.67), (1.0, 0.95), (3.0, 1.0)])
def test_the_claim_is_held_against_the_error(claimed: float, inside: float) -> None:
    found = figures(claimed)
    assert found["x: NEES/6"] == pytest.approx(1 / claimed**2, rel=0.1)
    assert found["x: twist NEES/6"] == pytest.approx(1 / claimed**2, rel=0.1)
    assert found["x: inside 95 %"] == pytest.approx(inside, abs=0.02)
    assert found["x: claim of an axis"] / found["x: error of an axis"] == pytest.approx(claimed, rel=0.1)
    assert found["x: measured"] == 100.0


def test_a_surface_that_is_hardly_followed_has_no_consistency() -> None:
    for count, waiting in ((SETTLING_SETS, 5), (20, 20)):
        assert np.isnan(figures(1.0, count, waiting)["x: NEES/6"])


def latency_bench_figures(wall_ms: float, flow_share: float = 0.25) -> dict[str, tuple[float, str]]:
    wall = np.full((40, 1 + len(STAGES)), wall_ms / 1000)
    wall[round(40 * flow_share) :, 1 + STAGES.index("flow")] = 0.0
    found = latency_figures("x", wall, np.full(40, 0.002))
    return {f.what: (f.value, f.verdict) for f in found}


@pytest.mark.parametrize(
    ("ms", "verdicts"), [(7.9, ("met", "met", "met")), (12.0, ("MISSED", "met", "met")), (40.0, ("MISSED",) * 3)]
)
def test_latencies_are_judged_by_median_percentile_and_largest(ms: float, verdicts: tuple[str, ...]) -> None:
    found = latency_bench_figures(ms)
    for word, verdict in zip(("median", "99 %", "largest"), verdicts, strict=True):
        value, judged = found[f"x: pose after, {word}"]
        assert value == pytest.approx(ms) and judged == verdict


def test_processor_time_and_the_share_of_flow_are_told() -> None:
    found = latency_bench_figures(5.0)
    assert found["x: processor, median"][0] == pytest.approx(2.0)
    assert found["x: frame sets that asked for flow"][0] == pytest.approx(25.0)
    assert found["x: estimation alone, 99 %"] == (pytest.approx(5.0), "MISSED")


def test_a_surface_that_is_never_followed_has_no_latency() -> None:
    (only,) = latency_figures("x", np.zeros((0, 1 + len(STAGES))), np.zeros(0))
    assert np.isnan(only.value) and only.note


@pytest.mark.parametrize("power", [0.0, 0.5, 1.0, 2.0])
def test_the_slope_is_the_power_of_the_law(power: float) -> None:
    values = (1.0, 3.0, 10.0, 40.0)
    assert slope(values, 7 * np.array(values) ** power) == pytest.approx(power, abs=1e-9)
    assert slope(values, np.array([7.0, np.nan, 7 * 10.0**power, np.nan])) == pytest.approx(power, abs=1e-9)
    assert np.isnan(slope(values, np.full(4, np.nan)))


def test_each_point_is_told() -> None:
    axis = CostAxis("tracks", "landmarks", "a pose", (10, 20, 40), lambda n: (n, 2 * n))
    costs = np.array([axis.cost(n) for n in axis.values])
    told = growth_figures(axis, costs)
    assert [f.value for f in told[:3]] == [10, 20, 40] and told[3].value == pytest.approx(1.0)


@pytest.mark.slow
def test_a_short_run_measures_every_axis_but_the_rendered_one(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(growth, "WORLD_MINUTES", (0.02, 0.03))
    short = tuple(CostAxis(a.name, a.unit, a.what, a.values[:2], a.cost) for a in axes_for(0.8))
    monkeypatch.setattr(growth, "axes_for", lambda seconds: short)
    found = growth.run_growth(argparse.Namespace(seconds=0.8, no_pictures=True))
    assert len(found) == 4 * 3 and all(f.value > 0 for f in found if "median" in f.what)
    assert not any(f.what.startswith("pixels") for f in found)
