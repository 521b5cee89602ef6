"""The arm's wire: G1, G4 and G54 as 48-byte frames (thesis Table 6.1). Degrees, mm/min and ms exist only here.

Floats are IEEE 754 binary32, little-endian, as public drivers of the arm send them; there is no checksum. `decode`
takes what `encode` can have made and refuses all else: for every frame it takes, encode(decode(frame)) == frame.
"""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass
from typing import Any

import numpy as np

from estimation.errors import InputError
from estimation.se3 import Array

LENGTH = 48
_G1 = struct.Struct("<BcB6f16xfB")  # X Y Z, three angles, reserved, feed
_G4 = struct.Struct("<BcBf40xB")  # pause
_G54 = struct.Struct("<BBB3f32xB")  # X Y Z
_MOTION, _MOTION_END, _SYSTEM, _SYSTEM_END = 238, 239, 252, 253

JOINTS = ("J4", "J5", "J6")  # the machine axes A B C


@dataclass(frozen=True, slots=True)
class Dialect:
    """What public drivers of the arm do not agree on.

    motion_byte: byte 2 of a G1 frame; 1 in the thesis and one driver, 0 in another. slots: which joint stands in each
    of the three angle slots; J4 J5 J6 in the thesis's table, J5 first in its appendix and in both drivers.
    """

    motion_byte: int = 1
    slots: tuple[str, str, str] = JOINTS

    def __post_init__(self) -> None:
        if self.motion_byte not in (0, 1):
            raise InputError("dialect", "motion_byte", self.motion_byte, "0 or 1")
        if sorted(self.slots) != list(JOINTS):
            raise InputError("dialect", "slots", self.slots, "J4, J5 and J6, each once")


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


Instruction = G1 | G4 | G54


def encode(instruction: Instruction, dialect: Dialect = THESIS) -> bytes:
    """The frame of an instruction; InputError for what no frame can hold: not finite, too large, feed or pause <= 0."""
    if isinstance(instruction, G1):
        angles = dict(zip(JOINTS, np.rad2deg(instruction.axes[3:]), strict=True))
        numbers = [*instruction.axes[:3], *(angles[joint] for joint in dialect.slots), instruction.feed * 60]
        body = _singles(numbers, "G1")
        _positive("G1", "feed", body[6], "mm/min")
        return _G1.pack(_MOTION, b"1", dialect.motion_byte, *body, _MOTION_END)
    if isinstance(instruction, G4):
        body = _singles([instruction.duration * 1000], "G4")
        _positive("G4", "pause", body[0], "ms")
        return _G4.pack(_MOTION, b"6", 0, *body, _MOTION_END)
    return _G54.pack(_SYSTEM, 20, 1, *_singles(list(instruction.origin), "G54"), _SYSTEM_END)


def decode(frame: bytes, dialect: Dialect = THESIS) -> Instruction:
    """The instruction in a frame; InputError where `encode` in this dialect cannot have made it."""
    if len(frame) != LENGTH:
        raise InputError("frame", "length", len(frame), f"{LENGTH} bytes")
    head, tail = frame[:3], frame[-1]
    if head == bytes([_MOTION, ord("1"), dialect.motion_byte]) and tail == _MOTION_END:
        instruction: Instruction = _decode_move(_G1.unpack(frame), dialect)
    elif head == bytes([_MOTION, ord("6"), 0]) and tail == _MOTION_END:
        instruction = G4(_G4.unpack(frame)[3] / 1000)
    elif head == bytes([_SYSTEM, 20, 1]) and tail == _SYSTEM_END:
        instruction = G54(np.array(_G54.unpack(frame)[3:6]))
    else:
        raise InputError("frame", "header, code and tail", [*head, tail], "those of G1, G4 or G54")
    if encode(instruction, dialect) != frame:
        raise InputError("frame", "reserved bytes", frame.hex(" "), "zeros")
    return instruction


def _decode_move(fields: tuple[Any, ...], dialect: Dialect) -> G1:
    angles = dict(zip(dialect.slots, fields[6:9], strict=True))
    axes = np.array([*fields[3:6], *np.deg2rad([angles[joint] for joint in JOINTS])])
    return G1(axes, fields[9] / 60)


def _singles(numbers: list[float], where: str) -> list[float]:
    """Numbers as binary32 holds them."""
    with np.errstate(over="ignore"):
        singles = [float(np.float32(number)) for number in numbers]
    for number, single in zip(numbers, singles, strict=True):
        if not math.isfinite(single):
            raise InputError(where, "parameter", number, "a finite number that binary32 can hold")
    return singles


def _positive(where: str, what: str, value: float, unit: str) -> None:
    if not value > 0:
        raise InputError(where, what, value, f"> 0 {unit}")
