"""What an operator asks of the run, and the line in shared memory by which it comes.

Neither side ever waits: a full line refuses what comes, what leads towards rest has places that nothing else takes, and
a stop has one of its own that cannot be full. A page that is killed in the middle of a word leaves nothing behind that
the run would stumble over.
"""

from __future__ import annotations

import struct
from collections.abc import Collection
from ctypes import c_uint64
from dataclasses import dataclass
from enum import StrEnum
from multiprocessing.sharedctypes import RawArray
from typing import Any
from zlib import crc32


class Wish(StrEnum):
    """What can be asked for. A STOP is always followed; the others where the run offers them."""

    CONFIRM = "confirm"  # what is shown over the pictures is right
    AGAIN = "again"  # do this stage anew: check, or look for the wound
    START = "start"  # let the arm move: approach, then print
    PAUSE = "pause"  # hold above the surface, ready to go on
    RESUME = "resume"  # go on printing where it left off
    STOP = "stop"  # come to rest now
    HOME = "home"  # move the arm to its home
    END = "end"  # end the run, and write its report


ALWAYS = frozenset({Wish.STOP, Wish.PAUSE, Wish.END})  # lead towards rest: right whatever the asking window showed

SLOTS = 16  # requests that wait; the run takes them every few ms and a hand gives a few in a second
OTHERS = 8  # of them for what does not lead towards rest: a flood of such requests leaves room for a pause
_RECORD = struct.Struct("=QQBI")  # number, turn, wish, check sum
_LAST, _STOP, _WRITTEN, _TAKEN, _WINDOWS = range(5)  # last number given, last stop, records written and taken, windows
_WISHES = tuple(Wish)


@dataclass(frozen=True, slots=True)
class Request:
    """One wish. number: counts up over all windows. turn: that of the view which the operator saw when asking."""

    number: int
    wish: Wish
    turn: int


def refusal(wish: Wish, turn: int, offers: Collection[Wish], present: int) -> str:
    """Why a wish cannot be followed, "" if it can.

    turn: of the view it was asked under; present: of the newest view, which `offers` wishes. A window that shows an
    older turn may stop, pause or end, and nothing else: it cannot let a run go on that another window has stopped.
    """
    if wish is Wish.STOP:
        return ""
    if wish not in ALWAYS and turn != present:
        return "the run has changed since this was shown: look again, then ask again"
    return "" if wish in offers else f"{wish} cannot be done at this stage"


class RequestLine:
    """Handed to the page's process when that is started: the page asks, the run takes. One of each."""

    def __init__(self) -> None:
        self._counts: Any = RawArray(c_uint64, 5)  # each is written whole, or not at all
        self._records: Any = RawArray("B", SLOTS * _RECORD.size)
        self._stops_seen = 0

    def ask(self, wish: Wish, turn: int) -> int | None:
        """Number of the request; None where the line is full: for ALWAYS later than for others, for a stop never."""
        number = int(self._counts[_LAST]) + 1
        if wish is Wish.STOP:
            self._counts[_LAST] = number
            self._counts[_STOP] = number
            return number
        written = self._counts[_WRITTEN]
        if written - self._counts[_TAKEN] >= (SLOTS if wish in ALWAYS else OTHERS):
            return None
        body = (number, turn, _WISHES.index(wish))
        _RECORD.pack_into(self._records, _place(written), *body, _check(*body))
        self._counts[_LAST] = number
        self._counts[_WRITTEN] = written + 1
        return number

    def take(self) -> list[Request]:
        """What was asked for since the last call, in order; a stop stands alone, as what came with it is void."""
        waiting = list(self._waiting())
        stop = self._counts[_STOP]
        if stop != self._stops_seen:
            self._stops_seen = stop
            return [Request(stop, Wish.STOP, 0)]
        return waiting

    @property
    def last_stop(self) -> int:
        """Number of the last stop asked for, 0 before the first; any process that holds the line may watch it."""
        return int(self._counts[_STOP])

    @property
    def windows(self) -> int:
        """How many windows show the page; pictures for nobody need not be made."""
        return int(self._counts[_WINDOWS])

    @windows.setter
    def windows(self, count: int) -> None:
        self._counts[_WINDOWS] = count

    def _waiting(self) -> list[Request]:
        taken, written, found = self._counts[_TAKEN], self._counts[_WRITTEN], []
        while taken < written:
            number, turn, index, check = _RECORD.unpack_from(self._records, _place(taken))
            if check != _check(number, turn, index):
                break  # the count was seen before the record: the next look finds it whole
            found.append(Request(number, _WISHES[index], turn))
            taken += 1
        self._counts[_TAKEN] = taken
        return found


def _place(count: int) -> int:
    return (count % SLOTS) * _RECORD.size


def _check(number: int, turn: int, index: int) -> int:
    return crc32(struct.pack("=QQB", number, turn, index))
