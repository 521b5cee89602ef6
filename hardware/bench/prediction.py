"""Prediction of breathing: error of surface points beside hold, constant velocity and a plain ensemble.

Over recorded chests where there are some, else over the breathing of the simulator's scenarios, seen with the
recordings' own noise; what is asked as a part of hold's error is asked of the recordings alone.
"""

from __future__ import annotations

import argparse
import csv
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from estimation import se3
from estimation.errors import InputError
from estimation.forecast.predictor import Predictor
from estimation.pose import SurfacePose, TrackState
from estimation.se3 import Array
from estimation.trajectory import Trajectory
from hardware.bench.figures import Figure, Target, at_most
from hardware.bench.options import BREATHING
from hardware.bench.plain_ensemble import plain_forecasts
from hardware.process.clock import CpuClock
from hardware.simulator.scenario_file import read_scenario
from hardware.tum import read_tum
from perception.package_data import shipped_file

AHEAD = (0.1, 0.2, 0.3, 0.5)  # s
SHARES = (0.42, 0.42, 0.44, 0.47)  # of hold's error, asked for on recorded chests
SIMULATED = (None,) * 4
PLAIN = 0.92  # of the plain ensemble's error, asked for
COVERED = Target(0.88, 0.92)
LEAST = 1e-9  # rad^2 and mm^2: what the trace's own pose is claimed to be known to
SPREAD = 60.0  # mm
AROUND = SPREAD * np.concatenate([np.zeros((1, 3)), np.eye(3), -np.eye(3)])  # where no markers are told
RATE, NOISE = 10.0, 0.1  # Hz, and mm: of the recorded chests


@dataclass(frozen=True, slots=True, eq=False)
class Errors:
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


def run(options: argparse.Namespace) -> list[Figure]:
    """All figures over the traces of a folder, or over the simulator's."""
    if options.traces is None:
        if options.seconds < options.warm_up + 2:
            raise InputError("command line", "--seconds", options.seconds, f"at least {options.warm_up + 2:g}")
        chests = [simulated(name, options.seconds) for name in BREATHING]
        return figures([errors_of(chest, options.warm_up) for chest in chests], SIMULATED)
    files = sorted(options.traces.glob(options.pattern))
    if not files:
        raise InputError(options.traces, "traces", "none", f"at least one {options.pattern}")
    return figures([errors_of(recorded(file, options.warm_up), options.warm_up) for file in files], SHARES)


def recorded(file: Path, warm_up: float) -> Chest:
    """A trace as it was recorded, long enough to be judged."""
    trace = read_tum(file, exact=True)
    if trace.stamps[-1] - trace.stamps[0] < warm_up + 1 + max(AHEAD):
        raise InputError(file, "duration", f"{trace.stamps[-1] - trace.stamps[0]:g} s", f"more than {warm_up + 2:g} s")
    return Chest(file.stem, trace, marker_points(file, trace))


def simulated(name: str, seconds: float) -> Chest:
    """A scenario's motion, as a camera would tell it that trembles by the recordings' noise."""
    scenario = read_scenario(shipped_file("scenarios", f"{name}.toml"))
    stamps, rng = np.arange(0.0, seconds, 1 / RATE), np.random.default_rng([scenario.seed, 83])
    noise = rng.normal(size=(len(stamps), 6)) * np.repeat([NOISE / SPREAD, NOISE], 3)
    poses = scenario.rest @ scenario.motion(stamps) @ se3.exp(noise)
    return Chest(name, Trajectory(stamps, poses, True), AROUND)


def errors_of(chest: Chest, warm_up: float) -> Errors:
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
    return Errors(chest.name, hold, steadily, simply, ours, covered, ms)


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
        pose = SurfacePose(stamp, trace.base_from_surface[i], LEAST * np.eye(6), twists[i], TrackState.TRACKING)
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
        return AROUND
    with beside.open(newline="", encoding="utf-8") as stream:
        rows = list(csv.DictReader(stream))
    names = [c.removesuffix("_x_mm") for c in rows[0] if c.endswith("_x_mm")]
    markers = np.array([[[float(row[f"{n}_{a}_mm"]) for a in "xyz"] for n in names] for row in rows])
    if len(markers) != len(trace.stamps):
        raise InputError(beside, "rows", len(markers), f"{len(trace.stamps)}, as many as poses")
    placed = markers - markers.mean((0, 1))
    inverse = se3.inverse(trace.base_from_surface)
    return np.asarray(se3.transform_points(inverse, placed).mean(0))


def figures(traces: list[Errors], shares: Sequence[float | None] = SHARES) -> list[Figure]:
    """The figures of traces, each method's mean error as a part of hold's. shares: what is asked, if anything."""
    mean = {name: np.mean([getattr(t, name) for t in traces], axis=0) for name in ("hold", "steady", "plain", "ours")}
    out = []
    for k, (ahead, asked) in enumerate(zip(AHEAD, shares, strict=True)):
        hold, steady, plain, ours = (float(mean[n][k]) for n in ("hold", "steady", "plain", "ours"))
        beside = f"constant velocity {steady / hold:.3f}, plain ensemble {plain / hold:.3f}"
        name = f"{1000 * ahead:.0f} ms"
        out.append(
            Figure(
                f"{name}: error by hold's",
                ours / hold,
                "",
                None if asked is None else at_most(asked),
                beside,
                f"hold {hold:.3f} mm",
            )
        )
        out.append(Figure(f"{name}: error by the plain ensemble's", ours / plain, "", at_most(PLAIN)))
    for trace in traces:
        for k, ahead in enumerate(AHEAD):
            share = f"error by hold's {trace.ours[k] / trace.hold[k]:.3f}"
            name = f"{trace.name}, {1000 * ahead:.0f} ms: inside 90 %"
            out.append(Figure(name, float(trace.covered[k]), "", COVERED, "", share))
    median, late = np.percentile(np.concatenate([t.ms for t in traces]), [50, 99])
    out.append(Figure("time a step: median", float(median), "ms", at_most(0.5), "", "CPU, learning included"))
    out.append(Figure("time a step: p99", float(late), "ms", None, "", "CPU"))
    return out
