"""The virtual arm's serial line in virtual time: bytes on the wire, frames lost on the way in, and telemetry.

What each fault means stands in hardware/process/faults.py. Without a duration a drop or garble takes one frame, the
first one from its start on; with one, every frame that begins meanwhile.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Sequence

import numpy as np

from estimation.errors import InputError
from estimation.se3 import Array
from hardware.arm.profile import BITS_PER_BYTE
from hardware.arm.protocol import FRAME_LENGTH, Reply, ReplyKind, encode_reply
from hardware.process.faults import Fault, FaultKind, FaultPart, faults_striking
from hardware.simulator.arm.settings import ArmSettings, ReplyMode


class SerialWire:
    """One direction of a line; remembers until when it is busy. baud: bits/s, infinite for a line without delay."""

    def __init__(self, baud: float) -> None:
        if not baud > 0:
            raise InputError("wire", "baud", baud, "> 0 bits/s")
        self._byte_time = BITS_PER_BYTE / baud
        self.free = -math.inf  # s, when the last byte sent so far has arrived; -inf before the first

    def send(self, data: bytes, now: float) -> Array:
        """Instants (N,), s, at which the bytes handed over at `now` have arrived; they wait for those before them."""
        arrivals = max(self.free, now) + self._byte_time * np.arange(1, len(data) + 1)
        if len(arrivals):
            self.free = float(arrivals[-1])
        return np.asarray(arrivals)


def unplugged(faults: Sequence[Fault], instant: float) -> bool:
    """Whether the line is cut at `instant`, s."""
    return any(fault.covers(instant) for fault in faults_striking(faults, FaultPart.ARM, FaultKind.UNPLUG))


class FaultyLine:
    """The line into the arm. Frames are told apart by counting 48 bytes each from the first byte on.

    struck: instants, s, at which a frame began that was lost or garbled.
    """

    def __init__(self, faults: Sequence[Fault], rng: np.random.Generator) -> None:
        self._faults, self._rng = list(faults), rng
        self._place = 0
        self._mask: bytes | None = bytes(FRAME_LENGTH)  # bits of this frame that flip; None where it is lost
        self.struck: list[float] = []

    def __call__(self, data: bytes, now: float) -> bytes:
        """What arrives of `data`, which comes at `now`, s."""
        arrived = bytearray()
        while data:
            if self._place == 0:
                self._begin(now)
            part, data = data[: FRAME_LENGTH - self._place], data[FRAME_LENGTH - self._place :]
            if self._mask is not None:
                arrived += bytes(a ^ b for a, b in zip(part, self._mask[self._place :], strict=False))
            self._place = (self._place + len(part)) % FRAME_LENGTH
        return b"" if unplugged(self._faults, now) else bytes(arrived)

    def _begin(self, now: float) -> None:
        self._mask = bytes(FRAME_LENGTH)
        for fault in faults_striking(self._faults, FaultPart.ARM, FaultKind.DROP, FaultKind.GARBLE):
            once = fault.duration == 0
            if not (now >= fault.start if once else fault.covers(now)):
                continue
            if once:
                self._faults.remove(fault)
            if fault.kind is FaultKind.DROP or self._mask is None:
                self._mask = None
            else:
                bits = np.zeros(8 * FRAME_LENGTH, np.uint8)
                bits[self._rng.choice(len(bits), self._rng.integers(1, 9), replace=False)] = 1
                self._mask = np.packbits(bits).tobytes()
            self.struck.append(now)


class Telemetry:
    """Bytes on their way to the host.

    A stream begins one period after the start and gives place, tool and arm angles each period, as long as the line is
    free. The place is what a G1 would name, that is, from the work origin. J1 J2 J3 are sent as 0: they would need
    the arm's geometry.
    """

    def __init__(self, settings: ArmSettings, baud: float, faults: Sequence[Fault]) -> None:
        self._mode, self._period = settings.replies, settings.reply_period
        self._faults, self._wire = faults, SerialWire(baud)
        self._rng = np.random.default_rng([settings.seed, 0])
        self._under_way: deque[tuple[float, int]] = deque()  # when each byte arrives
        self._count, self._next, self._stray = 0, 0.0, 0
        self._schedule()

    def advance(self, now: float, axes_at: Callable[[Array], Array], origin: Array) -> None:
        """Send what is due up to `now`, s. axes_at: the executed axes (N, 6) at instants (N,). origin: (3,) mm."""
        due: list[float] = []
        replies: list[bytes] = []
        while self._mode is not ReplyMode.OFF and self._next <= now:
            due.append(self._next)
            replies.append(bytes([self._stray]))
            self._schedule()
        if due and self._mode is ReplyMode.STREAM:
            kinds = ReplyKind.PLACE, ReplyKind.TOOL, ReplyKind.ARM
            replies = []
            for axes in axes_at(np.array(due)):
                values = zip(kinds, (axes[:3] - origin, axes[3:], np.zeros(3)), strict=True)
                replies.append(b"".join(encode_reply(Reply(*each)) for each in values))
        for instant, data in zip(due, replies, strict=True):
            if self._wire.free <= instant and not unplugged(self._faults, instant):
                self._under_way.extend(zip(self._wire.send(data, instant).tolist(), data, strict=True))

    def take(self, now: float) -> bytes:
        """The bytes that have reached the host by `now` and were not taken before."""
        arrived = bytearray()
        while self._under_way and self._under_way[0][0] <= now:
            arrived.append(self._under_way.popleft()[1])
        return bytes(arrived)

    def _schedule(self) -> None:
        self._count += 1
        if self._mode is ReplyMode.STREAM:
            self._next = self._count * self._period
        elif self._mode is ReplyMode.STRAY:
            self._next += self._rng.exponential(self._period)
            self._stray = int(self._rng.integers(256))
