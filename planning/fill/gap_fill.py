"""Closed lines that widen into the corners which the next line inwards cannot reach."""

from __future__ import annotations

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely.geometry.base import BaseGeometry

from estimation.se3 import Array
from planning.fill.bead import Bead
from planning.fill.fit import Fit

BESIDE = 0.8  # spacings from a line's middle to a gap that it can widen into
DENSE = 0.15  # spacings from point to point along a gap
DEEPEST = 0.5  # spacings by which a line widens at most: a corner of 50 degrees is that deep
SOUNDINGS = 8  # places across that depth at which it is asked whether the corner lies open
CALM = 2  # roundings of width and way, each over two points: else the way turns sharply
FINE = 0.01  # spacings: less is no widening


def widened(ring: Bead, gaps: NDArray[np.object_], fit: Fit) -> Bead:
    """A closed line widened inwards, over what the next level leaves open."""
    spacing, deepest = fit.spacing, min(DEEPEST * fit.spacing, fit.most - fit.spacing)
    line = shapely.linestrings(ring.points)
    shapely.prepare(line)
    near = gaps[shapely.dwithin(line, gaps, BESIDE * spacing)]
    if not len(near):
        return ring
    ring = denser(ring, near, spacing)
    inward = _inward(ring.points)
    depths = (np.arange(SOUNDINGS) + 0.5) * deepest / SOUNDINGS
    sounded = ring.points[:, None] + inward[:, None] * (ring.width[:, None] / 2 + depths)[..., None]  # (N, S, 2)
    open_there = shapely.contains_xy(prepared(near), sounded[..., 0], sounded[..., 1])
    more: Array = open_there.sum(axis=1) * (deepest / SOUNDINGS)
    more[np.abs(ring.width - spacing) > 1e-9] = 0.0
    more = _calm(more[:, None], np.ones(len(more)))[:, 0]
    points = _calm(ring.points + inward * (more / 2)[:, None], np.asarray(more > FINE * spacing, float))
    line = shapely.linestrings(np.column_stack([points, ring.width + more]))
    lines = shapely.get_coordinates(shapely.simplify(line, FINE * spacing, preserve_topology=False), include_z=True)
    return Bead(lines[:, :2], lines[:, 2])


def prepared(shapes: NDArray[np.object_]) -> BaseGeometry:
    """Polygons (G,) as one, made ready for many questions."""
    whole = shapely.multipolygons(shapes)
    shapely.prepare(whole)
    return whole


def _inward(points: Array) -> Array:
    """Unit normals (N, 2) of a closed line (N, 2) to its right; offsets run clockwise round what they fill."""
    step = np.diff(points, axis=0, prepend=points[-2:-1], append=points[1:2])
    step /= np.maximum(np.linalg.norm(step, axis=1), 1e-9)[:, None]
    along = step[:-1] + step[1:]
    along /= np.maximum(np.linalg.norm(along, axis=1), 1e-9)[:, None]
    return np.stack([along[:, 1], -along[:, 0]], axis=1)


def _calm(values: Array, where: Array) -> Array:
    """Values (N, D) along a closed line, smoothed where `where` (N,) is 1."""
    values, weight = values[:-1], where[:-1, None] / 4
    for _ in range(CALM):
        round_ = np.concatenate([values[-1:], values, values[:1]])
        values = values + weight * (round_[:-2] - 2 * values + round_[2:])
    return np.concatenate([values, values[:1]])


def denser(ring: Bead, near: NDArray[np.object_], spacing: float) -> Bead:
    """The same line with points close together where it passes gaps."""
    along = ring.along
    extra = np.linspace(0, along[-1], int(along[-1] / (DENSE * spacing)) + 2)[1:-1]
    at = ring.at(extra)
    left, low, right, high = shapely.bounds(near).T[..., None]  # (G, 1) each
    (x, y, _), reach = at.T, BESIDE * spacing
    across, upwards = (x > left - reach) & (x < right + reach), (y > low - reach) & (y < high + reach)
    beside = (across & upwards).any(axis=0)
    every = np.unique(np.concatenate([along, extra[beside]]))
    return Bead(
        np.stack([np.interp(every, along, v) for v in ring.points.T], axis=1), np.interp(every, along, ring.width)
    )
