"""The nearest point of a scan: exact on the triangles near by, quick where only its neighbourhood matters."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from estimation.scan import Index, Scan, face_areas, normals_at, open_edges
from estimation.se3 import Array

SAMPLES = 15_000  # about so many spread over the scan; a 100 x 100 mm scan gets one every 0.8 mm
_FINEST = 24  # divisions of a triangle's side at most


@dataclass(frozen=True, slots=True, eq=False)
class Closest:
    """Nearest points of a scan. points, normals: (N, 3), surface frame, mm. rim: (N,) whether on an open edge."""

    points: Array
    normals: Array
    rim: NDArray[np.bool_]


class ScanIndex:
    """A scan made ready for many queries.

    samples, normals: (S, 3), surface frame, mm: points spread over the triangles, at least one on each. triangle: (S,)
    the one each lies on. spacing: mm, how far apart they are at most, roughly.
    """

    def __init__(self, scan: Scan) -> None:
        self.scan = scan
        areas = face_areas(scan)
        self.spacing = float(np.sqrt(areas.sum() / SAMPLES))
        self.triangle, weights = _spread(scan, self.spacing)
        self._corners = scan.corners
        self.samples = np.einsum("sk,ski->si", weights, self._corners[self.triangle])
        self.normals = normals_at(scan, self.triangle, weights)
        self.tree = cKDTree(self.samples)
        self.spacing = max(self.spacing, float(np.sqrt(np.quantile(areas, 0.9))))
        self._open = _open_sides(scan)

    def closest(self, points: Array, candidates: int = 8) -> Closest:
        """Nearest points of the scan to points (N, 3), on the triangles of the nearest samples."""
        count = min(candidates, len(self.samples))
        _, near = self.tree.query(points, k=count)
        triangle = self.triangle[near.reshape(len(points), count)]  # (N, K)
        corners = self._corners[triangle.ravel()]
        weights = closest_weights(np.repeat(points, count, axis=0), corners)
        found = np.einsum("mk,mki->mi", weights, corners).reshape(len(points), count, 3)
        best = np.argmin(np.linalg.norm(found - points[:, None], axis=2), axis=1)
        row = np.arange(len(points))
        chosen, weight = triangle[row, best], weights.reshape(len(points), count, 3)[row, best]
        rim = ((weight < 1e-9) & self._open[chosen]).any(axis=1)
        return Closest(found[row, best], normals_at(self.scan, chosen, weight), rim)


def closest_weights(points: Array, corners: Array) -> Array:
    """Barycentric weights (M, 3) of the point of each triangle (M, 3, 3) nearest to its point (M, 3).

    Inside where the foot of the perpendicular falls inside, else on the nearest of the three sides (Ericson, Real-Time
    Collision Detection, 2005, 5.1.5, without its shortcuts).
    """
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    normal = np.cross(b - a, c - a)
    area = np.einsum("mi,mi->m", normal, normal)
    u = np.einsum("mi,mi->m", np.cross(c - b, points - b), normal) / area
    v = np.einsum("mi,mi->m", np.cross(a - c, points - c), normal) / area
    inner = np.column_stack([u, v, 1 - u - v])
    best, nearest = inner.copy(), np.full(len(points), np.inf)
    for i, j in ((0, 1), (1, 2), (2, 0)):
        side = corners[:, j] - corners[:, i]
        along = np.einsum("mi,mi->m", points - corners[:, i], side) / np.einsum("mi,mi->m", side, side)
        along = np.clip(along, 0, 1)
        distance = np.linalg.norm(corners[:, i] + along[:, None] * side - points, axis=1)
        weights = np.zeros_like(inner)
        weights[:, i], weights[:, j] = 1 - along, along
        better = distance < nearest
        best[better], nearest[better] = weights[better], distance[better]
    inside = (inner >= 0).all(axis=1)
    best[inside] = inner[inside]
    return best


def _spread(scan: Scan, spacing: float) -> tuple[Index, Array]:
    """Triangles (S,) and barycentric weights (S, 3) of samples about `spacing` apart: centres of sub-triangles."""
    corners = scan.corners
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    divisions = np.clip(np.ceil(longest / (1.5 * spacing)).astype(int), 1, _FINEST)
    triangles, weights = [], []
    for n in np.unique(divisions):
        some = np.flatnonzero(divisions == n)
        i, j = (m.ravel() for m in np.meshgrid(np.arange(n), np.arange(n), indexing="ij"))
        up = np.column_stack([i, j])[i + j < n] + 1 / 3
        down = np.column_stack([i, j])[i + j < n - 1] + 2 / 3
        uv = np.concatenate([up, down]) / n
        triangles.append(np.repeat(some, len(uv)))
        weights.append(np.tile(np.column_stack([1 - uv.sum(1), uv]), (len(some), 1)))
    return np.concatenate(triangles), np.concatenate(weights)


def _open_sides(scan: Scan) -> NDArray[np.bool_]:
    """(T, 3) whether the side opposite each corner is an open edge."""
    sides = np.sort(scan.triangles[:, [[1, 2], [2, 0], [0, 1]]], axis=2)
    keys = sides[..., 0] * len(scan.vertices) + sides[..., 1]
    edges = open_edges(scan)
    return np.asarray(np.isin(keys, edges[:, 0] * len(scan.vertices) + edges[:, 1]))
