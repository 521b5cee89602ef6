"""Fills a region with beads in printing order, their corners cut so that the nozzle need not slow down.

Zig-zag and raster are laid here: parallel lines across a region, joined along its boundary or each for itself.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import shapely
from numpy.typing import NDArray

from estimation.se3 import Array
from planning.fill.bead import (
    SHARP_TURN,
    Bead,
    Pattern,
    PrintPace,
    Region,
    bead_fit,
    check_region,
    covered_area,
    even_bead,
    print_cost,
    roughness,
    travel_length,
    turn_angles,
)
from planning.fill.rings import ring_levels
from planning.fill.spiral import BeadRun, fill_gaps, nest_rings, order_runs, separate_rings, spiral_runs

MAX_CUTS = 4  # each halves the turns: a reversal is smooth after four
SHARP_MARGIN = 0.95  # of SHARP_TURN, so that rounding has no effect
RIM_OVERLAP = 0.1  # spacings by which lines run into the rim of hybrid; else their round ends leave gaps there
CORNER_CUT = 0.05  # spacings by which corners are cut: that leaves less than a hundredth of a bead open
RING_OVERLAP = 0.005  # of the width, of closed lines: what rounded corners and simplified offsets leave open
MIN_ROUGHNESS = 0.001  # of the area, lost in corners of the contour: below, gaps come to half a percent at most
DOUBLE_WEIGHT = 5  # mm2 laid twice that count as one left open, by the limits of both: 5 and 1 % of a wound
COVERAGE_TOLERANCE = 0.001  # of the covered area: less is no difference
LINE_PATTERNS = ("zigzag", "raster", "hybrid")  # patterns with straight lines, whose angle matters
MAX_STRETCH = 0.25  # of a line more would be laid before lines lie farther apart than asked
TANGENT_MARGIN = 1e-6  # share of the height by which the outermost lines stay off the tangent
EMPTY_REGION = shapely.MultiPolygon()


@dataclass(frozen=True, slots=True, eq=False)
class Boundary:
    """The boundary of a region, ring after ring."""

    vertices: Array  # (M, 2) mm, without repeats
    ring_start: NDArray[np.intp]  # (M,) of each vertex's ring
    ring_end: NDArray[np.intp]  # (M,) of each vertex's ring


@dataclass(frozen=True, slots=True, eq=False)
class Crossings:
    """Where scan lines cross a boundary, by line and then by x: two by two they bound a stretch inside."""

    points: Array  # (N, 2) mm, N even, in the axes of the lines
    line: NDArray[np.intp]  # (N,) number of the scan line
    edge: NDArray[np.intp]  # (N,) number of the boundary's edge
    after: NDArray[np.intp]  # (N,) crossing that follows along the boundary
    before: NDArray[np.intp]  # (N,) crossing that precedes along the boundary
    boundary: Boundary  # in the axes of the lines


Lines = Callable[[Boundary, float, float], tuple[list[Array], float]]  # (boundary, angle, spacing): lines, spacing


def fill(region: Region, pattern: Pattern, pace: PrintPace) -> list[Bead]:
    """Beads that fill a region, mm, in printing order; none where it is empty. InputError where contours cross."""
    rim, core = _rim(_inset(region, pattern), pattern, pace)
    return rim + _lines(core, pattern, pace)


def settle_angle(region: Region, pattern: Pattern, pace: PrintPace) -> Pattern:
    """The pattern with a number as angle: the one that fills the region fastest, or with the shortest way."""
    if pattern.kind not in LINE_PATTERNS:
        return pattern
    rim, core = _rim(_inset(region, pattern), pattern, pace)
    candidates = [replace(pattern, angle=angle) for angle in _angles(pattern)]
    costs = [print_cost(rim + _lines(core, candidate, pace), pace) for candidate in candidates]
    shorter = pattern.angle == "shorter"
    return candidates[int(np.argmin([c.printed + c.travelled if shorter else c.seconds for c in costs]))]


def smooth_corners(bead: Bead, reach: float) -> Bead:
    """The bead with each sharp corner cut `reach` mm before and after it, or less where its sides are short."""
    lines = np.column_stack([bead.points, bead.width])
    for _ in range(MAX_CUTS):
        sharp = (turn_angles(lines[:, :2]) > SHARP_MARGIN * SHARP_TURN).nonzero()[0] + 1
        if not len(sharp):
            break
        lines = _cut(lines, sharp, reach)
        reach /= 2
    return Bead(lines[:, :2], lines[:, 2])


def _cut(lines: Array, corner: NDArray[np.intp], reach: float) -> Array:
    """Lines (N, 3) with two points instead of each corner (C,), equally far from it so that each turns half as much."""
    tips = lines[corner]
    backward, forward = lines[corner - 1] - tips, lines[corner + 1] - tips
    backward_length, forward_length = np.hypot(backward[:, 0], backward[:, 1]), np.hypot(forward[:, 0], forward[:, 1])
    lengths = np.minimum(reach, 0.4 * np.minimum(backward_length, forward_length))
    times = np.ones(len(lines), int)
    times[corner] = 2
    doubled = np.repeat(lines, times, axis=0)
    place = corner + np.arange(len(corner))
    doubled[place] = tips + (lengths / np.maximum(backward_length, 1e-12))[:, None] * backward
    doubled[place + 1] = tips + (lengths / np.maximum(forward_length, 1e-12))[:, None] * forward
    return doubled


def _inset(region: Region, pattern: Pattern) -> Region:
    """The part of a region that is filled."""
    region = check_region(region)
    return shapely.buffer(region, -pattern.inset) if pattern.inset else region


# -- closed lines


def _rim(region: Region, pattern: Pattern, pace: PrintPace) -> tuple[list[Bead], Region]:
    """Beads along the contour, in printing order, and the region that they leave for parallel lines."""
    if region.is_empty or pattern.kind in ("zigzag", "raster"):
        return [], region
    uneven = roughness(region, pattern.spacing)
    if uneven < MIN_ROUGHNESS:  # else the gaps are filled one by one
        pattern = replace(pattern, overlap=max(pattern.overlap, RING_OVERLAP))
    hybrid, fit, spacing = pattern.kind == "hybrid", bead_fit(pattern), pattern.spacing
    reached = shapely.buffer(region, (spacing - pattern.width) / 2) if pattern.overlap else region
    levels, core = ring_levels(reached, uneven, fit, pattern.rims if hybrid else None)
    nests = nest_rings([level.rings for level in levels], spacing)
    runs = [_nest_run(nest, uneven, pattern, pace) for nest in nests]
    runs += [[_printed_bead(bead, pattern)] for level in levels for bead in level.single]
    if hybrid:
        return order_runs(runs, _corner(region, pattern), pace), shapely.buffer(core, RIM_OVERLAP * spacing)
    if uneven >= MIN_ROUGHNESS:  # gaps between beads are filled where the region is rough or narrow, else it costs time
        runs = [[_cut_corners(bead, pattern) for bead in run] for run in fill_gaps(runs, region, fit)]
    return order_runs(runs, _corner(region, pattern), pace), EMPTY_REGION


def _corner(region: Region, pattern: Pattern) -> Array:
    """The corner (2,) of the region's bounding box at which printing begins."""
    left, low, right, high = region.bounds
    x, y = pattern.start
    return np.array([right if x > 0 else left, high if y > 0 else low])


def _nest_run(nest: list[Bead], uneven: float, pattern: Pattern, pace: PrintPace) -> BeadRun:
    """A nest's lines one by one (contour) or joined (spiral), else whichever is faster and fills as well."""
    start = np.array(pattern.start)
    if pattern.kind != "spiral":
        closed = [_printed_bead(bead, pattern) for bead in separate_rings(nest, start, pattern.seam)]
        if pattern.kind == "contour":
            return closed
    joined = [_printed_bead(bead, pattern) for bead in spiral_runs(nest, pattern.spacing, start, pattern.seam)]
    if pattern.kind == "spiral":
        return joined
    slower = print_cost(joined, pace).seconds >= print_cost(closed, pace).seconds
    return closed if slower or (uneven >= MIN_ROUGHNESS and _worse(joined, closed)) else joined


def _worse(joined: BeadRun, closed: BeadRun) -> bool:
    """Whether a spiral fills worse than the closed lines that it joins.

    Where these lie unevenly, the ramps between them leave areas open or lay them twice, depending on where it begins.
    """
    covered = [covered_area(run).area for run in (joined, closed)]
    double = [sum(bead.area for bead in run) - area for run, area in zip((joined, closed), covered, strict=True)]
    return bool(covered[1] - covered[0] + (double[0] - double[1]) / DOUBLE_WEIGHT > COVERAGE_TOLERANCE * covered[1])


def _printed_bead(bead: Bead, pattern: Pattern) -> Bead:
    """A bead as wide as the overlap makes it, its corners cut."""
    return _cut_corners(Bead(bead.points, bead.width / (1 - pattern.overlap)), pattern)


def _cut_corners(bead: Bead, pattern: Pattern) -> Bead:
    return smooth_corners(bead, CORNER_CUT * pattern.spacing)


# -- parallel lines


def _lines(region: Region, pattern: Pattern, pace: PrintPace) -> list[Bead]:
    """The shortest or fastest way to fill a region with parallel lines, begun on the side of the pattern's start."""
    lay: Lines = raster_lines if pattern.kind == "raster" else zigzag_lines
    middle = shapely.buffer(region, -pattern.width / 2)
    if middle.is_empty:
        return []
    corner, boundary = _corner(region, pattern), region_boundary(middle)
    ways = [_line_beads(lay(boundary, angle, pattern.spacing), pattern, corner, pace) for angle in _angles(pattern)]
    if pattern.angle == "shorter":  # the printed line and the way between its parts, thesis 5.3
        shortest = min(ways, key=lambda way: sum(bead.length for bead in way) + travel_length(way))
        return [_cut_corners(bead, pattern) for bead in shortest]
    smooth = ([_cut_corners(bead, pattern) for bead in way] for way in ways)
    return min(smooth, key=lambda way: print_cost(way, pace).seconds)


def _line_beads(spaced: tuple[list[Array], float], pattern: Pattern, corner: Array, pace: PrintPace) -> list[Bead]:
    """Lines and their spacing as beads of one width, in printing order."""
    lines, step = spaced
    width = min(pattern.width, step / (1 - pattern.overlap))
    beads = [even_bead(line, width) for line in lines]
    if pattern.kind == "raster":
        first, last = (min(math.dist(end, corner) for end in bead.points[[0, -1]]) for bead in (beads[0], beads[-1]))
        return beads if first <= last else beads[::-1]
    return order_runs([[bead] for bead in beads], corner, pace)


def _angles(pattern: Pattern) -> list[float]:
    """The angles to try, rad."""
    if pattern.angle == "shorter":
        return [0.0, np.pi / 2]
    if pattern.angle == "fastest":
        return [np.pi * k / pattern.angles for k in range(pattern.angles)]
    return [float(pattern.angle)]


def rotate(points: Array, angle: float) -> Array:
    """Points (..., 2) turned by an angle, rad, about the origin."""
    c, s = np.cos(angle), np.sin(angle)
    return np.asarray(points @ np.array([[c, s], [-s, c]]))


def region_boundary(region: Region) -> Boundary:
    """The boundary of a region; one serves lines at all angles."""
    points, ring = shapely.get_coordinates(shapely.get_rings(shapely.get_parts(region)), return_index=True)
    last = np.append(np.flatnonzero(ring[1:] != ring[:-1]), len(ring) - 1)
    start = np.concatenate([[0], last[:-1] + 1])
    distinct = np.ones(len(points), bool)
    distinct[last] = False  # a ring repeats its first point
    count = last - start
    end = np.cumsum(count)
    return Boundary(points[distinct], np.repeat(end - count, count), np.repeat(end, count))


def crossings(boundary: Boundary, angle: float, spacing: float) -> tuple[Crossings, float]:
    """Crossings of lines at an angle with a boundary, and the distance of the lines, mm.

    The outermost lines touch the region; the distance divides its height evenly and is about `spacing`, rather less.
    """
    boundary = replace(boundary, vertices=rotate(boundary.vertices, -angle))
    low, high = float(boundary.vertices[:, 1].min()), float(boundary.vertices[:, 1].max())
    lines = max(1, int(np.ceil((high - low) / spacing - MAX_STRETCH))) + 1
    step = (high - low) / (lines - 1)
    return _line_crossings(boundary, low, step, lines), step


def _line_crossings(boundary: Boundary, low: float, step: float, lines: int) -> Crossings:
    vertices, ring_start = boundary.vertices, boundary.ring_start
    following = np.arange(1, len(vertices) + 1)
    following = np.where(following == boundary.ring_end, ring_start, following)
    # where the edges cross the lines; the outermost lines lie just inside
    level = np.clip((vertices[:, 1] - low) / step, TANGENT_MARGIN, lines - 1 - TANGENT_MARGIN)
    heights = np.arange(lines, dtype=float)
    heights[0], heights[-1] = 2 * TANGENT_MARGIN, lines - 1 - 2 * TANGENT_MARGIN
    a, b = level, level[following]
    first = np.searchsorted(heights, np.minimum(a, b), "left")
    count = np.searchsorted(heights, np.maximum(a, b), "left") - first
    edge = np.repeat(np.arange(len(vertices)), count)
    line = np.arange(len(edge)) - np.repeat(np.cumsum(count) - count, count) + np.repeat(first, count)
    share = (heights[line] - a[edge]) / (b - a)[edge]
    points = vertices[edge] + share[:, None] * (vertices[following[edge]] - vertices[edge])
    # neighbours along each ring
    along = np.lexsort([share, edge])
    after, before = np.empty(len(edge), np.intp), np.empty(len(edge), np.intp)
    ring = ring_start[edge[along]]
    closes = np.append(np.flatnonzero(ring[1:] != ring[:-1]), len(ring) - 1)
    opens = np.concatenate([[0], closes[:-1] + 1])
    onwards, backwards = np.arange(1, len(ring) + 1), np.arange(-1, len(ring) - 1)
    onwards[closes], backwards[opens] = opens, closes
    after[along], before[along] = along[onwards], along[backwards]
    # in the order of the lines
    order = np.lexsort([points[:, 0], line])
    place = np.empty(len(order), np.intp)
    place[order] = np.arange(len(order))
    return Crossings(points[order], line[order], edge[order], place[after[order]], place[before[order]], boundary)


def raster_lines(middle: Boundary, angle: float, spacing: float) -> tuple[list[Array], float]:
    """Lines (2, 2) at an angle, rad, all in one direction, and how far apart they are, mm.

    middle: the boundary of what middle lines of beads may reach.
    """
    scan, step = crossings(middle, angle, spacing)
    return list(rotate(scan.points, angle).reshape(-1, 2, 2)), step


def zigzag_lines(middle: Boundary, angle: float, spacing: float) -> tuple[list[Array], float]:
    """Lines (N, 2) at an angle, rad, there and back, and how far apart their straight parts are, mm.

    The end of a line is joined to the start of the next one by the boundary between them, where that boundary meets no
    other line: so joints stay inside however concave the region is. Else a new line begins.
    """
    scan, step = crossings(middle, angle, spacing)
    return [rotate(run, angle) for run in _runs(scan)], step


def _runs(scan: Crossings) -> list[Array]:
    line, edge = scan.line.tolist(), scan.edge.tolist()
    after, before = scan.after.tolist(), scan.before.tolist()
    used = [False] * (len(line) // 2)
    points = np.concatenate([scan.points, scan.boundary.vertices])
    runs = []
    for first in range(len(used)):
        if used[first]:
            continue
        path, entry = [], 2 * first
        while True:
            used[entry // 2] = True
            leave = entry ^ 1
            path += [entry, leave]
            target = after[leave]
            if line[target] == line[leave] + 1 and not used[target // 2]:
                path += _between(scan, edge[leave], edge[target], len(line))
            else:
                target = before[leave]
                if line[target] != line[leave] + 1 or used[target // 2]:
                    break
                path += _between(scan, edge[target], edge[leave], len(line))[::-1]
            entry = target
        runs.append(points[path])
    return runs


def _between(scan: Crossings, a: int, b: int, offset: int) -> list[int]:
    """Numbers of the boundary's own points from a crossing of edge a on to the next one, of edge b."""
    if b >= a:
        return list(range(offset + a + 1, offset + b + 1))
    start, end = int(scan.boundary.ring_start[a]), int(scan.boundary.ring_end[a])
    return [*range(offset + a + 1, offset + end), *range(offset + start, offset + b + 1)]
