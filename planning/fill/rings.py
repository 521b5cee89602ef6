"""Closed lines parallel to the contour, level by level, as wide as the place between their neighbours.

After Kuipers et al. 2020: where the thickness left is no multiple of the spacing, two neighbours share it, wider or
narrower than nominal, or one bead along the medial axis takes it. The line outside a corner widens into what is
left open there.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import shapely
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from shapely.geometry.base import BaseGeometry

from estimation.se3 import Array
from planning.fill.axis import Axis, axis_of
from planning.fill.bead import Bead, even
from planning.fill.coverage import covered_by
from planning.fill.region import Region, minus, points_of
from planning.fill.strokes import ONE, TWO, strokes

SAMPLED = 0.25  # spacings from point to point of the boundary whose medial axis is sought
ROUND = 0.15  # spacings: radius of corners, so that none stops the nozzle
SLIVER = 0.02  # spacings squared: a smaller loop is a dot
FINE = 0.003  # spacings: to which lines are simplified; offsets of offsets double their points each time
FACING = 0.15  # spacings: a line's point nearer to or farther from a disc's rim faces another disc
SMALLEST = 0.04  # spacings squared: of a gap worth filling, as in a corner of 110 degrees
CALM = 3  # roundings

DEEPEST = 0.5  # spacings by which a line widens into a corner
SOUNDINGS = 8  # places across that depth at which it is asked whether a corner lies open


@dataclass(frozen=True, slots=True, eq=False)
class Level:
    """One level: closed lines, and the single beads that fill what is too narrow for two."""

    rings: list[Bead]
    single: list[Bead]


def ring_levels(region: Region, spacing: float, most: int | None = None) -> tuple[list[Level], Region]:
    """Levels of closed lines from the contour inwards, at most so many, and the region that they leave."""
    axis = axis_of(region, SAMPLED * spacing)
    thin = strokes(axis, shapely.boundary(region), spacing, most)
    levels: list[Level] = []
    left = region
    while not left.is_empty and (most is None or len(levels) < most):
        own = [bead for k, bead in thin if k == len(levels)]
        middle = _middle(left, own, spacing)
        gaps = _gaps(left, middle, own, spacing)
        own += _dots(gaps, spacing)
        if levels and len(gaps):
            outer = levels[-1]
            levels[-1] = Level([_into(ring, gaps, spacing) for ring in outer.rings], outer.single)
        between = _between(axis, len(levels), spacing)
        rings = shapely.get_rings(shapely.get_parts(_simple(middle, spacing)))
        levels.append(Level([_shared(ring, between, spacing) for ring in rings], own))
        left = _simple(shapely.buffer(left, -spacing), spacing)
    return levels, left


def _simple(region: Region, spacing: float) -> Region:
    """Without points that offsets of offsets double each time."""
    return shapely.simplify(region, FINE * spacing, preserve_topology=False)


def _middle(left: Region, single: list[Bead], spacing: float) -> Region:
    """What lies inside the middle lines of the next level; tongues that single beads fill are cut off."""
    middle = shapely.buffer(shapely.buffer(left, -(0.5 + ROUND) * spacing), ROUND * spacing, quad_segs=4)
    if single:
        lean = (TWO - 0.5) * spacing
        rest = shapely.get_parts(minus(middle, shapely.buffer(shapely.buffer(middle, -lean), lean)))
        lines = shapely.multilinestrings([shapely.linestrings(bead.points) for bead in single])
        middle = minus(middle, shapely.union_all(rest[shapely.intersects(rest, lines)]))
        middle = shapely.buffer(shapely.buffer(middle, -ROUND * spacing), ROUND * spacing, quad_segs=4)
    parts = shapely.get_parts(middle)
    return shapely.multipolygons(parts[shapely.area(parts) > SLIVER * spacing**2])


def _gaps(left: Region, middle: Region, single: list[Bead], spacing: float) -> NDArray[np.object_]:
    """What a level leaves open between the line outside it and its own."""
    reached = shapely.buffer(middle, 0.51 * spacing, quad_segs=4)
    if left.area - reached.area < SMALLEST * spacing**2:
        return np.empty(0, object)
    gaps = minus(left, reached)
    gaps = shapely.get_parts(minus(gaps, covered_by(single)) if single else gaps)
    return np.asarray(gaps[shapely.area(gaps) > SMALLEST * spacing**2])


def _dots(gaps: NDArray[np.object_], spacing: float) -> list[Bead]:
    """A short bead in the middle of each gap that is wide enough for one."""
    large = gaps[shapely.area(gaps) > 0.2 * spacing**2]
    circles = [shapely.maximum_inscribed_circle(gap, 0.02 * spacing) for gap in large]
    dots = []
    for circle in circles:
        (x, y), edge = shapely.get_coordinates(circle)
        r = float(np.hypot(x - edge[0], y - edge[1]))
        if r >= ONE * spacing:
            dots.append(Bead(np.array([[x - 0.05 * spacing, y], [x + 0.05 * spacing, y]]), np.full(2, 2 * r)))
    return dots


def _between(axis: Axis, level: int, spacing: float) -> Axis:
    """The part of an axis that only two lines of a level pass, one on each side; radii less what is outside them."""
    radii = axis.radii - level * spacing
    two = (radii >= TWO * spacing) & (radii < (1 + ONE) * spacing)
    return Axis(axis.middles[two], radii[two], axis.edges[:0])


def _shared(ring: BaseGeometry, between: Axis, spacing: float) -> Bead:
    """A closed line, moved and widened where only two fit between the lines outside it."""
    points = points_of(shapely.segmentize(ring, spacing))
    if not len(between.radii):
        return even(points, spacing)
    far, near = cKDTree(between.middles).query(points, distance_upper_bound=0.8 * spacing)
    near[np.isinf(far)] = 0
    beside = np.abs(far + spacing / 2 - between.radii[near]) < FACING * spacing
    if not beside.any():
        return even(points, spacing)
    more = np.where(beside, between.radii[near] - spacing, 0.0)
    way = (between.middles[near] - points) / np.maximum(far, 1e-9)[:, None]
    points = points + way * (more / 2)[:, None]
    points[-1], more[-1] = points[0], more[0]
    return Bead(points, spacing + more)


def _into(ring: Bead, gaps: NDArray[np.object_], spacing: float) -> Bead:
    """A closed line widened inwards, over what the next level leaves open."""
    near = gaps[shapely.dwithin(gaps, shapely.linestrings(ring.points), 0.6 * spacing)]
    if not len(near):
        return ring
    ring = _denser(ring, near, spacing)
    inward = _inward(ring.points)
    depths = (np.arange(SOUNDINGS) + 0.5) * DEEPEST * spacing / SOUNDINGS
    sounded = ring.points[:, None] + inward[:, None] * (ring.width[:, None] / 2 + depths)[..., None]  # (N, S, 2)
    open_there = shapely.contains_xy(_prepared(near), sounded[..., 0], sounded[..., 1])
    more: Array = open_there.sum(axis=1) * (DEEPEST * spacing / SOUNDINGS)
    more[np.abs(ring.width - spacing) > 1e-9] = 0.0
    more = _calm(more[:, None], np.ones(len(more)))[:, 0]
    points = _calm(ring.points + inward * (more / 2)[:, None], np.asarray(more > 0.01 * spacing, float))
    line = shapely.simplify(shapely.linestrings(np.column_stack([points, ring.width + more])), 0.01 * spacing)
    lines = shapely.get_coordinates(line, include_z=True)
    return Bead(lines[:, :2], lines[:, 2])


def _prepared(shapes: NDArray[np.object_]) -> BaseGeometry:
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
        values = values + weight * (np.roll(values, 1, axis=0) - 2 * values + np.roll(values, -1, axis=0))
    return np.concatenate([values, values[:1]])


def _denser(ring: Bead, near: NDArray[np.object_], spacing: float) -> Bead:
    """The same line with points close together where it passes gaps."""
    along = ring.along
    extra = np.linspace(0, along[-1], int(along[-1] / (0.15 * spacing)) + 2)[1:-1]
    at = ring.at(extra)
    low, high = np.moveaxis(shapely.bounds(near).reshape(-1, 2, 2), 1, 0)  # (G, 2) each
    reach = 0.8 * spacing
    beside = ((at[:, None, :2] > low - reach) & (at[:, None, :2] < high + reach)).all(axis=2).any(axis=1)
    every = np.unique(np.concatenate([along, extra[beside]]))
    return Bead(
        np.stack([np.interp(every, along, v) for v in ring.points.T], axis=1), np.interp(every, along, ring.width)
    )
