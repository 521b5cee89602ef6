"""A bead: one extruded run in the plane."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from estimation.se3 import Array

SAME = 1e-9  # mm: two points nearer are one


@dataclass(frozen=True, slots=True, eq=False)
class Bead:
    """One run of the nozzle without a stop of the flow.

    points: (N, 2) mm, N >= 2; a closed run repeats its first point. width: (N,) mm, of the line laid at each point,
    linear between them.
    """

    points: Array
    width: Array

    @property
    def closed(self) -> bool:
        """Whether it ends where it began."""
        return len(self.points) > 3 and bool(np.abs(self.points[0] - self.points[-1]).max() < SAME)

    @property
    def steps(self) -> Array:
        """Lengths (N-1,) mm from point to point."""
        return np.asarray(np.linalg.norm(np.diff(self.points, axis=0), axis=1))

    @property
    def length(self) -> float:
        """The whole length, mm."""
        return float(self.steps.sum())

    @property
    def laid(self) -> float:
        """Area of its material, mm2: length times width."""
        return float(self.steps @ (self.width[:-1] + self.width[1:]) / 2)

    @property
    def reversed(self) -> Bead:
        """The same bead from its other end."""
        return Bead(self.points[::-1], self.width[::-1])

    def begun_at(self, start: int) -> Bead:
        """A closed bead that begins and ends at its point number `start` instead."""
        return Bead(_turned(self.points, start), _turned(self.width, start))


def even(points: Array, width: float) -> Bead:
    """A bead of one width, mm, through points (N, 2)."""
    return Bead(points, np.full(len(points), width))


def _turned(values: Array, start: int) -> Array:
    return np.concatenate([values[start:-1], values[: start + 1]])
