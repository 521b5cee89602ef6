"""Subjects `prediction` and `loop`: where a breathing chest will be, and what knowing it is worth at the nozzle.

`prediction`: error of surface points beside hold, constant velocity and a plain ensemble. Over recorded chests where
there are some, else over the breathing of the simulator's scenarios, seen with the recordings' own noise; what is
asked as a part of hold's error is asked of the recordings alone. The ensemble is eight autoregressions by recursive
least squares (four reaches of the lags, two forgetting factors), hold and constant velocity, each coordinate by itself:
increments since each lag are regressed on the increment ahead, directly for each horizon. The ten are weighted by the
exponential of their delayed squared errors over the last seconds, relative to the best one's.

`loop`: each print is one of a scenario in virtual time: exposure, way, pairing, the estimator on tracks, the motion of
a live run and the virtual arm, whose nozzle is compared with its true checkpoint every millisecond. What differs is
only what the motion is told of the surface: where it was at the first pose (a bed that stands still), where it was last
seen, that and its velocity, or the pose as it is. The first three claim to know it exactly: nothing but what they ask
of the arm keeps them from printing.
"""

from __future__ import annotations

import argparse
import csv
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from estimation import se3
from estimation.errors import InputError
from estimation.forecast.predictor import Predictor
from estimation.pose import SurfacePose, TrackState, Trajectory
from estimation.se3 import Array
from hardware.bench.fault_run import FaultRun, PreparedScenario, prepare_scenario
from hardware.bench.figures import (
    Figure,
    Target,
    at_least,
    at_most,
    percentile,
    require_positive,
    with_progress,
    workers,
    write_page,
)
from hardware.bench.subjects import BREATHING
from hardware.files.folder_tables import read_tum
from hardware.process.clock import CpuClock
from hardware.report.page import Plot, document, legend, line_key, section
from hardware.simulator.scenario import read_scenario
from perception.frames import FrameSet
from perception.package_data import shipped_file

LAG_REACHES = (0.5, 1.0, 2.0, 4.0)  # s
FORGETTING_FACTORS = (0.995, 0.9995)  # a sample
MAX_LAGS = 12
RIDGE = 1.0  # mm^2
ERROR_MEMORY, WEIGHT_SHARPNESS = (
    50.0,
    2.0,
)  # samples over which errors count; 2 times the best one's error weighs exp(-2)


def plain_forecasts(values: Array, step: float, ahead: tuple[int, ...]) -> Array:
    """Increments (H, T, C) expected of values (T, C), mm, `step` s apart, over each of H numbers of samples ahead."""
    experts = [autoregression(values, lags, keep, ahead) for lags in _lags(step) for keep in FORGETTING_FACTORS]
    velocity = np.concatenate([np.zeros_like(values[:1]), np.diff(values, axis=0)])
    steady = np.asarray(ahead)[:, None, None] * velocity
    return weighted(values, np.stack([*experts, np.zeros_like(steady), steady]), ahead)


def _lags(step: float) -> list[list[int]]:
    """Four sets of lags in samples: every one up to half a second, sparser from there."""
    reaches = [max(2, round(reach / step)) for reach in LAG_REACHES]
    return [sorted({round(x) for x in np.geomspace(1, reach, min(reach, MAX_LAGS))}) for reach in reaches]


def autoregression(values: Array, lags: list[int], keep: float, ahead: tuple[int, ...]) -> Array:
    """Increments (H, T, C) that one autoregression per coordinate expects, trained on what is known at each time."""
    count, width = values.shape
    first, delay = max(lags), max(ahead)
    inputs = np.zeros((count, width, len(lags)))
    for i, lag in enumerate(lags):
        inputs[lag:, :, i] = values[lag:] - values[:-lag]
    gain = np.tile(np.eye(len(lags)) / RIDGE, (width, 1, 1))
    slopes = np.zeros((width, len(lags), len(ahead)))
    out = np.zeros((len(ahead), count, width))
    for t in range(first, count):
        if t - delay >= first:
            then = t - delay
            x, truth = inputs[then], np.stack([values[then + h] - values[then] for h in ahead], -1)  # (C, L), (C, H)
            pull = (gain @ x[..., None])[..., 0]
            share = pull / (keep + (x * pull).sum(1))[:, None]
            slopes += share[..., None] * (truth - (x[:, None] @ slopes)[:, 0])[:, None]
            gain = (gain - share[..., None] * pull[:, None]) / keep
        out[:, t] = (inputs[t][:, None] @ slopes)[:, 0].T
    return out


def weighted(values: Array, experts: Array, ahead: tuple[int, ...]) -> Array:
    """Experts' increments (E, H, T, C) combined (H, T, C) by exponential weights of their errors so far."""
    out = np.zeros(experts.shape[1:])
    for k, h in enumerate(ahead):
        square = np.zeros((len(experts), values.shape[1]))
        for t in range(values.shape[0]):
            if t >= h:
                square += ((experts[:, k, t - h] - (values[t] - values[t - h])) ** 2 - square) / ERROR_MEMORY
            best = square.min(0)
            weights = np.exp(-WEIGHT_SHARPNESS * (square - best) / np.maximum(best, 1e-9))
            out[k, t] = (weights / weights.sum(0) * experts[:, k, t]).sum(0)
    return out


AHEAD = (0.1, 0.2, 0.3, 0.5)  # s
HOLD_SHARES = (0.42, 0.42, 0.44, 0.47)  # of hold's error, asked for on recorded chests
SIMULATED = (None,) * 4
ENSEMBLE_TARGET = 0.92  # of the plain ensemble's error, asked for
COVERED_TARGET = Target(0.88, 0.92)
TRACE_VARIANCE = 1e-9  # rad^2 and mm^2: what the trace's own pose is claimed to be known to
POINT_SPREAD = 60.0  # mm
POINTS_AROUND = POINT_SPREAD * np.concatenate([np.zeros((1, 3)), np.eye(3), -np.eye(3)])  # where no markers are told
CHEST_RATE, CHEST_NOISE = 10.0, 0.1  # Hz, and mm: of the recorded chests


@dataclass(frozen=True, slots=True, eq=False)
class TraceErrors:
    """What one trace came to. hold, steady, plain, ours: (H,) RMSE, mm, mean over points. covered: (H,). ms: (T,)."""

    name: str
    hold: Array
    steady: Array
    plain: Array
    ours: Array
    covered: Array
    ms: Array


@dataclass(frozen=True, slots=True, eq=False)
class Chest:
    """One motion. seen: poses as they are told, of points (P, 3) mm on the surface."""

    name: str
    seen: Trajectory
    points: Array


def run_prediction(options: argparse.Namespace) -> list[Figure]:
    """All figures over the traces of a folder, or over the simulator's."""
    if options.traces is None:
        if options.seconds < options.warm_up + 2:
            raise InputError("command line", "--seconds", options.seconds, f"at least {options.warm_up + 2:g}")
        chests = [simulated(name, options.seconds) for name in BREATHING]
        return figures([errors_of(chest, options.warm_up) for chest in chests], SIMULATED)
    files = sorted(options.traces.glob(options.pattern))
    if not files:
        raise InputError(options.traces, "traces", "none", f"at least one {options.pattern}")
    return figures([errors_of(recorded(file, options.warm_up), options.warm_up) for file in files], HOLD_SHARES)


def recorded(file: Path, warm_up: float) -> Chest:
    """A trace as it was recorded, long enough to be judged."""
    trace = read_tum(file, exact=True)
    if trace.stamps[-1] - trace.stamps[0] < warm_up + 1 + max(AHEAD):
        raise InputError(file, "duration", f"{trace.stamps[-1] - trace.stamps[0]:g} s", f"more than {warm_up + 2:g} s")
    return Chest(file.stem, trace, marker_points(file, trace))


def simulated(name: str, seconds: float) -> Chest:
    """A scenario's motion, as a camera would tell it that trembles by the recordings' noise."""
    scenario = read_scenario(shipped_file("scenarios", f"{name}.toml"))
    stamps, rng = np.arange(0.0, seconds, 1 / CHEST_RATE), np.random.default_rng([scenario.seed, 83])
    noise = rng.normal(size=(len(stamps), 6)) * np.repeat([CHEST_NOISE / POINT_SPREAD, CHEST_NOISE], 3)
    poses = scenario.rest @ scenario.motion(stamps) @ se3.exp(noise)
    return Chest(name, Trajectory(stamps, poses, True), POINTS_AROUND)


def errors_of(chest: Chest, warm_up: float) -> TraceErrors:
    """Run every method over one trace, once through."""
    trace, points = chest.seen, chest.points
    step = float(np.median(np.diff(trace.stamps)))
    first, ahead = int(np.searchsorted(trace.stamps, trace.stamps[0] + warm_up)), tuple(round(a / step) for a in AHEAD)
    places = se3.transform_points(trace.base_from_surface, points)  # (T, P, 3)
    flat = places.reshape(len(places), -1)
    plain = places + plain_forecasts(flat, step, ahead).reshape(len(ahead), *places.shape)
    steady = np.concatenate([np.zeros_like(places[:1]), np.diff(places, axis=0)])
    expected, radii, ms = followed(trace, points)
    out = np.zeros((5, len(ahead)))
    for k, h in enumerate(ahead):
        truth, now = places[first + h :], slice(first, len(places) - h)
        guesses = (places[now], places[now] + h * steady[now], plain[k, now], expected[k, now])
        lengths = [np.linalg.norm(truth - guess, axis=-1) for guess in guesses]
        out[:4, k] = [np.sqrt((length**2).mean(0)).mean() for length in lengths]
        out[4, k] = (lengths[3] <= radii[k, now]).mean()
    hold, steadily, simply, ours, covered = out
    return TraceErrors(chest.name, hold, steadily, simply, ours, covered, ms)


def followed(trace: Trajectory, points: Array) -> tuple[Array, Array, Array]:
    """Places (H, T, P, 3) and 90 % radii (H, T, P) that our prediction gives, mm, and its time per pose (T,), ms."""
    count, clock, predictor = len(trace.stamps), CpuClock(), Predictor(points)
    twists = np.zeros((count, 6))
    moves = se3.log(se3.inverse(trace.base_from_surface[:-1]) @ trace.base_from_surface[1:])
    twists[1:] = moves / np.diff(trace.stamps)[:, None]
    places, radii = np.zeros((len(AHEAD), count, len(points), 3)), np.zeros((len(AHEAD), count, len(points)))
    ms = np.zeros(count)
    for i, stamp in enumerate(trace.stamps.tolist()):
        begun = clock.now()
        pose = SurfacePose(
            stamp, trace.base_from_surface[i], TRACE_VARIANCE * np.eye(6), twists[i], TrackState.TRACKING
        )
        pose = replace(pose, forecast=predictor.add(pose))
        ms[i] = 1000 * (clock.now() - begun)
        for k, ahead in enumerate(AHEAD):
            later = pose.predict(stamp + ahead)
            places[k, i] = se3.transform_points(later.base_from_surface, points)
            radii[k, i] = later.radius_at(points)
    return places, radii, ms


def marker_points(file: Path, trace: Trajectory) -> Array:
    """Where the markers beside a trace (NAME_markers.csv) sit on the surface (P, 3), mm; else points about it."""
    beside = file.with_name(f"{file.stem}_markers.csv")
    if not beside.is_file():
        return POINTS_AROUND
    with beside.open(newline="", encoding="utf-8") as stream:
        rows = list(csv.DictReader(stream))
    names = [c.removesuffix("_x_mm") for c in rows[0] if c.endswith("_x_mm")]
    markers = np.array([[[float(row[f"{n}_{a}_mm"]) for a in "xyz"] for n in names] for row in rows])
    if len(markers) != len(trace.stamps):
        raise InputError(beside, "rows", len(markers), f"{len(trace.stamps)}, as many as poses")
    placed = markers - markers.mean((0, 1))
    inverse = se3.inverse(trace.base_from_surface)
    return np.asarray(se3.transform_points(inverse, placed).mean(0))


def figures(traces: list[TraceErrors], shares: Sequence[float | None] = HOLD_SHARES) -> list[Figure]:
    """The figures of traces, each method's mean error as a part of hold's. shares: what is asked, if anything."""
    mean = {name: np.mean([getattr(t, name) for t in traces], axis=0) for name in ("hold", "steady", "plain", "ours")}
    out = []
    for k, (ahead, asked) in enumerate(zip(AHEAD, shares, strict=True)):
        hold, steady, plain, ours = (float(mean[n][k]) for n in ("hold", "steady", "plain", "ours"))
        beside = f"constant velocity {steady / hold:.3f}, plain ensemble {plain / hold:.3f}"
        name = f"{1000 * ahead:.0f} ms"
        target = None if asked is None else at_most(asked)
        out.append(Figure(f"{name}: error by hold's", ours / hold, "", target, beside, f"hold {hold:.3f} mm"))
        out.append(Figure(f"{name}: error by the plain ensemble's", ours / plain, "", at_most(ENSEMBLE_TARGET)))
    for trace in traces:
        for k, ahead in enumerate(AHEAD):
            share = f"error by hold's {trace.ours[k] / trace.hold[k]:.3f}"
            name = f"{trace.name}, {1000 * ahead:.0f} ms: inside 90 %"
            out.append(Figure(name, float(trace.covered[k]), "", COVERED_TARGET, "", share))
    ms = np.concatenate([t.ms for t in traces])
    out.append(Figure("time a step: median", percentile(ms, 50), "ms", at_most(0.5), "", "CPU, learning included"))
    out.append(Figure("time a step: p99", percentile(ms, 99), "ms", None, "", "CPU"))
    return out


MIN_DRAWN_MM = 0.01  # mm, where the logarithmic axis begins
NOZZLE_ERROR_95, MAX_NOZZLE_ERROR, MIN_DUTY = 0.5, 1.0, 0.8  # mm, mm, part of the time: asked of a live run

Told = Callable[[SurfacePose], SurfacePose]  # what the motion is told in the place of a pose


@dataclass(frozen=True, slots=True, eq=False)
class Print:
    """One print. stamps: (N,) s. error: (N,) mm at the nozzle, NaN where nothing leaves it."""

    stamps: Array
    error: Array

    @property
    def p95(self) -> float:
        """mm, while extruding."""
        return percentile(self.error[np.isfinite(self.error)], 95)

    @property
    def largest(self) -> float:
        """mm, while extruding."""
        return percentile(self.error[np.isfinite(self.error)], 100)

    @property
    def duty(self) -> float:
        """Part of the time from the first material to the last in which it flows."""
        flows = np.flatnonzero(np.isfinite(self.error))
        return len(flows) / (flows[-1] - flows[0] + 1) if len(flows) else 0.0


class StillBed:
    """The surface is said to be where it was first seen, for ever."""

    def __init__(self) -> None:
        self._first: SurfacePose | None = None

    def __call__(self, pose: SurfacePose) -> SurfacePose:
        """The first measured pose, under every stamp."""
        if self._first is None and pose.state.measured:
            self._first = pose
        where = pose if self._first is None else self._first
        return replace(last_seen(pose), base_from_surface=where.base_from_surface)


def last_seen(pose: SurfacePose) -> SurfacePose:
    """The surface is said to stay where it was seen."""
    return replace(steady(pose), twist=np.zeros(6))


def steady(pose: SurfacePose) -> SurfacePose:
    """The surface is said to keep its velocity."""
    nothing = np.zeros((6, 6))
    return replace(pose, covariance=nothing, twist_covariance=nothing, acceleration_psd=np.zeros(6), forecast=None)


def as_it_is(pose: SurfacePose) -> SurfacePose:
    """What the estimator says, forecast and claim included."""
    return pose


MOTION_INPUTS: dict[str, Callable[[], Told]] = {
    "a bed that stands still": StillBed,
    "where it was last seen": lambda: last_seen,
    "constant velocity": lambda: steady,
    "forecast": lambda: as_it_is,
}
FORECAST_INPUT = "forecast"


class LoopRun(FaultRun):
    """A print in which nothing goes wrong, and the motion is told something else than the pose."""

    def __init__(self, on: PreparedScenario, told: Told, seed: int) -> None:
        super().__init__(on, (), seed)
        self._told = told

    def _know(self, pose: SurfacePose, frames: FrameSet, seen: object) -> None:
        super()._know(self._told(pose), frames, seen)


def run_loop(options: argparse.Namespace) -> list[Figure]:
    """Print every scenario in every way; with an output folder, the errors over time as a page."""
    if options.seed < 0:
        raise InputError("command line", "--seed", options.seed, ">= 0")
    require_positive(options, "jobs")
    asked = [(name, way) for name in options.scenario for way in MOTION_INPUTS]
    with workers(options.jobs) as pool:
        prints = pool.map(partial(_print_case, options.seed), *zip(*asked, strict=True))
        done = list(with_progress("loop", "prints", prints, len(asked)))
    by_case = dict(zip(asked, done, strict=True))
    write_page(options.out, "loop.html", lambda: loop_page(by_case), "picture")
    return [figure for name in options.scenario for figure in _figures(name, by_case)]


def _print_case(seed: int, scenario: str, way: str) -> Print:
    prepared = prepare_scenario(shipped_file("scenarios", f"{scenario}.toml"))
    log = LoopRun(prepared, MOTION_INPUTS[way](), seed)().log
    assert log is not None
    error = np.linalg.norm((log.base_from_nozzle - log.base_from_target)[:, :3, 3], axis=1)
    return Print(log.stamps, np.where(log.extrude, error, np.nan))


def _figures(scenario: str, prints: dict[tuple[str, str], Print]) -> list[Figure]:
    ours = prints[scenario, FORECAST_INPUT]
    rest = [(way, one) for (name, way), one in prints.items() if name == scenario and way != FORECAST_INPUT]
    others = ", ".join(f"{way} {one.p95:.2f}" for way, one in rest)
    return [
        Figure(
            f"{scenario}: error at the nozzle, 95 %",
            ours.p95,
            "mm",
            at_most(NOZZLE_ERROR_95),
            others,
            "while extruding",
        ),
        Figure(f"{scenario}: largest error", ours.largest, "mm", at_most(MAX_NOZZLE_ERROR)),
        Figure(
            f"{scenario}: duty", ours.duty, "", at_least(MIN_DUTY), "", "the arm holds where the forecast is not sure"
        ),
    ]


def loop_page(prints: dict[tuple[str, str], Print]) -> str:
    """The error at the nozzle over time, a plot for each way, one scale for all of a scenario."""
    body = [_one(name, prints) for name in dict.fromkeys(name for name, _ in prints)]
    lead = "The same print, by what the motion is told of where the surface will be."
    footer = "Virtual time, the virtual arm; the true error, every millisecond."
    return document("bench", "closed loop", lead, body, footer)


def _one(scenario: str, prints: dict[tuple[str, str], Print]) -> str:
    ways = {way: one for (name, way), one in prints.items() if name == scenario}
    top = 1.3 * max(MAX_NOZZLE_ERROR, *(one.largest for one in ways.values() if np.isfinite(one.error).any()))
    span = 0.0, max(float(one.stamps[-1]) for one in ways.values())
    plots = []
    for way, one in ways.items():
        label = f"{way}: 95 % {one.p95:.2f}, at most {one.largest:.2f} mm"
        plot = Plot(900, 150, span, (MIN_DRAWN_MM, top), log_y=True, label=label)
        plot.level(MAX_NOZZLE_ERROR, "", "limit")
        plot.line(one.stamps, np.maximum(one.error, MIN_DRAWN_MM), "estimate")
        plots.append(plot.svg())
    keys = legend([line_key("estimate", "error while extruding, mm"), line_key("limit", f"{MAX_NOZZLE_ERROR:g} mm")])
    return section(scenario, "Over time, s; a gap: nothing leaves the nozzle.", keys + "".join(plots))
