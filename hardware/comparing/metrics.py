"""Absolute and relative errors of poses as evo counts them (Sturm et al., IROS 2012; Zhang and Scaramuzza, IROS 2018).

evo itself draws in pandas, matplotlib and seaborn; its numbers are a page of arithmetic, and a test holds ours to them.
Scale is never fitted: lengths here are calibrated mm.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estimation import se3
from estimation.errors import InputError
from estimation.se3 import Array
from hardware.comparing.posed import Posed
from hardware.report.evaluation import Errors, associate, best_constant, errors_under

ALIGNMENTS = ("as they stand", "aligned, SE(3)", "one surface frame", "laid at one pose")
HELD = 1e-3  # mm, one standard deviation in all: less is claimed of no pose that was measured
CLAIMED = ALIGNMENTS[0], ALIGNMENTS[3]  # under which covariances mean what they say: nothing is fitted
Rows = NDArray[np.int64]
FEWEST = 3  # pairs: of fewer an alignment would leave nothing


@dataclass(frozen=True, slots=True)
class Statistics:
    """The figures that evo gives of errors, in their own unit; NaN where there are none."""

    rmse: float
    mean: float
    median: float
    std: float
    min: float
    max: float
    sse: float


@dataclass(frozen=True, slots=True, eq=False)
class Relative:
    """Errors of the change over `delta` poses, (P,) mm and rad. rows: (P,) of the poses at which each change ends."""

    rows: Rows
    translation: Array
    rotation: Array


@dataclass(frozen=True, slots=True, eq=False)
class Judged:
    """One alignment. name: of ALIGNMENTS. estimated, reference: (M, 4, 4) after it. absolute: APE and NEES. relative:
    RPE.
    """

    name: str
    estimated: Array
    reference: Array
    absolute: Errors
    relative: Relative


@dataclass(frozen=True, slots=True, eq=False)
class Compared:
    """Poses beside others of the same instants. stamps: (M,) s, of the estimated ones. gap: s, median distance of the
    stamps that belong together. judged: by alignment, without the SE(3) one where positions do not determine it.
    """

    estimated: Posed
    reference: Posed
    stamps: Array
    gap: float
    delta: int
    judged: tuple[Judged, ...]

    def of(self, name: str) -> Judged | None:
        """The alignment of that name, None where there is none."""
        return next((each for each in self.judged if each.name == name), None)

    @property
    def fitted(self) -> Judged:
        """In one surface frame, the one that fits best."""
        return self.judged[-2]

    @property
    def laid(self) -> Judged:
        """In the surface frame of one pose."""
        return self.judged[-1]


def statistics(errors: Array) -> Statistics:
    """The figures of errors (M,)."""
    if not len(errors):
        return Statistics(*[float("nan")] * 7)
    square = errors**2
    values = np.sqrt(square.mean()), errors.mean(), np.median(errors), errors.std(), errors.min(), errors.max()
    return Statistics(*map(float, (*values, square.sum())))


def compare(estimated: Posed, reference: Posed, delta: int = 1) -> Compared:
    """The estimated poses judged by the reference.

    "As they stand": evo without options. "Aligned, SE(3)": `evo_ape -a`, the rigid motion of the base that brings the
    positions nearest (Umeyama 1991), left out where they lie on a line and do not determine it. "One surface frame":
    the constant between the two surface frames, which are each run's own, that brings the poses nearest. "Laid at one
    pose": that constant as one pose tells it, whose own error then is in all others; so a run claims its covariances
    that lays its surface frame by its first pose, or, smoothed, holds the pose that did.
    delta: poses between the two of a relative error; the pairs follow one another, as evo's do. Raises InputError where
    fewer than FEWEST poses belong together.
    """
    rows, theirs = associate(estimated.trajectory.stamps, reference.trajectory.stamps)
    rows, theirs = _once(rows, theirs, estimated.trajectory.stamps, reference.trajectory.stamps)
    if len(rows) < max(FEWEST, delta + 1):
        need = f"{max(FEWEST, delta + 1)} or more: are both of the same recording, and on one clock?"
        raise InputError(estimated.name, f"poses at instants of {reference.name}", len(rows), need)
    ours, target = estimated.trajectory.base_from_surface[rows], reference.trajectory.base_from_surface[theirs]
    covariance = estimated.covariance[rows]
    pairs = [(ALIGNMENTS[0], ours, target)]
    if _determined(ours[:, :3, 3], target[:, :3, 3]):
        motion = se3.rigid_from_points(ours[:, :3, 3], target[:, :3, 3])
        pairs.append((ALIGNMENTS[1], motion @ ours, target))
    changes = se3.inverse(target) @ ours
    pairs += [
        (ALIGNMENTS[2], ours, target @ best_constant(changes)),
        (ALIGNMENTS[3], ours, target @ changes[_held(covariance)]),
    ]
    judged = tuple(
        Judged(name, a, b, errors_under(np.eye(4), b, a, covariance), relative_errors(a, b, delta))
        for name, a, b in pairs
    )
    gaps = np.abs(estimated.trajectory.stamps[rows] - reference.trajectory.stamps[theirs])
    return Compared(estimated, reference, estimated.trajectory.stamps[rows], float(np.median(gaps)), delta, judged)


def _held(covariance: Array) -> int:
    """The pose that a smoothed run holds, of which next to nothing is claimed (M, 6, 6); the first where none is."""
    size = np.trace(covariance[:, 3:, 3:], axis1=1, axis2=2)
    return int(np.argmin(size)) if np.isfinite(size).all() and size.min() < HELD**2 else 0


def relative_errors(estimated: Array, reference: Array, delta: int) -> Relative:
    """Of poses (M, 4, 4): how far the change from each to the one `delta` later is off, pairs end to end."""
    ends = np.arange(0, len(estimated), delta, dtype=np.int64)
    change, expected = (se3.inverse(p[ends[:-1]]) @ p[ends[1:]] for p in (estimated, reference))
    off = se3.inverse(expected) @ change
    return Relative(ends[1:], np.linalg.norm(off[:, :3, 3], axis=-1), se3.angle_of(off[:, :3, :3]))


def _once(rows: Rows, theirs: Rows, stamps: Array, their_stamps: Array) -> tuple[Rows, Rows]:
    """Each of the reference's rows once, with the nearest of those that chose it."""
    order = np.lexsort((np.abs(stamps[rows] - their_stamps[theirs]), theirs))
    _, first = np.unique(theirs[order], return_index=True)
    kept = np.sort(order[first])
    return rows[kept], theirs[kept]


def _determined(a: Array, b: Array) -> bool:
    """Whether positions (M, 3) tell a rotation between them: evo's own condition."""
    sizes = np.linalg.svd((b - b.mean(0)).T @ (a - a.mean(0)) / len(a), compute_uv=False)
    return bool((sizes > np.finfo(float).eps).sum() >= 2)
