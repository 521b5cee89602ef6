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
        sharp = np.flatnonzero(turning(lines[:, :2]) > MARGIN * SHARP) + 1
        if not len(sharp):
            break
        lines = _cut(lines, sharp, reach)
        reach /= 2
    return Bead(lines[:, :2], lines[:, 2])


def _cut(lines: Array, corner: NDArray[np.intp], reach: float) -> Array:
    """Lines (N, 3) with two points instead of each corner (C,), equally far from it so that each turns half as much."""
    to = [lines[corner + way] - lines[corner] for way in (-1, 1)]
    far = [np.linalg.norm(side[:, :2], axis=1) for side in to]
    cut = np.minimum(reach, 0.4 * np.minimum(*far))
    before, after = (
        lines[corner] + (cut / np.maximum(length, 1e-12))[:, None] * side for side, length in zip(to, far, strict=True)
    )
    lines = lines.copy()
    lines[corner] = before
    return np.insert(lines, corner + 1, after, axis=0)
