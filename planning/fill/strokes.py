"""Single beads along the middle of what is too narrow for two: as wide as the place."""

from __future__ import annotations

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely.geometry.base import BaseGeometry

from estimation.se3 import Array
from planning.fill.axis import Axis
from planning.fill.bead import Bead
from planning.fill.fit import Fit

SHORTEST = 0.1  # spacings: a shorter line is a dot
SAMPLED = 0.25  # spacings from point to point
CLEAR = 0.5  # of the radius at a wide end, by which a bead stays away from the line that turns there
WIDE = 0.9  # of the widest: an end at least that wide lies before such a turn
SMOOTHED = 4  # roundings, each over two points


def paths(edges: NDArray[np.intp]) -> list[list[int]]:
    """The edges (E, 2) of a graph as paths between its ends and forks; circles end where they begin."""
    beside: dict[int, list[int]] = {}
    for a, b in np.unique(np.sort(edges[edges[:, 0] != edges[:, 1]], axis=1), axis=0).tolist():
        beside.setdefault(a, []).append(b)
        beside.setdefault(b, []).append(a)
    found, gone = [], set()
    ends = [v for v, near in beside.items() if len(near) != 2]
    for start in (*ends, *beside):
        for second in beside[start]:
            if (start, second) in gone:
                continue
            path = [start, second]
            gone |= {(start, second), (second, start)}
            while len(beside[path[-1]]) == 2 and path[-1] != start:
                a, b = beside[path[-1]]
                path.append(b if a == path[-2] else a)
                gone |= {(path[-2], path[-1]), (path[-1], path[-2])}
            found.append(path)
    return found


def strokes(axis: Axis, edge: BaseGeometry, fit: Fit, levels: int | None = None) -> list[tuple[int, Bead]]:
    """Beads along the parts of an axis that closed lines at multiples of the spacing leave, each with its level.

    edge: the boundary that the axis belongs to; no bead reaches over it.
    """
    level = fit.level(axis.radii)
    single = (axis.radii - fit.outside(level) < fit.two) & (level >= 0)
    if levels is not None:
        single &= level < levels
    a, b = axis.edges.T
    kept = axis.edges[single[a] & single[b] & (level[a] == level[b])]
    found = []
    for path in paths(kept):
        points = _smooth(axis.middles[path], fit.spacing)
        if len(points):
            inner = int(level[path[0]])
            radius = shapely.distance(edge, shapely.points(points)) - float(fit.outside(inner))
            bead = _clear(Bead(points, 2 * np.clip(radius, fit.one, fit.two)), fit)
            if bead is not None:
                found.append((inner, bead))
    return found


def _clear(bead: Bead, fit: Fit) -> Bead | None:
    """What stays of a bead once it keeps clear of the closed lines that turn round where it is widest."""
    start, end = (CLEAR * fit.two if width > WIDE * 2 * fit.two else 0.0 for width in bead.width[[0, -1]])
    if bead.length - start - end < SHORTEST * fit.spacing:
        return None
    return bead.between(start, bead.length - end)


def _smooth(points: Array, spacing: float) -> Array:
    """The same line (N, 2) without the Voronoi diagram's jitter; none where it is too short to be one."""
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    if along[-1] < SHORTEST * spacing:
        return points[:0]
    at = np.linspace(0, along[-1], max(2, int(np.ceil(along[-1] / (SAMPLED * spacing))) + 1))
    line = np.stack([np.interp(at, along, v) for v in points.T], axis=1)
    for _ in range(SMOOTHED):
        line[1:-1] = (line[:-2] + 2 * line[1:-1] + line[2:]) / 4
    return line
