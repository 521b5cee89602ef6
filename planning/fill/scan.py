"""Parallel lines across a region, all at once, and how their ends are joined along its boundary."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import shapely
from numpy.typing import NDArray

from estimation.se3 import Array
from planning.fill.region import Region

STRETCH = 0.25  # of a line more would be laid before lines lie farther apart than asked
INWARD = 1e-6  # share of the height by which the outermost lines stay off the tangent


@dataclass(frozen=True, slots=True, eq=False)
class Boundary:
    """vertices: (M, 2) mm, ring after ring, without repeats. ring_start, ring_end: (M,) of each vertex's ring."""

    vertices: Array
    ring_start: NDArray[np.intp]
    ring_end: NDArray[np.intp]


@dataclass(frozen=True, slots=True, eq=False)
class Crossings:
    """Where scan lines cross a boundary, by line and then by x: two by two they bound a stretch inside.

    points: (N, 2) mm, N even, in the axes of the lines. line: (N,) number of the scan line. edge: (N,) number of the
    boundary's edge. after, before: (N,) the crossing that follows and precedes along the boundary. vertices: (M, 2) of
    the boundary, ring after ring, without repeats; ring_start, ring_end: (M,) of each vertex.
    """

    points: Array
    line: NDArray[np.intp]
    edge: NDArray[np.intp]
    after: NDArray[np.intp]
    before: NDArray[np.intp]
    vertices: Array
    ring_start: NDArray[np.intp]
    ring_end: NDArray[np.intp]


def turned(points: Array, angle: float) -> Array:
    """Points (..., 2) turned by an angle, rad, about the origin."""
    c, s = np.cos(angle), np.sin(angle)
    return np.asarray(points @ np.array([[c, s], [-s, c]]))


def boundary_of(region: Region) -> Boundary:
    """The boundary of a region; one serves lines at all angles."""
    points, ring = shapely.get_coordinates(shapely.get_rings(shapely.get_parts(region)), return_index=True)
    last = np.append(np.flatnonzero(ring[1:] != ring[:-1]), len(ring) - 1)
    start = np.concatenate([[0], last[:-1] + 1])
    kept = np.ones(len(points), bool)
    kept[last] = False  # a ring repeats its first point
    count = last - start
    end = np.cumsum(count)
    return Boundary(points[kept], np.repeat(end - count, count), np.repeat(end, count))


def crossings(boundary: Boundary, angle: float, spacing: float) -> tuple[Crossings, float]:
    """Crossings of lines at an angle with a boundary, and the distance of the lines, mm.

    The outermost lines touch the region; the distance divides its height evenly and is about `spacing`, rather less.
    """
    vertices = turned(boundary.vertices, -angle)
    low, high = float(vertices[:, 1].min()), float(vertices[:, 1].max())
    lines = max(1, int(np.ceil((high - low) / spacing - STRETCH))) + 1
    step = (high - low) / (lines - 1)
    found = _crossed(vertices, boundary.ring_start, boundary.ring_end, low, step, lines)
    return found, step


def _crossed(
    vertices: Array, ring_start: NDArray[np.intp], ring_end: NDArray[np.intp], low: float, step: float, lines: int
) -> Crossings:
    following = np.arange(1, len(vertices) + 1)
    following = np.where(following == ring_end, ring_start, following)
    level = np.clip((vertices[:, 1] - low) / step, INWARD, lines - 1 - INWARD)  # outermost lines: just inside
    heights = np.arange(lines, dtype=float)
    heights[0], heights[-1] = 2 * INWARD, lines - 1 - 2 * INWARD
    a, b = level, level[following]
    first = np.searchsorted(heights, np.minimum(a, b), "left")
    count = np.searchsorted(heights, np.maximum(a, b), "left") - first
    edge = np.repeat(np.arange(len(vertices)), count)
    line = np.arange(len(edge)) - np.repeat(np.cumsum(count) - count, count) + np.repeat(first, count)
    share = (heights[line] - a[edge]) / (b - a)[edge]
    points = vertices[edge] + share[:, None] * (vertices[following[edge]] - vertices[edge])
    along = np.lexsort([share, edge])
    after = np.empty(len(edge), np.intp)
    before = np.empty(len(edge), np.intp)
    ring = ring_start[edge[along]]
    closes = np.append(np.flatnonzero(ring[1:] != ring[:-1]), len(ring) - 1)
    opens = np.concatenate([[0], closes[:-1] + 1])
    nxt, prv = np.arange(1, len(ring) + 1), np.arange(-1, len(ring) - 1)
    nxt[closes], prv[opens] = opens, closes
    after[along], before[along] = along[nxt], along[prv]
    order = np.lexsort([points[:, 0], line])
    place = np.empty(len(order), np.intp)
    place[order] = np.arange(len(order))
    return Crossings(
        points[order],
        line[order],
        edge[order],
        place[after[order]],
        place[before[order]],
        vertices,
        ring_start,
        ring_end,
    )
