"""Beads widened over the small gaps that a rough or narrow region leaves between them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import shapely
from numpy.typing import NDArray
from scipy.ndimage import convolve1d

from estimation.se3 import Array
from planning.fill.bead import Bead
from planning.fill.coverage import covered_by
from planning.fill.fit import Fit
from planning.fill.gap_fill import denser, prepared
from planning.fill.order import Run
from planning.fill.region import Region, minus
from planning.fill.rings import dots

FAR = 0.2  # spacings beyond a bead's edge up to which it is asked whether it lies open
SOUNDINGS = 12  # places in that
SMALLEST = 0.0015  # spacings squared: a smaller gap is none
MOST_TWICE = 0.045  # of the area: a tenth under the 5 % that may be laid twice, as it is told from the gaps alone
PRICES = (0.0, 0.25, 0.5, 1.0, 2.0)  # gap worth widening over what is covered already, by area: the next if it is more
EVEN = np.array([1.0, 2.0, 1.0]) / 4  # weights over neighbours: else the way turns sharply


def mended(runs: Sequence[Run], region: Region, fit: Fit) -> list[Run]:
    """Runs, each bead widened over the gaps that are nearest to it, and dots in those that are wide enough for one.

    What lies open at the contour stays so. Where too much would be laid twice, only over what is mostly gap.
    """
    beads = [bead for run in runs for bead in run]
    covered = covered_by(beads)
    gaps = shapely.get_parts(minus(region, covered))
    gaps = gaps[shapely.area(gaps) > SMALLEST * fit.spacing**2]
    gaps = gaps[~shapely.intersects(gaps, shapely.boundary(region))]
    if not len(gaps):
        return list(runs)
    lines = np.array([shapely.linestrings(bead.points) for bead in beads], dtype=object)
    nearest = shapely.distance(gaps[:, None], lines[None]).argmin(axis=1)
    reached = covered.area + float(shapely.area(gaps).sum()) + MOST_TWICE * region.area
    found = beads
    for price in PRICES:
        found = [_over(bead, gaps[nearest == i], fit, price) for i, bead in enumerate(beads)]
        if sum(bead.laid for bead in found) <= reached:
            break
    better = iter(found)
    return [[next(better) for _ in run] for run in runs] + [[dot] for dot in dots(gaps, fit)]


def _over(bead: Bead, gaps: NDArray[np.object_], fit: Fit, price: float) -> Bead:
    """A bead widened to either side where a gap begins at its edge; its ends stay. price: as in PRICES."""
    if not len(gaps):
        return bead
    bead = denser(bead, gaps, fit.spacing)
    left, own = _left(bead.points), prepared(gaps)
    depths = (np.arange(SOUNDINGS) + 0.5) * FAR * fit.spacing / SOUNDINGS
    more = np.stack([_open(bead, side * left, depths, own, price) for side in (1.0, -1.0)])  # (2, N)
    more *= np.minimum(np.maximum(fit.most - bead.width, 0.0) / np.maximum(more.sum(axis=0), 1e-12), 1.0)
    points = bead.points + left * ((more[0] - more[1]) / 2)[:, None]
    return Bead(points, bead.width + more.sum(axis=0))


def _open(bead: Bead, way: Array, depths: Array, gaps: shapely.Geometry, price: float) -> Array:
    """How far (N,), mm, gaps reach from a bead's edge along `way` (N, 2), as far as they are worth their price, evened
    out along the bead."""
    at = bead.points[:, None] + way[:, None] * (bead.width[:, None] / 2 + depths)[..., None]  # (N, S, 2)
    gain = np.cumsum(np.where(shapely.contains_xy(gaps, at[..., 0], at[..., 1]), 1.0, -price), axis=1)
    reach = np.where(gain.max(axis=1) > 0, depths[gain.argmax(axis=1)], 0.0)
    mode = "wrap" if bead.closed else "nearest"
    inner = convolve1d(reach[:-1] if bead.closed else reach, EVEN, mode=mode)
    return np.append(inner, inner[0]) if bead.closed else np.asarray(inner)


def _left(points: Array) -> Array:
    """Unit normals (N, 2) of a line (N, 2), to its left; of a closed one the same at both ends."""
    step = np.diff(points, axis=0)
    step /= np.maximum(np.linalg.norm(step, axis=1), 1e-9)[:, None]
    closed = np.abs(points[0] - points[-1]).max() < 1e-9
    before, after = (step[-1:], step[:1]) if closed else (step[:1], step[-1:])
    along = np.concatenate([before, step]) + np.concatenate([step, after])
    along /= np.maximum(np.linalg.norm(along, axis=1), 1e-9)[:, None]
    return np.stack([-along[:, 1], along[:, 0]], axis=1)
