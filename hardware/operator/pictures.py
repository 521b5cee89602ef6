"""The live pictures: what each camera sees, small, with what was found in it.

Path and nozzle are drawn by the browser, which knows the cameras from the scene: a picture carries only the poses that
belong to its instant.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from estimation.se3 import Array

CAPACITY = 1 << 20  # bytes: three pictures of 640 px, and near ones, take 250 kB with all that lies over them


@dataclass(frozen=True, slots=True, eq=False)
class CameraPicture:
    """One camera's picture. jpeg: of any size; all pixels are those of the camera's own size.

    outline: of the wound, polygons (K, 2) px of the image as it is. tracks: (M, 2) px, undistorted as in Observations.
    near: JPEG of the part `crop` (x, y, width, height px) around what was found, b"" and None where nothing was.
    """

    camera: str
    jpeg: bytes
    outline: tuple[Array, ...] = ()
    tracks: Array = field(default_factory=lambda: np.zeros((0, 2)))
    near: bytes = b""
    crop: tuple[int, int, int, int] | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Pictures:
    """The pictures of one instant. stamp: s. base_from_surface: (4, 4) mm at that instant, None while nobody knows."""

    stamp: float
    pictures: tuple[CameraPicture, ...]
    base_from_surface: Array | None = None
