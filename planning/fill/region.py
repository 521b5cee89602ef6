"""Regions of the plane: read from contours and checked, and how far beads cover them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import TypeAlias

import numpy as np
import shapely
from shapely.geometry import MultiPolygon, Polygon
from shapely.geometry.base import BaseGeometry

from estimation.errors import InputError
from estimation.se3 import Array
from planning.fill.bead import Bead

ROUNDING_GRID = 1e-6  # mm to which corners are rounded where exact arithmetic finds no answer

Region: TypeAlias = Polygon | MultiPolygon

# steps buffered at once: of a long spiral, which touches itself all along, GEOS makes invalid areas
MAX_BUFFERED_STEPS = 32


def region_of(contour: Array, where: object = "contour") -> Polygon:
    """The region inside a contour (N, 2), mm; InputError says where it crosses itself."""
    if contour.ndim != 2 or contour.shape[1] != 2 or len(contour) < 3:
        raise InputError(where, "shape", contour.shape, "(N, 2) with N >= 3")
    if not np.isfinite(contour).all():
        raise InputError(where, "point", contour[~np.isfinite(contour).all(axis=1)][0], "finite numbers")
    region = Polygon(contour)
    check_region(region, where)
    return region


def check_region(region: Region, where: object = "region") -> Region:
    """The region itself if its contours cross neither themselves nor one another; InputError says where they do."""
    if not isinstance(region, Polygon | MultiPolygon):
        raise InputError(where, "kind", type(region).__name__, "Polygon or MultiPolygon")
    if not np.isfinite(shapely.get_coordinates(region)).all():
        raise InputError(where, "points", "not finite", "finite numbers")
    if not region.is_valid:
        raise InputError(where, "contour", shapely.is_valid_reason(region), "contours that do not cross, x y in mm")
    return region


def without_bumps(region: Region, bumps: Region, clearance: float) -> Region:
    """The region without bumps that are too high to go over, and without `clearance` mm around them (thesis 5.2)."""
    return only_areas(shapely.difference(region, shapely.buffer(bumps, clearance)))


def roughness(region: Region, width: float) -> float:
    """Share of the area that a disc `width` mm wide does not reach: corners, and what is narrower."""
    radius = width / 2
    return 1 - float(shapely.buffer(shapely.buffer(region, -radius), radius).area / region.area)


def only_areas(shape: BaseGeometry) -> Region:
    """The areas of whatever a shapely operation returned; lines and points have none."""
    return MultiPolygon(areas(shape))


def areas(shape: BaseGeometry) -> list[Polygon]:
    """The non-empty polygons of a shape, one by one."""
    parts = shapely.get_parts(shapely.get_parts(shape))
    return [part for part in parts if isinstance(part, Polygon) and not part.is_empty]


def difference(a: BaseGeometry, b: BaseGeometry) -> BaseGeometry:
    """What lies in a and not in b, also where simplified outlines cross themselves by a micrometre."""
    try:
        return shapely.difference(a, b)
    except shapely.GEOSException:
        return shapely.difference(shapely.buffer(a, 0), shapely.buffer(b, 0), grid_size=ROUNDING_GRID)


def union_of(shapes: Sequence[BaseGeometry]) -> BaseGeometry:
    """What lies in any of the shapes, also where exact arithmetic finds no answer."""
    try:
        return shapely.union_all(shapes)
    except shapely.GEOSException:
        return shapely.union_all(shapely.buffer(shapes, 0), grid_size=ROUNDING_GRID)


@dataclass(frozen=True, slots=True, eq=False)
class FillCoverage:
    """How beads cover a region, as shares of its area."""

    covered: float  # by the union of the beads
    over: float  # of the union, outside the region
    double: float  # material (length times width) beyond the union
    gaps: MultiPolygon  # what stays open


def fill_coverage(beads: Sequence[Bead], region: Region) -> FillCoverage:
    """Coverage of a region by beads, each point of them a disc of the local width, as dispensed by a round nozzle."""
    if region.area == 0:
        return FillCoverage(1.0, 0.0, 0.0, MultiPolygon())
    union = covered_area(beads)
    material = sum(bead.area for bead in beads)
    gaps = only_areas(difference(region, union))
    over, area = difference(union, region).area, region.area
    return FillCoverage((union.area - over) / area, over / area, (material - union.area) / area, gaps)


def covered_area(beads: Sequence[Bead], arc: int = 16) -> BaseGeometry:
    """The area that beads cover. arc: edges that each quarter of a disc is drawn with."""
    return union_of([shape for bead in beads for shape in _shapes(bead, arc)])


def _shapes(bead: Bead, arc: int) -> list[BaseGeometry]:
    """Areas that together are a bead's: stretches of one width as a whole, and each step on which the width changes."""
    change = np.abs(np.diff(bead.width)) > 1e-9
    ends = np.concatenate([[0], np.flatnonzero(np.diff(change)) + 1, [len(change)]])
    shapes: list[BaseGeometry] = []
    for a, b in pairwise(ends.tolist()):
        if change[a]:
            shapes += _tapered(bead.points[a : b + 1], bead.width[a : b + 1], arc)
        else:
            cuts = [*range(a, b, MAX_BUFFERED_STEPS), b]
            lines = [shapely.linestrings(bead.points[i : j + 1]) for i, j in pairwise(cuts)]
            shapes += shapely.buffer(lines, bead.width[a] / 2, quad_segs=arc).tolist()
    return shapes


def _tapered(points: Array, width: Array, arc: int) -> list[BaseGeometry]:
    step = np.diff(points, axis=0)
    side = np.stack([-step[:, 1], step[:, 0]], axis=1)
    side /= 2 * np.maximum(np.linalg.norm(step, axis=1), 1e-12)[:, None]
    a, b = side * width[:-1, None], side * width[1:, None]
    corners = np.stack([points[:-1] + a, points[:-1] - a, points[1:] - b, points[1:] + b], axis=1)
    return [*shapely.polygons(corners), *shapely.buffer(shapely.points(points), width / 2, quad_segs=arc)]
