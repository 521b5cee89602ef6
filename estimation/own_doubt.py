"""Landmarks whose own place is known worse than a track: they count the less, the farther off they may be imaged.

A landmark that one camera alone has seen stands exactly on that camera's ray and anywhere along it: in that camera it
counts in full, in another next to nothing until it is known better.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from estimation.se3 import Array
from estimation.surface_map import SurfaceMap

VAGUE = 0.3  # mm along some direction: landmarks of two cameras are better known, those of one alone are not


class OwnDoubt:
    """What single landmarks of one map add to the sigmas of their tracks."""

    def __init__(self, surface_map: SurfaceMap) -> None:
        count = len(surface_map)
        blocks = np.einsum("ninj->nij", surface_map.covariance.reshape(count, 3, count, 3))
        self._vague = np.linalg.eigvalsh(blocks)[:, -1] > VAGUE**2
        self._blocks = np.where(self._vague[:, None, None], blocks, 0.0)

    def widened(self, sigma: Array, track: NDArray[np.int64], jacobians: Array) -> Array:
        """The sigmas (N,) px with it. track: (N,) rows of the map. jacobians: (N, 2, 6) px by the pose."""
        rows = np.flatnonzero(self._vague[track])
        if not len(rows):
            return sigma
        by_point, wide = jacobians[rows, :, 3:], sigma.copy()
        square = np.einsum("mki,mij,mkj->m", by_point, self._blocks[track[rows]], by_point) / 2  # of one axis
        wide[rows] = np.sqrt(sigma[rows] ** 2 + square)
        return wide
