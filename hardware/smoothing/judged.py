"""A smoothed session beside its live run and its truth, and what a loop of another speed would have made of it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estimation import se3
from estimation.batch.smoothed import Smoothed
from estimation.se3 import Array
from estimation.trajectory import Trajectory
from hardware.report.evaluation import Errors, associate, best_constant, errors_under
from hardware.smoothing.rhythms import Rhythms, rhythms
from hardware.smoothing.tracks import Tracks

DELAYS = (0.02, 0.033, 0.05, 0.1, 0.15, 0.2, 0.3)  # s, from exposure to the nozzle's arrival
RATE = 60.0  # Hz, of the instants that a loop is asked at


@dataclass(frozen=True, slots=True, eq=False)
class Live:
    """The live run's measured poses. rows: (M,) of the smoothed ones. poses: (M, 4, 4). apart: (M, 6) right
    perturbations of the smoothed poses, rad and mm, after the constant between the surface frames that fits best.
    """

    rows: NDArray[np.int64]
    poses: Array
    apart: Array


@dataclass(frozen=True, slots=True, eq=False)
class Judged:
    """live: None without measured poses. errors: of smoothed and live poses (None without) against truth or reference
    after the best constant, None without either; exact: whether that is a truth. late: (D, 4) for each of DELAYS, mm:
    RMS and 95 % of the nozzle's error where the last pose is held, and where it is carried on along its twist.
    """

    live: Live | None
    errors: tuple[Errors, Errors | None] | None
    exact: bool
    late: Array
    rhythms: Rhythms

    @property
    def live_rms(self) -> float:
        """RMS distance, mm, of live from smoothed poses; nan without."""
        return float("nan") if self.live is None else float(np.sqrt((self.live.apart[:, 3:] ** 2).sum(1).mean()))


def judge(smoothed: Smoothed, tracks: Tracks, truth: Trajectory | None) -> Judged:
    """All that is told of a smoothed session."""
    live = _live(smoothed, tracks)
    errors = None if truth is None else _errors(smoothed, live, truth)
    return Judged(live, errors, truth is not None and truth.exact, what_if(smoothed), rhythms(smoothed))


def _live(smoothed: Smoothed, tracks: Tracks) -> Live | None:
    start = tracks.start
    if start is None:
        return None
    theirs, rows = associate(start.stamps, smoothed.stamps)
    if not len(rows):
        return None
    poses, ours = start.base_from_surface[theirs], smoothed.states.poses[rows]
    constant = best_constant(se3.inverse(ours) @ poses)
    laid = poses @ se3.inverse(constant)
    return Live(rows, laid, se3.log(se3.inverse(ours) @ laid))


def _errors(smoothed: Smoothed, live: Live | None, truth: Trajectory) -> tuple[Errors, Errors | None] | None:
    rows, true_rows = associate(smoothed.stamps, truth.stamps)
    if not len(rows):
        return None
    ours = _under(smoothed.states.poses[rows], truth.base_from_surface[true_rows], smoothed.covariance[rows, :6, :6])
    if live is None:
        return ours, None
    mine, of_truth = associate(smoothed.stamps[live.rows], truth.stamps)
    unknown = np.full((len(mine), 6, 6), np.nan)
    return ours, _under(live.poses[mine], truth.base_from_surface[of_truth], unknown) if len(mine) else None


def _under(poses: Array, truth: Array, covariance: Array) -> Errors:
    return errors_under(best_constant(se3.inverse(truth) @ poses), truth, poses, covariance)


def what_if(smoothed: Smoothed) -> Array:
    """(D, 4) mm; see Judged. The nozzle stands over the middle of the map, and knows the pose itself exactly."""
    middle = np.median(smoothed.map.points, axis=0)
    first, last = smoothed.stamps[[0, -1]]
    out = np.full((len(DELAYS), 4), np.nan)
    times = np.arange(first, last, 1 / RATE)
    now = smoothed.at(times)
    for i, delay in enumerate(DELAYS):
        kept = times + delay <= last
        if not kept.any():
            continue
        then = smoothed.at(times[kept] + delay).base_from_surface
        held = now.base_from_surface[kept]
        carried = held @ se3.exp(now.twist[kept] * delay)
        true = se3.transform_points(then, middle[None])[:, 0]
        for j, guess in enumerate((held, carried)):
            off = np.linalg.norm(se3.transform_points(guess, middle[None])[:, 0] - true, axis=1)
            out[i, 2 * j : 2 * j + 2] = np.sqrt(np.mean(off**2)), np.percentile(off, 95)
    return out
