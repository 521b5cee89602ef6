"""What the virtual arm sends by itself: nothing, position replies, or stray single bytes."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence

import numpy as np

from estimation.se3 import Array
from hardware.process.faults import Fault
from hardware.replies import Reply, ReplyKind, encode_reply
from hardware.simulator.arm.settings import ArmSettings, Replies
from hardware.simulator.arm_faults import unplugged
from hardware.simulator.wire import Wire


class Answers:
    """Bytes on their way to the host.

    A stream begins one period after the start and gives place, tool and arm angles each period, as long as the line is
    free. The place is what a G1 would name, that is, from the work origin. J1 J2 J3 are sent as 0: they would need
    the arm's geometry.
    """

    def __init__(self, settings: ArmSettings, baud: float, faults: Sequence[Fault]) -> None:
        self._mode, self._period = settings.replies, settings.reply_period
        self._faults, self._wire = faults, Wire(baud)
        self._rng = np.random.default_rng([settings.seed, 0])
        self._under_way: deque[tuple[float, int]] = deque()  # when each byte arrives
        self._count, self._next, self._stray = 0, 0.0, 0
        self._schedule()

    def advance(self, now: float, axes_at: Callable[[Array], Array], origin: Array) -> None:
        """Send what is due up to `now`, s. axes_at: the executed axes (N, 6) at instants (N,). origin: (3,) mm."""
        due: list[float] = []
        words: list[bytes] = []
        while self._mode is not Replies.OFF and self._next <= now:
            due.append(self._next)
            words.append(bytes([self._stray]))
            self._schedule()
        if due and self._mode is Replies.STREAM:
            words = [_replies(axes, origin) for axes in axes_at(np.array(due))]
        for instant, data in zip(due, words, strict=True):
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
        if self._mode is Replies.STREAM:
            self._next = self._count * self._period
        elif self._mode is Replies.STRAY:
            self._next += self._rng.exponential(self._period)
            self._stray = int(self._rng.integers(256))


def _replies(axes: Array, origin: Array) -> bytes:
    numbers = (ReplyKind.PLACE, axes[:3] - origin), (ReplyKind.TOOL, axes[3:]), (ReplyKind.ARM, np.zeros(3))
    return b"".join(encode_reply(Reply(kind, values)) for kind, values in numbers)
