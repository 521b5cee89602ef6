"""`planner`: random poses into planner and guard, judged tick by tick by an oracle; cost of a step.

Each stream is a print of its own: a random path over a moving surface, whose poses are noisy, late, jumping, invalid or
missing, with a caller that stalls now and then. A stream is cut in two: a second planner resumes from the first one's
progress. Time is virtual; the cost of a step is the thread's own processor time.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Any

import numpy as np

from estimation import se3
from estimation.pose import Forecast, SurfacePose, TrackState
from estimation.se3 import Array
from estimation.surface_map import Warp
from hardware.arm.profile import ArmProfile
from hardware.bench.figures import Figure, at_least, at_most, milliseconds, percentile, with_progress
from hardware.process.clock import CpuClock
from planning.command import Hold, Move
from planning.kinematics import axes_from_nozzle, axis_limits
from planning.motion.curve import curve_through, gridpoints_on
from planning.motion.guard import Guard
from planning.motion.planner import STALL_TICKS, Planner
from planning.motion.retime import Timing, axis_derivatives, retime, run_times
from planning.path import MIN_SPACING, Path, PrintPhase, progress_mark, resume_fraction, way_lengths
from tests.fault_run import AXES_LIMITS, AxesOracle

Draw = np.random.Generator
Tick = tuple[float, SurfacePose | None]  # now, s, and the newest pose

SWING_REST = se3.make(np.eye(3), [202.5, 225.0, 50.0])  # base_from_surface: under the default arm's home
TICK_S = 0.02
FIRST_TICK = 10.0  # s, its instant
MAX_POSE_DELAY = 0.1  # s from a pose's stamp until it is known
SWINGS = ((0.0, 0.0), (5.0, 0.05), (12.0, 0.2), (40.0, 0.6))  # mm and rad of the surface's swing
SWING_RATES = 0.1, 0.3, 0.8  # Hz
POSE_NOISES = 0.0, 0.0, 0.05, 0.3, 10.0  # mm, and a hundredth of it in rad
INVALID_SHARES = 0.0, 0.005, 0.02, 0.3  # of the poses
UNCERTAIN_SHARES = 0.0, 0.01, 0.1  # of poses with a large covariance
FRAME_RATES = 6, 30, 60  # Hz
STALL_SHARE = 0.002  # of ticks before which the caller stalls
JUMP_SIZES = np.array([0.01] * 3 + [5.0] * 3)  # rad and mm of a jump
OUT_OF_REACH = np.array([0.0, 0, 0, 800.0, 0, 0])  # mm
MIN_PRINTING = 0.02  # share of the updates that print, below which a bench of printing has measured nothing
FORECAST_HORIZONS = np.array([0.1, 0.2, 0.3, 0.4, 0.5])  # s


@dataclass(frozen=True, slots=True)
class SwingingSurface:
    """A surface that swings about SWING_REST: height mm along its normal, tilt rad, rate Hz."""

    height: float
    tilt: float
    rate: float

    def at(self, t: Array | float) -> Array:
        """base_from_surface (..., 4, 4) at t (...), s."""
        phase = 2 * np.pi * self.rate * np.asarray(t)
        sine, none = np.sin(phase), np.zeros_like(phase)
        turn = [self.tilt * sine, 0.6 * self.tilt * np.cos(phase), none]
        return np.asarray(SWING_REST @ se3.exp(np.stack([*turn, none, none, self.height * sine], -1)))


STILL, SWUNG = SwingingSurface(0.0, 0.0, 0.25), SwingingSurface(10.0, 0.05, 0.25)
WHOLE_HORIZONS = 200  # of grid points for one timing of a path of some seconds


def random_path(draw: Draw) -> Path:
    """Checkpoints far apart or close together, straight, curved, tilted or turned on the spot; all may be printed."""
    match int(draw.integers(3)):
        case 0:  # scattered
            points = np.asarray(draw.uniform(-8, 8, (int(draw.integers(2, 12)), 3)) * [1, 1, 0.2])
        case 1:  # curved, 0.05 to 0.5 mm apart, as a dense planner gives them
            angle = np.linspace(0, draw.uniform(1, 12), int(draw.integers(40, 400)))
            radius = draw.uniform(2, 15) * (1 - 0.05 * angle)
            height = draw.uniform(-1, 1) * np.sin(angle)
            points = np.stack([radius * np.cos(angle), radius * np.sin(angle), height], -1)
        case _:  # raster
            across = np.arange(-4, 4, draw.uniform(0.3, 2.0))
            points = np.array([[x, y, 0] for i, y in enumerate(across) for x in np.array([-6.0, 6.0]) * (-1) ** i])
    turns = np.cumsum(draw.normal(size=points.shape), axis=0) * draw.choice([0.0, 0.005, 0.05])
    poses = se3.make(se3.exp_rotation(np.clip(turns, -0.3, 0.3)), points)
    poses = poses[np.concatenate([[True], way_lengths(poses) >= 2 * MIN_SPACING])]
    count = len(poses)
    speed, layer = draw.uniform(1.0, draw.choice([5.0, 40.0, 120.0]), count), np.zeros(count, np.int64)
    return Path(poses, speed, np.ones(count, np.int64), np.full(count, 20.0), layer, draw.random(count) < 0.9)


def _ticks(draw: Draw, ticks: int) -> Iterator[Tick]:
    swing = SwingingSurface(*SWINGS[draw.integers(4)], float(draw.choice(SWING_RATES)))
    kinds = POSE_NOISES, INVALID_SHARES, UNCERTAIN_SHARES, FRAME_RATES
    noise, invalid, uncertain, fps = (draw.choice(of_kind) for of_kind in kinds)
    forecast, warped = draw.random() < 0.3, draw.random() < 0.2
    now, last_frame, newest, jump = FIRST_TICK, -1, None, np.eye(4)
    for _ in range(ticks):
        if (frame := int((now - FIRST_TICK) * fps)) > last_frame:
            last_frame = frame
            if draw.random() < invalid / 5:
                jump = jump @ se3.exp(draw.normal(size=6) * JUMP_SIZES)
            pose = _pose(swing, now - draw.uniform(0, MAX_POSE_DELAY), draw, forecast)
            if draw.random() < uncertain:
                pose = replace(pose, covariance=pose.covariance * draw.choice([30.0, 200.0]) ** 2)
            error = jump @ se3.exp(draw.normal(size=6) * noise * np.array([0.01] * 3 + [1.0] * 3))
            pose = replace(pose, base_from_surface=pose.base_from_surface @ error)
            if warped:
                control, shifts = draw.uniform(-8, 8, (6, 3)) * [1, 1, 0], draw.normal(size=(6, 3)) * 0.2
                warp = Warp(control, shifts, 1e-4 * np.eye(18), np.zeros((18, 18)), 8.0, 0.2, 0.01)
                pose = replace(pose, warp=warp)
            newest = _invalid(pose, draw) if draw.random() < invalid else pose
        yield now, newest
        now += TICK_S * (1 if draw.random() > STALL_SHARE else int(draw.integers(4, 60)))


def _pose(swing: SwingingSurface, stamp: float, draw: Draw, with_forecast: bool) -> SurfacePose:
    """The exact pose and twist at `stamp`, s, now and then DEGRADED."""
    pose = _exact_pose(swing, stamp)
    state = TrackState.DEGRADED if draw.random() < 0.1 else TrackState.TRACKING
    forecast = None
    if with_forecast:
        ahead = se3.inverse(pose.base_from_surface) @ swing.at(stamp + FORECAST_HORIZONS)
        increments = se3.log(ahead) * draw.normal(1.0, 0.05)
        covariances = pose.covariance + FORECAST_HORIZONS[:, None, None] * 0.01 * np.eye(6)
        forecast = Forecast(FORECAST_HORIZONS, increments, covariances)
    return replace(pose, state=state, forecast=forecast)


def _exact_pose(swing: SwingingSurface, stamp: float) -> SurfacePose:
    step = 1e-4
    before, here, after = swing.at(stamp + np.array([-step, 0, step]))
    twist = se3.log(se3.inverse(before) @ after) / (2 * step)
    return SurfacePose(stamp, here, np.diag([1e-6] * 3 + [1e-4] * 3), twist, TrackState.TRACKING)


def _invalid(pose: SurfacePose, draw: Draw) -> SurfacePose | None:
    """The pose with one thing wrong: missing, not measured, not finite, too fast, too far, older or newer."""
    place = pose.base_from_surface
    changes: tuple[Callable[[], dict[str, Any]], ...] = (
        lambda: {"state": TrackState.COASTING},
        lambda: {"base_from_surface": np.full((4, 4), np.nan)},
        lambda: {"twist": np.array([0, 0, 0, np.inf, 0, 0])},
        lambda: {"twist": pose.twist + draw.normal(size=6) * [1, 1, 1, 100, 100, 100]},
        lambda: {"covariance": np.full((6, 6), np.nan)},
        lambda: {"stamp": draw.choice([np.nan, -np.inf, 0.0, pose.stamp + 1.0])},
        lambda: {"covariance": -pose.covariance},
        lambda: {"base_from_surface": place @ se3.exp([*draw.normal(size=3), 0, 0, 0])},
        lambda: {"base_from_surface": place @ se3.exp(OUT_OF_REACH)},
    )
    kind = int(draw.integers(len(changes) + 1))
    return replace(pose, **changes[kind - 1]()) if kind else None


STREAM_UPDATES = 500  # of one stream: 10 s
TAKE_OVER_SHARE = 0.6  # of a stream, after which a second planner takes over
START_ABOVE = se3.make(np.eye(3), [0, 0, 2.0])  # mm, of the arm over the surface: low, so that prints begin soon
LONG_PATH = 50_000  # checkpoints
PATH_MOVES = 300
PLAN_TARGETS = at_most(3.0), at_most(8.0)  # ms, median and 99 %


@dataclass
class StreamTally:
    """Counts over all streams."""

    violations: Array = field(default_factory=lambda: np.zeros(len(AXES_LIMITS)))
    max_shares: Array = field(default_factory=lambda: np.zeros(len(AXES_LIMITS)))
    samples: int = 0
    moves: int = 0
    printing: int = 0
    refused: int = 0
    twice: float = 0.0  # mm printed twice
    errors: list[str] = field(default_factory=list)
    seconds: list[float] = field(default_factory=list)  # of each step
    timed: list[bool] = field(default_factory=list)  # whether it timed a horizon


def run_planner(options: argparse.Namespace) -> list[Figure]:
    """Judge the streams, then time the transform of a long path to another pose."""
    tally, profile = StreamTally(), bench_arm()
    streams = -(-options.updates // STREAM_UPDATES)
    for stream in with_progress("planner", "streams", range(streams), streams):
        try:
            follow_stream((options.seed, stream), tally, profile)
        except Exception as error:  # every uncaught error is a finding, whatever it is
            tally.errors.append(f"stream {stream}: {type(error).__name__}: {error}")
    transform, axes = carries(LONG_PATH, PATH_MOVES)
    name, note = f"transform of {LONG_PATH:,} checkpoints", "processor time"
    return [
        *_limits(tally),
        *_costs(tally),
        *pace_figures(profile),
        Figure(f"{name}, 99 %", milliseconds(transform, 99), "ms", at_most(1), "thesis < 1", note),
        Figure(f"{name}, median", milliseconds(transform, 50), "ms"),
        Figure(f"{name}, axes X to C too, 99 %", milliseconds(axes, 99), "ms", note=note),
        Figure(f"{name}, axes X to C too, median", milliseconds(axes, 50), "ms"),
    ]


def bench_arm(profile: ArmProfile | None = None) -> ArmProfile:
    """An arm, the default one or another, that starts START_ABOVE the surface at rest."""
    profile = ArmProfile() if profile is None else profile
    return replace(profile, arm=replace(profile.arm, home=axes_from_nozzle(profile.arm, SWING_REST @ START_ABOVE)))


def follow_stream(seed: tuple[int, int], tally: StreamTally, profile: ArmProfile, ticks: int = STREAM_UPDATES) -> None:
    """One stream through planner and guard."""
    draw, clock = np.random.default_rng(seed), CpuClock()
    path = random_path(draw)
    settings = profile.limits, profile.arm, TICK_S
    planner, guard = Planner(path, *settings), Guard(*settings, path.zone)
    oracle, before, printed = AxesOracle(profile.arm.home, profile.limits, TICK_S), -np.inf, 0.0
    for k, (now, pose) in enumerate(_ticks(draw, ticks)):
        if now - before > STALL_TICKS * TICK_S:
            oracle.rest()
        if k == int(TAKE_OVER_SHARE * ticks):  # by a later run, on an arm that stands where it was left
            arm = replace(profile.arm, home=guard.axes.copy())
            fraction = resume_fraction(path, progress_mark(path, planner.progress))
            planner = Planner(path, profile.limits, arm, TICK_S, start=fraction)
            guard = Guard(profile.limits, arm, TICK_S, path.zone)
            oracle.rest()
        before, place, horizons, start = now, planner.progress.place, planner.horizons, clock.now()
        planned = planner(pose, now)
        tally.seconds.append(clock.now() - start)
        tally.timed.append(planner.horizons > horizons)
        command = guard(planned, pose, now)
        if isinstance(planned, Move) and isinstance(command, Hold):
            tally.refused += 1
            planner.refused(guard.axes)
        oracle(command.axes if isinstance(command, Move) else None)
        if isinstance(command, Move):
            tally.moves += 1
            if command.extrude:
                tally.printing += 1
                tally.twice += max(printed - place, 0.0)
                printed = max(printed, planner.progress.place)
    tally.samples += oracle.samples
    tally.violations = tally.violations + oracle.violations
    tally.max_shares = np.maximum(tally.max_shares, oracle.max_shares)


def _limits(tally: StreamTally) -> list[Figure]:
    none, note = at_most(0), f"of {tally.samples:,} updates, {tally.moves:,} of them moves, {tally.printing:,} printing"
    figures = [Figure("samples over a limit by 0.1 %", float(tally.violations.sum()), "", none, "ruckig #160", note)]
    for kind, over, worst in zip(AXES_LIMITS, tally.violations, tally.max_shares, strict=True):
        figures.append(Figure(f"{kind}: most of its limit", float(worst), "", at_most(1.001), note=f"{int(over)} over"))
    return [
        *figures,
        Figure("uncaught errors", len(tally.errors), "", none, "toppra #150", next(iter(tally.errors), "")),
        Figure("moves that the guard refused", tally.refused, "", none),
        Figure("printed twice", tally.twice, "mm", at_most(1e-6), note="over outages, stalls and a second run"),
        Figure("share of updates that print", tally.printing / max(tally.samples, 1), "", at_least(MIN_PRINTING)),
    ]


def _costs(tally: StreamTally) -> list[Figure]:
    ms, figures = 1000 * np.array(tally.seconds), []
    kinds = ("step that times a horizon", np.array(tally.timed), PLAN_TARGETS), ("any step", ms > 0, (None, None))
    for name, rows, targets in kinds:
        note = f"{rows.sum():,} steps, processor time"
        for word, share, target in zip(("median", "99 %"), (50, 99), targets, strict=True):
            figures.append(Figure(f"{name}, {word}", percentile(ms[rows], share), "ms", target, "", note))
    return figures


def zigzag_with_hops() -> Path:
    """Ways of 0.3 mm at 20 mm/s with a sharp corner every 3 mm or less, and two hops over 2 mm on the way."""
    corners = np.array([[3 * (k // 2 % 2 != k % 2), 1.5 * (k // 2), 0] for k in range(24)], float)
    points, printed = [corners[:1]], [True]
    for number, (start, end) in enumerate(pairwise(corners)):
        ways = start + np.linspace(0, 1, 11)[1:, None] * (end - start)
        hop = np.stack([end + [0, 0, 2], end + [4, 0, 2], end + [4, 0, 0]])
        hops = number % 8 == 7
        points += [ways, hop] if hops else [ways]
        printed += [True] * 10 + [False] * 3 * hops
        corners[number + 1 :] += [4.0 * hops, 0, 0]
    poses, extrude = se3.make(np.eye(3), np.concatenate(points)), np.array(printed)
    count, speed = len(poses), np.where(extrude, 20.0, 40.0)
    return Path(poses, speed, np.ones(count, np.int64), np.full(count, 20.0), np.zeros(count, np.int64), extrude)


def seconds_to_print(path: Path, profile: ArmProfile, swing: SwingingSurface) -> float:
    """From the first checkpoint to the last, by the planner, tick by tick, on exact poses."""
    planner, now, ticks = Planner(path, profile.limits, profile.arm, TICK_S), FIRST_TICK, 0
    while planner.progress.phase is not PrintPhase.LEAVING:
        planner(_exact_pose(swing, now), now)
        ticks, now = ticks + (planner.progress.phase is PrintPhase.PRINTING), now + TICK_S
    return ticks * TICK_S


def seconds_as_a_whole(path: Path, profile: ArmProfile) -> float:
    """By one timing of TOPP-RA for the whole path under the planner's rules, on fine grid points; at rest."""
    curve = curve_through(path.surface_from_nozzle, path.speed[1:], ~path.extrude[1:])
    grid = gridpoints_on(curve, 0.0, curve.length, WHOLE_HORIZONS)
    derivatives = axis_derivatives(profile.arm, _exact_pose(STILL, 0.0), curve, grid, 0.0)
    limits = replace(profile.limits, speed=profile.limits.per_tick(TICK_S))
    timing = retime(grid, derivatives, 0.0, 0.0, axis_limits(profile.arm, limits))
    return timing.end if isinstance(timing, Timing) else float("nan")


def pace_figures(profile: ArmProfile) -> list[Figure]:
    """How long a path of short ways, corners and hops takes: by one timing of the whole, and as it is told before."""
    path = zigzag_with_hops()
    ideal, told = seconds_as_a_whole(path, profile), run_times(path, profile.arm, profile.limits, TICK_S)[-1]
    at_rest, swung = (seconds_to_print(path, profile, swing) for swing in (STILL, SWUNG))
    note = f"{len(path)} checkpoints, {ideal:.2f} s as a whole"
    return [
        Figure("dense path, time by that of one timing, at rest", at_rest / ideal, "", at_most(1.08), "", note),
        Figure("dense path, the same on a swing of 10 mm", swung / ideal, "", at_most(1.15)),
        Figure("dense path, time told before off by", 100 * abs(told / at_rest - 1), "%", at_most(5.0)),
    ]


def carries(checkpoints: int, count: int) -> tuple[Array, Array]:
    """Processor time (count,), s, to carry a path to one random pose after the other: as poses, and as axes too.

    Transforms are (4, 3, N) in memory, their columns, each of which one product of matrices carries (thesis Eq. 5.1 to
    5.7 at once). One for all four was measured to take half as long again, and now and then ten times as long.
    """
    draw, clock = np.random.default_rng(0), CpuClock()
    path = se3.exp(draw.normal(size=(checkpoints, 6)) * [0.2, 0.2, 0.2, 20, 20, 2])
    columns = np.ascontiguousarray(path[:, :3].T)
    moved, machine = np.empty_like(columns), np.empty((6, checkpoints))
    moves = SWING_REST @ se3.exp(draw.normal(size=(count, 6)) * [0.05, 0.05, 0.05, 5, 5, 5])
    transform, axes = np.empty(count), np.empty(count)
    for k, base_from_surface in enumerate(moves):
        start = clock.now()
        np.matmul(base_from_surface[:3, :3], columns, out=moved)
        moved[3] += base_from_surface[:3, 3:]
        transform[k] = clock.now() - start
        x, y, z, machine[:3] = moved
        np.arctan2(y[2], z[2], out=machine[3])
        np.arctan2(-x[2], np.sqrt(x[0] ** 2 + x[1] ** 2), out=machine[4])
        np.arctan2(x[1], x[0], out=machine[5])
        axes[k] = clock.now() - start
    return transform, axes
