"""What a fit's covariance is made of: tracks, what cameras share, and the map's joint error."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estimation.observations import Observations
from estimation.online.deformation import WarpFilter
from estimation.online.pose_solver import EFFICIENCY, GATE, PoseFit, Shared
from estimation.se3 import Array
from estimation.surface_map import SurfaceMap
from estimation.track_loops import pulls

CLAIMED = 20.0  # residuals as which the sigmas claimed count
LEAST_SLOPE = 0.1  # of the weights' sum: with less of it most tracks are outliers, and the rest tells nothing


@dataclass(frozen=True, slots=True, eq=False)
class FitCovariance:
    """The parts (6, 6) of a fit's covariance. noise: new in every frame set; lasting: what map and deformation add.

    smear: what late exposures make of the motion, new in every frame set too. scatter: variance of the tracks in parts
    of what is claimed of them. tracks: (6, 6), the part of `noise` that they have as claimed. late: (6, C), how far
    a second's delay of each camera takes the pose. bias: (6, 2C), how far a pixel's shift of each camera's image,
    rights, then downs by turns, takes it.
    """

    noise: Array
    smear: Array
    lasting: Array
    scatter: float
    tracks: Array
    late: Array
    bias: Array


class MapError:
    """The part of a map's joint covariance that the tracks in use touch.

    All of it is megabytes, and to read them every frame took longer than the fit; the landmarks in use change slowly.
    """

    ROOM = 1.5  # times the landmarks in use, that may be held before the block is cut anew

    def __init__(self, surface_map: SurfaceMap) -> None:
        count = len(surface_map)
        self._whole = surface_map.covariance.reshape(count, 3, count, 3)
        self._position = np.full(count, -1)
        self._block = np.zeros((0, 0))

    def through(self, rows: NDArray[np.int64], pull: Array) -> Array:
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


def scatter(seen: Observations, solution: PoseFit) -> float:
    """Variance of the tracks in parts of what is claimed of them, as the residuals of one fit show it.

    The variance of the estimating equations over their slope (Huber 1981, 6.8), as a part of what it is for normal
    errors of the size claimed. Tracks of clean pictures are two or three times better than they claim, and where some
    are worse without being outliers, their weights alone would say too little. What is claimed counts as some tracks.
    """
    root = seen.sigma * solution.scale
    square = (solution.residuals**2).sum(1) / root**2
    used = solution.weights > 0
    weight = (1 + square[used] / GATE**2) ** -2
    told = weight.sum() * 2 - 6
    if told <= 0:
        return 1.0
    slope = float(np.mean(weight * (1 - 2 * square[used] / (GATE**2 + square[used]))))
    if slope <= LEAST_SLOPE:
        return 1.0
    pull = float(np.mean(weight**2 * square[used])) / 2 * (2 * weight.sum() / told)
    found = EFFICIENCY * float(weight.mean()) * pull / slope**2
    return float((CLAIMED + told * found) / (CLAIMED + told))


def fit_covariance(
    seen: Observations,
    solution: PoseFit,
    shared: Shared,
    map_error: MapError,
    warp: WarpFilter | None,
) -> FitCovariance:
    """The covariance of a pose that was fitted to what was `seen`, by its parts."""
    information = solution.information + 1e-9 * np.eye(6) * np.trace(solution.information)
    noise = np.linalg.pinv(information, hermitian=True)
    weight = EFFICIENCY * solution.weights / (seen.sigma * solution.scale) ** 2
    rows, landmark = np.unique(seen.track, return_inverse=True)
    cameras = len(shared.shift)
    camera = np.ascontiguousarray(seen.camera)
    by_landmark, by_camera = pulls(cameras, len(rows), camera, landmark, solution.jacobians, weight, shared.twist)
    lasting = map_error.through(rows, by_landmark)
    if warp is not None:
        weighted = solution.jacobians * weight[:, None, None]
        lasting = lasting + warp.pull(seen.track, weighted, solution.jacobians[:, :, 3:])
    late, bias = noise @ by_camera[:, 0], noise @ by_camera[:, 1:].swapaxes(1, 2).reshape(6, -1)
    new, stays = noise + (bias * np.repeat(shared.shift, 2)) @ bias.T, noise @ lasting @ noise
    return FitCovariance(new, late @ shared.delay @ late.T, stays, scatter(seen, solution), noise, late, bias)
