"""The published schemas of a recording: the messages of every channel but the images', as JSON Schema.

Foxglove's well-known messages where one fits (foxglove.*: field names and meanings are theirs, lengths in metres),
our own otherwise (stillbed.*: mm, s, rad, px). The float64 `stamp` of our own messages is exact; the file's
log times are the same instants in whole nanoseconds, moved by `Recorder`'s epoch so that none is negative.
Foxglove reads neither arrays of arrays nor lists of types, so matrices are flat, row by row, and an array that is
not finite is written as an empty one (JSON knows no NaN).
"""

from __future__ import annotations

from typing import Any

Schema = dict[str, Any]

INFO, WARNING, ERROR = 2, 3, 4  # levels of an event, Foxglove's numbers

NUMBER: Schema = {"type": "number"}
TEXT: Schema = {"type": "string"}
COUNT: Schema = {"type": "integer", "minimum": 0}
FLAG: Schema = {"type": "boolean"}
BASE64: Schema = {"type": "string", "contentEncoding": "base64"}
TIME = {
    "type": "object",
    "title": "time",
    "properties": {"sec": COUNT, "nsec": {**COUNT, "maximum": 999_999_999}},
    "required": ["sec", "nsec"],
}


def _array(items: Schema, count: int | None = None, about: str = "") -> Schema:
    length = {} if count is None else {"minItems": count, "maxItems": count}
    return {"type": "array", "items": items, **length, **({"description": about} if about else {})}


def _finite_array(about: str) -> Schema:
    """Numbers that are all finite, or none."""
    return _array(NUMBER, None, f"{about}; empty: not finite")


def _part(about: str = "", **properties: Schema) -> Schema:
    """An object inside a message, all of it required."""
    description = {"description": about} if about else {}
    return {"type": "object", **description, "properties": properties, "required": list(properties)}


def _message(title: str, about: str, **properties: Schema) -> Schema:
    """The schema of a channel's messages, all properties required."""
    head = {"$schema": "https://json-schema.org/draft/2020-12/schema", "title": title, "description": about}
    return {**head, "type": "object", "properties": properties, "required": list(properties)}


def _described(schema: Schema, about: str) -> Schema:
    return {**schema, "description": about}


STAMP = _described(NUMBER, "s, exact")
XYZ = _part(x=NUMBER, y=NUMBER, z=NUMBER)
QUATERNION = _part(x=NUMBER, y=NUMBER, z=NUMBER, w=NUMBER)
POSE_ROW = {"position": _array(NUMBER, 3, "mm"), "quaternion": _array(NUMBER, 4, "qx qy qz qw")}
CAMERA = {
    "type": "object",
    "properties": {
        "name": TEXT,
        "size": _array(COUNT, 2, "[width, height], px"),
        "matrix": _array(NUMBER, 9, "3x3, px"),
        "distortion": _array(NUMBER, 5, "k1 k2 p1 p2 k3"),
        "base_from_camera": _array(NUMBER, 16, "4x4, mm"),
        "clock_offset_s": _described(NUMBER, "s, to be added to the camera's stamps"),
    },
    "required": ["name", "size", "matrix", "distortion", "base_from_camera"],
}

CALIBRATION = _message(
    "foxglove.CameraCalibration",
    "A camera of the rig",
    timestamp=TIME,
    frame_id=TEXT,
    width=COUNT,
    height=COUNT,
    distortion_model=TEXT,
    D=_array(NUMBER),
    K=_array(NUMBER, 9),
    R=_array(NUMBER, 9),
    P=_array(NUMBER, 12),
)
MOTION = _part(
    "Whether the surface moves",
    moving=FLAG,
    onset=_array(NUMBER, None, "s, start of the last movement; empty: before the first pose"),
    moved=_described(NUMBER, "mm since it was last at rest"),
    turned=_described(NUMBER, "rad since it was last at rest"),
)
FORECAST = _part(
    "where the surface is expected after the stamp; empty: by its twist",
    horizons=_finite_array("s after the stamp, H of them"),
    increments=_finite_array("Hx6, tangent at the pose"),
    covariances=_finite_array("Hx6x6, rad, mm"),
)
LOCAL = _part(
    "What single places may be off by beyond the rest, by K bells, and away from S supports; span = 0: nothing",
    centres=_finite_array("K x 3, mm"),
    variance=_finite_array("K, mm^2, along every direction"),
    growth=_finite_array("K, mm^2/s, by which that grows"),
    reach=_finite_array("K, mm, one sigma of each bell"),
    support=_finite_array("S x 3, mm, where landmarks show the surface"),
    span=_described(NUMBER, "mm from the nearest support within which a place moves with it"),
    unsupported=_described(NUMBER, "mm^2, at twice that distance and beyond"),
)
WARP: Schema = {
    "type": "object",
    "description": "Departure from a rigid body: Gaussian bells about K points, surface frame; K = 0: none",
    "properties": {
        "control": _finite_array("K x 3, mm"),
        "coefficients": _finite_array("K x 3, mm"),
        "covariance": _finite_array("3K x 3K, mm^2, of the coefficients"),
        "growth": _finite_array("3K x 3K, mm^2/s"),
        "reach": _described(NUMBER, "mm, one sigma of a bell"),
        "deformation": _described(NUMBER, "mm, root mean square over the landmarks"),
        "deformation_sigma": _described(NUMBER, "mm"),
    },
}
BYTES = _message("stillbed.Bytes", "Bytes on the arm's link", stamp=STAMP, data=BASE64)

TOPICS: dict[str, Schema] = {
    "/rig": _message("stillbed.Rig", "The calibrated cameras; mm, px", camera=_array(CAMERA)),
    "/roi": _message(
        "stillbed.Roi",
        "Where the surface is in one image, px",
        stamp=STAMP,
        camera=COUNT,
        polygon=_array(NUMBER, None, "x y of each corner"),
        found=_described(FLAG, "by a network; else an operator drew it"),
    ),
    "/wound_outline": _message(
        "stillbed.WoundOutline",
        "Where the wound is in one picture as somebody says; the last one of a picture counts",
        stamp=_described(NUMBER, "s, when it was said, exact"),
        camera=COUNT,
        taken=_described(NUMBER, "s, of the picture, exact"),
        polygon=_array(NUMBER, None, "x y of each corner, px"),
        by=_described(TEXT, "who says so: operator"),
        format=_described(TEXT, "of the picture: png"),
        data=_described(BASE64, "the picture, exact"),
    ),
    "/frames": _message(
        "stillbed.Frame",
        "When an image was taken; the image is the message of the same sequence number on its camera's channel",
        stamp=_described(NUMBER, "s on the common clock, exact"),
        camera_stamp=_described(NUMBER, "s on the camera's own clock, exact"),
        camera=COUNT,
        number=_described(COUNT, "sequence number of the image"),
    ),
    "/truth": _message(
        "stillbed.Truth",
        "Known or measured pose of the surface in the base frame, mm",
        stamp=STAMP,
        **POSE_ROW,
        exact=_described(FLAG, "true: a simulator's or an instrument's; false: a measured reference"),
    ),
    "/head": _message(
        "stillbed.PrintHead",
        "Pose of the nozzle in the base frame by the commands that were sent, z from the tip up into the head, mm",
        stamp=_described(NUMBER, "s, of the frame set, exact"),
        **POSE_ROW,
        extruding=_described(FLAG, "true: ink flows"),
    ),
    "/observations": _message(
        "stillbed.Observations",
        "Tracks of one frame set, parallel arrays of length N",
        stamp=STAMP,
        camera=_array(COUNT),
        track=_array({"type": "integer"}),
        pixels=_finite_array("x y of each track, undistorted px"),
        sigma=_finite_array("px, one standard deviation per axis"),
    ),
    "/pose": _message(
        "stillbed.SurfacePose",
        "Estimated pose of the surface; mm, rad, s; tangent order rx ry rz tx ty tz, right perturbation",
        stamp=STAMP,
        base_from_surface=_finite_array("4x4, mm"),
        covariance=_finite_array("6x6, rad, mm"),
        twist=_finite_array("6, rad/s, mm/s, surface frame"),
        state=TEXT,
        twist_covariance=_finite_array("6x6, rad/s, mm/s"),
        acceleration_psd=_finite_array("6, rad^2/s^3, mm^2/s^3"),
        reason=TEXT,
        motion=MOTION,
        warp=WARP,
        forecast=FORECAST,
        local=LOCAL,
    ),
    "/move": _message(
        "stillbed.Move",
        "Go to the machine axes on the way to a checkpoint",
        stamp=STAMP,
        axes=_array(NUMBER, 6, "X Y Z A B C, mm and rad"),
        feed=_described(NUMBER, "mm/s"),
        checkpoint={"type": "integer"},
        extrude=FLAG,
        reason=_described(TEXT, "why it brakes or rests; empty of a move along the path"),
        flow=_described(NUMBER, "mm^3/s that the dispenser is told; 0: off"),
        flow_after=_described(NUMBER, "s into the tick at which it is told"),
    ),
    "/hold": _message(
        "stillbed.Hold", "Stay, because of the reason", stamp=STAMP, duration=_described(NUMBER, "s"), reason=TEXT
    ),
    "/arm/sent": BYTES,
    "/arm/received": BYTES,
    "/tick": _message(
        "stillbed.Tick",
        "A tick of the motion: what it was given, and the frame that it gave",
        stamp=STAMP,
        pose_stamp=_array(NUMBER, None, "s, of the pose they were given; empty: none"),
        asked=_described(FLAG, "whether planner and guard were asked, and gave the frame"),
        begun=_array(NUMBER, None, "where on the path they were begun anew before it; empty: they were not"),
        recalled=_array(NUMBER, None, "12, mm and rad: where the arm rested and stands, if moves were called back"),
        lag=_array(NUMBER, None, "s, the arm's, by which they went from this tick on; empty: as before"),
        paused=_described(FLAG, "whether they were told to wait above the surface"),
        material_in=_described(FLAG, "whether the material that they had asked for was put in before it"),
        fraction=_described(NUMBER, "place on the path, counted in checkpoints"),
        phase=TEXT,
        frame=BASE64,
    ),
    "/dispenser": _message(
        "stillbed.Dispenser",
        "What a dispenser did",
        stamp=STAMP,
        name=TEXT,
        text=TEXT,
        flow=_array(NUMBER, None, "mm^3/s told from here on; empty: as before"),
    ),
    "/latency": _message(
        "stillbed.Latency",
        "How long a stage took so far",
        stamp=STAMP,
        stage=TEXT,
        width=_described(NUMBER, "s, of a bin"),
        counts=_array(COUNT, None, "in each bin; the last holds all that were later"),
        most=_described(NUMBER, "s, the largest"),
    ),
    "/events": _message(
        "foxglove.Log",
        "Something that happened",
        timestamp=TIME,
        level=_described(COUNT, "1 debug, 2 info, 3 warning, 4 error, 5 fatal"),
        message=TEXT,
        name=TEXT,
        file=TEXT,
        line=COUNT,
        stamp=STAMP,
    ),
    "/tf": _message(
        "foxglove.FrameTransform",
        "Pose of a child frame in its parent, metres",
        timestamp=TIME,
        parent_frame_id=TEXT,
        child_frame_id=TEXT,
        translation=XYZ,
        rotation=QUATERNION,
    ),
}


def image_topic(camera: str) -> str:
    """The channel of a camera's images."""
    return f"/camera/{camera}/image"


def calibration_topic(camera: str) -> str:
    """The channel of a camera's calibration, where Foxglove looks for it beside the images."""
    return f"/camera/{camera}/calibration"


def camera_frame(camera: str) -> str:
    """The name of a camera's frame for viewers."""
    return f"camera/{camera}"
