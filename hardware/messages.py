"""Records as the JSON messages of a recording, and back: what is written is read back to the same float64s.

Numbers that are not finite become null, which reads as NaN (JSON has no other way to say so).
"""

from __future__ import annotations

import base64
from typing import Any

import numpy as np

from estimation import se3
from estimation.observations import Observations
from estimation.pose import SurfacePose, TrackState
from estimation.rig import Camera
from estimation.se3 import Array
from hardware.schemas import camera_frame
from perception.frames import Roi
from planning.command import Hold, Move

Message = dict[str, Any]

SURFACE_FRAME = "surface"
BASE_FRAME = "base"
_MM = 1e-3  # viewers count in metres


def time_of(log_time: int) -> dict[str, int]:
    """A log time in ns as Foxglove's time."""
    return {"sec": log_time // 1_000_000_000, "nsec": log_time % 1_000_000_000}


def message_from_roi(roi: Roi) -> Message:
    """A polygon as a message."""
    return {"stamp": roi.stamp, "camera": int(roi.camera), "polygon": roi.polygon.tolist()}


def roi_from_message(message: Message) -> Roi:
    """A polygon from its message."""
    return Roi(message["camera"], message["stamp"], np.array(message["polygon"], float))


def message_from_truth(row: Array, exact: bool) -> Message:
    """A row (8,) of stamp x y z qx qy qz qw, s and mm, as a message."""
    values = row.tolist()
    return {"stamp": values[0], "position": values[1:4], "quaternion": values[4:], "exact": exact}


def truth_row(message: Message) -> list[float]:
    """The row of 8 numbers in a truth message."""
    return [message["stamp"], *message["position"], *message["quaternion"]]


def message_from_observations(observations: Observations) -> Message:
    """Observations as a message."""
    return {
        "stamp": observations.stamp,
        "camera": observations.camera.tolist(),
        "track": observations.track.tolist(),
        "pixels": _nullable(observations.pixels),
        "sigma": _nullable(observations.sigma),
    }


def observations_from_message(message: Message) -> Observations:
    """Observations from their message."""
    camera, track = (np.array(message[key], np.int64) for key in ("camera", "track"))
    return Observations(
        message["stamp"], camera, track, _array(message["pixels"]).reshape(-1, 2), _array(message["sigma"])
    )


def message_from_pose(pose: SurfacePose) -> Message:
    """An estimated pose as a message."""
    return {
        "stamp": pose.stamp,
        "base_from_surface": _nullable(pose.base_from_surface),
        "covariance": _nullable(pose.covariance),
        "twist": _nullable(pose.twist),
        "state": pose.state.value,
        "twist_covariance": _nullable(pose.twist_covariance),
        "acceleration_psd": _nullable(pose.acceleration_psd),
        "reason": pose.reason,
    }


def pose_from_message(message: Message) -> SurfacePose:
    """An estimated pose from its message."""
    keys = ("base_from_surface", "covariance", "twist", "twist_covariance", "acceleration_psd")
    arrays = {key: _array(message[key]) for key in keys}
    return SurfacePose(stamp=message["stamp"], state=TrackState(message["state"]), reason=message["reason"], **arrays)


def message_from_move(move: Move) -> Message:
    """A move as a message."""
    return {
        "stamp": move.stamp,
        "axes": move.axes.tolist(),
        "feed": move.feed,
        "checkpoint": int(move.checkpoint),
        "extrude": bool(move.extrude),
    }


def move_from_message(message: Message) -> Move:
    """A move from its message."""
    axes = np.array(message["axes"], float)
    return Move(message["stamp"], axes, message["feed"], message["checkpoint"], message["extrude"])


def message_from_hold(hold: Hold) -> Message:
    """A hold as a message."""
    return {"stamp": hold.stamp, "duration": hold.duration, "reason": hold.reason}


def hold_from_message(message: Message) -> Hold:
    """A hold from its message."""
    return Hold(message["stamp"], message["duration"], message["reason"])


def message_from_bytes(stamp: float, data: bytes) -> Message:
    """Bytes on the arm's link as a message."""
    return {"stamp": stamp, "data": base64.b64encode(data).decode("ascii")}


def bytes_from_message(message: Message) -> bytes:
    """Bytes from a message with base64 `data`."""
    return base64.b64decode(message["data"], validate=True)


def message_from_image(kind: str, data: bytes, camera: str, log_time: int) -> Message:
    """An encoded image as Foxglove's CompressedImage."""
    encoded = base64.b64encode(data).decode("ascii")
    return {"timestamp": time_of(log_time), "frame_id": camera_frame(camera), "data": encoded, "format": kind}


def message_from_calibration(camera: Camera, log_time: int) -> Message:
    """A camera as Foxglove's CameraCalibration."""
    matrix = camera.matrix
    return {
        "timestamp": time_of(log_time),
        "frame_id": camera_frame(camera.name),
        "width": camera.size[0],
        "height": camera.size[1],
        "distortion_model": "plumb_bob",
        "D": camera.distortion.tolist(),
        "K": matrix.ravel().tolist(),
        "R": np.eye(3).ravel().tolist(),
        "P": np.concatenate([matrix, np.zeros((3, 1))], axis=1).ravel().tolist(),
    }


def message_from_transform(base_from_child: Array, child: str, log_time: int) -> Message:
    """Where a frame stands in the base frame (4, 4), mm, as Foxglove's FrameTransform, metres."""
    position = base_from_child[:3, 3] * _MM
    quaternion = se3.quaternion_from_rotation(base_from_child[:3, :3])
    return {
        "timestamp": time_of(log_time),
        "parent_frame_id": BASE_FRAME,
        "child_frame_id": child,
        "translation": dict(zip("xyz", position.tolist(), strict=True)),
        "rotation": dict(zip("xyzw", quaternion.tolist(), strict=True)),
    }


def message_from_event(stamp: float, level: int, text: str, name: str, log_time: int) -> Message:
    """Something that happened, as Foxglove's Log."""
    time = time_of(log_time)
    return {"timestamp": time, "level": level, "message": text, "name": name, "file": "", "line": 0, "stamp": stamp}


def _nullable(array: Array) -> Any:
    if np.isfinite(array).all():
        return array.tolist()
    objects = array.astype(object)
    objects[~np.isfinite(array)] = None
    return objects.tolist()


def _array(values: Any) -> Array:
    return np.array(values, np.float64)
