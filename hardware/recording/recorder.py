"""Recorder: writes a run's records into one MCAP file, which stays readable if the run is killed."""

from __future__ import annotations

import contextlib
import json
import math
from collections.abc import Callable
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
from hardware.files.folder_tables import rows_from_trajectory
from hardware.files.images import IMAGE_CHANNEL, check_size, encode, pack_image
from hardware.files.session import SURFACE_SUFFIXES
from hardware.motion.loop import RecordedTick
from hardware.motion.material import DispenserRecord
from hardware.process.checks import read_bytes
from hardware.recording import messages
from hardware.recording.mcap_file import ChunkMessages, walk
from hardware.recording.mcap_writer import McapWriter
from hardware.recording.messages import SURFACE_FRAME, Message
from hardware.recording.schemas import CALIBRATION, INFO, TOPICS, Schema, calibration_topic, camera_frame, image_topic
from perception.frames import Frame, OutlinedPicture, Roi
from planning.command import Command, Hold, Move

MAX_CHUNK_SECONDS = 0.5  # s of stamps that a killed run may lose: half of the second that is promised
MAX_CHUNK_BYTES = 4 * 2**20  # a chunk is unpacked whole, so its size bounds the reader's memory
LOG_EPOCH = 1_000_000_000  # s added to log times where stamps do not count from 1970: MCAP has none below zero
MIN_WALL_CLOCK_STAMP = 1e8  # s: a first stamp above it counts from 1970
NOT_KEPT = "; nothing is kept of it"
MAX_LOG_TIME = 2**63 - 1  # ns

RECORD_CHANNELS: dict[type, tuple[str, Callable[[Any], Message]]] = {  # topic and encoder of each kind of record
    Observations: ("/observations", messages.message_from_observations),
    Roi: ("/roi", messages.message_from_roi),
    OutlinedPicture: ("/wound_outline", messages.message_from_outlined),
    RecordedTick: ("/tick", messages.message_from_tick),
    DispenserRecord: ("/dispenser", messages.message_from_dispenser),
    Move: ("/move", messages.message_from_move),
    Hold: ("/hold", messages.message_from_hold),
}

T = TypeVar("T")


class Recorder:
    """Writes a recording; a context manager. Stamps, s, may start anywhere, also below zero.

    A chunk is closed and handed to the system before its stamps span more than half a second: a run that is killed at
    any instant loses no more than that (a power cut may take more). A full or lost disk is a StillbedError: what was
    written before stays readable, and later writes raise the same error. The rig and what the channels are stand in the
    first chunk and again in the second: whichever of them is damaged, the other opens the recording.
    """

    def __init__(
        self,
        path: str | Path,
        rig: Rig,
        jpeg_quality: int | None = None,
        overwrite: bool = False,
        compress: bool = True,
        kept: bool = True,
    ) -> None:
        """Create the file at `path`; images are stored as PNG, or as JPEG of `jpeg_quality` (0-100).

        compress: whether chunks are compressed, which saves a quarter of the file and costs a third of the time.
        kept: whether the caller leaves the file where it stands after a failure; said in the error.
        """
        self.path, self.rig = Path(path), rig
        self._jpeg_quality, self._kept = jpeg_quality, kept
        self._channels: dict[str, int] = {}
        self._schemas: dict[str, int] = {}
        self._numbers = [0] * len(rig)  # next frame number per camera
        self._epoch: int | None = None  # s, known at the first stamp
        self._chunk_start = math.nan  # s, stamp of the open chunk's first message
        self._repeated = False  # whether the second chunk has begun, with the rig once more
        self._last: dict[str, float] = {}  # s, per stream of images or truth
        self._failed = ""
        self._closed = False
        try:
            self._file = open(self.path, "wb" if overwrite else "xb")  # noqa: SIM115  (closed in `close`)
        except FileExistsError:
            allowed = "a new file, or leave to overwrite"
            raise InputError(self.path, "recording", "a file that exists", allowed) from None
        except OSError as error:
            raise StillbedError(f"{self.path}: cannot write: {error}") from error
        self._writer = McapWriter(self._file, MAX_CHUNK_BYTES, compress)
        self._guarded(lambda: self._writer.start("stillbed"))

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
        record: Frame | Observations | SurfacePose | Command | Roi | OutlinedPicture | RecordedTick | DispenserRecord,
    ) -> None:
        """Write a record to its channel at its own stamp."""
        if isinstance(record, Frame):
            self.frame(record)
        elif isinstance(record, SurfacePose):
            self._pose(record)
        else:
            topic, encoded = next(each for kind, each in RECORD_CHANNELS.items() if isinstance(record, kind))
            self._message(topic, record.stamp, encoded(record))

    def frame(self, frame: Frame, camera_stamp: float | None = None) -> None:
        """Write an image; camera_stamp: s on the camera's own clock, by default the frame's less the clock offset."""
        camera = self.rig.cameras[frame.camera]
        check_size(frame.image, camera.size, self.path, f"image of camera {camera.name!r}")
        self.encoded_frame(frame.camera, frame.stamp, *encode(frame.image, self._jpeg_quality), camera_stamp)

    def encoded_frame(
        self, camera: int, stamp: float, kind: str, data: bytes, camera_stamp: float | None = None
    ) -> None:
        """Write an image that is already PNG or JPEG (`kind` "png" or "jpeg"); stamps in s as in `frame`."""
        own = stamp - self.rig.cameras[camera].clock_offset if camera_stamp is None else camera_stamp
        name, number = self.rig.cameras[camera].name, self._numbers[camera]
        self._check_rising(f"stamp of camera {name!r}", stamp)
        image = pack_image(kind, data, camera_frame(name), self._log_time(stamp))
        self._add(image_topic(name), None, stamp, image, number)
        entry = {"stamp": stamp, "camera_stamp": own, "camera": int(camera), "number": number}
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

    def head_row(self, row: Array, extruding: bool) -> None:
        """Write where the print head was at a frame set: (8,) stamp x y z qx qy qz qw, s and mm, base_from_nozzle."""
        self._check_rising("stamp of the print head", float(row[0]))
        self._message("/head", float(row[0]), messages.message_from_head(row, extruding))

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
        """Write an event at `stamp`, s."""
        log_time = self._log_time(stamp)
        self._message("/events", stamp, messages.message_from_event(stamp, level, text, name, log_time))

    def latency(self, stamp: float, stage: str, width: float, counts: NDArray[np.int64], most: float) -> None:
        """Write how long a stage took until `stamp`, s: counts (N,) in bins of `width` s, and the largest, s."""
        message = {"stamp": stamp, "stage": stage, "width": width, "counts": counts.tolist(), "most": most}
        self._message("/latency", stamp, message)

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
        if np.isfinite(pose.base_from_surface).all():
            log_time = self._log_time(pose.stamp)
            transform = messages.message_from_transform(pose.base_from_surface, SURFACE_FRAME, log_time)
            self._message("/tf", pose.stamp, transform)

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
        log_time = round(stamp * 1e9) + self._epoch * 1_000_000_000
        if not 0 <= log_time <= MAX_LOG_TIME:
            raise InputError(self.path, "stamp", stamp, f"-{self._epoch} .. {MAX_LOG_TIME / 1e9 - self._epoch:.0f} s")
        return log_time

    def _begin(self, stamp: float) -> None:
        """Write the rig at the first stamp: at 0 s viewers would see a recording that starts in 1970."""
        self._epoch = 0 if stamp > MIN_WALL_CLOCK_STAMP else LOG_EPOCH
        epoch = {"epoch_s": str(self._epoch), "units": "mm, s, rad, px"}
        self._guarded(lambda: self._writer.add_metadata("stillbed", epoch))
        self._message("/rig", stamp, messages.message_from_rig(self.rig))
        log_time = self._log_time(stamp)
        for camera in self.rig.cameras:
            calibration = messages.message_from_calibration(camera, log_time)
            self._message(calibration_topic(camera.name), stamp, calibration, CALIBRATION)
            transform = messages.message_from_transform(camera.base_from_camera, camera_frame(camera.name), log_time)
            self._message("/tf", stamp, transform)

    def _message(self, topic: str, stamp: float, message: Message, schema: Schema | None = None) -> None:
        self._add(topic, TOPICS[topic] if schema is None else schema, stamp, self._text(topic, message))

    def _add(self, topic: str, schema: Schema | None, stamp: float, data: bytes, sequence: int = 0) -> None:
        """Write an encoded message; schema: None for an image."""
        log_time = self._log_time(stamp)
        if abs(stamp - self._chunk_start) >= MAX_CHUNK_SECONDS:
            self.flush()
        if math.isnan(self._chunk_start):
            self._chunk_start = stamp
        if self._writer.chunks == 1 and not self._repeated:
            self._repeated = True  # before the rig comes here itself
            self._guarded(self._writer.repeat_definitions)
            self._message("/rig", stamp, messages.message_from_rig(self.rig))
        channel = self._channel(topic, schema)
        self._guarded(lambda: self._writer.add_message(channel, log_time, data, sequence))

    def _text(self, topic: str, message: Message) -> bytes:
        data = orjson.dumps(message, option=orjson.OPT_SERIALIZE_NUMPY)
        if b"null" in data:  # orjson's word for a number that is not finite; it may be part of a text
            try:
                json.dumps(message, allow_nan=False)
            except ValueError:
                raise InputError(self.path, topic, message, "finite numbers") from None
        return data

    def _channel(self, topic: str, schema: Schema | None) -> int:
        if topic not in self._channels:
            name, kind, encoding, text = IMAGE_CHANNEL
            if schema is not None:
                name, kind, encoding, text = schema["title"], "jsonschema", "json", orjson.dumps(schema)
            if name not in self._schemas:
                self._schemas[name] = self._guarded(lambda: self._writer.register_schema(name, kind, text))
            number = self._schemas[name]
            self._channels[topic] = self._guarded(lambda: self._writer.register_channel(topic, encoding, number))
        return self._channels[topic]

    def _guarded(self, action: Callable[[], T]) -> T:
        """Run one write; an error of the disk becomes a StillbedError, now and at every later write."""
        if self._failed:
            raise StillbedError(self._failed)
        try:
            return action()
        except OSError as error:
            self._failed = f"{self.path}: recording stopped, {(error.strerror or str(error)).lower()}{self._left()}"
            raise StillbedError(self._failed) from error

    def _left(self) -> str:
        """What a failed write leaves, by a look at the file."""
        if not self._kept:
            return NOT_KEPT
        try:
            readable = any(isinstance(part, ChunkMessages) and part.messages for part in walk(self.path))
        except (InputError, OSError):
            readable = False
        return "; what was written before is kept" if readable else "; nothing of it can be read"
