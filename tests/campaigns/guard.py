"""`python -m tests.campaigns guard`: random commands before the guard, on and beside all its limits.

An independent oracle judges. It is written from the limits alone and shares no arithmetic with the guard. It judges all
commands of a run at once, afterwards, and computes each number in another way: the surface's speed and a point's
standard deviation by small steps of the point, the joints by forward kinematics. A verdict is 1 where a limit is kept,
-1 where it is broken and 0 within rounding of it.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from estimation import se3
from estimation.pose import SurfacePose, TrackState
from estimation.se3 import Array
from hardware.bench.figures import Figure, at_most, columns
from perception import shipped_file
from planning.command import Command, Hold, MotionLimits, Move, NoGo, box, cylinder, half_space
from planning.kinematics import SimpleArm, joints_from_axes, nozzle_from_joints
from planning.motion.guard import Guard

Flags = NDArray[np.bool_]
Verdicts = NDArray[np.int_]

ROUNDING_SHARE = 1e-12  # of a limit
DIFFERENCE_ERROR = 1e-5  # of a limit whose number is differentiated by steps
DIFFERENCE_STEP = 1e-5  # rad and mm, or s, of these steps
ZONE_THIRDS = 40  # ternary search steps: 1e-7 of a segment
ZONE_MARGIN = 1e-6  # mm, of a zone's surface
REACH_TOLERANCE = 1e-6  # mm and rad, of the nozzle by forward kinematics


@dataclass(slots=True)
class GuardLog:
    """The commands a guard was given, in order, N rows."""

    stamps: Array  # (N,) s, as the command states it
    nows: Array  # (N,) s, when the guard was asked
    axes: Array  # (N, 6)
    feeds: Array  # (N,)
    extrude: Flags  # (N,)
    holds: Flags  # (N,) whether it was a Hold
    poses: list[SurfacePose | None]  # N
    passed: Flags  # (N,)


@dataclass(frozen=True, slots=True, eq=False)
class GuardRules:
    """The parameters of a guard."""

    arm: SimpleArm
    limits: MotionLimits
    zone: Array  # (2, 3) mm
    tick: float  # s
    lag: float  # s


def judge_guard(log: GuardLog, rules: GuardRules) -> NDArray[np.int_]:
    """(4,) counts: all commands, passed, passed though a limit is broken, refused though all are kept."""
    before = _last(np.where((log.passed & ~log.holds)[:, None], log.axes, np.nan), rules.arm.home)
    after = _last(np.where(log.passed, log.nows, np.nan), -np.inf)
    order = _exactly(np.isfinite(log.nows) & (log.stamps == log.nows) & (log.nows > after))
    pose = _pose_verdicts(log, before, rules)
    # moves that follow no trusted pose: no ink, and soon and near at rest
    trusted = ((order > 0) & flags for flags in (pose > 0, pose >= 0))
    sure, perhaps = (_since_trusted(log, before, flags, rules.limits) for flags in trusted)
    stopping = np.where(log.extrude, -1, np.where(sure == perhaps, sure, 0))
    trust = np.where(pose > 0, 1, np.where((pose == 0) & (stopping < 0), 0, stopping))
    parts = [_reach(log, rules), _motion(log, before, rules), _joints(log, before, rules), _zones(log, before, rules)]
    verdict = np.minimum(order, np.where(log.holds, 1, np.minimum.reduce([*parts, trust])))
    wrong = log.passed & (verdict < 0), ~log.passed & (verdict > 0)
    return np.array([len(verdict), log.passed.sum(), wrong[0].sum(), wrong[1].sum()])


def _within(values: Array, limit: float | Array, rounding: float = ROUNDING_SHARE) -> Verdicts:
    """Verdicts on values that must not exceed a limit; NaN does."""
    inside, near = values <= limit * (1 - rounding), values <= limit * (1 + rounding)
    return np.where(inside, 1, np.where(near, 0, -1))


def _exactly(flags: Flags) -> Verdicts:
    return np.where(flags, 1, -1)


def _last(rows: Array, first: Array | float) -> Array:
    """The last row before each one that is not NaN, `first` where there is none yet."""
    known = ~np.isnan(rows.reshape(len(rows), -1)).any(axis=1)
    index = np.maximum.accumulate(np.where(known, np.arange(len(rows)), -1))
    index = np.concatenate([[-1], index[:-1]])
    filled = np.broadcast_to(first, rows.shape).copy()
    filled[index >= 0] = rows[index[index >= 0]]
    return filled


def _reach(log: GuardLog, rules: GuardRules) -> Verdicts:
    inside = np.isfinite(log.axes) & (log.axes >= rules.limits.low) & (log.axes <= rules.limits.high)
    return _exactly(inside.all(axis=1) & (log.feeds > 0) & (log.feeds <= rules.limits.feed))


def _motion(log: GuardLog, before: Array, rules: GuardRules) -> Verdicts:
    limits, way = rules.limits, log.axes - before
    jump = _within(np.sqrt((way[:, :3] ** 2).sum(axis=1)), limits.jump)
    turn = _within(np.abs(way[:, 3:]).max(axis=1), limits.turn)
    speed = _within(np.abs(way), limits.speed * rules.tick).min(axis=1)
    return np.asarray(np.minimum.reduce([jump, turn, speed]))


def _joints(log: GuardLog, before: Array, rules: GuardRules) -> Verdicts:
    """Verdicts on the joints of an arm that is sent its last three."""
    model = rules.arm.jointed
    if model is None:
        return np.ones(len(log.axes), int)
    finite = np.all(np.isfinite(log.axes), axis=1)
    axes = np.where(finite[:, None], log.axes, rules.arm.home)  # judged by _reach
    after, start = joints_from_axes(model, axes), joints_from_axes(model, before)
    known = np.all(np.isfinite(after), axis=1)
    after = np.where(known[:, None], after, 0.0)
    error = np.abs(nozzle_from_joints(model, after)[:, :3, 3] - axes[:, :3]).max(axis=1)
    error = np.maximum(error, np.abs(after[:, 3:] - axes[:, 3:]).max(axis=1))
    inside = _exactly(np.all((after >= model.low) & (after <= model.high), axis=1))
    speed = _within(np.abs(after - start), model.speed * rules.tick).min(axis=1)
    return np.where(known & (error < REACH_TOLERANCE), np.minimum(inside, speed), -1)


def _zones(log: GuardLog, before: Array, rules: GuardRules) -> Verdicts:
    """Verdicts on the tip's straight segments: ternary search for the least distance outside, convex along each."""
    finite = np.all(np.isfinite(log.axes), axis=1)
    start, end = (
        np.linalg.solve(rules.arm.arm_from_base, np.column_stack([axes[:, :3], np.ones(len(axes))]).T)[:3].T
        for axes in (before, np.where(finite[:, None], log.axes, before))
    )
    verdict = np.ones(len(start), int)
    for zone in rules.limits.zones:
        low, high = np.zeros(len(start)), np.ones(len(start))
        for _ in range(ZONE_THIRDS):
            left, right = low + (high - low) / 3, high - (high - low) / 3
            nearer = _outside(zone, start, end, left) < _outside(zone, start, end, right)
            low, high = np.where(nearer, low, left), np.where(nearer, right, high)
        shares = (np.zeros(len(start)), (low + high) / 2, np.ones(len(start)))
        least = np.min([_outside(zone, start, end, share) for share in shares], axis=0)
        verdict = np.minimum(verdict, np.where(least > ZONE_MARGIN, 1, np.where(least > -ZONE_MARGIN, 0, -1)))
    return np.where(finite, verdict, -1)


def _outside(zone: NoGo, start: Array, end: Array, share: Array) -> Array:
    """Distance (N,), mm, outside a zone by its farthest face, negative inside, at a share (N,) of segments (N, 3)."""
    places = start + share[:, None] * (end - start)
    faces = (places[:, None] * zone.normals).sum(axis=2) - zone.offsets
    along = places - zone.axis[0]
    axis = zone.axis[1] - zone.axis[0]
    off = along - np.outer(along @ axis / (axis @ axis), axis)
    return np.asarray(np.maximum(faces.max(axis=1), np.sqrt((off**2).sum(axis=1)) - zone.radius))


def _since_trusted(log: GuardLog, before: Array, trusted: Flags, limits: MotionLimits) -> Verdicts:
    """Verdicts on time and way since the last command with a trusted pose."""
    at = _last(np.where(trusted, log.nows, np.nan), -np.inf)
    place = _last(np.where(trusted[:, None], before, np.nan), np.nan)
    way = np.sqrt(((log.axes - place)[:, :3] ** 2).sum(axis=1))
    return np.minimum(_within(log.nows - at, limits.stop_time), _within(way, limits.stop_distance))


def _pose_verdicts(log: GuardLog, before: Array, rules: GuardRules) -> Verdicts:
    """Verdicts on the poses; a pose that is not there is replaced by a LOST one, and refused."""
    none = np.eye(4), np.zeros((6, 6)), np.zeros(6), TrackState.LOST
    there = np.array([pose is not None for pose in log.poses])
    poses = [pose or SurfacePose(now, *none) for pose, now in zip(log.poses, log.nows, strict=True)]
    numbers = columns(poses, *_POSE_NUMBERS)
    stamps, base, covariance, twist, drift, psd = numbers
    finite = np.all([np.isfinite(n.reshape(len(n), -1)).all(axis=1) for n in numbers], axis=0)
    measured = np.array([pose.state in (TrackState.TRACKING, TrackState.DEGRADED) for pose in poses])
    age = log.nows - stamps
    ahead = (age + rules.tick + rules.lag)[:, None, None]
    spread = covariance + ahead**2 * drift + ahead**3 / 3 * (psd[:, :, None] * np.eye(6))
    usable = finite[:, None, None]
    # the point of the print zone, surface frame, where the nozzle is or to which it is nearest; the tip is at X Y Z
    arm_from_surface = rules.arm.arm_from_base @ np.where(usable, base, np.eye(4))
    tip = np.column_stack([before[:, :3], np.ones(len(before))])
    place = np.clip(np.linalg.solve(arm_from_surface, tip[:, :, None])[:, :3, 0], *rules.zone)
    velocity = _differentiated(place, np.where(finite[:, None], twist, 0.0))
    jacobian = np.stack([_differentiated(place, axis[None]) for axis in np.eye(6)], axis=-1)
    # standard deviation along the worst direction
    position_covariance = jacobian @ np.where(usable, spread, 0.0) @ np.swapaxes(jacobian, 1, 2)
    error = np.sqrt(np.linalg.norm(position_covariance, 2, axis=(1, 2)))
    limits = rules.limits
    verdicts = [
        _exactly(there & finite & measured),
        _exactly(age >= 0),
        _within(age, limits.pose_age),
        _within(error, limits.pose_error, DIFFERENCE_ERROR),
        _within(np.linalg.norm(velocity, axis=1), limits.surface_speed, DIFFERENCE_ERROR),
        _within(np.sqrt((twist[:, :3] ** 2).sum(axis=1)), limits.surface_turn),
    ]
    return np.asarray(np.minimum.reduce(verdicts))


_POSE_NUMBERS = ("stamp", "base_from_surface", "covariance", "twist", "twist_covariance", "acceleration_psd")


def _differentiated(place: Array, twist: Array) -> Array:
    """Velocity (N, 3) of places (N, 3) of the surface, in its own frame, under a twist (..., 6), by differences."""
    points = np.concatenate([place, np.ones((len(place), 1))], 1)[:, :, None]
    there, back = ((se3.exp(step * twist) @ points)[:, :3, 0] for step in (DIFFERENCE_STEP, -DIFFERENCE_STEP))
    return np.asarray((there - back) / (2 * DIFFERENCE_STEP))


COMMANDS_A_RUN = 10_000
PRINT_ZONE = np.array([[-20.0, -20, -1], [20, 20, 5]])
SURFACE_REST = se3.make(np.eye(3), [202.5, 225.0, 50.0])  # base_from_surface
TICK_S, ARM_LAG = 0.02, 0.024  # s
AXES_BOX = np.array([12.0, 12, 12, 0.15, 0.15, 0.15])  # mm and rad about home
OUTAGE_SHARE, MAX_OUTAGE_S = 0.01, 0.8  # share of the poses at which the surface is lost, and for how long at most
TRACK_STATES = list(TrackState)


def run_guard(options: argparse.Namespace) -> list[Figure]:
    """How many random commands passed though they break a limit, and were refused though they keep all."""
    commands, seed = options.commands, options.seed
    arms = simple_rules(), simple_rules(), simple_rules(), jointed_rules()
    counts = np.zeros(4, int)
    for k in range(max(1, round(commands / COMMANDS_A_RUN))):
        rules = arms[k % len(arms)]
        counts += judge_guard(random_log(seed + k, min(COMMANDS_A_RUN, commands), rules), rules)
    count, passed, broken, refused = counts.tolist()
    what = "guard: random commands"
    return [
        Figure(what, count, "", note=f"{passed} passed; one in four runs with an arm that is sent its joints"),
        Figure(f"{what} that break a limit and passed", broken, "", at_most(0), "", "by an independent oracle"),
        Figure(f"{what} that keep all and were refused", refused, "", at_most(0)),
    ]


def simple_rules() -> GuardRules:
    """The thesis's arm, whose controller sees to its joints."""
    return GuardRules(SimpleArm(), boxed_limits(MotionLimits()), PRINT_ZONE, TICK_S, ARM_LAG)


def jointed_rules() -> GuardRules:
    """An arm that is sent its last three joints."""
    from hardware.files.arm_file import read_arm

    profile = read_arm(shipped_file("arms", "six_axis.toml"))
    return GuardRules(profile.arm, boxed_limits(profile.limits), PRINT_ZONE, TICK_S, ARM_LAG)


def boxed_limits(limits: MotionLimits) -> MotionLimits:
    """The limits with bounds, and a zone of each kind, so near home that random steps meet them."""
    home = SimpleArm().home
    tip = home[:3]
    zones = (
        half_space("bed", np.array([0.1, 0, 1.0]), tip - [0, 0, 9]),
        box("block", tip + [5, 4, 2], tip + [9, 8, 9]),
        cylinder("post", tip - [7, 6, 20], tip - [7, 6, -20], 1.5),
    )
    return replace(limits, low=home - AXES_BOX, high=home + AXES_BOX, zones=zones)


def random_log(seed: int, count: int, rules: GuardRules, guard: Guard | None = None) -> GuardLog:
    """`count` commands near all limits, and what a guard, the real one if none is given, makes of them."""
    draw = np.random.default_rng(seed)
    arm, limits = rules.arm, rules.limits
    guard = Guard(limits, arm, rules.tick, rules.zone, rules.lag) if guard is None else guard
    rows, poses, now, lost_until = [], [], 0.0, 0.0
    for _ in range(count):
        now += draw.choice([TICK_S, 0.1, 0.0, -TICK_S], p=[0.9, 0.06, 0.02, 0.02])
        stamp = now if draw.random() < 0.98 else now + draw.choice([1e-9, -TICK_S, np.nan])
        if draw.random() < OUTAGE_SHARE:
            lost_until = now + draw.uniform(0, MAX_OUTAGE_S)
        pose = None if now < lost_until else random_pose(draw, now, rules)
        axes, feed = random_move(draw, guard.axes, rules)
        hold, extrude = draw.random() < 0.05, draw.random() < 0.5
        command: Command = Hold(stamp, 0.001, "") if hold else Move(stamp, axes, feed, 0, bool(extrude))
        passed = guard(command, pose, now) is command
        rows.append([stamp, now, *axes, feed, extrude, hold, passed])
        poses.append(pose)
    table = np.array(rows)
    flags = table[:, 9:].astype(bool)
    return GuardLog(table[:, 0], table[:, 1], table[:, 2:8], table[:, 8], flags[:, 0], flags[:, 1], poses, flags[:, 2])


def random_move(draw: np.random.Generator, before: Array, rules: GuardRules) -> tuple[Array, float]:
    """Axes (6,) and feed: a step about home, often on a limit or a hair beyond it."""
    limits = rules.limits
    near = draw.choice([0.2, 0.5, 1.0, 1 + 1e-9, 1 - 1e-9, 1.5], p=[0.5, 0.38, 0.03, 0.03, 0.03, 0.03])
    near = near * draw.choice([1.0, 0.05])
    way = draw.normal(size=6) * limits.speed + draw.choice([0.0, 0.0, 3.0]) * (rules.arm.home - before)
    of_limits = max(np.abs(way / limits.speed).max(), float(np.linalg.norm(way[:3])) * TICK_S / limits.jump)
    axes = before + near * TICK_S * way / of_limits
    if draw.random() < 0.03:
        axis = draw.integers(6)
        low, high = limits.low[axis], limits.high[axis]
        axes[axis] = draw.choice([low, high, np.nan, np.inf, np.nextafter(high, np.inf), np.nextafter(low, -np.inf)])
    feed = limits.feed * draw.choice([0.3, 1.0, 1 + 1e-9, 0.0, -1.0, np.nan], p=[0.9, 0.05, 0.02, 0.01, 0.01, 0.01])
    return axes, float(feed)


def random_pose(draw: np.random.Generator, now: float, rules: GuardRules) -> SurfacePose | None:
    """A pose, mostly worth following, sometimes on or beyond one of its limits; now and then there is none."""
    limits = rules.limits
    if draw.random() < 0.02:
        return None
    age = limits.pose_age * draw.choice([0.1, 0.5, 0.999, 1.001, -0.01], p=[0.4, 0.52, 0.03, 0.03, 0.02])
    state = TRACK_STATES[draw.choice(len(TRACK_STATES), p=[0.02 if not s.measured else 0.47 for s in TRACK_STATES])]
    known = limits.pose_error * draw.choice([0.1, 0.5, 0.99, 1.01], p=[0.5, 0.44, 0.03, 0.03])
    covariance = known**2 * np.diag([1e-6, 1e-6, 1e-6, 1.0, *draw.uniform(0.1, 1.0, 2)])
    turn, speed = draw.normal(size=3), draw.normal(size=3)
    turn *= limits.surface_turn * draw.choice([0.1, 0.9, 1.001], p=[0.85, 0.1, 0.05]) / np.linalg.norm(turn)
    speed *= limits.surface_speed * draw.choice([0.1, 0.7, 1.3], p=[0.85, 0.1, 0.05]) / np.linalg.norm(speed)
    twist = np.concatenate([turn, speed])
    if draw.random() < 0.01:
        twist[draw.integers(6)] = np.nan
    base = SURFACE_REST @ se3.exp(draw.normal(size=6) * [0.05, 0.05, 0.05, 3, 3, 3])
    shifts = np.array([0, 0, 0, 1.0, 1, 1])
    drift, psd = np.diag(shifts) * draw.choice([0.0, 1.0]), shifts * draw.choice([0, 5])
    return SurfacePose(now - age, base, covariance, twist, state, drift, psd)
