"""From nozzle pose to machine axes and back: the thesis's simple mode, where the arm's controller solves its joints.

X Y Z are the nozzle tip in the arm's frame, mm. A B C (the arm's J4 J5 J6) are the angles alpha, beta, gamma of thesis
Eq. 4.3 of the turn that carries the tool from where it stands at A = B = C = 0 to where it must stand:

    Rz(C) @ Ry(B) @ Rx(A) = rotation of arm_from_nozzle @ inverse(arm_from_nozzle at zero)

For an upright path (alpha = beta = gamma = 0) over a surface that started parallel to the arm, that turn is the
surface's own rotation since then: the thesis adds exactly that to its angles (6.3, J5 and J6).
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from estimation import se3
from estimation.errors import InputError
from estimation.se3 import Array


@dataclass(frozen=True, slots=True, eq=False)
class SimpleArm:
    """An arm that is told where its tool shall be.

    arm_from_base: (4, 4) mm, where the arm stands in the base frame. arm_from_upright: (3, 3) rotation of the nozzle
    frame at A = B = C = 0. home: (6,) mm and rad, where the arm stands at start.
    """

    arm_from_base: Array = field(default_factory=lambda: np.eye(4))
    arm_from_upright: Array = field(default_factory=lambda: np.eye(3))
    home: Array = field(default_factory=lambda: np.array([202.5, 225, 113, 0, 0, 0]))  # thesis 6.3

    def __post_init__(self) -> None:
        if not se3.is_transform(self.arm_from_base):
            raise InputError("arm", "arm_from_base", self.arm_from_base.tolist(), "a finite 4x4 rigid motion, mm")
        if self.arm_from_upright.shape != (3, 3) or not se3.is_transform(se3.make(self.arm_from_upright, np.zeros(3))):
            raise InputError("arm", "arm_from_upright", self.arm_from_upright.tolist(), "a 3x3 rotation")
        if self.home.shape != (6,) or not np.isfinite(self.home).all():
            raise InputError("arm", "home", self.home.tolist(), "6 finite numbers X Y Z A B C, mm and rad")


def axes_from_nozzle(arm: SimpleArm, base_from_nozzle: Array) -> Array:
    """Machine axes (..., 6), mm and rad, that bring the nozzle to base_from_nozzle (..., 4, 4); A and C in +-pi."""
    arm_from_nozzle = arm.arm_from_base @ base_from_nozzle
    turn = arm_from_nozzle[..., :3, :3] @ arm.arm_from_upright.T
    return np.concatenate([arm_from_nozzle[..., :3, 3], se3.euler_from_rotation(turn)], axis=-1)


def nozzle_from_axes(arm: SimpleArm, axes: Array) -> Array:
    """base_from_nozzle (..., 4, 4) at machine axes (..., 6): inverse of `axes_from_nozzle`."""
    turn = se3.rotation_from_euler(axes[..., 3:])
    return np.asarray(se3.inverse(arm.arm_from_base) @ se3.make(turn @ arm.arm_from_upright, axes[..., :3]))


def limited_axes(arm: SimpleArm, base_from_nozzle: Array) -> Array:
    """What limits of speed and acceleration bind (..., D) at base_from_nozzle (..., 4, 4): the machine axes."""
    return axes_from_nozzle(arm, base_from_nozzle)
