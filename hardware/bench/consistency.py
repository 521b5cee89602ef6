"""`stillbed bench consistency`: on pictures, do the errors of the poses have the size that is claimed of them?

The pictures are loops of the outages' scenes (`hardware/bench/outage_run.py`), shown with fresh noise each time round.
Everything is measured after the constant transform taken at the first TRACKING pose; nothing is fitted over the run.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estimation import se3
from estimation.pose import SurfacePose, TrackState
from estimation.se3 import Array
from hardware.bench.estimator import CONSISTENT, INSIDE
from hardware.bench.figures import Figure, at_least
from hardware.bench.outage_run import FPS, looped
from hardware.bench.pooled import WITHIN, nees
from hardware.simulator.picture_loop import PictureLoop
from hardware.simulator.scene.scene import rois
from perception.frames import Frame, FrameSet
from perception.tracking.step import TrackingStep

PERIOD = 40  # frame sets of a loop
SETTLED = 32  # frame sets after the first TRACKING pose: until then the widest claim is given out


@dataclass(frozen=True, slots=True, eq=False)
class Run:
    """The poses of one scene from the first TRACKING one on. errors: (N, 6) rad and mm, of the measured ones, in the
    surface frame; covariances: (N, 6, 6) as claimed; late: (N,) frame sets since the first. share: that was measured.
    """

    errors: Array
    covariances: Array
    late: NDArray[np.int64]
    share: float


def run(options: argparse.Namespace) -> list[Figure]:
    """Figures over all scenes, and each scene's own."""
    seeds = range(options.seed, options.seed + options.scenes)
    runs = {f"scene {seed}": followed(seed, round(options.seconds * FPS)) for seed in seeds}
    return [*consistency_figures("all", list(runs.values())), *_each(runs)]


def followed(seed: int, count: int) -> Run:
    """What the tracking step makes of `count` frame sets of one scene."""
    rig, scene, loop = looped(seed, PERIOD)
    step = TrackingStep(rig, rois(scene, rig, loop.poses[0], 0.0))
    poses = [_pose(step, loop, k) for k in range(count)]
    return errors_of(poses, loop.poses[np.arange(count) % len(loop)])


def _pose(step: TrackingStep, loop: PictureLoop, number: int) -> SurfacePose:
    stamp = number / FPS
    frames = [Frame(c, stamp, loop.noisy(image)) for c, image in enumerate(loop.images(number))]
    pose = step(FrameSet(stamp, tuple(frames)))
    step.idle()
    return pose


def errors_of(poses: list[SurfacePose], truth: Array) -> Run:
    """Errors of poses against truth (N, 4, 4), base_from_surface, after the transform at the first TRACKING one."""
    first = next((i for i, p in enumerate(poses) if p.state is TrackState.TRACKING), len(poses))
    rows = np.array([i for i in range(first + 1, len(poses)) if poses[i].state.measured], np.int64)
    if not len(rows):
        return Run(np.zeros((0, 6)), np.zeros((0, 6, 6)), rows, 0.0)
    constant = se3.inverse(truth[first]) @ poses[first].base_from_surface
    found = np.stack([poses[i].base_from_surface for i in rows])
    errors = se3.log(se3.inverse(found) @ truth[rows] @ constant)
    share = len(rows) / (len(poses) - first - 1)
    return Run(errors, np.stack([poses[i].covariance for i in rows]), rows - first, share)


def consistency_figures(name: str, runs: list[Run]) -> list[Figure]:
    """Of all poses but those of the first second, when the claim is still that of unknown cameras."""
    errors, covariances, late = (
        np.concatenate([getattr(r, n) for r in runs]) for n in ("errors", "covariances", "late")
    )
    kept = late > SETTLED
    if not kept.any():
        return [Figure(f"{name}: NEES/6", float("nan"), "", CONSISTENT, note="not followed for longer than a second")]
    squares = nees(errors, covariances) / 6
    errors, covariances = errors[kept], covariances[kept]
    inside = np.abs(errors) <= WITHIN * np.sqrt(np.diagonal(covariances, axis1=1, axis2=2))
    claim = float(np.sqrt(np.trace(covariances[:, 3:, 3:], axis1=1, axis2=2).mean() / 3))
    error = float(np.sqrt((errors[:, 3:] ** 2).mean()))
    note = f"{len(errors)} poses; {squares[~kept].mean():.3f} in the first second" if (~kept).any() else ""
    return [
        Figure(f"{name}: NEES/6", float(squares[kept].mean()), "", CONSISTENT, "", note),
        Figure(f"{name}: NEES/6, largest", float(squares[kept].max()), "", None, "", "of one pose"),
        Figure(f"{name}: inside 95 %", float(inside.mean()), "", INSIDE, "", "of six axes"),
        Figure(f"{name}: error of an axis", 1000 * error, "um"),
        Figure(f"{name}: claim of an axis", 1000 * claim, "um"),
        Figure(f"{name}: measured", 100 * float(np.mean([r.share for r in runs])), "%", at_least(99)),
    ]


def _each(runs: dict[str, Run]) -> list[Figure]:
    if len(runs) < 2:
        return []
    return [f for name, one in runs.items() for f in consistency_figures(name, [one]) if "NEES/6" in f.what]
