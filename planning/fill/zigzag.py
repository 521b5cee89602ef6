"""Zig-zag and raster: parallel lines across a region, joined along its boundary or each for itself."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import shapely
from numpy.typing import NDArray

from estimation.se3 import Array
from planning.fill.region import Region

MAX_STRETCH = 0.25  # of a line more would be laid before lines lie farther apart than asked
TANGENT_MARGIN = 1e-6  # share of the height by which the outermost lines stay off the tangent


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
            to = after[leave]
            if line[to] == line[leave] + 1 and not used[to // 2]:
                path += _between(scan, edge[leave], edge[to], len(line))
            else:
                to = before[leave]
                if line[to] != line[leave] + 1 or used[to // 2]:
                    break
                path += _between(scan, edge[to], edge[leave], len(line))[::-1]
            entry = to
        runs.append(points[path])
    return runs


def _between(scan: Crossings, a: int, b: int, offset: int) -> list[int]:
    """Numbers of the boundary's own points from a crossing of edge a on to the next one, of edge b."""
    if b >= a:
        return list(range(offset + a + 1, offset + b + 1))
    start, end = int(scan.boundary.ring_start[a]), int(scan.boundary.ring_end[a])
    return [*range(offset + a + 1, offset + end), *range(offset + start, offset + b + 1)]
