"""What is to happen when, in virtual time: the one order in which everything in the simulated world takes place."""

from __future__ import annotations

import heapq
from collections.abc import Callable, Iterator

Action = Callable[[float], None]  # told the instant, s

ARRIVAL, KNOWN, TICK, EXPOSURE = range(4)  # what goes first of what falls on one instant


class Agenda:
    """A queue of actions by instant; what falls on one instant goes by rank, then in the order in which it came."""

    def __init__(self) -> None:
        self._heap: list[tuple[float, int, int, Action]] = []
        self._count = 0

    def at(self, instant: float, rank: int, action: Action) -> None:
        """Do `action` at `instant`, s."""
        heapq.heappush(self._heap, (instant, rank, self._count, action))
        self._count += 1

    def run(self, until: Callable[[], float]) -> Iterator[float]:
        """Do everything due before `until()`, s, in order; gives each instant after what happened at it."""
        while self._heap and self._heap[0][0] < until():
            instant, _, _, action = heapq.heappop(self._heap)
            action(instant)
            yield instant
