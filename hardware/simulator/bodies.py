"""Parametric bodies with a wound in them: forearm, chest, foot."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np

from estimation.se3 import Array
from hardware.simulator.scene.fields import smooth
from hardware.simulator.scene.shape import STEP, Shape, shape_from_function

MARGIN = 9.0  # mm of body under the drape on every side of the opening


@dataclass(frozen=True, slots=True)
class Wound:
    """A wound about the origin. size: (x, y) mm of its irregular outline; depth: mm of its bed below the skin."""

    size: tuple[float, float] = (42.0, 31.0)
    depth: float = 2.4


def forearm(x: Array, y: Array) -> Array:
    """Heights of a cylinder along x that tapers from 50 to 45 mm, its muscle bulging on one side."""
    radius = 47.5 - 0.022 * x
    return np.asarray(_arch(y, radius) + 0.022 * x + 1.1 * np.exp(-(((x + 40) / 35) ** 2) - ((y - 14) / 18) ** 2))


def chest(x: Array, y: Array) -> Array:
    """Heights of a broad, gently vaulted wall with the swell of ribs under it."""
    ribs = 0.35 * np.sin(2 * np.pi * (y + 0.25 * x) / 34.0)
    return np.asarray(_arch(y, 190.0) + _arch(x, 260.0) + ribs)


def foot(x: Array, y: Array) -> Array:
    """Heights of an instep: strongly curved across, hollow along, with a tendon."""
    tendon = 0.9 * np.exp(-(((y - 18 - 0.2 * x) / 4.5) ** 2))
    return np.asarray(_arch(y, 52.0) + 0.0016 * x**2 - 0.05 * x + 0.0005 * x * y + tendon)


BODIES: dict[str, tuple[Callable[[Array, Array], Array], tuple[float, float]]] = {
    "forearm": (forearm, (120.0, 62.0)),
    "chest": (chest, (120.0, 90.0)),
    "foot": (foot, (110.0, 74.0)),
}  # height and opening (x, y) mm of each


def body(kind: str, wound: Wound | None, seed: int, step: float = STEP) -> Shape:
    """The shape of `kind` (a key of BODIES) with a wound at the origin, its skin level there being z = 0."""
    height, opening = BODIES[kind]
    rng = np.random.default_rng([seed, 21])
    bare = shape_from_function(height, (opening[0] + 2 * MARGIN, opening[1] + 2 * MARGIN), step)
    grid = bare.heights.shape
    heights = bare.heights - bare.heights_at([[0.0, 0.0]])
    heights += 0.22 * smooth(grid, 26 / step, rng) + 0.05 * smooth(grid, 7 / step, rng)  # the body's own unevenness
    if wound is None:
        return Shape(step, heights)
    inside = outline(grid, step, wound, rng)
    heights += _relief(inside, step, wound, rng)
    return Shape(step, heights, inside=inside)


def with_wound(shape: Shape, wound: Wound, seed: int) -> Shape:
    """The shape with a wound drawn, not carved, at its middle: a scan has its own relief."""
    inside = outline(shape.heights.shape, shape.step, wound, np.random.default_rng([seed, 21]))
    return Shape(shape.step, shape.heights, shape.surface_from_grid, inside, shape.valid)


def outline(grid: tuple[int, int], step: float, wound: Wound, rng: np.random.Generator) -> Array:
    """About how far inside the wound's edge each node is, (H, W) mm; an irregular oval of the wound's size."""
    rows, columns = grid
    x, y = np.meshgrid((np.arange(columns) - (columns - 1) / 2) * step, (np.arange(rows) - (rows - 1) / 2) * step)
    half = np.array(wound.size) / 2
    x = x + 0.05 * half[0] * smooth(grid, 9 / step, rng)
    y = y + 0.05 * half[1] * smooth(grid, 9 / step, rng)
    angle, edge = np.arctan2(y / half[1], x / half[0]), np.ones(grid)
    for k in range(2, 8):
        edge += rng.normal(0, 0.13 / k) * np.cos(k * angle + rng.uniform(0, 2 * np.pi))
    radius = np.hypot(x / half[0], y / half[1])
    return np.asarray((edge - radius) * half.min() + 0.12 * smooth(grid, 1.6 / step, rng))


def _relief(inside: Array, step: float, wound: Wound, rng: np.random.Generator) -> Array:
    """What the wound adds to the heights (H, W), mm: a swollen rim, a wall, an uneven bed."""
    wall = 0.9 * wound.depth  # mm wide, so that its slope stays below 1
    t = np.clip((inside + 0.25 * wall) / (1.6 * wall), 0, 1)
    sunk = t * t * (3 - 2 * t)
    uneven = 0.22 * smooth(inside.shape, 9 / step, rng) + 0.1 * smooth(inside.shape, 3 / step, rng)
    bed = wound.depth * (0.82 + 0.18 * np.clip(inside / 8, 0, 1) + np.clip(uneven, -0.5, 0.5))
    swollen = 0.45 * np.exp(-(((inside + 2.2) / 1.9) ** 2))
    return np.asarray(cv2.GaussianBlur(swollen - sunk * bed, (0, 0), 0.35 / step))


def _arch(y: Array, radius: Array | float) -> Array:
    """Heights of a circle's top, going on straight where its slope passes 0.85: cloth and camera see no further."""
    edge = radius * 0.85 / np.hypot(1, 0.85)
    near = np.clip(y, -edge, edge)
    return np.asarray(np.sqrt(radius**2 - near**2) - radius - 0.85 * (np.abs(y) - np.abs(near)))
