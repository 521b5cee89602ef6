"""MCAP files written, with a packed index."""

from __future__ import annotations

import struct
import zlib
from typing import BinaryIO

import zstandard
from mcap.data_stream import RecordBuilder
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
from mcap.writer import MCAP0_MAGIC

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

    def start(self, profile: str, library: str) -> None:
        """Write the head of the file."""
        self._file.write(MCAP0_MAGIC + _bytes(Header(profile, library)))

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

    @property
    def chunks(self) -> int:
        """How many chunks are closed."""
        return self._chunks

    def repeat_definitions(self) -> None:
        """Write all schemas and channels so far once more: the open chunk and those behind it need no earlier one."""
        for record in (*self._schemas, *self._channels):
            record.write(self._chunk)

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
        data = _finished_bytes(self._chunk)
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
    return _finished_bytes(builder)


def _finished_bytes(builder: RecordBuilder) -> bytes:
    return bytes(builder.end())  # type: ignore[no-untyped-call]
