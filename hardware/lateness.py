"""How late ticks were: a histogram, so that a run of any length costs the same memory and the same time."""

from __future__ import annotations

import math

import numpy as np

BIN = 1e-4  # s
_BINS = 1000  # a tenth of a second; what is later counts as that


class Lateness:
    """Counts of lateness. most: s, the largest."""

    def __init__(self) -> None:
        self._counts = np.zeros(_BINS, np.int64)
        self.count, self.most = 0, 0.0

    def add(self, late: float) -> None:
        """One tick was `late` s behind its instant."""
        self._counts[min(int(max(late, 0.0) / BIN), _BINS - 1)] += 1
        self.count += 1
        self.most = max(self.most, late)

    @property
    def counts(self) -> tuple[int, ...]:
        """How many there were in each bin of BIN s; the last one holds all that were later."""
        return tuple(self._counts.tolist())

    def percentile(self, share: float) -> float:
        """Lateness, s, that `share` percent of the ticks do not exceed, rounded up to a bin; NaN of none."""
        if not self.count:
            return math.nan
        wanted = max(share / 100 * self.count, 1.0)
        return (int(np.searchsorted(np.cumsum(self._counts), wanted)) + 1) * BIN
