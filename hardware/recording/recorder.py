"""Recorder: writes a run's records into one MCAP file, which stays readable if the run is killed."""

from __future__ import annotations

import contextlib
import json
import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from logging import INFO
from operator import attrgetter
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import orjson
from numpy.typing import NDArray

from estimation.errors import InputError, StillbedError
from estimation.observations import Observations
from estimation.pose import SurfacePose, Trajectory
from estimation.rig import Rig
from estimation.se3 import Array
from hardware.arm.profile import ArmProfile
from hardware.files.folder_tables import rows_from_trajectory
from hardware.files.images import check_size, encode
from hardware.files.session import SURFACE_SUFFIXES, head_from_row
from hardware.motion.loop import DispenserRecord, RecordedTick
from hardware.process.checks import read_bytes
from hardware.process.system import provenance
from hardware.recording import messages, ros_messages
from hardware.recording.loop_record import LoopRecord
from hardware.recording.mcap_file import NO_SCHEMA, UTC_LOG_TIMES, ChunkMessages, sealed, walk
from hardware.recording.mcap_writer import McapWriter
from hardware.recording.messages import Message, camera_frame, image_topic
from hardware.recording.ros_messages import RosMessage
from perception.frames import Frame, OutlinedPicture, Roi
from planning.command import Command, Hold, Move
from planning.laid_beads import Look

MAX_CHUNK_SECONDS = 0.5  # s of stamps that a killed run may lose: half of the second that is promised
MAX_CHUNK_BYTES = 4 * 2**20  # a chunk is unpacked whole, so its size bounds the reader's memory
LOG_EPOCH = 1_000_000_000  # s added to log times where nobody knows when stamps began: MCAP has none below zero
MIN_WALL_CLOCK_STAMP = 1e8  # s: a first stamp above it counts from 1970
NOT_KEPT = "; nothing is kept of it"
MAX_LOG_TIME = 2**63 - 1  # ns
NO_LOG_TIMES = f"stamps + {LOG_EPOCH} s; when they began is not known"

RECORD_CHANNELS: dict[type, tuple[str, Callable[[Any], Message]]] = {  # topic and encoder of each kind of record
    Observations: ("/observations", messages.message_from_observations),
    Roi: ("/roi", messages.message_from_roi),
    OutlinedPicture: ("/wound_outline", messages.message_from_outlined),
    RecordedTick: ("/tick", messages.message_from_tick),
    LoopRecord: ("/loop", attrgetter("message")),
    DispenserRecord: ("/dispenser", messages.message_from_dispenser),
    Look: ("/look", messages.message_from_look),
    Move: ("/move", messages.message_from_move),
    Hold: ("/hold", messages.message_from_hold),
}

T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class PublishedMessage:
    """A message as it was written."""

    topic: str
    name: str | None  # of the ROS message; None: JSON
    data: bytes
    log_time: int  # ns since 1970


class Recorder:
    """Writes a recording; a context manager. Stamps, s, may start anywhere, also below zero.

    A chunk is closed and handed to the system before its stamps span more than half a second: a run that is killed at
    any instant loses no more than that (a power cut may take more). A full or lost disk is a StillbedError: what was
    written before stays readable, and later writes raise the same error. The rig and what the channels are stand in the
    first chunk and again in the second: whichever of them is damaged, the other opens the recording.

    Beside our own channels (JSON without a schema: exact, in mm, s, rad and px) the same is told in those that every
    viewer knows (`ros_messages`: ROS 2, SI units). The file has the profile `ros2`.
    """

    def __init__(
        self,
        path: str | Path,
        rig: Rig,
        jpeg_quality: int | None = None,
        overwrite: bool = False,
        compress: bool = True,
        kept: bool = True,
        began: int | None = None,
        listener: Callable[[PublishedMessage], None] | None = None,
    ) -> None:
        """Create the file at `path`; images are stored as PNG, or as JPEG of `jpeg_quality` (0-100).

        compress: whether chunks are compressed, which saves a quarter of the file and costs a third of the time.
        kept: whether the caller leaves the file where it stands after a failure; said in the error.
        began: UTC at stamp 0, ns since 1970; None where nobody knows it.
        listener: is given every message that is written.
        """
        self.path, self.rig = Path(path), rig
        self._jpeg_quality, self._kept = jpeg_quality, kept
        self._channels: dict[str, int] = {}
        self._schemas: dict[str, int] = {}
        self._numbers = [0] * len(rig)  # next frame number per camera
        self._epoch: int | None = None  # ns that log times are ahead of stamps, known at the first stamp
        self._began, self._listener = began, listener
        self._viewers = ros_messages.ViewerChannels(rig)
        self._chunk_start = math.nan  # s, stamp of the open chunk's first message
        self._repeated = False  # whether the second chunk has begun, with the rig once more
        self._last: dict[str, float] = {}  # s, per stream of images or truth
        self._failed = ""
        self._closed = False
        try:
            self._file = open(self.path, "wb" if overwrite else "xb")  # noqa: SIM115  (closed in `close`)
        except FileExistsError:
            raise InputError(self.path, "recording", "a file that exists", "a new file, or --force") from None
        except OSError as error:
            raise StillbedError(f"{self.path}: cannot write: {error}") from error
        self._writer = McapWriter(self._file, MAX_CHUNK_BYTES, compress)
        self._guarded(lambda: self._writer.start("ros2", "stillbed"))

    def __enter__(self) -> Recorder:
        return self

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        try:
            self.close()
        except StillbedError:
            if error is None:
                raise

    def write(
        self,
        record: Frame
        | Observations
        | SurfacePose
        | Command
        | Roi
        | OutlinedPicture
        | RecordedTick
        | LoopRecord
        | DispenserRecord
        | Look,
    ) -> None:
        """Write a record to its channel at its own stamp."""
        if isinstance(record, Frame):
            self.frame(record)
        elif isinstance(record, SurfacePose):
            self._pose(record)
        else:
            topic, encoded = next(entry for kind, entry in RECORD_CHANNELS.items() if isinstance(record, kind))
            self._message(topic, record.stamp, encoded(record))
        if isinstance(record, Observations):
            self._viewers.take_tracks(record)
        elif isinstance(record, RecordedTick):
            self._publish(self._viewers.tick(record, self._log_time(record.stamp)), record.stamp)

    def frame(self, frame: Frame, camera_stamp: float | None = None) -> None:
        """Write an image; camera_stamp: s on the camera's own clock, by default the frame's less the clock offset."""
        camera = self.rig.cameras[frame.camera]
        check_size(frame.image, camera.size, self.path, f"image of camera {camera.name!r}")
        self.encoded_frame(frame.camera, frame.stamp, *encode(frame.image, self._jpeg_quality), camera_stamp)

    def encoded_frame(
        self, camera: int, stamp: float, kind: str, data: bytes, camera_stamp: float | None = None
    ) -> None:
        """Write an image that is already PNG or JPEG (`kind` "png" or "jpeg"); stamps in s as in `frame`."""
        camera_clock_stamp = stamp - self.rig.cameras[camera].clock_offset if camera_stamp is None else camera_stamp
        name, number = self.rig.cameras[camera].name, self._numbers[camera]
        self._check_rising(f"stamp of camera {name!r}", stamp)
        image = ros_messages.image(kind, data, camera_frame(name), self._log_time(stamp))
        self._publish([RosMessage(image_topic(name), ros_messages.IMAGE, image)], stamp, number)
        entry = {"stamp": stamp, "camera_stamp": camera_clock_stamp, "camera": int(camera), "number": number}
        self._message("/frames", stamp, entry)  # after the image: where this can be read, the image can
        self._numbers[camera] += 1

    def truth(self, trajectory: Trajectory) -> None:
        """Write known or measured poses, each at its own stamp."""
        for row in rows_from_trajectory(trajectory):
            self.truth_row(row, trajectory.exact)

    def truth_row(self, row: Array, exact: bool) -> None:
        """Write one pose (8,): stamp x y z qx qy qz qw, s and mm, unchanged."""
        self._check_rising("stamp of truth", float(row[0]))
        self._message("/truth", float(row[0]), messages.message_from_truth(row, exact))
        self._viewers.take_truth(float(row[0]), head_from_row(row, False).base_from_nozzle)

    def head_row(self, row: Array, extruding: bool, shown: bool = True) -> None:
        """Write where the print head was at a frame set: (8,) stamp x y z qx qy qz qw, s and mm, base_from_nozzle.

        shown: whether viewers are shown it as well.
        """
        self._check_rising("stamp of the print head", float(row[0]))
        stamp = float(row[0])
        self._message("/head", stamp, messages.message_from_head(row, extruding))
        if shown:
            self.show_nozzle(stamp, head_from_row(row, extruding).base_from_nozzle)

    def show_arm(self, profile: ArmProfile) -> None:
        """Show viewers the nozzle of this arm by the ticks from now on."""
        self._viewers.arm(profile)

    def show_nozzle(self, stamp: float, base_from_nozzle: Array) -> None:
        """Show viewers where the nozzle is, (4, 4) mm."""
        self._publish(self._viewers.nozzle(base_from_nozzle, self._log_time(stamp)), stamp)

    def show_path(self, stamp: float, points: Array, places: Array) -> None:
        """Show viewers the path: points (N, 3), mm, surface frame, and how far along it each is (N,), rising."""
        self._publish(self._viewers.path(points, places, self._log_time(stamp)), stamp)

    def progress(self, stamp: float, place: float) -> None:
        """Show viewers how far the print is, in the unit of the path's places."""
        self._publish(self._viewers.progress(stamp, place, self._log_time(stamp)), stamp)

    def show_surface(self, stamp: float, landmarks: Array, outlines: Sequence[Array] = ()) -> None:
        """Show viewers landmarks (N, 3) and outlines (K, 3), mm, surface frame."""
        self._publish(self._viewers.surface(landmarks, outlines, self._log_time(stamp)), stamp)

    def show_scan(self, stamp: float, points: Array) -> None:
        """Show viewers the scan's vertices (N, 3), mm, where they lie in the surface frame."""
        self._publish(self._viewers.scan(points, self._log_time(stamp)), stamp)

    def error(self, stamp: float, name: str, millimetres: float) -> None:
        """Show viewers an error, as /error/`name`."""
        self._publish([self._viewers.error(name, millimetres)], stamp)

    def surface(self, path: Path) -> None:
        """Attach the scan (ply, stl or obj, mm) as it is."""
        if path.suffix.lower() not in SURFACE_SUFFIXES:
            raise InputError(path, "surface", path.name, f"a file {', '.join(SURFACE_SUFFIXES)}")
        data = read_bytes(path)
        name = f"surface{path.suffix.lower()}"
        self._guarded(lambda: self._writer.add_attachment(name, "model/" + path.suffix.lower()[1:], data))

    def sent(self, stamp: float, data: bytes) -> None:
        """Write bytes that went to the arm at `stamp`, s."""
        self._message("/arm/sent", stamp, messages.message_from_bytes(stamp, data))

    def received(self, stamp: float, data: bytes) -> None:
        """Write bytes that came from the arm at `stamp`, s."""
        self._message("/arm/received", stamp, messages.message_from_bytes(stamp, data))

    def event(self, stamp: float, text: str, level: int = INFO, name: str = "stillbed") -> None:
        """Write an event at `stamp`, s. level: of Python's logging, whose numbers are ROS's."""
        log_message = ros_messages.log(level, text, name, self._log_time(stamp))
        self._publish([RosMessage("/events", ros_messages.LOG, log_message)], stamp)

    def latency(self, stamp: float, stage: str, width: float, counts: NDArray[np.int64], most: float) -> None:
        """Write how long a stage took until `stamp`, s: counts (N,) in bins of `width` s, and the largest, s."""
        message = {"stamp": stamp, "stage": stage, "width": width, "counts": counts.tolist(), "most": most}
        self._message("/latency", stamp, message)

    def trace(self, stamp: float, message: Message) -> None:
        """Write what a process did of frame sets until `stamp`, s, as `hardware/live/trace.py` has it."""
        self._message("/trace", stamp, message)

    def attach(self, name: str, data: bytes) -> None:
        """Keep a file of the run in the recording, as text."""
        self._guarded(lambda: self._writer.add_attachment(name, "text/plain", data))

    def flush(self) -> None:
        """Close the open chunk and hand everything to the system."""
        self._guarded(self._writer.flush)
        self._chunk_start = math.nan

    def close(self) -> None:
        """Write the index and close the file; after a failure keep what reached the disk. Twice is once."""
        if self._closed:
            return
        self._closed = True
        try:
            if not self._failed:
                if self._epoch is None:
                    self._begin(0.0)
                self._guarded(self._writer.finish)
                self._guarded(self._file.flush)
        finally:
            with contextlib.suppress(OSError):  # was raised already, for the same bytes
                self._file.close()

    def _pose(self, pose: SurfacePose) -> None:
        self._message("/pose", pose.stamp, messages.message_from_pose(pose))
        self._publish(self._viewers.pose(pose, self._log_time(pose.stamp)), pose.stamp)

    def _check_rising(self, stream: str, stamp: float) -> None:
        """InputError for a stamp not later than the stream's last: the reader would refuse the whole file."""
        last = self._last.get(stream, -math.inf)
        if not stamp > last:
            raise InputError(self.path, stream, stamp, f"later than the one before, {last} s")
        self._last[stream] = stamp

    def _log_time(self, stamp: float) -> int:
        """Whole ns for viewers; the exact stamp stands in the message."""
        if not math.isfinite(stamp):
            raise InputError(self.path, "stamp", stamp, "a finite number of seconds")
        if self._epoch is None:
            self._begin(stamp)
        assert self._epoch is not None
        log_time = round(stamp * 1e9) + self._epoch
        if not 0 <= log_time <= MAX_LOG_TIME:
            allowed = f"{-self._epoch / 1e9:.0f} .. {(MAX_LOG_TIME - self._epoch) / 1e9:.0f} s"
            raise InputError(self.path, "stamp", stamp, allowed)
        return log_time

    def _begin(self, stamp: float) -> None:
        """Write the rig at the first stamp, when it is known what log times are."""
        known = self._began if self._began is not None else 0 if stamp > MIN_WALL_CLOCK_STAMP else None
        self._epoch = LOG_EPOCH * 1_000_000_000 if known is None else known
        table = {"epoch_ns": str(self._epoch), "log_times": UTC_LOG_TIMES if known is not None else NO_LOG_TIMES}
        table |= {"units": "own channels: mm, s, rad, px; ROS's: m, s, rad, px", **provenance().texts()}
        self._guarded(lambda: self._writer.add_metadata("stillbed", sealed(table)))
        self._define(stamp)

    def _define(self, stamp: float) -> None:
        """The rig, as we read it and as viewers do."""
        self._message("/rig", stamp, messages.message_from_rig(self.rig))
        self._publish(self._viewers.start(self._log_time(stamp)), stamp)

    def _message(self, topic: str, stamp: float, message: Message) -> None:
        self._add(topic, None, stamp, self._text(topic, message))

    def _publish(self, shown: Iterable[RosMessage], stamp: float, sequence: int = 0) -> None:
        for each in shown:
            self._add(each.topic, each.name, stamp, each.data, sequence)

    def _add(self, topic: str, name: str | None, stamp: float, data: bytes, sequence: int = 0) -> None:
        """Write an encoded message; name: of the ROS message that it is, None for JSON."""
        log_time = self._log_time(stamp)
        if abs(stamp - self._chunk_start) >= MAX_CHUNK_SECONDS:
            self.flush()
        if math.isnan(self._chunk_start):
            self._chunk_start = stamp
        if self._writer.chunks == 1 and not self._repeated:
            self._repeated = True  # before the rig comes here itself
            self._guarded(self._writer.repeat_definitions)
            self._define(stamp)
        channel = self._channel(topic, name)
        self._guarded(lambda: self._writer.add_message(channel, log_time, data, sequence))
        if self._listener is not None:
            self._listener(PublishedMessage(topic, name, data, log_time))

    def _text(self, topic: str, message: Message) -> bytes:
        data = orjson.dumps(message, option=orjson.OPT_SERIALIZE_NUMPY)
        if b"null" in data:  # orjson's word for a number that is not finite; it may be part of a text
            try:
                json.dumps(message, allow_nan=False)
            except ValueError:
                raise InputError(self.path, topic, message, "finite numbers") from None
        return data

    def _channel(self, topic: str, name: str | None) -> int:
        if topic not in self._channels:
            if name is not None and name not in self._schemas:
                text = ros_messages.definition(name).encode()
                self._schemas[name] = self._guarded(lambda: self._writer.register_schema(name, "ros2msg", text))
            number, encoding = (NO_SCHEMA, "json") if name is None else (self._schemas[name], "cdr")
            self._channels[topic] = self._guarded(lambda: self._writer.register_channel(topic, encoding, number))
        return self._channels[topic]

    def _guarded(self, action: Callable[[], T]) -> T:
        """Run one write; an error of the disk becomes a StillbedError, now and at every later write."""
        if self._failed:
            raise StillbedError(self._failed)
        try:
            return action()
        except OSError as error:
            self._failed = f"{self.path}: recording stopped, {(error.strerror or str(error)).lower()}{self._remains()}"
            raise StillbedError(self._failed) from error

    def _remains(self) -> str:
        """Whether the file is still readable after a failed write, as a text."""
        if not self._kept:
            return NOT_KEPT
        try:
            readable = any(isinstance(record, ChunkMessages) and record.messages for record in walk(self.path))
        except (InputError, OSError):
            readable = False
        return "; what was written before is kept" if readable else "; nothing of it can be read"
