"""Corners cut so short that the nozzle need not slow down for them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from estimation.se3 import Array
from planning.fill.bead import Bead
from planning.fill.pace import SHARP, turning

ROUNDS = 4  # each halves the turns: a reversal is eased in four
MARGIN = 0.95  # of SHARP, so that rounding of numbers decides nothing


def eased(bead: Bead, reach: float) -> Bead:
    """The same bead with each sharp corner cut, `reach` mm before and after it or less where its sides are short."""
    lines = np.column_stack([bead.points, bead.width])
    for _ in range(ROUNDS):
        sharp = (turning(lines[:, :2]) > MARGIN * SHARP).nonzero()[0] + 1
        if not len(sharp):
            break
        lines = _cut(lines, sharp, reach)
        reach /= 2
    return Bead(lines[:, :2], lines[:, 2])


def _cut(lines: Array, corner: NDArray[np.intp], reach: float) -> Array:
    """Lines (N, 3) with two points instead of each corner (C,), equally far from it so that each turns half as much."""
    here = lines[corner]
    back, on = lines[corner - 1] - here, lines[corner + 1] - here
    far_back, far_on = np.hypot(back[:, 0], back[:, 1]), np.hypot(on[:, 0], on[:, 1])
    cut = np.minimum(reach, 0.4 * np.minimum(far_back, far_on))
    times = np.ones(len(lines), int)
    times[corner] = 2
    found = np.repeat(lines, times, axis=0)
    place = corner + np.arange(len(corner))
    found[place] = here + (cut / np.maximum(far_back, 1e-12))[:, None] * back
    found[place + 1] = here + (cut / np.maximum(far_on, 1e-12))[:, None] * on
    return found
