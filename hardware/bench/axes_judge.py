"""An oracle of the arm's commanded motion: what each axis does, by differences of the commands themselves."""

from __future__ import annotations

import numpy as np

from estimation.se3 import Array
from planning.limits import Limits

KINDS = "speed", "acceleration", "jerk", "jump", "turn"
SLACK = 1.001  # a sample counts as over a limit from 0.1 % on


class AxesJudge:
    """Follows the axes tick by tick. samples: ticks judged. over: how many broke each of KINDS. worst: (5,) shares."""

    def __init__(self, axes: Array, limits: Limits, tick: float) -> None:
        """axes: (6,) where the arm stands at first, at rest."""
        self._limits, self._tick = limits, tick
        self._bounds = np.stack([limits.speed, limits.acceleration, limits.jerk]) * tick ** np.arange(1, 4)[:, None]
        self.samples = 0
        self.over, self.worst = np.zeros(len(KINDS), np.int64), np.zeros(len(KINDS))
        self._last = np.tile(axes, (4, 1))  # (4, 6), the newest last

    def rest(self) -> None:
        """The arm has come to rest by itself, where it was sent last."""
        self._last = np.tile(self._last[-1], (4, 1))

    def stands(self, axes: Array) -> None:
        """What was sent beyond was called back: the arm stands at `axes` (6,)."""
        self._last = np.tile(axes, (4, 1))

    def __call__(self, axes: Array | None) -> None:
        """One tick: the axes (6,) that are reached by its end, None where the arm is held."""
        self._last = np.vstack([self._last[1:], self._last[-1] if axes is None else axes])
        shares = self._shares()
        self.samples += 1
        self.over += ~(shares <= SLACK)  # NaN is over
        self.worst = np.maximum(self.worst, np.where(np.isfinite(shares), shares, np.inf))

    def _shares(self) -> Array:
        """How much of each limit the last tick took (5,)."""
        p = self._last
        step = p[3] - p[2]
        quotients = np.abs(np.stack([step, step - (p[2] - p[1]), p[3] - 3 * p[2] + 3 * p[1] - p[0]])) / self._bounds
        jump, turn = np.linalg.norm(step[:3]) / self._limits.jump, np.abs(step[3:]).max() / self._limits.turn
        return np.array([*quotients.max(axis=1), jump, turn])
