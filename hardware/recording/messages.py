"""Records as the JSON messages of a recording, and back: every float64 is read back as it was written.

Matrices are flat, row by row. An array with a number that is not finite is written as an empty one, which reads as NaN
throughout. docs/recordings.md says what each field of a message is.
"""

from __future__ import annotations

import base64
from typing import Any

import numpy as np

from estimation.observations import Observations
from estimation.pose import Forecast, MotionState, SurfacePose, TrackState
from estimation.rig import Rig
from estimation.se3 import Array
from estimation.surface_map import LocalError, Warp
from hardware.files.rig_file import rig_from_table, table_from_rig
from hardware.motion.loop import DispenserRecord, RecordedTick
from perception.frames import OutlinedPicture, Roi
from planning.command import Hold, Move
from planning.laid_beads import LaidBeads, Look, Stations
from planning.material import flow_from_message, message_from_flow

Message = dict[str, Any]


def image_topic(camera: str) -> str:
    """The channel of a camera's pictures."""
    return f"/camera/{camera}/image"


def camera_frame(camera: str) -> str:
    """The name of a camera's frame."""
    return f"camera/{camera}"


_POSE_SHAPES = {
    "base_from_surface": (4, 4),
    "covariance": (6, 6),
    "twist": (6,),
    "twist_covariance": (6, 6),
    "acceleration_psd": (6,),
}
_FORECAST: dict[str, tuple[int, ...]] = {"horizons": (), "increments": (6,), "covariances": (6, 6)}  # of each horizon
_WARP_ARRAYS = {"control": 1, "coefficients": 1, "covariance": 2, "growth": 2}  # 1: (K, 3), 2: (3K, 3K); K points
_WARP_NUMBERS = ("reach", "deformation", "deformation_sigma")
_LOCAL = {"centres": (3,), "variance": (), "growth": (), "reach": (), "support": (3,)}  # shapes of one entry
_LOCAL_NUMBERS = ("span", "unsupported")


def message_from_rig(rig: Rig) -> Message:
    """The cameras as a message."""
    table = table_from_rig(rig)
    for entry, camera in zip(table["camera"], rig.cameras, strict=True):
        entry["matrix"] = camera.matrix.ravel().tolist()
        entry["base_from_camera"] = camera.base_from_camera.ravel().tolist()
    return table


def rig_from_message(where: object, message: Message) -> Rig:
    """The cameras from their message, checked like a rig.toml; InputError (where)."""
    cameras = message["camera"]
    for camera in cameras if isinstance(cameras, list) else ():
        for key, rows in (("matrix", 3), ("base_from_camera", 4)):
            if isinstance(camera, dict) and isinstance(camera.get(key), list):
                flat = camera[key]
                camera[key] = [flat[i : i + rows] for i in range(0, len(flat), rows)]
    return rig_from_table(where, message)


def message_from_roi(roi: Roi) -> Message:
    """A polygon as a message."""
    polygon = roi.polygon.ravel().tolist()
    return {"stamp": roi.stamp, "camera": int(roi.camera), "polygon": polygon, "found": roi.found}


def roi_from_message(message: Message) -> Roi:
    """A polygon from its message."""
    polygon = np.array(message["polygon"], float).reshape(-1, 2)
    return Roi(message["camera"], message["stamp"], polygon, message.get("found", False))


def message_from_outlined(outlined: OutlinedPicture) -> Message:
    """A wound's outline with its picture, exact, as a message."""
    from hardware.files.images import encode  # loads cv2, which a motion process does not need

    kind, data = encode(outlined.image)
    return {
        "stamp": outlined.stamp,
        "camera": int(outlined.camera),
        "taken": outlined.taken,
        "polygon": outlined.polygon.ravel().tolist(),
        "by": outlined.by,
        "format": kind,
        "data": base64.b64encode(data).decode("ascii"),
    }


def outlined_from_message(where: object, message: Message) -> OutlinedPicture:
    """A wound's outline with its picture from its message; InputError (where) for a picture that is none."""
    from hardware.files.images import decode

    image = decode(bytes_from_message(message), where, "/wound_outline: data")
    polygon = np.array(message["polygon"], float).reshape(-1, 2)
    stamps = float(message["stamp"]), float(message["taken"])
    return OutlinedPicture(int(message["camera"]), *stamps, image, polygon, str(message["by"]))


def message_from_truth(row: Array, exact: bool) -> Message:
    """A row (8,) of stamp x y z qx qy qz qw, s and mm, as a message."""
    return {**_message_from_row(row), "exact": exact}


def message_from_head(row: Array, extruding: bool) -> Message:
    """A print head's row (8,) of stamp x y z qx qy qz qw, s and mm, base_from_nozzle, as a message."""
    return {**_message_from_row(row), "extruding": bool(extruding)}


def row_from_message(message: Message) -> list[float]:
    """The row of 8 numbers, stamp x y z qx qy qz qw (s and mm), in a message of truth or of a print head."""
    return [float(value) for value in (message["stamp"], *message["position"], *message["quaternion"])]


def _message_from_row(row: Array) -> Message:
    values = row.tolist()
    return {"stamp": values[0], "position": values[1:4], "quaternion": values[4:]}


def message_from_observations(observations: Observations) -> Message:
    """Observations as a message."""
    camera, track = observations.camera.tolist(), observations.track.tolist()
    pixels, sigma = _flat(observations.pixels), _flat(observations.sigma)
    return {"stamp": observations.stamp, "camera": camera, "track": track, "pixels": pixels, "sigma": sigma}


def observations_from_message(message: Message) -> Observations:
    """Observations from their message."""
    camera, track = (np.array(message[name], np.int64) for name in ("camera", "track"))
    pixels, sigma = _array(message["pixels"], (len(camera), 2)), _array(message["sigma"], (len(camera),))
    return Observations(message["stamp"], camera, track, pixels, sigma)


def message_from_pose(pose: SurfacePose) -> Message:
    """An estimated pose as a message."""
    return {
        "stamp": pose.stamp,
        "base_from_surface": _flat(pose.base_from_surface),
        "covariance": _flat(pose.covariance),
        "twist": _flat(pose.twist),
        "state": pose.state.value,
        "twist_covariance": _flat(pose.twist_covariance),
        "acceleration_psd": _flat(pose.acceleration_psd),
        "reason": pose.reason,
        "motion": {
            "moving": pose.motion.moving,
            "onset": _flat(np.array([pose.motion.onset])),
            "moved": pose.motion.distance,
            "turned": pose.motion.angle,
        },
        "warp": {
            **{name: [] if pose.warp is None else _flat(getattr(pose.warp, name)) for name in _WARP_ARRAYS},
            **{name: 0.0 if pose.warp is None else getattr(pose.warp, name) for name in _WARP_NUMBERS},
        },
        "forecast": {name: [] if pose.forecast is None else _flat(getattr(pose.forecast, name)) for name in _FORECAST},
        "local": {
            **{name: [] if pose.local is None else _flat(getattr(pose.local, name)) for name in _LOCAL},
            **{name: 0.0 if pose.local is None else getattr(pose.local, name) for name in _LOCAL_NUMBERS},
        },
    }


def pose_from_message(message: Message) -> SurfacePose:
    """An estimated pose from its message."""
    arrays: dict[str, Any] = {key: _array(message[key], shape) for key, shape in _POSE_SHAPES.items()}
    return SurfacePose(
        stamp=message["stamp"],
        state=TrackState(message["state"]),
        reason=message["reason"],
        motion=_motion_from_message(message["motion"]) if "motion" in message else MotionState(),
        warp=_warp_from_message(message["warp"]) if "warp" in message else None,
        forecast=_forecast_from_message(message["forecast"]) if "forecast" in message else None,
        local=_local_from_message(message["local"]) if "local" in message else None,
        **arrays,
    )


def _motion_from_message(message: Message) -> MotionState:
    onset = float(_array(message["onset"], (1,))[0])
    return MotionState(message["moving"], onset, message["moved"], message["turned"])


def _forecast_from_message(message: Message) -> Forecast | None:
    count = len(message["horizons"])
    arrays = (_array(message[name], (count, *shape)) for name, shape in _FORECAST.items())
    return Forecast(*arrays) if count else None


def _local_from_message(message: Message) -> LocalError | None:
    if not message["span"]:
        return None
    arrays: dict[str, Any] = {name: np.reshape(message[name], (-1, *shape)) for name, shape in _LOCAL.items()}
    return LocalError(**arrays, **{name: message[name] for name in _LOCAL_NUMBERS})


def _warp_from_message(message: Message) -> Warp | None:
    size = len(message["control"])
    if not size:
        return None
    shapes = {1: (size // 3, 3), 2: (size, size)}
    arrays: dict[str, Any] = {name: _array(message[name], shapes[kind]) for name, kind in _WARP_ARRAYS.items()}
    return Warp(**arrays, **{name: message[name] for name in _WARP_NUMBERS})


def message_from_move(move: Move) -> Message:
    """A move as a message."""
    return {
        "stamp": move.stamp,
        "axes": move.axes.tolist(),
        "feed": move.feed,
        "checkpoint": int(move.checkpoint),
        "extrude": bool(move.extrude),
        "reason": move.reason,
        "flow": move.flow,
        "flow_after": move.flow_after,
    }


def move_from_message(message: Message) -> Move:
    """A move from its message."""
    axes, reason = np.array(message["axes"], float), message.get("reason", "")
    flow = message.get("flow", 0.0), message.get("flow_after", 0.0)
    return Move(message["stamp"], axes, message["feed"], message["checkpoint"], message["extrude"], reason, *flow)


def message_from_hold(hold: Hold) -> Message:
    """A hold as a message."""
    return {"stamp": hold.stamp, "duration": hold.duration, "reason": hold.reason}


def hold_from_message(message: Message) -> Hold:
    """A hold from its message."""
    return Hold(message["stamp"], message["duration"], message["reason"])


def message_from_tick(tick: RecordedTick) -> Message:
    """A tick of the motion as a message; its command is written as a message of its own."""
    return {
        "stamp": tick.stamp,
        "pose_stamp": _flat(np.array([tick.pose_stamp])),
        "asked": tick.planned,
        "recalled": [] if tick.recalled is None else tick.recalled.ravel().tolist(),
        "fraction": tick.fraction,
        "phase": tick.phase.value,
        "frame": base64.b64encode(tick.frame).decode("ascii"),
    }


def message_from_dispenser(record: DispenserRecord) -> Message:
    """What a dispenser did as a message."""
    flow = [] if record.flow is None else [record.flow]
    return {"stamp": record.stamp, "name": record.name, "text": record.text, "flow": flow}


_STATIONS = ("bead", "layer", "begin", "end", "crest", "width")  # of a look: whole numbers, then mm
_LAID = ("planned", "volume", "sigma", "height", "height_sigma")  # mm^3, and mm


def message_from_look(look: Look) -> Message:
    """A look as a message; what could not be judged is null."""
    names = ("stamp", "first", "last", "seconds")
    laid = {name: [v if np.isfinite(v) else None for v in getattr(look.laid, name).tolist()] for name in _LAID}
    stations = {name: getattr(look.laid.stations, name).tolist() for name in _STATIONS}
    flow = {} if look.flow is None else {"flow": message_from_flow(look.flow)}
    return flow | {
        **{name: float(getattr(look, name)) for name in names},
        "spread": look.width,
        "text": look.text,
        **stations,
        **laid,
    }


def look_from_message(message: Message) -> Look:
    """A look from its message."""
    kinds = (np.int64, np.int64, float, float, float, float)
    stations = Stations(*(np.array(message[name], kind) for name, kind in zip(_STATIONS, kinds, strict=True)))
    laid = LaidBeads(stations, *(np.array(message[name], float) for name in _LAID))  # null: NaN
    stamp, first, last, seconds, spread = (message[name] for name in ("stamp", "first", "last", "seconds", "spread"))
    flow = flow_from_message(message["flow"]) if "flow" in message else None
    return Look(stamp, first, last, seconds, spread, laid, flow)


def message_from_bytes(stamp: float, data: bytes) -> Message:
    """Bytes on the arm's link as a message."""
    return {"stamp": stamp, "data": base64.b64encode(data).decode("ascii")}


def bytes_from_message(message: Message) -> bytes:
    """Bytes from a message with base64 `data`."""
    return base64.b64decode(message["data"], validate=True)


def _flat(array: Array) -> list[float]:
    values: list[float] = array.ravel().tolist()
    return values if np.isfinite(array).all() else []


def _array(values: list[float], shape: tuple[int, ...]) -> Array:
    if not values:
        return np.full(shape, np.nan)
    return np.array(values, np.float64).reshape(shape)
