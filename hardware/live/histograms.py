"""How long each stage takes: a histogram each, so that a run of any length costs the same memory."""

from __future__ import annotations

import numpy as np

from hardware.lateness import BIN, Lateness
from hardware.live.records import LatencyEntry, Span


class Histograms:
    """Times by stage, s."""

    def __init__(self) -> None:
        self._stages: dict[str, Lateness] = {}

    def add(self, stage: str, seconds: float) -> None:
        """A stage took so long."""
        self._stages.setdefault(stage, Lateness()).add(seconds)

    def spans(self) -> tuple[Span, ...]:
        """Each stage in a line."""
        return tuple(
            Span(name, h.count, h.percentile(50), h.percentile(99), h.most) for name, h in self._stages.items()
        )

    def entries(self, stamp: float) -> list[LatencyEntry]:
        """The histograms themselves, for a recording, at `stamp`, s."""
        return [
            LatencyEntry(stamp, name, BIN, np.array(h.counts, np.int64), h.most) for name, h in self._stages.items()
        ]
