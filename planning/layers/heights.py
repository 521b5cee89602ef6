"""The scan as heights over a plane: sampled, its holes closed, its noise measured and taken out."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import binary_erosion, binary_fill_holes, gaussian_filter

from estimation import se3
from estimation.scan import Scan
from estimation.se3 import Array
from planning.layers.grid import Grid, Mask, filled, grid_over, smoothed, topmost

MOST_NODES = 400_000  # of a grid: 3 MB a layer
SMOOTH = 8.0  # mm of smoothing for each mm of noise: leaves a tenth of it on a scan of 0.5 mm between points
MOST_SMOOTH = 1.0  # mm: more would round the wound's rim away
QUIET = 0.01  # mm: noise below is not worth smoothing
WIDENING = (1.0, 2.0, 4.0, 8.0, 16.0, 32.0)  # nodes: how far each round of closing holes looks


@dataclass(frozen=True, slots=True, eq=False)
class HeightMap:
    """Heights (H, W) mm over a plane. scanned: where the scan has a triangle; closed: where a hole was closed.

    surface_from_plane: (4, 4). noise: mm, one standard deviation, of the scan; smoothing: mm, by which it was averaged.
    """

    surface_from_plane: Array
    grid: Grid
    heights: Array
    scanned: Mask
    closed: Mask
    noise: float
    smoothing: float

    @property
    def known(self) -> Mask:
        """Where there is a height to build on."""
        return self.scanned | self.closed


def height_map(scan: Scan, surface_from_plane: Array, step: float, box: Array | None = None) -> HeightMap:
    """The scan's topmost heights over a plane, `step` mm apart or more. box: low and high corner (2, 2), mm."""
    points = se3.transform_points(se3.inverse(surface_from_plane), scan.vertices)
    low, high = points[:, :2].min(axis=0), points[:, :2].max(axis=0)
    if box is not None:
        low, high = np.maximum(low, box[0]), np.minimum(high, box[1])
    step = max(step, float(np.sqrt(np.prod(high - low) / MOST_NODES)))
    grid = grid_over(low, high, step)
    top = topmost(points, scan.triangles, grid)
    scanned = np.isfinite(top)
    closed = np.asarray(binary_fill_holes(scanned)) & ~scanned
    heights = _closed(np.where(scanned, top, 0.0), scanned, closed)
    noise = _noise(grid, heights, scanned)
    radius = min(SMOOTH * noise, MOST_SMOOTH) if noise > QUIET else 0.0
    heights = smoothed(grid, heights, radius, scanned | closed)
    return HeightMap(surface_from_plane, grid, heights, scanned, closed, noise, radius)


def _closed(heights: Array, scanned: Mask, holes: Mask) -> Array:
    """Heights with holes closed by averages of what is around them, and nodes beyond the rim as the nearest one."""
    heights, known = heights.copy(), scanned.copy()
    for reach in WIDENING:
        todo = holes & ~known
        if not todo.any():
            break
        weight = gaussian_filter(known.astype(float), reach, truncate=2.0)
        total = gaussian_filter(np.where(known, heights, 0.0), reach, truncate=2.0)
        near = todo & (weight > 0.2)
        heights[near] = total[near] / weight[near]
        known |= near
    return filled(heights, known)


def _noise(grid: Grid, heights: Array, scanned: Mask) -> float:
    """The scatter of heights about their neighbourhood, mm: of the quieter half, which is no wall and no rim."""
    sigma = 1.0 / grid.step
    off = np.abs(heights - gaussian_filter(heights, sigma, mode="nearest"))
    inner = binary_erosion(scanned, iterations=max(1, int(2 * sigma)))
    sample = off[inner] if inner.any() else off[scanned]
    return 1.4826 * float(np.median(sample)) if len(sample) else 0.0
