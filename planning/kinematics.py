"""Kinematics: nozzle pose to machine axes X Y Z A B C and back, with or without a model of the arm's joints.

X Y Z are the nozzle tip in the arm's frame, mm. A B C (the arm's J4 J5 J6) are one of two things:

* `surface`, the thesis's simple mode: the angles alpha, beta, gamma of Eq. 4.3 of the rotation of the tool from where
  it stands at A = B = C = 0; the arm's controller solves the joints.

    Rz(C) @ Ry(B) @ Rx(A) = rotation of arm_from_nozzle @ inverse(arm_from_nozzle at zero)

  For an upright path (alpha = beta = gamma = 0) over a surface that started parallel to the arm, that is the surface's
  own rotation since then: the thesis adds exactly that to its angles (6.3, J5 and J6).
* `joints`: the angles of the last three joints of a kinematic model, in one posture that the arm keeps.

A machine that does not turn, such as a gantry, keeps A B C of its home: its tip goes where the path wants it, and its
tool leans against the path's by what the surface has turned, up to `max_lean`. How the tool stands about its own axis
is of no account.

The model follows the distal Denavit-Hartenberg convention (Spong, Hutchinson and Vidyasagar 2006, 3.2): the i-th row
a, alpha, d, theta is Rz(joint + theta) Tz(d) Tx(a) Rx(alpha). It must be an elbow arm with a spherical wrist, as nearly
all six-axis arms are: joints 2 and 3 parallel, the last three axes through one point. Then the inverse is exact in all
eight postures (Pieper 1968): the wrist's centre fixes joints 1 to 3, a triangle of upper arm and forearm in a vertical
plane; the remaining rotation fixes joints 4 to 6. What is out of reach is NaN.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from enum import Enum
from itertools import product

import numpy as np

from estimation import se3
from estimation.errors import InputError
from estimation.se3 import Array
from planning.command import MotionLimits

SHOULDERS, ELBOWS, WRISTS = ("front", "back"), ("up", "down"), ("positive", "negative")
POSTURES = np.array(list(product([1.0, -1.0], repeat=3)))  # (8, 3): shoulder, elbow, wrist; see JointModel.signs
ELBOW_ARM_LAYOUT = "alpha +-90 0 +-90 +-90 +-90 0 degrees, a4 = a5 = a6 = d5 = 0, a2 > 0, a3 or d4 not 0"
MAX_LEAN = float(np.deg2rad(45))  # rad: a needle that leans more scrapes rather than prints
MAX_TOOL_OFFSET = 200.0  # mm: a tip farther from where the arm assumes it is another tool
SINGULAR_REGULARISATION = 1e-6  # added to divisors near a singularity


@dataclass(frozen=True, slots=True, eq=False)
class JointModel:
    """One arm's joints J1 to J6. InputError names what makes no sense.

    posture: which of the eight solutions the arm keeps: wrist in front of the first axis or behind it, elbow up or
    down, fifth joint bent to the positive or the negative side.
    """

    name: str
    dh: Array  # (6, 4) a mm, alpha rad, d mm, theta rad
    low: Array  # (6,) rad
    high: Array  # (6,) rad
    speed: Array  # (6,) rad/s
    acceleration: Array  # (6,) rad/s^2
    arm_from_foot: Array = field(default_factory=lambda: np.eye(4))  # (4, 4) mm, from the table's first frame
    flange_from_nozzle: Array = field(default_factory=lambda: np.eye(4))  # (4, 4) mm
    posture: tuple[str, str, str] = ("front", "up", "negative")
    nominal: bool = True  # the numbers are assumed, not the maker's

    def __post_init__(self) -> None:
        for name, shape in (("dh", (6, 4)), ("low", (6,)), ("high", (6,)), ("speed", (6,)), ("acceleration", (6,))):
            value = getattr(self, name)
            if np.shape(value) != shape or not np.isfinite(value).all():
                raise InputError("kinematics", name, np.asarray(value).tolist(), f"finite numbers, shape {shape}")
        for name in ("arm_from_foot", "flange_from_nozzle"):
            if not se3.is_transform(getattr(self, name)):
                raise InputError("kinematics", name, getattr(self, name).tolist(), "a finite 4x4 rigid motion, mm")
        if (self.low >= self.high).any() or (self.high - self.low > 2 * np.pi + 1e-9).any():
            raise InputError("kinematics", "low", np.rad2deg(self.low).tolist(), "below high, by 360 degrees at most")
        for name in ("speed", "acceleration"):
            if (getattr(self, name) <= 0).any():
                raise InputError("kinematics", name, np.rad2deg(getattr(self, name)).tolist(), "> 0")
        for word, words in zip(self.posture, (SHOULDERS, ELBOWS, WRISTS), strict=True):
            if word not in words:
                raise InputError("kinematics", "posture", word, " or ".join(words))
        a, alpha, d, _ = self.dh.T
        turns = np.abs(np.abs(alpha) - np.pi / 2 * np.array([1, 0, 1, 1, 1, 0])).max() < 1e-9
        wrist = not np.abs([*a[3:], d[4]]).max() > 1e-9
        if not (turns and wrist and a[1] > 0 and np.hypot(a[2], d[3]) > 0):
            raise InputError("kinematics", "dh", self.dh.tolist(), ELBOW_ARM_LAYOUT)

    @property
    def signs(self) -> Array:
        """The posture as (3,) of 1 and -1; 1 is the first word of each pair."""
        words = zip(self.posture, (SHOULDERS, ELBOWS, WRISTS), strict=True)
        return np.array([1.0 if word == pair[0] else -1.0 for word, pair in words])


def link_transform(model: JointModel, i: int, angle: Array) -> Array:
    """Transform (..., 4, 4) from link i + 1 to link i where joint i + 1 stands at `angle` (...), theta added."""
    a, alpha, d, _ = model.dh[i].tolist()
    c, s, ca, sa = np.cos(angle), np.sin(angle), math.cos(alpha), math.sin(alpha)
    out = np.zeros((*np.shape(angle), 4, 4))
    out[..., 0, 0], out[..., 0, 1], out[..., 0, 2], out[..., 0, 3] = c, -s * ca, s * sa, a * c
    out[..., 1, 0], out[..., 1, 1], out[..., 1, 2], out[..., 1, 3] = s, c * ca, -c * sa, a * s
    out[..., 2, 1], out[..., 2, 2], out[..., 2, 3], out[..., 3, 3] = sa, ca, d, 1.0
    return out


def _links(model: JointModel, first: int, angles: Array) -> Array:
    """Transform (..., 4, 4) over the three links from `first` on, their joints at `angles` (..., 3), theta added."""
    a, b, c = (link_transform(model, first + i, angles[..., i]) for i in range(3))
    return np.asarray(a @ b @ c)


def link_chain(model: JointModel, joints: Array) -> Array:
    """arm_from_link (7, ..., 4, 4) at joints (..., 6), rad: the foot first, the nozzle instead of the last link."""
    frames = [np.broadcast_to(model.arm_from_foot, (*joints.shape[:-1], 4, 4))]
    for i in range(6):
        frames.append(frames[-1] @ link_transform(model, i, joints[..., i] + model.dh[i, 3]))
    frames[-1] = frames[-1] @ model.flange_from_nozzle
    return np.stack(frames)


def nozzle_from_joints(model: JointModel, joints: Array) -> Array:
    """Where joints (..., 6), rad, bring the nozzle (..., 4, 4)."""
    return np.asarray(link_chain(model, joints)[-1])


def jacobian(model: JointModel, joints: Array) -> Array:
    """Velocity (..., 6, 6) of the nozzle, turn and then tip, in the arm's frame, by the speed of each joint."""
    frames = link_chain(model, joints)
    axes, origins = frames[:6, ..., :3, 2], frames[:6, ..., :3, 3]
    moved = np.cross(axes, frames[-1, ..., :3, 3] - origins)
    return np.moveaxis(np.concatenate([axes, moved], -1), 0, -1)


@dataclass(frozen=True, slots=True, eq=False)
class JointDistance:
    """Distances (...) of joints from the ends of their ranges and from singularities; 0 or less: there, or beyond."""

    bound: Array  # rad to the nearest end of a joint's range
    wrist: Array  # rad of joint 5 from where axes 4 and 6 are one line
    elbow: Array  # rad from where the arm is stretched out or folded
    shoulder: Array  # mm of the wrist from the plane of the first axis and a line along the second
    manipulability: Array  # Yoshikawa's, sqrt(det(J J^T)), tip speeds relative to the arm's size (a2 + |a3, d4|)


def joint_distance(model: JointModel, joints: Array) -> JointDistance:
    """Distances of joints (..., 6), rad, from their ends and from singularities."""
    a, alpha, d, theta = model.dh.T
    bend = joints[..., 2] + theta[2] + np.arctan2(-np.sign(alpha[2]) * d[3], a[2])
    forearm = np.hypot(a[2], d[3])
    upper = joints[..., 1] + theta[1]
    ahead = a[0] + a[1] * np.cos(upper) + forearm * np.cos(upper + bend)
    matrix = jacobian(model, joints) * np.repeat([1.0, 1 / (a[1] + forearm)], 3)[:, None]
    with np.errstate(invalid="ignore"):  # of joints that are NaN
        manipulability = np.abs(np.linalg.det(matrix))
    bound = np.minimum(joints - model.low, model.high - joints).min(axis=-1)
    wrist, elbow = (np.abs(np.arcsin(np.sin(angle))) for angle in (joints[..., 4] + theta[4], bend))
    return JointDistance(bound, wrist, elbow, np.abs(ahead), manipulability)


def joints_from_nozzle(model: JointModel, arm_from_nozzle: Array, signs: Array | None = None) -> Array:
    """Joints (..., 6), rad, that bring the nozzle to arm_from_nozzle (..., 4, 4) in the posture `signs` (3,).

    Without signs in the model's own. Each joint is within half a turn of the middle of its range; NaN: out of reach.
    """
    shoulder, elbow, wrist = model.signs if signs is None else signs
    foot_from_flange = se3.inverse(model.arm_from_foot) @ arm_from_nozzle @ se3.inverse(model.flange_from_nozzle)
    centre = foot_from_flange[..., :3, 3] - model.dh[5, 2] * foot_from_flange[..., :3, 2]
    first = _triangle(model, centre, _centre_in_forearm(model), shoulder, elbow)
    last = _wrist(model, first, foot_from_flange[..., :3, :3], wrist)
    return _wrapped(model, np.concatenate([first, last], -1))


def joints_from_tip(model: JointModel, tip: Array, wrist: Array) -> Array:
    """Joints (..., 6), rad, that bring the nozzle's tip to `tip` (..., 3), mm, arm frame, the last three being `wrist`.

    The solution is of the model's own posture; NaN where there is none.
    """
    foot_from_arm = se3.inverse(model.arm_from_foot)
    place = tip @ foot_from_arm[:3, :3].T + foot_from_arm[:3, 3]
    angles = wrist + model.dh[3:, 3]
    in_forearm = _in_link_3(model, (_links(model, 3, angles) @ model.flange_from_nozzle)[..., :3, 3])
    solution = np.full((*wrist.shape[:-1], 6), np.nan)
    for shoulder, elbow in product([1.0, -1.0], repeat=2):  # of the triangle with the tip; the posture is the wrist's
        joints = _wrapped(model, np.concatenate([_triangle(model, place, in_forearm, shoulder, elbow), angles], -1))
        with np.errstate(invalid="ignore"):
            own = np.isnan(solution[..., 0]) & (_posture(model, joints) == model.signs[:2]).all(axis=-1)
        solution = np.where(own[..., None], joints, solution)
    return solution


def _centre_in_forearm(model: JointModel) -> Array:
    """The wrist's centre (3,), mm, in the forearm: see `_in_link_3`."""
    return _in_link_3(model, np.array([0.0, 0, model.dh[3, 2]]))


def _in_link_3(model: JointModel, points: Array) -> Array:
    """Points (..., 3) of frame 3, mm, seen from the elbow with x along the third row's a: joint 3 turns about z."""
    a, alpha, d, _ = model.dh[2]
    return np.asarray(points @ se3.exp_rotation([alpha, 0, 0]).T + [a, 0, d])


def _triangle(model: JointModel, place: Array, forearm: Array, shoulder: float, elbow: float) -> Array:
    """The table's angles (..., 3) that bring the point `forearm` (..., 3) of the forearm to `place` (..., 3), mm."""
    a, alpha, d, _ = model.dh.T
    side = np.sign(alpha[0])
    aside = -side * (d[1] + forearm[..., 2])
    with np.errstate(invalid="ignore"):  # the root of what is negative: out of reach
        ahead = shoulder * np.sqrt(place[..., 0] ** 2 + place[..., 1] ** 2 - aside**2)
        first = np.arctan2(place[..., 1], place[..., 0]) - np.arctan2(aside, ahead)
        x, y = ahead - a[0], side * (place[..., 2] - d[0])
        reach = np.hypot(forearm[..., 0], forearm[..., 1])
        bend = -side * shoulder * elbow * np.arccos((x**2 + y**2 - a[1] ** 2 - reach**2) / (2 * a[1] * reach))
        second = np.arctan2(y, x) - np.arctan2(reach * np.sin(bend), a[1] + reach * np.cos(bend))
    return np.stack([first, second, bend - np.arctan2(forearm[..., 1], forearm[..., 0])], -1)


def _posture(model: JointModel, joints: Array) -> Array:
    """Signs (..., 2) of shoulder and elbow of joints (..., 6)."""
    a, alpha, _, theta = model.dh.T
    x, y, _ = _centre_in_forearm(model)
    upper, bend = joints[..., 1] + theta[1], joints[..., 2] + theta[2] + np.arctan2(y, x)
    shoulder = np.sign(a[0] + a[1] * np.cos(upper) + np.hypot(x, y) * np.cos(upper + bend))
    return np.stack([shoulder, -np.sign(alpha[0]) * shoulder * np.sign(np.sin(bend))], -1)


def _wrist(model: JointModel, first: Array, foot_from_flange: Array, sign: float) -> Array:
    """The table's angles (..., 3) of the wrist for the rotation (..., 3, 3), the first three being `first` (..., 3)."""
    fourth_side, fifth_side = np.sign(model.dh[3:5, 1])
    turn = np.swapaxes(_links(model, 0, first)[..., :3, :3], -1, -2) @ foot_from_flange
    axis, up = turn[..., 2], fifth_side * sign
    fifth = sign * np.arctan2(np.hypot(axis[..., 0], axis[..., 1]), -fourth_side * fifth_side * axis[..., 2])
    fourth = np.arctan2(up * axis[..., 1], up * axis[..., 0])
    bent = (link_transform(model, 3, fourth) @ link_transform(model, 4, fifth))[..., :3, :3]
    spun = np.swapaxes(bent, -1, -2) @ turn
    return np.stack([fourth, fifth, np.arctan2(spun[..., 1, 0], spun[..., 0, 0])], -1)


def _wrapped(model: JointModel, angles: Array) -> Array:
    """Joints (..., 6) of the table's angles, each within half a turn of the middle of its range."""
    middle = (model.low + model.high) / 2
    off = angles - model.dh[:, 3] - middle
    return np.asarray(middle + off - 2 * np.pi * np.round(off / (2 * np.pi)))


class AngleMode(Enum):
    """What the axes A B C are."""

    SURFACE = "surface"
    JOINTS = "joints"


@dataclass(frozen=True, slots=True, eq=False)
class SimpleArm:
    """An arm that is sent the pose of its tool."""

    arm_from_base: Array = field(default_factory=lambda: np.eye(4))  # (4, 4) mm
    arm_from_upright: Array = field(default_factory=lambda: np.eye(3))  # (3, 3) of the nozzle at A = B = C = 0
    home: Array = field(default_factory=lambda: np.array([202.5, 225, 113, 0, 0, 0]))  # (6,) mm and rad; thesis 6.3
    joints: JointModel | None = None
    angles: AngleMode = AngleMode.SURFACE  # what A B C are
    tool_offset: Array = field(default_factory=lambda: np.zeros(3))  # (3,) mm, the true tip in the assumed nozzle frame
    max_lean: float | None = None  # rad that the tool may lean, of a machine that does not turn; None: it turns

    def __post_init__(self) -> None:
        if not se3.is_transform(self.arm_from_base):
            raise InputError("arm", "arm_from_base", self.arm_from_base.tolist(), "a finite 4x4 rigid motion, mm")
        if self.arm_from_upright.shape != (3, 3) or not se3.is_transform(se3.make(self.arm_from_upright, np.zeros(3))):
            raise InputError("arm", "arm_from_upright", self.arm_from_upright.tolist(), "a 3x3 rotation")
        if self.home.shape != (6,) or not np.isfinite(self.home).all():
            raise InputError("arm", "home", self.home.tolist(), "6 finite numbers X Y Z A B C, mm and rad")
        if self.tool_offset.shape != (3,) or not (np.abs(self.tool_offset) <= MAX_TOOL_OFFSET).all():
            allowed = f"3 numbers within {MAX_TOOL_OFFSET:g} mm"
            raise InputError("arm", "tool_offset", self.tool_offset.tolist(), allowed)
        if self.max_lean is not None and not 0 < self.max_lean <= MAX_LEAN:
            allowed = f"above 0, at most {np.rad2deg(MAX_LEAN):g} degrees"
            raise InputError("arm", "max_lean", float(np.rad2deg(self.max_lean)), allowed)
        if self.max_lean is not None and self.joints is not None:
            raise InputError("arm", "max_lean", float(np.rad2deg(self.max_lean)), "no table [kinematics] beside it")
        if self.angles is AngleMode.JOINTS and self.joints is None:
            raise InputError("arm", "angles", self.angles.value, "surface, where there is no model of the joints")

    @property
    def beyond(self) -> str:
        """Why `axes_from_nozzle` gives NaN, where it does."""
        turns = self.max_lean is None
        return "the arm has no such posture" if turns else "this machine does not turn: its tool would lean too far"

    @property
    def jointed(self) -> JointModel | None:
        """The model of the joints where A B C are its last three."""
        return self.joints if self.angles is AngleMode.JOINTS else None


def axes_from_nozzle(arm: SimpleArm, base_from_nozzle: Array) -> Array:
    """Machine axes (..., 6), mm and rad, that bring the nozzle to base_from_nozzle (..., 4, 4).

    In the simple mode A and C are in +-pi. With joints, angles are NaN where the arm's posture does not reach; of a
    machine that does not turn, where its tool would lean too far.
    """
    if arm.max_lean is not None:
        return _unturned_axes(arm, arm.arm_from_base @ base_from_nozzle, arm.max_lean)
    arm_from_nozzle = _offset_tool(arm, arm.arm_from_base @ base_from_nozzle, -1.0)
    if arm.jointed is not None:
        angles = joints_from_nozzle(arm.jointed, arm_from_nozzle)[..., 3:]
    else:
        angles = se3.euler_from_rotation(arm_from_nozzle[..., :3, :3] @ arm.arm_from_upright.T)
    return np.concatenate([arm_from_nozzle[..., :3, 3], angles], axis=-1)


def tool_lean(arm: SimpleArm, arm_from_nozzle: Array) -> Array:
    """Angle (...), rad, between a path's tool (..., 4, 4) and that of a machine that does not turn."""
    upright = se3.rotation_from_euler(arm.home[3:]) @ arm.arm_from_upright
    along = arm_from_nozzle[..., :3, 2] @ upright[:, 2]
    across = np.linalg.norm(np.cross(arm_from_nozzle[..., :3, 2], upright[:, 2]), axis=-1)
    return np.asarray(np.arctan2(across, along))


def _unturned_axes(arm: SimpleArm, arm_from_nozzle: Array, max_lean: float) -> Array:
    """Machine axes (..., 6) of a machine that does not turn."""
    upright = se3.rotation_from_euler(arm.home[3:]) @ arm.arm_from_upright
    tip = arm_from_nozzle[..., :3, 3] - upright @ arm.tool_offset
    angles = np.where(tool_lean(arm, arm_from_nozzle)[..., None] <= max_lean, arm.home[3:], np.nan)
    return np.concatenate([tip, angles], axis=-1)


def nozzle_from_axes(arm: SimpleArm, axes: Array) -> Array:
    """base_from_nozzle (..., 4, 4) at machine axes (..., 6): inverse of `axes_from_nozzle`."""
    if arm.jointed is not None:
        arm_from_nozzle = nozzle_from_joints(arm.jointed, joints_from_axes(arm.jointed, axes))
    else:
        arm_from_nozzle = se3.make(se3.rotation_from_euler(axes[..., 3:]) @ arm.arm_from_upright, axes[..., :3])
    return np.asarray(se3.inverse(arm.arm_from_base) @ _offset_tool(arm, arm_from_nozzle, 1.0))


def _offset_tool(arm: SimpleArm, arm_from_nozzle: Array, sign: float) -> Array:
    """The nozzle (..., 4, 4) moved by the tool's offset: from the pose that the arm assumes (1) or to it (-1)."""
    if not arm.tool_offset.any():
        return arm_from_nozzle
    return np.asarray(arm_from_nozzle @ se3.make(np.eye(3), sign * arm.tool_offset))


def joints_from_axes(model: JointModel, axes: Array) -> Array:
    """All joints (..., 6), rad, at machine axes (..., 6) X Y Z J4 J5 J6; NaN where the posture does not reach."""
    return joints_from_tip(model, axes[..., :3], axes[..., 3:])


def limited_axes(arm: SimpleArm, base_from_nozzle: Array) -> Array:
    """What has limits of speed and acceleration (..., D): the machine axes and, with joints, J1 to J3 after them."""
    if arm.jointed is None:
        return axes_from_nozzle(arm, base_from_nozzle)
    arm_from_nozzle = _offset_tool(arm, arm.arm_from_base @ base_from_nozzle, -1.0)
    joints = joints_from_nozzle(arm.jointed, arm_from_nozzle)
    return np.concatenate([arm_from_nozzle[..., :3, 3], joints[..., 3:], joints[..., :3]], axis=-1)


def max_axis_change(arm: SimpleArm, limited: Array) -> tuple[Array, Array]:
    """Largest change of each of `limited_axes` (..., D) as the tip moves, per mm, and as it turns, per rad."""
    if arm.max_lean is not None:
        moved = np.broadcast_to([1.0, 1, 1, 0, 0, 0], limited.shape)
        return moved, np.zeros_like(moved)
    if arm.jointed is None:
        # of A and C, as B nears the gimbal lock
        steep = 1 / np.maximum(np.abs(np.cos(limited[..., 4:5])), SINGULAR_REGULARISATION)
        none, one = np.zeros_like(steep), np.ones_like(steep)
        moved = np.broadcast_to([1.0, 1, 1, 0, 0, 0], limited.shape)
        turned = np.concatenate([none, none, none, steep, one, steep], axis=-1)
        return moved, turned + float(np.linalg.norm(arm.tool_offset)) * moved
    matrix = jacobian(arm.jointed, limited[..., [6, 7, 8, 3, 4, 5]])
    inverse = np.linalg.inv(matrix + SINGULAR_REGULARISATION * np.eye(6))
    turned, moved = (np.linalg.norm(inverse[..., part], axis=-1) for part in (slice(3), slice(3, 6)))
    moved, turned = (
        np.concatenate([tip, of[..., 3:], of[..., :3]], axis=-1)
        for tip, of in ((np.ones_like(moved[..., :3]), moved), (np.zeros_like(turned[..., :3]), turned))
    )
    return moved, turned + float(np.linalg.norm(arm.tool_offset)) * moved


def axis_limits(arm: SimpleArm, limits: MotionLimits) -> tuple[Array, Array]:
    """Limits of speed and acceleration (D,) of `limited_axes`."""
    if (model := arm.jointed) is None:
        return limits.speed, limits.acceleration
    return np.append(limits.speed, model.speed[:3]), np.append(limits.acceleration, model.acceleration[:3])
