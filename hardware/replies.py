"""What the arm may answer: 9 bytes with three numbers, as one public driver of the arm reads them.

The thesis knows only stray single bytes (6.2), so the reader gives those back as well. Byte 0 is 0xCE, 1 to 6 three
int16, big-endian, 7 the kind, 8 0xCF. Places count tenths of a millimetre, angles hundredths of a degree. As in
protocol.py, `decode_reply` takes what `encode_reply` can have made and refuses all else.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from enum import IntEnum

import numpy as np

from estimation.errors import InputError
from estimation.se3 import Array
from hardware.arm.protocol import FrameStream

REPLY_LENGTH = 9
_REPLY = struct.Struct(">B3hBB")
_HEAD, _TAIL = 0xCE, 0xCF
REPLY_TAILS = {_HEAD: _TAIL}
_MOST = 32_767  # int16; its -32768 has no opposite and is not sent


class ReplyKind(IntEnum):
    """Which three numbers a reply holds; the value is byte 7. The driver knows a 4 and a 5, and does not use them."""

    PLACE = 0  # X Y Z
    TOOL = 1  # J4 J5 J6
    ARM = 2  # J1 J2 J3
    ORIGIN = 3  # X Y Z of the work origin


@dataclass(frozen=True, slots=True, eq=False)
class Reply:
    """One answer. values: (3,) mm, or rad where `kind` is TOOL or ARM."""

    kind: ReplyKind
    values: Array


def encode_reply(reply: Reply) -> bytes:
    """The 9 bytes of a reply, its numbers rounded to what they count in; InputError for one that does not fit."""
    counts = np.asarray(reply.values) / unit(reply.kind)
    if not (np.abs(counts) < _MOST + 0.5).all():  # NaN too
        allowed = f"at most {_MOST / 10:g} mm or {_MOST / 100:g} degrees either way"
        raise InputError("reply", reply.kind.name.lower(), reply.values.tolist(), allowed)
    return _REPLY.pack(_HEAD, *np.rint(counts).astype(int).tolist(), reply.kind, _TAIL)


def decode_reply(frame: bytes) -> Reply:
    """The reply in 9 bytes; InputError where `encode_reply` cannot have made them."""
    if len(frame) != REPLY_LENGTH:
        raise InputError("reply", "length", len(frame), f"{REPLY_LENGTH} bytes")
    head, *counts, kind, tail = _REPLY.unpack(frame)
    if (head, tail) != (_HEAD, _TAIL):
        raise InputError("reply", "first and last byte", [head, tail], f"{_HEAD} and {_TAIL}")
    if kind not in list(ReplyKind):
        raise InputError("reply", "kind", kind, "0 to 3")
    if min(counts) < -_MOST:
        raise InputError("reply", "values", counts, f"-{_MOST} to {_MOST}")
    return Reply(ReplyKind(kind), np.array(counts) * unit(ReplyKind(kind)))


def reply_stream() -> FrameStream[Reply]:
    """A reader of what the arm sends: replies, and the stray bytes between them.

    A stray byte just before a reply never costs it: byte 8 would then be the reply's kind, which is no 0xCF.
    """
    return FrameStream(REPLY_LENGTH, REPLY_TAILS, decode_reply)


def unit(kind: ReplyKind) -> float:
    """What its values count in, mm or rad."""
    return 0.1 if kind in (ReplyKind.PLACE, ReplyKind.ORIGIN) else float(np.deg2rad(0.01))
