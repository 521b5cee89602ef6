"""What the link says of the arm: its state, and the record that a console or a log is given."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from math import degrees

from estimation.se3 import Array


class ArmState(Enum):
    """Whether the arm may be moved. Only an operator's word leads to ARMED."""

    DISARMED = "disarmed"  # connected, and listened to; nothing is sent
    ARMED = "armed"  # moves are sent
    STOPPED = "stopped"  # a stop was asked for, or a fault made one; nothing is sent until it is armed again
    UNPLUGGED = "unplugged"  # the device is gone; it is looked for, and disarmed when it is back


@dataclass(frozen=True, slots=True, eq=False)
class ArmStatus:
    """The arm at one instant.

    stamp: s. reason: why the state is what it is. axes: (6,) mm and rad, where it is by dead reckoning, None where
    nobody said where it stood. answered: (6,) what it last answered, None without. off: mm that it answers from beside
    its way. lag: s, measured, from set-point to answer, NaN until known. answer_rate: Hz, NaN without. in_flight: s of
    motion under way, in `queued` commands. frames: sent. answers: taken. strays: bytes that belong to no answer.
    """

    stamp: float
    state: ArmState
    reason: str
    axes: Array | None
    answered: Array | None
    off: float
    lag: float
    answer_rate: float
    in_flight: float
    queued: int
    frames: int
    answers: int
    strays: int


@dataclass(frozen=True, slots=True)
class ArmEvent:
    """Something that a person should be able to read afterwards. stamp: s."""

    stamp: float
    text: str


def told(axes: Array) -> str:
    """Axes (6,), mm and rad, for a person: mm and degrees."""
    return ", ".join([*(f"{v:.1f}" for v in axes[:3]), *(f"{degrees(v):.2f}" for v in axes[3:])])
