"""Recordings: every record comes back, a cut file keeps its whole chunks, and what is written is a sound MCAP."""

from __future__ import annotations

import json
import resource
import signal
import struct
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path

import jsonschema  # type: ignore[import-untyped]
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import SeekingReader
from mcap.records import ChunkIndex
from mcap.stream_reader import StreamReader
from mcap.writer import CompressionType, Writer
from session_files import NAMES, image, rig, stamps, trajectory

from estimation.errors import InputError, StillbedError
from estimation.observations import Observations
from estimation.pose import SurfacePose, TrackState
from hardware import channels
from hardware.images import encode
from hardware.mcap_walk import ChunkOf, Damage, walk
from hardware.messages import message_from_image, message_from_rig
from hardware.recording import CHUNK_SECONDS, EPOCH, WARNING, Recorder
from hardware.rig_file import table_from_rig
from hardware.schemas import CALIBRATION, IMAGE, TOPICS
from hardware.session import open_session
from hardware.tum import rows_from_trajectory
from perception.frames import Frame, Roi
from planning.command import Hold, Move

EXACT_STAMPS = st.floats(-1e8, 1e8) | st.floats(1e9, 4e9)


def write_frames(recorder: Recorder, count: int, cameras: int = 2, start: float = -0.1) -> None:
    for number, stamp in enumerate(stamps(count, start)):
        for camera in range(cameras):
            recorder.write(Frame(camera, stamp, image(camera, number)))


def pose(stamp: float, seed: int = 0) -> SurfacePose:
    draw = np.random.default_rng(seed)
    root = draw.normal(size=(6, 6))
    placed = trajectory(1, True).base_from_surface[0]
    return SurfacePose(
        stamp,
        placed,
        root @ root.T,
        draw.normal(size=6),
        TrackState.DEGRADED,
        np.eye(6) / 3,
        draw.random(6),
        'why "so"',
    )


LOST = SurfacePose(0.0, np.full((4, 4), np.nan), np.full((6, 6), np.inf), np.zeros(6), TrackState.LOST)


@pytest.mark.parametrize("start", [-10.83, 0.0, 1.7e9 + 1 / 3])
def test_frames_come_back_with_their_exact_stamps_and_pixels(tmp_path: Path, start: float) -> None:
    with Recorder(tmp_path / "x.mcap", rig()) as recorder:
        write_frames(recorder, 20, 3, start)
    session = open_session(tmp_path / "x.mcap")
    assert session.damage == "" and len(session) == 20
    assert table_from_rig(session.rig) == table_from_rig(rig())
    for number, (frames, stamp) in enumerate(zip(session.frame_sets(), stamps(20, start), strict=True)):
        assert [(f.camera, f.stamp) for f in frames.frames] == [(c, stamp) for c in range(3)]
        assert all(np.array_equal(f.image, image(f.camera, number)) for f in frames.frames)


def test_frames_that_arrive_late_are_put_in_order(tmp_path: Path) -> None:
    times = stamps(12)
    with Recorder(tmp_path / "x.mcap", rig(2)) as recorder:
        for number in range(12):
            recorder.write(Frame(0, times[number], image(0, number)))
            if number >= 3:
                recorder.write(Frame(1, times[number - 3], image(1, number - 3)))
    sets = list(open_session(tmp_path / "x.mcap").frame_sets())
    assert [len(s.frames) for s in sets] == [2] * 9 + [1] * 3
    assert np.array_equal(sets[5].frames[1].image, image(1, 5))


@given(stamp=EXACT_STAMPS, seed=st.integers(0, 2**32 - 1), size=st.integers(0, 5), data=st.binary(max_size=60))
def test_every_record_comes_back_bit_by_bit(
    tmp_path_factory: pytest.TempPathFactory, stamp: float, seed: int, size: int, data: bytes
) -> None:
    path = tmp_path_factory.mktemp("r") / "x.mcap"
    draw = np.random.default_rng(seed)
    seen = Observations(
        stamp,
        draw.integers(0, 3, size),
        draw.integers(0, 2**62, size),
        draw.normal(size=(size, 2)) * 1e3,
        draw.random(size),
    )
    move, hold = Move(stamp, draw.normal(size=6), 1 / 3, 7, True), Hold(stamp, 0.1, "pose is old")
    with Recorder(path, rig()) as recorder:
        for record in (seen, pose(stamp, seed), move, hold, move):
            recorder.write(record)
        recorder.sent(stamp, data)
        recorder.received(stamp, data[::-1])
        recorder.event(stamp, "drape moved", WARNING)
        moved = trajectory(size, False)
        moved.stamps[:] += stamp
        recorder.truth(moved)
    (back,) = channels.read_observations(path)
    assert back.stamp == stamp and len(back) == size
    for name in ("camera", "track", "pixels", "sigma"):
        assert getattr(back, name).tobytes() == getattr(seen, name).tobytes()
    (estimate,) = channels.read_poses(path)
    for name in ("base_from_surface", "covariance", "twist", "twist_covariance", "acceleration_psd"):
        assert getattr(estimate, name).tobytes() == getattr(pose(stamp, seed), name).tobytes()
    assert (estimate.stamp, estimate.state, estimate.reason) == (stamp, TrackState.DEGRADED, 'why "so"')
    first, second, third = channels.read_commands(path)
    assert isinstance(first, Move) and isinstance(third, Move) and second == hold
    assert first.axes.tobytes() == move.axes.tobytes()
    assert (first.stamp, first.feed, first.checkpoint, first.extrude) == (stamp, 1 / 3, 7, True)
    assert list(channels.read_sent(path)) == [(stamp, data)]
    assert list(channels.read_received(path)) == [(stamp, data[::-1])]
    assert list(channels.read_events(path)) == [(stamp, WARNING, "drape moved")]
    assert channels.read_truth_rows(path).tobytes() == rows_from_trajectory(moved).tobytes()


def test_a_pose_that_is_not_finite_reads_as_nan_and_stays_valid_json(tmp_path: Path) -> None:
    with Recorder(tmp_path / "x.mcap", rig()) as recorder:
        recorder.write(LOST)
    (back,) = channels.read_poses(tmp_path / "x.mcap")
    assert np.isnan(back.base_from_surface).all() and np.isnan(back.covariance).all()
    assert b"NaN" not in (tmp_path / "x.mcap").read_bytes()


def test_roi_truth_and_surface_travel(tmp_path: Path) -> None:
    scan = tmp_path / "scan.STL"
    scan.write_bytes(bytes(range(256)) * 300)
    polygon = np.array([[-1.5, 2.0], [30.0, 1 / 3], [12.0, 40.0]])
    with Recorder(tmp_path / "x.mcap", rig(2)) as recorder:
        recorder.surface(scan)
        recorder.write(Roi(1, -0.1, polygon))
        write_frames(recorder, 5)
        recorder.truth(trajectory(5, True))
    session = open_session(tmp_path / "x.mcap")
    assert session.surface is not None and session.surface.suffix == ".stl"
    assert session.surface.read_bytes() == scan.read_bytes()
    assert session.roi[0].camera == 1 and session.roi[0].polygon.tobytes() == polygon.tobytes()
    assert session.truth is not None and session.truth.exact
    assert session.truth.stamps.tolist() == stamps(5)
    assert np.abs(session.truth.base_from_surface - trajectory(5, True).base_from_surface).max() < 1e-13
    copy = session.surface
    del session
    assert not copy.exists()  # it went with the session


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A closed recording of 2.4 s with a scan in it."""
    folder = tmp_path_factory.mktemp("whole")
    (folder / "scan.ply").write_bytes(b"ply\n" * 500)
    with Recorder(folder / "x.mcap", rig(2)) as recorder:
        for number, stamp in enumerate(stamps(24, 0.0)):
            for camera in range(2):
                recorder.write(Frame(camera, 3 * stamp, image(camera, number)))
            recorder.write(pose(3 * stamp, number))
            if number == 12:
                recorder.surface(folder / "scan.ply")
    return folder / "x.mcap"


@cache
def chunk_ends(path: Path) -> list[tuple[int, int]]:
    """End of each chunk, bytes, and the frames that can be read up to there."""
    with open(path, "rb") as file:
        summary = SeekingReader(file).get_summary()
    assert summary is not None
    ends = []
    frames = 0
    chunks = {p.offset: p for p in walk(path) if isinstance(p, ChunkOf)}
    for index in sorted(summary.chunk_indexes, key=lambda c: c.chunk_start_offset):
        frames += sum(m.topic == "/frames" for m in chunks[index.chunk_start_offset].messages)
        ends.append((index.chunk_start_offset + index.chunk_length, frames))
    return ends


@settings(max_examples=120)
@given(where=st.floats(0, 1), near=st.integers(-12, 12) | st.none(), pick=st.integers(0, 1000))
def test_a_file_cut_at_any_byte_is_readable_up_to_its_last_whole_chunk(
    whole: Path, where: float, near: int | None, pick: int
) -> None:
    data, ends = whole.read_bytes(), chunk_ends(whole)
    cut = int(where * (len(data) - 1)) if near is None else ends[pick % len(ends)][0] + near
    part = whole.parent / "cut.mcap"
    part.write_bytes(data[:cut])
    expected = max([frames for end, frames in ends if end <= cut], default=0)
    if cut < ends[0][0]:
        with pytest.raises(InputError):
            open_session(part)
        return
    session = open_session(part)
    assert sum(map(len, session.sets)) == expected
    assert len(list(session.frame_sets())) == len(session)
    assert session.damage != ""
    assert sum(1 for _ in channels.read_poses(part)) >= expected // 2 - 1


def test_a_chunk_that_an_interrupted_run_wrote_twice_counts_once(whole: Path) -> None:
    data, ends = whole.read_bytes(), [end for end, _ in chunk_ends(whole)]
    starts = [p.offset for p in walk(whole) if isinstance(p, ChunkOf)]
    again = whole.parent / "again.mcap"
    again.write_bytes(data[: ends[1]] + data[starts[1] : ends[1]] + data[ends[1] :])
    session = open_session(again)
    assert sum(map(len, session.sets)) == 48 == sum(len(s.frames) for s in session.frame_sets())


def test_an_attachment_cannot_choose_where_it_is_unpacked(tmp_path: Path) -> None:
    with Recorder(tmp_path / "x.mcap", rig(2)) as recorder:
        write_frames(recorder, 2)
    with open(tmp_path / "y.mcap", "wb") as file:
        writer = Writer(file)
        writer.start()
        writer.add_attachment(0, 0, "../surface.ply", "model/ply", b"ply")
        for part in walk(tmp_path / "x.mcap"):
            for stored in part.messages if isinstance(part, ChunkOf) else ():
                channel = writer.register_channel(stored.topic, "json", 0)
                writer.add_message(channel, 0, stored.data, 0, stored.sequence)
        writer.finish()  # type: ignore[no-untyped-call]
    session = open_session(tmp_path / "y.mcap")
    assert len(session) == 2 and session.surface is None


@settings(max_examples=60)
@given(where=st.floats(0.01, 0.999), bit=st.integers(0, 7))
def test_a_flipped_bit_never_gives_a_wrong_image(whole: Path, where: float, bit: int) -> None:
    data = bytearray(whole.read_bytes())
    data[int(where * len(data))] ^= 1 << bit
    part = whole.parent / "flip.mcap"
    part.write_bytes(data)
    try:
        session = open_session(part)
    except InputError:
        return  # the first chunk, with the rig, is broken
    frames = {(f.camera, f.stamp): f.image for s in session.frame_sets() for f in s.frames}
    original = {3 * stamp: number for number, stamp in enumerate(stamps(24, 0.0))}
    assert all(np.array_equal(i, image(c, original[s])) for (c, s), i in frames.items())
    assert len(frames) == 48 or session.damage


KILLED = """
import sys, time
sys.path.insert(0, "tests")
from session_files import image, rig
from hardware.recording import Recorder
from perception.frames import Frame
recorder = Recorder(sys.argv[1], rig(2))
for k in range(10**6):
    for camera in range(2):
        recorder.write(Frame(camera, k / 30, image(camera, k % 50)))
    print(k, flush=True)
"""


def test_a_killed_run_is_readable_to_the_last_second(tmp_path: Path) -> None:
    root = Path(__file__).parent.parent
    command = [sys.executable, "-c", KILLED, str(tmp_path / "x.mcap")]
    child = subprocess.Popen(command, cwd=root, stdout=subprocess.PIPE, text=True)
    assert child.stdout is not None
    while int(child.stdout.readline()) < 100:
        pass
    child.send_signal(signal.SIGKILL)
    last = max([100, *(int(line) for line in child.stdout.read().split())])
    child.wait()
    session = open_session(tmp_path / "x.mcap")
    assert "not closed" in session.damage or "cut" in session.damage
    frames = list(session.frame_sets())
    assert last / 30 - frames[-1].stamp <= CHUNK_SECONDS + 2 / 30


@contextmanager
def disk_of(size: int) -> Iterator[None]:
    """No file may grow beyond `size` bytes: the system itself refuses the write."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def test_a_full_disk_is_one_error_and_what_was_written_stays_readable(tmp_path: Path) -> None:
    path = tmp_path / "x.mcap"
    recorder = Recorder(path, rig(2))
    with disk_of(400_000), pytest.raises(StillbedError, match="recording stopped") as caught:
        write_frames(recorder, 10_000)
    with pytest.raises(StillbedError, match="recording stopped"):
        recorder.event(1.0, "still there?")
    recorder.close()
    recorder.close()
    assert not isinstance(caught.value, InputError)
    session = open_session(path)
    assert len(session) > 10 and len(list(session.frame_sets())) == len(session)


def test_an_error_inside_the_block_is_not_hidden_and_the_file_is_closed(tmp_path: Path) -> None:
    with pytest.raises(KeyboardInterrupt), Recorder(tmp_path / "x.mcap", rig(2)) as recorder:
        write_frames(recorder, 3)
        raise KeyboardInterrupt
    assert open_session(tmp_path / "x.mcap").damage == ""


def test_a_folder_that_is_not_there_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(StillbedError, match="cannot write"):
        Recorder(tmp_path / "none" / "x.mcap", rig())


def test_an_existing_file_is_only_replaced_when_told(tmp_path: Path) -> None:
    path = tmp_path / "x.mcap"
    path.write_bytes(b"precious")
    with pytest.raises(InputError, match="exists"):
        Recorder(path, rig())
    assert path.read_bytes() == b"precious"
    with Recorder(path, rig(2), overwrite=True) as recorder:
        write_frames(recorder, 2)
    assert len(open_session(path)) == 2


@pytest.mark.parametrize("stamp", [float("nan"), float("inf"), -2e9, 1e30])
def test_a_stamp_that_cannot_be_stored_is_refused(tmp_path: Path, stamp: float) -> None:
    with Recorder(tmp_path / "x.mcap", rig(2)) as recorder:
        write_frames(recorder, 2)
        with pytest.raises(InputError, match="stamp"):
            recorder.write(Frame(0, stamp, image(0, 0)))
        with pytest.raises(InputError, match="stamp"):
            recorder.event(stamp, "never")
    assert len(open_session(tmp_path / "x.mcap")) == 2


def test_what_the_reader_would_refuse_is_refused_when_written(tmp_path: Path) -> None:
    with Recorder(tmp_path / "x.mcap", rig(2)) as recorder:
        write_frames(recorder, 3)
        with pytest.raises(InputError, match="later than"):
            recorder.write(Frame(1, stamps(3)[2], image(0, 0)))
        with pytest.raises(InputError, match="64 x 48 px"):
            recorder.write(Frame(1, 5.0, image(0, 0)[1:]))
        with pytest.raises(InputError, match="finite"):
            recorder.write(Move(5.0, np.full(6, np.nan), 1.0, 0, False))
    assert len(open_session(tmp_path / "x.mcap")) == 3


def test_jpeg_is_smaller_and_nearly_the_same(tmp_path: Path) -> None:
    rough = np.add.outer(np.arange(48), np.arange(64)).astype(np.uint8) + image(0, 0)[..., 0] % 8
    for name, quality in (("png", None), ("jpeg", 80)):
        with Recorder(tmp_path / name, rig(2), jpeg_quality=quality) as recorder:
            recorder.write(Frame(0, 0.0, rough))
    (frames,) = open_session(tmp_path / "jpeg").frame_sets()
    assert 0 < np.abs(frames.frames[0].image.astype(int) - rough).max() < 16
    assert (tmp_path / "jpeg").stat().st_size < (tmp_path / "png").stat().st_size


@pytest.mark.parametrize("content", [b"", b"ply\n", b"\x89MCAP0\r\n", b"\x89MCAP0\r\n" + bytes(100)])
def test_what_is_no_recording_is_one_error(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "x.mcap").write_bytes(content)
    with pytest.raises(InputError, match=r"x\.mcap"):
        open_session(tmp_path / "x.mcap")


def foreign(path: Path, messages: list[tuple[str, object]]) -> None:
    """A sound MCAP file, written by someone else."""
    with open(path, "wb") as file:
        writer = Writer(file, compression=CompressionType.LZ4)
        writer.start()
        for topic, message in messages:
            channel = writer.register_channel(topic, "json", 0)
            writer.add_message(channel, 0, json.dumps(message).encode(), 0)
        writer.finish()  # type: ignore[no-untyped-call]


FRAME = {"stamp": 0.0, "camera_stamp": 0.0, "camera": 0, "number": 0}
RIG = message_from_rig(rig(2))
ONE_FRAME = [
    ("/rig", RIG),
    ("/camera/left/image", message_from_image(*encode(image(0, 0)), "left", 0)),
    ("/frames", FRAME),
]


@pytest.mark.parametrize(
    ("messages", "words"),
    [
        ([("/other", {})], "/rig"),
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
        ([("/rig", RIG), ("/camera/left/image", {"data": "", "format": "png"}), ("/frames", FRAME)], "undecodable"),
        ([("/rig", RIG), ("/camera/left/image", {"data": 3}), ("/frames", FRAME)], "CompressedImage"),
    ],
)
def test_a_sound_file_with_the_wrong_content_is_one_error(
    tmp_path: Path, messages: list[tuple[str, object]], words: str
) -> None:
    foreign(tmp_path / "x.mcap", messages)
    with pytest.raises(InputError) as caught:
        open_session(tmp_path / "x.mcap")
    assert words in str(caught.value) and "x.mcap" in caught.value.where


# What `mcap doctor` looks at, asked of the library


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
            known.add(record.id)  # type: ignore[attr-defined]
        elif name == "Channel":
            assert record.schema_id in known  # type: ignore[attr-defined]
            channels_seen.add(record.id)  # type: ignore[attr-defined]
        elif name == "Message":
            assert record.channel_id in channels_seen  # type: ignore[attr-defined]
            assert record.log_time >= last  # type: ignore[attr-defined]
            last = record.log_time  # type: ignore[attr-defined]


def test_the_summary_points_at_what_is_there(whole: Path) -> None:
    data = whole.read_bytes()
    with open(whole, "rb") as file:
        reader = SeekingReader(file, validate_crcs=True)
        summary = reader.get_summary()
        assert summary is not None and summary.statistics is not None
        counted = sum(1 for _ in reader.iter_messages())
        (attachment,) = reader.iter_attachments()
        (metadata,) = reader.iter_metadata()
    assert counted == summary.statistics.message_count
    assert attachment.name == "surface.ply" and attachment.data == b"ply\n" * 500
    assert metadata.metadata["epoch_s"] == str(EPOCH)
    for index in summary.chunk_indexes:
        assert isinstance(index, ChunkIndex)
        opcode, length = struct.unpack_from("<BQ", data, index.chunk_start_offset)
        assert (opcode, length + 9) == (0x06, index.chunk_length)
        assert index.message_end_time - index.message_start_time <= CHUNK_SECONDS * 1e9
        for offset in index.message_index_offsets.values():
            assert data[offset] == 0x07
    assert len(summary.chunk_indexes) == summary.statistics.chunk_count >= 4


def test_every_message_fits_its_published_schema(tmp_path: Path) -> None:
    (tmp_path / "scan.obj").write_bytes(b"v 0 0 0\n")
    with Recorder(tmp_path / "x.mcap", rig()) as recorder:
        write_frames(recorder, 2, 3)
        recorder.surface(tmp_path / "scan.obj")
        recorder.truth(trajectory(2, True))
        pixels = np.array([[1.0, 2.0], [3.0, 0.0]])
        recorder.write(Observations(0.0, np.array([0, 1]), np.array([5, -1]), pixels, np.ones(2)))
        recorder.write(pose(0.0))
        recorder.write(LOST)
        recorder.write(Move(0.0, np.zeros(6), 1.0, 0, False))
        recorder.write(Hold(0.0, 0.1, "why"))
        recorder.write(Roi(0, 0.0, np.eye(3)[:, :2]))
        recorder.sent(0.0, b"1")
        recorder.received(0.0, b"2")
        recorder.event(0.0, "words")
    seen = set()
    with open(tmp_path / "x.mcap", "rb") as file:
        for schema, channel, message in SeekingReader(file, validate_crcs=True).iter_messages():
            assert schema is not None and schema.encoding == "jsonschema" and channel.message_encoding == "json"
            parsed = json.loads(schema.data)
            assert parsed["type"] == "object" and parsed["title"] == schema.name
            if schema.name not in seen:
                jsonschema.Draft202012Validator.check_schema(parsed)
            jsonschema.validate(json.loads(message.data), parsed, cls=jsonschema.Draft202012Validator)
            seen.add(schema.name)
    assert {"foxglove.CompressedImage", "foxglove.CameraCalibration", "foxglove.FrameTransform", "foxglove.Log"} <= seen
    assert len(seen) == 13


def plain(schema: dict[str, object]) -> bool:
    """Whether Foxglove can read it: each field has one type, and arrays hold no arrays."""
    fields = schema.get("properties", {})
    assert isinstance(fields, dict)
    for field in fields.values():
        inner = field["items"] if field["type"] == "array" else field
        allowed = {"boolean", "string", "number", "integer", "object"}
        if not isinstance(inner["type"], str) or inner["type"] not in allowed or not plain(inner):
            return False
    return True


def test_every_schema_is_one_that_foxglove_reads() -> None:
    every = [*TOPICS.values(), IMAGE, CALIBRATION]
    assert all(plain(schema) for schema in every)
    assert not plain({"type": "object", "properties": {"m": {"type": "array", "items": {"type": "array"}}}})


def test_images_are_given_to_viewers_at_their_stamp(whole: Path) -> None:
    with open(whole, "rb") as file:
        found = list(SeekingReader(file).iter_messages(topics=[f"/camera/{NAMES[0]}/image"]))
    for (_, _, message), stamp in zip(found, stamps(24, 0.0), strict=True):
        assert message.log_time == round(3 * stamp * 1e9) + EPOCH * 10**9
        told = json.loads(message.data)["timestamp"]
        assert told["sec"] * 10**9 + told["nsec"] == message.log_time
