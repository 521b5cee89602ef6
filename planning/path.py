"""The printing path, checked that it can be printed, how far a print of it is, and where a later one goes on.

Checkpoints lie on the surface in printing order (thesis 5.2). Whether an arm reaches them: joint ranges, joint speeds
and singularities at each, on the surface at rest and at every place that it is expected to move to. Material leaves
along the tool's axis, so the spin about it is free; it can be chosen for a whole path at once.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from enum import Enum
from math import floor

import numpy as np
from numpy.typing import NDArray

from estimation import se3
from estimation.errors import InputError
from estimation.se3 import Array
from planning.kinematics import (
    POSTURES,
    JointDistance,
    JointModel,
    SimpleArm,
    jacobian,
    joint_distance,
    joints_from_nozzle,
    tool_lean,
)

LEVER_ARM = 10.0  # mm per rad: the length that a turn counts as, and so the time that a turn on the spot takes
MIN_SPACING = 1e-3  # mm: checkpoints that are nearer, turn included, have no direction between them
MAX_COORDINATE = 1000.0  # mm: beyond, the unit is wrong (the arm reaches 650 mm)
MAX_SPEED = 200.0  # mm/s: above, the unit is wrong (bioprinting is 1 to 30 mm/s, the arm's top speed 250)
MIN_TEMPERATURE, MAX_TEMPERATURE = -50.0, 500.0  # degrees C: far below and above any bio-ink or thermoplastic


Column = NDArray[np.int64] | NDArray[np.float64] | NDArray[np.str_]


@dataclass(frozen=True, slots=True, eq=False)
class Path:
    """N >= 2 checkpoints as parallel arrays.

    The nozzle frame has its origin at the tip and z from the tip back into the tool: material leaves along -z. Where
    its axes are those of the surface frame, the tool stands upright on the surface.
    """

    surface_from_nozzle: Array  # (N, 4, 4) mm
    speed: Array  # (N,) mm/s, on the way to each checkpoint
    material: NDArray[np.int64] | NDArray[np.str_]  # (N,)
    temperature: Array  # (N,) degrees C
    layer: NDArray[np.int64]  # (N,)
    extrude: NDArray[np.bool_]  # (N,) whether it extrudes on the way to each checkpoint
    extra: Mapping[str, Column] = field(default_factory=dict)  # further named columns (N,): numbers where all are

    def __len__(self) -> int:
        return len(self.speed)

    def __repr__(self) -> str:
        more = f", {', '.join(self.extra)}" if self.extra else ""
        return f"Path({len(self)} checkpoints, {len(np.unique(self.layer))} layers{more})"

    @property
    def zone(self) -> Array:
        """Low and high corner (2, 3) of the box around all checkpoints, surface frame, mm."""
        places = self.surface_from_nozzle[:, :3, 3]
        return np.stack([places.min(axis=0), places.max(axis=0)])


def check_path(
    path: Path,
    where: object = "path",
    lines: Sequence[int] | None = None,
    columns: Mapping[str, tuple[str, Sequence[str]]] | None = None,
) -> Path:
    """The path itself if it can be printed; else InputError names the first checkpoint that cannot.

    where, lines: the file, and each checkpoint's line in it, for the message; without lines, checkpoints count from 0.
    columns: of `speed` and `temperature` the file's column and each checkpoint's text there, for the message as well.
    Refused are fewer than two checkpoints, columns of unequal length, transforms that are no rigid motion, places,
    speeds and temperatures out of range, and two successive checkpoints at one place.
    """
    count = len(path.surface_from_nozzle)
    if count < 2:
        raise InputError(where, "checkpoints", count, "2 or more")
    own = {f.name: getattr(path, f.name) for f in fields(path) if f.name != "extra"}
    for column, values in (own | dict(path.extra)).items():
        if len(values) != count:
            raise InputError(where, column, f"{len(values)} values", f"{count}, one for each checkpoint")

    def name(i: int) -> str:
        return f"checkpoint {i}" if lines is None else f"line {lines[i]}"

    def wrong(i: int, value: str, got: object, allowed: str) -> InputError:
        header, texts = (columns or {}).get(value, (value, None))
        return InputError(where, f"{name(i)}: {header}", got if texts is None else texts[i], allowed)

    if (i := _first(~_rigid(path.surface_from_nozzle))) is not None:
        transform = path.surface_from_nozzle[i].tolist()
        raise InputError(where, f"{name(i)}: surface_from_nozzle", transform, "a finite rigid motion, mm")
    if (i := _first(np.abs(path.surface_from_nozzle[:, :3, 3]).max(1) > MAX_COORDINATE)) is not None:
        place = path.surface_from_nozzle[i, :3, 3].tolist()
        raise InputError(where, f"{name(i)}: position", place, f"within {MAX_COORDINATE:g} mm of the surface's origin")
    speed, heat = path.speed, path.temperature
    if (i := _first(~((speed > 0) & (speed <= MAX_SPEED)))) is not None:  # NaN fails every comparison
        raise wrong(i, "speed", float(speed[i]), f"0 < speed <= {MAX_SPEED:g} mm/s")
    if (i := _first(~((heat >= MIN_TEMPERATURE) & (heat <= MAX_TEMPERATURE)))) is not None:
        raise wrong(i, "temperature", float(heat[i]), f"{MIN_TEMPERATURE:g} to {MAX_TEMPERATURE:g} degrees C")
    if (i := _first(way_lengths(path.surface_from_nozzle) < MIN_SPACING)) is not None:
        place = path.surface_from_nozzle[i + 1, :3, 3].tolist()
        raise InputError(where, f"{name(i + 1)}: position", place, f"{MIN_SPACING:g} mm or more from {name(i)}")
    return path


def way_lengths(surface_from_nozzle: Array) -> Array:
    """Lengths (N-1,), mm, between poses (N, 4, 4): the longer of the move and of the turn times LEVER_ARM."""
    return lengths_from(*moves_and_turns(surface_from_nozzle))


def ways_along(surface_from_nozzle: Array) -> Array:
    """Way (N,), mm, from the first of poses (N, 4, 4) to each, by `way_lengths`."""
    return np.concatenate([[0.0], np.cumsum(way_lengths(surface_from_nozzle))])


def moves_and_turns(surface_from_nozzle: Array) -> tuple[Array, Array]:
    """Moves (N-1, 3), mm, and turns (N-1, 3), body vectors in rad, between poses (N, 4, 4)."""
    rotations = surface_from_nozzle[:, :3, :3]
    turns = se3.log_rotation(np.swapaxes(rotations[:-1], -1, -2) @ rotations[1:])
    return np.diff(surface_from_nozzle[:, :3, 3], axis=0), turns


def lengths_from(moves: Array, turns: Array) -> Array:
    """`way_lengths` of ways by their moves (M, 3), mm, and turns (M, 3), rad."""
    return np.asarray(np.maximum(np.linalg.norm(moves, axis=1), LEVER_ARM * np.linalg.norm(turns, axis=1)))


def _first(wrong: NDArray[np.bool_]) -> int | None:
    indices = np.flatnonzero(wrong)
    return int(indices[0]) if len(indices) else None


def _rigid(transforms: Array) -> NDArray[np.bool_]:
    """Which (N,) of transforms (N, 4, 4) are rigid motions, by the test of se3.is_transform."""
    r = transforms[:, :3, :3]
    with np.errstate(invalid="ignore"):  # where a number is not finite, isfinite decides
        off = np.abs(r @ np.swapaxes(r, -1, -2) - np.eye(3)).max((1, 2))
        last = np.abs(transforms[:, 3] - [0, 0, 0, 1]).max(1)
        rigid = np.isfinite(transforms).all((1, 2)) & (off < 1e-5) & (last < 1e-5) & (np.linalg.det(r) > 0)
    return np.asarray(rigid)


class PrintPhase(Enum):
    """What the nozzle is doing."""

    WAITING = "waiting"  # at rest, nothing begun
    ENTERING = "entering"  # on the way to where printing begins or goes on
    PRINTING = "printing"
    RETREATING = "retreating"  # up from the surface in a pause, and then at rest above it
    LEAVING = "leaving"  # on the way up from the last checkpoint
    FINISHED = "finished"


LOOK = "(a look)"  # wanted where the needle stands aside until what was laid has been looked at; no material's name


@dataclass(frozen=True, slots=True)
class PrintProgress:
    """How far the print is."""

    phase: PrintPhase
    checkpoint: int  # the one being printed
    total: int  # checkpoints
    place: float  # mm of the path
    length: float  # mm of the whole path
    fraction: float  # the place in checkpoints: 2.35 is 35 % of the way from checkpoint 2 to 3
    wanted: str = ""  # material that an operator has to put in before it goes on, or LOOK; "" if none

    @property
    def printed(self) -> int:
        """The last checkpoint that is done."""
        return floor(self.fraction)

    @property
    def next(self) -> int | None:
        """The checkpoint after the one being printed; None where there is none."""
        return self.checkpoint + 1 if self.checkpoint + 1 < self.total else None


@dataclass(frozen=True, slots=True)
class ProgressMark:
    """Where a print stopped."""

    path: str  # fingerprint of its path
    fraction: float  # place in checkpoints


def progress_mark(path: Path, progress: PrintProgress) -> ProgressMark:
    """The record of a print of `path` that is as far as `progress` says."""
    return ProgressMark(fingerprint(path), progress.fraction)


def resume_fraction(path: Path, mark: ProgressMark, where: object = "bookmark") -> float:
    """The fraction at which a print of `path` goes on; InputError if the record is of another path or lies outside."""
    if mark.path != (own := fingerprint(path)):
        raise InputError(where, "path", mark.path, f"{own}, the fingerprint of the path to be printed")
    return check_start(path, mark.fraction, where)


def check_start(path: Path, fraction: float, where: object = "planner") -> float:
    """The fraction itself if it is a place on the path, counted in checkpoints; else InputError."""
    if not 0 <= fraction <= len(path) - 1:
        raise InputError(where, "fraction", fraction, f"0 to {len(path) - 1} checkpoints")
    return fraction


def fingerprint(path: Path) -> str:
    """A short name of all that is printed: places, speeds, materials, temperatures, layers, extrusion."""
    digest = hashlib.sha256()
    for column in (path.surface_from_nozzle, path.speed, path.temperature, path.layer, path.extrude):
        digest.update(np.ascontiguousarray(column).tobytes())
    digest.update("\n".join(map(str, path.material.tolist())).encode())
    return digest.hexdigest()[:16]


# rad from a singular wrist or elbow: there joints turn ten times as fast as the tool
MIN_SINGULAR_ANGLE = float(np.deg2rad(5))
# mm of the wrist from the first axis: as near, joint 1 turns a whole degree for a third of a millimetre
MIN_SHOULDER_DISTANCE = 20.0
SPIN_CANDIDATES = 24  # candidates all round: 15 degrees apart
REACHABLE = "ok"
TISSUE = "tool meets tissue"
LEANS = "tool leans too far"
REACH_REASONS = (REACHABLE, "too far", "joint range", "singular", "joint speed", TISSUE, LEANS)
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

    joints: Array  # (N, J) rad, with the surface at rest
    bound: Array  # (N,) rad
    wrist: Array  # (N,) rad
    elbow: Array  # (N,) rad
    shoulder: Array  # (N,) mm
    manipulability: Array  # (N,)
    speed: Array  # (N,) largest share of a joint's speed limit, for path and surface together
    reason: NDArray[np.int64]  # (N,) index into REACH_REASONS, 0 where it can be printed
    spin: Array  # (N,) rad that the tool is spun about its axis
    lean: Array | None = None  # (N,) rad that the tool of a machine that does not turn leans against the path's

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
    reason = np.select(wrong, list(range(1, len(wrong) + 1)), 0)
    unspun = np.zeros(len(path))
    return Reach(joints[0], bound, wrist, elbow, shoulder, manipulability, speed, reason.astype(np.int64), unspun)


def unturned_reach(arm: SimpleArm, speed: Array, arm_from_surface: Array, path: Path, motion: SurfaceMotion) -> Reach:
    """The reach of a machine that does not turn and has no joints. speed: (3,) mm/s that its X Y Z may do."""
    poses = np.stack([arm_from_surface @ place @ path.surface_from_nozzle for place in motion.places])
    lean = tool_lean(arm, poses).max(axis=0)
    tip = np.broadcast_to(np.eye(6)[3:], (len(path), 3, 6))
    share = joint_speed_share(tip, speed, arm_from_surface, path, motion)
    assert arm.max_lean is not None
    reason = np.select([lean > arm.max_lean, ~(share <= 1)], [REACH_REASONS.index(LEANS), 4], 0).astype(np.int64)
    unknown = np.full(len(path), np.nan)
    joints, spin = np.full((len(path), 6), np.nan), np.zeros(len(path))
    return Reach(joints, unknown, unknown, unknown, unknown, unknown, share, reason, spin, lean)


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
    inverse = np.full((len(path), 6, 6), np.nan)
    matrix = jacobian(model, joints)
    regular = np.isfinite(matrix).all(axis=(1, 2)) & (joint_distance(model, joints).manipulability > 1e-6)
    inverse[regular] = np.linalg.inv(matrix[regular])
    return joint_speed_share(inverse, model.speed, arm_from_surface, path, motion)


def joint_speed_share(
    inverse: Array, limit: Array, arm_from_surface: Array, path: Path, motion: SurfaceMotion
) -> Array:
    """The same by the inverse (N, J, 6) of the Jacobian, turn and then tip, and the joints' limits (J,), rad/s."""
    poses = arm_from_surface @ path.surface_from_nozzle
    turns = se3.log_rotation(poses[1:, :3, :3] @ np.swapaxes(poses[:-1, :3, :3], -1, -2))
    step = np.concatenate([turns, np.diff(poses[:, :3, 3], axis=0)], axis=1)
    along = step * (path.speed[1:] / way_lengths(path.surface_from_nozzle))[:, None]  # (N - 1, 6): turn and tip, per s
    along = np.concatenate([along[:1], along])
    speeds = np.abs(inverse @ along[..., None])[..., 0]
    pace = 2 * np.pi * motion.rate  # a swing's greatest speed by its height
    for swing in motion.swings @ np.kron(np.eye(2), arm_from_surface[:3, :3].T):
        tip = swing[3:] + np.cross(swing[:3], poses[:, :3, 3] - arm_from_surface[:3, 3])
        turn = np.broadcast_to(swing[:3], tip.shape)
        speeds = speeds + pace * np.abs(inverse @ np.concatenate([turn, tip], 1)[..., None])[..., 0]
    return np.asarray((speeds / limit).max(axis=1))


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
