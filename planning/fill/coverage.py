"""How much of a region beads cover, how much twice, how much beside it, and what is left open."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import shapely
from shapely.geometry import MultiPolygon
from shapely.geometry.base import BaseGeometry

from estimation.se3 import Array
from planning.fill.bead import Bead
from planning.fill.region import Region, joined, minus, only_areas

PIECE = 32  # steps buffered at once: of a long spiral, which touches itself all along, GEOS makes invalid areas


@dataclass(frozen=True, slots=True, eq=False)
class Coverage:
    """Shares of a region's area. covered: by the union of the beads. over: of the union, outside the region.

    double: material laid (length times width) beyond the union. gaps: what stays open.
    """

    covered: float
    over: float
    double: float
    gaps: MultiPolygon


def coverage(beads: Sequence[Bead], region: Region) -> Coverage:
    """Coverage of a region by beads, each point of them a disc of the local width, as dispensed by a round nozzle."""
    if region.area == 0:
        return Coverage(1.0, 0.0, 0.0, MultiPolygon())
    union = covered_by(beads)
    laid = sum(bead.laid for bead in beads)
    gaps = only_areas(minus(region, union))
    over, area = minus(union, region).area, region.area
    return Coverage((union.area - over) / area, over / area, (laid - union.area) / area, gaps)


def covered_by(beads: Sequence[Bead], arc: int = 16) -> BaseGeometry:
    """The area that beads cover. arc: edges that each quarter of a disc is drawn with."""
    return joined([shape for bead in beads for shape in _shapes(bead, arc)])


def _shapes(bead: Bead, arc: int) -> list[BaseGeometry]:
    """Areas that together are a bead's: stretches of one width as a whole, and each step on which the width changes."""
    change = np.abs(np.diff(bead.width)) > 1e-9
    ends = np.concatenate([[0], np.flatnonzero(np.diff(change)) + 1, [len(change)]])
    found: list[BaseGeometry] = []
    for a, b in pairwise(ends.tolist()):
        if change[a]:
            found += _tapered(bead.points[a : b + 1], bead.width[a : b + 1], arc)
        else:
            cuts = [*range(a, b, PIECE), b]
            lines = [shapely.linestrings(bead.points[i : j + 1]) for i, j in pairwise(cuts)]
            found += shapely.buffer(lines, bead.width[a] / 2, quad_segs=arc).tolist()
    return found


def _tapered(points: Array, width: Array, arc: int) -> list[BaseGeometry]:
    step = np.diff(points, axis=0)
    side = np.stack([-step[:, 1], step[:, 0]], axis=1)
    side /= 2 * np.maximum(np.linalg.norm(step, axis=1), 1e-12)[:, None]
    a, b = side * width[:-1, None], side * width[1:, None]
    corners = np.stack([points[:-1] + a, points[:-1] - a, points[1:] - b, points[1:] + b], axis=1)
    return [*shapely.polygons(corners), *shapely.buffer(shapely.points(points), width / 2, quad_segs=arc)]
