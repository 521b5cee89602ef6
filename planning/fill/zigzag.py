"""Zig-zag and raster: parallel lines, joined along the boundary or each for itself."""

from __future__ import annotations

import numpy as np

from estimation.se3 import Array
from planning.fill.bead import Bead, even
from planning.fill.region import Region
from planning.fill.scan import Crossings, crossings, turned


def raster_beads(region: Region, angle: float, spacing: float, overlap: float) -> list[Bead]:
    """Lines at an angle, rad, all in one direction, within a region of middle lines."""
    if region.is_empty:
        return []
    found, step = crossings(region, angle, spacing)
    lines = turned(found.points, angle).reshape(-1, 2, 2)
    return [even(line, step / (1 - overlap)) for line in lines]


def zigzag_beads(region: Region, angle: float, spacing: float, overlap: float) -> list[Bead]:
    """Lines at an angle, rad, there and back, within a region of middle lines.

    The end of a line is joined to the start of the next one by the boundary between them, where that boundary meets no
    other line: so joints stay inside however concave the region is. Else a new bead begins.
    """
    if region.is_empty:
        return []
    found, step = crossings(region, angle, spacing)
    return [even(turned(run, angle), step / (1 - overlap)) for run in _runs(found)]


def _runs(found: Crossings) -> list[Array]:
    line = found.line.tolist()
    after, before = found.after.tolist(), found.before.tolist()
    used = [False] * (len(line) // 2)
    runs = []
    for first in range(len(used)):
        if used[first]:
            continue
        parts, entry = [], 2 * first
        while True:
            used[entry // 2] = True
            leave = entry ^ 1
            parts.append(found.points[[entry, leave]])
            to, forward = after[leave], True
            if line[to] != line[leave] + 1 or used[to // 2]:
                to, forward = before[leave], False
            if line[to] != line[leave] + 1 or used[to // 2]:
                break
            parts.append(_between(found, leave, to) if forward else _between(found, to, leave)[::-1])
            entry = to
        runs.append(np.concatenate(parts))
    return runs


def _between(found: Crossings, a: int, b: int) -> Array:
    """The boundary's own points from one crossing on to the next."""
    i, j = int(found.edge[a]), int(found.edge[b])
    if i == j:
        return found.vertices[:0]
    start, end = int(found.ring_start[i]), int(found.ring_end[i])
    if j > i:
        return found.vertices[i + 1 : j + 1]
    return np.concatenate([found.vertices[i + 1 : end], found.vertices[start : j + 1]])
