"""The arm's wire: motion and control frames of 48 bytes. Degrees, mm/min and ms exist only here and in replies.py.

G1, G4 and G54 are of thesis Table 6.1, the control frames of public drivers of the arm. Floats are IEEE 754 binary32,
little-endian, as those drivers send them; there is no checksum. `decode` takes what `encode` can have made and refuses
all else: for every frame it takes, encode(decode(frame)) == frame.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

import numpy as np

from estimation.errors import InputError
from estimation.se3 import Array

LENGTH = 48
_G1 = struct.Struct("<BcB6ff12xfB")  # X Y Z, three angles, pwm, reserved, feed
_G4 = struct.Struct("<BcBf40xB")  # pause
_G54 = struct.Struct("<BBB3f32xB")  # X Y Z
_SINGLE = struct.Struct("<f")
_MOTION, _MOTION_END, _SYSTEM, _SYSTEM_END = 238, 239, 252, 253
TAILS = {_MOTION: _MOTION_END, _SYSTEM: _SYSTEM_END}  # last byte of a frame by its first

JOINTS = ("J4", "J5", "J6")  # the machine axes A B C


@dataclass(frozen=True, slots=True)
class Dialect:
    """What thesis and public drivers of the arm do not agree on.

    motion_byte: byte 2 of a G1 frame; 1 in the thesis and one driver, 0 in another. slots: which joint stands in each
    of the three angle slots; J4 J5 J6 in the thesis's table, J5 first in its appendix and in both drivers.
    origin_scale: what a G54 frame multiplies mm by; 1 in the thesis, 10 in a driver. pwm: the number after the angles
    of a G1 frame, whose use is not known; 0 in the thesis and one driver, 1500 in another.
    """

    motion_byte: int = 1
    slots: tuple[str, str, str] = JOINTS
    origin_scale: int = 1
    pwm: float = 0.0

    def __post_init__(self) -> None:
        if self.motion_byte not in (0, 1):
            raise InputError("dialect", "motion_byte", self.motion_byte, "0 or 1")
        if sorted(self.slots) != list(JOINTS):
            raise InputError("dialect", "slots", self.slots, "J4, J5 and J6, each once")
        if self.origin_scale not in (1, 10):
            raise InputError("dialect", "origin_scale", self.origin_scale, "1 or 10")
        if self.pwm not in (0, 1500):
            raise InputError("dialect", "pwm", self.pwm, "0 or 1500")


THESIS = Dialect()


@dataclass(frozen=True, slots=True, eq=False)
class G1:
    """Move in a straight line. axes: (6,) X Y Z A B C, mm and rad. feed: mm/s."""

    axes: Array
    feed: float


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


@dataclass(frozen=True, slots=True)
class Reset:
    """Forget what is queued."""


@dataclass(frozen=True, slots=True)
class ControllerReset:
    """Begin as at power-on."""


@dataclass(frozen=True, slots=True)
class Mode:
    """Change to `mode`, 0 or 9; what these are, the public driver that sends them does not say."""

    mode: int


Instruction = G1 | G4 | G54 | Pause | Reset | ControllerReset | Mode


def _control(*code: int) -> bytes:
    return bytes([_SYSTEM, *code]).ljust(LENGTH - 1, b"\0") + bytes([_SYSTEM_END])


_FRAMES: dict[Instruction, bytes] = {  # of what has no numbers
    Pause(): _control(30, 3, 2),
    Reset(): _control(12, 3),
    ControllerReset(): _control(12, 6, 0),
    Mode(0): _control(30, 9, 0),
    Mode(9): _control(30, 9, 9),
}
_CONTROLS = {frame: instruction for instruction, frame in _FRAMES.items()}


def encode(instruction: Instruction, dialect: Dialect = THESIS) -> bytes:
    """The frame of an instruction; InputError for what no frame can hold: not finite, too large, feed or pause <= 0."""
    if isinstance(instruction, G1):
        angles = dict(zip(JOINTS, np.rad2deg(instruction.axes[3:]), strict=True))
        turns = (angles[joint] for joint in dialect.slots)
        body = _singles([*instruction.axes[:3], *turns, dialect.pwm, instruction.feed * 60], "G1")
        _positive("G1", "feed", body[7], "mm/min")
        return _G1.pack(_MOTION, b"1", dialect.motion_byte, *body, _MOTION_END)
    if isinstance(instruction, G4):
        body = _singles([instruction.duration * 1000], "G4")
        _positive("G4", "pause", body[0], "ms")
        return _G4.pack(_MOTION, b"6", 0, *body, _MOTION_END)
    if isinstance(instruction, G54):
        body = _singles([number * dialect.origin_scale for number in instruction.origin], "G54")
        return _G54.pack(_SYSTEM, 20, 1, *body, _SYSTEM_END)
    if instruction not in _FRAMES:
        raise InputError("frame", "instruction", instruction, "a mode of 0 or 9")
    return _FRAMES[instruction]


def decode(frame: bytes, dialect: Dialect = THESIS) -> Instruction:
    """The instruction in a frame; InputError where `encode` in this dialect cannot have made it."""
    if len(frame) != LENGTH:
        raise InputError("frame", "length", len(frame), f"{LENGTH} bytes")
    if frame in _CONTROLS:
        return _CONTROLS[frame]
    head, tail = frame[:3], frame[-1]
    if head == bytes([_MOTION, ord("1"), dialect.motion_byte]) and tail == _MOTION_END:
        instruction: Instruction = _decode_move(_G1.unpack(frame), dialect)
    elif head == bytes([_MOTION, ord("6"), 0]) and tail == _MOTION_END:
        instruction = G4(_G4.unpack(frame)[3] / 1000)
    elif head == bytes([_SYSTEM, 20, 1]) and tail == _SYSTEM_END:
        instruction = G54(np.array(_G54.unpack(frame)[3:6]) / dialect.origin_scale)
    else:
        raise InputError("frame", "header, code and tail", [*head, tail], "those of G1, G4, G54 or a control frame")
    if encode(instruction, dialect) != frame:
        raise InputError("frame", "reserved bytes", frame.hex(" "), "zeros, and the dialect's pwm")
    return instruction


def _decode_move(fields: tuple[Any, ...], dialect: Dialect) -> G1:
    angles = dict(zip(dialect.slots, fields[6:9], strict=True))
    axes = np.array([*fields[3:6], *np.deg2rad([angles[joint] for joint in JOINTS])])
    return G1(axes, fields[10] / 60)


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


def _positive(where: str, what: str, value: float, unit: str) -> None:
    if not value > 0:
        raise InputError(where, what, value, f"> 0 {unit}")


Taken = TypeVar("Taken")


class FrameStream(Generic[Taken]):
    """Finds frames in bytes that come in any split, and finds the next one again after bytes that are none.

    length: bytes of a frame. tails: its last byte by its first. decode: what it says, InputError where it is none.
    """

    def __init__(self, length: int, tails: Mapping[int, int], decode: Callable[[bytes], Taken]) -> None:
        self._length, self._tails, self._decode = length, tails, decode
        self._rest = b""

    def __call__(self, data: bytes) -> tuple[list[Taken], bytes]:
        """What the frames that `data` completes say, and the bytes that by now are known to be in no frame."""
        rest, start = self._rest + data, 0
        taken: list[Taken] = []
        stray = bytearray()
        while start < len(rest):
            tail, end = self._tails.get(rest[start]), start + self._length
            if tail is not None and end > len(rest):
                break
            if tail is not None and rest[end - 1] == tail:
                try:
                    taken.append(self._decode(rest[start:end]))
                except InputError:
                    pass  # looks like a frame and is none: the next one may begin inside it
                else:
                    start = end
                    continue
            stray.append(rest[start])
            start += 1
        self._rest = rest[start:]
        return taken, bytes(stray)

    @property
    def pending(self) -> int:
        """Bytes held back because a frame may begin with them."""
        return len(self._rest)
