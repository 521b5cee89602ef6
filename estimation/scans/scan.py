"""A scan of the surface, a triangle mesh in the surface frame: where rays meet it, and its nearest points."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial import cKDTree

from estimation.se3 import Array, Index, Mask, inverse, transform_points

MIN_INCIDENCE = 0.1  # cosine of ray and normal: no landmark is seen more from the side
_EDGE_SLACK = 1e-9  # barycentric, so that no ray slips through between two triangles
SAMPLE_COUNT = 15_000  # about so many spread over the scan; a 100 x 100 mm scan gets one every 0.8 mm
CANDIDATE_SAMPLES = 8  # whose triangles may hold the nearest point
_MAX_DIVISIONS = 24  # of a triangle's side


@dataclass(frozen=True, slots=True, eq=False)
class Scan:
    """A triangle mesh without duplicated vertices."""

    vertices: Array  # (V, 3) mm, surface frame
    triangles: Index  # (T, 3) numbers of vertices, anticlockwise as seen from outside
    normals: Array  # (V, 3) unit, out of the surface, the mean of the triangles around, weighted by area

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


@dataclass(frozen=True, slots=True, eq=False)
class Hits:
    """Where N rays first meet the scan."""

    points: Array  # (N, 3) mm, surface frame; NaN without a hit
    normals: Array  # (N, 3) unit, likewise
    hit: Mask  # (N,)


def cast_rays(scan: Scan, surface_from_camera: Array, directions: Array) -> Hits:
    """Where rays (N, 3), camera frame, first meet the scan, on either side; all within 80 degrees of their mean.

    Only triangles whose picture on a plane across the mean ray covers the ray's are tried (Moeller and Trumbore 1997).
    They are looked up by their circles, octave by octave, so that a few large triangles do not slow the small ones.
    """
    miss = np.full((len(directions), 3), np.nan)
    if not len(directions) or not len(scan.triangles):
        return Hits(miss, miss.copy(), np.zeros(len(directions), bool))
    corners = transform_points(inverse(surface_from_camera), scan.vertices)[scan.triangles]  # (T, 3, 3) camera frame
    ray, triangle = _candidates(corners, directions)
    depth, weights = _meet(corners[triangle], directions[ray])
    keep = np.flatnonzero(np.isfinite(depth))
    keep = keep[np.argsort(depth[keep], kind="stable")]
    first_ray, first = np.unique(ray[keep], return_index=True)
    chosen = keep[first]
    points, normals = miss, miss.copy()
    hits = depth[chosen, None] * directions[first_ray]
    points[first_ray] = transform_points(surface_from_camera, hits)
    normals[first_ray] = normals_at(scan, triangle[chosen], weights[chosen])
    return Hits(points, normals, np.isfinite(points[:, 0]))


def foot_jacobians(rays: Array, normals: Array) -> tuple[Array, Array]:
    """How the foot of each ray (N, 3), from the camera, moves along the plane with unit normal (N, 3) that it meets.

    (N, 3, 3) by a shift of the ray, and (N, 3) by a shift of the plane along its normal.
    """
    along = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    slope = np.einsum("ni,ni->n", along, normals)
    slope = np.where(np.abs(slope) < MIN_INCIDENCE, -MIN_INCIDENCE, slope)
    return np.eye(3) - along[:, :, None] * normals[:, None] / slope[:, None, None], along / slope[:, None]


def _meet(corners: Array, directions: Array) -> tuple[Array, Array]:
    """Distances (M,) to triangles (M, 3, 3), in lengths of `directions` (M, 3), NaN for a miss; barycentric weights."""
    # Moeller and Trumbore, Fast, Minimum Storage Ray/Triangle Intersection, 1997
    a = corners[:, 0]
    ab, ac = corners[:, 1] - a, corners[:, 2] - a
    p, q = np.cross(directions, ac), np.cross(-a, ab)
    with np.errstate(divide="ignore", invalid="ignore"):
        scale = 1 / np.einsum("mi,mi->m", ab, p)
        u = np.einsum("mi,mi->m", -a, p) * scale
        v = np.einsum("mi,mi->m", directions, q) * scale
        t = np.einsum("mi,mi->m", ac, q) * scale
        inside = (u >= -_EDGE_SLACK) & (v >= -_EDGE_SLACK) & (u + v <= 1 + _EDGE_SLACK) & (t > 0)
    return np.where(inside, t, np.nan), np.column_stack([1 - u - v, u, v])


def _candidates(corners: Array, directions: Array) -> tuple[Index, Index]:
    """Pairs (M,) of ray and triangle (T, 3, 3), camera frame, that may meet."""
    across = _across(directions)
    flat = directions @ across[:, :2] / (directions @ across[:, 2:])  # (N, 2) on a plane one unit away
    turned = corners @ across
    front = turned[..., 2] > 1e-6 * np.abs(turned).max()
    whole = np.flatnonzero(front.all(1))  # the others reach behind the camera: tried against every ray
    odd = np.flatnonzero(front.any(1) & ~front.all(1))
    pictures = turned[whole, :, :2] / turned[whole, :, 2:]  # (W, 3, 2)
    low, high = pictures.min(1), pictures.max(1)
    centres, radii = (low + high) / 2, np.linalg.norm(high - low, axis=1) / 2
    rays = [np.repeat(np.arange(len(flat)), len(odd))]
    triangles = [np.tile(odd, len(flat))]
    tree = cKDTree(flat)
    for octave in np.unique(np.frexp(radii)[1]):
        some = np.flatnonzero(np.frexp(radii)[1] == octave)
        near = tree.query_ball_tree(cKDTree(centres[some]), float(np.ldexp(1.0, octave)) * (1 + 1e-9))
        rays.append(np.repeat(np.arange(len(flat)), [len(f) for f in near]))
        triangles.append(whole[some[np.array([t for f in near for t in f], np.int64)]])
    return np.concatenate(rays), np.concatenate(triangles)


def _across(directions: Array) -> Array:
    """Rotation (3, 3) whose last column is the mean ray."""
    unit = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    z = unit.mean(0) / np.linalg.norm(unit.mean(0))
    assert (unit @ z).min() > 0.17, "rays of one camera stand within 80 degrees of their mean"
    x = np.cross(np.eye(3)[np.argmin(np.abs(z))], z)
    x /= np.linalg.norm(x)
    return np.column_stack([x, np.cross(z, x), z])


@dataclass(frozen=True, slots=True, eq=False)
class ClosestPoints:
    """Nearest points of a scan."""

    points: Array  # (N, 3) mm, surface frame
    normals: Array  # (N, 3) unit
    rim: Mask  # (N,) whether on an open edge


class ScanIndex:
    """A scan made ready for many queries, by samples spread over its triangles, at least one on each."""

    def __init__(self, scan: Scan) -> None:
        self.scan, self._corners, areas = scan, scan.corners, face_areas(scan)
        spacing = float(np.sqrt(areas.sum() / SAMPLE_COUNT))
        self.spacing = max(spacing, float(np.sqrt(np.quantile(areas, 0.9))))  # mm, about the largest between samples
        self.triangle, weights = _spread(scan, spacing)  # (S,) that each sample lies on
        self.samples = np.einsum("sk,ski->si", weights, self._corners[self.triangle])  # (S, 3) mm, surface frame
        self.normals = normals_at(scan, self.triangle, weights)  # (S, 3)
        self.tree = cKDTree(self.samples)
        # (T, 3) whether the side opposite each corner is an open edge
        sides = np.sort(scan.triangles[:, [[1, 2], [2, 0], [0, 1]]], axis=2)
        edges, count = open_edges(scan), len(scan.vertices)
        self._open = np.isin(sides[..., 0] * count + sides[..., 1], edges[:, 0] * count + edges[:, 1])

    def closest(self, points: Array) -> ClosestPoints:
        """Nearest points of the scan to points (N, 3), on the triangles of the nearest samples."""
        count = min(CANDIDATE_SAMPLES, len(self.samples))
        _, near = self.tree.query(points, k=count)
        triangle = self.triangle[near.reshape(len(points), count)]  # (N, K)
        corners = self._corners[triangle.ravel()]
        weights = closest_weights(np.repeat(points, count, axis=0), corners)
        nearest = np.einsum("mk,mki->mi", weights, corners).reshape(len(points), count, 3)
        best = np.argmin(np.linalg.norm(nearest - points[:, None], axis=2), axis=1)
        row = np.arange(len(points))
        chosen, weight = triangle[row, best], weights.reshape(len(points), count, 3)[row, best]
        rim = ((weight < 1e-9) & self._open[chosen]).any(axis=1)
        return ClosestPoints(nearest[row, best], normals_at(self.scan, chosen, weight), rim)


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
