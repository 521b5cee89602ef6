"""`stillbed bench bumps`: cameras bumped by little and lenses turned by little before a breathing surface; and neither.

Tracks are drawn, not rendered: an hour of them passes in minutes. What bumps do in pictures, `bench outages` shows.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from estimation import se3
from estimation.online.estimator import Estimator
from estimation.pose import TrackState
from estimation.rig import Rig
from estimation.se3 import Array
from estimation.surface_map import SurfaceMap
from estimation.synthetic.arc_rig import REST, arc_rig
from estimation.synthetic.look import observations
from estimation.synthetic.motions import Motion
from estimation.synthetic.movements import irregular
from estimation.synthetic.surfaces import patch
from hardware.bench.figures import Figure, at_least, at_most
from hardware.process.clock import WallClock
from hardware.process.progress import Progress

RATE = 30.0  # Hz
CALM, WATCHED = 6.0, 4.0  # s before a bump, and after it
NOISE = 0.3  # px
LANDMARKS = 60
REFERENCE = "none"


@dataclass(frozen=True, slots=True)
class Knock:
    """One kind of knock. shift: mm, turn: degrees, in a direction drawn across the view; scale: of the focal length."""

    name: str
    shift: float = 0.0
    turn: float = 0.0
    scale: float = 1.0
    wanted: bool = True

    def struck(self, rig: Rig, camera: int, rng: np.random.Generator) -> Rig:
        """The rig with one camera knocked."""
        own, angle = rig.cameras[camera], rng.uniform(0, 2 * np.pi)
        across = np.array([np.cos(angle), np.sin(angle), 0.0])
        moved = own.base_from_camera @ se3.exp(np.concatenate([across * np.deg2rad(self.turn), across * self.shift]))
        matrix = own.matrix * np.array([[self.scale, 1, 1], [1, self.scale, 1], [1, 1, 1]])
        cameras = list(rig.cameras)
        cameras[camera] = replace(own, base_from_camera=moved, matrix=matrix)
        return Rig(tuple(cameras))


KNOCKS = (
    Knock("0.25 mm", shift=0.25, wanted=False),
    Knock("0.5 mm", shift=0.5),
    Knock("1 mm", shift=1.0),
    Knock("2 mm", shift=2.0),
    Knock("0.2 degrees", turn=0.2),
    Knock("lens 0.5 %", scale=1.005, wanted=False),
    Knock("lens 1 %", scale=1.01),
    Knock("lens -1 %", scale=0.99),
)


def run(options: argparse.Namespace) -> list[Figure]:
    """Knocks found, named and how soon; and false alarms of a calm run."""
    figures: list[Figure] = []
    with Progress("knocks", "runs", WallClock().now) as progress:
        for kind, knock in enumerate(KNOCKS):
            results = []
            for number in range(options.count):
                results.append(_knocked(knock, number % 3, options.seed + 1000 * kind + number))
                progress(kind * options.count + number + 1, len(KNOCKS) * options.count)
            figures += _figures(knock, results)
    if options.minutes > 0:
        figures.append(_calm(options.seed, options.minutes))
    return figures


@dataclass(frozen=True, slots=True)
class Result:
    """s until the state was no longer TRACKING, until the right camera was named, and as what; inf: never."""

    flagged: float
    named: float
    right: bool


def _figures(knock: Knock, results: list[Result]) -> Iterator[Figure]:
    flagged, named = (np.array([getattr(r, name) for r in results]) for name in ("flagged", "named"))
    target = at_least(1.0) if knock.wanted else None
    share = float(np.isfinite(flagged).mean())
    note = f"{len(results)} knocks, each camera in turn, {NOISE:g} px, {LANDMARKS} landmarks"
    yield Figure(f"{knock.name}: DEGRADED, share", share, "", target, REFERENCE, note)
    known = flagged[np.isfinite(flagged)]
    yield Figure(f"{knock.name}: time, largest", 1000 * float(known.max()) if len(known) else float("nan"), "ms")
    yield Figure(f"{knock.name}: camera named, share", float(np.isfinite(named).mean()), "", target)
    right = [r.right for r in results if np.isfinite(r.named)]
    yield Figure(f"{knock.name}: bump told from lens, share", float(np.mean(right)) if right else float("nan"), "")


def _begun(rig: Rig, landmarks: Array, motion: Motion) -> Estimator:
    estimator = Estimator(rig)
    up = np.tile([0.0, 0.0, 1.0], (len(landmarks), 1))
    estimator.begin(0.0, REST @ motion(0.0), SurfaceMap(landmarks, up, np.zeros((3 * len(landmarks),) * 2)))
    return estimator


def _knocked(knock: Knock, camera: int, seed: int) -> Result:
    rng, rig = np.random.default_rng([seed, 101]), arc_rig()
    motion, landmarks = irregular(rng), patch(LANDMARKS, rng).points
    struck, name = knock.struck(rig, camera, rng), rig.cameras[camera].name
    estimator = _begun(rig, landmarks, motion)
    flagged = named = np.inf
    right = False
    for number in range(1, round((CALM + WATCHED) * RATE)):
        stamp = number / RATE
        pose = _step(estimator, struck if stamp >= CALM else rig, landmarks, motion, stamp, rng)
        if stamp >= CALM and pose[0] is not TrackState.TRACKING:
            flagged = min(flagged, stamp - CALM)
            if name in pose[1]:
                named = min(named, stamp - CALM)
                right = ("lens was turned" in pose[1]) == (knock.scale != 1.0)
    return Result(flagged, named, right)


def _step(
    estimator: Estimator, rig: Rig, landmarks: Array, motion: Motion, stamp: float, rng: np.random.Generator
) -> tuple[TrackState, str]:
    seen = observations(rig, landmarks, REST @ motion(stamp), stamp, rng, NOISE)
    fit = estimator.fit(seen, estimator.predict(stamp))
    pose = estimator.accept(fit, seen) if fit.measured else estimator.coast(fit)
    return pose.state, pose.reason


def _calm(seed: int, minutes: float) -> Figure:
    """Frame sets in which a camera is called bumped though none is, over several breathings of five minutes."""
    alarms, rig, left = 0, arc_rig(), minutes * 60.0
    for part in range(max(1, int(np.ceil(minutes / 5)))):
        rng = np.random.default_rng([seed, 103, part])
        motion, landmarks = irregular(rng), patch(LANDMARKS, rng).points
        estimator = _begun(rig, landmarks, motion)
        for number in range(1, round(min(left, 300.0) * RATE)):
            _step(estimator, rig, landmarks, motion, number / RATE, rng)
            alarms += bool(estimator.health.bumps.bumped)
        left -= 300.0
    return Figure(
        "false alarms, frame sets", alarms, "", at_most(0), REFERENCE, f"{minutes:g} min of irregular breathing"
    )
