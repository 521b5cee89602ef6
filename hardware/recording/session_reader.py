"""Recordings read back: as a session, as the records of one channel, and as the path and arm that a run used.

Of a damaged file all but the damaged chunks is read. `open_session` opens both containers, folder and MCAP file.
"""

from __future__ import annotations

import shutil
import tempfile
import weakref
from collections import OrderedDict
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO, TypeVar

import numpy as np

from estimation.errors import InputError
from estimation.observations import Observations
from estimation.pose import SurfacePose, Trajectory
from estimation.rig import Rig
from estimation.se3 import Array
from hardware.arm.profile import ArmProfile
from hardware.files import session as sessions
from hardware.files.arm_file import arm_from_text, arm_text
from hardware.files.dispenser_file import dispensers_from_text, outlets_from
from hardware.files.folder_tables import check_polygon, checked_rows, trajectory_from_rows
from hardware.files.images import check_size, decode
from hardware.files.path_file import path_from_text, path_text, tissue_from_text
from hardware.files.session import SURFACE_SUFFIXES, FrameRef, PrintHeadLog, Session, head_from_row, pair_refs
from hardware.files.session_folder import open_folder
from hardware.recording import messages
from hardware.recording.mcap_file import (
    AttachedFile,
    ChunkMessages,
    Damage,
    FileMetadata,
    StoredMessage,
    began_of,
    chunk_messages,
    damage_words,
    parse,
    walk,
)
from hardware.recording.messages import Message, image_topic
from perception.frames import Image, OutlinedPicture, PrintHead, Roi
from planning.clearance import TissueGuard
from planning.command import Command
from planning.material import Outlets
from planning.path import Path as PrintPath

if TYPE_CHECKING:
    from perception.training.dataset import Labelled

CACHED_CHUNKS = 4  # frames of one instant lie in neighbouring chunks
SURFACE_NAMES = tuple(f"surface{suffix}" for suffix in SURFACE_SUFFIXES)  # exact names: one with a folder in it is none
SESSION_TOPICS = ("/rig", "/roi", "/truth", "/head", "/frames")

T = TypeVar("T")
# of an image, by topic and number: offset of its chunk, index of the message in the chunk, encoding
ImagePlaces = dict[tuple[str, int], tuple[int, int, str]]


@dataclass(slots=True)
class RecordingContents:
    """What is read of a recording before any image is: all records of a session, and where each image is stored.

    A run that is interrupted while it writes may store a chunk twice; sets and dictionaries keep each record once.
    """

    rig: Rig | None = None
    rois: dict[tuple[int, float], Roi] = field(default_factory=dict)  # by camera and stamp
    truth: set[tuple[float, ...]] = field(default_factory=set)  # rows of stamp x y z qx qy qz qw, s and mm
    exact: bool = False  # whether truth is exact
    heads: set[tuple[tuple[float, ...], bool]] = field(default_factory=set)  # such a row, and whether ink flows
    frames: dict[tuple[int, int], FrameRef] = field(default_factory=dict)  # by camera and number
    places: ImagePlaces = field(default_factory=dict)
    surface: AttachedFile | None = None
    damage: str = ""  # "" if none
    began: int | None = None  # ns since 1970, UTC, at stamp 0


def open_session(path: str | Path) -> Session:
    """Open a session folder or an .mcap file; InputError says what is wrong with it."""
    path = Path(path)
    if path.is_dir():
        return open_folder(path)
    sessions.check_exists(path)
    return open_recording(path)


def open_recording(path: Path) -> Session:
    """Open an .mcap recording; what is damaged is left out, `Session.damage` says what."""
    contents = _contents(path)
    rig = contents.rig
    if rig is None:
        allowed = "a stillbed.Rig; pictures of others go into a session folder: docs/conventions.md"
        raise InputError(path, "/rig", contents.damage or "no message", allowed)
    frames = list(contents.frames.values())
    _check_frames(path, contents, rig)
    stamps = [np.array(sorted(r.stamp for r in frames if r.camera == c)) for c in range(len(rig))]
    for camera, times in zip(rig.cameras, stamps, strict=True):
        if (np.diff(times) <= 0).any():
            raise InputError(path, f"/frames: stamp of camera {camera.name!r}", "one stamp twice", "each stamp once")
    reader = (open_reader := partial(RecordingReader, path, rig, contents.places))()
    for ref in {ref.camera: ref for ref in reversed(frames)}.values():  # the first image of each camera
        reader.read(ref)
    reader.close()
    rois = _checked_rois(path, contents, rig)
    truth, heads = _truth(path, contents), _heads(path, contents)
    surface, sets = _unpacked_surface(contents.surface, open_reader), pair_refs(frames, stamps, len(rig))
    return Session(path, rig, rois, surface, truth, sets, open_reader, contents.damage, heads, contents.began)


def _contents(path: Path) -> RecordingContents:
    contents, damages = RecordingContents(), list[Damage]()
    for record in walk(path):
        if isinstance(record, Damage):
            damages.append(record)
        elif isinstance(record, FileMetadata):
            contents.began = began_of(record.table)
        elif isinstance(record, AttachedFile):
            if record.name in SURFACE_NAMES:
                contents.surface = record
        else:
            for index, stored in enumerate(record.messages):
                _take(path, contents, (record.offset, index), stored)
    contents.damage = damage_words(damages)
    if damages:  # an image may be lost with another chunk than its entry
        names = [] if contents.rig is None else [camera.name for camera in contents.rig.cameras]
        refs = [(key, ref) for key, ref in contents.frames.items() if 0 <= ref.camera < len(names)]
        readable = ((key, ref) for key, ref in refs if (image_topic(names[ref.camera]), ref.number) in contents.places)
        contents.frames = dict(readable)
    return contents


def recording_damage(path: Path) -> str:
    """What of an .mcap file cannot be read, "" if nothing or where `path` is no .mcap file."""
    if path.suffix.lower() != ".mcap" or not path.is_file():
        return ""
    return damage_words([part for part in walk(path) if isinstance(part, Damage)])


def _take(path: Path, contents: RecordingContents, place: tuple[int, int], stored: StoredMessage) -> None:
    if stored.topic.endswith("/image"):
        contents.places[stored.topic, stored.sequence] = *place, stored.encoding
    elif stored.topic in SESSION_TOPICS:
        _decoded(path, stored, lambda message: _take_message(path, contents, stored.topic, message))


def _decoded(path: Path, stored: StoredMessage, decode: Callable[[Message], T]) -> T:
    """The record that `decode` makes of a stored message; InputError where it is none of its channel's schema."""
    message = parse(path, stored)
    try:
        return decode(message)
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
        camera_stamp, stamp = float(message["camera_stamp"]), float(message["stamp"])
        camera, number = int(message["camera"]), int(message["number"])
        contents.frames[camera, number] = FrameRef(camera, number, camera_stamp, stamp)


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
            allowed = "an image for every message of /frames"
            raise InputError(path, f"{topic}: image", f"no number {ref.number}", allowed)


def _checked_rois(path: Path, contents: RecordingContents, rig: Rig) -> tuple[Roi, ...]:
    for i, roi in enumerate(contents.rois.values()):
        if not 0 <= roi.camera < len(rig) or not np.isfinite(roi.stamp):
            got = f"camera {roi.camera} at {roi.stamp} s"
            raise InputError(path, f"/roi[{i}]", got, f"a camera of /rig, 0..{len(rig) - 1}, and a finite stamp")
        check_polygon(path, f"/roi[{i}]", roi.polygon, rig.cameras[roi.camera].size)
    return _last_look(tuple(contents.rois.values()))


def _last_look(rois: tuple[Roi, ...]) -> tuple[Roi, ...]:
    """The regions that count: a run that looks for the surface anew records all of its region again, at one stamp."""
    latest = tuple(roi for roi in rois if roi.stamp == max(each.stamp for each in rois))
    repeated = len({roi.camera for roi in rois}) < len(rois)
    return latest if repeated and len(latest) > 1 else rois


def _truth(path: Path, contents: RecordingContents) -> Trajectory | None:
    if not contents.truth:
        return None
    rows = checked_rows(path, ((f"/truth[{i}]", row) for i, row in enumerate(sorted(contents.truth))))
    return trajectory_from_rows(rows, contents.exact)


def _heads(path: Path, contents: RecordingContents) -> PrintHeadLog:
    heads = sorted(contents.heads)
    rows = checked_rows(path, ((f"/head[{i}]", row) for i, (row, _) in enumerate(heads)))
    return PrintHeadLog(rows, np.array([extruding for _, extruding in heads], bool))


def _unpacked_surface(surface: AttachedFile | None, owner: object) -> Path | None:
    """The scan as a temporary file, which mesh readers need; it is deleted with its owner, a part of the session."""
    if surface is None:
        return None
    folder = tempfile.mkdtemp(prefix="stillbed-")
    weakref.finalize(owner, shutil.rmtree, folder, ignore_errors=True)
    path = Path(folder) / surface.name
    path.write_bytes(surface.data)
    return path


class RecordingReader:
    """Decodes the images of a recording; keeps the last few chunks unpacked."""

    def __init__(self, path: Path, rig: Rig, places: ImagePlaces) -> None:
        self._path, self._rig, self._places = path, rig, places
        self._file: BinaryIO = open(path, "rb")  # noqa: SIM115  (closed in `close`)
        self._chunks: OrderedDict[int, list[bytes]] = OrderedDict()

    def read(self, ref: FrameRef) -> Image:
        """The image; InputError where it is undecodable or not of the camera's size."""
        camera = self._rig.cameras[ref.camera]
        what = f"{image_topic(camera.name)}: image {ref.number}"
        image = decode(self.encoded(ref)[1], self._path, what)
        check_size(image, camera.size, self._path, what)
        return image

    def encoded(self, ref: FrameRef) -> tuple[str, bytes]:
        """Format ("png" or "jpeg") and bytes of the image as stored."""
        topic = image_topic(self._rig.cameras[ref.camera].name)
        offset, index, encoding = self._places[topic, ref.number]
        data = self._chunk(offset)[index]
        try:
            if encoding == "cdr":
                from hardware.recording.ros_messages import image_from  # slow to load

                return image_from(data)
            message = parse(self._path, StoredMessage(topic, ref.number, data))  # as recordings once held them
            return message["format"], messages.bytes_from_message(message)
        except (KeyError, TypeError, ValueError, OverflowError) as error:
            raise InputError(self._path, topic, repr(error), "an encoded image") from error

    def _chunk(self, offset: int) -> list[bytes]:
        if offset not in self._chunks:
            self._chunks[offset] = chunk_messages(self._file, offset)
            if len(self._chunks) > CACHED_CHUNKS:
                self._chunks.popitem(last=False)
        return self._chunks[offset]

    def close(self) -> None:
        """Close the file."""
        self._file.close()


def read_poses(path: str | Path) -> Iterator[SurfacePose]:
    """Estimated poses."""
    return read_channels(path, {"/pose": messages.pose_from_message})


def read_smoothed(path: str | Path) -> Iterator[SurfacePose]:
    """Poses as `stillbed smooth` added them."""
    return read_channels(path, {"/smoothed": messages.pose_from_message})


def read_observations(path: str | Path) -> Iterator[Observations]:
    """Tracked image points of every frame set."""
    return read_channels(path, {"/observations": messages.observations_from_message})


def read_commands(path: str | Path) -> Iterator[Command]:
    """Moves and holds as they were decided."""
    return read_channels(path, {"/move": messages.move_from_message, "/hold": messages.hold_from_message})


def read_truth_rows(path: str | Path) -> Array:
    """Truth or reference as stored, rows (N, 8) of stamp x y z qx qy qz qw, s and mm, in order of stamp."""
    return np.array(sorted(read_channels(path, {"/truth": messages.row_from_message})), float).reshape(-1, 8)


def read_heads(path: str | Path) -> Iterator[tuple[float, PrintHead]]:
    """Stamps (s) of frame sets, and the print head at each."""
    return read_channels(path, {"/head": _stamped_head})


def _stamped_head(message: Message) -> tuple[float, PrintHead]:
    row = messages.row_from_message(message)
    return row[0], head_from_row(row, message["extruding"])


def read_channels(path: str | Path, decoders: Mapping[str, Callable[[Message], T]]) -> Iterator[T]:
    """The records of some channels in the order of the file. decoders: topic: record of a message."""
    path = Path(path)
    for part in walk(path):
        for stored in part.messages if isinstance(part, ChunkMessages) else ():
            if stored.topic in decoders:
                yield _decoded(path, stored, decoders[stored.topic])


OUTLINE_TOPIC = "/wound_outline"
OUTLINE_ALLOWED = "a recording of a live run in which an operator corrected the wound's outline"


def corrected_pictures(recording: Path) -> list[Labelled]:
    """The pictures on which operators corrected the wound's outline, each once with the last outline drawn on it.

    In order of camera and stamp. A picture is what the operator saw, to the last bit; a mask is True inside the outline
    and on it. name: "FILE/CAMERA_STAMP". InputError: no such file, no corrected picture in it, one that is not of its
    camera's size, an outline that is no polygon in its picture.
    """
    from perception.mapping.features import polygon_mask  # loads what no run needs that only reads poses
    from perception.training.dataset import Labelled
    from perception.wound.segmentation import rgb

    source, newest = Path(recording), dict[tuple[int, float], OutlinedPicture]()
    decoders: dict[str, Callable[[Message], Rig | OutlinedPicture]] = {
        "/rig": partial(messages.rig_from_message, f"{source} /rig"),
        OUTLINE_TOPIC: partial(messages.outlined_from_message, source),
    }
    rig: Rig | None = None
    for record in read_channels(source, decoders):
        if isinstance(record, Rig):
            rig = record
        elif not np.isfinite(stamps := [record.stamp, record.taken]).all():
            raise InputError(source, f"{OUTLINE_TOPIC}: stamp", stamps, "finite numbers of seconds")
        elif (key := (record.camera, record.taken)) not in newest or newest[key].stamp <= record.stamp:
            newest[key] = record
    if rig is None or not newest:
        raise InputError(source, OUTLINE_TOPIC, recording_damage(source) or "no message", OUTLINE_ALLOWED)
    pictures = []
    for camera, taken in sorted(newest):
        outlined = newest[camera, taken]
        if not 0 <= camera < len(rig):
            raise InputError(source, f"{OUTLINE_TOPIC}: camera", camera, f"a camera of /rig, 0..{len(rig) - 1}")
        name, size = rig.cameras[camera].name, rig.cameras[camera].size
        check_size(outlined.image, size, source, f"{OUTLINE_TOPIC}: image of camera {name!r}")
        check_polygon(source, f"{OUTLINE_TOPIC}: polygon of camera {name!r}", outlined.polygon, size)
        wound = polygon_mask(size, outlined.polygon) > 0
        pictures.append(Labelled(f"{source.name}/{name}_{taken:.6f}", rgb(outlined.image), wound))
    return pictures


PATH_ATTACHMENT, ARM_ATTACHMENT, DISPENSER_ATTACHMENT = "path.csv", "arm.toml", "dispenser.toml"
TISSUE_ATTACHMENT = "tissue.json"  # what the guard kept the tool out of


@dataclass(frozen=True, slots=True, eq=False)
class PrintInputs:
    """What a run printed: path, arm, and the outlets of its materials."""

    path: PrintPath
    profile: ArmProfile
    outlets: Outlets
    tissue: TissueGuard | None  # that the tool was kept out of


def input_texts(path: PrintPath, profile: ArmProfile, dispensers: str = "", tissue: str = "") -> dict[str, str]:
    """Path, arm, dispenser file and tissue as texts, by the names of the recording's attachments; "" without."""
    texts = {PATH_ATTACHMENT: path_text(path), ARM_ATTACHMENT: arm_text(profile, "as a live run used it", whole=True)}
    optional = {DISPENSER_ATTACHMENT: dispensers, TISSUE_ATTACHMENT: tissue}
    return texts | {name: text for name, text in optional.items() if text}


def used_inputs(record: Path) -> PrintInputs:
    """What a recorded run printed; InputError where it did not begin to print."""
    attachments = (part for part in walk(record) if isinstance(part, AttachedFile))
    return inputs_from_texts({part.name: part.data.decode("utf-8", "replace") for part in attachments}, record)


def inputs_from_texts(texts: Mapping[str, str], record: Path) -> PrintInputs:
    """What is printed by the attached texts of a recording; InputError where they are missing."""
    if PATH_ATTACHMENT not in texts or ARM_ATTACHMENT not in texts:
        raise InputError(record, "recording", "no path", "the recording of a run that began to print")
    path = path_from_text(texts[PATH_ATTACHMENT], record / PATH_ATTACHMENT)
    dispensers, source = texts.get(DISPENSER_ATTACHMENT, ""), record / DISPENSER_ATTACHMENT
    outlets = outlets_from(dispensers_from_text(dispensers, source), source) if dispensers else {}
    tissue = tissue_from_text(texts[TISSUE_ATTACHMENT], record) if TISSUE_ATTACHMENT in texts else None
    return PrintInputs(path, arm_from_text(texts[ARM_ATTACHMENT], record / ARM_ATTACHMENT), outlets, tissue)
