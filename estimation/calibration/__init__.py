"""Covariances that keep what they claim: shape from recent errors, size from how often they were left.

The size follows the share of errors outside (Gibbs and Candes 2021, adaptive conformal inference, on its logarithm): in
the long run the share holds whatever the errors' distribution. The last second's errors against the usual ones widen or
narrow it at once, so that an irregular breath or a cough is not paid for by all quiet ones.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from estimation import se3
from estimation.forecast import radius
from estimation.se3 import Array

SHARE = 0.9
MEMORY = 300.0  # samples, for the shape
RECENT = 10.0  # samples, for how lively it is just now
RATE = 0.08  # of the size's logarithm, per sample
SOON = 10  # samples, before which nothing is usual
MOST = 100.0  # times the usual square of an error: one blunder is not more


class Intervals:
    """Covariances (H, 6, 6) of errors of H horizons, calibrated while they are used."""

    def __init__(self, horizons: int, points: Array) -> None:
        """points: (N, 3), in the errors' own scale, at which errors are judged."""
        self._at = np.concatenate([-se3.hat(points), np.broadcast_to(np.eye(3), (len(points), 3, 3))], -1)  # (N, 3, 6)
        self._mean = np.einsum("nij,nik->jk", self._at, self._at) / len(points)
        self._shape = np.tile(np.eye(6) * 1e-6, (horizons, 1, 1))
        self._seen, self._size, self._lively = np.zeros(horizons), np.zeros(horizons), np.ones(horizons)

    def __call__(self) -> tuple[Array, Array]:
        """The covariances (H, 6, 6) now, and the radii (H, N) that they claim at the points."""
        lively = 0.5 + 0.25 * (self._lively + self._lively[0])
        spread = self._shape * (lively * np.exp(2 * self._size))[:, None, None]
        return spread, radius(self._at @ spread[:, None] @ np.swapaxes(self._at, 1, 2), SHARE)

    def learn(self, k: NDArray[np.int64], error: Array, claimed: Array) -> None:
        """Take errors (K, 6) of horizons k (K,), each once, and the radii (K, N) that were claimed for them."""
        squares = ((self._at @ error[:, None, :, None])[..., 0] ** 2).sum(-1)  # (K, N)
        outside = (squares > claimed**2).mean(1)
        usual = (self._shape[k] * self._mean).sum((1, 2))
        self._seen[k] = np.minimum(self._seen[k] + 1, MEMORY)
        settled = self._seen[k] > SOON
        ratio = np.where(settled, np.minimum(squares.mean(1) / np.maximum(usual, 1e-12), MOST), 1.0)
        self._lively[k] += (ratio - self._lively[k]) / RECENT
        self._shape[k] += (error[:, :, None] * error[:, None] - self._shape[k]) / self._seen[k][:, None, None]
        self._size[k] += np.where(settled, RATE * (outside - (1 - SHARE)), 0.0)
