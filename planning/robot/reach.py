"""Whether an arm can print a path, before it prints: joint ranges, joint speeds and singularities at each checkpoint.

Each checkpoint is asked for on the surface at rest and wherever the surface is expected to move to. The tool may be
spun about its own axis where that helps: material leaves along it, so the spin is free.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from estimation import se3
from estimation.se3 import Array
from planning.inverse import POSTURES, joints_from_nozzle
from planning.path import Path, lengths
from planning.robot.kinematics import Distance, JointModel, distance, jacobian

SINGULAR = float(np.deg2rad(5))  # rad from a singular wrist or elbow: there joints turn ten times as fast as the tool
AXIS = 20.0  # mm of the wrist from the first axis: as near, joint 1 turns a whole degree for a third of a millimetre
SPINS = 24  # candidates all round: 15 degrees apart
OK = "ok"
REASONS = (OK, "too far", "joint range", "singular", "joint speed")


@dataclass(frozen=True, slots=True, eq=False)
class Motion:
    """What the surface may do: away from rest by `shift` mm along its normal, by `turn` rad about x, y or z.

    rate: Hz at which it swings so far, for the joints' speed.
    """

    shift: float = 0.0
    turn: float = 0.0
    rate: float = 0.0

    @property
    def places(self) -> Array:
        """rest_from_surface (S, 4, 4), rest itself first."""
        ends = np.concatenate([[np.zeros(6)], *(sign * self.swings[:, :] for sign in (1, -1))])
        return se3.exp(ends[np.concatenate([[True], np.abs(ends[1:]).any(axis=1)])])

    @property
    def swings(self) -> Array:
        """Tangent vectors (4, 6) of the ends of its swings."""
        return np.diag([self.turn] * 3 + [0.0, 0.0, self.shift])[[0, 1, 2, 5]]


@dataclass(frozen=True, slots=True, eq=False)
class Reach:
    """What each of N checkpoints asks of the arm; the worst over where the surface may be.

    joints: (N, 6) rad, at rest. bound, wrist, elbow: (N,) rad and shoulder: (N,) mm, as in joints.Distance.
    manipulability: (N,). speed: (N,) share of the slowest joint's speed, path and surface together. reason: (N,) index
    into REASONS, 0 where it can be printed. spin: (N,) rad that the tool is spun about its axis.
    """

    joints: Array
    bound: Array
    wrist: Array
    elbow: Array
    shoulder: Array
    manipulability: Array
    speed: Array
    reason: NDArray[np.int64]
    spin: Array

    @property
    def feasible(self) -> NDArray[np.bool_]:
        """(N,) which checkpoints can be printed."""
        return np.asarray(self.reason == 0)


def reach_of(
    model: JointModel, arm_from_surface: Array, path: Path, motion: Motion, signs: Array | None = None
) -> Reach:
    """What the path asks of the arm where the surface rests at arm_from_surface (4, 4), in the posture `signs`.

    Without signs in the model's own.
    """
    joints = [
        joints_from_nozzle(model, arm_from_surface @ moved @ path.surface_from_nozzle, signs) for moved in motion.places
    ]
    far = [distance(model, at) for at in joints]
    bound, wrist, elbow, shoulder, least = (
        np.stack([getattr(at, f.name) for at in far]).min(axis=0) for f in fields(Distance)
    )
    speed = _speed(model, joints[0], arm_from_surface, path, motion)
    with np.errstate(invalid="ignore"):
        wrong = [
            ~np.isfinite(np.stack(joints)).all(axis=(0, 2)),
            bound < 0,
            (wrist < SINGULAR) | (elbow < SINGULAR) | (shoulder < AXIS),
            ~(speed <= 1),
        ]
    reason = np.select(wrong, list(range(1, len(REASONS))), 0)
    unspun = np.zeros(len(path))
    return Reach(joints[0], bound, wrist, elbow, shoulder, least, speed, reason.astype(np.int64), unspun)


def best_posture(model: JointModel, arm_from_surface: Array, path: Path, motion: Motion) -> tuple[int, int]:
    """Which of POSTURES can print most checkpoints, and how many; the model's own where it is as good as any."""
    counts = [int(reach_of(model, arm_from_surface, path, motion, signs).feasible.sum()) for signs in POSTURES]
    own = int(np.flatnonzero((model.signs == POSTURES).all(axis=1))[0])
    best = own if counts[own] == max(counts) else int(np.argmax(counts))
    return best, counts[best]


def spun(path: Path, spin: Array) -> Array:
    """surface_from_nozzle (N, 4, 4) of a path whose tool is turned by `spin` (N,), rad, about its own axis."""
    return np.asarray(path.surface_from_nozzle @ se3.make(se3.exp_rotation(np.outer(spin, [0, 0, 1])), np.zeros(3)))


def _speed(model: JointModel, joints: Array, arm_from_surface: Array, path: Path, motion: Motion) -> Array:
    """Share (N,) of the joints' speeds that the way to each checkpoint (or from the first) and the surface take."""
    poses = arm_from_surface @ path.surface_from_nozzle
    step = np.concatenate(
        [
            se3.log_rotation(poses[1:, :3, :3] @ np.swapaxes(poses[:-1, :3, :3], -1, -2)),
            np.diff(poses[:, :3, 3], axis=0),
        ],
        axis=1,
    )
    along = step * (path.speed[1:] / lengths(path.surface_from_nozzle))[:, None]  # (N - 1, 6): turn and tip, per s
    along = np.concatenate([along[:1], along])
    inverse = np.full((len(path), 6, 6), np.nan)
    matrix = jacobian(model, joints)
    regular = np.isfinite(matrix).all(axis=(1, 2)) & (distance(model, joints).manipulability > 1e-6)
    inverse[regular] = np.linalg.inv(matrix[regular])
    asked = np.abs(inverse @ along[..., None])[..., 0]
    pace = 2 * np.pi * motion.rate  # a swing's greatest speed by its height
    for swing in motion.swings @ np.kron(np.eye(2), arm_from_surface[:3, :3].T):
        tip = swing[3:] + np.cross(swing[:3], poses[:, :3, 3] - arm_from_surface[:3, 3])
        turn = np.broadcast_to(swing[:3], tip.shape)
        asked = asked + pace * np.abs(inverse @ np.concatenate([turn, tip], 1)[..., None])[..., 0]
    return np.asarray((asked / model.speed).max(axis=1))
