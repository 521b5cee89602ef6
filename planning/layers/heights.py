"""The scan as heights over a plane, and the healthy skin interpolated over the wound.

The skin is a quadric and the departure of the skin near by from it (universal kriging, Matheron 1969): the departure is
a Gaussian process, so the surface meets the skin around the wound and returns to the limb's own curvature over its
middle. A thin plate instead carries the slope of a swollen rim across the whole wound: on simulated limbs its error was
twice as large.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import RBFInterpolator
from scipy.ndimage import binary_erosion, binary_fill_holes, distance_transform_edt, gaussian_filter, map_coordinates

from estimation import se3
from estimation.scans.scan import Scan
from estimation.se3 import Array, Index
from planning.layers.grid import Grid, Mask, filled, grid_over, interpolate, smoothed, topmost

MAX_NODES = 400_000  # of a grid: 3 MB a layer
SMOOTHING_PER_NOISE = 8.0  # mm for each mm of noise: leaves a tenth of it on a scan of 0.5 mm between points
MAX_SMOOTHING = 1.0  # mm: more would round the wound's rim away
MIN_NOISE = 0.01  # mm: noise below is not worth smoothing
CLOSING_RADII = (1.0, 2.0, 4.0, 8.0, 16.0, 32.0)  # nodes: how far each round of closing holes looks
COARSE_STEP = 2.0  # mm between nodes where it is worked out; skin bends over centimetres
MAX_CENTRES = 300  # points it is held by
KERNEL_RADIUS = 12.0  # mm over which a departure from the quadric fades, as the best of 10 to 30 mm on simulated limbs
FIRST_KERNEL_RADIUS = 30.0  # mm, while the wound is not known: too stiff to creep down its walls
NUGGET_VARIANCE = 0.1  # variance of a point by itself over that of the departures
RIM_SEED_SHARE = 0.15  # of the greatest distance from the scan's rim: taken for skin at first
MAX_SKIN_ROUNDS = 10  # at most
SKIN_SIGMAS, MIN_SKIN_BAND = 4.0, 0.3  # skin lies within so many deviations, and mm, of it


@dataclass(frozen=True, slots=True, eq=False)
class HeightMap:
    """Heights of a scan over a plane."""

    surface_from_plane: Array  # (4, 4) mm
    grid: Grid
    heights: Array  # (H, W) mm
    scanned: Mask  # (H, W) where the scan has a triangle
    closed: Mask  # (H, W) where a hole was closed
    noise: float  # mm, standard deviation of the scan
    smoothing: float  # mm over which it was averaged

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
    step = max(step, float(np.sqrt(np.prod(high - low) / MAX_NODES)))
    grid = grid_over(low, high, step)
    top = topmost(points, scan.triangles, grid)
    scanned = np.isfinite(top)
    closed = np.asarray(binary_fill_holes(scanned)) & ~scanned
    heights = _closed(np.where(scanned, top, 0.0), scanned, closed)
    noise = _noise(grid, heights, scanned)
    radius = min(SMOOTHING_PER_NOISE * noise, MAX_SMOOTHING) if noise > MIN_NOISE else 0.0
    heights = smoothed(grid, heights, radius, scanned | closed)
    return HeightMap(surface_from_plane, grid, heights, scanned, closed, noise, radius)


def _closed(heights: Array, scanned: Mask, holes: Mask) -> Array:
    """Heights with holes closed by averages of what is around them, and nodes beyond the rim as the nearest one."""
    heights, known = heights.copy(), scanned.copy()
    for reach in CLOSING_RADII:
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


def restore_skin(grid: Grid, heights: Array, held: Mask, reach: float = KERNEL_RADIUS) -> Array:
    """Heights (H, W) of healthy skin over the whole grid, from those at the nodes `held`."""
    rows, columns = np.nonzero(held)
    chosen = _spread(rows, columns, held.shape)
    places = np.column_stack([grid.x[columns[chosen]], grid.y[rows[chosen]]])
    middle, size = places.mean(axis=0), float(np.ptp(places, axis=0).max())
    solved = RBFInterpolator(
        (places - middle) / size, heights[rows[chosen], columns[chosen]], smoothing=NUGGET_VARIANCE,
        kernel="gaussian", epsilon=size / reach, degree=2,
    )  # fmt: skip
    nodes = (grid.nodes.reshape(-1, 2) - middle) / size
    return np.asarray(solved(nodes)).reshape(grid.shape)


def _spread(rows: Index, columns: Index, shape: tuple[int, ...]) -> Index:
    """Numbers of up to MAX_CENTRES nodes, evenly spread: one in each square of a lattice just coarse enough."""
    every = 1
    while True:
        _, first = np.unique(rows // every * shape[1] + columns // every, return_index=True)
        if len(first) <= MAX_CENTRES:
            return np.asarray(first)
        every += 1


def skin_nodes(grid: Grid, heights: Array, valid: Mask) -> tuple[Array, Mask, float]:
    """The healthy surface (H, W) guessed without knowing the wound, the nodes that are skin, and their scatter, mm.

    The skin along the scan's rim is taken for healthy; the surface through it shows what else is.
    """
    inner = distance_transform_edt(np.pad(valid, 1))[1:-1, 1:-1]
    seed = valid & (inner <= max(2.0, RIM_SEED_SHARE * inner.max()))
    held, surface, sigma = seed, heights, 0.0
    for _ in range(MAX_SKIN_ROUNDS):
        surface = restore_skin(grid, heights, held, FIRST_KERNEL_RADIUS)
        off = np.abs(heights - surface)
        sigma = 1.4826 * float(np.median(off[held]))
        now = valid & (off < max(SKIN_SIGMAS * sigma, MIN_SKIN_BAND))
        now |= seed & (off < 3 * max(SKIN_SIGMAS * sigma, MIN_SKIN_BAND))
        if now.sum() < 30 or (now == held).all():
            break
        held = now
    return surface, held, sigma


def upsampled(grid: Grid, coarse: Grid, values: Array) -> Array:
    """Values (h, w) of a coarse grid at the nodes of a fine one (H, W), by cubic splines."""
    ratio = grid.step / coarse.step
    rows, columns = (np.arange(n) * ratio for n in grid.shape)
    return np.asarray(map_coordinates(values, np.meshgrid(rows, columns, indexing="ij"), order=3, mode="nearest"))


def downsampled(grid: Grid, coarse: Grid, values: Array) -> Array:
    """Values (H, W) of a fine grid at the nodes of a coarse one (h, w)."""
    return interpolate(grid, values, coarse.nodes.reshape(-1, 2)).reshape(coarse.shape)
