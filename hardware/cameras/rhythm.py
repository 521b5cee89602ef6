"""The steady beat behind instants that jitter and skip: a phase-locked period."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np

MEMORY = 30  # beats by which phase and period are smoothed: a second of a webcam
SKIPS = 0.6  # of a period after the next beat, where one is likelier to be left out than late (2 %, sigma 5 of 33 ms)
EARLY = 0.4  # of a period after the last one: sooner, it is no beat of its own
PAUSE = 10  # beats without an instant, after which the phase may be another one
SEEN = 10  # instants by which a period is found
LONGER = 20  # instants by which it is found to have changed
CHANGED = 0.25  # share by which it has: the median of so many steps, each of sigma 7 of 33 ms, lies off by half of that
FAR, SURE = 2.0, 10  # times the usual, that one instant may pull at most; beats after which the usual is known
SHORTEST = 0.004  # s: no camera here is faster, but what was held up comes faster


@dataclass(frozen=True, slots=True)
class Beat:
    """One instant's place. steady: s, without the jitter. count: periods since the last one, 0 for no beat at all."""

    steady: float
    count: int


class Rhythm:
    """Follows instants (s) that come at a steady period, some off by up to half of it, some not at all.

    The gains are those of a straight line through all beats, from MEMORY beats on fixed (Brookner, Tracking and Kalman
    Filtering Made Easy, 1.3). A period that has changed for good is taken over.
    """

    def __init__(self, period: float | None = None) -> None:
        """period: s, as it is told; None: found from the first SEEN instants, which are taken as they are."""
        self.period, self.missed = period, 0
        self._beats = 0  # that speak for the phase
        self._known = SEEN if period else 0  # as many more speak for the period
        self._grid, self._off = -np.inf, 0.0
        self._instants: deque[float] = deque(maxlen=LONGER)

    @property
    def jitter(self) -> float:
        """Root mean square of how far instants lie off the steady beat, s."""
        return float(np.sqrt(self._off))

    def __call__(self, instant: float) -> Beat:
        """Take the next instant, s, not before the last one; steady ones do not go back either."""
        if self.period and self._instants and instant - self._instants[-1] > PAUSE * self.period:
            self._beats = 0
        self._instants.append(instant)
        if self._is_due(self.period) and self._find():
            return Beat(self._grid, 1)
        if self.period is None or self._beats == 0:
            self._grid, self._beats = max(instant, self._grid), 1
            return Beat(self._grid, 1)
        return self._follow(instant, self.period)

    def _is_due(self, period: float | None) -> bool:
        """Whether a period can be found, or most of the last steps are of another length, the same for all of them."""
        if period is None:
            return len(self._instants) >= SEEN
        if len(self._instants) < LONGER:
            return False
        steps = np.diff(self._instants)
        median = max(float(np.median(steps)), SHORTEST)
        alike = np.mean(np.abs(steps - median) < CHANGED / 2 * median) > 0.5
        return bool(alike) and abs(median / period - 1) > CHANGED

    def _find(self) -> bool:
        """Lay the straight line through the last instants, counted in their median step; False where that is none."""
        instants = np.array(self._instants)[-SEEN:]
        steps = np.diff(instants)
        counts = np.append(0, np.cumsum(np.round(steps / max(float(np.median(steps)), SHORTEST))))
        if np.ptp(instants) < SHORTEST * (SEEN - 1) or counts[-1] == 0:
            return False
        slope, start = np.polyfit(counts, instants - instants[0], 1)
        self.period, self._beats, self._known = float(slope), SEEN, 0
        self._grid = max(self._grid, float(instants[0] + start + slope * counts[-1]))
        return True

    def _follow(self, instant: float, period: float) -> Beat:
        ahead = (instant - self._grid) / period
        if ahead < EARLY:
            return Beat(self._grid, 0)
        count = max(1, int(np.ceil(ahead - SKIPS)))
        off = self._bounded(instant - self._grid - count * period)
        k = min(self._beats, MEMORY)
        known = min(self._beats + self._known, MEMORY)
        self._grid += count * period + off * 2 * (2 * k + 1) / ((k + 1) * (k + 2))
        self.period = period + off / count * 6 / ((known + 1) * (known + 2))
        self._off += (off * off - self._off) / k
        self._beats, self.missed = self._beats + 1, self.missed + count - 1
        return Beat(self._grid, count)

    def _bounded(self, off: float) -> float:
        """How far, s, an instant off its beat counts: Huber's bound, so that one that was held up moves no phase."""
        far = FAR * self.jitter + 1e-4 if self._beats > SURE else np.inf
        return float(np.clip(off, -far, far))
