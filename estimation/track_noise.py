"""How much of the tracks' scatter about a pose is drawn anew with each frame set, and how much lasts.

What is new is averaged by the window, what lasts is not: where between pixels a landmark lies, how its patch is seen
from here. Both show in how a track's residual changes, the first from one frame set to the next, the second over
seconds. What never changes is the map's, or was in the first pose, too.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estimation.observations import Observations
from estimation.online.pose_solver import PoseFit
from estimation.se3 import Array

MEMORY = 300.0  # frame sets, ten seconds, over which the parts are learned
CLAIMED = 20.0  # tracks as which the belief at first counts: that all of it is new
LEAST = 0.02  # of the variance: no track errs alike to the last bit
APART = 0.2  # s: what has changed in more need not be new
LONG = 1.0  # s and up to twice that: a breath has gone half its way
AGREES = 0.2  # weight of a track that takes part


@dataclass(frozen=True, slots=True, eq=False)
class _Residuals:
    """Of one fit: stamp, s; key (N,), of a track in a camera; value (N, 2), in sigmas and as it pulls at the pose."""

    stamp: float
    key: NDArray[np.int64]
    value: Array


class TrackNoise:
    """The parts of the tracks' scatter, as shares of its variance that are together one at most."""

    def __init__(self, cameras: int) -> None:
        self._cameras = cameras
        self._past: list[_Residuals] = []  # of some seconds ago, of one, and the last
        self._sums = CLAIMED * np.array([1.0, 1.0, 0.0, 0.0])  # of squares an axis: all, new; all, changed in seconds

    @property
    def anew(self) -> float:
        """The share that is drawn anew with each frame set."""
        return float(np.clip(self._sums[1] / self._sums[0], LEAST, 1.0))

    @property
    def lasting(self) -> float:
        """The share that is alike from one frame set to the next, and another after seconds."""
        whole, changed = self._sums[2:]
        return float(np.clip(changed / max(whole, CLAIMED) - self.anew, 0.0, 1.0 - self.anew))

    def learn(self, seen: Observations, solution: PoseFit, sigma: Array) -> None:
        """Take the residuals of one fit. sigma: (N,) px as claimed."""
        good = solution.weights > AGREES
        key = seen.track[good] * self._cameras + seen.camera[good]
        pull = solution.weights[good] / (sigma[good] * solution.scale)
        now = _Residuals(seen.stamp, key, solution.residuals[good] * pull[:, None])
        if not self._past:
            self._past = [now] * 3
            return
        old, middle, last = self._past
        new = _changed(now, last) if now.stamp - last.stamp < APART else np.zeros(2)
        self._sums = (1 - 1 / MEMORY) * self._sums + np.r_[new, _changed(now, old)]
        self._past = [middle, now, now] if now.stamp - middle.stamp >= LONG else [old, middle, now]


def _changed(now: _Residuals, then: _Residuals) -> Array:
    """Sums (2,), an axis, of the squared residuals of tracks that both have, and of half their squared changes."""
    _, rows, before = np.intersect1d(now.key, then.key, assume_unique=True, return_indices=True)
    value = now.value[rows]
    change = value - then.value[before]
    return np.array([(value**2).sum(), (change**2).sum() / 2]) / 2
