"""How lively the surface moves: the density of white-noise acceleration that its recent motion is most likely under.

A hand waves a thousand times livelier than a chest; a prior tuned to one drags or shakes on the other. So a bank of
constant-velocity Kalman filters runs beside the window, one for each density of a grid, and those that predicted the
last measurements best say which density the window is to reckon with (multiple-model estimation; Magill 1965).
"""

from __future__ import annotations

import numpy as np

from estimation.runtime import compiled
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
        filters = self._off, self._rate, self._var, self._cross, self._rate_var
        keep = float(np.exp(-seconds / MEMORY))
        _advance(self._grid, self._score, *filters, moved, variance.copy(), float(seconds), keep)


@compiled(f"void({', '.join(['f8[:,::1]'] * 7)}, f8[::1], f8[::1], f8, f8)")
def _advance(
    grid: Array,
    score: Array,
    off: Array,
    rate: Array,
    var: Array,
    cross: Array,
    rate_var: Array,
    moved: Array,
    variance: Array,
    dt: float,
    keep: float,
) -> None:
    """Predict all filters (6, K) by dt, s, score them by the pose that was measured, and update them, in place."""
    for i in range(grid.shape[0]):
        for k in range(grid.shape[1]):
            q = grid[i, k]
            ahead = off[i, k] + rate[i, k] * dt - moved[i]  # predicted minus measured
            spread = var[i, k] + 2 * dt * cross[i, k] + dt**2 * rate_var[i, k] + q * dt**3 / 3
            both = cross[i, k] + dt * rate_var[i, k] + q * dt**2 / 2
            total = spread + variance[i]
            one = -0.5 * (np.log(total) + (TAILS + 1) * np.log1p(ahead**2 / (TAILS * total)))
            score[i, k] = keep * score[i, k] + one
            gain, gain_rate = spread / total, both / total
            off[i, k], rate[i, k] = ahead * (1 - gain), rate[i, k] - gain_rate * ahead
            rate_var[i, k] += q * dt - gain_rate * both
            var[i, k], cross[i, k] = spread * (1 - gain), both * (1 - gain)
