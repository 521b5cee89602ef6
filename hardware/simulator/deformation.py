"""How the surface departs from rigid: it stretches along the surface and bulges out of it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from estimation.errors import InputError
from estimation.se3 import Array

STRETCH = (-0.3, 0.5)  # a skin tears beyond
BULGE = 30.0  # mm
RADIUS = (5.0, 500.0)  # mm


@dataclass(frozen=True, slots=True)
class Deformation:
    """At amount 1: stretch (x, y), a share of each length, about the origin, and a Gaussian bulge out of the surface.

    bulge: mm at the origin. radius: mm, one sigma, in material coordinates. In the shape's grid frame (z out of the
    surface), which is the surface frame unless the shape is a scan.
    """

    stretch: tuple[float, float] = (0.0, 0.0)
    bulge: float = 0.0
    radius: float = 40.0

    def __post_init__(self) -> None:
        for value in self.stretch:
            if not STRETCH[0] <= value <= STRETCH[1]:
                raise InputError("deformation", "stretch", value, f"{STRETCH[0]} to {STRETCH[1]}, a share of length")
        if not abs(self.bulge) <= BULGE:
            raise InputError("deformation", "bulge", self.bulge, f"-{BULGE:g} to {BULGE:g} mm")
        if not RADIUS[0] <= self.radius <= RADIUS[1]:
            raise InputError("deformation", "radius", self.radius, f"{RADIUS[0]:g} to {RADIUS[1]:g} mm")

    def factors(self, amount: float) -> tuple[float, float]:
        """By how much lengths along x and y grow."""
        return 1 + amount * self.stretch[0], 1 + amount * self.stretch[1]

    def lift(self, xy: ArrayLike, amount: float | Array) -> Array:
        """How far out (N,) mm material points (N, 2) mm bulge; amount: one, or (N,)."""
        square = np.einsum("...i,...i->...", np.asarray(xy, float), np.asarray(xy, float))
        return np.asarray(amount * self.bulge * np.exp(-square / (2 * self.radius**2)))

    def displacement(self, points: ArrayLike, amount: float | Array) -> Array:
        """How far (N, 3) mm points (N, 3) mm of the shape at rest are moved, in the grid frame; amount: or (N,)."""
        points = np.asarray(points, float)
        along = np.asarray(amount)[..., None] * points[..., :2] * np.array(self.stretch)
        return np.concatenate([along, self.lift(points[..., :2], amount)[..., None]], -1)

    def undo(self, points: ArrayLike, amount: float | Array) -> Array:
        """Where points (N, 3) mm of the deformed shape lie at rest, (N, 3) mm, in the grid frame; amount: or (N,)."""
        points = np.asarray(points, float)
        flat = points[..., :2] / (1 + np.asarray(amount)[..., None] * np.array(self.stretch))
        return np.concatenate([flat, (points[..., 2] - self.lift(flat, amount))[..., None]], -1)
