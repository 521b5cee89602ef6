"""Closed lines parallel to the contour."""

from __future__ import annotations

import shapely

from planning.fill.bead import Bead, even
from planning.fill.pattern import Pattern
from planning.fill.region import Region, areas, points_of


def ring_beads(region: Region, pattern: Pattern, most: int | None = None) -> tuple[list[Bead], Region]:
    """Closed beads from the contour inwards, at most so many levels, and the region that they leave."""
    beads: list[Bead] = []
    left, level = region, 0
    while not left.is_empty and (most is None or level < most):
        middle = shapely.buffer(left, -pattern.width / 2)
        for part in areas(middle):
            beads += [even(points_of(ring), pattern.width) for ring in (part.exterior, *part.interiors)]
        left, level = shapely.buffer(left, -pattern.spacing), level + 1
    return beads, left
