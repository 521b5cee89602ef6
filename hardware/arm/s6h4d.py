"""The driver of the SEED S6H4D, and of any arm that speaks its protocol: frames of 48 bytes through a serial port.

A frame that is partly out is always completed first: torn, it would take bytes of the next one with it. A frame of
which no byte is out may be called back. Which bytes a frame has, `hardware/arm/protocol.py` says.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence

import numpy as np

from estimation.se3 import Array
from hardware.arm.driver import (
    G1,
    G4,
    G54,
    ByteListener,
    Pause,
    Reply,
    ReplyKind,
    Reported,
    Sent,
)
from hardware.arm.port import Opener, PortOpener, serial_ports, write_last
from hardware.arm.profile import BITS_PER_BYTE, ArmProfile
from hardware.arm.protocol import FRAME_LENGTH, REPLY_LENGTH, encode, reply_stream
from hardware.arm.serial_driver import SerialDriver

STOP_FRAMES = 2  # the first one may complete a frame that was torn when the process died


class S6H4D(SerialDriver):
    """Frames on their way out through one port, and answers in."""

    def __init__(self, opener: Opener, profile: ArmProfile, listener: ByteListener | None = None) -> None:
        """As SerialDriver's."""
        self._dialect = profile.dialect
        self._reply_time = REPLY_LENGTH * BITS_PER_BYTE / profile.baud  # s that an answer takes on the wire
        super().__init__(opener, listener)

    def _reset(self) -> None:
        self.origin = np.zeros(3)
        self._frames: deque[tuple[bytes, G1 | G4 | G54 | Pause]] = deque()
        self._done = 0  # bytes of the first frame that went out
        self._since = 0.0  # s, when the first frame was to go
        self._stream = reply_stream()

    def state(self, now: float) -> Reported:
        """Answers that have come, and the bytes known to be in none."""
        replies, strays = self.receive()
        if self.origin.any():  # the arm counts from its origin
            replies = [
                Reply(reply.kind, reply.values + self.origin) if reply.kind is ReplyKind.PLACE else reply
                for reply in replies
            ]
        return Reported(now - self._reply_time, replies, strays)

    def receive(self) -> tuple[list[Reply], bytes]:
        """Answers as the arm gives them, and stray bytes."""
        assert self.port is not None
        return self._stream(self.port.read())

    def send(self, instruction: G1 | G4, now: float) -> Sequence[Sent]:
        """Give out its frame behind those that wait."""
        shifted: G1 | G4 = instruction
        if isinstance(instruction, G1) and self.origin.any():
            axes = instruction.axes - np.concatenate([self.origin, np.zeros(3)])
            shifted = G1(axes, instruction.feed, instruction.material)
        return self._put(encode(shifted, self._dialect), instruction, now)

    def stop(self, now: float) -> Sequence[Sent]:
        """Give out the pause frame, behind the rest of a frame that is half out."""
        self.recall()
        return self._put(encode(Pause(), self._dialect), Pause(), now)

    def set_origin(self, origin: Array, now: float) -> Sequence[Sent]:
        """Give out G54; InputError for what no frame holds."""
        frame = G54(origin)
        sent = self._put(encode(frame, self._dialect), frame, now)
        self.origin = np.array(origin, float)
        return sent

    def _put(self, frame: bytes, instruction: G1 | G4 | G54 | Pause, now: float) -> Sequence[Sent]:
        if not self._frames:
            self._since = now
        self._frames.append((frame, instruction))
        return self.flush(now)

    def flush(self, now: float) -> Sequence[Sent]:
        """Write what the port takes."""
        assert self.port is not None
        sent: list[Sent] = []
        share = 0.0
        while self._frames:
            frame, instruction = self._frames[0]
            written = self.port.write(frame[self._done :])
            self._done += written
            share += written / FRAME_LENGTH
            if self._done == FRAME_LENGTH:
                self._frames.popleft()
                self._done, self._since = 0, now
                sent.append(Sent(instruction, share))
                share = 0.0
            elif not written:
                break
        return [*sent, Sent(None, share)] if share else sent

    def recall(self) -> None:
        """Take back the frames of which no byte is gone."""
        while len(self._frames) > (1 if self._done else 0):
            self._frames.pop()

    def blocked_for(self, now: float) -> float | None:
        """Seconds that the first frame has waited."""
        return now - self._since if self._frames else None


def open_arm(address: str, profile: ArmProfile, listener: ByteListener | None = None) -> S6H4D:
    """The arm on a device's path or a URL of pyserial's."""
    return S6H4D(PortOpener(address, profile.baud), profile, listener)


def find_arms() -> list[tuple[str, str]]:
    """The serial ports that the system shows: an arm may hang on each."""
    return serial_ports()


def emergency_stop(address: str, profile: ArmProfile) -> tuple[float, str]:
    """Stop it with the pause frame: when that was on the wire, s, and why it was not."""
    return write_last(address, profile.baud, encode(Pause(), profile.dialect) * STOP_FRAMES, profile.frame_time)
