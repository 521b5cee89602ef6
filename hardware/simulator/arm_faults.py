"""What can go wrong with arm and line, by name: "stall 600ms", "drop", "garble", "unplug", "slow 80%".

stall TIME   the controller does nothing for so long; what comes in is queued
slow SHARE   moves go at this share of their feed
unplug       nothing goes in or out
drop         a frame is lost on the line
garble       one to eight bits of a frame flip on the line

Each may say "at 5s" (else it begins at 0 s), and all but stall "for 2s". Without that slow and unplug never end, and
drop and garble take one frame, the first one from then on; with it, every frame that begins meanwhile.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum

import numpy as np

from estimation.errors import InputError
from hardware import checks
from hardware.protocol import LENGTH

SPELLING = 'such as "stall 600ms", "slow 80%", "drop", "garble" or "unplug", then "at 5s", "for 2s" or both'
_BITS = 8 * LENGTH


class FaultKind(Enum):
    """The name of a fault."""

    STALL = "stall"
    SLOW = "slow"
    UNPLUG = "unplug"
    DROP = "drop"
    GARBLE = "garble"


_ONCE = (FaultKind.DROP, FaultKind.GARBLE)


@dataclass(frozen=True, slots=True)
class ArmFault:
    """One fault. start: s. duration: s; 0 of a drop or garble means one frame. share: of the feed, where it is slow."""

    kind: FaultKind
    start: float
    duration: float
    share: float = 1.0

    @property
    def end(self) -> float:
        """Instant at which it is over, s."""
        return self.start + self.duration

    def covers(self, instant: float) -> bool:
        """Whether it goes on at `instant`, s."""
        return self.start <= instant < self.end


def fault_from_text(where: object, key: str, text: object) -> ArmFault:
    """The fault that a text names; InputError with `where` and `key` for one that none does."""
    words = text.split() if isinstance(text, str) else []
    if not words:
        raise InputError(where, key, text, SPELLING)
    kinds = {kind.value: kind for kind in FaultKind}
    if words[0] not in kinds:
        raise InputError(where, key, text, f"{SPELLING}; the first word {checks.meant(words[0], kinds)}")
    kind, rest = kinds[words[0]], words[1:]
    amount = rest.pop(0) if kind in (FaultKind.STALL, FaultKind.SLOW) and rest else ""
    times = dict(zip(rest[::2], map(_seconds, rest[1::2]), strict=False))
    if len(rest) != 2 * len(times) or not set(times) <= {"at", "for"} or None in times.values():
        raise InputError(where, key, text, SPELLING)
    start, duration = times.get("at") or 0.0, times.get("for", 0.0 if kind in _ONCE else math.inf)
    share = 1.0
    if kind is FaultKind.STALL:
        duration = _seconds(amount) if "for" not in times else None
    if kind is FaultKind.SLOW:
        share = _share(amount)
    if duration is None or not (duration > 0 or ("for" not in times and kind in _ONCE)) or not 0 < share <= 1:
        raise InputError(where, key, text, f"{SPELLING}; times above 0, a share above 0 and up to 100%")
    return ArmFault(kind, start, duration, share)


def _seconds(text: str) -> float | None:
    found = re.fullmatch(r"(\d+(?:\.\d+)?)(ms|s)", text)
    return float(found[1]) * (0.001 if found[2] == "ms" else 1.0) if found else None


def _share(text: str) -> float:
    """A share such as "80%"; NaN where it is none."""
    found = re.fullmatch(r"(\d+(?:\.\d+)?)%", text)
    return float(found[1]) / 100 if found else math.nan


def unplugged(faults: Sequence[ArmFault], instant: float) -> bool:
    """Whether the line is cut at `instant`, s."""
    return any(fault.kind is FaultKind.UNPLUG and fault.covers(instant) for fault in faults)


Stretches = list[tuple[float, float, float]]  # of one command: begin and end, s, and the share of its usual rate


class Rates:
    """How fast queued work is done while the controller stalls or is slow."""

    def __init__(self, faults: Sequence[ArmFault]) -> None:
        self._faults = [fault for fault in faults if fault.kind in (FaultKind.STALL, FaultKind.SLOW)]
        self._edges = sorted({edge for fault in self._faults for edge in (fault.start, fault.end)} | {math.inf})

    def stretches(self, start: float, work: float, moving: bool) -> Stretches:
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

    def _rate(self, instant: float, moving: bool) -> float:
        rate = 1.0
        for fault in self._faults:
            if fault.covers(instant) and (moving or fault.kind is FaultKind.STALL):
                rate *= 0.0 if fault.kind is FaultKind.STALL else fault.share
        return rate


class FaultyLine:
    """The line into the arm. Frames are told apart by counting 48 bytes each from the first byte on.

    struck: instants, s, at which a frame began that was lost or garbled.
    """

    def __init__(self, faults: Sequence[ArmFault], rng: np.random.Generator) -> None:
        self._faults, self._rng = list(faults), rng
        self._place = 0
        self._mask: bytes | None = bytes(LENGTH)  # bits of this frame that flip; None where it is lost
        self.struck: list[float] = []

    def __call__(self, data: bytes, now: float) -> bytes:
        """What arrives of `data`, which comes at `now`, s."""
        arrived = bytearray()
        while data:
            if self._place == 0:
                self._begin(now)
            part, data = data[: LENGTH - self._place], data[LENGTH - self._place :]
            if self._mask is not None:
                arrived += bytes(a ^ b for a, b in zip(part, self._mask[self._place :], strict=False))
            self._place = (self._place + len(part)) % LENGTH
        return b"" if unplugged(self._faults, now) else bytes(arrived)

    def _begin(self, now: float) -> None:
        """What happens to the frame that begins at `now`."""
        self._mask = bytes(LENGTH)
        for fault in [f for f in self._faults if f.kind in _ONCE]:
            once = fault.duration == 0
            if not (now >= fault.start if once else fault.covers(now)):
                continue
            if once:
                self._faults.remove(fault)
            self._mask = None if fault.kind is FaultKind.DROP or self._mask is None else self._flips()
            self.struck.append(now)

    def _flips(self) -> bytes:
        bits = np.zeros(_BITS, np.uint8)
        bits[self._rng.choice(_BITS, self._rng.integers(1, 9), replace=False)] = 1
        return np.packbits(bits).tobytes()
