"""Fill a region with beads, in printing order."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import shapely

from estimation.se3 import Array
from planning.fill.bead import Bead, even
from planning.fill.coverage import covered_by
from planning.fill.ease import eased
from planning.fill.fit import fit_of
from planning.fill.mend import mended
from planning.fill.order import Run, ordered
from planning.fill.pace import Pace, hops, spent
from planning.fill.pattern import Pattern
from planning.fill.region import Region, checked, roughness
from planning.fill.rings import Level, ring_levels
from planning.fill.scan import Boundary, boundary_of
from planning.fill.spiral import apart, nests, wound
from planning.fill.zigzag import raster_lines, zigzag_lines

INTO_RIM = 0.1  # spacings by which lines run into the rim of hybrid, whose round ends leave gaps else
CORNER = 0.05  # spacings by which corners are cut: what that leaves open is less than a hundredth of a bead
ROUGH = 0.001  # of the area, lost in corners of the contour: below, gaps come to half a percent at most
TWICE = 5  # mm2 laid twice are as bad as one left open, as the limits of both are: 5 and 1 % of a wound
AS_GOOD = 0.001  # of what is covered: less is no difference
LINED = ("zigzag", "raster", "hybrid")  # patterns with straight lines, whose angle matters
NOTHING = shapely.MultiPolygon()

Lines = Callable[[Boundary, float, float], tuple[list[Array], float]]


def fill(region: Region, pattern: Pattern, pace: Pace) -> list[Bead]:
    """Beads that fill a region, mm, in printing order; none where it is empty. InputError where contours cross."""
    rim, core = _rim(_within(region, pattern), pattern, pace)
    return rim + _lines(core, pattern, pace)


def turned(region: Region, pattern: Pattern, pace: Pace) -> Pattern:
    """The pattern with the angle of its lines settled, by which the region is filled fastest or the way is shortest."""
    if pattern.kind not in LINED:
        return pattern
    rim, core = _rim(_within(region, pattern), pattern, pace)
    tried = [replace(pattern, angle=angle) for angle in _angles(pattern)]
    costs = [spent(rim + _lines(core, one, pace), pace) for one in tried]
    shorter = pattern.angle == "shorter"
    return tried[int(np.argmin([c.printed + c.travelled if shorter else c.seconds for c in costs]))]


def _within(region: Region, pattern: Pattern) -> Region:
    """The part of a region that is filled."""
    region = checked(region)
    return shapely.buffer(region, -pattern.inset) if pattern.inset else region


def _rim(region: Region, pattern: Pattern, pace: Pace) -> tuple[list[Bead], Region]:
    """Beads along the contour, in printing order, and the region that they leave for lines."""
    if region.is_empty or pattern.kind in ("zigzag", "raster"):
        return [], region
    hybrid = pattern.kind == "hybrid"
    lost = roughness(region, pattern.spacing)
    levels, core = _levels(region, lost, pattern, pattern.rims if hybrid else None)
    runs, corner = _runs(levels, lost, pattern, pace), _corner(region, pattern)
    if not hybrid:
        return ordered(_mended(runs, region, lost, pattern), corner), NOTHING
    return ordered(runs, corner), shapely.buffer(core, INTO_RIM * pattern.spacing)


def _corner(region: Region, pattern: Pattern) -> Array:
    """The corner (2,) of the box around a region that printing begins nearest to."""
    left, low, right, high = region.bounds
    x, y = pattern.start
    return np.array([right if x > 0 else left, high if y > 0 else low])


def _mended(runs: list[Run], region: Region, lost: float, pattern: Pattern) -> list[Run]:
    """Runs without gaps between them where the region is rough or narrow; elsewhere it would be lost time."""
    if lost < ROUGH:
        return runs
    better = mended(runs, region, fit_of(pattern))
    return [[eased(bead, CORNER * pattern.spacing) for bead in run] for run in better]


def _levels(region: Region, lost: float, pattern: Pattern, most: int | None = None) -> tuple[list[Level], Region]:
    reached = shapely.buffer(region, (pattern.spacing - pattern.width) / 2) if pattern.overlap else region
    return ring_levels(reached, lost, fit_of(pattern), most)


def _runs(levels: list[Level], lost: float, pattern: Pattern, pace: Pace) -> list[Run]:
    nested = nests([level.rings for level in levels], pattern.spacing)
    runs = [_nest_run(nest, lost, pattern, pace) for nest in nested]
    return runs + [[_laid(bead, pattern)] for level in levels for bead in level.single]


def _nest_run(nest: list[Bead], lost: float, pattern: Pattern, pace: Pace) -> Run:
    """A nest's lines one by one, or joined: as the pattern says, or whichever is faster and fills as well."""
    start = np.array(pattern.start)
    if pattern.kind != "spiral":
        closed = [_laid(bead, pattern) for bead in apart(nest, start, pattern.seam)]
        if pattern.kind == "contour":
            return closed
    joined = [_laid(bead, pattern) for bead in wound(nest, pattern.spacing, start, pattern.seam)]
    if pattern.kind == "spiral":
        return joined
    slower = spent(joined, pace).seconds >= spent(closed, pace).seconds
    return closed if slower or (lost >= ROUGH and _worse(joined, closed)) else joined


def _worse(joined: Run, closed: Run) -> bool:
    """Whether a spiral fills worse than the closed lines that it joins: where these lie unevenly, ramps between them
    leave open or lay twice what they do not, more or less as the spiral happens to begin."""
    covered = [covered_by(run).area for run in (joined, closed)]
    twice = [sum(bead.laid for bead in run) - area for run, area in zip((joined, closed), covered, strict=True)]
    return bool(covered[1] - covered[0] + (twice[0] - twice[1]) / TWICE > AS_GOOD * covered[1])


def _laid(bead: Bead, pattern: Pattern) -> Bead:
    """A bead as wide as the overlap makes it, its corners eased."""
    return eased(Bead(bead.points, bead.width / (1 - pattern.overlap)), CORNER * pattern.spacing)


def _lines(region: Region, pattern: Pattern, pace: Pace) -> list[Bead]:
    """The shortest or fastest way to fill a region with parallel lines, begun on the side of the pattern's start."""
    lay: Lines = raster_lines if pattern.kind == "raster" else zigzag_lines
    middle = shapely.buffer(region, -pattern.width / 2)
    if middle.is_empty:
        return []
    corner, boundary = _corner(region, pattern), boundary_of(middle)
    found = [_placed(lay(boundary, angle, pattern.spacing), pattern, corner) for angle in _angles(pattern)]
    if pattern.angle == "shorter":  # the printed line and the way between its parts, thesis 5.3
        return [_cut(b, pattern) for b in min(found, key=lambda way: sum(bead.length for bead in way) + hops(way))]
    return min(([_cut(bead, pattern) for bead in way] for way in found), key=lambda way: spent(way, pace).seconds)


def _placed(laid: tuple[list[Array], float], pattern: Pattern, corner: Array) -> list[Bead]:
    """Lines as beads of one width, in printing order."""
    lines, step = laid
    width = min(pattern.width, step / (1 - pattern.overlap))
    beads = [even(line, width) for line in lines]
    if pattern.kind == "raster":
        first, last = (min(math.dist(end, corner) for end in bead.points[[0, -1]]) for bead in (beads[0], beads[-1]))
        return beads if first <= last else beads[::-1]
    return ordered([[bead] for bead in beads], corner)


def _cut(bead: Bead, pattern: Pattern) -> Bead:
    return eased(bead, CORNER * pattern.spacing)


def _angles(pattern: Pattern) -> list[float]:
    if pattern.angle == "shorter":
        return [0.0, np.pi / 2]
    if pattern.angle == "fastest":
        return [np.pi * k / pattern.angles for k in range(pattern.angles)]
    return [float(pattern.angle)]
