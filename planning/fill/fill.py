"""Fill a region with beads, in printing order."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import shapely

from planning.fill.bead import Bead
from planning.fill.pace import Pace, spent
from planning.fill.pattern import Pattern
from planning.fill.region import Region, checked
from planning.fill.rings import ring_beads
from planning.fill.zigzag import raster_beads, zigzag_beads

Lines = Callable[[Region, float, float, float], list[Bead]]


def fill(region: Region, pattern: Pattern, pace: Pace) -> list[Bead]:
    """Beads that fill a region, mm, in printing order; none where it is empty. InputError where contours cross."""
    region = shapely.buffer(checked(region), -pattern.inset)
    if region.is_empty:
        return []
    if pattern.kind in ("zigzag", "raster"):
        return _lines(region, pattern, pace)
    if pattern.kind == "hybrid":
        beads, core = ring_beads(region, pattern, pattern.rims)
        return beads + _lines(core, pattern, pace)
    return ring_beads(region, pattern)[0]


def _lines(region: Region, pattern: Pattern, pace: Pace) -> list[Bead]:
    lay: Lines = raster_beads if pattern.kind == "raster" else zigzag_beads
    middle = shapely.buffer(region, -pattern.width / 2)
    found = [lay(middle, angle, pattern.spacing, pattern.overlap) for angle in _angles(pattern)]
    if pattern.angle == "shorter":
        return min(found, key=lambda beads: spent(beads, pace).printed + spent(beads, pace).travelled)
    return min(found, key=lambda beads: spent(beads, pace).seconds)


def _angles(pattern: Pattern) -> list[float]:
    if pattern.angle == "shorter":
        return [0.0, np.pi / 2]
    if pattern.angle == "fastest":
        return [np.pi * k / pattern.angles for k in range(pattern.angles)]
    return [float(pattern.angle)]
