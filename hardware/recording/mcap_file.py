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
from mcap.records import Attachment, Channel, Chunk, McapRecord, Message, Metadata
from mcap.stream_reader import breakup_chunk
from mcap.writer import MCAP0_MAGIC

from estimation.errors import InputError
from hardware.process.checks import why

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


@dataclass(frozen=True, slots=True)
class Piece:
    """The records of a chunk that begins at byte `offset`, or the one attachment or metadata there."""

    offset: int
    records: tuple[McapRecord, ...]


def walk(path: Path) -> Iterator[Part]:
    """The parts of a recording in the order of the file; a Damage, if any, is the last one."""
    channels: dict[int, Channel] = {}
    for piece in pieces(path):
        if isinstance(piece, Damage):
            yield piece
            continue
        first = next(iter(piece.records), None)
        if isinstance(first, Attachment):
            yield Attached(first.name, first.data)
        elif not isinstance(first, Metadata):
            yield ChunkOf(piece.offset, _stored(piece, channels))


def pieces(path: Path) -> Iterator[Piece | Damage]:
    """The same parts as the library's records, and the metadata."""
    known: set[int] = set()
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
            if opcode not in (Opcode.CHUNK, Opcode.ATTACHMENT, Opcode.METADATA):
                file.seek(length, 1)
                continue
            records = _records(opcode, file.read(length), known)
            if records is not None:
                yield Piece(offset, records)
            elif opcode != Opcode.METADATA:
                yield _damage(offset, size, "a record is broken")
                return


def _damage(offset: int, size: int, why: str) -> Damage:
    return Damage(f"{why}: read up to byte {offset} of {size}")


def _records(opcode: int, data: bytes, known: set[int]) -> tuple[McapRecord, ...] | None:
    """What a record holds, its checksum checked; None if it is broken. known: channels, learnt on the way."""
    stream = ReadDataStream(BytesIO(data))
    try:
        if opcode == Opcode.METADATA:
            return (Metadata.read(stream),)
        if opcode == Opcode.ATTACHMENT:
            (crc,) = struct.unpack("<I", data[-4:])
            return (Attachment.read(stream),) if crc in (0, zlib.crc32(data[:-4])) else None
        records = tuple(breakup_chunk(Chunk.read(stream), validate_crc=True))
    except Exception:  # whatever the library, its decompressors and struct say of broken bytes: the same thing
        return None
    known.update(r.id for r in records if isinstance(r, Channel))
    return records if all(r.channel_id in known for r in records if isinstance(r, Message)) else None


def _stored(chunk: Piece, channels: dict[int, Channel]) -> tuple[Stored, ...]:
    """The messages of a chunk; channels: learnt on the way."""
    channels.update((r.id, r) for r in chunk.records if isinstance(r, Channel))
    said = ((channels[r.channel_id], r) for r in chunk.records if isinstance(r, Message))
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
