"""`stillbed bench planner`: random poses into planner and guard, judged tick by tick by an oracle; what a step costs.

Each stream is a print of its own: a random path over a moving surface, seen through poses that are noisy, late,
jumping, spoilt or missing, by a caller that stalls now and then. A stream is cut in two: a second planner goes on where
the first one's record says. Time is virtual; the cost of a step is the thread's own processor time.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass, field, replace

import numpy as np

from estimation import se3
from estimation.pose import SurfacePose, TrackState
from estimation.se3 import Array
from hardware.arm.profile import ArmProfile
from hardware.bench.axes_judge import KINDS, AxesJudge
from hardware.bench.figures import Figure, at_most
from hardware.bench.random_runs import REST, TICK, random_run
from hardware.files.arm_file import read_arm
from hardware.process.clock import CpuClock, WallClock
from hardware.process.progress import Progress as Bar
from planning.carry import CarriedPath
from planning.command import Hold, Move
from planning.kinematics import SimpleArm, axes_from_nozzle
from planning.motion.guard import Guard
from planning.motion.planner import STALL, Planner
from planning.path import Path
from planning.progress import bookmark, resumed

STREAM = 500  # updates of one stream: 10 s
CUT = 0.6  # of a stream, after which a second planner takes over
ABOVE = se3.make(np.eye(3), [0, 0, 2.0])  # mm: the arm starts so high above the surface, so that prints begin soon
CHECKPOINTS = 50_000
CARRIES = 300
PLAN = at_most(3.0), at_most(8.0)  # ms, median and 99 %


@dataclass
class Tally:
    """What came of the streams. seconds: of each step; timed: whether it timed a horizon; twice: mm printed twice."""

    over: Array = field(default_factory=lambda: np.zeros(len(KINDS)))
    worst: Array = field(default_factory=lambda: np.zeros(len(KINDS)))
    samples: int = 0
    moves: int = 0
    printing: int = 0
    refused: int = 0
    twice: float = 0.0
    errors: list[str] = field(default_factory=list)
    seconds: list[float] = field(default_factory=list)
    timed: list[bool] = field(default_factory=list)


def run(options: argparse.Namespace) -> list[Figure]:
    """Judge the streams, then time the transform of a long path."""
    tally, profile = Tally(), bench_arm(None if options.arm is None else read_arm(options.arm))
    streams = -(-options.updates // STREAM)
    with Bar("planner", "streams", WallClock().now) as bar:
        for stream in range(streams):
            try:
                follow((options.seed, stream), tally, profile)
            except Exception as error:  # every uncaught error is a finding, whatever it is
                tally.errors.append(f"stream {stream}: {type(error).__name__}: {error}")
            bar(stream + 1, streams)
    return [*_limits(tally), *_costs(tally), *carry_figures()]


def bench_arm(profile: ArmProfile | None = None) -> ArmProfile:
    """An arm, the default one or another, that starts ABOVE the surface at rest."""
    profile = ArmProfile() if profile is None else profile
    return replace(profile, arm=replace(profile.arm, home=axes_from_nozzle(profile.arm, REST @ ABOVE)))


def follow(seed: tuple[int, int], tally: Tally, profile: ArmProfile, ticks: int = STREAM) -> None:
    """One stream through planner and guard."""
    path, seen = random_run(seed, ticks)
    clock = CpuClock()
    settings = profile.limits, profile.arm, TICK
    planner, guard = Planner(path, *settings), Guard(*settings, path.zone)
    judge, before, printed = AxesJudge(profile.arm.home, profile.limits, TICK), -np.inf, 0.0
    for k, (now, pose) in enumerate(seen):
        if now - before > STALL * TICK:
            judge.rest()
        if k == int(CUT * ticks):
            planner, guard = _taken_over(path, profile, planner, guard)
            judge.rest()
        before, place, horizons, start = now, planner.progress.place, planner.horizons, clock.now()
        wanted = planner(pose, now)
        tally.seconds.append(clock.now() - start)
        tally.timed.append(planner.horizons > horizons)
        command = guard(wanted, pose, now)
        if isinstance(wanted, Move) and isinstance(command, Hold):
            tally.refused += 1
            planner.refused(guard.axes)
        judge(command.axes if isinstance(command, Move) else None)
        if isinstance(command, Move):
            tally.moves += 1
            if command.extrude:
                tally.printing += 1
                tally.twice += max(printed - place, 0.0)
                printed = max(printed, planner.progress.place)
    tally.samples += judge.samples
    tally.over, tally.worst = tally.over + judge.over, np.maximum(tally.worst, judge.worst)


def _taken_over(path: Path, profile: ArmProfile, planner: Planner, guard: Guard) -> tuple[Planner, Guard]:
    """A planner and a guard of a later run, on an arm that stands where it was left."""
    arm = replace(profile.arm, home=guard.axes.copy())
    start = resumed(path, bookmark(path, planner.progress))
    return Planner(path, profile.limits, arm, TICK, start=start), Guard(profile.limits, arm, TICK, path.zone)


def _limits(tally: Tally) -> list[Figure]:
    none, note = at_most(0), f"of {tally.samples:,} updates, {tally.moves:,} of them moves, {tally.printing:,} printing"
    figures = [Figure("samples over a limit by 0.1 %", float(tally.over.sum()), "", none, "ruckig #160", note)]
    for kind, over, worst in zip(KINDS, tally.over, tally.worst, strict=True):
        figures.append(Figure(f"{kind}: most of its limit", float(worst), "", at_most(1.001), note=f"{int(over)} over"))
    told = tally.errors[0] if tally.errors else ""
    return [
        *figures,
        Figure("uncaught errors", len(tally.errors), "", none, "toppra #150", told),
        Figure("moves that the guard refused", tally.refused, "", none),
        Figure("printed twice", tally.twice, "mm", at_most(1e-6), note="over outages, stalls and a second run"),
        Figure("share of updates that print", tally.printing / max(tally.samples, 1)),
    ]


def _costs(tally: Tally) -> list[Figure]:
    spent, timed = 1000 * np.array(tally.seconds), np.array(tally.timed)
    figures = []
    for name, rows, targets in (("step that times a horizon", timed, PLAN), ("any step", spent > 0, (None, None))):
        of = spent[rows] if rows.any() else np.array([np.nan])
        for word, percentile, target in zip(("median", "99 %"), (50, 99), targets, strict=True):
            note = f"{rows.sum():,} steps, processor time"
            figures.append(Figure(f"{name}, {word}", float(np.percentile(of, percentile)), "ms", target, "", note))
    return figures


def carry_figures() -> list[Figure]:
    """What it costs to carry a long path to another pose."""
    transform, axes = carries(CHECKPOINTS, CARRIES)
    name, note = f"transform of {CHECKPOINTS:,} checkpoints", "processor time"
    return [
        Figure(f"{name}, 99 %", 1000 * float(np.percentile(transform, 99)), "ms", at_most(1), "thesis < 1", note),
        Figure(f"{name}, median", 1000 * float(np.median(transform)), "ms"),
        Figure(f"{name}, axes X to C too, 99 %", 1000 * float(np.percentile(axes, 99)), "ms", note=note),
        Figure(f"{name}, axes X to C too, median", 1000 * float(np.median(axes)), "ms"),
    ]


def carries(checkpoints: int, count: int) -> tuple[Array, Array]:
    """Processor time (count,), s, to carry a path to one random pose after the other: as poses, and as axes too."""
    draw, clock = np.random.default_rng(0), CpuClock()
    carried = CarriedPath(se3.exp(draw.normal(size=(checkpoints, 6)) * [0.2, 0.2, 0.2, 20, 20, 2]), SimpleArm())
    moves = REST @ se3.exp(draw.normal(size=(count, 6)) * [0.05, 0.05, 0.05, 5, 5, 5])
    transform, axes = np.empty(count), np.empty(count)
    for k, base_from_surface in enumerate(moves):
        pose = SurfacePose(float(k), base_from_surface, np.eye(6), np.zeros(6), TrackState.TRACKING)
        start = clock.now()
        carried(pose)
        transform[k] = clock.now() - start
        assert carried.axes.shape == (6, checkpoints)
        axes[k] = clock.now() - start
    return transform, axes
