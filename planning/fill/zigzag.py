"""Zig-zag and raster: parallel lines, joined along the boundary or each for itself."""

from __future__ import annotations

import numpy as np

from estimation.se3 import Array
from planning.fill.scan import Boundary, Crossings, crossings, turned


def raster_lines(middle: Boundary, angle: float, spacing: float) -> tuple[list[Array], float]:
    """Lines (2, 2) at an angle, rad, all in one direction, and how far apart they are, mm.

    middle: the boundary of what middle lines of beads may reach.
    """
    found, step = crossings(middle, angle, spacing)
    return list(turned(found.points, angle).reshape(-1, 2, 2)), step


def zigzag_lines(middle: Boundary, angle: float, spacing: float) -> tuple[list[Array], float]:
    """Lines (N, 2) at an angle, rad, there and back, and how far apart their straight parts are, mm.

    The end of a line is joined to the start of the next one by the boundary between them, where that boundary meets no
    other line: so joints stay inside however concave the region is. Else a new line begins.
    """
    found, step = crossings(middle, angle, spacing)
    return [turned(run, angle) for run in _runs(found)], step


def _runs(found: Crossings) -> list[Array]:
    line, edge = found.line.tolist(), found.edge.tolist()
    after, before = found.after.tolist(), found.before.tolist()
    used = [False] * (len(line) // 2)
    points = np.concatenate([found.points, found.vertices])
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
                path += _between(found, edge[leave], edge[to], len(line))
            else:
                to = before[leave]
                if line[to] != line[leave] + 1 or used[to // 2]:
                    break
                path += _between(found, edge[to], edge[leave], len(line))[::-1]
            entry = to
        runs.append(points[path])
    return runs


def _between(found: Crossings, a: int, b: int, offset: int) -> list[int]:
    """Numbers of the boundary's own points from a crossing of edge a on to the next one, of edge b."""
    if b >= a:
        return list(range(offset + a + 1, offset + b + 1))
    start, end = int(found.ring_start[a]), int(found.ring_end[a])
    return [*range(offset + a + 1, offset + end), *range(offset + start, offset + b + 1)]
