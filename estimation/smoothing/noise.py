"""What a recording tells of its own noise: the tracks' size, what images share, and how lively the motion is."""

from __future__ import annotations

import numpy as np

from estimation.batch.solve import Equations, Estimate, Pass
from estimation.se3 import Array
from estimation.smoothing.measured import Noise, whitened_squares
from estimation.smoothing.packed import Packed
from estimation.track_loops import MEDIAN

LEAST_UNIT = 0.3  # of what is claimed: better than that no track is believed to be
LEAST_JITTER, LEAST_UNREST = 1e-4, 3e-3  # s, px: no stamp and no lens is steadier
HEAVY = 2.0  # numbers that the whole recording's liveliness counts for where a moment has its own
EAGER = 1.4  # steps of the fixed point, which otherwise comes near slowly
BELIEF = 0.1  # numbers that what was believed before counts for
AROUND = 1  # frame sets to either side over which it is taken
LEAST_PSD = np.array([1e-4] * 3 + [1e-1] * 3)  # rad^2/s^5, mm^2/s^5: less is rest


def unit_of(data: Packed, estimate: Estimate) -> Array:
    """(C,) residuals in parts of what is claimed of them: by the median, so that outliers do not count."""
    square = whitened_squares(data, estimate.states, estimate.cameras, estimate.points, 0, len(data))
    out = np.ones(len(estimate.cameras))
    for c in range(len(out)):
        mine = square[data.camera == c]
        mine = mine[np.isfinite(mine)]
        if len(mine):
            out[c] = max(np.sqrt(np.median(mine) / MEDIAN), LEAST_UNIT)
    return out


def shared_sizes(done: Pass, steps: Array, own: Array, noise: Noise) -> tuple[float, float]:
    """Jitter, s, and unrest, px, of what each camera's tracks share in a frame set, by their evidence.

    steps: (K, 18) that the states are about to take. own: (K, 18, 18) their covariances, the effects' own doubt apart.
    """
    through = np.einsum("kij,kjl,kil->ki", done.follows, own, done.follows, optimize=True)
    n, known = len(noise.unit), noise.own_information()
    apart = np.repeat([max(1 - 1 / n, 1e-6), 1.0], [n, 2 * n])  # of the delays, whose sum is held
    known = known / apart
    effects = done.effects + (done.follows @ steps[..., None])[..., 0]
    told = np.clip(1 - (done.doubts + through) * known, 0.0, 1.0)  # (K, 3C): nothing where the camera was blind
    sizes = []
    for part, least in ((slice(0, n), LEAST_JITTER), (slice(n, 3 * n), LEAST_UNREST)):
        square, count = float((effects[:, part] ** 2).sum()), float(told[:, part].sum())
        before = 1 / known[part.start]
        variance = (square + BELIEF * before) / (count + BELIEF) / apart[part.start]
        sizes.append(max(float(np.sqrt(variance)), least))
    return sizes[0], sizes[1]


def liveliness(equations: Equations, steps: Array, own: Array, after: Array) -> Array:
    """(K - 1, 6) density of the jerk, of each moment as far as it tells, else alike all along.

    The fixed point of the evidence (MacKay, Neural Computation 4:415, 1992), which expectation maximisation needs
    hundreds of passes for. Axes are not taken together: a chest is lively along its normal only.
    """
    square, told = equations.jerks(steps, own, after)
    before = equations.known.psd
    count = told.sum(0)
    ratio = ((square / before).sum(0) + BELIEF) / (count + BELIEF)
    usual = np.exp(np.log(before).mean(0)) * np.clip(ratio**EAGER, 1e-3, 1e3)
    window = np.ones(2 * AROUND + 1)
    near = [np.stack([np.convolve(c, window, mode="same") for c in a.T], axis=1) for a in (square, told)]
    return np.asarray(np.maximum((near[0] + HEAVY * usual) / (near[1] + HEAVY), LEAST_PSD))
