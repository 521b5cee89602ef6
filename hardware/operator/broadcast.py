"""What a window is sent: JSON of the records, and the pictures as they are behind a head that says whose they are."""

from __future__ import annotations

import json
import math
import struct
from dataclasses import fields, is_dataclass
from typing import Any

import numpy as np

from hardware.operator.pictures import Pictures
from hardware.operator.scene import Scene

_SIZE = struct.Struct("<I")
DIGITS = 7  # significant ones: 0.1 um of a metre, as much as a screen could ever show
PIXEL = 1  # decimals of pixels


def text(**parts: Any) -> str:
    """One message: keyword by keyword, records as objects of their fields, NaN as null."""
    return text_of(parts)


def text_of(value: Any) -> str:
    """One record in JSON."""
    return json.dumps(plain(value), separators=(",", ":"), allow_nan=False)


def plain(value: Any) -> Any:
    """What JSON can hold of a record, an array, an enum, or of what contains them."""
    if isinstance(value, np.ndarray):
        return plain(value.tolist())
    if isinstance(value, np.generic):
        return plain(value.item())
    if is_dataclass(value) and not isinstance(value, type):
        return {f.name: plain(getattr(value, f.name)) for f in fields(value)}
    if isinstance(value, dict):
        return {str(key): plain(each) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return [plain(each) for each in value]
    if isinstance(value, float):
        return float(f"{value:.{DIGITS}g}") if math.isfinite(value) else None
    return value.value if hasattr(value, "value") else value


def scene_text(scene: Scene) -> str:
    """The scene, its coordinates in rows one after the other."""
    return text(
        kind="scene",
        cameras=scene.cameras,
        path=np.round(scene.path, 3).ravel(),
        checkpoint=scene.checkpoint,
        extrude=scene.extrude.astype(np.uint8),
        surface=np.round(scene.surface, 2).ravel(),
        triangles=scene.triangles.ravel(),
    )


def pictures_bytes(pictures: Pictures) -> bytes:
    """Length of the head (4 bytes, little-endian), the head as JSON, each camera's JPEGs: the whole, the near one."""
    head = text(
        stamp=pictures.stamp,
        base_from_surface=pictures.base_from_surface,
        pictures=[
            {
                "camera": each.camera,
                "size": len(each.jpeg),
                "near": len(each.near),
                "crop": each.crop,
                "outline": [np.round(polygon, PIXEL).ravel() for polygon in each.outline],
                "tracks": np.round(each.tracks, PIXEL).ravel(),
            }
            for each in pictures.pictures
        ],
    ).encode()
    return b"".join([_SIZE.pack(len(head)), head, *(each.jpeg + each.near for each in pictures.pictures)])
