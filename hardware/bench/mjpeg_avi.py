"""A video file made by hand: JPEGs in an AVI container (Microsoft, AVI RIFF File Reference), with its index."""

from __future__ import annotations

import struct
from collections.abc import Sequence

HAS_INDEX, KEY_FRAME = 0x10, 0x10


def mjpeg_avi(pictures: Sequence[bytes], size: tuple[int, int], rate: int) -> bytes:
    """The file of pictures that are encoded as JPEG. size: W, H px. rate: frames per second."""
    most, (width, height), count = max(map(len, pictures)), size, len(pictures)
    usual = 1_000_000 // rate, most * rate, 0, HAS_INDEX, count, 0, 1, most, width, height, 0, 0, 0, 0
    stream = struct.pack(
        "<4s4sIHHIIIIIIiI4H", b"vids", b"MJPG", 0, 0, 0, 0, 1, rate, 0, count, most, -1, 0, 0, 0, *size
    )
    bitmap = struct.pack("<IiiHH4sIiiII", 40, width, height, 1, 24, b"MJPG", 3 * width * height, 0, 0, 0, 0)
    strl = _list(b"strl", _chunk(b"strh", stream) + _chunk(b"strf", bitmap))
    chunks, entries, at = [], [], 4
    for picture in pictures:
        chunks.append(_chunk(b"00dc", picture))
        entries.append(struct.pack("<4sIII", b"00dc", KEY_FRAME, at, len(picture)))
        at += len(chunks[-1])
    header = _list(b"hdrl", _chunk(b"avih", struct.pack("<14I", *usual)) + strl)
    body = header + _list(b"movi", b"".join(chunks)) + _chunk(b"idx1", b"".join(entries))
    return _chunk(b"RIFF", b"AVI " + body)


def _chunk(name: bytes, data: bytes) -> bytes:
    return name + struct.pack("<I", len(data)) + data + b"\0" * (len(data) % 2)


def _list(name: bytes, data: bytes) -> bytes:
    return _chunk(b"LIST", name + data)
