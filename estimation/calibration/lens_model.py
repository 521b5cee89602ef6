"""The lens as nine numbers, and how a pixel moves with each of them.

A lens is fx fy cx cy k1 k2 p1 p2 k3 (px; thesis Eq. 4.5 with OpenCV's order of the last five). A model says which of
them are free; what is not free is zero.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from estimation.rig import Camera
from estimation.se3 import Array

PARAMETERS = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3")
CENTRE = 0.04  # of the image's longer side: one sigma by which the axis misses its middle
SKEWED = 0.005  # one sigma of ln(fx / fy): pixels are square
BENDS = (
    0.5,
    0.5,
    0.01,
    0.01,
    0.3,
)  # one sigma of k1 k2 p1 p2 k3; webcams were measured at 0.35, 0.27, 0.004, 0.01, 0.16
CORNER = 0.2  # one sigma of the part of its radius by which a corner of the image is moved; webcams: -0.18 to 0.19
MODELS: dict[str, NDArray[np.int64]] = {
    "none": np.arange(4),
    "k1": np.arange(5),
    "k1 k2": np.arange(6),
    "k1 k2 p1 p2": np.arange(8),
    "k1 k2 p1 p2 k3": np.arange(9),
}  # distortion by name, from the simplest on: the free numbers


def lens_of(camera: Camera) -> Array:
    """The nine numbers (9,) of a camera."""
    m = camera.matrix
    return np.concatenate([[m[0, 0], m[1, 1], m[0, 2], m[1, 2]], camera.distortion])


def matrix_of(lens: ArrayLike) -> Array:
    """The camera matrix (3, 3), px, of a lens (9,)."""
    fx, fy, cx, cy = np.asarray(lens, float)[:4]
    return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])


def image(lens: Array, points: Array) -> tuple[Array, Array, Array]:
    """Pixels (..., 2) of points (..., 3) in the camera's frame, and their slopes by lens (..., 2, 9) and point.

    lens: (9,) or (..., 9). The last array is (..., 2, 3), px per mm.
    """
    fx, fy, cx, cy, k1, k2, p1, p2, k3 = np.moveaxis(np.broadcast_to(lens, (*points.shape[:-1], 9)), -1, 0)
    z = points[..., 2]
    x, y = points[..., 0] / z, points[..., 1] / z
    r2, xy = x * x + y * y, x * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    slope = k1 + r2 * (2 * k2 + 3 * k3 * r2)  # of `radial` by r2
    u = x * radial + 2 * p1 * xy + p2 * (r2 + 2 * x * x)
    v = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * xy
    pixels = np.stack([fx * u + cx, fy * v + cy], -1)
    by_lens = np.zeros((*points.shape[:-1], 2, 9))
    by_lens[..., 0, 0], by_lens[..., 1, 1] = u, v
    by_lens[..., 0, 2] = by_lens[..., 1, 3] = 1.0
    columns = (r2, r2 * r2, None, None, r2**3)
    for k, column in enumerate(columns):
        if column is not None:
            by_lens[..., 0, 4 + k], by_lens[..., 1, 4 + k] = fx * x * column, fy * y * column
    by_lens[..., 0, 6], by_lens[..., 1, 6] = fx * 2 * xy, fy * (r2 + 2 * y * y)
    by_lens[..., 0, 7], by_lens[..., 1, 7] = fx * (r2 + 2 * x * x), fy * 2 * xy
    ux = radial + 2 * x * x * slope + 2 * p1 * y + 6 * p2 * x
    uy = 2 * xy * slope + 2 * p1 * x + 2 * p2 * y  # also v by x
    vy = radial + 2 * y * y * slope + 6 * p1 * y + 2 * p2 * x
    by_point = np.empty((*points.shape[:-1], 2, 3))
    for row, (focal, a, b) in enumerate(((fx, ux, uy), (fy, uy, vy))):
        by_point[..., row, 0], by_point[..., row, 1] = focal * a / z, focal * b / z
        by_point[..., row, 2] = -focal * (a * x + b * y) / z
    return pixels, by_lens, by_point


@dataclass(frozen=True, slots=True, eq=False)
class Belief:
    """What is known of a lens before any view: cost, slope (9,) and information (9, 9) at one lens."""

    cost: float
    slope: Array
    information: Array


def belief(size: tuple[int, int], lens: Array) -> Belief:
    """The belief about any webcam with images of `size` (W, H) px, at a lens (9,); hardly any, but never none."""
    about = np.array([lens[0], lens[1], (size[0] - 1) / 2, (size[1] - 1) / 2, 0, 0, 0, 0, 0])
    sigma = np.array([np.inf, np.inf, CENTRE * max(size), CENTRE * max(size), *BENDS])
    off = (lens - about) / sigma
    skew = np.array([1 / lens[0], -1 / lens[1], 0, 0, 0, 0, 0, 0, 0]) / SKEWED
    log_ratio = float(np.log(lens[0] / lens[1])) / SKEWED
    bend, bend_slope = _corner_bend(size, lens)
    information = np.diag(sigma**-2) + np.outer(skew, skew) + np.outer(bend_slope, bend_slope)
    slope = off / sigma + log_ratio * skew + bend * bend_slope
    return Belief(float(off @ off) + log_ratio**2 + bend**2, slope, information)


@dataclass(frozen=True, slots=True, eq=False)
class KnownLenses:
    """Lenses (C, 9) that are known beforehand, and one standard deviation (C, 9) of each number; 0: exactly."""

    lens: Array
    sigma: Array


def knowledge(known: KnownLenses, camera: int, lens: Array) -> Belief:
    """What is known of one camera's lens (9,) beforehand; what is known exactly is not sought."""
    sigma = known.sigma[camera]
    weight = np.where(sigma > 0, 1 / np.where(sigma > 0, sigma, 1.0) ** 2, 0.0)
    off = lens - known.lens[camera]
    return Belief(float(weight @ off**2), weight * off, np.diag(weight))


def _corner_bend(size: tuple[int, int], lens: Array) -> tuple[float, Array]:
    """By how much of its radius a corner of the image is moved, in sigmas, and the slope (9,) of that."""
    fx, fy, k1, k2, k3 = lens[[0, 1, 4, 5, 8]]
    r2 = (size[0] ** 2 + size[1] ** 2) / (4 * fx * fy)
    rate = k1 + r2 * (2 * k2 + 3 * r2 * k3)
    slope = np.array([-rate * r2 / fx, -rate * r2 / fy, 0, 0, r2, r2**2, 0, 0, r2**3])
    return float(r2 * (k1 + r2 * (k2 + r2 * k3))) / CORNER, slope / CORNER
