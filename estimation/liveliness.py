"""How lively the surface moves: the density of white-noise acceleration that its recent motion is most likely under.

A hand waves a thousand times livelier than a chest; a prior tuned to one drags or shakes on the other. So a bank of
constant-velocity Kalman filters runs beside the window, one for each density of a grid, and those that predicted the
last measurements best say which density the window is to reckon with (multiple-model estimation; Magill 1965).
"""

from __future__ import annotations

import numpy as np

from estimation.se3 import Array

STEP = 10**0.5  # between densities of the grid: closer ones cannot be told apart in a second
ROTATION = 1e-7 * STEP ** np.arange(18)  # rad^2/s^3, from a surface at rest to a shaken one
TRANSLATION = 1e-2 * STEP ** np.arange(18)  # mm^2/s^3
MEMORY = 1.0  # s: over which a density is judged
TAILS = 4.0  # degrees of freedom of Student's t: a single jerk is not a lively motion, ten in a second are
UNKNOWN = 100.0  # rad/s and mm/s, standard deviation of a velocity before anything is known of it


class Liveliness:
    """Follows the spectral density of the acceleration, axis by axis: a chest is lively along its normal only."""

    def __init__(self) -> None:
        self._grid = np.stack([ROTATION] * 3 + [TRANSLATION] * 3)  # (6, K)
        self._score = np.zeros_like(self._grid)  # log likelihoods
        self.restart()

    def restart(self) -> None:
        """Begin with an unknown velocity, as after an outage; the densities' scores stay."""
        shape = self._grid.shape
        self._off, self._rate = np.zeros(shape), np.zeros(shape)  # of the last measured pose: what the filters made
        self._var, self._cross, self._rate_var = np.full(shape, np.inf), np.zeros(shape), np.full(shape, UNKNOWN**2)

    @property
    def psd(self) -> Array:
        """(6,) rad^2/s^3 and mm^2/s^3: the mean of the densities under their likelihoods."""
        weight = np.exp(self._score - self._score.max(1, keepdims=True))
        weight = weight / weight.sum(1, keepdims=True)
        return np.asarray((weight * self._grid).sum(1))

    def add(self, moved: Array, seconds: float, variance: Array) -> None:
        """Take a measured pose: moved (6,) from the measured pose before it, variance (6,) of the new one."""
        if np.isinf(self._var).any():
            self._var = np.tile(variance[:, None], (1, self._grid.shape[1]))
        dt, q, r = seconds, self._grid, variance[:, None]
        ahead = self._off + self._rate * dt - moved[:, None]  # predicted minus measured
        var = self._var + 2 * dt * self._cross + dt**2 * self._rate_var + q * dt**3 / 3
        cross = self._cross + dt * self._rate_var + q * dt**2 / 2
        rate_var = self._rate_var + q * dt
        total = var + r
        one = -0.5 * (np.log(total) + (TAILS + 1) * np.log1p(ahead**2 / (TAILS * total)))
        keep = np.exp(-dt / MEMORY)
        self._score = keep * self._score + one
        gain, gain_rate = var / total, cross / total
        self._off, self._rate = ahead * (1 - gain), self._rate - gain_rate * ahead
        self._var, self._cross, self._rate_var = var * (1 - gain), cross * (1 - gain), rate_var - gain_rate * cross
