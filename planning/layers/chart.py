"""The plane stretched to the length of the skin, so that beads laid side by side in it lie side by side on the limb.

Lengths are added up along x and y from the middle of the wound: on a cylinder along either axis this is its unrolling,
and on any other surface areas are right to the second order of the slope.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from estimation.se3 import Array
from planning.layers.grid import Grid, at, gradient

STEPS = 8  # of Newton's method, each at least halving the error where the skin slopes by less than 60 degrees
STEEPEST = 1.5  # slope, 56 degrees: of skin; beyond, it is the edge of a scan


@dataclass(frozen=True, slots=True, eq=False)
class Chart:
    """A stretched plane. grid: in the plane. places: (H, W, 2) mm, where each node lies in the chart.

    stretch: (H, W, 2), how much longer a step along x and y is there. cosine: (H, W), plane area over chart area.
    """

    grid: Grid
    places: Array
    stretch: Array
    cosine: Array

    def from_plane(self, xy: Array) -> Array:
        """Points (N, 2) in the chart, mm, of points in the plane."""
        edge = np.clip(xy, self.grid.origin, [self.grid.x[-1], self.grid.y[-1]])
        return at(self.grid, self.places, xy) + xy - edge

    def to_plane(self, uv: Array) -> Array:
        """Points (N, 2) in the plane, mm, of points in the chart."""
        xy = np.array(uv, float)
        for _ in range(STEPS):
            off = uv - self.from_plane(xy)
            xy = xy + off / at(self.grid, self.stretch, xy)
            if not len(off) or np.abs(off).max() < 1e-6:
                break
        return xy


def flat(grid: Grid) -> Chart:
    """The plane itself."""
    return Chart(grid, grid.nodes, np.ones((*grid.shape, 2)), np.ones(grid.shape))


def unrolled(grid: Grid, heights: Array) -> Chart:
    """The chart of a surface with heights (H, W) over the plane."""
    slopes = np.clip(gradient(grid, heights), -STEEPEST, STEEPEST)
    stretch = np.sqrt(1 + slopes**2)
    middle = tuple(np.clip(np.rint(-grid.origin / grid.step), 0, np.array(grid.shape[::-1]) - 1).astype(int))
    places = np.stack([_summed(stretch[..., 0], 1), _summed(stretch[..., 1], 0)], axis=-1) * grid.step
    places[..., 0] += grid.x[middle[0]] - places[:, middle[0], 0][:, None]
    places[..., 1] += grid.y[middle[1]] - places[middle[1], :, 1][None, :]
    return Chart(grid, places, stretch, 1 / np.prod(stretch, axis=-1))


def _summed(values: Array, axis: int) -> Array:
    """The trapezoid sums of values (H, W) from the first node on, along an axis."""
    total = np.cumsum(values, axis=axis)
    first = np.take(values, [0], axis=axis)
    return np.asarray(total - values / 2 - first / 2)
