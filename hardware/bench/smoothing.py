"""`stillbed bench smoothing`: smoothed poses beside causal ones, from tracks and from pictures; clocks, Ceres, time."""

from __future__ import annotations

import argparse
import resource
import sys
from dataclasses import dataclass

import numpy as np

from estimation import se3, smooth
from estimation.batch.smoothed import Smoothed
from estimation.se3 import Array
from estimation.smoothing.cameras import REFINED
from estimation.synthetic.follow import follow
from estimation.synthetic.world import World, synthetic_world
from hardware.bench.bundle_adjustment import ceres_figures
from hardware.bench.figures import Figure, Target, at_most
from hardware.bench.smoothing_many import many_figures
from hardware.bench.smoothing_rendered import rendered_figures
from hardware.process.clock import CpuClock
from hardware.report.evaluation import best_constant

CONSISTENT = Target(0.8, 1.25)
NEES_NOTE = "from the first pose on, whose one draw is in all others: many seeds make it sure"
LATE = (0.016, 0.0, -0.016)  # s
MOST_SECONDS, MOST_GIGABYTES, AT_MINUTES = 60.0, 2.0, 10.0


@dataclass(frozen=True, slots=True)
class Pair:
    """One world: mean squared error, mm^2, of smoothed and of causal poses, aligned; NEES/6 of the smoothed ones."""

    smoothed: float
    causal: float
    nees: float


def run(options: argparse.Namespace) -> list[Figure]:
    """All figures."""
    figures: list[Figure] = []
    for movement in options.movements:
        pairs = [_pair(movement, seed, options) for seed in range(options.seeds)]
        found = pair_figures(movement, pairs)
        print(f"{movement}: {found[0].value:.2f} of the causal error", file=sys.stderr, flush=True)
        figures += found
    if options.movements:
        figures += _late_figures(options)
    figures += rendered_figures(options.scenarios, options.rendered)
    if options.adjusted:
        figures += ceres_figures(options.adjusted, options.count)
    if options.sessions:
        figures += many_figures(options.sessions)
    figures += [figure for minutes in options.minutes for figure in _timed(minutes, options.count)]
    return figures + [_timed(1.0, count)[0] for count in options.landmarks]  # less memory than the longest run took


def pair_figures(movement: str, pairs: list[Pair]) -> list[Figure]:
    """The figures of one movement, over all its worlds."""
    ours, causal = (
        1000 * float(np.sqrt(np.mean(v))) for v in zip(*((p.smoothed, p.causal) for p in pairs), strict=True)
    )
    note = f"{ours:.1f} against {causal:.1f} um RMS, aligned"
    return [
        Figure(f"{movement}: error by the causal one's", ours / causal, "", at_most(0.6), "", note),
        Figure(
            f"{movement}: NEES/6", float(np.mean([p.nees for p in pairs])), "", CONSISTENT, "", "from the first pose"
        ),
    ]


def _pair(movement: str, seed: int, options: argparse.Namespace) -> Pair:
    world = synthetic_world(movement, options.seconds, count=options.count, seed=seed)
    result = smooth(world.rig, list(world))
    causal = [pose for pose in follow(world, "seen").poses if pose.state.measured]
    rows = np.searchsorted(world.stamps, [pose.stamp - 1e-6 for pose in causal])
    truth = world.truth.base_from_surface
    poses = result.states.poses
    theirs = np.stack([pose.base_from_surface for pose in causal])
    return Pair(_off(poses[rows], truth[rows]), _off(theirs, truth[rows]), _nees(result, truth))


def _off(poses: Array, truth: Array) -> float:
    """Mean squared distance, mm^2, of the origin after the constant that fits best."""
    constant = best_constant(se3.inverse(truth) @ poses)
    return float(((poses[:, :3, 3] - (truth @ constant)[:, :3, 3]) ** 2).sum(1).mean())


def _nees(result: Smoothed, truth: Array) -> float:
    """NEES / 6 where the first pose is laid upon the truth, as smoothing lays its frame."""
    poses = result.states.poses
    off = se3.log(se3.inverse(poses) @ truth @ se3.inverse(truth[0]) @ poses[0])[1:]
    return float(np.einsum("ni,nij,nj->n", off, np.linalg.inv(result.covariance[1:, :6, :6]), off).mean() / 6)


def _late_figures(options: argparse.Namespace) -> list[Figure]:
    """With late cameras and an imperfect calibration, which the recording corrects."""
    errors, offsets = [], []
    for seed in range(options.seeds):
        world = synthetic_world(
            "lively", options.seconds, count=options.count, seed=seed, offsets=LATE, calibration=0.3
        )
        result = smooth(world.rig, list(world), prior=REFINED)
        errors.append(_off(result.states.poses, world.truth.base_from_surface))
        offsets.append(result.offsets - np.array(LATE))
    name = "lively, cameras 16 ms apart, calibrated to 0.3 px"
    return [
        Figure(f"{name}: error", float(np.sqrt(np.mean(errors))), "mm", at_most(0.05), "", "RMS, aligned"),
        Figure(f"{name}: offsets off by", 1000 * float(np.sqrt(np.mean(np.square(offsets)))), "ms"),
    ]


def _timed(minutes: float, count: int) -> list[Figure]:
    world: World = synthetic_world("breathing", 60 * minutes, count=count)
    seen = list(world)
    clock = CpuClock()
    start = clock.now()
    smooth(world.rig, seen)
    spent = clock.now() - start
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
    asked = minutes == AT_MINUTES
    name = f"{minutes:g} min, {len(world)} poses, {count} landmarks"
    return [
        Figure(f"{name}: time", spent, "s", at_most(MOST_SECONDS) if asked else None, "", "of one core"),
        Figure(f"{name}: memory", peak, "GB", at_most(MOST_GIGABYTES) if asked else None, "", "peak, tracks included"),
    ]
