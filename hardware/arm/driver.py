"""The seam between stillbed and an arm: what a driver must do, and its vocabulary.

Above it stand guard, flow control, own moves, retries of a stop and the recovery of an arm that does not follow
(`hardware/arm/link.py`), the same for any arm. Below it stands what one make of arm needs: its bytes, its library, its
process. Limits, tick, lag, dead time, horizon in flight and frame of an arm come from its arm file
(`hardware/arm/profile.py`), never from its driver. docs/drivers.md says how to write one.

Axes are X Y Z A B C of the arm's frame, mm and rad. Instants are s of our clock.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import Protocol

import numpy as np

from estimation.errors import InputError, StillbedError
from estimation.se3 import Array


class UnpluggedError(StillbedError):
    """The device is not there, or not any more."""


@dataclass(frozen=True, slots=True, eq=False)
class G1:
    """Move in a straight line."""

    axes: Array  # (6,) X Y Z A B C, mm and rad
    feed: float  # mm/s; degrees/s of a move that only turns
    material: bool = False  # whether it is to flow; says nothing in a dialect without pwm_on
    volume: float = 0.0  # mm^3 that are to leave meanwhile, for an arm with an `Extruder`; no frame holds it


@dataclass(frozen=True, slots=True)
class G4:
    """Pause all for `duration` s."""

    duration: float


@dataclass(frozen=True, slots=True, eq=False)
class G54:
    """Make `origin` (3,), mm, the place that is called (0, 0, 0)."""

    origin: Array


@dataclass(frozen=True, slots=True)
class Pause:
    """Stop at once; what no queued G4 can do."""


class ReplyKind(IntEnum):
    """Which three numbers a reply holds; the value is byte 7 of the S6H4D's. Its 4 and 5 are not used."""

    PLACE = 0  # X Y Z
    TOOL = 1  # A B C, of the S6H4D J4 J5 J6
    ARM = 2  # J1 J2 J3
    ORIGIN = 3  # X Y Z of the work origin


@dataclass(frozen=True, slots=True, eq=False)
class Reply:
    """One answer."""

    kind: ReplyKind
    values: Array  # (3,) mm, or rad of TOOL and ARM


@dataclass(frozen=True, slots=True, eq=False)
class Sent:
    """What has just gone out, of all that was given to a driver."""

    instruction: G1 | G4 | G54 | Pause | None  # complete now, as the arm reads it, machine axes; None: part of one
    share: float = 1.0  # of the arm's dead time that passes from now on; less, where a part went out before


@dataclass(frozen=True, slots=True, eq=False)
class Reported:
    """What an arm has said since it was last asked."""

    stamp: float  # s, when the arm was there, not when it was read
    replies: Sequence[Reply] = ()  # where it is; PLACE and TOOL of one instant, in any order
    strays: bytes = b""  # what came and is no answer
    fault: str = ""  # why it has stopped by itself and takes no moves, for a person; "" where it has not
    busy: bool = False  # whether it makes a move of its own, such as `home`


class ArmDriver(Protocol):
    """One arm. Methods with a body have a default, which a driver that derives from this class may keep.

    No method waits, reads a clock, or sends what it was not given; each may raise UnpluggedError where the arm is gone.
    """

    origin: Array = np.zeros(3)  # (3,) mm in machine axes, from which the arm's controller counts; see `set_origin`

    def connect(self, now: float) -> None:
        """Open the line at `now`, s; nothing moves. UnpluggedError: not there; InputError: another program has it."""
        ...

    def state(self, now: float) -> Reported:
        """What the arm has said since the last call, places and angles in machine axes; called every few ms."""
        ...

    def send(self, instruction: G1 | G4, now: float) -> Sequence[Sent]:
        """Give out the command of the next tick; what of all that was given has now gone out, as the arm reads it.

        An arm goes straight from where the last command ends, at its feed, and rests at the end until the next comes.
        """
        ...

    def stop(self, now: float) -> Sequence[Sent]:
        """Bring the arm to rest at once, ahead of all that is queued, and forget what is queued; called again freely.

        What it returns holds a Pause once the stop is out. A driver's arm also comes to rest, by itself, where this
        process dies or says nothing: within the commands that it has, or by a watchdog of its own.
        """
        ...

    def close(self) -> None:
        """Let the arm go; it is sent nothing. `connect` may follow."""
        ...

    def release(self) -> None:
        """Let other programs have it, for good."""
        return

    def enable(self, now: float) -> str:
        """An operator lets the arm move again: clear what has stopped it. Why that cannot be, "" where it can."""
        return ""

    def home(self, now: float) -> bool:
        """Begin the arm's own way of finding its place, `busy` until it is done; False: it has none."""
        return False

    def set_origin(self, origin: Array, now: float) -> Sequence[Sent]:
        """Have the controller count from `origin` (3,), mm, machine axes; axes of this class stay machine axes."""
        raise InputError("arm", "origin", origin.tolist(), "none: this arm's controller counts in machine axes alone")

    def flush(self, now: float) -> Sequence[Sent]:
        """Give out what waits; called every few ms. Nothing waits of a line that takes all at once."""
        return ()

    def recall(self) -> None:
        """Take back what was given and of which nothing is out."""
        return

    def blocked_for(self, now: float) -> float | None:
        """For how many s the line has taken nothing while something waits; None where nothing waits."""
        return None

    def waiting(self) -> float:
        """Bytes that the system has taken and the line not yet, as far as it tells."""
        return 0.0


ByteListener = Callable[[bytes, bool], None]  # (bytes, whether they were sent rather than received)
