"""Where a function on a grid is positive, as polygons: marching triangles, which leave no case in doubt."""

from __future__ import annotations

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely import MultiPolygon

from estimation.se3 import Array
from planning.layers.grid import Grid

NEARLY = 1e-9  # values nearer to 0 than this are moved off it, so that no crossing falls on a node
Index = NDArray[np.int64]


def region(grid: Grid, values: Array, least: float, slack: float) -> MultiPolygon:
    """Where values (H, W), linear between nodes, are positive, in mm.

    least: mm^2, smaller pieces and holes are left out. slack: mm that the outline may be moved to make it simple.
    """
    rings = [ring for ring in _rings(grid, values) if abs(_area(ring)) >= least]
    if not rings:
        return MultiPolygon()
    polygons = shapely.build_area(shapely.multilinestrings([shapely.linestrings(_closed(r)) for r in rings]))
    return as_multi(shapely.make_valid(shapely.simplify(polygons, slack)), least)


def as_multi(shape: shapely.Geometry, least: float = 0.0) -> MultiPolygon:
    """The polygons of any shape that are at least `least` mm^2 large, the largest first."""
    parts = [p for p in shapely.get_parts(shapely.get_parts(shape)) if isinstance(p, shapely.Polygon)]
    parts = [p for p in parts if not p.is_empty and p.area >= least]
    return MultiPolygon(sorted(parts, key=lambda p: (-p.area, p.bounds)))


def _closed(ring: Array) -> Array:
    return np.concatenate([ring, ring[:1]])


def _area(ring: Array) -> float:
    x, y = ring.T
    return float(np.sum(x * np.roll(y, -1) - y * np.roll(x, -1)) / 2)


def _rings(grid: Grid, values: Array) -> list[Array]:
    """Closed rings (N, 2), mm, with the positive side on their left."""
    f = np.pad(np.asarray(values, float), 1, constant_values=-1.0)
    f = np.where(np.abs(f) < NEARLY, -NEARLY, f)
    starts, ends = _segments(f)
    columns = f.shape[1]
    order = np.argsort(starts)
    keys = starts[order]  # each edge is left once
    following = np.searchsorted(keys, ends[order])
    places = grid.origin + (_crossings(f, keys, columns) - 1) * grid.step
    return [places[loop] for loop in _loops(following)]


def _segments(f: Array) -> tuple[Index, Index]:
    """Lines across the triangles of the grid: the edges, by number, where each enters and leaves."""
    number = np.arange(f.size).reshape(f.shape)
    inside = f > 0
    mixed = inside[:-1, :-1] != inside[:-1, 1:]
    mixed |= (inside[:-1, :-1] != inside[1:, 1:]) | (inside[:-1, :-1] != inside[1:, :-1])
    a, b, c, d = (n[mixed] for n in (number[:-1, :-1], number[:-1, 1:], number[1:, 1:], number[1:, :-1]))
    corners = np.concatenate([np.column_stack([a, b, c]), np.column_stack([a, c, d])])
    flags = inside.ravel()[corners]
    count = flags.sum(axis=1)
    crossed = (count == 1) | (count == 2)
    corners, flags, count = corners[crossed], flags[crossed], count[crossed]
    odd = np.argmax(flags == (count == 1)[:, None], axis=1)
    rows = np.arange(len(corners))
    p, q, r = (corners[rows, (odd + k) % 3] for k in range(3))
    one, two = _edge(p, q, f.size), _edge(r, p, f.size)
    lone_inside = count == 1
    return np.where(lone_inside, one, two), np.where(lone_inside, two, one)


def _edge(a: Index, b: Index, size: int) -> Index:
    return np.asarray(np.minimum(a, b) * size + np.maximum(a, b))


def _crossings(f: Array, keys: Index, columns: int) -> Array:
    """Points (N, 2), in nodes, where f is zero on edges."""
    low, high = keys // f.size, keys % f.size
    flat = f.ravel()
    t = flat[low] / (flat[low] - flat[high])
    x = low % columns + t * (high % columns - low % columns)
    y = low // columns + t * (high // columns - low // columns)
    return np.column_stack([x, y])


def _loops(following: Index) -> list[Index]:
    """The cycles of a permutation."""
    todo, successors = np.ones(len(following), bool), following.tolist()
    loops = []
    for start in range(len(successors)):
        if not todo[start]:
            continue
        loop, k = list[int](), start
        while todo[k]:
            todo[k] = False
            loop.append(k)
            k = successors[k]
        loops.append(np.array(loop))
    return loops
