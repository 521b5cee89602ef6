"""An oracle beside the guard: written from the limits alone, it shares no arithmetic with it.

It looks at all commands of a run at once, afterwards, and takes another way to each number: the surface's speed and the
spread of a place by moving the place a little, the joints by where they bring the nozzle. A verdict is 1 where a limit
is kept, -1 where it is broken and 0 within rounding of it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estimation import se3
from estimation.pose import SurfacePose, TrackState
from estimation.se3 import Array
from planning.kinematics import SimpleArm, joints_from_axes
from planning.limits import Limits
from planning.no_go import NoGo
from planning.robot.kinematics import arm_from_nozzle

Flags = NDArray[np.bool_]
Verdicts = NDArray[np.int_]

ROUNDING = 1e-12  # of a limit
COARSE = 1e-5  # of one whose number is differentiated by steps
SMALL = 1e-5  # rad and mm, or s, of these steps
CLOSER = 40  # thirds: 1e-7 of a way
NEAR = 1e-6  # mm, of a zone's surface
REACHED = 1e-6  # mm and rad: joints that bring the nozzle where it shall be


@dataclass(slots=True)
class Log:
    """What a guard was asked and let pass, in order, a row each; N rows.

    stamps, nows: (N,) s. axes: (N, 6). feeds: (N,). extrude, holds: (N,) bool, whether it was a hold. poses: N of them.
    passed: (N,) bool.
    """

    stamps: Array
    nows: Array
    axes: Array
    feeds: Array
    extrude: Flags
    holds: Flags
    poses: list[SurfacePose | None]
    passed: Flags


@dataclass(frozen=True, slots=True, eq=False)
class Rules:
    """What the guard was told. zone: (2, 3) mm. tick, lag: s."""

    arm: SimpleArm
    limits: Limits
    zone: Array
    tick: float
    lag: float


def judge(log: Log, rules: Rules) -> NDArray[np.int_]:
    """(4,) counts: asked, passed, passed though a limit is broken, refused though all are kept."""
    before = _last(np.where((log.passed & ~log.holds)[:, None], log.axes, np.nan), rules.arm.home)
    order, worth = _order(log), _worth(log, before, rules)
    stopping = _stopping(log, order, worth, before, rules.limits)
    trust = np.where(worth > 0, 1, np.where((worth == 0) & (stopping < 0), 0, stopping))
    parts = [_reach(log, rules), _motion(log, before, rules), _joints(log, before, rules), _zones(log, before, rules)]
    moves = np.minimum.reduce([*parts, trust])
    verdict = np.minimum(order, np.where(log.holds, 1, moves))
    wrong = log.passed & (verdict < 0), ~log.passed & (verdict > 0)
    return np.array([len(verdict), log.passed.sum(), wrong[0].sum(), wrong[1].sum()])


def _within(values: Array, limit: float | Array, rounding: float = ROUNDING) -> Verdicts:
    """Verdicts on values that must not exceed a limit; what is not a number does."""
    kept, near = values <= limit * (1 - rounding), values <= limit * (1 + rounding)
    return np.where(kept, 1, np.where(near, 0, -1))


def _exactly(kept: Flags) -> Verdicts:
    return np.where(kept, 1, -1)


def _every(flags: Flags) -> Flags:
    """Whether all of a row are so (N,)."""
    return np.asarray(flags.all(axis=1), bool)


def _last(rows: Array, first: Array | float) -> Array:
    """The row before each one that is not NaN, `first` where there is none yet."""
    known = ~np.isnan(rows.reshape(len(rows), -1)).any(axis=1)
    index = np.maximum.accumulate(np.where(known, np.arange(len(rows)), -1))
    index = np.concatenate([[-1], index[:-1]])
    filled = np.broadcast_to(first, rows.shape).copy()
    filled[index >= 0] = rows[index[index >= 0]]
    return filled


def _order(log: Log) -> Verdicts:
    after = _last(np.where(log.passed, log.nows, np.nan), -np.inf)
    return _exactly(np.isfinite(log.nows) & (log.stamps == log.nows) & (log.nows > after))


def _reach(log: Log, rules: Rules) -> Verdicts:
    inside = _every((log.axes >= rules.limits.low) & (log.axes <= rules.limits.high))
    feed: Flags = (log.feeds > 0) & (log.feeds <= rules.limits.feed)
    return _exactly(_every(np.isfinite(log.axes)) & inside & feed)


def _motion(log: Log, before: Array, rules: Rules) -> Verdicts:
    limits, way = rules.limits, log.axes - before
    jump = _within(np.sqrt((way[:, :3] ** 2).sum(axis=1)), limits.jump)
    turn = _within(np.abs(way[:, 3:]).max(axis=1), limits.turn)
    speed = _within(np.abs(way), limits.speed * rules.tick).min(axis=1)
    return np.asarray(np.minimum.reduce([jump, turn, speed]))


def _joints(log: Log, before: Array, rules: Rules) -> Verdicts:
    """Verdicts on the joints of an arm that is sent its last three."""
    model = rules.arm.jointed
    if model is None:
        return np.ones(len(log.axes), int)
    axes = np.where(_every(np.isfinite(log.axes))[:, None], log.axes, rules.arm.home)  # judged by _reach
    after, start = joints_from_axes(model, axes), joints_from_axes(model, before)
    known = _every(np.isfinite(after))
    after = np.where(known[:, None], after, 0.0)
    off = np.abs(arm_from_nozzle(model, after)[:, :3, 3] - axes[:, :3]).max(axis=1)
    off = np.maximum(off, np.abs(after[:, 3:] - axes[:, 3:]).max(axis=1))
    inside = _exactly(_every((after >= model.low) & (after <= model.high)))
    speed = _within(np.abs(after - start), model.speed * rules.tick).min(axis=1)
    return np.where(known & (off < REACHED), np.minimum(inside, speed), -1)


def _zones(log: Log, before: Array, rules: Rules) -> Verdicts:
    """Verdicts on the tip's straight ways: how far outside is convex along each, so thirds close in on its least."""
    finite = _every(np.isfinite(log.axes))
    start, end = (
        np.linalg.solve(rules.arm.arm_from_base, np.column_stack([axes[:, :3], np.ones(len(axes))]).T)[:3].T
        for axes in (before, np.where(finite[:, None], log.axes, before))
    )
    verdict = np.ones(len(start), int)
    for zone in rules.limits.zones:
        low, high = np.zeros(len(start)), np.ones(len(start))
        for _ in range(CLOSER):
            left, right = low + (high - low) / 3, high - (high - low) / 3
            nearer = _outside(zone, _between(start, end, left)) < _outside(zone, _between(start, end, right))
            low, high = np.where(nearer, low, left), np.where(nearer, right, high)
        shares = (np.zeros(len(start)), (low + high) / 2, np.ones(len(start)))
        least = np.min([_outside(zone, _between(start, end, share)) for share in shares], axis=0)
        verdict = np.minimum(verdict, np.where(least > NEAR, 1, np.where(least > -NEAR, 0, -1)))
    return np.where(finite, verdict, -1)


def _between(start: Array, end: Array, share: Array) -> Array:
    return start + share[:, None] * (end - start)


def _outside(zone: NoGo, places: Array) -> Array:
    """How far outside a zone places (N, 3) are, mm, along its farthest face; negative inside."""
    faces = (places[:, None] * zone.normals).sum(axis=2) - zone.offsets
    along = places - zone.axis[0]
    axis = zone.axis[1] - zone.axis[0]
    off = along - np.outer(along @ axis / (axis @ axis), axis)
    return np.asarray(np.maximum(faces.max(axis=1), np.sqrt((off**2).sum(axis=1)) - zone.radius))


def _stopping(log: Log, order: Verdicts, worth: Verdicts, before: Array, limits: Limits) -> Verdicts:
    """Verdicts on moves that follow no pose worth it: no ink, and soon and near at rest."""
    sure, perhaps = (_since(log, before, (order > 0) & trusted, limits) for trusted in (worth > 0, worth >= 0))
    either = np.where(sure == perhaps, sure, 0)
    return np.where(log.extrude, -1, either)


def _since(log: Log, before: Array, trusted: Flags, limits: Limits) -> Verdicts:
    at = _last(np.where(trusted, log.nows, np.nan), -np.inf)
    place = _last(np.where(trusted[:, None], before, np.nan), np.nan)
    way = np.sqrt(((log.axes - place)[:, :3] ** 2).sum(axis=1))
    return np.minimum(_within(log.nows - at, limits.stop_time), _within(way, limits.stop_distance))


def _worth(log: Log, before: Array, rules: Rules) -> Verdicts:
    """Verdicts on the poses."""
    there = np.array([pose is not None for pose in log.poses])
    poses = [_standing(now) if pose is None else pose for pose, now in zip(log.poses, log.nows, strict=True)]
    numbers = [np.array([getattr(pose, name) for pose in poses]) for name in _NUMBERS]
    stamps, base, covariance, twist, drift, psd = numbers
    finite = np.all([np.isfinite(n.reshape(len(n), -1)).all(axis=1) for n in numbers], axis=0)
    measured = np.array([pose.state in (TrackState.TRACKING, TrackState.DEGRADED) for pose in poses])
    age = log.nows - stamps
    ahead = (age + rules.tick + rules.lag)[:, None, None]
    spread = covariance + ahead**2 * drift + ahead**3 / 3 * (psd[:, :, None] * np.eye(6))
    usable = finite[:, None, None]
    place = _place(np.where(usable, base, np.eye(4)), before, rules)
    error, speed = _error(place, np.where(usable, spread, 0.0)), _speed(place, np.where(finite[:, None], twist, 0.0))
    limits = rules.limits
    verdicts = [
        _exactly(there & finite & measured),
        _exactly(age >= 0),
        _within(age, limits.pose_age),
        _within(error, limits.pose_error, COARSE),
        _within(speed, limits.surface_speed, COARSE),
        _within(np.sqrt((twist[:, :3] ** 2).sum(axis=1)), limits.surface_turn),
    ]
    return np.asarray(np.minimum.reduce(verdicts))


_NUMBERS = ("stamp", "base_from_surface", "covariance", "twist", "twist_covariance", "acceleration_psd")


def _standing(stamp: float) -> SurfacePose:
    """Stands in for a pose that is not there."""
    return SurfacePose(stamp, np.eye(4), np.zeros((6, 6)), np.zeros(6), TrackState.LOST)


def _place(base_from_surface: Array, axes: Array, rules: Rules) -> Array:
    """Where in the zone the nozzle is, or is nearest to (N, 3), in the surface frame. The tip is at X Y Z."""
    tip = np.column_stack([axes[:, :3], np.ones(len(axes))])
    arm_from_surface = rules.arm.arm_from_base @ base_from_surface
    return np.clip(np.linalg.solve(arm_from_surface, tip[:, :, None])[:, :3, 0], *rules.zone)


def _moved(place: Array, by: Array) -> Array:
    """Places (N, 3) after small motions (..., 6) of the surface under them, in its own frame."""
    return np.asarray((se3.exp(by) @ np.concatenate([place, np.ones((len(place), 1))], 1)[:, :, None])[:, :3, 0])


def _speed(place: Array, twist: Array) -> Array:
    return np.asarray(
        np.linalg.norm(_moved(place, SMALL * twist) - _moved(place, -SMALL * twist), axis=1) / (2 * SMALL)
    )


def _error(place: Array, spread: Array) -> Array:
    """Standard deviation (N,), mm, of places (N, 3) along the worst direction, for covariances (N, 6, 6)."""
    steps = SMALL * np.eye(6)
    columns = [_moved(place, step[None]) - _moved(place, -step[None]) for step in steps]
    jacobian = np.stack(columns, axis=-1) / (2 * SMALL)
    variance = np.linalg.norm(jacobian @ spread @ np.swapaxes(jacobian, 1, 2), 2, axis=(1, 2))
    return np.asarray(np.sqrt(variance))
