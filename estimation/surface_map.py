"""Records of the surface: landmark map, warp of soft tissue, local position errors, and dense heights on a lattice."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from estimation import se3
from estimation.se3 import Array, Index

INVERSE_STEPS = 4  # steps of the inverse: each leaves a share as large as the strain, a few hundredths
UNCERTAIN_MM = 0.3  # along some direction: landmarks of two cameras are better known, those of one alone are not


@dataclass(frozen=True, slots=True, eq=False)
class SurfaceMap:
    """N landmarks in the surface frame as parallel arrays; a landmark's row is the id of its track."""

    points: Array  # (N, 3) mm
    normals: Array  # (N, 3) unit, out of the surface
    covariance: Array  # (3N, 3N) mm^2, joint

    def __len__(self) -> int:
        return len(self.points)


class MapError:
    """A map's joint covariance: its part in the pose's covariance, and in the sigmas of single tracks.

    The joint covariance takes megabytes, and reading it every frame took longer than the fit. The landmarks in use
    change slowly, so their block is cached.
    """

    MAX_BLOCK_RATIO = 1.5  # landmarks in the cached block to landmarks in use, above which the block is cut anew

    def __init__(self, surface_map: SurfaceMap) -> None:
        count = len(surface_map)
        self._joint = surface_map.covariance.reshape(count, 3, count, 3)
        self._block_row = np.full(count, -1)  # of each landmark in the block
        self._block = np.zeros((0, 0))
        own_blocks = np.einsum("ninj->nij", self._joint)
        self._uncertain = np.linalg.eigvalsh(own_blocks)[:, -1] > UNCERTAIN_MM**2
        self._own_blocks = np.where(self._uncertain[:, None, None], own_blocks, 0.0)

    def pose_covariance(self, rows: Index, gradients: Array) -> Array:
        """Covariance (6, 6) of a pose with derivatives (6, K, 3) by the landmarks of rows (K,), ascending."""
        if (self._block_row[rows] < 0).any() or len(self._block) > 3 * self.MAX_BLOCK_RATIO * len(rows):
            block_rows = np.union1d(rows, np.flatnonzero(self._block_row >= 0))
            block_rows = block_rows if len(block_rows) < self.MAX_BLOCK_RATIO * len(rows) else rows
            self._block_row[:] = -1
            self._block_row[block_rows] = np.arange(len(block_rows))
            self._block = self._joint[block_rows][:, :, block_rows].reshape(3 * len(block_rows), -1)
        in_block = np.zeros((6, len(self._block) // 3, 3))
        in_block[:, self._block_row[rows]] = gradients
        flat = in_block.reshape(6, -1)
        return np.asarray(flat @ self._block @ flat.T)

    def inflate_sigmas(self, sigma: Array, track: Index, jacobians: Array) -> Array:
        """Sigmas (N,) px of tracks that include the error of their own landmark, where that is UNCERTAIN_MM or more.

        A landmark of one camera alone lies on that camera's ray, at an unknown depth. Its track keeps its weight in
        that camera and has nearly none in another one until the depth is known.

        sigma: (N,) px of the tracks. track: (N,) rows of the map. jacobians: (N, 2, 6) px by the pose.
        """
        uncertain = np.flatnonzero(self._uncertain[track])
        if not len(uncertain):
            return sigma
        point_jacobians, inflated = jacobians[uncertain, :, 3:], sigma.copy()
        variance = (
            np.einsum("mki,mij,mkj->m", point_jacobians, self._own_blocks[track[uncertain]], point_jacobians) / 2
        )  # of one axis
        inflated[uncertain] = np.sqrt(sigma[uncertain] ** 2 + variance)
        return inflated


def transform_map(surface_map: SurfaceMap, new_from_old: Array) -> SurfaceMap:
    """The same map in another surface frame: new_from_old (4, 4)."""
    rotation, count = new_from_old[:3, :3], len(surface_map)
    covariance = surface_map.covariance.reshape(count, 3, count, 3)
    rotated = np.einsum("ai,minj,bj->manb", rotation, covariance, rotation, optimize=True).reshape(3 * count, 3 * count)
    points = se3.transform_points(new_from_old, surface_map.points)
    return SurfaceMap(points, surface_map.normals @ rotation.T, rotated)


def merge_maps(first: SurfaceMap, second: SurfaceMap) -> SurfaceMap:
    """One map of both, which have the same surface frame; their errors are taken as independent."""
    n, m = 3 * len(first), 3 * len(second)
    covariance = np.zeros((n + m, n + m))
    covariance[:n, :n], covariance[n:, n:] = first.covariance, second.covariance
    points = np.concatenate([first.points, second.points])
    return SurfaceMap(points, np.concatenate([first.normals, second.normals]), covariance)


def local_normals(points: Array, outward: Array, neighbours: int = 12) -> Array:
    """Unit normals (N, 3) of points (N, 3): of a plane through each point's nearest neighbours.

    outward: (3,) or (N, 3), a rough direction out of the surface, which gives the sign. Where the neighbours lie on a
    line or scatter in depth, the normal leans towards that of all points.
    """
    from scipy.spatial import cKDTree  # processes that only pass poses on need none of it

    k = min(neighbours, len(points))
    _, index = cKDTree(points).query(points, k=k)
    offsets = points[index] - points[index].mean(1, keepdims=True)  # (N, k, 3)
    local_scatter = np.swapaxes(offsets, 1, 2) @ offsets / k
    centred = points - points.mean(0)
    global_scatter = centred.T @ centred / len(points)
    normals = np.linalg.eigh(local_scatter + 0.02 * global_scatter)[1][:, :, 0]
    sign = np.sign(np.einsum("ni,ni->n", normals, np.broadcast_to(outward, normals.shape)))
    return np.asarray(normals * np.where(sign == 0, 1.0, sign)[:, None])


def farthest_points(points: Array, first: int, count: int, min_distance: float = -1.0) -> Index:
    """Rows of up to `count` points (N, 3): `first`, then each the farthest from those before, beyond `min_distance`."""
    chosen, distance = [first], np.linalg.norm(points - points[first], axis=1)
    while len(chosen) < count:
        farthest = int(np.argmax(distance))
        if distance[farthest] <= min_distance:
            break
        chosen.append(farthest)
        distance = np.minimum(distance, np.linalg.norm(points - points[farthest], axis=1))
    return np.array(chosen)


def surface_frame(points_base: Array, towards: Array, right: Array) -> Array:
    """base_from_surface (4, 4) for a surface without a scan: origin at the points' centroid, z out of the surface.

    points_base: (N, 3) mm. towards: (3,), a point on the outer side (the cameras' centre). right: (3,), the direction
    that x follows as far as the surface's plane allows.
    """
    centroid = np.median(points_base, axis=0)
    centred = points_base - centroid
    inliers = centred[np.linalg.norm(centred, axis=1) <= 2.5 * np.median(np.linalg.norm(centred, axis=1))]
    z = np.linalg.eigh(inliers.T @ inliers)[1][:, 0]
    z = z if z @ (towards - centroid) > 0 else -z
    x = right - z * (z @ right)
    x = x if np.linalg.norm(x) > 1e-3 else np.cross([0.0, 1.0, 0.0], z)
    x = x / np.linalg.norm(x)
    return se3.make(np.stack([x, np.cross(z, x), z], axis=1), inliers.mean(0) + centroid)


@dataclass(frozen=True, slots=True, eq=False)
class Warp:
    """Displacement field of soft tissue, beside the rigid motion of the pose: Gaussian bells about K control points.

    It is smooth and falls to zero outside the mapped surface. Its rigid part over the landmarks is zero, so pose and
    warp share no motion.
    """

    control: Array  # (K, 3) mm, surface frame
    coefficients: Array  # (K, 3) mm, of the bell about each control point
    covariance: Array  # (3K, 3K) mm^2 of the coefficients, row by row
    growth: Array  # (3K, 3K) mm^2/s, growth of the covariance without measurements
    reach: float  # mm, one sigma of a bell
    deformation: float  # mm, root mean square displacement of the landmarks
    deformation_sigma: float  # mm

    def propagate(self, seconds: float) -> Warp:
        """The warp `seconds` s from its stamp, before or after: same shape, larger covariance."""
        return replace(self, covariance=self.covariance + abs(seconds) * self.growth)

    def displacement(self, points: Array) -> Array:
        """Displacements (N, 3) mm of points (N, 3) of the undeformed surface."""
        return np.asarray(bells(points, self.control, self.reach) @ self.coefficients)

    def apply(self, points: Array) -> Array:
        """Points (N, 3) mm of the undeformed surface, displaced."""
        return np.asarray(points + self.displacement(points))

    def undo(self, points: Array) -> Array:
        """Inverse of `apply`: points (N, 3) mm of the undeformed surface, by fixed-point iteration."""
        rest = points
        for _ in range(INVERSE_STEPS):
            rest = points - self.displacement(rest)
        return np.asarray(rest)

    def apply_to_poses(self, transforms: Array) -> Array:
        """Poses (N, 4, 4) on the undeformed surface, moved and turned with the tissue."""
        positions = transforms[:, :3, 3]
        weights = bells(positions, self.control, self.reach)
        gradients = -weights[..., None] * (positions[:, None] - self.control) / self.reach**2  # (N, K, 3)
        # half the curl of the displacement: the polar decomposition of its gradient, to first order
        rotation = 0.5 * se3.cross(gradients, self.coefficients).sum(1)
        return se3.make(se3.exp_rotation(rotation) @ transforms[:, :3, :3], positions + weights @ self.coefficients)

    def undo_on_poses(self, transforms: Array) -> Array:
        """Inverse of `apply_to_poses`: poses (N, 4, 4) on the undeformed surface."""
        rest = se3.make(transforms[:, :3, :3], self.undo(transforms[:, :3, 3]))
        rotations = self.apply_to_poses(rest)[:, :3, :3] @ np.swapaxes(rest[:, :3, :3], -1, -2)
        return se3.make(np.swapaxes(rotations, -1, -2) @ transforms[:, :3, :3], rest[:, :3, 3])

    def displacement_covariance(self, points: Array) -> Array:
        """Covariance (N, 3, 3), mm^2, of the displacement of points (N, 3)."""
        weights = bells(points, self.control, self.reach)
        count = len(self.control)
        weighted = (weights @ self.covariance.reshape(count, -1)).reshape(-1, 3, count, 3)
        return np.asarray((weights[:, None, None] @ weighted)[:, :, 0])  # matrix products: einsum plans each call anew


@dataclass(frozen=True, slots=True, eq=False)
class LocalError:
    """Additional position error of single places, where the tissue may have moved by itself."""

    centres: Array  # (K, 3) mm, surface frame, of the bells
    variance: Array  # (K,) mm^2 at the centre, along every direction
    growth: Array  # (K,) mm^2/s, growth of the variance without measurements
    reach: Array  # (K,) mm, of each bell, which is zero from twice that on
    support: Array  # (S, 3) mm, landmarks that were measured
    span: float  # mm from the nearest supporting landmark, within which a place moves with it
    unsupported: float  # mm^2, variance at twice that distance and beyond; everywhere without any support

    def add_bells(self, centres: Array, variance: float | Array, reach: float) -> LocalError:
        """Further bells about centres (K, 3) mm; variance: mm^2, one or (K,); reach: mm."""
        ones = np.ones(len(centres))
        return replace(
            self,
            centres=np.concatenate([self.centres, centres]),
            variance=np.append(self.variance, variance * ones),
            growth=np.append(self.growth, 0 * ones),
            reach=np.append(self.reach, reach * ones),
        )

    def propagate(self, seconds: float) -> LocalError:
        """The errors `seconds` s from their stamp, before or after."""
        return replace(self, variance=self.variance + abs(seconds) * self.growth)

    def variance_at(self, points: Array) -> Array:
        """Variance (N,), mm^2, along every direction, of points (N, 3): the larger of bells and missing support."""
        squares = ((points[:, None] - self.centres) ** 2).sum(-1)
        by_bells = (np.maximum(1 - squares / (2 * self.reach) ** 2, 0.0) * self.variance).max(1, initial=0.0)
        distance = np.sqrt(((points[:, None] - self.support) ** 2).sum(-1).min(1, initial=np.inf))
        return np.asarray(np.maximum(by_bells, self.unsupported * np.clip(distance / self.span - 1.0, 0.0, 1.0)))


def bells(points: Array, control: Array, reach: float | Array) -> Array:
    """Gaussian bells (N, K) about control points (K, 3) at points (N, 3); reach: one sigma, mm, one or (K,)."""
    square = ((points[:, None] - control) ** 2).sum(-1)
    return np.asarray(np.exp(-square / (2 * reach**2)))


@dataclass(frozen=True, slots=True, eq=False)
class SurfaceHeights:
    """Heights over a square lattice of the surface frame, measured densely; NaN where not measured."""

    low: Array  # (2,) mm, x and y of the first node
    step: float  # mm between nodes
    heights: Array  # (H, W) mm along z, rows along y
    sigma: Array  # (H, W) mm

    @property
    def nodes(self) -> Array:
        """x and y (H, W, 2) of the nodes, mm."""
        rows, columns = self.heights.shape
        x, y = (self.low[k] + self.step * np.arange(n) for k, n in ((0, columns), (1, rows)))
        return np.stack(np.meshgrid(x, y), -1)
