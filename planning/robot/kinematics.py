"""A six-axis arm by its Denavit-Hartenberg table: where its joints bring the nozzle, and how near they are to trouble.

Frames follow the distal convention (Spong, Hutchinson and Vidyasagar 2006, 3.2): the i-th row a, alpha, d, theta is
Rz(joint + theta) Tz(d) Tx(a) Rx(alpha). The arm must be an elbow arm with a spherical wrist, as nearly all six-axis
arms are: joints 2 and 3 parallel, the last three axes through one point. Then the way back is exact
(`planning/inverse.py`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from estimation import se3
from estimation.errors import InputError
from estimation.se3 import Array

SHOULDERS, ELBOWS, WRISTS = ("front", "back"), ("up", "down"), ("positive", "negative")
LAYOUT = "alpha +-90 0 +-90 +-90 +-90 0 degrees, a4 = a5 = a6 = d5 = 0, a2 > 0, a3 or d4 not 0"


@dataclass(frozen=True, slots=True, eq=False)
class JointModel:
    """One arm's joints J1 to J6. InputError names what makes no sense.

    dh: (6, 4) of a mm, alpha rad, d mm, theta rad. low, high, speed, acceleration: (6,) rad, rad/s, rad/s^2.
    arm_from_foot: (4, 4) mm, from where the table starts to the arm's own frame. flange_from_nozzle: (4, 4) mm.
    posture: which of the eight solutions the arm keeps: wrist in front of the first axis or behind it, elbow up or
    down, fifth joint bent to the positive or the negative side. nominal: the numbers are made up, not a maker's.
    """

    name: str
    dh: Array
    low: Array
    high: Array
    speed: Array
    acceleration: Array
    arm_from_foot: Array = field(default_factory=lambda: np.eye(4))
    flange_from_nozzle: Array = field(default_factory=lambda: np.eye(4))
    posture: tuple[str, str, str] = ("front", "up", "negative")
    nominal: bool = True

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
        if not self._solvable():
            raise InputError("kinematics", "dh", self.dh.tolist(), LAYOUT)

    def _solvable(self) -> bool:
        a, alpha, d, _ = self.dh.T
        turns = np.abs(np.abs(alpha) - np.pi / 2 * np.array([1, 0, 1, 1, 1, 0])).max() < 1e-9
        wrist = not np.abs([*a[3:], d[4]]).max() > 1e-9
        return bool(turns and wrist and a[1] > 0 and np.hypot(a[2], d[3]) > 0)

    @property
    def signs(self) -> Array:
        """The posture as (3,) of 1 and -1, the first word of each pair being 1."""
        words = zip(self.posture, (SHOULDERS, ELBOWS, WRISTS), strict=True)
        return np.array([1.0 if word == pair[0] else -1.0 for word, pair in words])


def link(model: JointModel, i: int, angle: Array) -> Array:
    """Transform (..., 4, 4) from link i + 1 to link i where joint i + 1 stands at `angle` (...), theta added."""
    a, alpha, d, _ = model.dh[i].tolist()
    c, s, ca, sa = np.cos(angle), np.sin(angle), math.cos(alpha), math.sin(alpha)
    out = np.zeros((*np.shape(angle), 4, 4))
    out[..., 0, 0], out[..., 0, 1], out[..., 0, 2], out[..., 0, 3] = c, -s * ca, s * sa, a * c
    out[..., 1, 0], out[..., 1, 1], out[..., 1, 2], out[..., 1, 3] = s, c * ca, -c * sa, a * s
    out[..., 2, 1], out[..., 2, 2], out[..., 2, 3], out[..., 3, 3] = sa, ca, d, 1.0
    return out


def chain(model: JointModel, joints: Array) -> Array:
    """arm_from_link (7, ..., 4, 4) at joints (..., 6), rad: the foot first, the nozzle instead of the last link."""
    frames = [np.broadcast_to(model.arm_from_foot, (*joints.shape[:-1], 4, 4))]
    for i in range(6):
        frames.append(frames[-1] @ link(model, i, joints[..., i] + model.dh[i, 3]))
    frames[-1] = frames[-1] @ model.flange_from_nozzle
    return np.stack(frames)


def arm_from_nozzle(model: JointModel, joints: Array) -> Array:
    """Where joints (..., 6), rad, bring the nozzle (..., 4, 4)."""
    return np.asarray(chain(model, joints)[-1])


def jacobian(model: JointModel, joints: Array) -> Array:
    """Velocity (..., 6, 6) of the nozzle, turn and then tip, in the arm's frame, by the speed of each joint."""
    frames = chain(model, joints)
    axes, origins = frames[:6, ..., :3, 2], frames[:6, ..., :3, 3]
    moved = np.cross(axes, frames[-1, ..., :3, 3] - origins)
    return np.moveaxis(np.concatenate([axes, moved], -1), 0, -1)


@dataclass(frozen=True, slots=True, eq=False)
class Distance:
    """How far joints are from what stops them; negative or 0: there, or beyond. Each (...).

    bound: rad to the nearest end of a joint's range. wrist: rad, of joint 5 from where axes 4 and 6 are one line.
    elbow: rad, from where the arm is stretched out or folded. shoulder: mm, of the wrist from the plane that holds the
    first axis and a line along the second. manipulability: Yoshikawa's, sqrt(det(J J^T)), with tip speeds by the
    arm's own size (a2 + |a3, d4|); 0 in a singularity.
    """

    bound: Array
    wrist: Array
    elbow: Array
    shoulder: Array
    manipulability: Array


def distance(model: JointModel, joints: Array) -> Distance:
    """Distances of joints (..., 6), rad, from their ends and from singularities."""
    a, alpha, d, theta = model.dh.T
    bend = joints[..., 2] + theta[2] + np.arctan2(-np.sign(alpha[2]) * d[3], a[2])
    forearm = np.hypot(a[2], d[3])
    upper = joints[..., 1] + theta[1]
    shoulder = np.abs(a[0] + a[1] * np.cos(upper) + forearm * np.cos(upper + bend))
    matrix = jacobian(model, joints) * np.repeat([1.0, 1 / (a[1] + forearm)], 3)[:, None]
    with np.errstate(invalid="ignore"):  # of joints that are NaN
        manipulability = np.abs(np.linalg.det(matrix))
    return Distance(
        np.minimum(joints - model.low, model.high - joints).min(axis=-1),
        np.abs(np.arcsin(np.sin(joints[..., 4] + theta[4]))),
        np.abs(np.arcsin(np.sin(bend))),
        shoulder,
        manipulability,
    )
