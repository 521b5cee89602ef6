"""Fill a region with beads, in printing order."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import shapely

from estimation.se3 import Array
from planning.fill.bead import Bead
from planning.fill.ease import eased
from planning.fill.order import Run, ordered
from planning.fill.pace import Pace, spent
from planning.fill.pattern import Pattern
from planning.fill.region import Region, checked
from planning.fill.rings import Level, ring_levels
from planning.fill.spiral import nests, wound
from planning.fill.zigzag import raster_beads, zigzag_beads

CORNER = 0.12  # spacings by which corners are cut: less than a bead's own rounding

Lines = Callable[[Region, float, float, float], list[Bead]]


def fill(region: Region, pattern: Pattern, pace: Pace) -> list[Bead]:
    """Beads that fill a region, mm, in printing order; none where it is empty. InputError where contours cross."""
    region = shapely.buffer(checked(region), -pattern.inset)
    if region.is_empty:
        return []
    corner = _corner(region, pattern)
    if pattern.kind in ("zigzag", "raster"):
        return _lines(region, pattern, pace)
    if pattern.kind == "hybrid":
        levels, core = _levels(region, pattern, pattern.rims)
        return ordered(_runs(levels, pattern, joined=True), corner) + _lines(core, pattern, pace)
    levels, _ = _levels(region, pattern)
    ways = {"contour": (False,), "spiral": (True,)}.get(pattern.kind, (True, False))
    found = [ordered(_runs(levels, pattern, joined), corner) for joined in ways]
    return min(found, key=lambda beads: spent(beads, pace).seconds)


def _corner(region: Region, pattern: Pattern) -> Array:
    """The corner (2,) of the box around a region that printing begins nearest to."""
    low, high = np.array(region.bounds).reshape(2, 2)
    return np.where(np.array(pattern.start) > 0, high, low)


def _levels(region: Region, pattern: Pattern, most: int | None = None) -> tuple[list[Level], Region]:
    return ring_levels(shapely.buffer(region, (pattern.spacing - pattern.width) / 2), pattern.spacing, most)


def _runs(levels: list[Level], pattern: Pattern, joined: bool) -> list[Run]:
    start, s = np.array(pattern.start), pattern.spacing
    rings = [level.rings for level in levels]
    runs = [wound(nest, s, start, pattern.seam, joined) for nest in nests(rings, s)]
    runs += [[bead] for level in levels for bead in level.single]
    return [[_laid(bead, pattern) for bead in run] for run in runs]


def _laid(bead: Bead, pattern: Pattern) -> Bead:
    """A bead as wide as the overlap makes it, its corners eased."""
    return eased(Bead(bead.points, bead.width / (1 - pattern.overlap)), CORNER * pattern.spacing)


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
