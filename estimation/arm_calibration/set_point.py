"""Where an arm's controller was sent over time, and where servos that follow it late are."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estimation.runtime import compiled
from estimation.se3 import Array

QUICKEST = 1e-9  # s: a lag below is none


@compiled("float64[:,::1](float64[::1], float64[:,::1], float64)")
def _behind(instants: Array, slopes: Array, lag: float) -> Array:
    """How far a first-order lag is behind the line at each knot (K, 6)."""
    out = np.zeros_like(slopes)
    for knot in range(1, len(instants)):
        left = np.exp(-(instants[knot] - instants[knot - 1]) / lag)
        for axis in range(slopes.shape[1]):
            steady = slopes[knot - 1, axis] * lag
            out[knot, axis] = (out[knot - 1, axis] + steady) * left - steady
    return out


@dataclass(frozen=True, slots=True, eq=False)
class SetPoint:
    """Straight ways between knots. instants: (K,) s, rising. axes: (K, 6) mm and rad; held before and after them."""

    instants: Array
    axes: Array

    @property
    def slopes(self) -> Array:
        """Speed (K, 6) after each knot, mm/s and rad/s; zero after the last."""
        ways = np.diff(self.axes, axis=0) / np.diff(self.instants)[:, None]
        return np.vstack([ways, np.zeros((1, self.axes.shape[1]))])

    def lagged(self, stamps: Array, dead_time: float, lag: float) -> Array:
        """Axes (N, 6) at stamps (N,), s, of servos that begin `dead_time` s late and approach with time constant `lag`.

        Exact for straight ways: lag y' = u - y with the set-point u of `dead_time` ago.
        """
        slopes, lag = self.slopes, max(lag, QUICKEST)
        behind = _behind(np.ascontiguousarray(self.instants), np.ascontiguousarray(slopes), lag)
        when = stamps - dead_time
        knot = np.searchsorted(self.instants, when, "right") - 1
        since = np.where(knot >= 0, when - self.instants[np.maximum(knot, 0)], 0.0)
        knot = np.maximum(knot, 0)
        left = np.exp(-since / lag)[:, None]
        held = np.where((when >= self.instants[0])[:, None], slopes[knot], 0.0)
        return np.asarray(self.axes[knot] + held * since[:, None] + behind[knot] * left + held * lag * (left - 1))

    def places(self, stamps: Array, settle: float) -> NDArray[np.int64]:
        """The number (N,) of the place at which the arm has rested for `settle` s at each stamp, s; -1 on the way."""
        moves = np.abs(self.slopes).max(1) > 0
        ended = np.where(np.concatenate([[False], moves[:-1]]), self.instants, -np.inf)  # a way, at each knot
        ended = np.maximum.accumulate(ended)
        number = np.unique(ended, return_inverse=True)[1]
        knot = np.maximum(np.searchsorted(self.instants, stamps, "right") - 1, 0)
        rests = ~moves[knot] & (stamps - ended[knot] >= settle)
        return np.where(rests, number[knot], -1)
