"""`stillbed bench registration`: a scan laid into the first pictures, its error over the wound, and its verdict."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from estimation import se3
from estimation.pose import SurfacePose, TrackState
from estimation.scan import Scan, scan_from_triangles
from estimation.se3 import Array
from estimation.synthetic.arc_rig import REST, arc_rig
from estimation.synthetic.follow import LEAST
from hardware.bench.figures import Figure, Target, at_most
from hardware.simulator.bodies import Wound, body, with_wound
from hardware.simulator.instant import Instant
from hardware.simulator.look import Look
from hardware.simulator.render import render
from hardware.simulator.scene.scene import Scene, rois
from hardware.simulator.scene.shape import Shape, cylinder, flat
from hardware.simulator.sensor import Sensor
from perception.frames import Frame, FrameSet
from perception.tracking.step import TrackingStep

SCAN_STEP = 1.0  # mm between the vertices of a scan, as handheld scanners give them
SCAN_FROM_SURFACE = se3.make(se3.exp_rotation([0.3, -0.2, 0.6]), [12.0, -7.0, 31.0])  # a scanner has its own frame
RATE, SETS = 30.0, LEAST  # of which the last poses are given out
RISE, TURN, BREATHS = 4.0, 0.03, 0.25  # mm, rad and Hz of the breathing meanwhile
OPEN = {"flat": 3, "cylinder": 2}  # directions that these shapes leave open
REFERENCE = "none"


@dataclass(frozen=True, slots=True)
class Case:
    """One body before the cameras. late: s, each camera's instant after the stamp."""

    name: str
    kind: str
    seed: int
    late: tuple[float, float, float] = (0.0, 0.0, 0.0)


def run(options: argparse.Namespace) -> list[Figure]:
    """Errors over the wound on bodies that hold a scan, verdicts on those that do not."""
    seeds = range(1, options.seeds + 1)
    cases = [Case(f"{kind} {seed}", kind, seed) for kind in ("chest", "forearm", "foot") for seed in seeds]
    cases.append(Case("forearm 1, cameras 10 ms apart", "forearm", 1, (0.0, 0.01, -0.01)))
    held = [figure for case in cases for figure in _errors(case)]
    return held + [_verdict(Case(kind, kind, 1), count) for kind, count in OPEN.items()]


def shape_of(kind: str, seed: int) -> Shape:
    """A body with a wound carved, or, on `flat` and `cylinder`, only painted."""
    if kind == "flat":
        return with_wound(flat((120.0, 90.0)), Wound(), seed)
    return with_wound(cylinder((120.0, 62.0), 50.0), Wound(), seed) if kind == "cylinder" else body(kind, Wound(), seed)


def wound_points(shape: Shape) -> Array:
    """Points (N, 3) mm of the wound, surface frame, one per node."""
    assert shape.inside is not None
    return shape.points(shape.grid(shape.step)[(shape.inside > 0).ravel()])


def breathing(stamp: float) -> Array:
    """base_from_surface (4, 4) at `stamp`, s, in the midst of a breath."""
    phase = 2 * np.pi * BREATHS * (stamp + 0.5)
    up = 0.5 * (1 - np.cos(phase))
    return REST @ se3.exp([TURN * up, 0.5 * TURN * up, 0.0, 0.1 * RISE * up, 0.2 * RISE * up, RISE * up])


def followed(case: Case) -> Iterator[SurfacePose]:
    """Poses of the tracking step, which is told the scan."""
    shape, rig = shape_of(case.kind, case.seed), arc_rig()
    scene, rng = Scene(shape, Look(), seed=case.seed), np.random.default_rng([case.seed, 41])
    step = TrackingStep(rig, rois(scene, rig, breathing(0.0), 0.0), scan=scan_of(shape))
    for stamp in np.arange(SETS) / RATE:
        instants = {late: Instant(stamp, 0.0, breathing(stamp + late), np.zeros(6)) for late in case.late}
        images = render(scene, rig.cameras, [instants[late] for late in case.late], Sensor(), rng.spawn(len(rig)))
        yield step(FrameSet(float(stamp), tuple(Frame(c, float(stamp), i) for c, i in enumerate(images))))
        step.idle()


def scan_of(shape: Shape) -> Scan:
    """What a scanner makes of a shape, in the scanner's own frame."""
    vertices, triangles = shape.mesh(SCAN_STEP)
    return scan_from_triangles(se3.transform_points(SCAN_FROM_SURFACE, vertices), triangles)


def _errors(case: Case) -> list[Figure]:
    points = wound_points(shape_of(case.kind, case.seed))
    off, claimed, sure = np.full(len(points), np.nan), np.nan, 0
    for pose in followed(case):
        if pose.state is TrackState.TRACKING:
            now, true = pose.base_from_surface @ SCAN_FROM_SURFACE, breathing(pose.stamp)
            off = np.linalg.norm(se3.transform_points(now, points) - se3.transform_points(true, points), axis=1)
            error = se3.adjoint(SCAN_FROM_SURFACE) @ se3.log(se3.inverse(now) @ true)
            claimed = float(error @ np.linalg.solve(pose.covariance, error)) / 6
            sure += 1
    note = f"{sure} of {SETS} poses TRACKING"
    return [
        Figure(f"{case.name}: error over the wound, mean", float(off.mean()), "mm", at_most(0.1), REFERENCE, note),
        Figure(f"{case.name}: largest", float(off.max()), "mm", at_most(0.15)),
        Figure(f"{case.name}: squared error, in parts of what is claimed", claimed, "", at_most(3.0)),
    ]


def _verdict(case: Case, count: int) -> Figure:
    last = list(followed(case))[-1]
    named = last.reason.count("slide along") + last.reason.count("turn about")
    never = 0 if last.state is TrackState.TRACKING else named
    return Figure(f"{case.name}: open directions named", never, "", Target(count, count), REFERENCE, last.reason)
