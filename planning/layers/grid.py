"""Heights over a plane: a regular grid, the triangles' topmost height at its nodes, and values between them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import distance_transform_edt, gaussian_filter

from estimation.se3 import Array

Mask = NDArray[np.bool_]
MOST_CANDIDATES = 2_000_000  # nodes tried against triangles at once: 100 MB


@dataclass(frozen=True, slots=True, eq=False)
class Grid:
    """Nodes of a square lattice. step: mm. origin: (2,) mm, x and y of node (0, 0). shape: (H, W), rows along y."""

    step: float
    origin: Array
    shape: tuple[int, int]

    @property
    def x(self) -> Array:
        """(W,) mm."""
        return np.asarray(self.origin[0] + self.step * np.arange(self.shape[1]))

    @property
    def y(self) -> Array:
        """(H,) mm."""
        return np.asarray(self.origin[1] + self.step * np.arange(self.shape[0]))

    @property
    def nodes(self) -> Array:
        """(H, W, 2) mm."""
        return np.stack(np.meshgrid(self.x, self.y), axis=-1)

    def coarser(self, step: float) -> Grid:
        """A grid over the same rectangle with nodes at least `step` apart, its last ones inside or on the edge."""
        shape = tuple(int((n - 1) * self.step / step + 1e-9) + 1 for n in self.shape)
        return Grid(step, self.origin, (shape[0], shape[1]))


def grid_over(low: ArrayLike, high: ArrayLike, step: float) -> Grid:
    """The grid from `low` (2,) to at least `high` (2,), mm."""
    low, high = np.asarray(low, float), np.asarray(high, float)
    columns, rows = (int(np.ceil(s / step - 1e-9)) + 1 for s in high - low)
    return Grid(step, low, (rows, columns))


def at(grid: Grid, values: Array, xy: ArrayLike) -> Array:
    """Values (N,) or (N, K) at points (N, 2) mm, bilinear between nodes (H, W) or (H, W, K), beside as at the edge."""
    rows, columns = grid.shape
    u = (np.asarray(xy, float) - grid.origin) / grid.step
    x, y = np.clip(u[:, 0], 0, columns - 1), np.clip(u[:, 1], 0, rows - 1)
    i, j = np.minimum(x.astype(np.int64), columns - 2), np.minimum(y.astype(np.int64), rows - 2)
    s, t = x - i, y - j
    flat, k = values.reshape(rows * columns, -1), j * columns + i
    parts = ((1 - s) * (1 - t), s * (1 - t), (1 - s) * t, s * t)
    found = sum(w[:, None] * flat[k + d] for w, d in zip(parts, (0, 1, columns, columns + 1), strict=True))
    return np.asarray(found).reshape(-1, *values.shape[2:])


def gradient(grid: Grid, values: Array) -> Array:
    """Slopes (H, W, 2) along x and y of values (H, W)."""
    along_y, along_x = np.gradient(values, grid.step)
    return np.stack([along_x, along_y], axis=-1)


def smoothed(grid: Grid, values: Array, radius: float, valid: Mask | None = None) -> Array:
    """Values (H, W) averaged by a Gaussian of `radius` mm over the valid nodes; the others are kept as they are."""
    if radius <= 0:
        return values
    sigma = radius / grid.step
    if valid is None or valid.all():
        return np.asarray(gaussian_filter(values, sigma, mode="nearest"))
    weight = gaussian_filter(valid.astype(float), sigma, mode="nearest")
    total = gaussian_filter(np.where(valid, values, 0.0), sigma, mode="nearest")
    return np.where(valid, total / np.maximum(weight, 1e-9), values)


def filled(values: Array, valid: Mask) -> Array:
    """Values (H, W) whose nodes that are not valid carry those of the nearest valid one."""
    nearest = distance_transform_edt(~valid, return_distances=False, return_indices=True)
    return np.asarray(values[tuple(nearest)])


def topmost(points: Array, triangles: NDArray[np.int64], grid: Grid) -> Array:
    """Height (H, W) of the topmost of triangles (T, 3) of points (V, 3) over each node; -inf where there is none."""
    heights = np.full(grid.shape[0] * grid.shape[1], -np.inf)
    corners = points[triangles]
    corners = corners[np.isfinite(corners).all(axis=(1, 2))]
    u = (corners[..., :2] - grid.origin) / grid.step  # (T, 3, 2) in nodes
    low = np.maximum(np.ceil(u.min(axis=1) - 1e-9), 0).astype(np.int64)
    high = np.minimum(np.floor(u.max(axis=1) + 1e-9), np.array(grid.shape[::-1]) - 1).astype(np.int64)
    counts = np.prod(np.maximum(high - low + 1, 0), axis=1)
    keep = np.flatnonzero(counts)
    for part in _parts(keep, counts[keep]):
        _raise(heights, u[part], corners[part, :, 2], low[part], high[part], counts[part], grid.shape[1])
    return heights.reshape(grid.shape)


def _parts(keep: NDArray[np.int64], counts: NDArray[np.int64]) -> list[NDArray[np.int64]]:
    total = np.cumsum(counts)
    cuts = np.searchsorted(total, np.arange(MOST_CANDIDATES, total[-1] if len(total) else 0, MOST_CANDIDATES))
    return [part for part in np.split(keep, cuts) if len(part)]


def _raise(
    heights: Array, u: Array, z: Array, low: NDArray[np.int64], high: NDArray[np.int64],
    counts: NDArray[np.int64], columns: int,
) -> None:  # fmt: skip
    """Raise `heights` (H * W,) to triangles u (T, 3, 2) in nodes, z (T, 3), in their boxes from low to high (T, 2)."""
    which = np.repeat(np.arange(len(u)), counts)
    k = np.arange(len(which)) - np.repeat(np.cumsum(counts) - counts, counts)
    wide = (high - low)[which, 0] + 1
    x, y = low[which, 0] + k % wide, low[which, 1] + k // wide
    a, b, c = u[:, 0], u[:, 1], u[:, 2]
    det = (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (c[:, 0] - a[:, 0]) * (b[:, 1] - a[:, 1])
    det = np.where(np.abs(det) > 1e-9, det, np.nan)  # upright triangles are seen as lines
    dx, dy = x - a[which, 0], y - a[which, 1]
    s = (dx * (c - a)[which, 1] - dy * (c - a)[which, 0]) / det[which]
    t = (dy * (b - a)[which, 0] - dx * (b - a)[which, 1]) / det[which]
    inside = (s >= -1e-9) & (t >= -1e-9) & (s + t <= 1 + 1e-9)
    w, s, t = which[inside], s[inside], t[inside]
    height = z[w, 0] + s * (z[w, 1] - z[w, 0]) + t * (z[w, 2] - z[w, 0])
    np.maximum.at(heights, y[inside] * columns + x[inside], height)
