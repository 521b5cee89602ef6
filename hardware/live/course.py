"""How the predicted error went over a run, and when the nozzle was held: as many numbers, however long it lasts."""

from __future__ import annotations

import numpy as np

from estimation.se3 import Array

BINS = 600  # even
SHORTEST = 0.1  # s of a bin at first


class Course:
    """Bins from the first tick on, twice as long whenever they are full.

    width: s of each. error: (BINS,) mm, the largest predicted in each while material left, NaN where none did. held:
    (BINS,) s.
    """

    def __init__(self) -> None:
        self.width = SHORTEST
        self.error = np.full(BINS, np.nan)
        self.held = np.zeros(BINS)
        self._begun = float("nan")
        self._last = 0

    @property
    def stamps(self) -> Array:
        """(N,) s since the first tick, the middles of the bins so far."""
        return np.asarray((np.arange(self._last + 1) + 0.5) * self.width, float)

    def add(self, stamp: float, error: float, held: float) -> None:
        """A tick at `stamp`, s, with its predicted error, mm or NaN, and the s for which it was held."""
        if np.isnan(self._begun):
            self._begun = stamp
        while (stamp - self._begun) / self.width >= BINS:
            half = np.full(BINS // 2, np.nan), np.zeros(BINS // 2)
            self.error = np.concatenate([np.fmax(self.error[::2], self.error[1::2]), half[0]])
            self.held = np.concatenate([self.held[::2] + self.held[1::2], half[1]])
            self.width *= 2
        self._last = max(0, int((stamp - self._begun) / self.width))
        self.error[self._last] = np.fmax(self.error[self._last], error)
        self.held[self._last] += held
