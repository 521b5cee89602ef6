"""Walking through an MCAP file, whole or damaged: its chunks and attachments, every checksum checked.

The file is walked from its start, record by record, and never through its index: so a file whose end is missing is
read by the same code as a whole one, and an index that lies cannot mislead.
"""

from __future__ import annotations

import json
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any, BinaryIO

from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Chunk, Message
from mcap.stream_reader import breakup_chunk
from mcap.writer import MCAP0_MAGIC

from estimation.errors import InputError
from hardware.checks import why

_HEAD = struct.Struct("<BQ")  # opcode and length in front of every record


@dataclass(frozen=True, slots=True)
class Stored:
    """One message as it is stored: its channel's topic and encoding, its sequence number, its bytes."""

    topic: str
    sequence: int
    data: bytes
    encoding: str = "json"


@dataclass(frozen=True, slots=True)
class ChunkOf:
    """The messages of the chunk that begins at byte `offset`."""

    offset: int
    messages: tuple[Stored, ...]


@dataclass(frozen=True, slots=True)
class Attached:
    """A file that travels in the recording."""

    name: str
    data: bytes


@dataclass(frozen=True, slots=True)
class Damage:
    """Why and where the file cannot be read further."""

    text: str


Part = ChunkOf | Attached | Damage


def walk(path: Path) -> Iterator[Part]:
    """The parts of a recording in the order of the file; a Damage, if any, is the last one."""
    channels: dict[int, Channel] = {}
    try:
        file = open(path, "rb")  # noqa: SIM115  (closed by the block below)
    except OSError as error:
        raise InputError(path, "recording", why(error), "a readable .mcap file") from error
    with file:
        size = path.stat().st_size
        magic = file.read(len(MCAP0_MAGIC))
        if magic != MCAP0_MAGIC:
            raise InputError(path, "recording", f"{size} bytes that begin with {magic!r}", "an MCAP file")
        while True:
            offset = file.tell()
            head = file.read(_HEAD.size)
            if len(head) < _HEAD.size:
                yield _damage(offset, size, "the file was not closed")
                return
            opcode, length = _HEAD.unpack(head)
            if opcode == 0 or file.tell() + length > size:
                yield _damage(offset, size, "a record is cut short or broken")
                return
            if opcode == Opcode.FOOTER:
                file.seek(length, 1)
                if file.read() != MCAP0_MAGIC:
                    yield _damage(offset, size, "the end is not an MCAP file's")
                return
            if opcode not in (Opcode.CHUNK, Opcode.ATTACHMENT):
                file.seek(length, 1)
                continue
            part = _part(opcode, offset, file.read(length), channels)
            yield part or _damage(offset, size, "a record is broken")
            if part is None:
                return


def _damage(offset: int, size: int, why: str) -> Damage:
    return Damage(f"{why}: read up to byte {offset} of {size}")


def _part(opcode: int, offset: int, data: bytes, channels: dict[int, Channel]) -> Part | None:
    """A chunk or an attachment with its checksum checked, None if it is broken; channels: learnt on the way."""
    try:
        if opcode == Opcode.ATTACHMENT:
            attachment = Attachment.read(ReadDataStream(BytesIO(data)))
            (crc,) = struct.unpack("<I", data[-4:])
            return Attached(attachment.name, attachment.data) if crc in (0, zlib.crc32(data[:-4])) else None
        return ChunkOf(offset, _unpack(data, channels))
    except Exception:  # whatever the library, its decompressors and struct say of broken bytes: the same thing
        return None


def _unpack(data: bytes, channels: dict[int, Channel]) -> tuple[Stored, ...]:
    records = breakup_chunk(Chunk.read(ReadDataStream(BytesIO(data))), validate_crc=True)
    channels.update((r.id, r) for r in records if isinstance(r, Channel))
    said = ((channels[r.channel_id], r) for r in records if isinstance(r, Message))
    return tuple(Stored(of.topic, r.sequence, r.data, of.message_encoding) for of, r in said)


def chunk_messages(file: BinaryIO, offset: int) -> list[bytes]:
    """The bytes of every message in the chunk at `offset` of a file that `walk` found whole."""
    file.seek(offset)
    _, length = _HEAD.unpack(file.read(_HEAD.size))
    chunk = Chunk.read(ReadDataStream(BytesIO(file.read(length))))
    return [r.data for r in breakup_chunk(chunk, validate_crc=True) if isinstance(r, Message)]


def parse(path: Path, stored: Stored) -> dict[str, Any]:
    """The JSON object that a message is."""
    try:
        message = json.loads(stored.data)
    except ValueError:
        message = None
    if not isinstance(message, dict):
        raise InputError(path, stored.topic, f"message of {len(stored.data)} bytes", "a JSON object")
    return message
