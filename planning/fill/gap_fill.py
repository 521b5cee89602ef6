"""Beads widened over gaps: in rough or narrow regions, and into corners that the next closed line cannot reach."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import shapely
from numpy.typing import NDArray
from scipy.ndimage import convolve1d
from shapely.geometry.base import BaseGeometry

from estimation.se3 import Array
from planning.fill.bead import Bead, BeadFit, even_bead
from planning.fill.region import Region, covered_area, difference
from planning.fill.spiral import BeadRun

NEIGHBOUR_DISTANCE = 0.8  # spacings from a line's middle to a gap that it can widen into
GAP_SPACING = 0.15  # spacings from point to point along a gap
MAX_WIDENING = 0.5  # spacings by which a line widens at most: a corner of 50 degrees is that deep
DEPTH_SAMPLES = 8  # places across that depth at which the corner is tested for being open
SMOOTHING_ROUNDS = 2  # roundings of width and way, each over two points: else the way turns sharply
MIN_WIDENING = 0.01  # spacings: less is no widening
DOT_HALF_LENGTH = 0.05  # spacings to either side of a dot's middle: the nozzle hardly moves
MAX_GAP_DEPTH = 0.2  # spacings beyond a bead's edge up to which gaps are looked for
GAP_SAMPLES = 12  # places in that
MIN_GAP = 0.0015  # spacings squared: a smaller gap is none
MAX_DOUBLE = 0.045  # of the area: a tenth under the 5 % that may be laid twice, as it is estimated from the gaps alone
# of area laid twice, in area of gaps; the next one is tried where with this one too much is laid twice
OVERLAP_PRICES = (0.0, 0.25, 0.5, 1.0, 2.0)
SMOOTHING_KERNEL = np.array([1.0, 2.0, 1.0]) / 4  # weights over neighbours: else the way turns sharply


def widen_ring(ring: Bead, gaps: NDArray[np.object_], fit: BeadFit) -> Bead:
    """A closed line widened inwards, over what the next level leaves open."""
    spacing, deepest = fit.spacing, min(MAX_WIDENING * fit.spacing, fit.most - fit.spacing)
    line = shapely.linestrings(ring.points)
    shapely.prepare(line)
    near = gaps[shapely.dwithin(line, gaps, NEIGHBOUR_DISTANCE * spacing)]
    if not len(near):
        return ring
    ring = densify(ring, near, spacing)
    inward = -_left(ring.points)  # offsets run clockwise round what they fill
    depths = (np.arange(DEPTH_SAMPLES) + 0.5) * deepest / DEPTH_SAMPLES
    sounded = ring.points[:, None] + inward[:, None] * (ring.width[:, None] / 2 + depths)[..., None]  # (N, S, 2)
    open_there = shapely.contains_xy(prepared_union(near), sounded[..., 0], sounded[..., 1])
    more: Array = open_there.sum(axis=1) * (deepest / DEPTH_SAMPLES)
    more[np.abs(ring.width - spacing) > 1e-9] = 0.0
    more = _smooth_closed(more[:, None], np.ones(len(more)))[:, 0]
    widened = np.asarray(more > MIN_WIDENING * spacing, float)
    points = _smooth_closed(ring.points + inward * (more / 2)[:, None], widened)
    line = shapely.linestrings(np.column_stack([points, ring.width + more]))
    simple = shapely.simplify(line, MIN_WIDENING * spacing, preserve_topology=False)
    lines = shapely.get_coordinates(simple, include_z=True)
    return Bead(lines[:, :2], lines[:, 2])


def prepared_union(shapes: NDArray[np.object_]) -> BaseGeometry:
    """Polygons (G,) as one, prepared for many queries."""
    whole = shapely.multipolygons(shapes)
    shapely.prepare(whole)
    return whole


def _smooth_closed(values: Array, where: Array) -> Array:
    """Values (N, D) along a closed line, smoothed where `where` (N,) is 1."""
    values, weight = values[:-1], where[:-1, None] / 4
    for _ in range(SMOOTHING_ROUNDS):
        wrapped = np.concatenate([values[-1:], values, values[:1]])
        values = values + weight * (wrapped[:-2] - 2 * values + wrapped[2:])
    return np.concatenate([values, values[:1]])


def densify(ring: Bead, near: NDArray[np.object_], spacing: float) -> Bead:
    """The same line with points close together where it passes gaps."""
    along = ring.along
    extra = np.linspace(0, along[-1], int(along[-1] / (GAP_SPACING * spacing)) + 2)[1:-1]
    at = ring.at(extra)
    left, low, right, high = shapely.bounds(near).T[..., None]  # (G, 1) each
    (x, y, _), reach = at.T, NEIGHBOUR_DISTANCE * spacing
    across, upwards = (x > left - reach) & (x < right + reach), (y > low - reach) & (y < high + reach)
    beside = (across & upwards).any(axis=0)
    lines = ring.at(np.unique(np.concatenate([along, extra[beside]])))
    return Bead(lines[:, :2], lines[:, 2])


def dot_beads(gaps: NDArray[np.object_], fit: BeadFit) -> list[Bead]:
    """A short bead in the middle of each gap that is wide enough for one."""
    large = gaps[shapely.area(gaps) > np.pi * fit.one**2]
    beads = []
    for circle in [shapely.maximum_inscribed_circle(gap, 0.1 * fit.one) for gap in large]:
        middle, rim = shapely.get_coordinates(circle)
        radius = math.dist(middle, rim)
        if radius >= fit.one:
            half = np.array([DOT_HALF_LENGTH * fit.spacing, 0.0])
            beads.append(even_bead(np.stack([middle - half, middle + half]), min(2 * radius, fit.most)))
    return beads


def fill_gaps(runs: Sequence[BeadRun], region: Region, fit: BeadFit) -> list[BeadRun]:
    """Runs, each bead widened over the gaps that are nearest to it, and dots in those that are wide enough for one.

    What lies open at the contour stays so. Where too much would be laid twice, only over what is mostly gap.
    """
    beads = [bead for run in runs for bead in run]
    covered = covered_area(beads)
    gaps = shapely.get_parts(difference(region, covered))
    gaps = gaps[shapely.area(gaps) > MIN_GAP * fit.spacing**2]
    gaps = gaps[~shapely.intersects(gaps, shapely.boundary(region))]
    if not len(gaps):
        return list(runs)
    lines = np.array([shapely.linestrings(bead.points) for bead in beads], dtype=object)
    nearest = shapely.distance(gaps[:, None], lines[None]).argmin(axis=1)
    reached = covered.area + float(shapely.area(gaps).sum()) + MAX_DOUBLE * region.area
    widened = beads
    for price in OVERLAP_PRICES:
        widened = [_over(bead, gaps[nearest == i], fit, price) for i, bead in enumerate(beads)]
        if sum(bead.area for bead in widened) <= reached:
            break
    better = iter(widened)
    return [[next(better) for _ in run] for run in runs] + [[dot] for dot in dot_beads(gaps, fit)]


def _over(bead: Bead, gaps: NDArray[np.object_], fit: BeadFit, price: float) -> Bead:
    """A bead widened to either side where a gap begins at its edge; its ends stay. price: one of OVERLAP_PRICES."""
    if not len(gaps):
        return bead
    bead = densify(bead, gaps, fit.spacing)
    left, own = _left(bead.points), prepared_union(gaps)
    depths = (np.arange(GAP_SAMPLES) + 0.5) * MAX_GAP_DEPTH * fit.spacing / GAP_SAMPLES
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
    inner = convolve1d(reach[:-1] if bead.closed else reach, SMOOTHING_KERNEL, mode=mode)
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
