"""The fit to one frame set: its pose, what its covariance is made of, and whether it counts as a measurement."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from estimation.observations import Observations
from estimation.online.deformation import WarpFilter
from estimation.online.pose_solver import EFFICIENCY, GATE, PoseFit, SharedErrors
from estimation.runtime import compiled
from estimation.se3 import Array, Index, Mask
from estimation.surface_map import SurfaceMap

PRIOR_RESIDUALS = 20.0  # residuals as which the sigmas claimed count
MIN_WEIGHT_SLOPE = 0.1  # of the weights' sum: with less of it most tracks are outliers, and the rest tells nothing
UNCERTAIN_MM = 0.3  # along some direction: landmarks of two cameras are better known, those of one alone are not


@dataclass(frozen=True, slots=True, eq=False)
class FitCovariance:
    """The parts of a fit's covariance, all of the right perturbation, and what they follow from."""

    noise: Array  # (6, 6), new in every frame set: tracks and shifts of whole images
    smear: Array  # (6, 6), new in every frame set: late exposures of a moving surface
    lasting: Array  # (6, 6), the same for many frame sets: errors of map and deformation
    scatter: float  # variance of the tracks, in parts of what is claimed of them
    tracks: Array  # (6, 6), the tracks' part of `noise`, as claimed
    late: Array  # (6, C), change of the pose by a second's delay of each camera
    bias: Array  # (6, 2C), change of the pose by a pixel's shift of each image: right and down of camera 0, 1, ...


@dataclass(frozen=True, slots=True, eq=False)
class FrameFit:
    """A fit to one frame set of C cameras, and whether it is a measurement."""

    stamp: float  # s
    solution: PoseFit
    parts: FitCovariance
    twist: Array  # (6,) velocity by which the cameras' instants were brought together
    twist_variance: Array  # (6,)
    inlier: Mask  # (N,) tracks
    used: Index  # (C,) inliers
    reason: str  # why it is no measurement, or ''
    off: Array  # (C,) px by which each camera stands off the pose, nan where it does not see the surface
    allowed: Array  # (C,) px, one sigma of that
    odd: frozenset[int] = frozenset()  # cameras that were left out

    @property
    def measured(self) -> bool:
        """Whether the fit may enter the window."""
        return not self.reason

    @property
    def covariance(self) -> Array:
        """(6, 6), of all that is new in this frame set."""
        return self.parts.noise + self.parts.smear

    @property
    def clear(self) -> float:
        """The part, 0 to 1, of the squared velocity in the images that is not the velocity's own noise."""
        weighted = self.solution.jacobians * np.sqrt(self.solution.weights)[:, None, None]
        noise = float((weighted**2).sum((0, 1)) @ self.twist_variance)
        whole = float(((weighted @ self.twist) ** 2).sum())
        return max(0.0, 1 - noise / whole) if whole > 0 else 0.0


def failed_fit(seen: Observations, start: Array, cameras: int, reason: str, odd: frozenset[int]) -> FrameFit:
    """No measurement of what was `seen` by a rig of so many cameras: the pose stays `start` (4, 4)."""
    count, zero, off = len(seen), np.zeros((6, 6)), np.full(cameras, np.nan)
    late, bias = np.zeros((6, cameras)), np.zeros((6, 2 * cameras))
    return FrameFit(
        seen.stamp,
        PoseFit(start, zero, np.zeros((count, 2)), np.zeros(count), np.zeros((count, 2, 6)), 1.0),
        FitCovariance(np.full((6, 6), np.inf), zero, zero, scatter=1.0, tracks=zero, late=late, bias=bias),
        twist=np.zeros(6),
        twist_variance=np.zeros(6),
        inlier=np.zeros(count, bool),
        used=np.zeros(cameras, np.int64),
        reason=reason,
        off=off,
        allowed=off,
        odd=odd,
    )


class MapError:
    """The part of a map's joint covariance that the tracks in use touch.

    The whole is megabytes, and reading it every frame took longer than the fit. The landmarks in use change slowly.
    """

    ROOM = 1.5  # times the landmarks in use, that may be held before the block is cut anew

    def __init__(self, surface_map: SurfaceMap) -> None:
        count = len(surface_map)
        self._whole = surface_map.covariance.reshape(count, 3, count, 3)
        self._position = np.full(count, -1)
        self._block = np.zeros((0, 0))

    def through(self, rows: Index, pull: Array) -> Array:
        """Covariance (6, 6) of the sum of the landmarks' pulls (6, K, 3), of rows (K,), ascending."""
        if (self._position[rows] < 0).any() or len(self._block) > 3 * self.ROOM * len(rows):
            held = np.union1d(rows, np.flatnonzero(self._position >= 0))
            held = held if len(held) < self.ROOM * len(rows) else rows
            self._position[:] = -1
            self._position[held] = np.arange(len(held))
            self._block = self._whole[held][:, :, held].reshape(3 * len(held), -1)
        spread = np.zeros((6, len(self._block) // 3, 3))
        spread[:, self._position[rows]] = pull
        flat = spread.reshape(6, -1)
        return np.asarray(flat @ self._block @ flat.T)


class LandmarkUncertainty:
    """Adds the doubt about single landmarks of one map to the sigmas of their tracks.

    A landmark that one camera alone has seen lies exactly on that camera's ray, and anywhere along it. In that camera
    it counts in full, in another next to nothing until it is known better.
    """

    def __init__(self, surface_map: SurfaceMap) -> None:
        count = len(surface_map)
        blocks = np.einsum("ninj->nij", surface_map.covariance.reshape(count, 3, count, 3))
        self._vague = np.linalg.eigvalsh(blocks)[:, -1] > UNCERTAIN_MM**2
        self._blocks = np.where(self._vague[:, None, None], blocks, 0.0)

    def widened(self, sigma: Array, track: Index, jacobians: Array) -> Array:
        """The sigmas (N,) px with it. track: (N,) rows of the map. jacobians: (N, 2, 6) px by the pose."""
        rows = np.flatnonzero(self._vague[track])
        if not len(rows):
            return sigma
        by_point, wide = jacobians[rows, :, 3:], sigma.copy()
        square = np.einsum("mki,mij,mkj->m", by_point, self._blocks[track[rows]], by_point) / 2  # of one axis
        wide[rows] = np.sqrt(sigma[rows] ** 2 + square)
        return wide


def residual_scatter(seen: Observations, solution: PoseFit) -> float:
    """Variance of the tracks in parts of what is claimed of them, by the residuals of one fit.

    The variance of the estimating equations over their slope (Huber 1981, 6.8), as a part of its value for normal
    errors of the size claimed. Tracks of clean pictures are two or three times better than they claim. Where some are
    worse without being outliers, the weights alone would say too little. The claim counts as PRIOR_RESIDUALS.
    """
    root = seen.sigma * solution.scale
    square = (solution.residuals**2).sum(1) / root**2
    used = solution.weights > 0
    weight = (1 + square[used] / GATE**2) ** -2
    freedom = weight.sum() * 2 - 6
    if freedom <= 0:
        return 1.0
    slope = float(np.mean(weight * (1 - 2 * square[used] / (GATE**2 + square[used]))))
    if slope <= MIN_WEIGHT_SLOPE:
        return 1.0
    pull = float(np.mean(weight**2 * square[used])) / 2 * (2 * weight.sum() / freedom)
    ratio = EFFICIENCY * float(weight.mean()) * pull / slope**2
    return float((PRIOR_RESIDUALS + freedom * ratio) / (PRIOR_RESIDUALS + freedom))


def fit_covariance(
    seen: Observations, solution: PoseFit, shared: SharedErrors, map_error: MapError, warp: WarpFilter | None
) -> FitCovariance:
    """The covariance of a pose that was fitted to what was `seen`, by its parts."""
    information = solution.information + 1e-9 * np.eye(6) * np.trace(solution.information)
    noise = np.linalg.pinv(information, hermitian=True)
    weight = EFFICIENCY * solution.weights / (seen.sigma * solution.scale) ** 2
    rows, landmark = np.unique(seen.track, return_inverse=True)
    cameras = len(shared.shift)
    camera = np.ascontiguousarray(seen.camera)
    by_landmark, by_camera = pose_pulls(cameras, len(rows), camera, landmark, solution.jacobians, weight, shared.twist)
    lasting = map_error.through(rows, by_landmark)
    if warp is not None:
        weighted = solution.jacobians * weight[:, None, None]
        lasting = lasting + warp.pull(seen.track, weighted, solution.jacobians[:, :, 3:])
    late, bias = noise @ by_camera[:, 0], noise @ by_camera[:, 1:].swapaxes(1, 2).reshape(6, -1)
    new, stays = noise + (bias * np.repeat(shared.shift, 2)) @ bias.T, noise @ lasting @ noise
    return FitCovariance(new, late @ shared.delay @ late.T, stays, residual_scatter(seen, solution), noise, late, bias)


@compiled("Tuple((f8[:,:,::1], f8[:,:,::1]))(i8, i8, i8[::1], i8[::1], f8[:,:,::1], f8[::1], f8[::1])")
def pose_pulls(
    cameras: int,
    landmarks: int,
    camera: Index,
    landmark: Index,
    jacobian: Array,
    weight: Array,
    twist: Array,
) -> tuple[Array, Array]:
    """How each landmark (6, L, 3), px^-2 per mm, and each camera's delay and shifts (6, 3, C) pull at the pose.

    The pose gives way by its covariance times that. landmark: (N,) below L. The rest as in `gram_by_camera`.
    """
    by_landmark, by_camera = np.zeros((6, landmarks, 3)), np.zeros((6, 3, cameras))
    for i in range(len(camera)):
        for k in range(2):
            row, along = jacobian[i, k], 0.0
            for a in range(6):
                along += row[a] * twist[a]
            for a in range(6):
                weighted = weight[i] * row[a]
                by_camera[a, 0, camera[i]] += weighted * along
                by_camera[a, 1 + k, camera[i]] += weighted
                for b in range(3):
                    by_landmark[a, landmark[i], b] += weighted * row[3 + b]
    return by_landmark, by_camera
