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

    def at(self, along: Array) -> Array:
        """x, y and width (M, 3) at lengths (M,) mm from the start; its ends beyond them."""
        length = np.concatenate([[0.0], np.cumsum(self.steps)])
        return np.stack([np.interp(along, length, values) for values in (*self.points.T, self.width)], axis=1)

    def between(self, start: float, end: float) -> Bead:
        """The stretch from one length to another, mm from the start."""
        length = np.concatenate([[0.0], np.cumsum(self.steps)])
        inner = length[(length > start + SAME) & (length < end - SAME)]
        found = self.at(np.concatenate([[start], inner, [end]]))
        return Bead(found[:, :2], found[:, 2])

    def turned(self, start: float) -> Bead:
        """A closed bead that begins and ends at `start` mm from its start instead."""
        a, b = self.between(start, self.length), self.between(0.0, start)
        if start < SAME or start > self.length - SAME:
            return self
        return Bead(np.concatenate([a.points, b.points[1:]]), np.concatenate([a.width, b.width[1:]]))


def even(points: Array, width: float) -> Bead:
    """A bead of one width, mm, through points (N, 2)."""
    return Bead(points, np.full(len(points), width))
