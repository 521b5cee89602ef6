"""From set-point to motion: dead time, first-order lag and an acceleration limit, each of which may be absent.

Dead time and lag are exact for a set-point that goes in straight lines. The limit works in steps of 1 ms on what the
lag gives: as long as that stays within the limit it is followed, to within acceleration * step^2, else caught up with.
"""

from __future__ import annotations

import math

import numpy as np

from estimation.se3 import Array
from hardware.simulator.polyline import AXES, Polyline

STEP = 0.001  # s, of the acceleration limit
_BATCH = 4096  # steps at once


class Lag:
    """tau y' = u - y, where u is the line `dead_time` s ago; y is u at the line's first knot."""

    def __init__(self, line: Polyline, dead_time: float, tau: float) -> None:
        self._line, self._dead_time, self._tau = line, dead_time, tau
        self._behind = np.zeros((64, AXES))  # y - u at each knot
        self._size = 1

    def at(self, instants: Array, now: float) -> tuple[Array, Array]:
        """Axes and slopes, both (N, 6), at instants (N,) up to `now`, after which the line may still change."""
        self._settle(now)
        index, since = self._line.before(instants - self._dead_time)
        slopes, started = self._line.slopes[index], instants - self._dead_time >= self._line.instants[0]
        axes = self._line.axes[index] + slopes * since[:, None]
        if self._tau == 0:
            return axes, slopes * started[:, None]
        left = np.exp(-since / self._tau)[:, None]
        behind = self._behind[index] * left + slopes * self._tau * (left - 1)
        return axes + behind, (slopes - slopes * left - self._behind[index] / self._tau * left) * started[:, None]

    def _settle(self, now: float) -> None:
        """How far y is behind at each knot up to `now`."""
        instants, slopes = self._line.instants, self._line.slopes
        size = int(np.searchsorted(instants, now, "right"))
        while len(self._behind) < size:
            self._behind = np.concatenate([self._behind, np.zeros_like(self._behind)])
        if self._tau == 0 or size <= self._size:
            return
        left = np.exp(-np.diff(instants[self._size - 1 : size]) / self._tau).tolist()
        for knot, share in zip(range(self._size, size), left, strict=True):
            steady = slopes[knot - 1] * self._tau
            self._behind[knot] = (self._behind[knot - 1] + steady) * share - steady
        self._size = size


class Servo:
    """Where the axes really are. most: (2,) greatest accelerations of X Y Z, mm/s^2, and A B C, rad/s^2, or None."""

    def __init__(self, line: Polyline, dead_time: float, tau: float, most: Array | None) -> None:
        self._lag = Lag(line, dead_time, tau)
        self._most = most
        self._limited = Polyline(float(line.instants[0]), line.axes[0])
        self._steps = 0
        self._at, self._speed = line.axes[0].tolist(), [0.0] * AXES

    def at(self, instants: Array, now: float) -> Array:
        """Axes (N, 6) at instants (N,) up to `now`."""
        if self._most is None:
            return self._lag.at(instants, now)[0]
        while self._steps * STEP < now:
            grid = np.arange(self._steps, self._steps + _BATCH, dtype=np.float64) * STEP
            grid = grid[grid < now]
            self._follow(grid, *self._lag.at(grid, now), self._most.tolist())
            self._steps += len(grid)
        return self._limited.at(instants)

    def _follow(self, grid: Array, axes: Array, slopes: Array, most: list[float]) -> None:
        """Take the steps that begin at instants (N,), where the lag asks for these axes and slopes (N, 6)."""
        for instant, goal, slope in zip(grid.tolist(), axes.tolist(), slopes.tolist(), strict=True):
            before, at = self._speed, self._at
            linear = _speed(at[:3], before[:3], goal[:3], slope[:3], most[0])
            self._speed = linear + _speed(at[3:], before[3:], goal[3:], slope[3:], most[1])
            if self._speed != before:
                self._limited.append(instant, np.array(at), np.array(self._speed))
            self._at = [p + v * STEP for p, v in zip(at, self._speed, strict=True)]


def _speed(at: list[float], speed: list[float], goal: list[float], slope: list[float], most: float) -> list[float]:
    """The speed of the next step: that of the goal, and as much more as can be braked in time; change is limited."""
    gap = [g - p for g, p in zip(goal, at, strict=True)]
    distance, step = math.hypot(*gap), most * STEP
    closing = step * (math.sqrt(0.25 + 2 * distance / (step * STEP)) - 0.5)  # braked by `step` a step, ends at zero
    share = min(1 / STEP, closing / distance) if distance else 0.0
    change = [s + share * g - v for s, g, v in zip(slope, gap, speed, strict=True)]
    size = math.hypot(*change)
    scale = min(1.0, step / size) if size else 0.0
    return [v + scale * c for v, c in zip(speed, change, strict=True)]
