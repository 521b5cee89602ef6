"""How many beads fit into a place, and how wide they may be."""

from __future__ import annotations

from dataclasses import dataclass

from planning.fill.pattern import Pattern

PAIR = 0.75  # spacings: radius from which two beads are laid: one would be half as wide again as nominal


@dataclass(frozen=True, slots=True)
class Fit:
    """All in mm. spacing: of closed lines. one, two: radius from which one bead fits, and from which two do.

    most: how wide a bead may be.
    """

    spacing: float
    one: float
    two: float
    most: float

    @property
    def three(self) -> float:
        """Radius from which a third bead fits between two: two share less."""
        return self.spacing + self.one


def fit_of(pattern: Pattern) -> Fit:
    """What a pattern's nozzle fits; overlap lets neighbours lie closer, not the nozzle lay less."""
    s = pattern.spacing
    return Fit(s, pattern.narrowest * s / 2, min(PAIR, pattern.widest / 2) * s, pattern.widest * s)
