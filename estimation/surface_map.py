"""The stored map of the surface: landmarks in the surface frame, against which every frame is matched."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from estimation import se3
from estimation.se3 import Array


@dataclass(frozen=True, slots=True, eq=False)
class SurfaceMap:
    """Landmarks as parallel arrays; a landmark's row is the id of its track.

    points: (N, 3) mm, normals: (N, 3) unit, out of the surface, both in the surface frame. covariance: (3N, 3N) mm^2,
    joint.
    """

    points: Array
    normals: Array
    covariance: Array

    def __len__(self) -> int:
        return len(self.points)


def moved_map(surface_map: SurfaceMap, new_from_old: Array) -> SurfaceMap:
    """The same map in another surface frame: new_from_old (4, 4)."""
    turn, count = new_from_old[:3, :3], len(surface_map)
    covariance = surface_map.covariance.reshape(count, 3, count, 3)
    turned = np.einsum("ai,minj,bj->manb", turn, covariance, turn, optimize=True).reshape(3 * count, 3 * count)
    points = se3.transform_points(new_from_old, surface_map.points)
    return SurfaceMap(points, surface_map.normals @ turn.T, turned)


def joined_map(first: SurfaceMap, second: SurfaceMap) -> SurfaceMap:
    """Both maps, of one surface frame, as one; their errors are taken as independent."""
    n, m = 3 * len(first), 3 * len(second)
    covariance = np.zeros((n + m, n + m))
    covariance[:n, :n], covariance[n:, n:] = first.covariance, second.covariance
    points = np.concatenate([first.points, second.points])
    return SurfaceMap(points, np.concatenate([first.normals, second.normals]), covariance)


def motion_of(points: Array) -> Array:
    """How points (N, 3) move, (3N, 6), with a right perturbation of their frame's pose, per rad and mm."""
    each = np.concatenate([-se3.hat(points), np.broadcast_to(np.eye(3), (len(points), 3, 3))], -1)
    return np.asarray(each.reshape(-1, 6))


def local_normals(points: Array, outward: Array, neighbours: int = 12) -> Array:
    """Unit normals (N, 3) of points (N, 3) by a plane through each one's nearest neighbours, on the side of `outward`.

    outward: (3,) or (N, 3), a rough direction out of the surface, the same frame. Where the neighbours lie on a line or
    scatter in depth, the normal leans towards that of all points: it is a prior for the patches, not a measurement.
    """
    k = min(neighbours, len(points))
    _, index = cKDTree(points).query(points, k=k)
    spread = points[index] - points[index].mean(1, keepdims=True)  # (N, k, 3)
    local = np.swapaxes(spread, 1, 2) @ spread / k
    centred = points - points.mean(0)
    whole = centred.T @ centred / len(points)
    normals = np.linalg.eigh(local + 0.02 * whole)[1][:, :, 0]
    sign = np.sign(np.einsum("ni,ni->n", normals, np.broadcast_to(outward, normals.shape)))
    return np.asarray(normals * np.where(sign == 0, 1.0, sign)[:, None])


def surface_frame(points_base: Array, towards: Array, right: Array) -> Array:
    """base_from_surface (4, 4) for a surface without a scan: origin at the points' centroid, z out of the surface.

    points_base: (N, 3) mm. towards: (3,), a point on the outer side (the cameras' centre). right: (3,), the direction
    that x follows as far as the surface's plane allows.
    """
    centroid = np.median(points_base, axis=0)
    centred = points_base - centroid
    near = centred[np.linalg.norm(centred, axis=1) <= 2.5 * np.median(np.linalg.norm(centred, axis=1))]
    z = np.linalg.eigh(near.T @ near)[1][:, 0]
    z = z if z @ (towards - centroid) > 0 else -z
    x = right - z * (z @ right)
    x = x if np.linalg.norm(x) > 1e-3 else np.cross([0.0, 1.0, 0.0], z)
    x = x / np.linalg.norm(x)
    return se3.make(np.stack([x, np.cross(z, x), z], axis=1), near.mean(0) + centroid)
