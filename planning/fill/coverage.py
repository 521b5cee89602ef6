"""How much of a region beads cover, how much twice, how much beside it, and what is left open."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import shapely
from shapely.geometry import MultiPolygon
from shapely.geometry.base import BaseGeometry

from planning.fill.bead import Bead
from planning.fill.region import Region, only_areas


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
    inside = shapely.intersection(union, region).area
    laid = sum(bead.laid for bead in beads)
    gaps = only_areas(shapely.difference(region, union))
    area = region.area
    return Coverage(inside / area, (union.area - inside) / area, (laid - union.area) / area, gaps)


def covered_by(beads: Sequence[Bead]) -> BaseGeometry:
    """The area that beads cover."""
    return shapely.union_all([footprint(bead) for bead in beads])


def footprint(bead: Bead) -> BaseGeometry:
    """The area that one bead covers."""
    if np.ptp(bead.width) < 1e-9:
        return shapely.buffer(shapely.linestrings(bead.points), bead.width[0] / 2)
    step = np.diff(bead.points, axis=0)
    side = np.stack([-step[:, 1], step[:, 0]], axis=1) / np.maximum(bead.steps, 1e-12)[:, None] / 2
    a, b = side * bead.width[:-1, None], side * bead.width[1:, None]
    corners = np.stack([bead.points[:-1] + a, bead.points[:-1] - a, bead.points[1:] - b, bead.points[1:] + b], axis=1)
    discs = shapely.buffer(shapely.points(bead.points), bead.width / 2)
    return shapely.union_all(np.concatenate([shapely.polygons(corners), discs]))
