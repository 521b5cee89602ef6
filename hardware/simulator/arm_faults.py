"""What the line into the arm does to frames while a fault of the arm goes on: lose them, garble them, be cut.

What each fault means stands in hardware/faults.py. Without a duration a drop or garble takes one frame, the first one
from its start on; with one, every frame that begins meanwhile.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from hardware.arm.protocol import LENGTH
from hardware.process.faults import Fault, Kind, Part, struck

_BITS = 8 * LENGTH
_LOSING = (Kind.DROP, Kind.GARBLE)


def unplugged(faults: Sequence[Fault], instant: float) -> bool:
    """Whether the line is cut at `instant`, s."""
    return any(fault.covers(instant) for fault in struck(faults, Part.ARM, Kind.UNPLUG))


class FaultyLine:
    """The line into the arm. Frames are told apart by counting 48 bytes each from the first byte on.

    struck: instants, s, at which a frame began that was lost or garbled.
    """

    def __init__(self, faults: Sequence[Fault], rng: np.random.Generator) -> None:
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
        for fault in struck(self._faults, Part.ARM, *_LOSING):
            once = fault.duration == 0
            if not (now >= fault.start if once else fault.covers(now)):
                continue
            if once:
                self._faults.remove(fault)
            self._mask = None if fault.kind is Kind.DROP or self._mask is None else self._flips()
            self.struck.append(now)

    def _flips(self) -> bytes:
        bits = np.zeros(_BITS, np.uint8)
        bits[self._rng.choice(_BITS, self._rng.integers(1, 9), replace=False)] = 1
        return np.packbits(bits).tobytes()
