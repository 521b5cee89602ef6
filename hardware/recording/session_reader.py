"""Recordings read back: as a session, one channel at a time, and the path and arm that a run used.

A damaged file is read up to its damage. Sessions of both containers, folder and MCAP file, are opened here.
"""

from __future__ import annotations

import shutil
import tempfile
import weakref
from collections import OrderedDict
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO, TypeVar

import numpy as np

from estimation.errors import InputError
from estimation.observations import Observations
from estimation.pose import SurfacePose, Trajectory
from estimation.rig import Rig
from estimation.se3 import Array
from hardware.arm.profile import ArmProfile
from hardware.files import images as compressed_image
from hardware.files.arm_file import arm_from_text, arm_text
from hardware.files.folder_tables import check_polygon, checked_rows, trajectory_from_rows
from hardware.files.images import check_size, decode
from hardware.files.path_file import path_from_text, path_text
from hardware.files.session import SURFACE_SUFFIXES, FrameRef, PrintHeadLog, Session, head_from_row, pair_refs
from hardware.files.session_folder import open_folder
from hardware.recording import messages
from hardware.recording.mcap_file import AttachedFile, ChunkMessages, Damage, StoredMessage, chunk_messages, parse, walk
from hardware.recording.messages import Message
from hardware.recording.schemas import image_topic
from perception.frames import Image, PrintHead, Roi
from planning.command import Command
from planning.path import Path as PrintPath

CACHED_CHUNKS = 4  # frames of one instant lie in neighbouring chunks

SURFACE_NAMES = tuple(f"surface{suffix}" for suffix in SURFACE_SUFFIXES)  # an attachment with a path in it is none

# of an image's topic and number: offset of its chunk, place in it, how it is encoded
ImagePlaces = dict[tuple[str, int], tuple[int, int, str]]


@dataclass(slots=True)
class RecordingContents:
    """What a walk through a recording found: everything but the images, and the chunk each image is in.

    A run that is interrupted while it writes may store a chunk twice: what is told twice counts once.
    """

    rig: Rig | None = None
    rois: dict[tuple[int, float], Roi] = field(default_factory=dict)
    truth: set[tuple[float, ...]] = field(default_factory=set)
    exact: bool = False
    heads: set[tuple[tuple[float, ...], bool]] = field(default_factory=set)
    frames: dict[tuple[int, int], FrameRef] = field(default_factory=dict)
    places: ImagePlaces = field(default_factory=dict)
    surface: AttachedFile | None = None
    damage: str = ""


def open_session(path: str | Path) -> Session:
    """Open a session folder or an .mcap file; InputError says what is wrong with it."""
    path = Path(path)
    if path.is_dir():
        return open_folder(path)
    if not path.exists():
        raise InputError(path, "session", "no such file or folder", "a session folder (with rig.toml) or an .mcap file")
    return open_recording(path)


def open_recording(path: Path) -> Session:
    """Open an .mcap recording; what is damaged is left out and told in `Session.damage`."""
    contents = _contents(path)
    rig = contents.rig
    if rig is None:
        raise InputError(path, "/rig", contents.damage or "no message", "a stillbed.Rig (written at the first stamp)")
    frames = list(contents.frames.values())
    _check_frames(path, contents, rig)
    stamps = [np.array(sorted(r.stamp for r in frames if r.camera == c)) for c in range(len(rig))]
    for camera, times in zip(rig.cameras, stamps, strict=True):
        if (np.diff(times) <= 0).any():
            raise InputError(path, f"/frames: stamp of camera {camera.name!r}", "one stamp twice", "each stamp once")
    store = RecordingStore(path, rig, contents.places)
    _check_first_images(store, frames)
    rois = _checked_rois(path, contents, rig)
    truth, heads, surface = _truth(path, contents), _heads(path, contents), _unpacked_surface(contents.surface, store)
    return Session(path, rig, rois, surface, truth, pair_refs(frames, stamps, len(rig)), store, contents.damage, heads)


def _contents(path: Path) -> RecordingContents:
    contents = RecordingContents()
    for part in walk(path):
        if isinstance(part, Damage):
            contents.damage = part.text
        elif isinstance(part, AttachedFile):
            if part.name in SURFACE_NAMES:
                contents.surface = part
        else:
            for index, stored in enumerate(part.messages):
                _take(path, contents, (part.offset, index), stored)
    return contents


def _take(path: Path, contents: RecordingContents, place: tuple[int, int], stored: StoredMessage) -> None:
    if stored.topic.endswith("/image"):
        contents.places[stored.topic, stored.sequence] = *place, stored.encoding
    elif stored.topic in ("/rig", "/roi", "/truth", "/head", "/frames"):
        message = parse(path, stored)
        try:
            _take_message(path, contents, stored.topic, message)
        except (KeyError, TypeError, ValueError, OverflowError) as error:
            raise InputError(path, stored.topic, repr(error), "a message of its schema") from error


def _take_message(path: Path, contents: RecordingContents, topic: str, message: Message) -> None:
    if topic == "/rig":
        contents.rig = messages.rig_from_message(f"{path} /rig", message)
    elif topic == "/roi":
        roi = messages.roi_from_message(message)
        contents.rois[roi.camera, roi.stamp] = roi
    elif topic == "/truth":
        contents.truth.add(tuple(messages.row_from_message(message)))
        contents.exact = bool(message["exact"])
    elif topic == "/head":
        if not isinstance(message["extruding"], bool):
            raise InputError(path, "/head: extruding", message["extruding"], "true or false")
        contents.heads.add((tuple(messages.row_from_message(message)), message["extruding"]))
    else:
        own, common = float(message["camera_stamp"]), float(message["stamp"])
        camera, number = int(message["camera"]), int(message["number"])
        contents.frames[camera, number] = FrameRef(camera, number, own, common)


def _check_frames(path: Path, contents: RecordingContents, rig: Rig) -> None:
    if not contents.frames:
        raise InputError(path, "/frames", contents.damage or "no message", "at least one image")
    for ref in contents.frames.values():
        if not 0 <= ref.camera < len(rig):
            raise InputError(path, "/frames: camera", ref.camera, f"a camera of /rig, 0..{len(rig) - 1}")
        if not np.isfinite([ref.stamp, ref.camera_stamp]).all():
            raise InputError(path, "/frames: stamp", [ref.stamp, ref.camera_stamp], "finite numbers of seconds")
        topic = image_topic(rig.cameras[ref.camera].name)
        if (topic, ref.number) not in contents.places:
            raise InputError(
                path, f"{topic}: image", f"no number {ref.number}", "an image for every message of /frames"
            )


def _checked_rois(path: Path, contents: RecordingContents, rig: Rig) -> tuple[Roi, ...]:
    for i, roi in enumerate(contents.rois.values()):
        if not 0 <= roi.camera < len(rig) or not np.isfinite(roi.stamp):
            got = f"camera {roi.camera} at {roi.stamp} s"
            raise InputError(path, f"/roi[{i}]", got, f"a camera of /rig, 0..{len(rig) - 1}, and a finite stamp")
        check_polygon(path, f"/roi[{i}]", roi.polygon, rig.cameras[roi.camera].size)
    return tuple(contents.rois.values())


def _check_first_images(store: RecordingStore, frames: list[FrameRef]) -> None:
    reader = store.open()
    first = {ref.camera: ref for ref in reversed(frames)}
    for ref in first.values():
        reader.read(ref)
    reader.close()


def _truth(path: Path, contents: RecordingContents) -> Trajectory | None:
    if not contents.truth:
        return None
    rows = checked_rows(path, ((f"/truth[{i}]", row) for i, row in enumerate(sorted(contents.truth))))
    return trajectory_from_rows(rows, contents.exact)


def _heads(path: Path, contents: RecordingContents) -> PrintHeadLog:
    heads = sorted(contents.heads)
    rows = checked_rows(path, ((f"/head[{i}]", row) for i, (row, _) in enumerate(heads)))
    return PrintHeadLog(rows, np.array([extruding for _, extruding in heads], bool))


def _unpacked_surface(surface: AttachedFile | None, store: RecordingStore) -> Path | None:
    """A copy of the scan beside the session, since mesh readers want a file; it goes when the session goes."""
    if surface is None:
        return None
    folder = tempfile.mkdtemp(prefix="stillbed-")
    weakref.finalize(store, shutil.rmtree, folder, ignore_errors=True)
    path = Path(folder) / surface.name
    path.write_bytes(surface.data)
    return path


class RecordingStore:
    """Where the images of a recording are: the offset of the chunk that holds each."""

    def __init__(self, path: Path, rig: Rig, places: ImagePlaces) -> None:
        self.path, self.rig, self.places = path, rig, places

    def open(self) -> RecordingReader:
        """A reader of its own."""
        return RecordingReader(self)


class RecordingReader:
    """Decodes the images of a recording; keeps the last few chunks unpacked."""

    def __init__(self, store: RecordingStore) -> None:
        self._store = store
        self._file: BinaryIO = open(store.path, "rb")  # noqa: SIM115  (closed in `close`)
        self._chunks: OrderedDict[int, list[bytes]] = OrderedDict()

    def read(self, ref: FrameRef) -> Image:
        """The image; InputError where it is undecodable or not of the camera's size."""
        camera = self._store.rig.cameras[ref.camera]
        what = f"{image_topic(camera.name)}: image {ref.number}"
        image = decode(self.encoded(ref)[1], self._store.path, what)
        check_size(image, camera.size, self._store.path, what)
        return image

    def encoded(self, ref: FrameRef) -> tuple[str, bytes]:
        """Format ("png" or "jpeg") and bytes of the image as stored."""
        topic = image_topic(self._store.rig.cameras[ref.camera].name)
        offset, index, encoding = self._store.places[topic, ref.number]
        data = self._chunk(offset)[index]
        try:
            if encoding == compressed_image.IMAGE_ENCODING:
                return compressed_image.unpack_image(data)
            message = parse(self._store.path, StoredMessage(topic, ref.number, data))  # as recordings once held them
            return message["format"], messages.bytes_from_message(message)
        except (KeyError, TypeError, ValueError, OverflowError) as error:
            raise InputError(self._store.path, topic, repr(error), "an encoded image") from error

    def _chunk(self, offset: int) -> list[bytes]:
        if offset not in self._chunks:
            self._chunks[offset] = chunk_messages(self._file, offset)
            if len(self._chunks) > CACHED_CHUNKS:
                self._chunks.popitem(last=False)
        return self._chunks[offset]

    def close(self) -> None:
        """Close the file."""
        self._file.close()


T = TypeVar("T")


def read_poses(path: str | Path) -> Iterator[SurfacePose]:
    """Estimated poses."""
    return _read(path, {"/pose": messages.pose_from_message})


def read_smoothed(path: str | Path) -> Iterator[SurfacePose]:
    """Poses as `stillbed smooth` added them."""
    return _read(path, {"/smoothed": messages.pose_from_message})


def read_observations(path: str | Path) -> Iterator[Observations]:
    """Observations."""
    return _read(path, {"/observations": messages.observations_from_message})


def read_commands(path: str | Path) -> Iterator[Command]:
    """Moves and holds as they were decided."""
    return _read(path, {"/move": messages.move_from_message, "/hold": messages.hold_from_message})


def read_sent(path: str | Path) -> Iterator[tuple[float, bytes]]:
    """Stamps (s) and bytes of what went to the arm."""
    return _read(path, {"/arm/sent": _stamped_bytes})


def read_received(path: str | Path) -> Iterator[tuple[float, bytes]]:
    """Stamps (s) and bytes of what came from the arm."""
    return _read(path, {"/arm/received": _stamped_bytes})


def read_events(path: str | Path) -> Iterator[tuple[float, int, str]]:
    """Stamp (s), level and words of every event."""
    return _read(path, {"/events": lambda m: (m["stamp"], m["level"], m["message"])})


def read_truth_rows(path: str | Path) -> Array:
    """Truth or reference as stored, rows (N, 8) of stamp x y z qx qy qz qw, s and mm, in order of stamp."""
    return np.array(sorted(_read(path, {"/truth": messages.row_from_message})), float).reshape(-1, 8)


def read_heads(path: str | Path) -> Iterator[tuple[float, PrintHead]]:
    """Stamps (s) of frame sets, and the print head at each."""
    return _read(path, {"/head": _stamped_head})


def _stamped_head(message: Message) -> tuple[float, PrintHead]:
    row = messages.row_from_message(message)
    return row[0], head_from_row(row, message["extruding"])


def _stamped_bytes(message: Message) -> tuple[float, bytes]:
    return message["stamp"], messages.bytes_from_message(message)


def _read(path: str | Path, decoders: dict[str, Callable[[Message], T]]) -> Iterator[T]:
    path = Path(path)
    for part in walk(path):
        for stored in part.messages if isinstance(part, ChunkMessages) else ():
            if stored.topic in decoders:
                message = parse(path, stored)
                try:
                    yield decoders[stored.topic](message)
                except (KeyError, TypeError, ValueError, OverflowError) as error:
                    raise InputError(path, stored.topic, repr(error), "a message of its schema") from error


PATH_ATTACHMENT, ARM_ATTACHMENT = "path.csv", "arm.toml"


def input_texts(path: PrintPath, profile: ArmProfile) -> dict[str, str]:
    """Path and arm as the texts that a recording keeps."""
    return {PATH_ATTACHMENT: path_text(path), ARM_ATTACHMENT: arm_text(profile, "as a live run used it")}


def used_inputs(record: Path) -> tuple[PrintPath, ArmProfile]:
    """Path and arm that a recorded run used; InputError where it did not begin to print."""
    attached = (part for part in walk(record) if isinstance(part, AttachedFile))
    return inputs_from_texts({part.name: part.data.decode("utf-8", "replace") for part in attached}, record)


def inputs_from_texts(texts: Mapping[str, str], record: Path) -> tuple[PrintPath, ArmProfile]:
    """Path and arm of the texts of a recording; InputError where they are not there."""
    if PATH_ATTACHMENT not in texts or ARM_ATTACHMENT not in texts:
        raise InputError(record, "recording", "no path", "the recording of a run that began to print")
    path = path_from_text(texts[PATH_ATTACHMENT], record / PATH_ATTACHMENT)
    return path, arm_from_text(texts[ARM_ATTACHMENT], record / ARM_ATTACHMENT)
