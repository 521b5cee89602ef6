"""The arm's wire: motion and control frames of 48 bytes out, answers of 9 bytes in. Degrees and mm/min exist only here.

G1, G4 and G54 are from thesis Table 6.1, control frames and answers from public drivers of the arm. Floats are IEEE 754
binary32, little-endian; there is no checksum. `decode` accepts only frames that `encode` can make: for each of them,
encode(decode(frame)) == frame.

An answer holds three numbers: byte 0 is 0xCE, 1 to 6 are three int16, big-endian, 7 is the kind, 8 is 0xCF. Places
count tenths of a millimetre, angles hundredths of a degree. The thesis knows only stray single bytes (6.2), so the
reader returns those as well. `decode_reply` accepts only answers that `encode_reply` can make.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Generic, TypeVar

import numpy as np

from estimation.errors import InputError
from hardware.arm.driver import G1, G4, G54, Pause, Reply, ReplyKind
from planning.command import Command, Move

FRAME_LENGTH = 48
_G1 = struct.Struct("<BcB6ff12xfB")  # X Y Z, three angles, pwm, reserved, feed
_G4 = struct.Struct("<BcBf40xB")  # pause
_G54 = struct.Struct("<BBB3f32xB")  # X Y Z
_SINGLE = struct.Struct("<f")
_MOTION, _MOTION_END, _SYSTEM, _SYSTEM_END = 238, 239, 252, 253
_MOVE, _WAIT = ord("1"), ord("6")  # byte 1 of a motion frame
FRAME_TAILS = {_MOTION: _MOTION_END, _SYSTEM: _SYSTEM_END}  # last byte of a frame by its first

MAX_PWM = 20_000.0  # ten times a hobby servo's pulse in microseconds
ANGLE_JOINTS = ("J4", "J5", "J6")  # the machine axes A B C


@dataclass(frozen=True, slots=True)
class Dialect:
    """Where thesis and public drivers of the arm do not agree."""

    motion_byte: int = 1  # byte 2 of a G1 frame; 1 in the thesis and one driver, 0 in another
    slots: tuple[str, str, str] = ANGLE_JOINTS  # the three angles; J5 first in the thesis's appendix and both drivers
    origin_scale: int = 1  # what a G54 frame multiplies mm by; 1 in the thesis, 10 in a driver
    pwm: float = 0.0  # after the angles of a G1 frame, its use not known; 0 in thesis and one driver, 1500 in another
    pwm_on: float | None = None  # there instead while material is to flow, where that switches a dispenser

    def __post_init__(self) -> None:
        if self.motion_byte not in (0, 1):
            raise InputError("dialect", "motion_byte", self.motion_byte, "0 or 1")
        if sorted(self.slots) != list(ANGLE_JOINTS):
            raise InputError("dialect", "slots", self.slots, "J4, J5 and J6, each once")
        if self.origin_scale not in (1, 10):
            raise InputError("dialect", "origin_scale", self.origin_scale, "1 or 10")
        if self.pwm_on is None and self.pwm not in (0, 1500):
            raise InputError("dialect", "pwm", self.pwm, "0 or 1500")
        for name, value in (("pwm", self.pwm), ("pwm_on", self.pwm if self.pwm_on is None else self.pwm_on)):
            if not 0 <= value <= MAX_PWM:
                raise InputError("dialect", name, value, f"0 to {MAX_PWM:g}")
        if self.pwm_on == self.pwm:
            raise InputError("dialect", "pwm_on", self.pwm_on, "another number than pwm, which is off")


THESIS_DIALECT = Dialect()


@dataclass(frozen=True, slots=True)
class Reset:
    """Forget what is queued."""


@dataclass(frozen=True, slots=True)
class ControllerReset:
    """Begin as at power-on."""


@dataclass(frozen=True, slots=True)
class Mode:
    """Change to a mode."""

    mode: int  # 0 or 9; what these are, the public driver that sends them does not say


Instruction = G1 | G4 | G54 | Pause | Reset | ControllerReset | Mode


def _control(*code: int) -> bytes:
    return bytes([_SYSTEM, *code]).ljust(FRAME_LENGTH - 1, b"\0") + bytes([_SYSTEM_END])


_FRAMES: dict[Instruction, bytes] = {  # of what has no numbers
    Pause(): _control(30, 3, 2),
    Reset(): _control(12, 3),
    ControllerReset(): _control(12, 6, 0),
    Mode(0): _control(30, 9, 0),
    Mode(9): _control(30, 9, 9),
}
_CONTROLS = {frame: instruction for instruction, frame in _FRAMES.items()}


def encode(instruction: Instruction, dialect: Dialect = THESIS_DIALECT) -> bytes:
    """The frame of an instruction; InputError for what no frame can hold: not finite, too large, feed or pause <= 0."""
    if isinstance(instruction, G1):
        angles = dict(zip(ANGLE_JOINTS, np.rad2deg(instruction.axes[3:]), strict=True))
        turns = (angles[joint] for joint in dialect.slots)
        pwm = dialect.pwm if dialect.pwm_on is None or not instruction.material else dialect.pwm_on
        body = _singles([*instruction.axes[:3], *turns, pwm, instruction.feed * 60], "G1")
        if not body[7] > 0:
            raise InputError("G1", "feed", body[7], "> 0 mm/min")
        return _G1.pack(_MOTION, b"1", dialect.motion_byte, *body, _MOTION_END)
    if isinstance(instruction, G4):
        body = _singles([instruction.duration * 1000], "G4")
        if not body[0] > 0:
            raise InputError("G4", "pause", body[0], "> 0 ms")
        return _G4.pack(_MOTION, b"6", 0, *body, _MOTION_END)
    if isinstance(instruction, G54):
        body = _singles([number * dialect.origin_scale for number in instruction.origin], "G54")
        return _G54.pack(_SYSTEM, 20, 1, *body, _SYSTEM_END)
    if instruction not in _FRAMES:
        raise InputError("frame", "instruction", instruction, "a mode of 0 or 9")
    return _FRAMES[instruction]


def frame_from_command(command: Command, dialect: Dialect = THESIS_DIALECT) -> bytes:
    """The frame of a command, G1 of a move and G4 of a hold; InputError as `encode`."""
    if isinstance(command, Move):
        return encode(G1(command.axes, command.feed, command.flow > 0), dialect)
    return encode(G4(command.duration), dialect)


def motion_from_frame(frame: bytes, dialect: Dialect = THESIS_DIALECT) -> G1 | G4:
    """What the arm reads in a frame of `frame_from_command`: the command rounded to binary32."""
    return _decode_move(frame, dialect) if frame[1] == _MOVE else _decode_pause(frame)


def decode(frame: bytes, dialect: Dialect = THESIS_DIALECT) -> Instruction:
    """The instruction in a frame; InputError where `encode` in this dialect cannot have made it."""
    if len(frame) != FRAME_LENGTH:
        raise InputError("frame", "length", len(frame), f"{FRAME_LENGTH} bytes")
    if frame in _CONTROLS:
        return _CONTROLS[frame]
    head, tail = frame[:3], frame[-1]
    if head == bytes([_MOTION, _MOVE, dialect.motion_byte]) and tail == _MOTION_END:
        instruction: Instruction = _decode_move(frame, dialect)
    elif head == bytes([_MOTION, _WAIT, 0]) and tail == _MOTION_END:
        instruction = _decode_pause(frame)
    elif head == bytes([_SYSTEM, 20, 1]) and tail == _SYSTEM_END:
        instruction = G54(np.array(_G54.unpack(frame)[3:6]) / dialect.origin_scale)
    else:
        raise InputError("frame", "header, code and tail", [*head, tail], "those of G1, G4, G54 or a control frame")
    if encode(instruction, dialect) != frame:
        raise InputError("frame", "reserved bytes", frame.hex(" "), "zeros, and the dialect's pwm")
    return instruction


def _decode_move(frame: bytes, dialect: Dialect) -> G1:
    fields = _G1.unpack(frame)
    angles = dict(zip(dialect.slots, fields[6:9], strict=True))
    axes = np.array([*fields[3:6], *np.deg2rad([angles[joint] for joint in ANGLE_JOINTS])])
    on = dialect.pwm_on
    return G1(axes, fields[10] / 60, on is not None and fields[9] == _SINGLE.unpack(_SINGLE.pack(on))[0])


def _decode_pause(frame: bytes) -> G4:
    return G4(_G4.unpack(frame)[3] / 1000)


def _singles(numbers: list[float], where: str) -> list[float]:
    """Numbers as binary32 holds them."""
    singles = []
    for number in numbers:
        try:
            single = _SINGLE.unpack(_SINGLE.pack(number))[0]
        except OverflowError:
            single = math.inf
        if not math.isfinite(single):
            raise InputError(where, "parameter", number, "a finite number that binary32 can hold")
        singles.append(single)
    return singles


Decoded = TypeVar("Decoded")


class FrameStream(Generic[Decoded]):
    """Finds the frames in a stream of bytes that comes in pieces, and finds the next one after bytes of no frame."""

    def __init__(self, length: int, tails: Mapping[int, int], decode: Callable[[bytes], Decoded]) -> None:
        """length: bytes of a frame. tails: its last byte by its first. decode: InputError for what is no frame."""
        self._length, self._tails, self._decode = length, tails, decode
        self._rest = b""

    def __call__(self, data: bytes) -> tuple[list[Decoded], bytes]:
        """The decoded frames that `data` completes, and the bytes that are now known to be in no frame."""
        rest, start = self._rest + data, 0
        decoded: list[Decoded] = []
        stray = bytearray()
        while start < len(rest):
            tail, end = self._tails.get(rest[start]), start + self._length
            if tail is not None and end > len(rest):
                break
            if tail is not None and rest[end - 1] == tail:
                try:
                    decoded.append(self._decode(rest[start:end]))
                except InputError:
                    pass  # looks like a frame and is none: the next one may begin inside it
                else:
                    start = end
                    continue
            stray.append(rest[start])
            start += 1
        self._rest = rest[start:]
        return decoded, bytes(stray)


REPLY_LENGTH = 9
_REPLY = struct.Struct(">B3hBB")
_REPLY_FIRST, _REPLY_LAST = 0xCE, 0xCF
REPLY_TAILS = {_REPLY_FIRST: _REPLY_LAST}
_MAX_COUNT = 32_767  # int16; its -32768 has no opposite and is not sent


def encode_reply(reply: Reply) -> bytes:
    """The 9 bytes of a reply, its numbers rounded to what they count in; InputError for one that does not fit."""
    counts = np.asarray(reply.values) / unit(reply.kind)
    if not (np.abs(counts) < _MAX_COUNT + 0.5).all():  # NaN too
        allowed = f"at most {_MAX_COUNT / 10:g} mm or {_MAX_COUNT / 100:g} degrees either way"
        raise InputError("reply", reply.kind.name.lower(), reply.values.tolist(), allowed)
    return _REPLY.pack(_REPLY_FIRST, *np.rint(counts).astype(int).tolist(), reply.kind, _REPLY_LAST)


def decode_reply(frame: bytes) -> Reply:
    """The reply in 9 bytes; InputError where `encode_reply` cannot have made them."""
    if len(frame) != REPLY_LENGTH:
        raise InputError("reply", "length", len(frame), f"{REPLY_LENGTH} bytes")
    head, *counts, kind, tail = _REPLY.unpack(frame)
    if (head, tail) != (_REPLY_FIRST, _REPLY_LAST):
        raise InputError("reply", "first and last byte", [head, tail], f"{_REPLY_FIRST} and {_REPLY_LAST}")
    if kind not in list(ReplyKind):
        raise InputError("reply", "kind", kind, "0 to 3")
    if min(counts) < -_MAX_COUNT:
        raise InputError("reply", "values", counts, f"-{_MAX_COUNT} to {_MAX_COUNT}")
    return Reply(ReplyKind(kind), np.array(counts) * unit(ReplyKind(kind)))


def reply_stream() -> FrameStream[Reply]:
    """A reader of what the arm sends: replies, and the stray bytes between them.

    A stray byte just before a reply never costs it: byte 8 would then be the reply's kind, which is no 0xCF.
    """
    return FrameStream(REPLY_LENGTH, REPLY_TAILS, decode_reply)


def unit(kind: ReplyKind) -> float:
    """One count of its values, mm or rad."""
    return 0.1 if kind in (ReplyKind.PLACE, ReplyKind.ORIGIN) else float(np.deg2rad(0.01))
