"""A surface that something happens to: it runs away and comes back, or is folded, for a while."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from estimation import se3
from estimation.errors import InputError
from estimation.se3 import Array
from hardware.process.faults import Fault, Kind, Part, drawn, struck
from hardware.simulator.deformation import Deformation
from hardware.simulator.truth import MotionOf

RIDGE = 8.0  # mm, one sigma of a fold: narrower than a wound, wider than a bead


def pulse(fault: Fault, times: Array) -> tuple[Array, Array]:
    """A rise from 0 to 1 and back without a corner while a fault lasts, and its rate, 1/s; both (N,) at times (N,)."""
    phase = np.clip((times - fault.start) / fault.duration, 0.0, 1.0) * np.pi
    return np.sin(phase) ** 2, np.sin(2 * phase) * np.pi / fault.duration


@dataclass(frozen=True, slots=True, eq=False)
class StruckMotion:
    """A motion with faults of kind FAST on top: along a straight line, at their amount at most."""

    motion: MotionOf
    faults: Sequence[Fault]

    def __call__(self, times: Array) -> Array:
        """rest_from_surface (N, 4, 4) at times (N,), s."""
        return np.asarray(se3.make(np.eye(3), self._way(times)[0]) @ self.motion(times))

    def twist(self, times: Array) -> Array:
        """Body twist (N, 6) at times (N,), rad/s and mm/s."""
        turned = np.swapaxes(self.motion(times)[:, :3, :3], -1, -2)
        twist = self.motion.twist(times).copy()
        twist[:, 3:] += (turned @ self._way(times)[1][..., None])[..., 0]
        return np.asarray(twist)

    def _way(self, times: Array) -> tuple[Array, Array]:
        """Displacement and speed (N, 3) in the rest frame, mm and mm/s."""
        place, speed = np.zeros((len(times), 3)), np.zeros((len(times), 3))
        for fault in self.faults:
            risen, rate = pulse(fault, times)
            direction = drawn(fault).normal(size=3)
            reach = fault.amount * fault.duration / np.pi * direction / np.linalg.norm(direction)
            place += risen[:, None] * reach
            speed += rate[:, None] * reach
        return place, speed


def struck_motion(motion: MotionOf, faults: Sequence[Fault]) -> MotionOf:
    """The motion with all that makes it run away."""
    fast = struck(faults, Part.SURFACE, Kind.FAST)
    return StruckMotion(motion, fast) if fast else motion


@dataclass(frozen=True, slots=True, eq=False)
class Folds:
    """How high folds stand: an amount over time, as a scenario's [strain] is."""

    faults: Sequence[Fault]

    def __call__(self, times: Array) -> Array:
        """mm (N,) at times (N,), s."""
        return np.asarray(sum(fault.amount * pulse(fault, times)[0] for fault in self.faults))


def folded(where: object, deformation: Deformation, faults: Sequence[Fault]) -> tuple[Deformation, Folds] | None:
    """The deformation of folds and its amount over time; None without any.

    InputError where the surface is deformed already: there is one deformation at a time.
    """
    folds = struck(faults, Part.SURFACE, Kind.FOLD)
    if not folds:
        return None
    if deformation != Deformation():
        raise InputError(where, "faults", str(folds[0]), "a scenario without [scene.deformation]")
    return Deformation(bulge=1.0, radius=RIDGE), Folds(folds)
