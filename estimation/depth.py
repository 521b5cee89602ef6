"""Landmarks refined look by look: as the surface turns under a camera, two of its instants are two views."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from estimation.se3 import Array
from estimation.surface_map import SurfaceMap

ASTRAY = 16.0  # squared sigmas, over two axes: what fits no better is another spot; one in three thousand by chance


def looked_at(
    surface_map: SurfaceMap,
    track: NDArray[np.int64],
    residuals: Array,
    jacobians: Array,
    sigma: Array,
    pose_covariance: Array,
) -> tuple[SurfaceMap, NDArray[np.bool_]]:
    """The map after a look at some of its landmarks from known poses, and which looks (M,) agree with it.

    One joint Kalman update: the landmarks' errors are correlated, and all looks share the pose's. track: (M,) rows,
    residuals: (M, 2) px, predicted minus seen, jacobians: (M, 2, 6) by the pose, sigma: (M,) px. pose_covariance:
    (6, 6).
    """
    count, looks = len(surface_map), len(track)
    if not looks:
        return surface_map, np.zeros(0, bool)
    by_map = np.zeros((looks, 2, count, 3))
    by_map[np.arange(looks), :, track] = jacobians[:, :, 3:]
    design = by_map.reshape(2 * looks, -1)
    by_pose = jacobians.reshape(-1, 6)
    noise = by_pose @ pose_covariance @ by_pose.T + np.diag(np.repeat(sigma**2, 2))
    across = surface_map.covariance @ design.T
    spread = design @ across + noise
    agrees = _agreeing(residuals, spread)
    kept = np.repeat(agrees, 2)
    gain = np.linalg.solve(spread[np.ix_(kept, kept)], across[:, kept].T).T
    covariance = surface_map.covariance - gain @ across[:, kept].T
    points = surface_map.points - (gain @ residuals[agrees].ravel()).reshape(-1, 3)
    return SurfaceMap(points, surface_map.normals, (covariance + covariance.T) / 2), agrees


def _agreeing(residuals: Array, spread: Array) -> NDArray[np.bool_]:
    """Which residuals (M, 2) px their own covariance, blocks of `spread` (2M, 2M), explains."""
    count = len(residuals)
    own = np.einsum("minj->mnij", spread.reshape(count, 2, count, 2))[np.arange(count), np.arange(count)]
    return np.asarray(np.einsum("mi,mij,mj->m", residuals, np.linalg.inv(own), residuals) < ASTRAY)
