"""Whether an arm can print a path: joint ranges, joint speeds and singularities at each checkpoint.

Each checkpoint is checked on the surface at rest and at every place that the surface is expected to move to. Material
leaves along the tool's axis, so the spin about it is free; it can be chosen for a whole path at once.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import NDArray

from estimation import se3
from estimation.se3 import Array
from planning.kinematics import POSTURES, JointDistance, JointModel, jacobian, joint_distance, joints_from_nozzle
from planning.path import Path, way_lengths

# rad from a singular wrist or elbow: there joints turn ten times as fast as the tool
MIN_SINGULAR_ANGLE = float(np.deg2rad(5))
# mm of the wrist from the first axis: as near, joint 1 turns a whole degree for a third of a millimetre
MIN_SHOULDER_DISTANCE = 20.0
SPIN_CANDIDATES = 24  # candidates all round: 15 degrees apart
REACHABLE = "ok"
REACH_REASONS = (REACHABLE, "too far", "joint range", "singular", "joint speed")
UNREACHABLE_COST = 1e3  # no smoothness is worth a checkpoint that cannot be printed
SPIN_STEP_COST = 1.0  # of a spin by one candidate from one checkpoint to the next
RANGE_END_COST = 1.0  # per rad that a joint is nearer than RANGE_END_ANGLE to the end of its range
RANGE_END_ANGLE = float(np.deg2rad(30))


@dataclass(frozen=True, slots=True, eq=False)
class SurfaceMotion:
    """The expected motion of the surface about its rest."""

    shift: float = 0.0  # mm along its normal
    turn: float = 0.0  # rad about x, y or z
    rate: float = 0.0  # Hz of these swings, for the joints' speed

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
    """The reach of N checkpoints, the worst over the places of the surface; distances as in JointDistance."""

    joints: Array  # (N, 6) rad, with the surface at rest
    bound: Array  # (N,) rad
    wrist: Array  # (N,) rad
    elbow: Array  # (N,) rad
    shoulder: Array  # (N,) mm
    manipulability: Array  # (N,)
    speed: Array  # (N,) largest share of a joint's speed limit, for path and surface together
    reason: NDArray[np.int64]  # (N,) index into REACH_REASONS, 0 where it can be printed
    spin: Array  # (N,) rad that the tool is spun about its axis

    @property
    def feasible(self) -> NDArray[np.bool_]:
        """(N,) which checkpoints can be printed."""
        return np.asarray(self.reason == 0)


def reach_of(
    model: JointModel, arm_from_surface: Array, path: Path, motion: SurfaceMotion, signs: Array | None = None
) -> Reach:
    """The reach where the surface rests at arm_from_surface (4, 4), in the posture `signs` or the model's own."""
    moved = [arm_from_surface @ place @ path.surface_from_nozzle for place in motion.places]
    joints = [joints_from_nozzle(model, poses, signs) for poses in moved]
    distances = [joint_distance(model, at) for at in joints]
    bound, wrist, elbow, shoulder, manipulability = (
        np.stack([getattr(d, f.name) for d in distances]).min(axis=0) for f in fields(JointDistance)
    )
    speed = _speed(model, joints[0], arm_from_surface, path, motion)
    with np.errstate(invalid="ignore"):
        wrong = [
            ~np.isfinite(np.stack(joints)).all(axis=(0, 2)),
            bound < 0,
            (wrist < MIN_SINGULAR_ANGLE) | (elbow < MIN_SINGULAR_ANGLE) | (shoulder < MIN_SHOULDER_DISTANCE),
            ~(speed <= 1),
        ]
    reason = np.select(wrong, list(range(1, len(REACH_REASONS))), 0)
    unspun = np.zeros(len(path))
    return Reach(joints[0], bound, wrist, elbow, shoulder, manipulability, speed, reason.astype(np.int64), unspun)


def best_posture(model: JointModel, arm_from_surface: Array, path: Path, motion: SurfaceMotion) -> tuple[int, int]:
    """Which of POSTURES can print most checkpoints, and how many; the model's own where it is as good as any."""
    counts = [int(reach_of(model, arm_from_surface, path, motion, signs).feasible.sum()) for signs in POSTURES]
    own = int(np.flatnonzero((model.signs == POSTURES).all(axis=1))[0])
    best = own if counts[own] == max(counts) else int(np.argmax(counts))
    return best, counts[best]


def spin_path(path: Path, spin: Array) -> Array:
    """surface_from_nozzle (N, 4, 4) of a path whose tool is turned by `spin` (N,), rad, about its own axis."""
    return np.asarray(path.surface_from_nozzle @ se3.make(se3.exp_rotation(np.outer(spin, [0, 0, 1])), np.zeros(3)))


def _speed(model: JointModel, joints: Array, arm_from_surface: Array, path: Path, motion: SurfaceMotion) -> Array:
    """Share (N,) of the joints' speeds that the way to each checkpoint (or from the first) and the surface take."""
    poses = arm_from_surface @ path.surface_from_nozzle
    turns = se3.log_rotation(poses[1:, :3, :3] @ np.swapaxes(poses[:-1, :3, :3], -1, -2))
    step = np.concatenate([turns, np.diff(poses[:, :3, 3], axis=0)], axis=1)
    along = step * (path.speed[1:] / way_lengths(path.surface_from_nozzle))[:, None]  # (N - 1, 6): turn and tip, per s
    along = np.concatenate([along[:1], along])
    inverse = np.full((len(path), 6, 6), np.nan)
    matrix = jacobian(model, joints)
    regular = np.isfinite(matrix).all(axis=(1, 2)) & (joint_distance(model, joints).manipulability > 1e-6)
    inverse[regular] = np.linalg.inv(matrix[regular])
    speeds = np.abs(inverse @ along[..., None])[..., 0]
    pace = 2 * np.pi * motion.rate  # a swing's greatest speed by its height
    for swing in motion.swings @ np.kron(np.eye(2), arm_from_surface[:3, :3].T):
        tip = swing[3:] + np.cross(swing[:3], poses[:, :3, 3] - arm_from_surface[:3, 3])
        turn = np.broadcast_to(swing[:3], tip.shape)
        speeds = speeds + pace * np.abs(inverse @ np.concatenate([turn, tip], 1)[..., None])[..., 0]
    return np.asarray((speeds / model.speed).max(axis=1))


def best_spin(model: JointModel, arm_from_surface: Array, path: Path, motion: SurfaceMotion) -> Array:
    """Spin (N,), rad, at each checkpoint: dynamic programming over SPINS candidates (Viterbi 1967).

    From one checkpoint to the next the tool spins by one candidate at most. The way back takes the path that costs
    least over all checkpoints: those that cannot be reached first, then spins, then joints near their ends.
    """
    candidates = np.linspace(-np.pi, np.pi, SPIN_CANDIDATES, endpoint=False)
    cost = np.stack([_cost(reach_at_spin(model, arm_from_surface, path, motion, s)) for s in candidates])  # (K, N)
    best, previous = cost[:, 0] + 1e-3 * np.abs(candidates), np.zeros((len(path), SPIN_CANDIDATES), np.int64)
    for i in range(1, len(path)):
        options = np.stack([best, np.roll(best, 1) + SPIN_STEP_COST, np.roll(best, -1) + SPIN_STEP_COST])
        choice = options.argmin(axis=0)
        previous[i] = (np.arange(SPIN_CANDIDATES) - np.array([0, 1, -1])[choice]) % SPIN_CANDIDATES
        best = options.min(axis=0) + cost[:, i]
    chosen = np.empty(len(path), np.int64)
    chosen[-1] = best.argmin()
    for i in range(len(path) - 1, 0, -1):
        chosen[i - 1] = previous[i, chosen[i]]
    return np.unwrap(candidates[chosen])


def reach_at_spin(
    model: JointModel, arm_from_surface: Array, path: Path, motion: SurfaceMotion, spin: Array | float
) -> Reach:
    """The reach with the tool turned by `spin`, rad, one for all or (N,)."""
    spins = np.broadcast_to(np.asarray(spin, float), len(path))
    turned = replace(path, surface_from_nozzle=spin_path(path, spins))
    return replace(reach_of(model, arm_from_surface, turned, motion), spin=spins)


def _cost(reach: Reach) -> Array:
    near_end = np.maximum(RANGE_END_ANGLE - np.nan_to_num(reach.bound), 0.0)
    return np.where(reach.feasible, RANGE_END_COST * near_end, UNREACHABLE_COST)
