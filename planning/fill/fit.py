"""How many beads fit into a place, and how wide they may be."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from estimation.se3 import Array
from planning.fill.pattern import Pattern

PAIR = 0.75  # spacings: radius from which two beads are laid: one would be half as wide again as nominal


@dataclass(frozen=True, slots=True)
class Fit:
    """All in mm. spacing: of closed lines. one, two: radius from which one bead fits, and from which two do.

    most: how wide a bead may be. outermost: spacing of the outermost closed lines alone.
    """

    spacing: float
    one: float
    two: float
    most: float
    outermost: float

    @property
    def three(self) -> float:
        """Radius from which a third bead fits between two: two share less."""
        return self.spacing + self.one

    def at(self, level: int) -> Fit:
        """What fits at a level of closed lines, 0 the outermost."""
        return self if level else replace(self, spacing=self.outermost)

    def outside(self, level: NDArray[np.intp] | int) -> Array:
        """How thick, mm, all levels outside this one are together."""
        return np.where(np.asarray(level) > 0, self.outermost + self.spacing * (np.asarray(level) - 1), 0.0)

    def level(self, radius: Array) -> NDArray[np.intp]:
        """The level of the innermost lines where discs have this radius; -1 where not even one bead fits."""
        further = np.floor((radius - self.outermost - self.one) / self.spacing).astype(int) + 1
        return np.where(radius < self.one, -1, np.maximum(further, 0))


def fit_of(pattern: Pattern) -> Fit:
    """What a pattern's nozzle fits; overlap lets neighbours lie closer, not the nozzle lay less."""
    s = pattern.spacing
    return Fit(s, pattern.narrowest * s / 2, min(PAIR, pattern.widest / 2) * s, pattern.widest * s, s)
