"""What the planner decides each tick: move there, or hold and say why."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from math import nan

import numpy as np

from estimation.se3 import Array

MIN_FEED = 1.0  # mm/s, or degrees/s: where the arm is off by rounding or a lost frame, it must not take for ever
TICK_FRACTION = 0.98  # of a tick for a move; in the rest the arm works off what queued up in an unnoticed stall
MAX_FLOW = 1000.0  # mm^3/s: a bead of 5 mm^2 on the fastest path; bioprinting lays 0.1 to 10
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
