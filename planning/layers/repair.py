"""What is wrong with a scanned mesh is put right where it can be, and counted."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from estimation.errors import InputError
from estimation.scans.scan import Scan, scan_from_triangles
from estimation.se3 import Array

Index = NDArray[np.int64]
MERGE_DISTANCE = 1e-4  # mm: nearer vertices are one; scanners resolve a hundredth, and float32 a hundred-thousandth
MIN_ISLAND_SHARE = 0.05  # of the whole area: smaller pieces are dirt, a table behind the limb, or a hair
SPIKE_SIGMAS, SPIKE_EDGES = 6.0, 0.75  # a vertex is a spike when it stands out by so many deviations, and so many edges
SPIKE_ROUNDS = 3  # a spike may hide the one beside it
MIN_MEAN_NORMAL = 0.1  # mean of the normals by area: a closed body's is 0, and no plane is its mean plane
MIN_TRIANGLES = 50  # triangles: fewer give no shape


@dataclass(frozen=True, slots=True)
class Repairs:
    """What was done to a mesh, as counts."""

    vertices: int
    triangles: int
    broken: int
    merged: int
    empty: int
    double: int
    crowded: int
    islands: int
    island_triangles: int
    turned: int
    spikes: int
    inside_out: bool
    holes: int

    def rows(self) -> list[tuple[str, int]]:
        """Defects and repairs, in words, and how often."""
        return [
            ("vertices read", self.vertices),
            ("triangles read", self.triangles),
            ("triangles left out that name a missing vertex or no finite place", self.broken),
            ("duplicate vertices merged", self.merged),
            ("triangles without area left out", self.empty),
            ("duplicate triangles left out", self.double),
            ("triangles left out where more than two met at an edge", self.crowded),
            (f"islands left out, {self.island_triangles} triangles", self.islands),
            ("triangles turned over", self.turned),
            ("spikes levelled", self.spikes),
            ("whole scan turned inside out, as asked for", int(self.inside_out)),
            ("holes closed", self.holes),
        ]


def repair_mesh(vertices: ArrayLike, triangles: ArrayLike, where: object, flip: bool = False) -> tuple[Scan, Repairs]:
    """The mesh with vertices (V, 3) mm and triangles (T, 3), put right, and what was done; InputError if it is no use.

    flip: turn the whole scan over, for one whose normals all point inwards.
    """
    points, faces = np.asarray(vertices, float).reshape(-1, 3), np.asarray(triangles, np.int64).reshape(-1, 3)
    read = len(points), len(faces)
    finite = np.r_[np.isfinite(points).all(axis=1), False]
    faces = faces[finite[np.where((faces >= 0) & (faces < len(points)), faces, -1)].all(axis=1)]
    broken = read[1] - len(faces)
    _enough(faces, where, read[1])
    points, faces, merged = _merged(points, faces)
    before = len(faces)
    faces = faces[_with_area(points, faces)]
    empty, before = before - len(faces), len(faces)
    _enough(faces, where, read[1])
    faces = faces[_single(faces)]
    double, before = before - len(faces), len(faces)
    faces = faces[_uncrowded(points, faces)]
    crowded, before = before - len(faces), len(faces)
    mainland, islands = _mainland(points, faces)
    faces = faces[mainland]
    island_triangles = before - len(faces)
    _enough(faces, where, read[1])
    turned = _against(points, faces)
    faces = np.where(turned[:, None] ^ flip, faces[:, ::-1], faces)
    points, spikes = _levelled(points, faces, mean_normal(points, faces, where))
    scan = scan_from_triangles(points, faces)
    done = Repairs(
        *read, broken, merged, empty, double, crowded, islands, island_triangles, int(turned.sum()), spikes, flip,
        max(0, _rims(scan) - 1),
    )  # fmt: skip
    return scan, done


def mean_normal(points: Array, faces: Index, where: object) -> Array:
    """The mean unit normal (3,) by area; InputError for a closed body, which faces no way."""
    crosses = _crosses(points, faces)
    z = crosses.sum(axis=0) / np.linalg.norm(crosses, axis=1).sum()
    facing = float(np.linalg.norm(z))
    if not facing >= MIN_MEAN_NORMAL:
        side = "the skin around the wound seen from one side; cut it out of the whole body"
        allowed = f"{MIN_MEAN_NORMAL:g} or more: {side}"
        raise InputError(where, "length of the mean normal", round(facing, 3), allowed)
    return np.asarray(z / facing)


def _enough(faces: Index, where: object, read: int) -> None:
    if len(faces) < MIN_TRIANGLES:
        got = f"{len(faces)} triangles that can be used of {read}"
        raise InputError(where, "scan", got, f"{MIN_TRIANGLES} or more: scan the wound again")


def _merged(points: Array, faces: Index) -> tuple[Array, Index, int]:
    """Vertices that are used, each once, the triangles of them, and how many were merged."""
    used, number = np.unique(faces, return_inverse=True)
    faces = number.reshape(-1, 3)
    points = points[used] + 0.0
    key = np.round(points / MERGE_DISTANCE)
    order = np.lexsort(key.T)
    new = np.r_[True, (np.diff(key[order], axis=0) != 0).any(axis=1)]
    number = np.empty(len(points), np.int64)
    number[order] = np.cumsum(new) - 1
    return points[order][new], number[faces], len(points) - int(new.sum())


def _with_area(points: Array, faces: Index) -> NDArray[np.bool_]:
    corners = points[faces]
    sides = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    return np.asarray(2 * _areas(points, faces) > 1e-6 * np.maximum(sides, MERGE_DISTANCE) ** 2)


def _areas(points: Array, faces: Index) -> Array:
    return np.asarray(np.linalg.norm(_crosses(points, faces), axis=1) / 2)


def _crosses(points: Array, faces: Index) -> Array:
    a, b, c = points[faces[:, 0]], points[faces[:, 1]], points[faces[:, 2]]
    p, q = b - a, c - a
    return np.asarray(p[:, [1, 2, 0]] * q[:, [2, 0, 1]] - p[:, [2, 0, 1]] * q[:, [1, 2, 0]])


def _single(faces: Index) -> NDArray[np.bool_]:
    """The first of each set of three vertices."""
    corners = np.sort(faces, axis=1)
    order = np.lexsort(corners.T)
    keep = np.zeros(len(faces), bool)
    keep[order[np.r_[True, (np.diff(corners[order], axis=0) != 0).any(axis=1)]]] = True
    return keep


def _edges(faces: Index) -> tuple[Index, Index, NDArray[np.bool_]]:
    """Number of each edge (3T,), its triangle (3T,), and whether the triangle walks it from the lower vertex."""
    start, end = faces[:, [0, 1, 2]].ravel(), faces[:, [1, 2, 0]].ravel()
    low, high = np.minimum(start, end), np.maximum(start, end)
    _, number = np.unique(low * (int(faces.max()) + 1) + high, return_inverse=True)
    return number, np.repeat(np.arange(len(faces)), 3), start < end


def _uncrowded(points: Array, faces: Index) -> NDArray[np.bool_]:
    """All but the smallest triangles at edges where more than two meet."""
    edge, triangle, _ = _edges(faces)
    if np.bincount(edge).max() <= 2:
        return np.ones(len(faces), bool)
    order = np.lexsort((-_areas(points, faces)[triangle], edge))
    rank = np.arange(len(order)) - np.searchsorted(edge[order], edge[order])
    keep = np.ones(len(faces), bool)
    keep[triangle[order[rank >= 2]]] = False
    return keep


def _pairs(faces: Index) -> tuple[Index, Index, NDArray[np.bool_]]:
    """Triangles that share an edge, (P,) and (P,), and whether they face the same way there."""
    edge, triangle, forward = _edges(faces)
    order = np.argsort(edge, kind="stable")
    same = np.flatnonzero(np.diff(edge[order]) == 0)
    a, b = order[same], order[same + 1]
    return triangle[a], triangle[b], forward[a] != forward[b]


def _mainland(points: Array, faces: Index) -> tuple[NDArray[np.bool_], int]:
    """Triangles that hang together over a good part of the area, and how many pieces are left out."""
    a, b, _ = _pairs(faces)
    count, piece = connected_components(coo_array((np.ones(len(a)), (a, b)), shape=(len(faces),) * 2), directed=False)
    areas = np.bincount(piece, _areas(points, faces), count)
    large = (areas >= MIN_ISLAND_SHARE * areas.sum()) | (areas == areas.max())
    return np.asarray(large[piece]), int(count - large.sum())


def _against(points: Array, faces: Index) -> NDArray[np.bool_]:
    """Which triangles face against the larger part of their piece.

    Each triangle stands twice in a graph, as it is and turned over; what hangs together in it faces one way.
    """
    a, b, same = _pairs(faces)
    count = len(faces)
    other, mirrored = np.where(same, b, b + count), np.where(same, b + count, b)
    edges = np.r_[a, a + count], np.r_[other, mirrored]
    graph = coo_array((np.ones(2 * len(a)), edges), shape=(2 * count, 2 * count))
    _, side = connected_components(graph, directed=False)
    one_sided = side[:count] == side[count:]  # as a Moebius strip: no way to face
    first = side[:count] < side[count:]
    areas = _areas(points, faces) * ~one_sided
    piece = np.minimum(side[:count], side[count:])
    as_first, as_other = (np.bincount(piece, areas * part, 2 * count) for part in (first, ~first))
    return np.asarray((first != (as_first >= as_other)[piece]) & ~one_sided)


def _levelled(points: Array, faces: Index, normal: Array) -> tuple[Array, int]:
    """Vertices (V, 3) of which those that stand out of all their neighbours are moved among them, and how many."""
    start, end = faces[:, [0, 1, 2]].ravel(), faces[:, [1, 2, 0]].ravel()  # faces agree: each neighbour comes once
    edge = float(np.median(np.linalg.norm(points[start] - points[end], axis=1)))
    points, moved = points.copy(), np.zeros(len(points), bool)
    for _ in range(SPIKE_ROUNDS):
        heights = points @ normal
        low, high, middle = _around(heights, start, end)
        noise = 1.4826 * float(np.median(np.abs(heights - middle)))
        out = np.maximum(heights - high, low - heights) > max(SPIKE_SIGMAS * noise, SPIKE_EDGES * edge)
        if not out.any():
            break
        points[out] += (middle - heights)[out, None] * normal
        moved |= out
    return points, int(moved.sum())


def _around(heights: Array, start: Index, end: Index) -> tuple[Array, Array, Array]:
    """Second lowest, second highest and median height (V,) of each vertex's neighbours; its own where there are few."""
    sorted_heights = heights[end][np.lexsort((heights[end], start))]
    count = np.bincount(start, minlength=len(heights))
    first = np.cumsum(count) - count
    many = count >= 4
    low, high, middle = heights.copy(), heights.copy(), heights.copy()
    low[many] = sorted_heights[first[many] + 1]
    high[many] = sorted_heights[first[many] + count[many] - 2]
    middle[many] = sorted_heights[first[many] + count[many] // 2]
    return low, high, middle


def _rims(scan: Scan) -> int:
    """How many rims the scan has: its own, and one for each hole."""
    edge, _, _ = _edges(scan.triangles)
    walked = scan.triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    rim = walked[np.bincount(edge)[edge] == 1]
    if not len(rim):
        return 0
    ends, number = np.unique(rim, return_inverse=True)
    a, b = number.reshape(-1, 2).T
    graph = coo_array((np.ones(len(a)), (a, b)), shape=(len(ends), len(ends)))
    return int(connected_components(graph, directed=False)[0])
