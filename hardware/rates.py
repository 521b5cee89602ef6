"""How long work takes to whatever stands still or is slow for a while."""

from __future__ import annotations

import math
from collections.abc import Iterable

from hardware.process.faults import Fault, Kind

Stretches = list[tuple[float, float, float]]  # of one piece of work: begin and end, s, and the share of its usual rate
STILL = (Kind.STALL, Kind.HANG, Kind.KILL)


class Rates:
    """How fast work is done by what stands still or is slow for a while: the arm's controller, or the tracking."""

    def __init__(self, faults: Iterable[Fault]) -> None:
        """faults: of one part."""
        self._faults = [fault for fault in faults if fault.kind in (*STILL, Kind.SLOW)]
        self._edges = sorted({edge for fault in self._faults for edge in (fault.start, fault.end)} | {math.inf})

    def stretches(self, start: float, work: float, moving: bool = True) -> Stretches:
        """Work of `work` s at the usual rate, begun at `start`: stretches, each its begin, end and share of that rate.

        A stall stops pauses too; being slow, like a feed override, changes moves only.
        """
        stretches: Stretches = []
        for edge in (edge for edge in self._edges if edge > start):
            rate = self._rate(start, moving)
            end = min(edge, start + work / rate) if rate else edge
            stretches.append((start, end, rate))
            if end < edge:
                break
            work, start = max(work - rate * (end - start), 0.0), edge
        return stretches

    def done(self, start: float, work: float) -> float:
        """When work of `work` s, begun at `start`, s, is done; infinite where it never is."""
        return self.stretches(start, work)[-1][1]

    def _rate(self, instant: float, moving: bool) -> float:
        rate = 1.0
        for fault in self._faults:
            if fault.covers(instant) and (moving or fault.kind in STILL):
                rate *= 0.0 if fault.kind in STILL else fault.share
        return rate
