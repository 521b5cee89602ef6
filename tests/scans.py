"""Scans of known shape: what registration and ray casting are tested on."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from estimation.scans.scan import Scan, scan_from_triangles
from estimation.se3 import Array

Shape = Callable[[Array, Array], Array]  # x, y -> z, mm


def plane(x: Array, y: Array) -> Array:
    return 0 * x


def sphere(x: Array, y: Array) -> Array:
    return np.sqrt(70.0**2 - x * x - y * y) - 70


def body(x: Array, y: Array) -> Array:
    """Curved, and the same from no two sides."""
    bump = 3 * np.exp(-((x - 14) ** 2 + (y - 6) ** 2) / 60) + 2 * np.exp(-((x + 22) ** 2 + (y - 15) ** 2) / 70)
    dent = 2.5 * np.exp(-((x + 9) ** 2 + (y + 4) ** 2) / 90)
    return -x * x / 160 - y * y / 110 + x * y / 300 + bump - dent


def twofold(x: Array, y: Array) -> Array:
    """Held in every direction, but the same after half a turn."""
    bumps = np.exp(-((x - 12) ** 2 + (y - 6) ** 2) / 60) + np.exp(-((x + 12) ** 2 + (y + 6) ** 2) / 60)
    return -x * x / 160 - y * y / 110 + 3 * bumps


def height_field(shape: Shape, size: tuple[float, float] = (80.0, 60.0), step: float = 1.0) -> Scan:
    """The scan of z = shape(x, y) over `size` mm about the origin, z outwards."""
    x, y = np.meshgrid(*(np.linspace(-s / 2, s / 2, round(s / step) + 1) for s in size))
    return _scan(np.stack([x, y, shape(x, y)], axis=-1))


def cylinder(radius: float = 70.0, size: tuple[float, float] = (80.0, 60.0), step: float = 1.0) -> Scan:
    """A part of a cylinder about the line y = 0, z = -radius."""
    x, arc = np.meshgrid(*(np.linspace(-s / 2, s / 2, round(s / step) + 1) for s in size))
    return _scan(np.stack([x, radius * np.sin(arc / radius), radius * (np.cos(arc / radius) - 1)], axis=-1))


def ball(radius: float, steps: int = 60) -> Scan:
    """A closed sphere about the origin."""
    around, down = np.meshgrid(np.linspace(0, 2 * np.pi, 2 * steps + 1), np.linspace(0, np.pi, steps + 1))
    xyz = np.stack([np.sin(down) * np.cos(around), np.sin(down) * np.sin(around), np.cos(down)], axis=-1)
    return _scan(radius * np.round(xyz[::-1], 12))


def points_on(scan: Scan, count: int, rng: np.random.Generator, box: Array | None = None) -> Array:
    """Points (count, 3) at random on triangles whose centre falls into box ((x0, x1), (y0, y1)), by default all."""
    centres = scan.corners.mean(axis=1)[:, :2]
    inside = np.ones(len(centres), bool) if box is None else ((centres > box[:, 0]) & (centres < box[:, 1])).all(axis=1)
    triangle = rng.choice(np.flatnonzero(inside), count)
    return np.einsum("nk,nki->ni", rng.dirichlet([1, 1, 1], count), scan.corners[triangle])


def _scan(grid: Array) -> Scan:
    """The triangles of a grid (H, W, 3) of points, x to the right and y upwards as seen from outside."""
    number = np.arange(grid.shape[0] * grid.shape[1]).reshape(grid.shape[:2])
    a, b, c, d = (m.ravel() for m in (number[:-1, :-1], number[:-1, 1:], number[1:, 1:], number[1:, :-1]))
    triangles = np.concatenate([np.column_stack([a, b, c]), np.column_stack([a, c, d])])
    return scan_from_triangles(grid.reshape(-1, 3), triangles)
