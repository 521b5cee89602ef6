"""The line to the arm: whole frames out in the order given, whatever a write takes; answers and stray bytes in.

A frame of which the port took a part is always completed first: torn, it would take bytes of the next one with it. One
of which nothing went out yet may be called back.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable

from hardware.arm.port import Port
from hardware.arm.protocol import LENGTH
from hardware.replies import Reply, reply_stream

Sent = Callable[[float, float], None]  # (now, share of the frame that went just now, and not before)


class ArmLine:
    """Frames on their way out through one port."""

    def __init__(self, port: Port) -> None:
        self.port = port
        self._frames: deque[tuple[bytes, Sent]] = deque()
        self._done = 0  # bytes of the first frame that went out
        self._since = 0.0  # when the first frame was to go
        self._stream = reply_stream()

    @property
    def blocked(self) -> bool:
        """Whether frames wait because the port takes no more."""
        return bool(self._frames)

    def blocked_for(self, now: float) -> float:
        """Seconds that the first frame has waited."""
        return now - self._since if self._frames else 0.0

    def send(self, frame: bytes, sent: Sent, now: float) -> float:
        """Give out a frame behind those that wait; `sent` is told when its last byte is gone. Gives what flush does."""
        if not self._frames:
            self._since = now
        self._frames.append((frame, sent))
        return self.flush(now)

    def flush(self, now: float) -> float:
        """Write what the port takes; the share of a frame that went out of one that is not complete."""
        share = 0.0
        while self._frames:
            frame, sent = self._frames[0]
            taken = self.port.write(frame[self._done :])
            self._done += taken
            share += taken / LENGTH
            if self._done == LENGTH:
                self._frames.popleft()
                self._done, self._since = 0, now
                sent(now, share)
                share = 0.0
            elif not taken:
                break
        return share

    def recall(self) -> int:
        """Take back the frames of which no byte is gone; how many."""
        kept = 1 if self._done else 0
        count = len(self._frames) - kept
        for _ in range(count):
            self._frames.pop()
        return count

    def receive(self) -> tuple[list[Reply], bytes]:
        """Answers that have come, and the bytes known to be in none."""
        return self._stream(self.port.read())
