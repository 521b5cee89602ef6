"""MCAP files: read record by record, whole or damaged, every checksum checked.

A file is read from its start, not through its index: the same code reads a file whose end is missing, and a wrong
index does no harm. Behind a broken record reading goes on at the next whole one. Where the chunk that names the
channels is broken, the second one names them again, or the file's summary does.
"""

from __future__ import annotations

import json
import re
import struct
import zlib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any, BinaryIO

from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    Channel,
    Chunk,
    Header,
    McapRecord,
    Message,
    Metadata,
    Schema,
)
from mcap.stream_reader import breakup_chunk
from mcap.writer import MCAP0_MAGIC

from estimation.errors import InputError
from hardware.process.checks import error_text

_RECORD_HEAD = struct.Struct("<BQ")  # opcode and length in front of every record
_DATA_END_LENGTH, _FOOTER_LENGTH = 4, 20
_SHAPE_BYTES = 512  # of a record, in which its inner lengths stand
_RECORD_START = re.compile(rb"(?s)(?=[\x02\x06\x09\x0c\x0f].{5}\0\0\0)")  # kinds to go on at, of less than 2**40 bytes
SCAN_BYTES = 2**22  # read at once in search of a whole record
MAX_TOLD_DAMAGES = 5  # in one text
CHECKSUM_KEY = "crc32"  # in metadata
NO_SCHEMA = 0  # of a channel of JSON: readers of ROS refuse a file with any schema but ROS's


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
class FileMetadata:
    """What the file says of itself: of what and when it was made."""

    table: Mapping[str, str]


@dataclass(frozen=True, slots=True)
class Damage:
    """A stretch of the file that cannot be read: why, where, and from when to when records are lost."""

    text: str


def damage_words(damages: Sequence[Damage]) -> str:
    """All damages of a file in one text, "" if there are none."""
    texts = [damage.text for damage in damages[:MAX_TOLD_DAMAGES]]
    remainder = [f"and {len(damages) - len(texts)} more"] if len(damages) > len(texts) else []
    return "; ".join(texts + remainder)


@dataclass(frozen=True, slots=True)
class RecordGroup:
    """The records of a chunk that begins at byte `offset`, or the one attachment or metadata there."""

    offset: int
    records: tuple[McapRecord, ...]


def walk(path: Path) -> Iterator[ChunkMessages | AttachedFile | FileMetadata | Damage]:
    """The parts of a recording in the order of the file; a Damage stands where a stretch of it cannot be read."""
    channels: dict[int, Channel] = {}
    for group in record_groups(path):
        if isinstance(group, Damage):
            yield group
            continue
        first = next(iter(group.records), None)
        if isinstance(first, Attachment):
            yield AttachedFile(first.name, first.data)
        elif isinstance(first, Metadata):
            yield FileMetadata(first.metadata)
        else:
            channels.update((r.id, r) for r in group.records if isinstance(r, Channel))
            pairs = ((channels[r.channel_id], r) for r in group.records if isinstance(r, Message))
            stored = (StoredMessage(of.topic, r.sequence, r.data, of.message_encoding) for of, r in pairs)
            yield ChunkMessages(group.offset, tuple(stored))


def record_groups(path: Path) -> Iterator[RecordGroup | Damage]:
    """The same parts as the MCAP library's records, and the metadata."""
    try:
        file = open(path, "rb")  # noqa: SIM115  (closed by the block below)
    except OSError as error:
        raise InputError(path, "recording", error_text(error), "a readable .mcap file") from error
    with file:
        size = path.stat().st_size
        magic = file.read(len(MCAP0_MAGIC))
        if sum(a != b for a, b in zip(magic, MCAP0_MAGIC, strict=False)) > 1 or len(magic) < len(MCAP0_MAGIC):
            raise InputError(path, "recording", f"{size} bytes that begin with {magic!r}", "an MCAP file")
        if magic != MCAP0_MAGIC:
            yield Damage(f"its first bytes are {magic!r}, not an MCAP file's; nothing else is lost")
        yield from _RecordWalk(file, size).groups()


@dataclass(frozen=True, slots=True)
class _Whole:
    """A record that can be read. records: of a chunk, an attachment or metadata; end: the byte behind it."""

    opcode: int
    end: int
    records: tuple[McapRecord, ...] = ()


@dataclass(frozen=True, slots=True)
class _Break:
    """Where reading broke off."""

    offset: int
    opcode: int  # of what stands there
    indexed: bool  # whether in the index, behind the data


def profile_of(path: Path) -> str:
    """The profile in the head of an MCAP file; "" where it cannot be read."""
    with suppress(Exception), open(path, "rb") as file:  # of broken bytes the library and struct raise many kinds
        file.seek(len(MCAP0_MAGIC))
        opcode, length = _RECORD_HEAD.unpack(file.read(_RECORD_HEAD.size))
        if opcode == Opcode.HEADER:
            return str(Header.read(ReadDataStream(BytesIO(file.read(min(length, _SHAPE_BYTES))))).profile)
    return ""


def sealed(table: Mapping[str, str]) -> dict[str, str]:
    """A table of metadata with a checksum of it: MCAP has none there."""
    text = json.dumps(sorted(table.items()), ensure_ascii=False)
    return {**table, CHECKSUM_KEY: f"{zlib.crc32(text.encode()):08x}"}


def _is_sound(table: Mapping[str, str]) -> bool:
    """Whether its checksum is right; older recordings have none."""
    content = {key: text for key, text in table.items() if key != CHECKSUM_KEY}
    return CHECKSUM_KEY not in table or sealed(content) == table


def epoch_of(metadata: Mapping[str, str]) -> int | None:
    """By how many ns log times are ahead of stamps, by a recording's metadata; None where they do not say."""
    now, before = (metadata.get(key, "") for key in ("epoch_ns", "epoch_s"))  # whole s in older recordings
    if now.removeprefix("-").isdecimal():
        return int(now)
    return int(before) * 1_000_000_000 if before.isdecimal() else None


UTC_LOG_TIMES = "UTC"  # what the metadata `log_times` say where these are real times


def began_of(metadata: Mapping[str, str]) -> int | None:
    """UTC at stamp 0, ns since 1970, by a recording's metadata; None where they do not know it."""
    epoch = epoch_of(metadata)
    known = metadata.get("log_times", UTC_LOG_TIMES if epoch == 0 else "") == UTC_LOG_TIMES
    return epoch if known else None


class _RecordWalk:
    """One pass over the records of a file, from behind its magic to its end; what is broken is skipped."""

    def __init__(self, file: BinaryIO, size: int) -> None:
        self._file, self._size = file, size
        self._channels_so_far: set[int] = set()  # channels so far
        self._epoch = 0  # ns that log times are ahead of stamps, by the metadata
        self._last: float | None = None  # s, last stamp of the newest chunk so far
        self._indexed = False  # behind the data: only the index follows
        self._gap: _Break | None = None  # not told yet

    def groups(self) -> Iterator[RecordGroup | Damage]:
        """What `record_groups` gives."""
        offset, opcode = len(MCAP0_MAGIC), 0
        checked = offset  # behind the last record that was checked; a broken length of another leads anywhere
        while offset < self._size and opcode != Opcode.FOOTER:
            group = self._record(offset)
            if group is None:
                self._gap = self._gap or _Break(offset, self._opcode(offset), self._indexed)
                offset = self._next_whole(checked)
                checked = offset + 1  # from here on it only goes forward
                continue
            self._channels_so_far |= {r.id for r in group.records if isinstance(r, Channel)}
            stamps = [(r.log_time - self._epoch) / 1e9 for r in group.records if isinstance(r, Message)]
            if stamps:
                if self._gap is not None:
                    yield self._damage(self._gap, min(stamps))
                self._last, self._gap = max(stamps), None
            for metadata in (r for r in group.records if isinstance(r, Metadata)):
                self._epoch = self._epoch if (epoch := epoch_of(metadata.metadata)) is None else epoch
            if group.records:
                yield RecordGroup(offset, group.records)
            opcode, offset = group.opcode, group.end
            checked = offset if group.records or opcode == Opcode.DATA_END else checked
            self._indexed |= opcode == Opcode.DATA_END
        if self._gap is not None and (opcode == Opcode.FOOTER or self._gap.indexed):
            yield self._damage(self._gap, None)
        elif self._gap is not None:
            yield Damage(f"a record is cut short or broken: read up to byte {self._gap.offset} of {self._size}")
        elif opcode != Opcode.FOOTER:
            yield Damage(f"the file was not closed: read up to byte {offset} of {self._size}")

    def _damage(self, gap: _Break, until: float | None) -> Damage:
        """until: s, first stamp behind it; None if there is none."""
        lost = "is lost" if gap.opcode == Opcode.CHUNK else "may be lost"
        if gap.indexed:
            text = "nothing is lost but the index"
        elif until is None:
            text = "what was recorded " + ("" if self._last is None else f"after {self._last:.2f} s ") + "may be lost"
        elif self._last is None:
            text = f"what was recorded before {until:.2f} s {lost}"
        else:
            text = f"what was recorded from {min(self._last, until):.2f} to {max(self._last, until):.2f} s {lost}"
        return Damage(f"a record is broken at byte {gap.offset} of {self._size}: {text}")

    def _opcode(self, offset: int) -> int:
        self._file.seek(offset)
        return (self._file.read(1) or b"\0")[0]

    def _record(self, offset: int) -> _Whole | None:
        """The record at `offset`; None if it is broken."""
        self._file.seek(offset)
        head = self._file.read(_RECORD_HEAD.size)
        if len(head) < _RECORD_HEAD.size:
            return None
        opcode, length = _RECORD_HEAD.unpack(head)
        end = offset + _RECORD_HEAD.size + length
        if opcode == 0 or end > self._size:
            return None
        if opcode == Opcode.FOOTER:
            self._file.seek(end)
            return _Whole(opcode, end) if self._file.read() == MCAP0_MAGIC else None
        if opcode not in (Opcode.CHUNK, Opcode.ATTACHMENT, Opcode.METADATA):
            return None if _holds_data(self._file.read(min(length, _SHAPE_BYTES)), length) else _Whole(opcode, end)
        records = self._records(opcode, self._file.read(length))
        return None if records is None else _Whole(opcode, end, records)

    def _records(self, opcode: int, data: bytes) -> tuple[McapRecord, ...] | None:
        """The records in a record, its checksum checked; None if it is broken."""
        stream = ReadDataStream(BytesIO(data))
        try:
            if opcode == Opcode.METADATA:
                metadata = Metadata.read(stream)
                return (metadata,) if stream.count == len(data) and _is_sound(metadata.metadata) else None
            if opcode == Opcode.ATTACHMENT:
                (crc,) = struct.unpack("<I", data[-4:])
                return (Attachment.read(stream),) if crc in (0, zlib.crc32(data[:-4])) else None
            records = tuple(breakup_chunk(Chunk.read(stream), validate_crc=True))
        except Exception:  # of broken bytes the library, its decompressors and struct raise many kinds
            return None
        registered = {r.id for r in records if isinstance(r, Channel)}
        referenced = {r.channel_id for r in records if isinstance(r, Message)}
        if not referenced <= self._channels_so_far | registered:  # the chunk that names them is broken
            records = (*_summary_channels(self._file, self._size), *records)
            registered = {r.id for r in records if isinstance(r, Channel)}
        return records if referenced <= self._channels_so_far | registered else None

    def _next_whole(self, offset: int) -> int:
        """Where the next record of data, or the end of the data, begins from `offset` on; the file's size if none."""
        while offset < self._size:
            self._file.seek(offset)
            block = self._file.read(SCAN_BYTES + _RECORD_HEAD.size)
            for match in _RECORD_START.finditer(block):
                if self._is_whole(offset + match.start()):
                    return offset + match.start()
            offset += SCAN_BYTES
        return self._size

    def _is_whole(self, offset: int) -> bool:
        self._file.seek(offset)
        opcode, length = _RECORD_HEAD.unpack(self._file.read(_RECORD_HEAD.size))
        if opcode == Opcode.DATA_END:
            return bool(length == _DATA_END_LENGTH)
        if opcode in (Opcode.CHUNK, Opcode.ATTACHMENT) and not _holds_data(self._file.read(_SHAPE_BYTES), length):
            return False
        return self._record(offset) is not None


def _holds_data(head: bytes, length: int) -> bool:
    """Whether a record of `length` bytes that begin with `head` has the lengths of a chunk or of an attachment inside.

    A chunk that is taken for another kind of record would be skipped without a word.
    """
    with suppress(struct.error):
        (name,) = struct.unpack_from("<I", head, 28)
        if name in (0, 3, 4):  # none, lz4, zstd
            return bool(struct.unpack_from("<Q", head, 32 + name)[0] + 40 + name == length)
    with suppress(struct.error):
        (name,) = struct.unpack_from("<I", head, 16)
        (media,) = struct.unpack_from("<I", head, 20 + name)
        (size,) = struct.unpack_from("<Q", head, 24 + name + media)
        return bool(36 + name + media + size == length)
    return False


def _summary_channels(file: BinaryIO, size: int) -> tuple[McapRecord, ...]:
    """Schemas and channels by the summary at the end of the file; none where it is missing or its checksum is wrong."""
    with suppress(Exception):  # of broken bytes the library and struct raise many kinds
        end = size - len(MCAP0_MAGIC) - _RECORD_HEAD.size - _FOOTER_LENGTH
        file.seek(end + _RECORD_HEAD.size)
        start, _, crc = struct.unpack("<QQI", file.read(_FOOTER_LENGTH))
        file.seek(start)
        data = file.read(size - len(MCAP0_MAGIC) - start)
        if zlib.crc32(data[:-4]) == crc:
            records = breakup_chunk(Chunk("", data[: end - start], 0, 0, 0, 0))
            return tuple(r for r in records if isinstance(r, Schema | Channel))
    return ()


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
