"""The calibrated cameras and how a point in the base frame becomes a pixel."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from estimation import se3
from estimation.se3 import Array


@dataclass(frozen=True, slots=True, eq=False)
class Camera:
    """One pinhole camera with Brown-Conrady distortion."""

    name: str
    size: tuple[int, int]  # (W, H) px
    matrix: Array  # (3, 3) px
    distortion: Array  # (5,) k1 k2 p1 p2 k3 (thesis Eq. 4.5, OpenCV's order)
    base_from_camera: Array  # (4, 4) mm, x right, y down, z into the scene
    clock_offset: float = 0.0  # s, to be added to its stamps

    def __repr__(self) -> str:
        return f"Camera({self.name!r}, {self.size[0]} x {self.size[1]} px)"


@dataclass(frozen=True, eq=False)
class Rig:
    """The cameras, in the order by which observations number them."""

    cameras: tuple[Camera, ...]

    def __repr__(self) -> str:
        return f"Rig({', '.join(map(repr, self.cameras))})"

    def __len__(self) -> int:
        return len(self.cameras)

    def index(self, name: str) -> int:
        """Number of the camera called `name`; KeyError if there is none."""
        for i, camera in enumerate(self.cameras):
            if camera.name == name:
                return i
        raise KeyError(name)

    @cached_property
    def matrices(self) -> Array:
        """Camera matrices (C, 3, 3), px."""
        return np.stack([c.matrix for c in self.cameras])

    @cached_property
    def camera_from_base(self) -> Array:
        """Extrinsics (C, 4, 4), mm."""
        return se3.inverse(np.stack([c.base_from_camera for c in self.cameras]))


def ideal_pixels(camera: Camera, points_base: ArrayLike) -> tuple[Array, Array]:
    """Undistorted pixels (N, 2) and depths (N,), mm, of points (N, 3) in the base frame; depth <= 0 is behind."""
    points_camera = se3.transform_points(se3.inverse(camera.base_from_camera), points_base)
    depth = points_camera[..., 2]
    safe = np.where(np.abs(depth) < 1e-9, 1e-9, depth)
    normalised = points_camera[..., :2] / safe[..., None]
    return normalised @ camera.matrix[:2, :2].T + camera.matrix[:2, 2], depth


def distort(camera: Camera, ideal: ArrayLike) -> Array:
    """Pixels as the lens images them (N, 2), from undistorted pixels (N, 2) of the same camera matrix."""
    normalised = (np.asarray(ideal, float) - camera.matrix[:2, 2]) @ np.linalg.inv(camera.matrix[:2, :2]).T
    x, y = normalised[..., 0], normalised[..., 1]
    k1, k2, p1, p2, k3 = camera.distortion
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    u = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    v = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    return np.asarray(np.stack([u, v], -1) @ camera.matrix[:2, :2].T + camera.matrix[:2, 2])


def pixels_from_points(camera: Camera, points_base: ArrayLike) -> tuple[Array, Array]:
    """Distorted pixels (N, 2) and depths (N,), mm, of points (N, 3) in the base frame, as cv2.projectPoints gives."""
    ideal, depth = ideal_pixels(camera, points_base)
    return distort(camera, ideal), depth
