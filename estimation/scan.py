"""A scan of the surface: a triangle mesh whose own coordinates are the surface frame."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from estimation.se3 import Array

Index = NDArray[np.int64]


@dataclass(frozen=True, slots=True, eq=False)
class Scan:
    """A triangle mesh without duplicated vertices.

    vertices: (V, 3) mm, surface frame. triangles: (T, 3) numbers of vertices, anticlockwise as seen from outside.
    normals: (V, 3) unit, out of the surface, each the mean of the triangles around it, weighted by area.
    """

    vertices: Array
    triangles: Index
    normals: Array

    @property
    def corners(self) -> Array:
        """Corners of the triangles (T, 3, 3), mm."""
        return np.asarray(self.vertices[self.triangles])


def scan_from_triangles(vertices: ArrayLike, triangles: ArrayLike) -> Scan:
    """The scan with vertices (V, 3) mm and triangles (T, 3); equal vertices are merged, empty triangles left out."""
    points, faces = np.asarray(vertices, float), np.asarray(triangles, np.int64)
    points, number = np.unique(points + 0.0, axis=0, return_inverse=True)  # + 0.0: -0 is 0
    faces = number.reshape(-1)[faces]
    crosses = _crosses(points, faces)
    largest = float(np.abs(points).max(initial=0.0))
    faces = faces[np.linalg.norm(crosses, axis=1) > 1e-12 * largest**2]
    used, number = np.unique(faces, return_inverse=True)
    points, faces = points[used], number.reshape(-1, 3)
    return Scan(points, faces, _vertex_normals(points, faces))


def open_edges(scan: Scan) -> Index:
    """Edges (E, 2) that belong to one triangle only: the rim of the scan and of its holes; none if it is closed."""
    edges = np.sort(scan.triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    different, count = np.unique(edges, axis=0, return_counts=True)
    return np.asarray(different[count == 1])


def face_normals(scan: Scan) -> Array:
    """Unit normals (T, 3) of the triangles, out of the surface."""
    crosses = _crosses(scan.vertices, scan.triangles)
    return np.asarray(crosses / np.linalg.norm(crosses, axis=1, keepdims=True))


def face_areas(scan: Scan) -> Array:
    """Areas (T,) of the triangles, mm^2."""
    return np.asarray(np.linalg.norm(_crosses(scan.vertices, scan.triangles), axis=1) / 2)


def normals_at(scan: Scan, triangle: Index, weights: Array) -> Array:
    """Unit normals (N, 3), interpolated between the corners of `triangle` (N,) by barycentric weights (N, 3)."""
    mixed = np.einsum("nk,nki->ni", weights, scan.normals[scan.triangles[triangle]])
    return np.asarray(mixed / np.maximum(np.linalg.norm(mixed, axis=1, keepdims=True), 1e-12))


def _crosses(points: Array, faces: Index) -> Array:
    a, b, c = points[faces[:, 0]], points[faces[:, 1]], points[faces[:, 2]]
    return np.cross(b - a, c - a)


def _vertex_normals(points: Array, faces: Index) -> Array:
    """Unit normals (V, 3); where the triangles around a vertex cancel out, that of one of them."""
    crosses = _crosses(points, faces)
    sums = np.zeros_like(points)
    some = np.zeros_like(points)
    for corner in range(3):
        np.add.at(sums, faces[:, corner], crosses)
        some[faces[:, corner]] = crosses
    length = np.linalg.norm(sums, axis=1)
    lone = length <= 1e-9 * np.linalg.norm(some, axis=1)
    sums[lone] = some[lone]
    return np.asarray(sums / np.linalg.norm(sums, axis=1, keepdims=True))
