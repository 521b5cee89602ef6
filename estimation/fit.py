"""A fit to one frame set, with what is claimed of it and whether it counts."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estimation.observations import Observations
from estimation.online.pose_solver import PoseFit
from estimation.se3 import Array


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """A fit to one frame set, judged.

    noise, smear: (6, 6) covariances of what is new in this frame set, by tracks and images, and by late exposures of
    what moves; lasting: (6, 6), of what the map adds to them. twist: (6,) the velocity by which the cameras'
    instants were brought together, twist_doubt: (6,) its variance. scatter: variance of the tracks in parts of what is
    claimed of them. tracks: (6, 6), what the tracks' own errors, as claimed, do to the pose; late: (6, C) and bias:
    (6, 2C), what a delay, s, and a shift, px, of each camera's image do. used: (C,) inliers per camera. reason: why it
    is no measurement, or ''. off: (C,) px by which each camera stands off the pose, nan where it does not see the
    surface; allowed: (C,) px, one sigma. odd: cameras that were left out.
    """

    stamp: float
    solution: PoseFit
    noise: Array
    smear: Array
    lasting: Array
    twist: Array
    twist_doubt: Array
    scatter: float
    tracks: Array
    late: Array
    bias: Array
    inlier: NDArray[np.bool_]
    used: NDArray[np.int64]
    reason: str
    off: Array
    allowed: Array
    odd: frozenset[int] = frozenset()

    @property
    def measured(self) -> bool:
        """Whether the fit may enter the window."""
        return not self.reason

    @property
    def covariance(self) -> Array:
        """(6, 6), of all that is new in this frame set."""
        return self.noise + self.smear

    @property
    def clear(self) -> float:
        """The part, 0 to 1, of the squared velocity in the images that is not the velocity's own noise."""
        weighted = self.solution.jacobians * np.sqrt(self.solution.weights)[:, None, None]
        noise = float((weighted**2).sum((0, 1)) @ self.twist_doubt)
        whole = float(((weighted @ self.twist) ** 2).sum())
        return max(0.0, 1 - noise / whole) if whole > 0 else 0.0


def no_fit(seen: Observations, start: Array, cameras: int, reason: str, odd: frozenset[int]) -> Fit:
    """No measurement of what was `seen` by a rig of so many cameras: the pose stays `start` (4, 4)."""
    count = len(seen)
    nothing = PoseFit(start, np.zeros((6, 6)), np.zeros((count, 2)), np.zeros(count), np.zeros((count, 2, 6)), 1.0)
    unknown, off = np.full((6, 6), np.inf), np.full(cameras, np.nan)
    pulls = np.zeros((6, 6)), np.zeros((6, cameras)), np.zeros((6, 2 * cameras))
    zeros = np.zeros((6, 6)), np.zeros((6, 6)), np.zeros(6), np.zeros(6), 1.0, *pulls
    none, used = np.zeros(count, bool), np.zeros(cameras, np.int64)
    return Fit(seen.stamp, nothing, unknown, *zeros, none, used, reason, off, off, odd)
