"""Bumps of the scanned bed that stand over a layer: low ones are gone over, high ones round (thesis 5.2, Fig. 5.5).

What joins the skin around the wound is its wall and no bump: a layer ends there anyway.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import shapely
from scipy.ndimage import label
from shapely import MultiPolygon

from estimation.se3 import Array, Index
from planning.layers.grid import Grid, Mask, positive_region

EIGHT_NEIGHBOURS = np.ones((3, 3), int)  # nodes joined across corners too, so that no outline runs between them
# of a layer's height that a bump may stand over its top: the layer over it keeps three tenths of its own there
DEFAULT_BUMP_LIMIT = 0.5
MAX_BUMP_LIMIT = 0.6  # the same at most: the layer over it then keeps a fifth, the thinnest bead
# of a bead beside a high bump: a needle is about twice as thick as its bead (22 G: 0.41 in, 0.72 mm out)
DEFAULT_CLEARANCE = 0.5


@dataclass(frozen=True, slots=True)
class BumpPassing:
    """How bumps are passed."""

    over: float | None = None  # mm above a layer's top up to which one is gone over; None: DEFAULT_BUMP_LIMIT
    clearance: float | None = None  # mm kept around a higher one; None: DEFAULT_CLEARANCE

    def limit(self, height: float) -> float:
        """mm above the top of a layer `height` mm high."""
        return DEFAULT_BUMP_LIMIT * height if self.over is None else min(self.over, MAX_BUMP_LIMIT * height)

    def clear(self, width: float) -> float:
        """mm around bumps, for beads `width` mm wide."""
        return DEFAULT_CLEARANCE * width if self.clearance is None else self.clearance


@dataclass(frozen=True, slots=True, eq=False)
class Bumps:
    """The bumps of one layer, in the plane, mm."""

    over: MultiPolygon  # where the bed is over the layer's middle and gone over
    around: MultiPolygon  # where it stands too high above the layer's top
    highest: float  # mm above the top, of all; 0 where there is none


@dataclass(frozen=True, slots=True)
class BumpLayer:
    """A layer that bumps may stand over."""

    height: float  # mm
    limit: float  # mm above its top up to which a bump is gone over
    level: bool  # it does not follow the bed by itself


DEFAULT_PASSING = BumpPassing()
NO_BUMPS = Bumps(MultiPolygon(), MultiPolygon(), 0.0)


def nodes_in_outline(grid: Grid, outline: MultiPolygon) -> Mask:
    """(H, W) which nodes lie inside an outline, islands of skin in it too: where what rises may be a bump."""
    whole = shapely.union_all([shapely.Polygon(part.exterior) for part in outline.geoms])
    shapely.prepare(whole)
    return np.asarray(shapely.contains_xy(whole, grid.nodes[..., 0], grid.nodes[..., 1]))


def bumps_in(grid: Grid, inside: Mask, rise: Array, step: BumpLayer, slack: float) -> Bumps:
    """The bumps of a layer over whose top the bed rises by `rise` (H, W) mm.

    inside: where bumps are looked for. slack: mm, of outlines.
    """
    grid, inside, rise = _window(grid, inside, rise)
    low, peaks = _bumps(rise > -step.height / 2, inside, rise, step.limit if step.level else -np.inf)
    high, tops = _bumps(rise > step.limit, inside, rise, np.inf)
    if not len(peaks) and not len(tops):
        return NO_BUMPS
    over = _shapes(grid, low, rise + step.height / 2, slack)
    return Bumps(over, _shapes(grid, high, rise - step.limit, slack), float(np.concatenate([peaks, tops]).max()))


def _window(grid: Grid, inside: Mask, values: Array) -> tuple[Grid, Mask, Array]:
    """The part of a grid that holds all nodes inside and one more around."""
    rows, columns = (np.flatnonzero(inside.any(axis=k)) for k in (1, 0))
    top, left = max(rows[0] - 1, 0), max(columns[0] - 1, 0)
    part = slice(top, rows[-1] + 2), slice(left, columns[-1] + 2)
    inside, values = inside[part], values[part]
    return Grid(grid.step, grid.origin + grid.step * np.array([left, top]), inside.shape), inside, values


def _bumps(raised: Mask, inside: Mask, rise: Array, limit: float) -> tuple[Mask, Array]:
    """The nodes (H, W) of joined raised ones that stay in the wound and rise to `limit` at most; the peaks (K,)."""
    if not (raised & inside).any():
        return np.zeros_like(raised), np.empty(0)
    labelled: tuple[Index, int] = label(raised, EIGHT_NEIGHBOURS)
    pieces, count = labelled
    walls = np.zeros(count + 1, bool)
    walls[pieces[~inside]] = True
    peaks = np.full(count + 1, -np.inf)
    np.maximum.at(peaks, pieces.ravel(), rise.ravel())
    chosen = (peaks <= limit) & ~walls
    chosen[0] = False  # what is not raised
    return chosen[pieces], peaks[chosen]


def _shapes(grid: Grid, own: Mask, values: Array, slack: float) -> MultiPolygon:
    """Where values (H, W) are positive at the nodes `own` and beside them."""
    if not own.any():
        return MultiPolygon()
    shape = positive_region(grid, np.where(own | (values <= 0), values, -np.abs(values)), 0.0, slack)
    shapely.prepare(shape)
    return shape
