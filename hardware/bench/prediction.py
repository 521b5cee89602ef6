"""Subjects `prediction` and `loop`: where a breathing chest will be, and what knowing it is worth at the nozzle.

`prediction`: error of surface points beside hold, constant velocity and a plain ensemble. Over recorded chests where
there are some, else over the breathing of the simulator's scenarios with the recordings' own noise; targets relative to
hold's error are for the recordings alone. The ensemble is eight autoregressions by recursive least squares (four ranges
of lags, two forgetting factors), hold and constant velocity, for each coordinate alone: increments since each lag are
regressed on the increment ahead, directly for each horizon. The ten are weighted by the exponential of their delayed
squared errors over the last seconds, relative to the best one's.

`loop`: each print is one of a scenario in virtual time: exposure, transport, pairing, the estimator on tracks, the
motion of a live run and the virtual arm, whose nozzle is compared with its true checkpoint every millisecond. Only the
pose that the motion is given differs: the first one for ever, the last one at rest, the last one with its velocity, or
the pose as it is. The first three state no error: only the arm's limits keep them from printing. One more scenario has
a late dispenser: hardware/bench/loop_run.py.
"""

from __future__ import annotations

import argparse
import csv
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from estimation import se3
from estimation.errors import InputError
from estimation.forecast.predictor import Predictor
from estimation.pose import SurfacePose, TrackState, Trajectory
from estimation.se3 import Array
from hardware.bench import figures
from hardware.bench.figures import Figure, Target, at_least, at_most, columns, with_progress, workers
from hardware.bench.loop_run import (
    DELAYS_KNOWN,
    DELAYS_ZERO,
    LATE_DISPENSER,
    BeadsPrint,
    LoopRun,
    bead_figures,
    prepare_scenario,
    print_beads,
)
from hardware.bench.subjects import BREATHING
from hardware.files.folder_tables import read_tum
from hardware.process.clock import CpuClock
from hardware.report.page import Plot, document, legend, line_key, section
from hardware.report.report import HALF_CHART_WIDTH
from hardware.simulator.nozzle_report import ends_chart
from hardware.simulator.scenario import read_scenario
from perception import shipped_file

LONGEST_LAGS = (0.5, 1.0, 2.0, 4.0)  # s
FORGETTING_FACTORS = (0.995, 0.9995)  # a sample
MAX_LAGS = 12
RIDGE = 1.0  # mm^2
ERROR_MEMORY = 50.0  # samples over which errors count
WEIGHT_SHARPNESS = 2.0  # twice the best expert's squared error weighs exp(-2)


def plain_forecasts(values: Array, step: float, ahead: tuple[int, ...]) -> Array:
    """Increments (H, T, C) expected of values (T, C), mm, `step` s apart, over each of H numbers of samples ahead."""
    longest = [max(2, round(lag / step)) for lag in LONGEST_LAGS]
    lags = [sorted({round(x) for x in np.geomspace(1, lag, min(lag, MAX_LAGS))}) for lag in longest]  # in samples
    experts = [_autoregression(values, expert_lags, keep, ahead) for expert_lags in lags for keep in FORGETTING_FACTORS]
    velocity = np.concatenate([np.zeros_like(values[:1]), np.diff(values, axis=0)])
    steady = np.asarray(ahead)[:, None, None] * velocity
    return _weighted(values, np.stack([*experts, np.zeros_like(steady), steady]), ahead)


def _autoregression(values: Array, lags: list[int], keep: float, ahead: tuple[int, ...]) -> Array:
    """Increments (H, T, C) that one autoregression per coordinate expects, trained on what is known at each time."""
    count, width = values.shape
    first, delay = max(lags), max(ahead)
    inputs = np.zeros((count, width, len(lags)))
    for i, lag in enumerate(lags):
        inputs[lag:, :, i] = values[lag:] - values[:-lag]
    gain = np.tile(np.eye(len(lags)) / RIDGE, (width, 1, 1))
    slopes = np.zeros((width, len(lags), len(ahead)))
    increments = np.zeros((len(ahead), count, width))
    for t in range(first, count):
        if t - delay >= first:
            past = t - delay
            x, truth = inputs[past], np.stack([values[past + h] - values[past] for h in ahead], -1)  # (C, L), (C, H)
            innovation_gain = (gain @ x[..., None])[..., 0]
            share = innovation_gain / (keep + (x * innovation_gain).sum(1))[:, None]
            slopes += share[..., None] * (truth - (x[:, None] @ slopes)[:, 0])[:, None]
            gain = (gain - share[..., None] * innovation_gain[:, None]) / keep
        increments[:, t] = (inputs[t][:, None] @ slopes)[:, 0].T
    return increments


def _weighted(values: Array, experts: Array, ahead: tuple[int, ...]) -> Array:
    """Experts' increments (E, H, T, C) combined (H, T, C) by exponential weights of their errors so far."""
    combined = np.zeros(experts.shape[1:])
    for k, h in enumerate(ahead):
        squared_errors = np.zeros((len(experts), values.shape[1]))
        for t in range(values.shape[0]):
            if t >= h:
                squared_errors += (
                    (experts[:, k, t - h] - (values[t] - values[t - h])) ** 2 - squared_errors
                ) / ERROR_MEMORY
            best = squared_errors.min(0)
            weights = np.exp(-WEIGHT_SHARPNESS * (squared_errors - best) / np.maximum(best, 1e-9))
            combined[k, t] = (weights / weights.sum(0) * experts[:, k, t]).sum(0)
    return combined


PREDICTION_HORIZONS = (0.1, 0.2, 0.3, 0.5)  # s
HOLD_SHARES = (0.42, 0.42, 0.44, 0.47)  # of hold's error: targets for recorded chests
SIMULATED = (None,) * 4
ENSEMBLE_TARGET = 0.92  # of the plain ensemble's error
COVERED_TARGET = Target(0.88, 0.92)
TRACE_VARIANCE = 1e-9  # rad^2 and mm^2: stated covariance of the trace's poses
POINT_SPREAD = 60.0  # mm
POINTS_AROUND = POINT_SPREAD * np.concatenate([np.zeros((1, 3)), np.eye(3), -np.eye(3)])  # where there are no markers
CHEST_RATE, CHEST_NOISE = 10.0, 0.1  # Hz, and mm: of the recorded chests


@dataclass(frozen=True, slots=True, eq=False)
class TraceErrors:
    """Errors of each method over one trace, at H times ahead: RMSE, mm, mean over points."""

    name: str
    hold: Array  # (H,)
    steady: Array  # (H,)
    plain: Array  # (H,)
    ours: Array  # (H,)
    covered: Array  # (H,) share of errors within the 90 % radius
    ms: Array  # (T,) time of a step


@dataclass(frozen=True, slots=True, eq=False)
class Chest:
    """One motion."""

    name: str
    observed: Trajectory  # with the noise of observation
    points: Array  # (P, 3) mm, on the surface


def run_prediction(options: argparse.Namespace) -> list[Figure]:
    """All figures over the traces of a folder, or over the simulator's."""
    if options.traces is None:
        if options.seconds < options.warm_up + 2:
            raise InputError("command line", "--seconds", options.seconds, f"at least {options.warm_up + 2:g}")
        chests = [simulated(name, options.seconds) for name in BREATHING]
        return prediction_figures([errors_of(chest, options.warm_up) for chest in chests], SIMULATED)
    files = sorted(options.traces.glob(options.pattern))
    if not files:
        raise InputError(options.traces, "traces", "none", f"at least one {options.pattern}")
    return prediction_figures(
        [errors_of(recorded(file, options.warm_up), options.warm_up) for file in files], HOLD_SHARES
    )


def recorded(file: Path, warm_up: float) -> Chest:
    """A trace as it was recorded, long enough to be judged."""
    trace = read_tum(file, exact=True)
    duration = trace.stamps[-1] - trace.stamps[0]
    if duration < warm_up + 1 + max(PREDICTION_HORIZONS):
        raise InputError(file, "duration", f"{duration:g} s", f"more than {warm_up + 2:g} s")
    return Chest(file.stem, trace, _marker_points(file, trace))


def simulated(name: str, seconds: float) -> Chest:
    """A scenario's motion, observed with the recordings' noise."""
    scenario = read_scenario(shipped_file("scenarios", f"{name}.toml"))
    stamps, rng = np.arange(0.0, seconds, 1 / CHEST_RATE), np.random.default_rng([scenario.seed, 83])
    noise = rng.normal(size=(len(stamps), 6)) * np.repeat([CHEST_NOISE / POINT_SPREAD, CHEST_NOISE], 3)
    poses = scenario.rest @ scenario.motion(stamps) @ se3.exp(noise)
    return Chest(name, Trajectory(stamps, poses, True), POINTS_AROUND)


def errors_of(chest: Chest, warm_up: float) -> TraceErrors:
    """Run every method over one trace, once through."""
    trace, points = chest.observed, chest.points
    step = float(np.median(np.diff(trace.stamps)))
    first = int(np.searchsorted(trace.stamps, trace.stamps[0] + warm_up))
    ahead = tuple(round(a / step) for a in PREDICTION_HORIZONS)
    places = se3.transform_points(trace.base_from_surface, points)  # (T, P, 3)
    flat = places.reshape(len(places), -1)
    plain = places + plain_forecasts(flat, step, ahead).reshape(len(ahead), *places.shape)
    steady = np.concatenate([np.zeros_like(places[:1]), np.diff(places, axis=0)])
    expected, radii, ms = _predicted(trace, points)
    errors = np.zeros((5, len(ahead)))
    for k, h in enumerate(ahead):
        truth, now = places[first + h :], slice(first, len(places) - h)
        guesses = (places[now], places[now] + h * steady[now], plain[k, now], expected[k, now])
        lengths = [np.linalg.norm(truth - guess, axis=-1) for guess in guesses]
        errors[:4, k] = [np.sqrt((length**2).mean(0)).mean() for length in lengths]
        errors[4, k] = (lengths[3] <= radii[k, now]).mean()
    hold, velocity, ensemble, forecast, covered = errors
    return TraceErrors(chest.name, hold, velocity, ensemble, forecast, covered, ms)


def _predicted(trace: Trajectory, points: Array) -> tuple[Array, Array, Array]:
    """Places (H, T, P, 3) and 90 % radii (H, T, P) that our prediction gives, mm, and its time per pose (T,), ms."""
    count, clock, predictor = len(trace.stamps), CpuClock(), Predictor(points)
    twists = np.zeros((count, 6))
    moves = se3.log(se3.inverse(trace.base_from_surface[:-1]) @ trace.base_from_surface[1:])
    twists[1:] = moves / np.diff(trace.stamps)[:, None]
    places = np.zeros((len(PREDICTION_HORIZONS), count, len(points), 3))
    radii = np.zeros(places.shape[:3])
    ms, covariance = np.zeros(count), TRACE_VARIANCE * np.eye(6)
    for i, stamp in enumerate(trace.stamps.tolist()):
        start = clock.now()
        pose = SurfacePose(stamp, trace.base_from_surface[i], covariance, twists[i], TrackState.TRACKING)
        pose = replace(pose, forecast=predictor.add(pose))
        ms[i] = 1000 * (clock.now() - start)
        for k, ahead in enumerate(PREDICTION_HORIZONS):
            later = pose.predict(stamp + ahead)
            places[k, i] = se3.transform_points(later.base_from_surface, points)
            radii[k, i] = later.radius_at(points)
    return places, radii, ms


def _marker_points(file: Path, trace: Trajectory) -> Array:
    """Where the markers beside a trace (NAME_markers.csv) sit on the surface (P, 3), mm; else points about it."""
    marker_file = file.with_name(f"{file.stem}_markers.csv")
    if not marker_file.is_file():
        return POINTS_AROUND
    with marker_file.open(newline="", encoding="utf-8") as stream:
        rows = list(csv.DictReader(stream))
    names = [c.removesuffix("_x_mm") for c in rows[0] if c.endswith("_x_mm")]
    markers = np.array([[[float(row[f"{n}_{a}_mm"]) for a in "xyz"] for n in names] for row in rows])
    if len(markers) != len(trace.stamps):
        raise InputError(marker_file, "rows", len(markers), f"{len(trace.stamps)}, as many as poses")
    inverse = se3.inverse(trace.base_from_surface)
    return np.asarray(se3.transform_points(inverse, markers - markers.mean((0, 1))).mean(0))


def prediction_figures(traces: list[TraceErrors], shares: Sequence[float | None] = HOLD_SHARES) -> list[Figure]:
    """The figures of traces, each method's mean error relative to hold's. shares: targets, if there are any."""
    methods = [np.mean(errors, axis=0).tolist() for errors in columns(traces, "hold", "steady", "plain", "ours")]
    rows = []
    for ahead, share, hold, steady, plain, ours in zip(PREDICTION_HORIZONS, shares, *methods, strict=True):
        references = f"constant velocity {steady / hold:.3f}, plain ensemble {plain / hold:.3f}"
        name, target = f"{1000 * ahead:.0f} ms", None if share is None else at_most(share)
        rows.append(Figure(f"{name}: error by hold's", ours / hold, "", target, references, f"hold {hold:.3f} mm"))
        rows.append(Figure(f"{name}: error by the plain ensemble's", ours / plain, "", at_most(ENSEMBLE_TARGET)))
    for trace in traces:
        for k, ahead in enumerate(PREDICTION_HORIZONS):
            note = f"error by hold's {trace.ours[k] / trace.hold[k]:.3f}"
            name = f"{trace.name}, {1000 * ahead:.0f} ms: inside 90 %"
            rows.append(Figure(name, float(trace.covered[k]), "", COVERED_TARGET, "", note))
    ms = np.concatenate([t.ms for t in traces])
    note = "CPU, learning included"
    rows.append(Figure("time a step: median", figures.percentile(ms, 50), "ms", at_most(0.5), note=note))
    return [*rows, Figure("time a step: p99", figures.percentile(ms, 99), "ms", note="CPU")]


MIN_DRAWN_MM = 0.01  # where the logarithmic axis begins
NOZZLE_ERROR_95, MAX_NOZZLE_ERROR, MIN_DUTY = 0.5, 1.0, 0.8  # mm, mm, share of the time: targets of a live run

PoseChange = Callable[[SurfacePose], SurfacePose]  # what the motion is given in place of a pose


@dataclass(frozen=True, slots=True, eq=False)
class Print:
    """One print."""

    stamps: Array  # (N,) s
    error: Array  # (N,) mm at the nozzle, NaN where nothing leaves it

    def percentile(self, share: float) -> float:
        """Of the error, mm, while extruding."""
        return figures.percentile(self.error[np.isfinite(self.error)], share)

    @property
    def duty(self) -> float:
        """Share of the time from the first material to the last in which it flows."""
        flows = np.flatnonzero(np.isfinite(self.error))
        return len(flows) / (flows[-1] - flows[0] + 1) if len(flows) else 0.0


class StillBed:
    """The surface stays for ever where it was first measured."""

    def __init__(self) -> None:
        self._first: SurfacePose | None = None

    def __call__(self, pose: SurfacePose) -> SurfacePose:
        """The first measured pose, under every stamp."""
        if self._first is None and pose.state.measured:
            self._first = pose
        return replace(at_rest(pose), base_from_surface=(self._first or pose).base_from_surface)


def at_rest(pose: SurfacePose) -> SurfacePose:
    """The surface stays where it was last measured."""
    return replace(steady(pose), twist=np.zeros(6))


def steady(pose: SurfacePose) -> SurfacePose:
    """The surface keeps its velocity."""
    nothing = np.zeros((6, 6))
    return replace(pose, covariance=nothing, twist_covariance=nothing, acceleration_psd=np.zeros(6), forecast=None)


FORECAST_INPUT = "forecast"  # the pose as the estimator reports it
MOTION_INPUTS: dict[str, Callable[[], PoseChange]] = {
    "a bed that stands still": StillBed,
    "where it was last seen": lambda: at_rest,
    "constant velocity": lambda: steady,
    FORECAST_INPUT: lambda: lambda pose: pose,
}


def run_loop(options: argparse.Namespace) -> list[Figure]:
    """Print every scenario in every way; with an output folder, the errors over time as a page."""
    if options.seed < 0:
        raise InputError("command line", "--seed", options.seed, ">= 0")
    figures.require_positive(options, "jobs")
    cases, delays = [(name, way) for name in options.scenario for way in MOTION_INPUTS], (DELAYS_KNOWN, DELAYS_ZERO)
    with workers(options.jobs) as pool:
        prints = pool.map(partial(_print_case, options.seed), *zip(*cases, strict=True))
        by_case = dict(zip(cases, with_progress("loop", "prints", prints, len(cases)), strict=True))
        beads = dict(zip(delays, pool.map(partial(print_beads, options.seed), delays), strict=True))
    figures.write_page(options.out, "loop.html", lambda: loop_page(by_case, beads), "picture")
    return [*(figure for name in options.scenario for figure in _figures(name, by_case)), *bead_figures(beads)]


def _print_case(seed: int, scenario: str, way: str) -> Print:
    prepared = prepare_scenario(shipped_file("scenarios", f"{scenario}.toml"))
    log = LoopRun(prepared, seed, change=MOTION_INPUTS[way]())()
    error = np.linalg.norm((log.base_from_nozzle - log.base_from_target)[:, :3, 3], axis=1)
    return Print(log.stamps, np.where(log.extrude, error, np.nan))


def _figures(scenario: str, prints: dict[tuple[str, str], Print]) -> list[Figure]:
    ours = prints[scenario, FORECAST_INPUT]
    rest = [(way, one) for (name, way), one in prints.items() if name == scenario and way != FORECAST_INPUT]
    others = ", ".join(f"{way} {one.percentile(95):.2f}" for way, one in rest)
    error, note = f"{scenario}: error at the nozzle, 95 %", "the arm holds where the forecast is not sure"
    return [
        Figure(error, ours.percentile(95), "mm", at_most(NOZZLE_ERROR_95), others, "while extruding"),
        Figure(f"{scenario}: largest error", ours.percentile(100), "mm", at_most(MAX_NOZZLE_ERROR)),
        Figure(f"{scenario}: duty", ours.duty, "", at_least(MIN_DUTY), "", note),
    ]


def loop_page(prints: dict[tuple[str, str], Print], beads: Mapping[str, BeadsPrint]) -> str:
    """The error at the nozzle over time, a plot for each way, one scale a scenario; and where beads lie, if any do."""
    body = [_beads_section(beads)] if beads else []
    keys = legend([line_key("estimate", "error while extruding, mm"), line_key("limit", f"{MAX_NOZZLE_ERROR:g} mm")])
    for scenario in dict.fromkeys(name for name, _ in prints):
        ways = {way: one for (name, way), one in prints.items() if name == scenario}
        largest = [one.percentile(100) for one in ways.values() if np.isfinite(one.error).any()]
        top, span = 1.3 * max(MAX_NOZZLE_ERROR, *largest), (0.0, max(float(one.stamps[-1]) for one in ways.values()))
        plots = []
        for way, one in ways.items():
            label = f"{way}: 95 % {one.percentile(95):.2f}, at most {one.percentile(100):.2f} mm"
            plot = Plot(900, 150, span, (MIN_DRAWN_MM, top), log_y=True, label=label)
            plot.level(MAX_NOZZLE_ERROR, "", "limit")
            plot.line(one.stamps, np.maximum(one.error, MIN_DRAWN_MM), "estimate")
            plots.append(plot.svg())
        body.append(section(scenario, "Over time, s; a gap: nothing leaves the nozzle.", keys + "".join(plots)))
    lead = "The same print, by what the motion is told of where the surface will be."
    footer = "Virtual time, the virtual arm; the true error, every millisecond."
    return document("bench", "closed loop", lead, body, footer)


def _beads_section(prints: Mapping[str, BeadsPrint]) -> str:
    """Both prints' beads about where they are to begin and end."""
    charts = [
        f"<div>{ends_chart(ends, f'{way}: about where beads {what}', HALF_CHART_WIDTH)}</div>"
        for way, one in prints.items()
        for what, ends in (("begin", one.material.beginnings), ("end", one.material.ends))
    ]
    late = 1000 * prints[DELAYS_KNOWN].delay
    text = f"Half of the dispenser's flow comes {late:.0f} ms after it is told. Laid of the planned, by mm of the path."
    return section(LATE_DISPENSER, text, f'<div class="two">{"".join(charts)}</div>')
