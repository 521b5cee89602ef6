"""What the planner decides each tick: move there, or hold and say why."""

from __future__ import annotations

from dataclasses import dataclass

from estimation.se3 import Array

TURNING = 1e-3  # mm: a shorter move only turns; the arm gets its axes as binary32, good to 6e-5 mm at 1 m


@dataclass(frozen=True, slots=True, eq=False)
class Move:
    """Go to the machine axes [X Y Z A B C] (6,), mm and rad, at `feed` mm/s; on the way to `checkpoint`. stamp: s.

    Of a move that only turns, by no more than TURNING along X Y Z, `feed` is in degrees/s, as controllers of arms read
    it.
    """

    stamp: float
    axes: Array
    feed: float
    checkpoint: int
    extrude: bool


@dataclass(frozen=True, slots=True)
class Hold:
    """Stay where you are for `duration` s, because of `reason`. stamp: s."""

    stamp: float
    duration: float
    reason: str


Command = Move | Hold
