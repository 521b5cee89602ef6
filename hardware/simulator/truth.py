"""What is true of the surface at any instant: where it is, how it moves, and where a checkpoint on it lies."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from estimation import se3
from estimation.se3 import Array
from hardware.simulator.deformation import Deformation

STEP = 0.01  # mm over which the deformation's gradient is taken: it is smooth over centimetres


class MotionOf(Protocol):
    """A motion about the rest pose: estimation.synthetic.motions.Motion, or anything that answers like it."""

    def __call__(self, times: Array) -> Array:
        """rest_from_surface (N, 4, 4) at times (N,), s."""
        ...

    def twist(self, times: Array) -> Array:
        """Body twist (N, 6) at times (N,), rad/s and mm/s."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class Truth:
    """The surface's true motion. rest: (4, 4) base_from_surface at rest. strain: amount of the deformation over time.

    surface_from_grid: (4, 4) mm, of the frame in which the deformation is given.
    """

    rest: Array
    motion: MotionOf
    deformation: Deformation = field(default_factory=Deformation)
    strain: Callable[[Array], Array] | None = None
    surface_from_grid: Array = field(default_factory=lambda: np.eye(4))

    def base_from_surface(self, times: Array) -> Array:
        """(N, 4, 4) mm at times (N,), s."""
        return np.asarray(self.rest @ self.motion(times))

    def twist(self, times: Array) -> Array:
        """Body twist (N, 6), rad/s and mm/s, at times (N,), s."""
        return self.motion.twist(times)

    def amount(self, times: Array) -> Array:
        """Amount of the deformation (N,) at times (N,), s; 0 where there is none."""
        return np.zeros(len(times)) if self.strain is None else np.asarray(self.strain(times))

    def checkpoints(self, times: Array, surface_from_nozzle: Array) -> Array:
        """base_from_target (N, 4, 4): where nozzle poses given on the undeformed surface (N, 4, 4) truly lie at (N,) s.

        The place is carried by the displacement field, the tool by the rotation of its gradient (polar decomposition).
        """
        amount, places = self.amount(times), surface_from_nozzle[:, :3, 3]
        moved = surface_from_nozzle
        if amount.any():
            moved = moved.copy()
            moved[:, :3, 3] += self.displacement(places, amount)
            moved[:, :3, :3] = self._turn(places, amount) @ moved[:, :3, :3]
        return np.asarray(self.base_from_surface(times) @ moved)

    def material(self, times: Array, points_base: Array) -> Array:
        """Points of the undeformed surface (N, 3), mm, that lie at points_base (N, 3) at times (N,), s."""
        there = se3.inverse(self.base_from_surface(times))
        points = (there[:, :3, :3] @ points_base[..., None])[..., 0] + there[:, :3, 3]
        amount = self.amount(times)
        if not amount.any():
            return np.asarray(points)
        grid = se3.transform_points(se3.inverse(self.surface_from_grid), points)
        return se3.transform_points(self.surface_from_grid, self.deformation.undo(grid, amount))

    def displacement(self, points: Array, amount: Array) -> Array:
        """How far (N, 3) mm points (N, 3) of the undeformed surface are moved by amounts (N,); both surface frame."""
        grid = se3.transform_points(se3.inverse(self.surface_from_grid), points)
        moved = self.deformation.displacement(grid, amount)
        return np.asarray(moved @ self.surface_from_grid[:3, :3].T)

    def _turn(self, points: Array, amount: Array) -> Array:
        """Rotations (N, 3, 3) of the material at points (N, 3)."""
        ahead = [self.displacement(points + STEP / 2 * axis, amount) for axis in np.eye(3)]
        behind = [self.displacement(points - STEP / 2 * axis, amount) for axis in np.eye(3)]
        gradient = np.eye(3) + (np.stack(ahead, -1) - np.stack(behind, -1)) / STEP
        return se3.nearest_rotation(gradient)
