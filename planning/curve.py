"""The way through checkpoints as a curve by length: straight between them, each corner a parabola, in turns as well.

A cubic spline through sparse checkpoints was measured to leave the path by 1 mm and to run at 2.7 times the speed limit
in corners. Here corners are blended on purpose (Kunz and Stilman 2012, with parabolas, which serve reversals as well):
the first derivative is continuous and never longer than 1, so speed along the curve bounds the tool's speed everywhere.

The tool's turn is blended over the same length: a parabola times the change of spin, after the stretch's own turn. The
change is fixed in the tool's frame when the tool turns about it, so that the spin itself is continuous, exactly.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimation import se3
from estimation.se3 import Array
from planning.path import LEVER, lengths

SHORTEST = 1.0  # mm: a horizon in which any printing speed can be stopped


@dataclass(frozen=True, slots=True, eq=False)
class Curve:
    """A way in the surface frame, by length s in mm (turns count too, see path.LEVER).

    knots: (K,) s of the checkpoints, from 0. points: (K, 3) mm. rotations: (K, 3, 3) of the nozzle. direction:
    (K-1, 3) and spin: (K-1, 3), body rad/mm, of each stretch. bend: (K, 3), change of direction, and swing: (K, 3),
    change of spin, at each checkpoint. half: (K,), length of the blend before and after each, 0 where there is none.
    speed: (K-1,) mm/s allowed on each stretch. corner: (K,) mm/s allowed in each blend. due: (K,) s, when each
    checkpoint is reached at the stretches' speeds.
    """

    knots: Array
    points: Array
    rotations: Array
    direction: Array
    spin: Array
    bend: Array
    swing: Array
    half: Array
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
        return np.clip(np.searchsorted(self.knots, s, "right") - 1, 0, len(self.knots) - 2)

    def poses(self, s: Array) -> Array:
        """surface_from_nozzle (N, 4, 4) at s (N,), mm."""
        i = self.stretch(s)
        along = s - self.knots[i]
        into, out_of = self._blends(i, s)
        after, before = self._share(i, out_of**2)[:, None], self._share(i + 1, into**2)[:, None]
        rotation = _turned(self.rotations[i], self.spin[i] * along[:, None])
        rotation = _turned(rotation, after * self.swing[i] + before * self.swing[i + 1])
        rounding = after * self.bend[i] + before * self.bend[i + 1]
        return se3.make(rotation, self.points[i] + self.direction[i] * along[:, None] + rounding)

    def slope(self, s: Array) -> Array:
        """First derivative (N, 3) of the position at s (N,); at most 1 long."""
        i = self.stretch(s)
        into, out_of = self._blends(i, s)
        after, before = self._share(i, out_of)[:, None], self._share(i + 1, into)[:, None]
        return np.asarray(self.direction[i] + 2 * (before * self.bend[i + 1] - after * self.bend[i]))

    def curvature(self, s: Array) -> Array:
        """Second derivative (N, 3), 1/mm, of the position at s (N,); where it steps, the stronger side."""
        i = self.stretch(s)
        into, out_of = self._blends(i, s, 1e-9)
        after, before = self._share(i, 1.0 * (out_of > 0))[:, None], self._share(i + 1, 1.0 * (into > 0))[:, None]
        return np.asarray(2 * (after * self.bend[i] + before * self.bend[i + 1]))

    def _blends(self, i: NDArray[np.intp], s: Array, slack: float = 0.0) -> tuple[Array, Array]:
        """How deep s is in the blend at the end and at the start of its stretch i, mm, 0 outside."""
        into = s - (self.knots[i + 1] - self.half[i + 1])
        out_of = self.knots[i] + self.half[i] - s
        return np.asarray(np.maximum(into + slack, 0.0)), np.asarray(np.maximum(out_of + slack, 0.0))

    def _share(self, i: NDArray[np.intp], value: NDArray[Any]) -> Array:
        """value (N,) over four halves of the blend at each checkpoint i, 0 where there is none."""
        half = self.half[i]
        return np.where(half > 0, value / np.where(half > 0, 4 * half, 1.0), 0.0)


def curve_through(surface_from_nozzle: Array, speed: Array, tolerance: float, swerve: float) -> Curve:
    """The curve through poses (K, 4, 4), no two in a row the same.

    speed: (K-1,) mm/s. tolerance: mm by which corners are cut. swerve: mm/s by which a corner may change the velocity.
    A turn counts as the way of a point LEVER beside the tip.
    """
    length = lengths(surface_from_nozzle)
    points, rotations = surface_from_nozzle[:, :3, 3], surface_from_nozzle[:, :3, :3]
    direction = np.diff(points, axis=0) / length[:, None]
    spin = se3.log_rotation(np.swapaxes(rotations[:-1], -1, -2) @ rotations[1:]) / length[:, None]
    bend, swing = np.zeros_like(points), np.zeros_like(points)
    bend[1:-1], swing[1:-1] = np.diff(direction, axis=0), np.diff(spin, axis=0)
    turned = np.maximum(np.linalg.norm(bend, axis=1), LEVER * np.linalg.norm(swing, axis=1))
    half = np.zeros(len(points))
    wanted = 4 * tolerance / np.maximum(turned[1:-1], 1e-9)  # the curve passes a corner at |bend| * half / 4
    half[1:-1] = np.where(turned[1:-1] > 1e-9, np.minimum(wanted, np.minimum(length[:-1], length[1:]) / 2), 0.0)
    knots, due = (np.concatenate([[0.0], np.cumsum(along)]) for along in (length, length / speed))
    corner = np.where(half > 0, swerve / np.maximum(turned, 1e-9), np.inf)
    return Curve(knots, points, rotations, direction, spin, bend, swing, half, np.asarray(speed, float), corner, due)


def _turned(rotation: Array, by: Array) -> Array:
    """Rotations (N, 3, 3) turned further by body vectors (N, 3), rad; an upright path's none costs nothing."""
    return np.asarray(rotation @ se3.exp_rotation(by)) if by.any() else rotation
