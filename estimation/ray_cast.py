"""Where rays meet a scan: map points from pixels."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from estimation.scan import Index, Scan, normals_at
from estimation.se3 import Array, inverse, transform_points

GRAZING = 0.1  # cosine of ray and normal: no landmark is seen more from the side
_RIM = 1e-9  # barycentric slack, so that no ray slips through between two triangles


@dataclass(frozen=True, slots=True, eq=False)
class Hits:
    """Where rays first meet the scan. points, normals: (N, 3), surface frame, mm; NaN where hit (N,) is False."""

    points: Array
    normals: Array
    hit: NDArray[np.bool_]


def points_on_scan(scan: Scan, surface_from_camera: Array, directions: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Points (N, 3) mm, surface frame, where rays from the camera first meet the scan, and whether they do (N,).

    directions: (N, 3), camera frame, of any length, all within 80 degrees of their mean; see `cast`.
    """
    hits = cast(scan, surface_from_camera, directions)
    return hits.points, hits.hit


def cast(scan: Scan, surface_from_camera: Array, directions: Array) -> Hits:
    """Where rays (N, 3), camera frame, first meet the scan, on either side of it.

    Only triangles whose picture on a plane across the mean ray covers the ray's are tried (Moeller and Trumbore 1997);
    they are looked up by their circles, octave by octave, so that a few large triangles do not slow the small ones.
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
    met = depth[chosen, None] * directions[first_ray]
    points[first_ray] = transform_points(surface_from_camera, met)
    normals[first_ray] = normals_at(scan, triangle[chosen], weights[chosen])
    return Hits(points, normals, np.isfinite(points[:, 0]))


def feet(rays: Array, normals: Array) -> tuple[Array, Array]:
    """How the foot of each ray (N, 3), from the camera, moves along the plane with unit normal (N, 3) that it meets.

    (N, 3, 3) with a shift of the ray, and (N, 3) with a shift of the plane along its normal.
    """
    along = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    slope = np.einsum("ni,ni->n", along, normals)
    slope = np.where(np.abs(slope) < GRAZING, -GRAZING, slope)
    return np.eye(3) - along[:, :, None] * normals[:, None] / slope[:, None, None], along / slope[:, None]


def _meet(corners: Array, directions: Array) -> tuple[Array, Array]:
    """Distance (M,) in lengths of `directions` (M, 3) from the origin to triangles (M, 3, 3), NaN for a miss, and
    barycentric weights (M, 3) (Moeller and Trumbore, Fast, Minimum Storage Ray/Triangle Intersection, 1997)."""
    a = corners[:, 0]
    ab, ac = corners[:, 1] - a, corners[:, 2] - a
    p, q = np.cross(directions, ac), np.cross(-a, ab)
    with np.errstate(divide="ignore", invalid="ignore"):
        scale = 1 / np.einsum("mi,mi->m", ab, p)
        u = np.einsum("mi,mi->m", -a, p) * scale
        v = np.einsum("mi,mi->m", directions, q) * scale
        t = np.einsum("mi,mi->m", ac, q) * scale
        inside = (u >= -_RIM) & (v >= -_RIM) & (u + v <= 1 + _RIM) & (t > 0)
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
        found = tree.query_ball_tree(cKDTree(centres[some]), float(np.ldexp(1.0, octave)) * (1 + 1e-9))
        rays.append(np.repeat(np.arange(len(flat)), [len(f) for f in found]))
        triangles.append(whole[some[np.array([t for f in found for t in f], np.int64)]])
    return np.concatenate(rays), np.concatenate(triangles)


def _across(directions: Array) -> Array:
    """Rotation (3, 3) whose last column is the mean ray."""
    unit = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    z = unit.mean(0) / np.linalg.norm(unit.mean(0))
    assert (unit @ z).min() > 0.17, "rays of one camera stand within 80 degrees of their mean"
    x = np.cross(np.eye(3)[np.argmin(np.abs(z))], z)
    x /= np.linalg.norm(x)
    return np.column_stack([x, np.cross(z, x), z])
