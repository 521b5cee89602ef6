"""What the planner decides each tick, move there, or hold and say why; and the limits that it keeps.

Limits are those of arm and tissue, of the poses that the arm may follow, and the zones that the tip must not enter.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from enum import StrEnum
from math import nan

import numpy as np

from estimation.errors import InputError
from estimation.se3 import Array

MIN_FEED = 1.0  # mm/s, or degrees/s: where the arm is off by rounding or a lost frame, it must not take for ever
TICK_FRACTION = 0.98  # of a tick for a move; in the rest the arm works off what queued up in an unnoticed stall
MAX_FLOW = 1000.0  # mm^3/s: a bead of 5 mm^2 on the fastest path; bioprinting lays 0.1 to 10
LOOKS = "stands aside for a look"  # the reason of a hold
MIN_TRAVEL = 1e-3  # mm: a shorter move only turns; the arm gets its axes as binary32, good to 6e-5 mm at 1 m


@dataclass(frozen=True, slots=True, eq=False)
class Move:
    """Go to the machine axes."""

    stamp: float  # s
    axes: Array  # (6,) X Y Z A B C, mm and rad
    feed: float  # mm/s; degrees/s, as arm controllers read it, of a move by MIN_TRAVEL or less along X Y Z
    checkpoint: int  # that the move leads to
    extrude: bool  # whether material is due at the nozzle during the move
    reason: str = ""  # why it brakes or rests; "" of a move along the path
    flow: float = 0.0  # mm^3/s that the dispenser is told, its delay led; 0: off
    flow_after: float = 0.0  # s into the tick at which it is told; until then as before


@dataclass(frozen=True, slots=True)
class Hold:
    """Stay in place."""

    stamp: float  # s
    duration: float  # s
    reason: str


class RefusalCode(StrEnum):
    """Why the guard refused a command; the values do not change. docs/motion.md explains each."""

    NOT_FINITE = "not_finite"
    ORDER = "order"
    FEED = "feed"
    WORKSPACE = "workspace"
    NO_GO = "no_go"
    JUMP = "jump"
    TURN = "turn"
    AXIS_SPEED = "axis_speed"
    POSTURE = "posture"
    JOINT_RANGE = "joint_range"
    JOINT_SPEED = "joint_speed"
    NO_POSE = "no_pose"
    POSE_NOT_FINITE = "pose_not_finite"
    TRACK_STATE = "track_state"
    POSE_AGE = "pose_age"
    SURFACE_SPEED = "surface_speed"
    SURFACE_TURN = "surface_turn"
    POSE_ERROR = "pose_error"
    WATCHDOG = "watchdog"
    STOP_DISTANCE = "stop_distance"
    FLOW = "flow"
    CLEARANCE = "clearance"


class HoldReason(str):
    """Why the planner stops, in words, with the code of what is broken, its number and its limit, as in a Refusal."""

    code: RefusalCode | None
    got: float
    limit: float

    def __new__(  # noqa: D102
        cls, words: str = "", code: RefusalCode | None = None, got: float = nan, limit: float = nan
    ) -> HoldReason:
        reason = super().__new__(cls, words)
        reason.code, reason.got, reason.limit = code, got, limit
        return reason


@dataclass(frozen=True, slots=True)
class Refusal(Hold):
    """The hold by which the guard replaces a command that it refuses."""

    code: RefusalCode
    got: float  # the number that breaks `limit`, in mm, s and rad; NaN where there is none
    limit: float


Command = Move | Hold


def feed_for(start: Array, axes: Array, tick: float) -> float:
    """Feed, mm/s or degrees/s as in `Move`, of a move from `start` to `axes`, (6,) each, within a tick of `tick` s.

    At least MIN_FEED: a shorter way then takes less than the tick, and the arm waits for the next one.
    """
    length, turn = float(np.linalg.norm(axes[:3] - start[:3])), float(np.linalg.norm(axes[3:] - start[3:]))
    way = length if length > MIN_TRAVEL else float(np.rad2deg(turn))
    return max(way / (TICK_FRACTION * tick), MIN_FEED)


AXIS_MARGIN = np.array([5.0, 5, 5, *np.deg2rad([2, 2, 2])])  # that targets keep from the bounds: braking needs room
JOINT_MARGIN = float(np.deg2rad(2))  # that joints keep from the ends of their ranges


@dataclass(frozen=True, slots=True, eq=False)
class NoGo:
    """A convex volume in the base frame: the intersection of half-spaces and a cylinder. Its surface is outside."""

    name: str
    normals: Array  # (K, 3) unit vectors, outwards
    offsets: Array  # (K,) mm; normals @ p < offsets inside
    axis: Array = field(default_factory=lambda: np.array([[0.0, 0, 0], [0, 0, 1]]))  # (2, 3) mm, of the cylinder
    radius: float = np.inf  # mm; infinite without a cylinder

    def __post_init__(self) -> None:
        arrays = self.normals, self.offsets, self.axis
        good = self.normals.ndim == 2 and self.normals.shape[1:] == (3,) and self.axis.shape == (2, 3)
        if not good or self.offsets.shape != self.normals.shape[:1] or not all(np.isfinite(a).all() for a in arrays):
            raise InputError("no-go zone", self.name, self.normals.tolist(), "K normals and offsets, finite")
        if np.abs(np.linalg.norm(self.normals, axis=1) - 1).max(initial=0.0) > 1e-9 or not self.radius > 0:
            raise InputError("no-go zone", self.name, self.radius, "unit normals, and a radius > 0")
        if not len(self.offsets) or np.array_equal(*self.axis):
            raise InputError("no-go zone", self.name, self.axis.tolist(), "one half-space or more, and an axis")

    def depth(self, place: Array) -> float:
        """Depth of a place (3,) inside, mm; 0 or less outside and on the surface."""
        depth = float((self.offsets - self.normals @ place).min())
        if np.isinf(self.radius):
            return depth
        return min(depth, self.radius - float(np.linalg.norm(self._flat(place))))

    def depth_along(self, start: Array, end: Array) -> float:
        """Depth of the straight way between two places (3,), mm: at its end, or in the middle of its part inside."""
        if (depth := self.depth(end)) > 0:
            return depth
        low, high = 0.0, 1.0
        for gap, more in zip(self.offsets - self.normals @ start, self.normals @ (end - start), strict=True):
            if more == 0 and gap <= 0:
                return 0.0
            low, high = (max(low, gap / more), high) if more < 0 else (low, min(high, gap / more) if more else high)
        if np.isfinite(self.radius):
            low, high = _within(self._flat(start), self._flat(end), self.radius, low, high)
        return max(self.depth(start + (low + high) / 2 * (end - start)), 0.0) if low < high else 0.0

    def _flat(self, place: Array) -> Array:
        """A place (3,) projected along the cylinder's axis, relative to it, turned by a right angle."""
        along = self.axis[1] - self.axis[0]
        return np.cross(place - self.axis[0], along / np.linalg.norm(along))


def half_space(name: str, normal: Array, place: Array) -> NoGo:
    """The half-space behind a plane through `place` (3,), mm, opposite to its `normal` (3,)."""
    if not np.linalg.norm(normal) > 0:
        raise InputError("no-go zone", name, normal.tolist(), "a normal that is not zero")
    unit = normal / np.linalg.norm(normal)
    return NoGo(name, unit[None], np.array([unit @ place]))


def box(name: str, low: Array, high: Array) -> NoGo:
    """A box between two corners (3,), mm, along the base frame's axes."""
    if not (low < high).all():
        raise InputError("no-go zone", name, [low.tolist(), high.tolist()], "a low corner below a high one")
    return NoGo(name, np.concatenate([np.eye(3), -np.eye(3)]), np.concatenate([high, -low]))


def cylinder(name: str, start: Array, end: Array, radius: float) -> NoGo:
    """A cylinder between the centres (3,) of its ends, mm."""
    if not np.linalg.norm(end - start) > 0:
        raise InputError("no-go zone", name, [start.tolist(), end.tolist()], "two ends apart")
    along = (end - start) / np.linalg.norm(end - start)
    offsets = np.array([-along @ start, along @ end])
    return NoGo(name, np.stack([-along, along]), offsets, np.stack([start, end]), radius)


def _within(start: Array, end: Array, radius: float, low: float, high: float) -> tuple[float, float]:
    """The part, in low to high, of a straight way (3,) that is within `radius` of 0; empty: (1, 0)."""
    way = end - start
    a, b, c = float(way @ way), float(start @ way), float(start @ start) - radius**2
    if a == 0:
        return (low, high) if c < 0 else (1.0, 0.0)
    if (root := b * b - a * c) <= 0:
        return 1.0, 0.0
    return max(low, (-b - root**0.5) / a), min(high, (-b + root**0.5) / a)


def _six(length: float, angle_deg: float) -> Array:
    return np.array([length] * 3 + [np.deg2rad(angle_deg)] * 3)


@dataclass(frozen=True, slots=True, eq=False)
class MotionLimits:
    """Limits of one run; axes are the machine's X Y Z A B C, mm and rad. InputError names one that makes no sense.

    speed: (6,) mm/s and rad/s; kept by the planner, checked by the guard.
    acceleration: (6,) mm/s^2 and rad/s^2; kept by the planner.
    jerk: (6,) mm/s^3 and rad/s^3; kept by the planner.
    jump: mm in one tick.
    turn: rad in one tick.
    low: (6,) lower ends of the axes' ranges.
    high: (6,) upper ends.
    feed: mm/s, the most that a G1 frame asks for.
    pose_age: s.
    pose_error: mm, standard deviation of the position under the nozzle.
    surface_speed: mm/s under the nozzle.
    surface_turn: rad/s.
    stop_time: s within which the arm comes to rest without a trusted pose.
    stop_distance: mm likewise.
    on_path: mm by which the nozzle may be off its place and still print.
    zones: no-go volumes.
    pause: s of one hold.
    """

    speed: Array = field(default_factory=lambda: _six(150.0, 120.0))  # public drivers run the arm at 167 mm/s
    acceleration: Array = field(default_factory=lambda: _six(1500.0, 1200.0))  # a tenth of a second to full speed
    jerk: Array = field(default_factory=lambda: _six(30_000.0, 24_000.0))  # 50 ms to full acceleration
    jump: float = 3.0  # 150 mm/s along any direction at 50 ticks a second
    turn: float = float(np.deg2rad(2.4))  # 120 degrees/s at 50 ticks a second
    low: Array = field(default_factory=lambda: np.array([-650.0, -650, -200, *-np.deg2rad([60, 60, 60])]))  # reach
    high: Array = field(default_factory=lambda: np.array([650.0, 650, 500, *np.deg2rad([60, 60, 60])]))  # B < 90 deg
    feed: float = 250.0  # the arm's own top speed, 15,000 mm/min in public drivers
    pose_age: float = 0.3  # a camera at 6 fps and 50 ms on the way; what that costs is in pose_error
    pose_error: float = 0.5  # a bead is 0.4 to 1 mm wide
    surface_speed: float = 50.0  # thesis 6.3
    surface_turn: float = float(np.deg2rad(40.0))  # thesis 6.3, read as per second
    stop_time: float = 0.4  # from 150 mm/s under the limits above: 0.15 s
    stop_distance: float = 15.0  # from 150 mm/s under the limits above: 11.3 mm
    on_path: float = 0.5  # half a bead
    zones: tuple[NoGo, ...] = ()  # in the base frame: none is known before somebody has measured it
    pause: float = 0.001  # thesis 6.3: pauses of 1 ms, repeated

    def per_tick(self, tick: float) -> Array:
        """Speed (6,), per s, at which each axis keeps jump and turn of a tick of `tick` s whatever the others do."""
        return np.minimum(self.speed, np.repeat([self.jump / 3**0.5, self.turn], 3) / tick)

    def __post_init__(self) -> None:
        for name in (f.name for f in fields(self) if f.name != "zones"):
            value: Array = np.asarray(getattr(self, name), float)
            shape = (6,) if name in ("speed", "acceleration", "jerk", "low", "high") else ()
            if value.shape != shape or not np.isfinite(value).all():
                raise InputError("limits", name, value.tolist(), "6 finite numbers" if shape else "a finite number")
            if name not in ("low", "high") and (value <= 0).any():
                raise InputError("limits", name, value.tolist(), "> 0")
        if (self.low >= self.high).any():
            raise InputError("limits", "low", self.low.tolist(), "below high, axis by axis")
        if max(abs(self.low[4]), abs(self.high[4])) >= np.pi / 2:
            got = np.rad2deg([self.low[4], self.high[4]]).round(9).tolist()
            raise InputError("limits", "low, high of B", got, "within 90 degrees (gimbal lock)")
