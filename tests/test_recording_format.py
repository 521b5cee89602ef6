"""What is written is a sound MCAP that viewers read, and what others wrote is read or refused in one line."""

from __future__ import annotations

import base64
import json
import re
import struct
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import SeekingReader
from mcap.records import ChunkIndex
from mcap.stream_reader import StreamReader
from mcap.writer import CompressionType, Writer
from rosbags.typesys import Stores, get_typestore

from estimation.errors import InputError
from estimation.observations import Observations
from hardware.files.folder_tables import rows_from_trajectory
from hardware.files.images import encode
from hardware.live.trace import TraceBatch, TraceEntry
from hardware.motion.loop import DispenserRecord, RecordedTick
from hardware.recording import ros_messages
from hardware.recording.loop_record import LoopRecord
from hardware.recording.mcap_file import ChunkMessages, Damage, walk
from hardware.recording.messages import message_from_rig
from hardware.recording.recorder import LOG_EPOCH, MAX_CHUNK_SECONDS, Recorder
from hardware.recording.session_reader import open_session
from perception.frames import Image, OutlinedPicture, Roi
from planning.command import Hold, Move
from planning.path import PrintPhase
from tests.recording_samples import LOST, pose, whole_recording, write_frames
from tests.session_files import NAMES, image, rig, stamps, trajectory
from tests.test_looks import some_look

STORE = get_typestore(Stores.ROS2_HUMBLE)


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return whole_recording(tmp_path_factory.mktemp("whole"))


def records(path: Path) -> list[object]:
    with open(path, "rb") as file:
        return list(StreamReader(file, validate_crcs=True, emit_chunks=False).records)


def test_the_file_is_sound_for_the_library_with_every_checksum(whole: Path) -> None:
    kinds = [type(r).__name__ for r in records(whole)]
    assert kinds[0] == "Header" and kinds[-1] == "Footer" and "DataEnd" in kinds
    assert not any(isinstance(p, Damage) for p in walk(whole))
    known: set[int] = {0}
    channels_seen: set[int] = set()
    last = 0
    for record in records(whole):
        name = type(record).__name__
        if name == "Schema":
            known.add(record.id)
        elif name == "Channel":
            assert record.schema_id in known
            channels_seen.add(record.id)
        elif name == "Message":
            assert record.channel_id in channels_seen
            assert record.log_time >= last
            last = record.log_time


def test_the_summary_points_at_what_is_there(whole: Path) -> None:
    data = whole.read_bytes()
    with open(whole, "rb") as file:
        reader = SeekingReader(file, validate_crcs=True)
        summary = reader.get_summary()
        counted = sum(1 for _ in reader.iter_messages())
        (attachment,) = reader.iter_attachments()
        (metadata,) = reader.iter_metadata()
    assert counted == summary.statistics.message_count
    assert attachment.name == "surface.ply" and attachment.data == b"ply\n" * 500
    assert metadata.metadata["epoch_ns"] == str(LOG_EPOCH * 10**9)
    for index in summary.chunk_indexes:
        assert isinstance(index, ChunkIndex)
        opcode, length = struct.unpack_from("<BQ", data, index.chunk_start_offset)
        assert (opcode, length + 9) == (0x06, index.chunk_length)
        assert index.message_end_time - index.message_start_time <= MAX_CHUNK_SECONDS * 1e9
        for offset in index.message_index_offsets.values():
            assert data[offset] == 0x07
    assert len(summary.chunk_indexes) == summary.statistics.chunk_count >= 4


@pytest.mark.slow
def test_no_bit_of_what_a_file_says_of_itself_flips_unseen(whole: Path, tmp_path: Path) -> None:
    """Else a flipped digit would move the time of day of everything."""
    data, told = bytearray(whole.read_bytes()), 0
    began = open_session(whole).began
    with open(whole, "rb") as file:
        (index,) = SeekingReader(file).get_summary().metadata_indexes
    for offset in range(index.offset + 9, index.offset + index.length, 3):
        data[offset] ^= 1
        flipped = tmp_path / "flipped.mcap"
        flipped.write_bytes(data)
        data[offset] ^= 1
        session = open_session(flipped)
        assert session.damage or session.began == began, offset
        told += bool(session.damage)
    assert told > 0.8 * index.length / 3  # unseen is only what changes nothing: the table's name, the checksum's


CHANNELS_PAGE = Path(__file__).parent.parent / "docs" / "recordings.md"


def described_channels() -> dict[str, set[str]]:
    """The fields of each of our own channels, as the page about recordings describes them."""
    rows = re.findall(r"^\| `(/[a-z_/]+)` \| ([^|]*) \|$", CHANNELS_PAGE.read_text(encoding="utf-8"), re.M)
    return {topic: set(re.findall(r"`([a-z_]+)`", text)) for topic, text in rows}


def test_every_message_has_the_fields_that_the_page_describes(tmp_path: Path) -> None:
    (tmp_path / "scan.obj").write_bytes(b"v 0 0 0\n")
    with Recorder(tmp_path / "x.mcap", rig()) as recorder:
        write_frames(recorder, 2, 3)
        recorder.surface(tmp_path / "scan.obj")
        recorder.truth(trajectory(2, True))
        recorder.head_row(rows_from_trajectory(trajectory(1, True))[0], True)
        pixels = np.array([[1.0, 2.0], [3.0, 0.0]])
        recorder.write(Observations(0.0, np.array([0, 1]), np.array([5, -1]), pixels, np.ones(2)))
        recorder.write(pose(0.0))
        recorder.write(LOST)
        recorder.write(Move(0.0, np.zeros(6), 1.0, 0, False))
        recorder.write(Hold(0.0, 0.1, "why"))
        recorder.write(Roi(0, 0.0, np.eye(3)[:, :2]))
        recorder.write(OutlinedPicture(0, 0.0, -1.0, image(0, 0), 9 * np.eye(3)[:, :2], "operator"))
        hold = Hold(0.0, 0.1, "why")
        recorder.write(RecordedTick(0.0, 0.0, True, hold, b"", 0.0, PrintPhase.PRINTING))
        recorder.write(LoopRecord(0, (0.0,), ((0, 1, "start", {"link": {}}),)))
        recorder.write(DispenserRecord(0.0, "needle", "on", 1.0))
        recorder.write(some_look())
        recorder.latency(0.0, "track", 0.001, np.zeros(3, np.int64), 0.0)
        recorder.trace(0.0, TraceBatch((TraceEntry("tracking", 0.0, ()),)).message)
        recorder.sent(0.0, b"1")
        recorder.received(0.0, b"2")
    described, seen = described_channels(), set[str]()
    with open(tmp_path / "x.mcap", "rb") as file:
        for schema, channel, message in SeekingReader(file, validate_crcs=True).iter_messages():
            if channel.message_encoding == "json":
                assert schema is None and set(json.loads(message.data)) == described[channel.topic], channel.topic
                seen.add(channel.topic)
    assert seen == set(described)


def test_images_are_given_to_viewers_at_their_stamp(whole: Path) -> None:
    with open(whole, "rb") as file:
        found = list(SeekingReader(file).iter_messages(topics=[f"/camera/{NAMES[0]}/image"]))
    for (_, _, message), stamp in zip(found, stamps(24, 0.0), strict=True):
        assert message.log_time == round(3 * stamp * 1e9) + LOG_EPOCH * 10**9
        told = STORE.deserialize_cdr(message.data, ros_messages.IMAGE).header.stamp
        assert told.sec * 10**9 + told.nanosec == message.log_time


def test_an_attachment_cannot_choose_where_it_is_unpacked(tmp_path: Path) -> None:
    with Recorder(tmp_path / "x.mcap", rig(2)) as recorder:
        write_frames(recorder, 2)
    with open(tmp_path / "y.mcap", "wb") as file:
        writer = Writer(file)
        writer.start()
        writer.add_attachment(0, 0, "../surface.ply", "model/ply", b"ply")
        for part in walk(tmp_path / "x.mcap"):
            for stored in part.messages if isinstance(part, ChunkMessages) else ():
                channel = writer.register_channel(stored.topic, stored.encoding, 0)
                writer.add_message(channel, 0, stored.data, 0, stored.sequence)
        writer.finish()
    session = open_session(tmp_path / "y.mcap")
    assert len(session) == 2 and session.surface is None


def foreign(path: Path, messages: list[tuple[str, object]]) -> None:
    """A sound MCAP file, written by someone else."""
    with open(path, "wb") as file:
        writer = Writer(file, compression=CompressionType.LZ4)
        writer.start()
        for topic, message in messages:
            channel = writer.register_channel(topic, "json", 0)
            writer.add_message(channel, 0, json.dumps(message).encode(), 0)
        writer.finish()


def old_image(picture: Image) -> dict[str, str]:
    """Foxglove's CompressedImage as JSON, which recordings held before they held ROS's."""
    kind, data = encode(picture)
    return {"format": kind, "data": base64.b64encode(data).decode()}


FRAME = {"stamp": 0.0, "camera_stamp": 0.0, "camera": 0, "number": 0}
HEAD = {"stamp": 0.0, "position": [1, 2, 3], "quaternion": [0, 0, 0, 1], "extruding": False}
RIG = message_from_rig(rig(2))
ONE_FRAME = [("/rig", RIG), ("/camera/left/image", old_image(image(0, 0))), ("/frames", FRAME)]


@pytest.mark.parametrize(
    ("messages", "words"),
    [
        ([("/other", {})], "/rig"),
        ([("/cam0/image_raw", {})], "go into a session folder: docs/conventions.md"),  # a ROS bag
        ([("/rig", [])], "/rig"),
        ([("/rig", {"camera": [{"name": "a"}]})], "camera[0].size = 'missing'"),
        ([("/rig", RIG)], "/frames"),
        ([("/rig", RIG), ("/frames", FRAME)], "/camera/left/image: image = 'no number 0'"),
        ([("/rig", RIG), ("/frames", {**FRAME, "camera": 2})], "allowed a camera of /rig, 0..1"),
        ([("/rig", RIG), ("/frames", {**FRAME, "stamp": float("nan")})], "finite"),
        ([("/rig", RIG), ("/frames", {"camera": 0})], "message of its schema"),
        ([*ONE_FRAME, ("/roi", {"stamp": 0.0, "camera": 2, "polygon": [0, 0, 9, 0, 9, 9]})], "a camera of /rig, 0..1"),
        ([*ONE_FRAME, ("/roi", {"stamp": 0.0, "camera": 0, "polygon": [0, 0, 9, 0, 9, float("nan")]})], "finite"),
        ([*ONE_FRAME, ("/roi", {"stamp": 0.0, "camera": 0, "polygon": [0, 0, 9, 0]})], "3 points"),
        ([*ONE_FRAME, ("/truth", {"stamp": 0, "position": [1, 2, 3], "quaternion": [0] * 4, "exact": True})], "unit"),
        ([*ONE_FRAME, ("/truth", {"stamp": 0, "position": [1, 2], "quaternion": [0] * 4, "exact": True})], "7 numbers"),
        ([*ONE_FRAME, ("/head", {**HEAD, "position": [1, 2, float("nan")]})], "/head[0] = '0.0 1.0 2.0 nan"),
        ([*ONE_FRAME, ("/head", {**HEAD, "position": [1, 2]})], "/head[0] = '7 numbers'"),
        ([*ONE_FRAME, ("/head", {**HEAD, "position": "far"})], "message of its schema"),
        ([*ONE_FRAME, ("/head", {**HEAD, "stamp": 10**400})], "message of its schema"),
        ([*ONE_FRAME, ("/head", HEAD), ("/head", {**HEAD, "position": [9, 9, 9]})], "/head[1]: stamp = 0.0"),
        ([*ONE_FRAME, ("/head", {**HEAD, "quaternion": [0, 0, 0, 2]})], "/head[0]: length of qx qy qz qw = 2.0"),
        ([*ONE_FRAME, ("/head", {**HEAD, "extruding": 1})], "/head: extruding = 1, allowed true or false"),
        ([("/rig", RIG), ("/camera/left/image", {"data": "", "format": "png"}), ("/frames", FRAME)], "undecodable"),
        ([("/rig", RIG), ("/camera/left/image", {"data": 3}), ("/frames", FRAME)], "an encoded image"),
    ],
)
def test_wrong_content_is_one_error(tmp_path: Path, messages: list[tuple[str, object]], words: str) -> None:
    foreign(tmp_path / "x.mcap", messages)
    with pytest.raises(InputError) as caught:
        open_session(tmp_path / "x.mcap")
    assert words in str(caught.value) and "x.mcap" in caught.value.where


def test_images_that_are_json_are_read_as_before(tmp_path: Path) -> None:
    foreign(tmp_path / "x.mcap", ONE_FRAME)
    session = open_session(tmp_path / "x.mcap")
    (frames,) = session.frame_sets()
    assert np.array_equal(frames.frames[0].image, image(0, 0))
    assert session.open_reader().encoded(session.sets[0][0]) == encode(image(0, 0))


@pytest.mark.parametrize("content", [b"", b"ply\n", b"\x89MCAP0\r\n", b"\x89MCAP0\r\n" + bytes(100)])
def test_what_is_no_recording_is_one_error(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "x.mcap").write_bytes(content)
    with pytest.raises(InputError, match=r"x\.mcap"):
        open_session(tmp_path / "x.mcap")
