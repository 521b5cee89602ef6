"""The healthy skin over a wound, interpolated across its rim: a quadric, and what the skin near by departs from it.

Universal kriging (Matheron 1969): the departure is taken for a Gaussian process, so that the surface meets the skin
around the wound and returns to the limb's own curvature over its middle. A thin plate instead carries the slope of a
swollen rim across the whole wound: on simulated limbs its error was twice as large.
"""

from __future__ import annotations

import numpy as np
from scipy.interpolate import RBFInterpolator
from scipy.ndimage import distance_transform_edt, map_coordinates

from estimation.scan import Index
from estimation.se3 import Array
from planning.layers.grid import Grid, Mask, at

COARSE = 2.0  # mm between nodes where it is worked out; skin bends over centimetres
MOST = 300  # points it is held by
REACH = 12.0  # mm over which a departure from the quadric fades, as the best of 10 to 30 mm on simulated limbs
FIRST_REACH = 30.0  # mm, while the wound is not known: too stiff to creep down its walls
NUGGET = 0.1  # variance of a point by itself over that of the departures
SEED = 0.15  # of the greatest distance from the scan's rim: taken for skin at first
ROUNDS = 10  # at most
SIGMAS, LEAST_STEP = 4.0, 0.3  # skin lies within so many deviations, and mm, of it


def restored(grid: Grid, heights: Array, held: Mask, reach: float = REACH) -> Array:
    """Heights (H, W) of healthy skin over the whole grid, from those at the nodes `held`."""
    rows, columns = np.nonzero(held)
    chosen = _spread(rows, columns, held.shape)
    places = np.column_stack([grid.x[columns[chosen]], grid.y[rows[chosen]]])
    middle, size = places.mean(axis=0), float(np.ptp(places, axis=0).max())
    solved = RBFInterpolator(
        (places - middle) / size, heights[rows[chosen], columns[chosen]], smoothing=NUGGET,
        kernel="gaussian", epsilon=size / reach, degree=2,
    )  # fmt: skip
    nodes = (grid.nodes.reshape(-1, 2) - middle) / size
    return np.asarray(solved(nodes)).reshape(grid.shape)


def _spread(rows: Index, columns: Index, shape: tuple[int, ...]) -> Index:
    """Numbers of up to MOST nodes, evenly spread: one in each square of a lattice just coarse enough."""
    every = 1
    while True:
        _, first = np.unique(rows // every * shape[1] + columns // every, return_index=True)
        if len(first) <= MOST:
            return np.asarray(first)
        every += 1


def skin_nodes(grid: Grid, heights: Array, valid: Mask) -> tuple[Array, Mask, float]:
    """The healthy surface (H, W) guessed without knowing the wound, the nodes that are skin, and their scatter, mm.

    The skin along the scan's rim is taken for healthy; the surface through it shows what else is.
    """
    inner = distance_transform_edt(np.pad(valid, 1))[1:-1, 1:-1]
    seed = valid & (inner <= max(2.0, SEED * inner.max()))
    held, surface, sigma = seed, heights, 0.0
    for _ in range(ROUNDS):
        surface = restored(grid, heights, held, FIRST_REACH)
        off = np.abs(heights - surface)
        sigma = 1.4826 * float(np.median(off[held]))
        now = valid & (off < max(SIGMAS * sigma, LEAST_STEP))
        now |= seed & (off < 3 * max(SIGMAS * sigma, LEAST_STEP))
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
    return at(grid, values, coarse.nodes.reshape(-1, 2)).reshape(coarse.shape)
