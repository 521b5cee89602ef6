"""Landmarks on surfaces of simple shape, each with its normal."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from estimation.se3 import Array

PATCH, RADIUS = (60.0, 45.0), 70.0  # mm: a wound's surroundings on an arm
EDGE = 40.0  # mm


@dataclass(frozen=True, slots=True, eq=False)
class Landmarks:
    """points: (N, 3) mm. normals: (N, 3) unit, outwards. Both in the surface frame."""

    points: Array
    normals: Array

    def __len__(self) -> int:
        return len(self.points)


Surface = Callable[[int, np.random.Generator], Landmarks]


def patch(count: int, rng: np.random.Generator) -> Landmarks:
    """`count` landmarks at random on a patch of 60 x 45 mm, bent about its x axis to a radius of 70 mm."""
    x, y = (rng.uniform(-0.5, 0.5, (count, 2)) * PATCH).T
    up = np.sqrt(RADIUS**2 - y**2)
    return Landmarks(np.stack([x, y, up - RADIUS], -1), np.stack([0 * x, y, up], -1) / RADIUS)


def cube(count: int, rng: np.random.Generator) -> Landmarks:
    """`count` landmarks at random on a cube of 40 mm, its bottom left out; the origin is the middle of its top."""
    outward = np.array([[0, 0, 1], [1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0]], float)
    normals = outward[rng.integers(0, len(outward), count)]
    points = rng.uniform(-EDGE / 2, EDGE / 2, (count, 3))
    points = np.where(normals != 0, normals * EDGE / 2, points)
    return Landmarks(points - [0, 0, EDGE / 2], normals)


SURFACES: dict[str, Surface] = {made.__name__: made for made in (patch, cube)}
