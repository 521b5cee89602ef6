"""The place on the path, where every process of a run can see it."""

from __future__ import annotations

from multiprocessing.sharedctypes import RawArray
from typing import Any


class Place:
    """How far the print is, in shared memory: outlives the process that prints.

    It is written before the command goes to the arm, so what it does not hold was not printed. fraction: counted in
    checkpoints, NaN before a path was begun.
    """

    def __init__(self) -> None:
        self._memory: Any = RawArray("d", [float("nan")])

    @property
    def fraction(self) -> float:
        """The place, counted in checkpoints."""
        return float(self._memory[0])

    @fraction.setter
    def fraction(self, value: float) -> None:
        self._memory[0] = value
