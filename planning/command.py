"""What the planner decides each tick: move there, or hold and say why."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from estimation.se3 import Array

SLOWEST = 1.0  # mm/s, or degrees/s: where the arm is off by rounding or a lost frame, it must not take for ever
HASTE = 0.98  # of a tick in which a move is made: what a stall that nobody saw has queued is worked off in the rest
TURNING = 1e-3  # mm: a shorter move only turns; the arm gets its axes as binary32, good to 6e-5 mm at 1 m


@dataclass(frozen=True, slots=True, eq=False)
class Move:
    """Go to the machine axes [X Y Z A B C] (6,), mm and rad, at `feed` mm/s; on the way to `checkpoint`. stamp: s.

    reason: why it brakes, "" of one that goes where the path leads. Of a move that only turns, by no more than TURNING
    along X Y Z, `feed` is in degrees/s, as controllers of arms read it.
    """

    stamp: float
    axes: Array
    feed: float
    checkpoint: int
    extrude: bool
    reason: str = ""


@dataclass(frozen=True, slots=True)
class Hold:
    """Stay where you are for `duration` s, because of `reason`. stamp: s."""

    stamp: float
    duration: float
    reason: str


class Code(StrEnum):
    """Why the guard refused a command; these words do not change. docs/motion.md says what each is."""

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


@dataclass(frozen=True, slots=True)
class Refusal(Hold):
    """The hold that the guard puts in a command's place. got: the number that breaks `limit`, in mm, s and rad.

    NaN where what is wrong is no number.
    """

    code: Code
    got: float
    limit: float


Command = Move | Hold


def feed_for(start: Array, axes: Array, tick: float) -> float:
    """Feed, mm/s or degrees/s as `Move` has it, of a move from `start` to `axes`, (6,) each, within a tick of `tick` s.

    No slower than SLOWEST: a lesser way is gone in less than the tick, and the arm waits for the next one.
    """
    length, turn = float(np.linalg.norm(axes[:3] - start[:3])), float(np.linalg.norm(axes[3:] - start[3:]))
    way = length if length > TURNING else float(np.rad2deg(turn))
    return max(way / (HASTE * tick), SLOWEST)
