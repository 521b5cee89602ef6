"""Recordings: every record comes back, what could not is refused; images are what ROS reads as one."""

from __future__ import annotations

import gc
from dataclasses import fields
from logging import WARNING
from pathlib import Path
from typing import BinaryIO

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from mcap.records import ChunkIndex
from mcap.writer import CompressionType, Writer

from estimation.errors import InputError, StillbedError
from estimation.observations import Observations
from estimation.pose import TrackState
from hardware.files.folder_tables import rows_from_trajectory
from hardware.files.images import encode
from hardware.files.rig_file import table_from_rig
from hardware.recording import ros_messages
from hardware.recording import session_reader as channels
from hardware.recording.mcap_file import ChunkMessages, StoredMessage, walk
from hardware.recording.messages import bytes_from_message
from hardware.recording.recorder import Recorder
from hardware.recording.ros_messages import image_from
from hardware.recording.session_reader import open_session
from perception.frames import Frame, Roi
from planning.command import Hold, Move
from tests.recording_samples import LOST, events, pose, write_frames
from tests.session_files import image, rig, stamps, trajectory

EXACT_STAMPS = st.floats(-1e8, 1e8) | st.floats(1e9, 4e9)


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
def test_round_trips(tmp_path_factory: pytest.TempPathFactory, stamp: float, seed: int, size: int, data: bytes) -> None:
    path = tmp_path_factory.mktemp("r") / "x.mcap"
    draw = np.random.default_rng(seed)
    camera, track = draw.integers(0, 3, size), draw.integers(0, 2**62, size)
    seen = Observations(stamp, camera, track, draw.normal(size=(size, 2)) * 1e3, draw.random(size))
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
    for name in ("warp", "forecast"):
        written, read = getattr(pose(stamp, seed), name), getattr(estimate, name)
        assert written is not None and read is not None
        for field in fields(written):
            assert np.array_equal(getattr(read, field.name), getattr(written, field.name))
    assert repr(estimate.motion) == repr(pose(stamp, seed).motion)  # NaN equals nothing, but is written like itself
    first, second, third = channels.read_commands(path)
    assert isinstance(first, Move) and isinstance(third, Move) and second == hold
    assert first.axes.tobytes() == move.axes.tobytes()
    assert (first.stamp, first.feed, first.checkpoint, first.extrude) == (stamp, 1 / 3, 7, True)
    sent, received = (channels.read_channels(path, {f"/arm/{way}": dict}) for way in ("sent", "received"))
    assert [(m["stamp"], bytes_from_message(m)) for m in sent] == [(stamp, data)]
    assert [(m["stamp"], bytes_from_message(m)) for m in received] == [(stamp, data[::-1])]
    (event,) = events(path)
    assert (event.level, event.text) == (WARNING, "drape moved") and event.stamp == pytest.approx(
        min(stamp, ros_messages.MAX_TIME_SECOND + stamp % 1), abs=1e-6
    )
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
        recorder.write(Roi(1, -0.1, polygon, found=True))
        write_frames(recorder, 5)
        recorder.truth(trajectory(5, True))
    session = open_session(tmp_path / "x.mcap")
    assert session.surface is not None and session.surface.suffix == ".stl"
    assert session.surface.read_bytes() == scan.read_bytes()
    assert session.roi[0].camera == 1 and session.roi[0].polygon.tobytes() == polygon.tobytes() and session.roi[0].found
    assert session.truth is not None and session.truth.exact
    assert session.truth.stamps.tolist() == stamps(5)
    assert np.abs(session.truth.base_from_surface - trajectory(5, True).base_from_surface).max() < 1e-13
    copy = session.surface
    del session
    assert not copy.exists()  # it went with the session


def test_jpeg_is_smaller_and_nearly_the_same(tmp_path: Path) -> None:
    rough = np.add.outer(np.arange(48), np.arange(64)).astype(np.uint8) + image(0, 0)[..., 0] % 8
    for name, quality in (("png", None), ("jpeg", 80)):
        with Recorder(tmp_path / name, rig(2), jpeg_quality=quality) as recorder:
            recorder.write(Frame(0, 0.0, rough))
    (frames,) = open_session(tmp_path / "jpeg").frame_sets()
    assert 0 < np.abs(frames.frames[0].image.astype(int) - rough).max() < 16
    assert (tmp_path / "jpeg").stat().st_size < (tmp_path / "png").stat().st_size


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


class LibraryWriter:
    """The library's own writer, called as ours."""

    def __init__(self, file: BinaryIO, chunk_size: int, compress: bool) -> None:
        kind = CompressionType.ZSTD if compress else CompressionType.NONE
        self.writer = writer = Writer(file, chunk_size=chunk_size, compression=kind)
        self.register_schema, self.register_channel = writer.register_schema, writer.register_channel
        self.add_metadata, self.flush, self.finish = writer.add_metadata, writer.flush, writer.finish

    def start(self, profile: str, library: str) -> None:
        self.writer.start(profile, library)

    @property
    def chunks(self) -> int:
        return len(self.writer._Writer__chunk_indices)

    def repeat_definitions(self) -> None:
        builder = self.writer._Writer__chunk_builder
        for schema in self.writer._Writer__schemas.values():
            builder.add_schema(schema)
        for channel in self.writer._Writer__channels.values():
            builder.add_channel(channel)

    def add_message(self, channel: int, log_time: int, data: bytes, sequence: int) -> None:
        self.writer.add_message(channel, log_time, data, log_time, sequence)

    def add_attachment(self, name: str, media_type: str, data: bytes) -> None:
        self.writer.add_attachment(0, 0, name, media_type, data)


@pytest.mark.parametrize("compress", [True, False])
def test_an_index_as_bytes_gives_the_very_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, compress: bool) -> None:
    def record(name: str) -> tuple[bytes, int]:
        with Recorder(tmp_path / name, rig(), compress=compress) as recorder:
            recorder.attach("notes.txt", b"before all")
            recorder.event(-1.0, "earlier than all else")
            write_frames(recorder, 60, 3, 0.0)
            recorder.attach("more.txt", b"amid it")
            held = sum(isinstance(each, ChunkIndex) for each in gc.get_objects())
        return (tmp_path / name).read_bytes(), held

    packed, held = record("packed.mcap")
    monkeypatch.setattr("hardware.recording.recorder.McapWriter", LibraryWriter)
    plain, chunks = record("plain.mcap")
    assert packed == plain and held == 0 and chunks > 2


def test_an_image_that_is_broken_inside_a_sound_file_is_named(tmp_path: Path) -> None:
    path = tmp_path / "x.mcap"
    with Recorder(path, rig(2)) as recorder:
        recorder.write(Frame(0, 0.0, image(0, 0)))
    chunks = (part for part in walk(path) if isinstance(part, ChunkMessages))
    stored = next(message for chunk in chunks for message in chunk.messages if "image" in message.topic)
    assert isinstance(stored, StoredMessage) and image_from(stored.data) == encode(image(0, 0))
    with Recorder(path, rig(2), overwrite=True) as recorder:
        recorder.encoded_frame(0, 0.0, "png", b"no picture")
    with pytest.raises(InputError, match="undecodable"):
        open_session(path)
