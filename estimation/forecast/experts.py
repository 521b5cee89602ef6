"""Recursive least squares that stays well: in information form, with a forgetting factor and a ridge."""

from __future__ import annotations

import numpy as np
from scipy.linalg.blas import dger, dsyr
from scipy.linalg.lapack import dposv

from estimation.se3 import Array


class Regression:
    """Linear regression of K outputs on N shared inputs, learned sample by sample.

    The sums are forgotten, the ridge is not: without excitation the coefficients go to zero instead of the covariance
    winding up, and what is solved is positive definite by construction, after hours as after a second.
    """

    def __init__(self, inputs: int, outputs: int, memory: float) -> None:
        """memory: samples over which a sample's weight falls to 1/e."""
        self.coefficients = np.zeros((inputs, outputs))
        self._keep = float(np.exp(-1 / memory))
        self._square = np.zeros((inputs, inputs), order="F")  # upper triangle
        self._product = np.zeros((inputs, outputs), order="F")

    def __call__(self, inputs: Array) -> Array:
        """Outputs (K,) expected of inputs (N,)."""
        return np.asarray(inputs @ self.coefficients)

    def learn(self, inputs: Array, outputs: Array, weight: float) -> None:
        """Take a sample: inputs (N,), outputs (K,). Coefficients change at the next `solve` only."""
        self._square *= self._keep
        self._product *= self._keep
        dsyr(weight, inputs, a=self._square, overwrite_a=1)
        dger(weight, inputs, outputs, a=self._product, overwrite_a=1)

    def solve(self, ridge: float) -> None:
        """Bring the coefficients up to date. ridge: variance of the noise over that of a coefficient, beforehand."""
        square = self._square.copy(order="F")
        square[np.diag_indices(len(square))] += ridge
        _, solved, failed = dposv(square, self._product, lower=0, overwrite_a=1)
        if not failed and np.isfinite(solved).all():
            self.coefficients = solved
