"""The channels that every viewer knows: ROS 2 messages as CDR, in m, rad and s (owns rosbags).

ROS 2 was chosen because Foxglove, Rerun and rosbags all read it; Foxglove's own protobuf messages are unknown to
rosbags and to `ros2 bag`. What ROS has no message for, tracks and outlines over a picture, is Foxglove's
`ImageAnnotations` in its ROS form. Frames: `base`, `surface`, `nozzle`, and `camera/NAME`, whose z axis looks into the
picture.

Every function gives a whole message. Times are ns since 1970. Loading this module takes 0.4 s: import it lazily.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import pairwise
from typing import Any

import numpy as np
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore
from rosbags.typesys.stores.ros2_humble import FIELDDEFS

from estimation import se3
from estimation.observations import Observations
from estimation.pose import SurfacePose, TrackState
from estimation.rig import Camera, Rig, distort, pixels_from_points
from estimation.se3 import Array
from hardware.arm.profile import ArmProfile
from hardware.motion.loop import CommandedPose, RecordedTick
from hardware.recording.messages import camera_frame

BASE_FRAME, SURFACE_FRAME, NOZZLE_FRAME = "base", "surface", "nozzle"
M_PER_MM = 1e-3
MAX_TIME_SECOND = 2**31 - 1  # that ROS's Time holds: in 2038

OVERLAY_PERIOD = 0.19  # s between two drawings over the pictures, each as dear as five poses, and two claims
PATH_PERIOD = 1.0  # s between two clouds of the path, which differ by what is printed
NOZZLE_PERIOD = 0.039  # s between two places of the nozzle: every second tick of 20 ms
MAX_OVERLAY_POINTS = 100  # of a line over a picture
TRACK_COLOUR, PATH_COLOUR, OUTLINE_COLOUR = (0.2, 0.9, 1.0), (1.0, 0.75, 0.1), (1.0, 0.35, 0.6)
PRINTED_RGB, PLANNED_RGB = (60, 200, 90), (160, 160, 160)

TRANSFORMS = "tf2_msgs/msg/TFMessage"
CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
IMAGE = "sensor_msgs/msg/CompressedImage"
ODOMETRY = "nav_msgs/msg/Odometry"
CLOUD = "sensor_msgs/msg/PointCloud2"
NUMBER = "std_msgs/msg/Float64"
LOG = "rcl_interfaces/msg/Log"
ANNOTATIONS = "foxglove_msgs/msg/ImageAnnotations"

_ANNOTATIONS_TEXT = f"""foxglove_msgs/CircleAnnotation[] circles
foxglove_msgs/PointsAnnotation[] points
foxglove_msgs/TextAnnotation[] texts
{80 * "="}
MSG: foxglove_msgs/CircleAnnotation
builtin_interfaces/Time timestamp
foxglove_msgs/Point2 position
float64 diameter
float64 thickness
foxglove_msgs/Color fill_color
foxglove_msgs/Color outline_color
{80 * "="}
MSG: foxglove_msgs/PointsAnnotation
uint8 UNKNOWN=0
uint8 POINTS=1
uint8 LINE_LOOP=2
uint8 LINE_STRIP=3
uint8 LINE_LIST=4
builtin_interfaces/Time timestamp
uint8 type
foxglove_msgs/Point2[] points
foxglove_msgs/Color outline_color
foxglove_msgs/Color[] outline_colors
foxglove_msgs/Color fill_color
float64 thickness
{80 * "="}
MSG: foxglove_msgs/TextAnnotation
builtin_interfaces/Time timestamp
foxglove_msgs/Point2 position
string text
float64 font_size
foxglove_msgs/Color text_color
foxglove_msgs/Color background_color
{80 * "="}
MSG: foxglove_msgs/Point2
float64 x
float64 y
{80 * "="}
MSG: foxglove_msgs/Color
float64 r
float64 g
float64 b
float64 a
{80 * "="}
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
"""
_POINTS, _LINE_LOOP, _LINE_STRIP = 1, 2, 3  # kinds of a PointsAnnotation
_FLOAT32 = 7  # kind of a PointField


@cache
def _store() -> Typestore:
    """The library's messages and Foxglove's; those alone that are used, as each becomes a class."""
    store = get_typestore(Stores.EMPTY)
    needed = {TRANSFORMS, CAMERA_INFO, IMAGE, ODOMETRY, CLOUD, NUMBER, LOG}
    stored: dict[str, Any] = {}
    while needed:
        name = needed.pop()
        stored[name] = FIELDDEFS[name]
        needed |= {part for part in _parts(FIELDDEFS[name][1]) if part not in stored}
    store.register(stored)
    store.register({k: v for k, v in get_types_from_msg(_ANNOTATIONS_TEXT, ANNOTATIONS).items() if k not in stored})
    return store


def _parts(field: object) -> set[str]:
    """The names of the messages in the fields of another."""
    if isinstance(field, str):
        return {field} if field in FIELDDEFS else set()
    return set().union(*map(_parts, field)) if isinstance(field, tuple | list) else set()


def definition(name: str) -> str:
    """A message's definition, with those of all messages in it, as a schema of encoding `ros2msg`."""
    text, _ = _store().generate_msgdef(name, ros_version=2)
    return text


def _packed(name: str, *fields: Any) -> bytes:
    return bytes(_store().serialize_cdr(_new(name, *fields), name))


def _new(name: str, *fields: Any) -> Any:
    return _store().types[name](*fields)


def unpacked(name: str, data: bytes) -> Any:
    """The message in `data`; ValueError where it is none."""
    try:
        return _store().deserialize_cdr(data, name)
    except Exception as error:  # of broken bytes the library, struct and numpy raise many kinds
        raise ValueError(f"{len(data)} bytes that are no {name}: {error}") from error


def _time(instant: int) -> Any:
    """A time after 2038 is the last one that there is."""
    seconds, rest = divmod(instant, 1_000_000_000)
    return _new("builtin_interfaces/msg/Time", min(seconds, MAX_TIME_SECOND), rest)


def _header(frame: str, instant: int) -> Any:
    return _new("std_msgs/msg/Header", _time(instant), frame)


def transforms(parent: str, children: Mapping[str, Array], instant: int) -> bytes:
    """TFMessage: the poses (4, 4), mm, of frames in their parent."""
    messages = []
    for child, pose in children.items():
        x, y, z = (M_PER_MM * pose[:3, 3]).tolist()
        turned = se3.quaternion_from_rotation(pose[:3, :3]).tolist()
        place = _new("geometry_msgs/msg/Vector3", x, y, z), _new("geometry_msgs/msg/Quaternion", *turned)
        placed = _new("geometry_msgs/msg/Transform", *place)
        messages.append(_new("geometry_msgs/msg/TransformStamped", _header(parent, instant), child, placed))
    return _packed(TRANSFORMS, messages)


def camera_info(camera: Camera, instant: int) -> bytes:
    """CameraInfo: a camera's matrix and lens, px."""
    matrix = np.asarray(camera.matrix, float)
    width, height = camera.size
    projection = np.concatenate([matrix, np.zeros((3, 1))], axis=1)
    whole = _new("sensor_msgs/msg/RegionOfInterest", 0, 0, 0, 0, False)
    lens = "plumb_bob", np.asarray(camera.distortion, float), matrix.ravel(), np.eye(3).ravel(), projection.ravel()
    return _packed(CAMERA_INFO, _header(camera_frame(camera.name), instant), height, width, *lens, 0, 0, whole)


def image(kind: str, data: bytes, frame: str, instant: int) -> bytes:
    """CompressedImage: a picture of `kind` ("png" or "jpeg") in the frame of its camera."""
    return _packed(IMAGE, _header(frame, instant), kind, np.frombuffer(data, np.uint8))


def image_from(data: bytes) -> tuple[str, bytes]:
    """Kind and bytes of the picture in a CompressedImage; ValueError where it is none."""
    message = unpacked(IMAGE, data)
    return message.format, message.data.tobytes()


def odometry(pose: Array, covariance: Array, twist: Array, twist_covariance: Array, instant: int) -> bytes:
    """Odometry: where the surface is in the base frame, and its velocity in its own.

    pose: (4, 4) base_from_surface, mm. covariance: (6, 6) of its right perturbation, rx ry rz tx ty tz, rad and mm.
    twist: (6,) of the surface frame, rad/s and mm/s, with its covariance (6, 6). ROS has translations first, in m, and
    the pose's covariance about the axes of the base frame.
    """
    by_base, by_surface = np.zeros((6, 6)), np.zeros((6, 6))
    for by, axes in ((by_base, pose[:3, :3]), (by_surface, np.eye(3))):
        by[:3, 3:], by[3:, :3] = M_PER_MM * axes, axes
    x, y, z = (M_PER_MM * pose[:3, 3]).tolist()
    quaternion = se3.quaternion_from_rotation(pose[:3, :3]).tolist()
    place = _new("geometry_msgs/msg/Point", x, y, z), _new("geometry_msgs/msg/Quaternion", *quaternion)
    rates = (by_surface @ twist).tolist()
    vectors = (_new("geometry_msgs/msg/Vector3", *part) for part in (rates[:3], rates[3:]))
    known = (by_base, covariance), (by_surface, twist_covariance)
    with np.errstate(invalid="ignore"):  # of a pose that nothing is known about
        spreads = [(by @ spread @ by.T).ravel() for by, spread in known]
    placed = _new("geometry_msgs/msg/PoseWithCovariance", _new("geometry_msgs/msg/Pose", *place), spreads[0])
    moved = _new("geometry_msgs/msg/TwistWithCovariance", _new("geometry_msgs/msg/Twist", *vectors), spreads[1])
    return _packed(ODOMETRY, _header(BASE_FRAME, instant), SURFACE_FRAME, placed, moved)


def cloud(points: Array, frame: str, instant: int, colours: Array | None = None) -> bytes:
    """PointCloud2: points (N, 3), mm, in a frame; colours: (N, 3) uint8, red green blue."""
    names = ("x", "y", "z") if colours is None else ("x", "y", "z", "rgb")
    layout = [("at", "<f4", 3)] if colours is None else [("at", "<f4", 3), ("bgr0", "u1", 4)]  # as PCL packs colours
    rows = np.zeros(len(points), np.dtype(layout))
    rows["at"] = M_PER_MM * np.asarray(points)
    if colours is not None:
        rows["bgr0"][:, :3] = np.asarray(colours)[:, ::-1]
    size, count = rows.dtype.itemsize, len(rows)
    described = [_new("sensor_msgs/msg/PointField", name, 4 * k, _FLOAT32, 1) for k, name in enumerate(names)]
    data = np.frombuffer(rows.tobytes(), np.uint8)
    return _packed(CLOUD, _header(frame, instant), 1, count, described, False, size, size * count, data, True)


@dataclass(frozen=True, slots=True, eq=False)
class Drawing:
    """What is drawn over a picture in one colour."""

    pixels: Array  # (N, 2) px, as the lens images them
    colour: tuple[float, float, float]  # red, green, blue, 0 to 1
    line: bool = True  # joined, else dots
    closed: bool = False
    thickness: float = 2.0  # px


def image_annotations(drawings: Sequence[Drawing], instant: int) -> bytes:
    """ImageAnnotations: dots and lines over a picture."""
    point, colour = _store().types["foxglove_msgs/msg/Point2"], _store().types["foxglove_msgs/msg/Color"]
    time, items = _time(instant), []
    for each in drawings:
        kind = (_LINE_LOOP if each.closed else _LINE_STRIP) if each.line else _POINTS
        points = [point(x, y) for x, y in each.pixels.tolist()]
        own, none = colour(*each.colour, 1.0), colour(0.0, 0.0, 0.0, 0.0)
        items.append(_new("foxglove_msgs/msg/PointsAnnotation", time, kind, points, own, [], none, each.thickness))
    return _packed(ANNOTATIONS, [], items, [])


def number(value: float) -> bytes:
    """Float64."""
    return _packed(NUMBER, float(value))


def log(level: int, text: str, name: str, instant: int) -> bytes:
    """Log: an event. name: of the part that tells it."""
    return _packed(LOG, _time(instant), level, name, text, "", "", 0)


@dataclass(frozen=True, slots=True)
class RosMessage:
    """One message for viewers: its channel, its type, and its bytes."""

    topic: str
    name: str
    data: bytes


class ViewerChannels:
    """What viewers are shown of a run: made of its records as they come, and of what is said to lie on the surface."""

    def __init__(self, rig: Rig) -> None:
        self._rig = rig
        self._path, self._places = np.empty((0, 3)), np.empty(0)  # mm, surface frame; and how far along each is
        self._middle = np.zeros(3)  # mm, of the path
        self._outlines: list[Array] = []  # (K, 3) mm each, surface frame, as drawn over pictures
        self._drawn_path = np.empty((0, 3))  # the path likewise
        self._tracks: Observations | None = None
        self._truth: tuple[float, Array] | None = None  # s and (4, 4) mm, the newest
        self._true_from_own: Array | None = None  # (4, 4) mm, between the surface frames of truth and tracker
        self._commanded: CommandedPose | None = None
        self._nozzle_stamp = -np.inf  # s, when the nozzle was last shown
        self._overlaid = self._cloud_stamp = -np.inf  # s, of the last drawing over the pictures, and of the last cloud

    def start(self, instant: int) -> Iterator[RosMessage]:
        """The cameras: where they stand, and their lenses."""
        poses = {camera_frame(camera.name): camera.base_from_camera for camera in self._rig.cameras}
        yield RosMessage("/tf_static", TRANSFORMS, transforms(BASE_FRAME, poses, instant))
        for camera in self._rig.cameras:
            yield RosMessage(f"/camera/{camera.name}/camera_info", CAMERA_INFO, camera_info(camera, instant))

    def take_tracks(self, tracks: Observations) -> None:
        """The tracks of which the next pose is made."""
        self._tracks = tracks

    def take_truth(self, stamp: float, base_from_surface: Array) -> None:
        """A true pose (4, 4), mm, at `stamp`, s."""
        self._truth = stamp, base_from_surface

    def path(self, points: Array, places: Array, instant: int) -> Iterator[RosMessage]:
        """The path from now on: points (N, 3), mm, surface frame, and how far along it each is (N,), rising."""
        self._path, self._places, self._drawn_path = points, places, _thinned(points)
        self._middle = points.mean(axis=0) if len(points) else np.zeros(3)
        yield from self._cloud(0.0, instant)

    def surface(self, landmarks: Array, outlines: Sequence[Array], instant: int) -> Iterator[RosMessage]:
        """Landmarks (N, 3) and outlines (K, 3), mm, surface frame, from now on."""
        self._outlines = [_thinned(each) for each in outlines if len(each)]
        yield RosMessage("/landmarks", CLOUD, cloud(landmarks, SURFACE_FRAME, instant))

    def scan(self, points: Array, instant: int) -> Iterator[RosMessage]:
        """The scan's vertices (N, 3), mm, where they lie in the surface frame."""
        yield RosMessage("/scan", CLOUD, cloud(points, SURFACE_FRAME, instant))

    def progress(self, stamp: float, place: float, instant: int) -> Iterator[RosMessage]:
        """How far the print is, in the unit of the path's places."""
        if len(self._path) and stamp - self._cloud_stamp >= PATH_PERIOD:
            self._cloud_stamp = stamp
            yield from self._cloud(place, instant)

    def _cloud(self, place: float, instant: int) -> Iterator[RosMessage]:
        colours = np.where((self._places <= place)[:, None], PRINTED_RGB, PLANNED_RGB)
        yield RosMessage("/path", CLOUD, cloud(self._path, SURFACE_FRAME, instant, colours))

    def arm(self, profile: ArmProfile) -> None:
        """The arm whose nozzle is shown by the ticks from now on."""
        self._commanded = CommandedPose(profile)

    def tick(self, tick: RecordedTick, instant: int) -> Iterator[RosMessage]:
        """How far the print is, and where the arm is by the commands so far."""
        yield from self.progress(tick.stamp, tick.fraction, instant)
        if self._commanded is None:
            return
        self._commanded.add(tick.command, tick.stamp)
        head = self._commanded.at(tick.stamp) if tick.stamp >= self._nozzle_stamp + NOZZLE_PERIOD else None
        if head is not None:
            self._nozzle_stamp = tick.stamp
            yield from self.nozzle(head.base_from_nozzle, instant)

    def nozzle(self, base_from_nozzle: Array, instant: int) -> Iterator[RosMessage]:
        """Where the nozzle is, (4, 4) mm."""
        yield RosMessage("/tf", TRANSFORMS, transforms(BASE_FRAME, {NOZZLE_FRAME: base_from_nozzle}, instant))

    def error(self, name: str, millimetres: float) -> RosMessage:
        """An error by its name, in m."""
        return RosMessage(f"/error/{name}", NUMBER, number(M_PER_MM * millimetres))

    def pose(self, pose: SurfacePose, instant: int) -> Iterator[RosMessage]:
        """Where the surface is, how well that is known, and what is drawn over the pictures."""
        pose_surface = pose.base_from_surface
        if not np.isfinite(pose_surface).all():
            return
        yield RosMessage("/tf", TRANSFORMS, transforms(BASE_FRAME, {SURFACE_FRAME: pose_surface}, instant))
        message = odometry(pose_surface, pose.covariance, pose.twist, pose.twist_covariance, instant)
        yield RosMessage("/surface", ODOMETRY, message)
        if self._truth is not None and self._truth[0] == pose.stamp:
            if self._true_from_own is None and pose.state is TrackState.TRACKING:
                self._true_from_own = se3.inverse(self._truth[1]) @ pose_surface
            if self._true_from_own is not None:
                true_point = se3.transform_points(self._truth[1] @ self._true_from_own, self._middle[None])
                off = se3.transform_points(pose_surface, self._middle[None]) - true_point
                yield self.error("tracking", float(np.linalg.norm(off)))
        if pose.stamp - self._overlaid >= OVERLAY_PERIOD:
            self._overlaid = pose.stamp
            if np.isfinite(pose.covariance).all():
                yield self.error("claimed", float(pose.error_at(self._middle[None])[0]))
            yield from self._overlays(pose, instant)

    def _overlays(self, pose: SurfacePose, instant: int) -> Iterator[RosMessage]:
        """Tracks, path and outlines in the picture of each camera."""
        path = [self._drawn_path] if len(self._drawn_path) else []
        lines = [*path, *self._outlines] if pose.state.measured else []
        ends = np.cumsum([len(each) for each in lines]).tolist()
        points = np.concatenate([np.empty((0, 3)), *lines])
        for number_, camera in enumerate(self._rig.cameras):
            drawings = []
            if (tracks := self._tracks) is not None and tracks.stamp == pose.stamp:
                seen = distort(camera, tracks.pixels[tracks.camera == number_])
                drawings.append(Drawing(seen, TRACK_COLOUR, line=False, thickness=4.0))
            pixels, depth = pixels_from_points(camera, se3.transform_points(pose.base_from_surface, points))
            for k, (begin, end) in enumerate(pairwise([0, *ends])):
                if (depth[begin:end] > 0).all():
                    closed = k >= len(path)
                    colour = OUTLINE_COLOUR if closed else PATH_COLOUR
                    drawings.append(Drawing(pixels[begin:end], colour, closed=closed))
            yield RosMessage(f"/camera/{camera.name}/annotations", ANNOTATIONS, image_annotations(drawings, instant))


def _thinned(points: Array) -> Array:
    """At most MAX_OVERLAY_POINTS of points (N, 3), the first and the last among them."""
    return points[np.unique(np.linspace(0, len(points) - 1, MAX_OVERLAY_POINTS).astype(int))] if len(points) else points
