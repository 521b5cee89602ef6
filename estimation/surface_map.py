"""The map of landmarks against which each frame set is matched, the warp of soft tissue, and what places may err by.

Beside it what the surface itself is where it was measured densely: heights on a lattice of the surface frame.
"""

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
    """A map's joint covariance: as it reaches the pose, and as it widens the sigmas of single tracks.

    The whole is megabytes, and reading it every frame took longer than the fit. The landmarks in use change slowly, so
    a block of theirs is kept.
    """

    MAX_BLOCK_RATIO = 1.5  # times the landmarks in use, that the block may hold before it is cut anew

    def __init__(self, surface_map: SurfaceMap) -> None:
        count = len(surface_map)
        self._whole = surface_map.covariance.reshape(count, 3, count, 3)
        self._position = np.full(count, -1)  # of each landmark in the block
        self._block = np.zeros((0, 0))
        own = np.einsum("ninj->nij", self._whole)
        self._uncertain = np.linalg.eigvalsh(own)[:, -1] > UNCERTAIN_MM**2
        self._own = np.where(self._uncertain[:, None, None], own, 0.0)

    def reaching_pose(self, rows: Index, pull: Array) -> Array:
        """Covariance (6, 6) of the sum of the landmarks' pulls (6, K, 3), of rows (K,), ascending."""
        if (self._position[rows] < 0).any() or len(self._block) > 3 * self.MAX_BLOCK_RATIO * len(rows):
            held = np.union1d(rows, np.flatnonzero(self._position >= 0))
            held = held if len(held) < self.MAX_BLOCK_RATIO * len(rows) else rows
            self._position[:] = -1
            self._position[held] = np.arange(len(held))
            self._block = self._whole[held][:, :, held].reshape(3 * len(held), -1)
        spread = np.zeros((6, len(self._block) // 3, 3))
        spread[:, self._position[rows]] = pull
        flat = spread.reshape(6, -1)
        return np.asarray(flat @ self._block @ flat.T)

    def widened(self, sigma: Array, track: Index, jacobians: Array) -> Array:
        """Sigmas (N,) px of tracks with the error of their own landmark, where that is UNCERTAIN_MM or more.

        A landmark that one camera alone has seen lies exactly on that camera's ray, and anywhere along it. In that
        camera it counts in full, in another next to nothing until it is known better. track: (N,) rows of the map.
        jacobians: (N, 2, 6) px by the pose.
        """
        rows = np.flatnonzero(self._uncertain[track])
        if not len(rows):
            return sigma
        by_point, wide = jacobians[rows, :, 3:], sigma.copy()
        square = np.einsum("mki,mij,mkj->m", by_point, self._own[track[rows]], by_point) / 2  # of one axis
        wide[rows] = np.sqrt(sigma[rows] ** 2 + square)
        return wide


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


def local_normals(points: Array, outward: Array, neighbours: int = 12) -> Array:
    """Unit normals (N, 3) of points (N, 3) by a plane through each one's nearest neighbours, on the side of `outward`.

    outward: (3,) or (N, 3), a rough direction out of the surface, the same frame. Where the neighbours lie on a line or
    scatter in depth, the normal leans towards that of all points.
    """
    from scipy.spatial import cKDTree  # processes that only pass poses on need none of it

    k = min(neighbours, len(points))
    _, index = cKDTree(points).query(points, k=k)
    spread = points[index] - points[index].mean(1, keepdims=True)  # (N, k, 3)
    local = np.swapaxes(spread, 1, 2) @ spread / k
    centred = points - points.mean(0)
    whole = centred.T @ centred / len(points)
    normals = np.linalg.eigh(local + 0.02 * whole)[1][:, :, 0]
    sign = np.sign(np.einsum("ni,ni->n", normals, np.broadcast_to(outward, normals.shape)))
    return np.asarray(normals * np.where(sign == 0, 1.0, sign)[:, None])


def farthest_points(points: Array, first: int, count: int, nearest: float = -1.0) -> Index:
    """Rows of up to `count` points (N, 3): `first`, then each the farthest from those before, beyond `nearest`."""
    chosen, distance = [first], np.linalg.norm(points - points[first], axis=1)
    while len(chosen) < count:
        farthest = int(np.argmax(distance))
        if distance[farthest] <= nearest:
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
    near = centred[np.linalg.norm(centred, axis=1) <= 2.5 * np.median(np.linalg.norm(centred, axis=1))]
    z = np.linalg.eigh(near.T @ near)[1][:, 0]
    z = z if z @ (towards - centroid) > 0 else -z
    x = right - z * (z @ right)
    x = x if np.linalg.norm(x) > 1e-3 else np.cross([0.0, 1.0, 0.0], z)
    x = x / np.linalg.norm(x)
    return se3.make(np.stack([x, np.cross(z, x), z], axis=1), near.mean(0) + centroid)


@dataclass(frozen=True, slots=True, eq=False)
class Warp:
    """Displacement field of soft tissue from the rigid body that the pose describes.

    A sum of Gaussian bells about K control points, so it is smooth, exact to differentiate and dies away beside the
    mapped surface. Its rigid part over the landmarks is zero: pose and warp do not share a motion.
    """

    control: Array  # (K, 3) mm, surface frame
    coefficients: Array  # (K, 3) mm, of the bell about each control point
    covariance: Array  # (3K, 3K) mm^2 of the coefficients, row by row
    growth: Array  # (3K, 3K) mm^2/s, by which that grows unseen
    reach: float  # mm, one sigma of a bell
    deformation: float  # mm, root mean square displacement of the landmarks
    deformation_sigma: float  # mm

    def later(self, seconds: float) -> Warp:
        """The same shape with its covariance `seconds` s from its stamp, before or after."""
        return replace(self, covariance=self.covariance + abs(seconds) * self.growth)

    def displacement(self, points: Array) -> Array:
        """Displacements (N, 3) mm of points (N, 3) of the undeformed surface."""
        return np.asarray(bells(points, self.control, self.reach) @ self.coefficients)

    def apply(self, points: Array) -> Array:
        """Points (N, 3) mm of the undeformed surface, displaced."""
        return np.asarray(points + self.displacement(points))

    def undo(self, points: Array) -> Array:
        """Points (N, 3) mm of the undeformed surface that the warp moves to points (N, 3)."""
        rest = points
        for _ in range(INVERSE_STEPS):
            rest = points - self.displacement(rest)
        return np.asarray(rest)

    def carry(self, transforms: Array) -> Array:
        """Poses (N, 4, 4) on the undeformed surface, moved and turned with the tissue."""
        places = transforms[:, :3, 3]
        bell = bells(places, self.control, self.reach)
        slope = -bell[..., None] * (places[:, None] - self.control) / self.reach**2  # (N, K, 3)
        # half the curl of the displacement: the polar decomposition of its gradient, to first order
        turn = 0.5 * se3.cross(slope, self.coefficients).sum(1)
        return se3.make(se3.exp_rotation(turn) @ transforms[:, :3, :3], places + bell @ self.coefficients)

    def uncarry(self, transforms: Array) -> Array:
        """Poses (N, 4, 4) on the undeformed surface that are carried to `transforms` (N, 4, 4)."""
        rest = se3.make(transforms[:, :3, :3], self.undo(transforms[:, :3, 3]))
        turned = self.carry(rest)[:, :3, :3] @ np.swapaxes(rest[:, :3, :3], -1, -2)
        return se3.make(np.swapaxes(turned, -1, -2) @ transforms[:, :3, :3], rest[:, :3, 3])

    def spread(self, points: Array) -> Array:
        """Covariance (N, 3, 3), mm^2, of the displacement of points (N, 3)."""
        bell = bells(points, self.control, self.reach)
        count = len(self.control)
        weighted = (bell @ self.covariance.reshape(count, -1)).reshape(-1, 3, count, 3)
        return np.asarray((bell[:, None, None] @ weighted)[:, :, 0])  # matrix products: einsum plans each call anew


@dataclass(frozen=True, slots=True, eq=False)
class LocalError:
    """By how much single places may be off beside the pose's own error: the tissue there may have moved by itself."""

    centres: Array  # (K, 3) mm, surface frame, each the middle of a bell
    variance: Array  # (K,) mm^2 there, along every direction
    growth: Array  # (K,) mm^2/s, by which that grows unseen
    reach: Array  # (K,) mm, of each bell: it ends at twice that, however far what lies under it may have gone
    support: Array  # (S, 3) mm, where landmarks show that the surface is there
    span: float  # mm from the nearest of them within which a place moves with it
    unsupported: float  # mm^2, at twice that distance and beyond; no support at all: everywhere

    def with_bells(self, centres: Array, variance: float | Array, reach: float) -> LocalError:
        """The same with further bells about centres (K, 3), of one variance, mm^2, or (K,), and one reach, mm."""
        every = np.ones(len(centres))
        return replace(
            self,
            centres=np.concatenate([self.centres, centres]),
            variance=np.append(self.variance, variance * every),
            growth=np.append(self.growth, 0 * every),
            reach=np.append(self.reach, reach * every),
        )

    def later(self, seconds: float) -> LocalError:
        """The same `seconds` s from its stamp, before or after."""
        return replace(self, variance=self.variance + abs(seconds) * self.growth)

    def variance_at(self, points: Array) -> Array:
        """Variance (N,), mm^2, along every direction, of points (N, 3): by bells or support, the larger."""
        square = ((points[:, None] - self.centres) ** 2).sum(-1)
        by_bells = (np.maximum(1 - square / (2 * self.reach) ** 2, 0.0) * self.variance).max(1, initial=0.0)
        away = np.sqrt(((points[:, None] - self.support) ** 2).sum(-1).min(1, initial=np.inf))
        return np.asarray(np.maximum(by_bells, self.unsupported * np.clip(away / self.span - 1.0, 0.0, 1.0)))


def bells(points: Array, control: Array, reach: float | Array) -> Array:
    """Value (N, K) at points (N, 3) of the bell about each control point (K, 3), of one sigma `reach`, mm (or (K,))."""
    square = ((points[:, None] - control) ** 2).sum(-1)
    return np.asarray(np.exp(-square / (2 * reach**2)))


@dataclass(frozen=True, slots=True, eq=False)
class SurfaceHeights:
    """The surface over the nodes of a square lattice in the surface frame; NaN where it was not measured."""

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
