"""Stacking: the weights of several predictions of one thing, by ridge regression over their recent errors."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from estimation.se3 import Array

MEMORY = 100.0  # samples, over which errors count
BELIEF = 3.0  # samples that the weights beforehand are worth
PRESENCE = np.array([0.3] * 3 + [1.0] * 3)  # of turns beside shifts: at the lever they are the noisier


class Stack:
    """Weights (H, E) of E experts for each of H horizons (Breiman 1996, made recursive)."""

    def __init__(self, horizons: int, prior: Array) -> None:
        """prior: (E,) the weights beforehand."""
        experts = len(prior)
        self.weights: Array = np.tile(prior, (horizons, 1))
        self._belief = BELIEF * np.eye(experts), BELIEF * prior
        self._square, self._product = np.zeros((horizons, experts, experts)), np.zeros((horizons, experts))
        self._size, self._seen = np.zeros(horizons), np.zeros(horizons)
        self._keep = float(np.exp(-1 / MEMORY))

    def __call__(self, experts: Array) -> Array:
        """The combined prediction (H, 6) of experts' (H, E, 6)."""
        return np.asarray((self.weights[:, :, None] * experts).sum(1))

    def learn(self, k: NDArray[np.int64], experts: Array, truth: Array) -> None:
        """Take what the experts (K, E, 6) said of horizons k (K,), each once, and the truth (K, 6)."""
        self._seen[k] = np.minimum(self._seen[k] + 1, 2 * MEMORY)
        self._size[k] += ((truth**2).sum(1) - self._size[k]) / self._seen[k]
        weighted = experts * (PRESENCE / np.maximum(self._size[k], 1e-12)[:, None])[:, None]
        self._square[k] = self._keep * self._square[k] + weighted @ np.swapaxes(experts, 1, 2)
        self._product[k] = self._keep * self._product[k] + (weighted @ truth[:, :, None])[..., 0]
        square, product = self._square + self._belief[0], self._product + self._belief[1]
        self.weights = np.asarray(np.linalg.solve(square, product[..., None])[..., 0], np.float64)
