"""The driver of the SEED S6H4D, and of any arm that speaks its protocol: frames of 48 bytes through a serial port.

`SerialDriver` is what drivers of arms on a serial line share.

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
    ArmDriver,
    ByteListener,
    Pause,
    Reply,
    ReplyKind,
    Reported,
    Sent,
)
from hardware.arm.port import Opener, Port, PortOpener, serial_ports, write_last
from hardware.arm.profile import BITS_PER_BYTE, ArmProfile
from hardware.arm.protocol import FRAME_LENGTH, REPLY_LENGTH, encode, reply_stream

STOP_FRAMES = 2  # the first one may complete a frame that was torn when the process died


class SerialDriver(ArmDriver):
    """An arm on a serial line. port: that is open; None before `connect` and after `close`."""

    def __init__(self, opener: Opener, listener: ByteListener | None = None) -> None:
        """opener: opens the device, and opens it again after it was away. listener: is told all bytes that pass."""
        self.opener, self._listener = opener, listener
        self.port: Port | None = None
        self._reset()

    def _reset(self) -> None:
        """Forget what was given and what has come."""
        raise NotImplementedError

    def connect(self, now: float) -> None:
        """Open the port."""
        port = self.opener()
        self.port = port if self._listener is None else _LoggedPort(port, self._listener)

    def close(self) -> None:
        """Close the port; what waits is dropped."""
        if self.port is not None:
            self.port.close()
        self.port = None
        self._reset()

    def release(self) -> None:
        """Let the device's lock go, where its opener holds one."""
        if isinstance(self.opener, PortOpener):
            self.opener.release()

    def waiting(self) -> float:
        """Bytes in the system's output buffer."""
        return 0.0 if self.port is None else self.port.waiting()


class _LoggedPort:
    """A port whose listener is called with all bytes that pass."""

    def __init__(self, port: Port, listener: ByteListener) -> None:
        self._port, self._listener = port, listener
        self.waiting, self.close = port.waiting, port.close

    def write(self, data: bytes) -> int:
        count = self._port.write(data)
        if count:
            self._listener(data[:count], True)
        return count

    def read(self) -> bytes:
        data = self._port.read()
        if data:
            self._listener(data, False)
        return data


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
        self._written_bytes = 0  # bytes of the first frame that went out
        self._wait_start = 0.0  # s, when the first frame was to go
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
            self._wait_start = now
        self._frames.append((frame, instruction))
        return self.flush(now)

    def flush(self, now: float) -> Sequence[Sent]:
        """Write what the port takes."""
        assert self.port is not None
        sent: list[Sent] = []
        share = 0.0
        while self._frames:
            frame, instruction = self._frames[0]
            written = self.port.write(frame[self._written_bytes :])
            self._written_bytes += written
            share += written / FRAME_LENGTH
            if self._written_bytes == FRAME_LENGTH:
                self._frames.popleft()
                self._written_bytes, self._wait_start = 0, now
                sent.append(Sent(instruction, share))
                share = 0.0
            elif not written:
                break
        return [*sent, Sent(None, share)] if share else sent

    def recall(self) -> None:
        """Take back the frames of which no byte is gone."""
        while len(self._frames) > (1 if self._written_bytes else 0):
            self._frames.pop()

    def blocked_for(self, now: float) -> float | None:
        """Seconds that the first frame has waited."""
        return now - self._wait_start if self._frames else None


def open_arm(address: str, profile: ArmProfile, listener: ByteListener | None = None) -> S6H4D:
    """The arm on a device's path or a URL of pyserial's."""
    return S6H4D(PortOpener(address, profile.baud), profile, listener)


def find_arms() -> list[tuple[str, str]]:
    """The serial ports that the system shows: an arm may hang on each."""
    return serial_ports()


def emergency_stop(address: str, profile: ArmProfile) -> tuple[float, str]:
    """Stop it with the pause frame: when that was on the wire, s, and why it was not."""
    return write_last(address, profile.baud, encode(Pause(), profile.dialect) * STOP_FRAMES, profile.frame_time)
