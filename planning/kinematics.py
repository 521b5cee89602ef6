"""From nozzle pose to machine axes X Y Z A B C and back.

X Y Z are the nozzle tip in the arm's frame, mm. What A B C (the arm's J4 J5 J6) are, is one of two things:

* `surface`, the thesis's simple mode: the angles alpha, beta, gamma of Eq. 4.3 of the turn that carries the tool from
  where it stands at A = B = C = 0 to where it must stand; the arm's controller solves its joints.

    Rz(C) @ Ry(B) @ Rx(A) = rotation of arm_from_nozzle @ inverse(arm_from_nozzle at zero)

  For an upright path (alpha = beta = gamma = 0) over a surface that started parallel to the arm, that turn is the
  surface's own rotation since then: the thesis adds exactly that to its angles (6.3, J5 and J6).
* `joints`: the angles of the last three joints of a kinematic model, in one posture that the arm keeps.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import Enum

import numpy as np

from estimation import se3
from estimation.errors import InputError
from estimation.se3 import Array
from planning.inverse import joints_from_nozzle, joints_from_tip
from planning.limits import Limits
from planning.robot.kinematics import JointModel, jacobian
from planning.robot.kinematics import arm_from_nozzle as arm_from_joints

LONGEST_OFFSET = 200.0  # mm: a tip farther from where the arm takes it to be is another tool
FLAT = 1e-6  # so much is added to what is divided by in a singularity


class Angles(Enum):
    """What the axes A B C are."""

    SURFACE = "surface"
    JOINTS = "joints"


@dataclass(frozen=True, slots=True, eq=False)
class SimpleArm:
    """An arm that is told where its tool shall be.

    arm_from_base: (4, 4) mm, where the arm stands in the base frame. arm_from_upright: (3, 3) rotation of the nozzle
    frame at A = B = C = 0, where A B C are the surface's. home: (6,) mm and rad, where the arm stands at start. joints:
    the arm's kinematic model, if there is one. angles: what A B C are. tool_offset: (3,) mm, where the tip really is in
    the nozzle frame that the arm believes in: X Y Z and a turn name a place that the tip is beside by it.
    """

    arm_from_base: Array = field(default_factory=lambda: np.eye(4))
    arm_from_upright: Array = field(default_factory=lambda: np.eye(3))
    home: Array = field(default_factory=lambda: np.array([202.5, 225, 113, 0, 0, 0]))  # thesis 6.3
    joints: JointModel | None = None
    angles: Angles = Angles.SURFACE
    tool_offset: Array = field(default_factory=lambda: np.zeros(3))

    def __post_init__(self) -> None:
        if not se3.is_transform(self.arm_from_base):
            raise InputError("arm", "arm_from_base", self.arm_from_base.tolist(), "a finite 4x4 rigid motion, mm")
        if self.arm_from_upright.shape != (3, 3) or not se3.is_transform(se3.make(self.arm_from_upright, np.zeros(3))):
            raise InputError("arm", "arm_from_upright", self.arm_from_upright.tolist(), "a 3x3 rotation")
        if self.home.shape != (6,) or not np.isfinite(self.home).all():
            raise InputError("arm", "home", self.home.tolist(), "6 finite numbers X Y Z A B C, mm and rad")
        if self.tool_offset.shape != (3,) or not (np.abs(self.tool_offset) <= LONGEST_OFFSET).all():
            allowed = f"3 numbers within {LONGEST_OFFSET:g} mm"
            raise InputError("arm", "tool_offset", self.tool_offset.tolist(), allowed)
        if self.angles is Angles.JOINTS and self.joints is None:
            raise InputError("arm", "angles", self.angles.value, "surface, where there is no model of the joints")

    @property
    def jointed(self) -> JointModel | None:
        """The model of the joints where A B C are its last three."""
        return self.joints if self.angles is Angles.JOINTS else None


def axes_from_nozzle(arm: SimpleArm, base_from_nozzle: Array) -> Array:
    """Machine axes (..., 6), mm and rad, that bring the nozzle to base_from_nozzle (..., 4, 4).

    In the simple mode A and C are in +-pi. With joints, angles are NaN where the arm's posture does not reach.
    """
    arm_from_nozzle = _believed(arm, arm.arm_from_base @ base_from_nozzle, -1.0)
    if arm.jointed is not None:
        angles = joints_from_nozzle(arm.jointed, arm_from_nozzle)[..., 3:]
    else:
        angles = se3.euler_from_rotation(arm_from_nozzle[..., :3, :3] @ arm.arm_from_upright.T)
    return np.concatenate([arm_from_nozzle[..., :3, 3], angles], axis=-1)


def nozzle_from_axes(arm: SimpleArm, axes: Array) -> Array:
    """base_from_nozzle (..., 4, 4) at machine axes (..., 6): inverse of `axes_from_nozzle`."""
    if arm.jointed is not None:
        arm_from_nozzle = arm_from_joints(arm.jointed, joints_from_axes(arm.jointed, axes))
    else:
        arm_from_nozzle = se3.make(se3.rotation_from_euler(axes[..., 3:]) @ arm.arm_from_upright, axes[..., :3])
    return np.asarray(se3.inverse(arm.arm_from_base) @ _believed(arm, arm_from_nozzle, 1.0))


def _believed(arm: SimpleArm, arm_from_nozzle: Array, sign: float) -> Array:
    """The nozzle (..., 4, 4) by the tool's offset away: from where the arm believes it (1) or to there (-1)."""
    if not arm.tool_offset.any():
        return arm_from_nozzle
    return np.asarray(arm_from_nozzle @ se3.make(np.eye(3), sign * arm.tool_offset))


def joints_from_axes(model: JointModel, axes: Array) -> Array:
    """All joints (..., 6), rad, at machine axes (..., 6) X Y Z J4 J5 J6; NaN where the posture does not reach."""
    return joints_from_tip(model, axes[..., :3], axes[..., 3:])


def limited_axes(arm: SimpleArm, base_from_nozzle: Array) -> Array:
    """What limits of speed and acceleration bind (..., D) at base_from_nozzle (..., 4, 4).

    The machine axes; with joints, J1 to J3 after them, as these are nobody else's to watch.
    """
    if arm.jointed is None:
        return axes_from_nozzle(arm, base_from_nozzle)
    arm_from_nozzle = _believed(arm, arm.arm_from_base @ base_from_nozzle, -1.0)
    joints = joints_from_nozzle(arm.jointed, arm_from_nozzle)
    return np.concatenate([arm_from_nozzle[..., :3, 3], joints[..., 3:], joints[..., :3]], axis=-1)


def most_change(arm: SimpleArm, limited: Array) -> tuple[Array, Array]:
    """By how much each of `limited_axes` (..., D) changes at most as the tip moves, per mm, and turns, per rad."""
    if arm.jointed is None:
        steep = 1 / np.maximum(np.abs(np.cos(limited[..., 4:5])), FLAT)  # of A and C, as B nears the gimbal lock
        none, one = np.zeros_like(steep), np.ones_like(steep)
        moved = np.broadcast_to([1.0, 1, 1, 0, 0, 0], limited.shape)
        turned = np.concatenate([none, none, none, steep, one, steep], axis=-1)
        return moved, turned + float(np.linalg.norm(arm.tool_offset)) * moved
    matrix = jacobian(arm.jointed, limited[..., [6, 7, 8, 3, 4, 5]])
    inverse = np.linalg.inv(matrix + FLAT * np.eye(6))
    turned, moved = (np.linalg.norm(inverse[..., part], axis=-1) for part in (slice(3), slice(3, 6)))
    moved, turned = (
        np.concatenate([tip, of[..., 3:], of[..., :3]], axis=-1)
        for tip, of in ((np.ones_like(moved[..., :3]), moved), (np.zeros_like(turned[..., :3]), turned))
    )
    return moved, turned + float(np.linalg.norm(arm.tool_offset)) * moved


def limits_of(arm: SimpleArm, limits: Limits) -> tuple[Array, Array]:
    """Speed and acceleration (D,) that bind `limited_axes`."""
    if arm.jointed is None:
        return limits.speed, limits.acceleration
    model = arm.jointed
    return np.append(limits.speed, model.speed[:3]), np.append(limits.acceleration, model.acceleration[:3])
