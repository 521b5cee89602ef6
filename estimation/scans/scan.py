"""A scan of the surface, a triangle mesh in the surface frame: ray intersection and nearest points."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from estimation.runtime import UNUSED_OPEN3D_MODULES, stub_modules
from estimation.se3 import Array, Index, Mask

MIN_INCIDENCE = 0.1  # cosine of ray and normal, bounds the derivatives
SAMPLE_COUNT = 15_000  # on the scan, about; 0.8 mm apart on 100 x 100 mm
RIM_WEIGHT = 1e-6  # barycentric: below, a nearest point is on the opposite side; ten roundings of float32
_MAX_DIVISIONS = 24  # of a triangle's side


@dataclass(frozen=True, slots=True, eq=False)
class Scan:
    """A triangle mesh without duplicated vertices."""

    vertices: Array  # (V, 3) mm, surface frame
    triangles: Index  # (T, 3) numbers of vertices, anticlockwise as seen from outside
    normals: Array  # (V, 3) unit, out of the surface, means of the adjacent triangles' by area

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
    return Scan(points, faces, vertex_normals(points, faces))


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


def vertex_normals(points: Array, faces: Index) -> Array:
    """Unit normals (V, 3); where adjacent triangles' normals cancel out, that of one triangle."""
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


def triangulate_lattice(valid: Mask) -> tuple[Index, Index]:
    """Triangles (T, 3) between valid nodes of a lattice (H, W), and the nodes (V,), row by row, that they number.

    Anticlockwise seen from +z, where rows run along y and columns along x.
    """
    number = np.arange(valid.size).reshape(valid.shape)
    a, b, c, d = (part.ravel() for part in (number[:-1, :-1], number[:-1, 1:], number[1:, :-1], number[1:, 1:]))
    triangles = np.concatenate([np.column_stack([a, b, d]), np.column_stack([a, d, c])])
    used, corner = np.unique(triangles[valid.ravel()[triangles].all(1)], return_inverse=True)
    return used, corner.reshape(-1, 3)


class _Scene:
    """open3d's ray casting scene of a scan, in float32: it finds triangles; points on them are computed in float64.

    The result of a query does not depend on other queries or threads.
    """

    def __init__(self, scan: Scan) -> None:
        with stub_modules(*UNUSED_OPEN3D_MODULES):
            import open3d as o3d  # a second and 100 MB, which processes without a scan need not spend

        self.scan, self._tensor = scan, o3d.core.Tensor
        self._middle = scan.vertices.mean(axis=0)  # float32 has 7 digits, which a distant origin would use up
        self._scene = o3d.t.geometry.RaycastingScene()
        self._scene.add_triangles(
            self._to_tensor(scan.vertices - self._middle), self._to_tensor(scan.triangles, np.uint32)
        )
        self._miss = self._scene.INVALID_ID

    def _to_tensor(self, values: Array | Index, kind: type = np.float32) -> Any:
        return self._tensor(np.ascontiguousarray(values, kind))

    def first_hits(self, origins: Array, directions: Array) -> tuple[Index, Index]:
        """Rays (M,) that hit the scan, and the first triangle (M,) of each."""
        rays = np.concatenate([origins - self._middle, directions], axis=1)
        triangle = self._scene.cast_rays(self._to_tensor(rays))["primitive_ids"].numpy()
        ray = np.flatnonzero(triangle != self._miss)
        return ray, triangle[ray].astype(np.int64)

    def closest(self, points: Array) -> tuple[Index, Array]:
        """The triangle (N,) nearest to each point (N, 3), and the barycentric weights (N, 3) of its nearest point."""
        near = self._scene.compute_closest_points(self._to_tensor(points - self._middle))
        uv = near["primitive_uvs"].numpy().astype(np.float64)
        return near["primitive_ids"].numpy().astype(np.int64), np.column_stack([1 - uv.sum(axis=1), uv])


@dataclass(frozen=True, slots=True, eq=False)
class Hits:
    """First intersections of N rays with the scan."""

    points: Array  # (N, 3) mm, surface frame; NaN without a hit
    normals: Array  # (N, 3) unit, likewise
    hit: Mask  # (N,)


def cast_rays(scan: Scan, origins: ArrayLike, directions: Array) -> Hits:
    """First intersections, with either side, of rays from `origins` (N, 3) or (3,) along `directions` (N, 3).

    Surface frame. open3d finds the triangle; the intersection with its plane is computed in float64.
    """
    points, normals = np.full((2, len(directions), 3), np.nan)
    if not len(directions) or not len(scan.triangles):
        return Hits(points, normals, np.zeros(len(directions), bool))
    origins = np.broadcast_to(np.asarray(origins, float), directions.shape)
    ray, triangle = _Scene(scan).first_hits(origins, directions)
    weights, depth = _intersect_triangles(scan.corners[triangle] - origins[ray, None], directions[ray])
    points[ray] = origins[ray] + depth[:, None] * directions[ray]
    normals[ray] = normals_at(scan, triangle, weights)
    return Hits(points, normals, np.isfinite(points[:, 0]))


LIGHT_DIRECTION = np.array([-0.4, 0.3, 0.87])  # in the view's frame: from above left
AMBIENT_LIGHT = 0.45  # brightness of faces turned away from the light


def render_scan(scan: Scan, colours: NDArray[np.uint8], way: Array, pixels: int) -> NDArray[np.uint8]:
    """An orthographic picture (pixels, pixels, 3) of a scan with colours (V, 3), seen from direction `way` (3,)."""
    from scipy.spatial import cKDTree  # half a second, which processes without a scan need not spend

    z = way / np.linalg.norm(way)
    x = np.cross([0.0, 1.0, 0.0] if abs(z[1]) < 0.5 else [0.0, 0.0, 1.0], z)
    x /= np.linalg.norm(x)
    axes = np.stack([x, np.cross(z, x), z])
    seen = scan.vertices @ axes.T
    low, high = seen.min(axis=0), seen.max(axis=0)
    lines, middle = np.linspace(-0.52, 0.52, pixels) * (high - low)[:2].max(), (low + high) / 2
    u, v = np.meshgrid(lines + middle[0], middle[1] - lines)
    flat = np.column_stack([u.ravel(), v.ravel(), np.full(u.size, high[2] + 1)])
    hits = cast_rays(scan, flat @ axes, np.broadcast_to(-z, (u.size, 3)))
    near = cKDTree(scan.vertices).query(hits.points[hits.hit])[1]
    lit = np.clip(hits.normals[hits.hit] @ (LIGHT_DIRECTION @ axes), 0, 1)
    image = np.full((u.size, 3), 255, np.uint8)
    image[hits.hit] = np.clip(colours[near] * (AMBIENT_LIGHT + 0.6 * lit)[:, None], 0, 255)
    return image.reshape(pixels, pixels, 3)


def intersection_jacobians(rays: Array, normals: Array) -> tuple[Array, Array]:
    """Derivatives of the intersections of rays (N, 3), from the camera, with planes of unit normals (N, 3).

    (N, 3, 3) by a shift of the ray, and (N, 3) by a shift of the plane along its normal.
    """
    along = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    slope = np.einsum("ni,ni->n", along, normals)
    slope = np.where(np.abs(slope) < MIN_INCIDENCE, -MIN_INCIDENCE, slope)
    return np.eye(3) - along[:, :, None] * normals[:, None] / slope[:, None, None], along / slope[:, None]


def _intersect_triangles(corners: Array, directions: Array) -> tuple[Array, Array]:
    """Intersections of rays (M, 3) from the origin with the planes of triangles (M, 3, 3) (Moeller and Trumbore 1997).

    Their barycentric weights (M, 3), and distances in lengths of `directions` (M,).
    """
    a = corners[:, 0]
    ab, ac = corners[:, 1] - a, corners[:, 2] - a
    p, q = np.cross(directions, ac), np.cross(-a, ab)
    scale = 1 / np.einsum("mi,mi->m", ab, p)
    u, v = -np.einsum("mi,mi->m", a, p) * scale, np.einsum("mi,mi->m", directions, q) * scale
    return np.column_stack([1 - u - v, u, v]), np.einsum("mi,mi->m", ac, q) * scale


@dataclass(frozen=True, slots=True, eq=False)
class ClosestPoints:
    """Nearest points of a scan."""

    points: Array  # (N, 3) mm, surface frame
    normals: Array  # (N, 3) unit
    rim: Mask  # (N,) whether on an open edge


class ScanIndex:
    """An index of a scan for many queries: samples on its triangles, at least one on each."""

    def __init__(self, scan: Scan) -> None:
        from scipy.spatial import cKDTree  # as above

        self.scan, self._scene, self._corners, areas = scan, _Scene(scan), scan.corners, face_areas(scan)
        spacing = float(np.sqrt(areas.sum() / SAMPLE_COUNT))
        self.spacing = max(spacing, float(np.sqrt(np.quantile(areas, 0.9))))  # mm, about the largest between samples
        self.triangle, weights = _sample_triangles(scan, spacing)  # (S,) that each sample lies on
        self.samples = np.einsum("sk,ski->si", weights, self._corners[self.triangle])  # (S, 3) mm, surface frame
        self.normals = normals_at(scan, self.triangle, weights)  # (S, 3)
        self.tree = cKDTree(self.samples)
        # (T, 3) whether the side opposite each corner is an open edge
        sides = np.sort(scan.triangles[:, [[1, 2], [2, 0], [0, 1]]], axis=2)
        edges, count = open_edges(scan), len(scan.vertices)
        self._open = np.isin(sides[..., 0] * count + sides[..., 1], edges[:, 0] * count + edges[:, 1])
        self._rim = np.isin(scan.triangles, edges)  # (T, 3) whether each corner is

    def closest(self, points: Array) -> ClosestPoints:
        """Nearest points of the scan to points (N, 3)."""
        triangle, weights = self._scene.closest(points)
        nearest = np.einsum("nk,nki->ni", weights, self._corners[triangle])
        beside = (weights < RIM_WEIGHT) & self._open[triangle]
        rim = np.any(beside | ((weights > 1 - RIM_WEIGHT) & self._rim[triangle]), axis=1)
        return ClosestPoints(nearest, normals_at(self.scan, triangle, weights), rim)


def _sample_triangles(scan: Scan, spacing: float) -> tuple[Index, Array]:
    """Triangles (S,) and barycentric weights (S, 3) of samples about `spacing` apart: centres of sub-triangles."""
    corners = scan.corners
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    divisions = np.clip(np.ceil(longest / (1.5 * spacing)).astype(int), 1, _MAX_DIVISIONS)
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
