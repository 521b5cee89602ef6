"""The way through checkpoints as a curve by length: straight between them, each corner a parabola, in turns as well.

A cubic spline through sparse checkpoints was measured to leave the path by 1 mm and to run at 2.7 times the speed limit
in corners. Here corners are blended on purpose (Kunz and Stilman 2012, with parabolas, which serve reversals as well):
the first derivative is continuous and never longer than 1, so speed along the curve bounds the tool's speed everywhere.

The tool's turn is blended over the same length: a parabola times the change of spin, after the stretch's own turn. The
change is fixed in the tool's frame when the tool turns about it, so that the spin itself is continuous, exactly.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estimation import se3
from estimation.se3 import Array
from planning.path import LEVER, lengths_of, steps

EDGE = 1e-9  # mm: so near its ends a blend has begun, as where it ends is known no better
SHORTEST = 1.0  # mm: a horizon in which any printing speed can be stopped


@dataclass(frozen=True, slots=True, eq=False)
class Curve:
    """A way in the surface frame, by length s in mm (turns count too, see path.LEVER).

    knots: (K,) s of the checkpoints, from 0. points: (K, 3) mm. rotations: (K, 3, 3) of the nozzle. direction:
    (K-1, 3) and spin: (K-1, 3), body rad/mm, of each stretch. bend: (K, 3), change of direction, and swing: (K, 3),
    change of spin, at each checkpoint. half: (K,), length of the blend before and after each, 0 where there is none.
    bent, swung: (K, 3), bend and swing over four halves of the blend, 0 where there is none. speed: (K-1,) mm/s allowed
    on each stretch. corner: (K,) mm/s allowed in each blend. due: (K,) s, when each checkpoint is reached at the
    stretches' speeds.
    """

    knots: Array
    points: Array
    rotations: Array
    direction: Array
    spin: Array
    bend: Array
    swing: Array
    half: Array
    bent: Array
    swung: Array
    speed: Array
    corner: Array
    due: Array

    @property
    def length(self) -> float:
        """Its whole length, mm."""
        return float(self.knots[-1])

    def after(self, s: float, seconds: float) -> float:
        """Where one is `seconds` s after s, mm, at the speeds allowed, and at least SHORTEST mm on; at most the end."""
        there = float(np.interp(np.interp(s, self.knots, self.due) + seconds, self.due, self.knots))
        return min(max(there, s + SHORTEST), self.length)

    def stretch(self, s: Array) -> NDArray[np.intp]:
        """Number (...) of the stretch that each s (...) lies on; a checkpoint belongs to the stretch after it."""
        return np.asarray(np.searchsorted(self.knots[1:-1], s, "right"))

    def poses(self, s: Array) -> Array:
        """surface_from_nozzle (N, 4, 4) at s (N,), mm."""
        i = self.stretch(s)
        along = (s - self.knots[i])[:, None]
        into, out_of = self._depths(i, s)
        before, after = np.maximum(into, 0.0) ** 2, np.maximum(out_of, 0.0) ** 2
        turns = self.spin[i] * along, after * self.swung[i] + before * self.swung[i + 1]
        rounding = after * self.bent[i] + before * self.bent[i + 1]
        return se3.make(_turned(self.rotations[i], *turns), self.points[i] + self.direction[i] * along + rounding)

    def derivatives(self, s: Array) -> tuple[Array, Array]:
        """First derivative (N, 3) of the position at s (N,), at most 1 long, and second (N, 3), 1/mm.

        Where the second steps it is the stronger side's.
        """
        i = self.stretch(s)
        into, out_of = self._depths(i, s)
        before, after = 2 * self.bent[i + 1], 2 * self.bent[i]
        first = self.direction[i] + np.maximum(into, 0.0) * before - np.maximum(out_of, 0.0) * after
        return np.asarray(first), np.asarray((into > -EDGE) * before + (out_of > -EDGE) * after)

    def _depths(self, i: NDArray[np.intp], s: Array) -> tuple[Array, Array]:
        """How deep s (N,) is in the blend at the end and at the start of its stretch i, mm (N, 1), negative outside."""
        into, out_of = s - self.knots[i + 1] + self.half[i + 1], self.knots[i] + self.half[i] - s
        return into[:, None], out_of[:, None]


def curve_through(surface_from_nozzle: Array, speed: Array, tolerance: float, swerve: float) -> Curve:
    """The curve through poses (K, 4, 4), no two in a row the same.

    speed: (K-1,) mm/s. tolerance: mm by which corners are cut. swerve: mm/s by which a corner may change the velocity.
    A turn counts as the way of a point LEVER beside the tip.
    """
    points, rotations = surface_from_nozzle[:, :3, 3], surface_from_nozzle[:, :3, :3]
    moves, turns = steps(surface_from_nozzle)
    length = lengths_of(moves, turns)
    direction, spin = moves / length[:, None], turns / length[:, None]
    bend, swing = np.zeros_like(points), np.zeros_like(points)
    bend[1:-1], swing[1:-1] = np.diff(direction, axis=0), np.diff(spin, axis=0)
    turned = np.maximum(np.linalg.norm(bend, axis=1), LEVER * np.linalg.norm(swing, axis=1))
    half = np.zeros(len(points))
    wanted = 4 * tolerance / np.maximum(turned[1:-1], 1e-9)  # the curve passes a corner at |bend| * half / 4
    half[1:-1] = np.where(turned[1:-1] > 1e-9, np.minimum(wanted, np.minimum(length[:-1], length[1:]) / 2), 0.0)
    knots, due = (np.concatenate([[0.0], np.cumsum(along)]) for along in (length, length / speed))
    corner = np.where(half > 0, swerve / np.maximum(turned, 1e-9), np.inf)
    quarter = np.where(half > 0, 0.25 / np.where(half > 0, half, 1.0), 0.0)[:, None]
    blends = bend, swing, half, bend * quarter, swing * quarter
    return Curve(knots, points, rotations, direction, spin, *blends, np.asarray(speed, float), corner, due)


def _turned(rotation: Array, along: Array, within: Array) -> Array:
    """Rotations (N, 3, 3) turned by one body vector (N, 3), rad, and then another; an upright path's cost nothing."""
    if not along.any() and not within.any():
        return rotation
    first, second = se3.exp_rotation(np.stack([along, within]))
    return np.asarray(rotation @ first @ second)
