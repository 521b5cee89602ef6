"""How the tool stands: along the surface's normal, as far as limits of its tilt and of its turning allow."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from estimation import se3
from estimation.se3 import Array
from planning.layers.grid import Grid, Mask, gradient, smoothed

RADII = (0.0, 0.5, 1.0, 2.0, 4.0, 8.0)  # mm: by the first that holds the limit the normals are smoothed


@dataclass(frozen=True, slots=True)
class ToolLimits:
    """tilt: rad from the plane's normal, at most. turning: rad per mm of way, at most. spin: rad, about the tool's own
    axis, free, as a round nozzle prints alike at any; 0 lays its x along the scan's."""

    tilt: float = np.deg2rad(30.0)
    turning: float = np.deg2rad(5.0)
    spin: float = 0.0


@dataclass(frozen=True, slots=True, eq=False)
class Tilts:
    """Tilts (H, W, 2), rad, of a surface: how far its normal leans, along the way that it rises. radius: mm that they
    were smoothed over. departure: rad, by which the tool is off the true normal at worst, inside the wound."""

    values: Array
    radius: float
    departure: float


def tilts(grid: Grid, heights: Array, inside: Mask, limits: ToolLimits) -> Tilts:
    """Tilts of a surface with heights (H, W) that keep the limits wherever the tool goes, not on one path only.

    A field that changes by at most `turning` a mm turns no tool faster on any way across it.
    """
    true = _tilts(gradient(grid, heights))
    chosen, used = true, 0.0
    for used in RADII:
        chosen = _clipped(_tilts(gradient(grid, smoothed(grid, heights, used))), limits.tilt)
        rate = _rate(grid, chosen, inside)
        if rate <= limits.turning:
            break
    else:
        chosen = chosen * (limits.turning / rate)
    return Tilts(chosen, used, float(np.linalg.norm(true - chosen, axis=-1)[inside].max(initial=0.0)))


def _tilts(slopes: Array) -> Array:
    steep = np.linalg.norm(slopes, axis=-1, keepdims=True)
    return np.asarray(slopes * np.arctan(steep) / np.maximum(steep, 1e-12))


def _clipped(values: Array, most: float) -> Array:
    size = np.linalg.norm(values, axis=-1, keepdims=True)
    return np.asarray(values * np.minimum(1.0, most / np.maximum(size, 1e-12)))


def _rate(grid: Grid, values: Array, inside: Mask) -> float:
    """The fastest change of tilts, rad per mm, in any direction, over the nodes inside."""
    parts = np.concatenate([gradient(grid, values[..., k])[inside] for k in range(2)], axis=1)  # (N, 4)
    a, b, c, d = parts.T
    squares, area = a * a + b * b + c * c + d * d, a * d - b * c
    return float(np.sqrt(np.max((squares + np.sqrt(np.maximum(squares**2 - 4 * area**2, 0))) / 2, initial=0.0)))


def rotations(tilt: Array, spin: float) -> Array:
    """plane_from_nozzle rotations (N, 3, 3) of tilts (N, 2): the least turn from upright, after the spin."""
    turn = np.column_stack([tilt[:, 1], -tilt[:, 0], np.zeros(len(tilt))])
    return np.asarray(se3.exp_rotation(turn) @ se3.exp_rotation(np.array([0.0, 0.0, spin])))
