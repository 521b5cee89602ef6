"""Fitting a pose while one camera may be wrong as a whole: the odd one out is found by the others and by the motion.

Single wrong tracks are rejected one by one; a camera that was bumped or swapped is wrong in all of its tracks at once,
and they agree with each other. Left out one at a time, the camera without which the others agree, and agree with the
motion until now, is the odd one.
"""

from __future__ import annotations

from collections.abc import Collection
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from estimation import se3
from estimation.median import median
from estimation.observations import Observations
from estimation.online.pose_solver import PoseFit, Shared, own_residuals, project, solve_pose
from estimation.pose import SurfacePose, TrackState
from estimation.rig import Rig
from estimation.se3 import Array

MOST = 2  # cameras that may be wrong at once: exchanged cables
ORDERLY = 1.5  # px of residual, at which nobody asks how much of it a camera's own motion explains
RAYLEIGH = 1.18  # median length of a vector whose two entries are normal, in their sigmas
SURER = 3.0  # sigmas of the motion that make a pose surprising, and times fewer than the next: which is odd is told


def solve_with(
    rig: Rig,
    observations: Observations,
    points: Array,
    start: Array,
    scales: tuple[float, ...],
    left_out: Collection[int],
    shared: Shared,
) -> PoseFit:
    """The pose of all cameras but `left_out`, whose tracks have residuals too, and no weight; points (N, 3) mm."""
    o = observations
    if not left_out:
        return solve_pose(rig, o.camera, points, o.pixels, o.sigma, start, scales=scales, shared=shared)
    kept = ~np.isin(o.camera, list(left_out))
    fit = solve_pose(
        rig, o.camera[kept], points[kept], o.pixels[kept], o.sigma[kept], start, scales=scales, shared=shared
    )
    predicted, _, jacobians = project(rig, o.camera, fit.base_from_surface, points)
    residuals, weights = predicted - o.pixels, np.zeros(len(o))
    residuals[kept], weights[kept] = fit.residuals, fit.weights
    return PoseFit(fit.base_from_surface, fit.information, residuals, weights, jacobians, fit.scale, fit.shared)


def standing_off(observations: Observations, fit: PoseFit, count: int, least: float) -> Array:
    """How far, px, each camera stands off a pose: (C,), nan with fewer tracks than `least`.

    That is the median of its tracks' residuals, less what their noise alone makes of it.
    """
    away = np.linalg.norm(fit.residuals, axis=1)
    off = np.full(count, np.nan)
    for c in range(count):
        mine = observations.camera == c
        if np.count_nonzero(mine) >= least:
            noise = RAYLEIGH * median(observations.sigma[mine])
            off[c] = np.sqrt(max(median(away[mine]) ** 2 - noise**2, 0.0))
    return off


def odd_ones(
    rig: Rig,
    observations: Observations,
    points: Array,
    left_out: Collection[int],
    allowed: Array,
    least: float,
    expected: SurfacePose,
    shared: Shared,
    left: int = 1,
    within: float = np.inf,
) -> tuple[frozenset[int], PoseFit] | None:
    """The cameras, one or else two, without which the others agree, and the fit without them; None where unclear.

    left_out: cameras that are so already. allowed: (C,) px by which each may stand off. expected: by the motion, at
    this stamp. left: cameras that have to stay. within: sigmas of the motion by which their pose may surprise.
    """
    kept = [int(c) for c in np.unique(observations.camera) if c not in left_out]
    for size in range(1, min(MOST, len(kept) - left) + 1):
        found: list[tuple[float, frozenset[int], PoseFit]] = []
        for odd in combinations(kept, size):
            without = frozenset(left_out) | set(odd)
            fit = solve_with(rig, observations, points, expected.base_from_surface, (4.0, 1.0), without, shared)
            apart = standing_off(observations, fit, len(rig), least) / allowed
            others = [apart[c] for c in kept if c not in odd and np.isfinite(apart[c])]
            if others and max(others) <= 1.0 and all(apart[c] > 1.0 for c in odd):
                found.append((surprise(fit, expected), without, fit))
        found.sort(key=lambda one: one[0])
        if found:
            sure = len(found) == 1 or found[1][0] > SURER * found[0][0]
            return found[0][1:] if sure and found[0][0] <= within else None
    return None


def surprise(fit: PoseFit, expected: SurfacePose) -> float:
    """By how many sigmas a pose differs from the motion's, at least one."""
    off = se3.log(se3.inverse(expected.base_from_surface) @ fit.base_from_surface)
    damped = fit.information + (1e-9 * np.trace(fit.information) + 1e-12) * np.eye(6)  # none at all: no surprise
    spread = expected.covariance + np.linalg.inv(damped)
    return max(1.0, float(np.sqrt(off @ np.linalg.solve(spread, off) / 6)))


def contradiction(
    observations: Observations, fit: PoseFit, odd: Collection[int], torn: bool, expected: SurfacePose
) -> str:
    """What speaks against a fit that stands on little, or ''.

    odd: cameras that are left out. torn: whether few tracks are left, and even they stand off. Of a covered surface a
    tenth of the landmarks is found by chance, anywhere within the search: a claim wide enough for such tracks is wide
    enough for any motion, so that nothing surprises. Taken for a pose they set it 3.7 mm off, 16 of it by its speed.
    """
    if torn:
        return "few tracks, against each other"
    if not odd:
        return ""
    out = np.isin(np.unique(observations.camera), list(odd))
    alone = bool(out.any() and (~out).sum() == 1)
    if not alone or expected.state is TrackState.LOST or surprise(fit, expected) <= SURER:
        return ""
    return "one camera alone, against the others and the motion"


def disorder(observations: Observations, solution: PoseFit, inlier: NDArray[np.bool_]) -> float:
    """Median residual, px, of the inliers when each camera may move for itself: what no pose of a surface explains."""
    whole = np.linalg.norm(solution.residuals[inlier], axis=1)
    if not len(whole) or median(whole) < ORDERLY:
        return 0.0  # what is left of so little need not be asked for
    left = own_residuals(observations.camera, solution, inlier.astype(float))[inlier]
    return float(np.median(np.linalg.norm(left, axis=1)))
