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
        x, y = (self.points[1:] - self.points[:-1]).T
        return np.asarray(np.sqrt(x * x + y * y))

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

    @property
    def along(self) -> Array:
        """Length (N,) mm from the start to each point."""
        return np.concatenate([[0.0], np.cumsum(self.steps)])

    def at(self, along: Array) -> Array:
        """x, y and width (M, 3) at lengths (M,) mm from the start; its ends beyond them."""
        length = self.along
        return np.stack([np.interp(along, length, values) for values in (*self.points.T, self.width)], axis=1)

    def between(self, start: float, end: float) -> Bead:
        """The stretch from one length to another, mm from the start."""
        length = self.along
        a, b = np.searchsorted(length, [start + SAME, end - SAME])
        ends = self.at(np.array([start, end]))
        lines = np.concatenate([ends[:1], np.column_stack([self.points[a:b], self.width[a:b]]), ends[1:]])
        return Bead(lines[:, :2], lines[:, 2])

    def turned(self, start: float) -> Bead:
        """A closed bead that begins and ends at `start` mm from its start instead."""
        length = self.along
        if start < SAME or start > length[-1] - SAME:
            return self
        a, b = np.searchsorted(length, [start - SAME, start + SAME])
        here, lines = self.at(np.array([start])), np.column_stack([self.points, self.width])
        lines = np.concatenate([here, lines[b:], lines[1:a], here])
        return Bead(lines[:, :2], lines[:, 2])


def even(points: Array, width: float) -> Bead:
    """A bead of one width, mm, through points (N, 2)."""
    return Bead(points, np.full(len(points), width))
