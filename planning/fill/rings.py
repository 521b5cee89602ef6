"""Closed lines parallel to the contour, level by level, as wide as the place between their neighbours.

After Kuipers et al. 2020: where the thickness left is no multiple of the spacing, two neighbours share it, wider or
narrower than nominal, or one bead along the medial axis takes it. The line outside a corner widens into what is
left open there.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import shapely
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from shapely.geometry.base import BaseGeometry

from planning.fill.axis import Axis, axis_of
from planning.fill.bead import Bead, even
from planning.fill.coverage import covered_by
from planning.fill.fit import Fit
from planning.fill.gap_fill import widened
from planning.fill.region import Region, joined, minus, points_of
from planning.fill.strokes import strokes

SAMPLED = 0.25  # spacings from point to point of the boundary whose medial axis is sought
ROUND = 0.15  # spacings: radius of corners, so that none stops the nozzle
DOT = 0.05  # spacings to either side of a dot's middle: the nozzle hardly moves
OUTERMOST = 0.05  # the same at the contour, where no line outside widens into them
SLIVER = 0.02  # spacings squared: a smaller loop is a dot
FINE = 0.003  # spacings: to which lines are simplified; offsets of offsets double their points each time
FACING = 0.15  # spacings: a line's point nearer to or farther from a disc's rim faces another disc
HAIR = 0.01  # spacings: a narrower opening between two lines is none
LOST = 0.003  # of the area: what the corners of the outermost line may lose before it is made narrower
ARC = 8  # edges of a quarter circle: off by a thousandth of a bead at most, less than FINE
SMALLEST = 0.04  # spacings squared: of a gap worth filling, as in a corner of 110 degrees


@dataclass(frozen=True, slots=True, eq=False)
class Level:
    """One level: closed lines, and the single beads that fill what is too narrow for two."""

    rings: list[Bead]
    single: list[Bead]


def ring_levels(region: Region, lost: float, fit: Fit, most: int | None = None) -> tuple[list[Level], Region]:
    """Levels of closed lines from the contour inwards, at most so many, and the region that they leave.

    lost: the region's roughness for one spacing.
    """
    fit = _following(lost, fit)
    axis = axis_of(region, SAMPLED * fit.spacing)
    thin = strokes(axis, shapely.boundary(region), fit, most)
    levels: list[Level] = []
    left = region
    while not left.is_empty and (most is None or len(levels) < most):
        here = fit.at(len(levels))
        spacing = here.spacing
        own = [bead for k, bead in thin if k == len(levels)]
        middle = _middle(left, own, here, (ROUND if levels else OUTERMOST) * spacing)
        gaps = _gaps(left, middle, own, spacing)
        own += dots(gaps, here)
        if levels and len(gaps):
            outer = levels[-1]
            before = fit.at(len(levels) - 1)
            levels[-1] = Level([widened(ring, gaps, before) for ring in outer.rings], outer.single)
        between = _between(axis, float(fit.outside(len(levels))), here)
        rings = shapely.get_rings(shapely.get_parts(_simple(middle, spacing)))
        levels.append(Level([_shared(ring, between, here) for ring in rings], own))
        left = _simple(shapely.buffer(left, -spacing, quad_segs=ARC), spacing)
    return levels, left


def _following(lost: float, fit: Fit) -> Fit:
    """The fit whose outermost line is so narrow that it follows a contour in whose corners so much is lost."""
    share = math.sqrt(LOST / max(lost, LOST))  # what rounded corners lose grows with the square of their radius
    return replace(fit, outermost=max(share * fit.spacing, 2 * fit.one))


def _simple(region: Region, spacing: float) -> Region:
    """Without points that offsets of offsets double each time."""
    return shapely.simplify(region, FINE * spacing, preserve_topology=False)


def _middle(left: Region, single: list[Bead], fit: Fit, radius: float) -> Region:
    """What lies inside the middle lines of the next level, corners rounded; tongues for single beads are cut off."""
    spacing = fit.spacing
    middle = shapely.buffer(shapely.buffer(left, -spacing / 2 - radius, quad_segs=ARC), radius, quad_segs=4)
    if single:
        lean = max(fit.two - spacing / 2, radius)
        wide = shapely.buffer(
            shapely.buffer(middle, -lean, quad_segs=ARC), lean + HAIR * spacing, quad_segs=ARC
        )  # not edge upon edge: that is slow
        rest = shapely.get_parts(minus(middle, wide))
        lines = shapely.multilinestrings([shapely.linestrings(bead.points) for bead in single])
        shapely.prepare(lines)
        middle = minus(middle, joined(rest[shapely.intersects(lines, rest)]))
        middle = shapely.buffer(shapely.buffer(middle, -radius, quad_segs=4), radius, quad_segs=4)
    parts = shapely.get_parts(middle)
    return shapely.multipolygons(parts[shapely.area(parts) > SLIVER * spacing**2])


def _gaps(left: Region, middle: Region, single: list[Bead], spacing: float) -> NDArray[np.object_]:
    """What a level leaves open between the line outside it and its own."""
    reached = shapely.buffer(middle, (0.5 + HAIR) * spacing, quad_segs=4)
    beyond = HAIR * spacing * reached.length  # by so much its area is larger than the beads' own (Steiner's formula)
    if left.area - reached.area + beyond < SMALLEST * spacing**2:
        return np.empty(0, object)
    gaps = _large(minus(left, reached), spacing)
    if not single or not len(gaps):
        return gaps
    lines = np.array([shapely.linestrings(bead.points) for bead in single], dtype=object)
    reach = np.array([bead.width.max() / 2 for bead in single])
    far = shapely.distance(lines[:, None], gaps[None])  # to gaps (S, G)
    own = [bead for bead, near in zip(single, far.min(axis=1) < reach, strict=True) if near]
    return _large(minus(shapely.multipolygons(gaps), covered_by(own, ARC)), spacing) if own else gaps


def _large(gaps: BaseGeometry, spacing: float) -> NDArray[np.object_]:
    """The parts of gaps that are worth filling."""
    parts = shapely.get_parts(gaps)
    return np.asarray(parts[shapely.area(parts) > SMALLEST * spacing**2])


def dots(gaps: NDArray[np.object_], fit: Fit) -> list[Bead]:
    """A short bead in the middle of each gap that is wide enough for one."""
    large = gaps[shapely.area(gaps) > np.pi * fit.one**2]
    dots = []
    for circle in [shapely.maximum_inscribed_circle(gap, 0.1 * fit.one) for gap in large]:
        middle, rim = shapely.get_coordinates(circle)
        radius = math.dist(middle, rim)
        if radius >= fit.one:
            half = np.array([DOT * fit.spacing, 0.0])
            dots.append(even(np.stack([middle - half, middle + half]), min(2 * radius, fit.most)))
    return dots


def _between(axis: Axis, outside: float, fit: Fit) -> Axis:
    """The part of an axis that only two lines of a level pass, one on each side; radii less what is outside them."""
    radii = axis.radii - outside
    two = (radii >= fit.two) & (radii < fit.three)
    return Axis(axis.middles[two], radii[two], axis.edges[:0])


def _shared(ring: BaseGeometry, between: Axis, fit: Fit) -> Bead:
    """A closed line, moved and widened where only two fit between the lines outside it."""
    spacing = fit.spacing
    points = points_of(shapely.segmentize(ring, spacing))
    if not len(between.radii):
        return even(points, spacing)
    far, near = cKDTree(between.middles).query(points, distance_upper_bound=0.8 * spacing)
    near[np.isinf(far)] = 0
    beside = np.abs(far + spacing / 2 - between.radii[near]) < FACING * spacing
    if not beside.any():
        return even(points, spacing)
    more = np.where(beside, np.minimum(between.radii[near], fit.most) - spacing, 0.0)
    way = (between.middles[near] - points) / np.maximum(far, 1e-9)[:, None]
    points = points + way * (more / 2)[:, None]
    points[-1], more[-1] = points[0], more[0]
    return Bead(points, spacing + more)
