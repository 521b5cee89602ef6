"""Trajectories read from any file or folder that stillbed writes, and the files of a smoothed session.

A recording is never changed: it is copied, with the smoothed poses as a channel more. Of a damaged recording the copy
holds what can be read.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from mcap.exceptions import McapError
from mcap.records import Attachment, Channel, McapRecord, Message, Metadata, Schema
from mcap.writer import Writer
from numpy.typing import NDArray

from estimation.batch.smoothed import SampledStates, Smoothed
from estimation.errors import InputError, StillbedError
from estimation.pose import SurfacePose, TrackState, Trajectory
from estimation.rig import Rig, distort, ideal_pixels
from estimation.se3 import Array, quaternion_from_rotation, transform_points
from hardware.files.folder_tables import (
    checked_rows,
    csv_table,
    read_tum,
    row_from_words,
    rows_from_trajectory,
    trajectory_from_rows,
)
from hardware.files.pose_file import COVARIANCE_COLUMNS, TRANSFORM_COLUMNS, TWIST_COLUMNS, UPPER_TRIANGLE
from hardware.files.pose_file import read_poses as read_pose_table
from hardware.files.session import Session
from hardware.process.checks import read_csv
from hardware.process.progress import write_atomically
from hardware.recording.mcap_file import NO_SCHEMA, Damage, epoch_of, profile_of, record_groups
from hardware.recording.messages import message_from_pose
from hardware.recording.session_reader import open_session, read_poses, read_smoothed, recording_damage
from perception.frames import Image

POSE_COLUMNS = ("stamp_s", *TRANSFORM_COLUMNS)
UNKNOWN_COLOUR = np.array([150, 150, 150])  # red green blue of a landmark that no camera shows
MAX_COLOUR_AGE_S = 0.05  # s between a frame set and the smoothed pose by which its pictures give colours


def write_instants(path: Path, instants: SampledStates) -> None:
    """smoothed.csv: pose, twist, and the upper triangles of both covariances, a line for each instant."""
    head = [*POSE_COLUMNS, *TWIST_COLUMNS, *COVARIANCE_COLUMNS, *(f"twist_{name}" for name in COVARIANCE_COLUMNS)]
    poses = instants.base_from_surface
    numbers = np.concatenate([poses[:, :3, 3], quaternion_from_rotation(poses[:, :3, :3]), instants.twist], axis=1)
    spreads = [c[:, UPPER_TRIANGLE[0], UPPER_TRIANGLE[1]] for c in (instants.covariance, instants.twist_covariance)]
    with csv_table(path, head) as write:
        for stamp, row, *parts in zip(instants.stamps, numbers, *spreads, strict=True):
            write([f"{stamp:.6f}", *(f"{v:.9f}" for v in row), *(f"{v:.6g}" for v in np.concatenate(parts))])


def read_instants(path: Path) -> tuple[Array, Array, Array]:
    """Stamps (N,), poses (N, 4, 4), covariances (N, 6, 6) of a smoothed.csv; InputError names what is wrong."""
    rows, count = read_csv(path), len(POSE_COLUMNS)
    width = count + len(TWIST_COLUMNS)
    lines = [(f"line {number}", cells) for number, cells in rows[1:] if cells]
    for what, cells in lines:
        if len(cells) != len(rows[0][1]):
            raise InputError(path, what, f"{len(cells)} columns", f"{len(rows[0][1])} columns")
    places = checked_rows(path, ((what, row_from_words(path, what, cells[:count])) for what, cells in lines))
    if not len(places):
        raise InputError(path, "poses", "none", "at least one line")
    covariance = np.empty((len(lines), 6, 6))
    for k, (what, cells) in enumerate(lines):
        upper = cells[width : width + len(COVARIANCE_COLUMNS)]
        numbers = row_from_words(path, f"{what}: covariance", upper, f"{len(COVARIANCE_COLUMNS)} numbers")
        covariance[k][UPPER_TRIANGLE] = covariance[k].T[UPPER_TRIANGLE] = numbers
    trajectory = trajectory_from_rows(places, exact=False)
    return trajectory.stamps, trajectory.base_from_surface, covariance


def write_map(path: Path, smoothed: Smoothed, session: Session) -> None:
    """map.ply: landmarks in the surface frame with normal, colour and sigma (mm, along its worst direction), as text.

    The colour is that of the first frame set's images, grey where no camera sees the landmark in them.
    """
    points, normals = smoothed.map.points, smoothed.map.normals
    count = len(points)
    blocks = smoothed.map.covariance.reshape(count, 3, count, 3)[np.arange(count), :, np.arange(count)]
    sigma = np.sqrt(np.linalg.eigvalsh(blocks)[:, -1])
    colours = _colours(smoothed, session)
    head = ["ply", "format ascii 1.0", f"element vertex {count}"]
    head += [f"property double {name}" for name in ("x", "y", "z", "nx", "ny", "nz")]
    head += [*(f"property uchar {name}" for name in ("red", "green", "blue")), "property double sigma", "end_header"]
    rows = zip(np.c_[points, normals].tolist(), colours.tolist(), sigma.tolist(), strict=True)
    body = [" ".join(map(str, (*map(repr, numbers), *colour, repr(s)))) for numbers, colour, s in rows]
    path.write_text("\n".join(head + body) + "\n", encoding="ascii")


def _colours(smoothed: Smoothed, session: Session) -> NDArray[np.int64]:
    """(L, 3) red green blue, 0 to 255."""
    out = np.tile(UNKNOWN_COLOUR, (len(smoothed.map), 1))
    for frames in session.frame_sets():
        k = int(np.abs(smoothed.stamps - frames.stamp).argmin())
        if abs(smoothed.stamps[k] - frames.stamp) > MAX_COLOUR_AGE_S:
            continue
        points_base = transform_points(smoothed.states.poses[k], smoothed.map.points)
        for frame in frames.frames:
            _colour(out, frame.image, smoothed.rig, frame.camera, points_base)
        break
    return out


def _colour(colours: NDArray[np.int64], image: Image, rig: Rig, camera: int, points_base: Array) -> None:
    """Set those of the colours (L, 3) whose points (L, 3), mm, lie inside the image, grey or BGR."""
    ideal, depth = ideal_pixels(rig.cameras[camera], points_base)
    at = np.round(distort(rig.cameras[camera], ideal))
    inside = (depth > 0) & (at >= 0).all(1) & (at < image.shape[1::-1]).all(1)
    x, y = at[inside].astype(np.int64).T
    shown = image[y, x]
    colours[inside] = shown[:, None] if shown.ndim == 1 else shown[:, ::-1]


FOLDER_FILES = ("smoothed.mcap", "smoothed.csv", "poses.csv", "truth.tum", "reference.tum")  # the first that is there
POSE_CHANNELS = ("smoothed", "pose", "truth")  # of a recording; the first that holds something, of a reference the last
POSE_READERS: dict[str, Callable[[Path], Iterator[SurfacePose]]] = {"smoothed": read_smoothed, "pose": read_poses}
POSE_SOURCES = f"a TUM or CSV file, an .mcap file, or a folder with one of {', '.join(FOLDER_FILES)}"


@dataclass(frozen=True, slots=True, eq=False)
class PoseSeries:
    """A trajectory and where it is from."""

    name: str  # file, and channel of a recording
    trajectory: Trajectory
    covariance: Array  # (N, 6, 6) of right perturbations, rad and mm; NaN where the file has none

    def __len__(self) -> int:
        return len(self.trajectory)


def read_pose_series(text: str, reference: bool = False) -> PoseSeries:
    """The trajectory that an argument of the command line names; InputError says what is wrong.

    text: a path; of an .mcap file also PATH:CHANNEL, with one of POSE_CHANNELS. reference: whether others are compared
    with it: of an .mcap file without CHANNEL the truth then comes first.
    """
    path, channel = _path_and_channel(text)
    if path.is_dir():
        inside = [path / name for name in FOLDER_FILES if (path / name).exists()]
        if not inside:
            raise InputError(path, "poses", "none", POSE_SOURCES)
        path = inside[0]
    if not path.exists():
        raise InputError(path, "file", "no such file or folder", POSE_SOURCES)
    if path.suffix == ".mcap":
        any_channel = POSE_CHANNELS[::-1] if reference else POSE_CHANNELS
        return _of_recording(path, (channel,) if channel else any_channel)
    if path.suffix == ".csv":
        return _of_csv(path)
    return _without_covariance(str(path), read_tum(path, exact=path.name == "truth.tum"))


def read_truth_series(text: str) -> PoseSeries:
    """The truth or reference in the session that an argument of the command line names."""
    path, _ = _path_and_channel(text)
    if path.is_dir():
        inside = [path / name for name in ("smoothed.mcap", "truth.tum", "reference.tum") if (path / name).exists()]
        if inside and inside[0].suffix == ".tum":
            return read_pose_series(str(inside[0]))
        path = inside[0] if inside else path
    if path.suffix == ".mcap" and not path.is_dir():
        return _of_recording(path, ("truth",))
    raise InputError(path, "truth", "none", "a session with its truth or reference; else name what it is compared with")


def poses_damage(text: str) -> str:
    """What was lost of the .mcap file that such an argument names; "" if nothing, or if it names no such file."""
    return recording_damage(_path_and_channel(text)[0])


def _path_and_channel(text: str) -> tuple[Path, str]:
    before, colon, channel = text.rpartition(":")
    if not colon or not before.endswith(".mcap") or Path(text).exists():
        return Path(text), ""
    if channel not in POSE_CHANNELS:
        raise InputError(before, "channel", channel, ", ".join(POSE_CHANNELS))
    return Path(before), channel


def _without_covariance(name: str, trajectory: Trajectory) -> PoseSeries:
    return PoseSeries(name, trajectory, np.full((len(trajectory), 6, 6), np.nan))


def _of_csv(path: Path) -> PoseSeries:
    """A poses.csv, a smoothed.csv, or rows of `stamp,x,y,z,qx,qy,qz,qw`."""
    cells = next((cells for _, cells in read_csv(path)), [])
    if cells[: len(POSE_COLUMNS)] == list(POSE_COLUMNS):
        stamps, poses, covariance = read_instants(path)
        return PoseSeries(str(path), Trajectory(stamps, poses, exact=False), covariance)
    if cells[:1] == ["stamp_s"]:
        table = read_pose_table(path)
        rows = table.measured
        if not rows.any():
            raise InputError(path, "poses", "none that was measured", "one or more")
        trajectory = Trajectory(table.stamps[rows], table.base_from_surface[rows], exact=False)
        lines = (f"line {row + 2}" for row in np.flatnonzero(rows))
        checked_rows(path, zip(lines, rows_from_trajectory(trajectory).tolist(), strict=True))
        return PoseSeries(str(path), trajectory, table.covariance[rows])
    return _without_covariance(str(path), read_tum(path, exact=False))


def _of_recording(path: Path, channels: tuple[str, ...]) -> PoseSeries:
    for channel in channels:
        name, truth = f"{path}:{channel}", open_session(path).truth if channel == "truth" else None
        if truth is not None and len(truth):
            return _without_covariance(name, truth)
        if channel != "truth" and len(series := _poses_of(path, name, POSE_READERS[channel])):
            return series
    raise InputError(path, "poses", "none", " or ".join(f"something in /{channel}" for channel in channels))


def _poses_of(path: Path, name: str, read: Callable[[Path], Iterator[SurfacePose]]) -> PoseSeries:
    """Measured poses in order of stamp, each once."""
    measured = (pose for pose in read(path) if np.isfinite(pose.base_from_surface).all() and pose.state.measured)
    poses = [pose for _, pose in sorted({pose.stamp: pose for pose in measured}.items())]
    transforms = np.array([pose.base_from_surface for pose in poses]).reshape(-1, 4, 4)
    covariance = np.array([pose.covariance for pose in poses]).reshape(-1, 6, 6)
    return PoseSeries(name, Trajectory(np.array([pose.stamp for pose in poses]), transforms, exact=False), covariance)


ADDED_TOPICS = SMOOTHED_TOPIC, VIEWERS_TOPIC = "/smoothed", "/smoothed_surface"  # ours, and the same as ROS has it


def write_copy(source: Path, target: Path, smoothed: Smoothed) -> None:
    """Copy the .mcap file `source` to `target` with the channel /smoothed; StillbedError where it cannot be copied."""

    def copy(part: Path) -> None:
        with part.open("wb") as stream:
            writer = Writer(stream)
            writer.start(profile=profile_of(source), library="stillbed")
            copier = _RecordCopier(writer)
            for group in record_groups(source):
                for record in () if isinstance(group, Damage) else group.records:
                    copier.write(record)
            _add_smoothed(writer, smoothed, copier.epoch)
            writer.finish()  # type: ignore[no-untyped-call]

    try:
        write_atomically(target, copy)
    except McapError as error:
        raise StillbedError(f"{source}: cannot be copied: {error}") from error


class _RecordCopier:
    """Writes the records of one file into another, where channels have other numbers."""

    def __init__(self, writer: Writer) -> None:
        self.epoch = 0  # ns added to log times, by the file's metadata
        self._writer = writer
        self._schemas: dict[int, Schema] = {}
        self._channels: dict[int, Channel] = {}
        self._numbers: dict[int, int] = {}  # number of a channel that has messages: its number in the copy

    def write(self, record: McapRecord) -> None:
        """Write a record; schemas and channels are kept until a message needs them."""
        if isinstance(record, Metadata):
            self._writer.add_metadata(record.name, record.metadata)
            self.epoch = self.epoch if (epoch := epoch_of(record.metadata)) is None else epoch
        elif isinstance(record, Attachment):
            self._writer.add_attachment(
                record.create_time, record.log_time, record.name, record.media_type, record.data
            )
        elif isinstance(record, Schema):
            self._schemas[record.id] = record
        elif isinstance(record, Channel):
            self._channels[record.id] = record
        elif isinstance(record, Message) and self._channels[record.channel_id].topic not in ADDED_TOPICS:
            number, m = self._number(record.channel_id), record
            self._writer.add_message(number, m.log_time, m.data, m.publish_time, m.sequence)

    def _number(self, channel: int) -> int:
        if channel not in self._numbers:
            of, schema = self._channels[channel], self._schemas.get(self._channels[channel].schema_id)
            number = 0 if schema is None else self._writer.register_schema(schema.name, schema.encoding, schema.data)
            self._numbers[channel] = self._writer.register_channel(of.topic, of.message_encoding, number)
        return self._numbers[channel]


def _add_smoothed(writer: Writer, smoothed: Smoothed, epoch: int) -> None:
    from hardware.recording import ros_messages  # slow to load

    text = ros_messages.definition(ros_messages.ODOMETRY).encode()
    shown = writer.register_channel(
        VIEWERS_TOPIC, "cdr", writer.register_schema(ros_messages.ODOMETRY, "ros2msg", text)
    )
    channel = writer.register_channel(SMOOTHED_TOPIC, "json", NO_SCHEMA)
    used = smoothed.statistics.used.sum(1)
    at = smoothed.states_at_stamps
    for k, stamp in enumerate(smoothed.stamps):
        state = TrackState.TRACKING if used[k] else TrackState.COASTING
        twist, twist_covariance = at.twist[k], at.twist_covariance[k]
        pose = SurfacePose(float(stamp), at.base_from_surface[k], at.covariance[k], twist, state, twist_covariance)
        data = json.dumps(message_from_pose(pose), allow_nan=False, separators=(",", ":")).encode()
        log_time = round(float(stamp) * 1e9) + epoch
        writer.add_message(channel, log_time, data, log_time)
        lies = pose.base_from_surface, pose.covariance, pose.twist, pose.twist_covariance
        writer.add_message(shown, log_time, ros_messages.odometry(*lies, log_time), log_time)
