"""MCAP files: read record by record, whole or damaged, every checksum checked; and written with a packed index.

A file is read from its start and never through its index: the same code reads a file whose end is missing, and a wrong
index does no harm.
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

import zstandard
from mcap.data_stream import ReadDataStream, RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    Chunk,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    Message,
    MessageIndex,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)
from mcap.stream_reader import breakup_chunk
from mcap.writer import MCAP0_MAGIC

from estimation.errors import InputError
from hardware.process.checks import error_text

_RECORD_HEAD = struct.Struct("<BQ")  # opcode and length in front of every record


@dataclass(frozen=True, slots=True)
class StoredMessage:
    """One message as it is stored."""

    topic: str  # of its channel
    sequence: int
    data: bytes
    encoding: str = "json"  # of its channel


@dataclass(frozen=True, slots=True)
class ChunkMessages:
    """The messages of the chunk that begins at byte `offset`."""

    offset: int
    messages: tuple[StoredMessage, ...]


@dataclass(frozen=True, slots=True)
class AttachedFile:
    """A file attached to the recording."""

    name: str
    data: bytes


@dataclass(frozen=True, slots=True)
class Damage:
    """Why and where the file cannot be read further."""

    text: str


@dataclass(frozen=True, slots=True)
class RecordGroup:
    """The records of a chunk that begins at byte `offset`, or the one attachment or metadata there."""

    offset: int
    records: tuple[McapRecord, ...]


def walk(path: Path) -> Iterator[ChunkMessages | AttachedFile | Damage]:
    """The parts of a recording in the order of the file; a Damage, if any, is the last one."""
    channels: dict[int, Channel] = {}
    for group in record_groups(path):
        if isinstance(group, Damage):
            yield group
            continue
        first = next(iter(group.records), None)
        if isinstance(first, Attachment):
            yield AttachedFile(first.name, first.data)
        elif not isinstance(first, Metadata):
            channels.update((r.id, r) for r in group.records if isinstance(r, Channel))
            pairs = ((channels[r.channel_id], r) for r in group.records if isinstance(r, Message))
            stored = (StoredMessage(of.topic, r.sequence, r.data, of.message_encoding) for of, r in pairs)
            yield ChunkMessages(group.offset, tuple(stored))


def record_groups(path: Path) -> Iterator[RecordGroup | Damage]:
    """The same parts as the MCAP library's records, and the metadata."""
    known: set[int] = set()  # channels so far
    try:
        file = open(path, "rb")  # noqa: SIM115  (closed by the block below)
    except OSError as error:
        raise InputError(path, "recording", error_text(error), "a readable .mcap file") from error
    with file:
        size = path.stat().st_size
        magic = file.read(len(MCAP0_MAGIC))
        if magic != MCAP0_MAGIC:
            raise InputError(path, "recording", f"{size} bytes that begin with {magic!r}", "an MCAP file")
        while True:
            offset = file.tell()
            head = file.read(_RECORD_HEAD.size)
            if len(head) < _RECORD_HEAD.size:
                yield _damage(offset, size, "the file was not closed")
                return
            opcode, length = _RECORD_HEAD.unpack(head)
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
                yield RecordGroup(offset, records)
            elif opcode != Opcode.METADATA:
                yield _damage(offset, size, "a record is broken")
                return


def _damage(offset: int, size: int, reason: str) -> Damage:
    return Damage(f"{reason}: read up to byte {offset} of {size}")


def _records(opcode: int, data: bytes, known: set[int]) -> tuple[McapRecord, ...] | None:
    """The records in a record, its checksum checked; None if it is broken. known: channels so far, added to."""
    stream = ReadDataStream(BytesIO(data))
    try:
        if opcode == Opcode.METADATA:
            return (Metadata.read(stream),)
        if opcode == Opcode.ATTACHMENT:
            (crc,) = struct.unpack("<I", data[-4:])
            return (Attachment.read(stream),) if crc in (0, zlib.crc32(data[:-4])) else None
        records = tuple(breakup_chunk(Chunk.read(stream), validate_crc=True))
    except Exception:  # of broken bytes the library, its decompressors and struct raise many kinds
        return None
    known.update(r.id for r in records if isinstance(r, Channel))
    return records if all(r.channel_id in known for r in records if isinstance(r, Message)) else None


def chunk_messages(file: BinaryIO, offset: int) -> list[bytes]:
    """The bytes of every message in the chunk at `offset`, which `walk` has checked."""
    file.seek(offset)
    _, length = _RECORD_HEAD.unpack(file.read(_RECORD_HEAD.size))
    chunk = Chunk.read(ReadDataStream(BytesIO(file.read(length))))
    return [r.data for r in breakup_chunk(chunk, validate_crc=True) if isinstance(r, Message)]


def parse(path: Path, stored: StoredMessage) -> dict[str, Any]:
    """The JSON object that a message is."""
    try:
        message = json.loads(stored.data)
    except ValueError:
        message = None
    if not isinstance(message, dict):
        raise InputError(path, stored.topic, f"message of {len(stored.data)} bytes", "a JSON object")
    return message


_FOOTER_HEAD = struct.Struct("<BQQQ")  # the footer without its checksum, which covers it
_FOOTER_LENGTH = 20


class McapWriter:
    """Writes an MCAP file, the same bytes as the library's Writer, and keeps its index as packed records.

    The library's Writer keeps an object for each chunk until the file is closed: 7 to 10 MB an hour of a live run. The
    packed records take a tenth of that.
    """

    def __init__(self, file: BinaryIO, chunk_size: int, compress: bool) -> None:
        """chunk_size: bytes at which a chunk is closed. compress: whether chunks are."""
        self._file, self._chunk_size, self._compress = file, chunk_size, compress
        self._chunk, self._span = RecordBuilder(), (0, 0)  # the open chunk, and its first and last log time, ns
        self._messages: dict[int, MessageIndex] = {}  # of the open chunk, by channel
        self._schemas: list[Schema] = []
        self._channels: list[Channel] = []
        self._attachments: list[AttachmentIndex] = []
        self._metadata: list[MetadataIndex] = []
        self._chunk_index = bytearray()
        self._chunks = 0
        self._first, self._last = 0, 0  # log times of the file, ns
        self._counts: dict[int, int] = {}  # messages of each channel

    def start(self, library: str) -> None:
        """Write the head of the file."""
        self._file.write(MCAP0_MAGIC + _bytes(Header("", library)))

    def register_schema(self, name: str, encoding: str, data: bytes) -> int:
        """The number of a new schema."""
        self._schemas.append(Schema(id=len(self._schemas) + 1, data=data, encoding=encoding, name=name))
        self._add(self._schemas[-1])
        return len(self._schemas)

    def register_channel(self, topic: str, encoding: str, schema: int) -> int:
        """The number of a new channel."""
        number = len(self._channels) + 1
        self._channels.append(Channel(number, topic, message_encoding=encoding, metadata={}, schema_id=schema))
        self._add(self._channels[-1])
        return number

    def add_message(self, channel: int, log_time: int, data: bytes, sequence: int) -> None:
        """Add a message to the open chunk. log_time: ns."""
        first, last = self._span if self._messages else (log_time, 0)
        self._span = min(first, log_time), max(last, log_time)
        self._first = min(self._first, log_time) if self._counts else log_time
        self._last = max(self._last, log_time)
        self._counts[channel] = self._counts.get(channel, 0) + 1
        index = self._messages.setdefault(channel, MessageIndex(channel_id=channel, records=[]))
        index.records.append((log_time, self._chunk.count))
        self._add(Message(channel, log_time=log_time, data=data, publish_time=log_time, sequence=sequence))

    def add_attachment(self, name: str, media_type: str, data: bytes) -> None:
        """Write an attached file."""
        record = _bytes(Attachment(0, 0, name, media_type, data))
        self._attachments.append(AttachmentIndex(self._file.tell(), len(record), 0, 0, len(data), name, media_type))
        self._file.write(record)

    def add_metadata(self, name: str, data: dict[str, str]) -> None:
        """Write a table about the whole file."""
        record = _bytes(Metadata(name, data))
        self._metadata.append(MetadataIndex(self._file.tell(), len(record), name))
        self._file.write(record)

    def flush(self) -> None:
        """Close the open chunk and hand everything to the system."""
        self._close_chunk()
        self._file.flush()

    def finish(self) -> None:
        """Close the open chunk, and write the summary and the end of the file."""
        self._close_chunk()
        self._file.write(_bytes(DataEnd(0)))
        start = self._file.tell()
        groups = (
            (Opcode.SCHEMA, _bytes(*self._schemas)),
            (Opcode.CHANNEL, _bytes(*self._channels)),
            (Opcode.STATISTICS, _bytes(self._statistics())),
            (Opcode.CHUNK_INDEX, bytes(self._chunk_index)),
            (Opcode.ATTACHMENT_INDEX, _bytes(*self._attachments)),
            (Opcode.METADATA_INDEX, _bytes(*self._metadata)),
        )
        summary, offsets = b"", []
        for opcode, records in groups:
            offsets.append(SummaryOffset(opcode, start + len(summary), len(records)))
            summary += records
        offset_start = start + len(summary)
        summary += _bytes(*offsets)
        head = _FOOTER_HEAD.pack(Opcode.FOOTER, _FOOTER_LENGTH, start, offset_start)
        footer = Footer(start, offset_start, zlib.crc32(head, zlib.crc32(summary)))
        self._file.write(summary + _bytes(footer) + MCAP0_MAGIC)

    def _add(self, record: McapRecord) -> None:
        record.write(self._chunk)
        if self._chunk.count > self._chunk_size:
            self._close_chunk()

    def _close_chunk(self) -> None:
        """Write the open chunk and its message index; one without messages stays open."""
        if not self._messages:
            return
        data = _ended(self._chunk)
        packed = zstandard.compress(data) if self._compress else data
        (first, last), kind = self._span, "zstd" if self._compress else ""
        record = _bytes(Chunk(kind, packed, last, first, zlib.crc32(data), len(data)))
        start, offsets, indexes = self._file.tell(), {}, b""
        for channel, index in self._messages.items():
            offsets[channel] = start + len(record) + len(indexes)
            indexes += _bytes(index)
        entry = ChunkIndex(len(record), start, kind, len(packed), last, len(indexes), offsets, first, len(data))
        self._chunk_index += _bytes(entry)
        self._file.write(record)
        self._file.write(indexes)
        self._chunks += 1
        self._messages.clear()

    def _statistics(self) -> Statistics:
        return Statistics(
            attachment_count=len(self._attachments),
            channel_count=len(self._channels),
            channel_message_counts=self._counts,
            chunk_count=self._chunks,
            message_count=sum(self._counts.values()),
            message_end_time=self._last,
            message_start_time=self._first,
            metadata_count=len(self._metadata),
            schema_count=len(self._schemas),
        )


def _bytes(*records: McapRecord) -> bytes:
    builder = RecordBuilder()
    for record in records:
        record.write(builder)
    return _ended(builder)


def _ended(builder: RecordBuilder) -> bytes:
    return bytes(builder.end())  # type: ignore[no-untyped-call]
