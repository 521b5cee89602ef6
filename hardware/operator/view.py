"""What a run or a calibration shows its operator a few times a second, what it offers, and which wishes it follows.

Everything but stamp, turn and stage may be missing: a part that does not exist yet is None, an unknown figure is NaN.
The fields of the records go to the page under their names.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from enum import StrEnum
from math import nan, pi

from estimation.pose import SurfacePose, TrackState, position_sigma
from estimation.se3 import Array
from planning.command import Command, HoldReason, Refusal, RefusalCode


class RunStage(StrEnum):
    """Where a run is, as an operator knows it."""

    CHECK = "check"  # cameras, calibration, arm, path, reach
    FIND = "find"  # the wound is looked for and the path laid on it
    CONFIRM = "confirm"  # the path is shown over the pictures; somebody has to say that it is right
    READY = "ready"  # all is well; the arm waits for the word
    APPROACH = "approach"  # the nozzle goes to where printing begins or goes on
    PRINT = "print"
    PAUSED = "paused"  # by the operator; the arm is armed and stands
    STOPPED = "stopped"  # by the operator or by a fault; nothing is sent to the arm
    HOMING = "homing"  # the arm goes home
    DONE = "done"  # the path is printed
    ENDED = "ended"  # somebody ended the run; the arm is at rest
    FAILED = "failed"  # the run cannot go on; the arm is at rest


class Wish(StrEnum):
    """What can be asked for. A STOP is always followed; the others where the run offers them."""

    CONFIRM = "confirm"  # what is shown over the pictures is right
    MOVE = "move"  # move the path along the surface to where it belongs
    OUTLINE = "outline"  # the wound lies inside the outline as it was corrected: follow the surface there
    AGAIN = "again"  # do this stage anew: check, or look for the wound
    START = "start"  # let the arm move: approach, then print
    PAUSE = "pause"  # hold above the surface, ready to go on
    LOOK = "look"  # in a pause: move aside, and inspect the print
    LIFT = "lift"  # after a stop: arm, and go up from the surface, as in a pause
    RESUME = "resume"  # go on printing where it left off
    STOP = "stop"  # come to rest now
    HOME = "home"  # move the arm to its home
    END = "end"  # end the run, and write its report


WISH_WORDS = {  # on buttons, in messages, in the terminal and in the documents
    Wish.CONFIRM: "Yes, the path is right",
    Wish.MOVE: "Move",
    Wish.OUTLINE: "Use this outline",
    Wish.AGAIN: "Look again",
    Wish.START: "Start",
    Wish.PAUSE: "Pause",
    Wish.LOOK: "Look at the print",
    Wish.LIFT: "Lift",
    Wish.RESUME: "Resume",
    Wish.STOP: "Stop",
    Wish.HOME: "Home",
    Wish.END: "Finish",
}
WISH_KEYS = {  # in the terminal and on the page; Enter stops in the terminal only, where no button has the focus
    Wish.STOP: "space",
    Wish.PAUSE: "p",
    Wish.RESUME: "r",
    Wish.LOOK: "o",
    Wish.LIFT: "l",
    Wish.HOME: "h",
    Wish.CONFIRM: "y",
    Wish.START: "s",
    Wish.AGAIN: "a",
    Wish.END: "q",
}
CALMING_WISHES = frozenset({Wish.STOP, Wish.PAUSE, Wish.END})  # lead to rest: accepted also from an old window
ACTIVE_STAGES = (RunStage.APPROACH, RunStage.PRINT, RunStage.HOMING, RunStage.PAUSED)  # the arm may move, or is armed
OVER_STAGES = (RunStage.DONE, RunStage.ENDED, RunStage.FAILED)  # nothing more will happen
STAGE_OFFERS = {
    RunStage.CHECK: (Wish.END,),
    RunStage.FIND: (Wish.END,),
    RunStage.CONFIRM: (Wish.CONFIRM, Wish.MOVE, Wish.OUTLINE, Wish.AGAIN, Wish.END),
    RunStage.READY: (Wish.START, Wish.AGAIN, Wish.END),
    RunStage.APPROACH: (Wish.PAUSE, Wish.HOME, Wish.END),
    RunStage.PRINT: (Wish.PAUSE, Wish.HOME, Wish.END),
    RunStage.PAUSED: (Wish.RESUME, Wish.LOOK, Wish.HOME, Wish.END),
    RunStage.STOPPED: (Wish.RESUME, Wish.LIFT, Wish.HOME, Wish.END),
    RunStage.HOMING: (Wish.END,),
}
STAGE_QUESTIONS = {
    RunStage.CHECK: "Checking cameras, arm, path and recording",
    RunStage.FIND: "Searching for the wound and placing the path",
    RunStage.CONFIRM: "Is the path at the right place?",
    RunStage.READY: "Is nobody within the arm's reach? Then it may start",
    RunStage.APPROACH: "The nozzle moves to the start of the path",
    RunStage.PRINT: "Printing",
    RunStage.PAUSED: "Paused: resume, look at the print, go home, or finish",
    RunStage.STOPPED: "Stopped: resume, lift the nozzle, go home, or finish",
    RunStage.HOMING: "The arm moves to its home",
    RunStage.DONE: "The path is printed",
    RunStage.ENDED: "The run was finished early; the rest can be resumed",
    RunStage.FAILED: "The run cannot go on; the rest can be resumed",
}
CHANGED_TEXT = "the run has changed since this was shown: look again, then ask again"
DRAW_QUESTION = "Mark the corners of the region to track, in two or more pictures"


def refusal(wish: Wish, turn: int, offers: Collection[Wish], present: int) -> str:
    """Why a wish cannot be followed, "" if it can.

    turn: of the view it was asked under; present: of the newest view, which `offers` wishes. A window that shows an
    older turn may stop, pause or finish, and nothing else: it cannot let a run go on that another window has stopped.
    """
    if wish is Wish.STOP:
        return ""
    if wish not in CALMING_WISHES and turn != present:
        return CHANGED_TEXT
    return "" if wish in offers else f"{WISH_WORDS[wish]} cannot be done at this stage"


MAX_MOVE_MM, MAX_MOVE_DEG = 100.0, 180.0  # of one request to move the path


@dataclass(frozen=True, slots=True)
class MoveRequest:
    """How far the path is to be moved along the surface, in the frame of PlacementView."""

    x_mm: float
    y_mm: float
    turn_deg: float  # about the surface's normal through the path's middle

    @property
    def allowed(self) -> bool:
        """Whether all of it is finite and within MAX_MOVE_MM and MAX_MOVE_DEG."""
        return all(abs(v) <= MAX_MOVE_MM for v in (self.x_mm, self.y_mm)) and abs(self.turn_deg) <= MAX_MOVE_DEG


class CheckVerdict(StrEnum):
    """What a check found, or how something fares."""

    PASS = "pass"
    WARN = "warn"  # goes on, but should be looked at
    FAIL = "fail"
    BUSY = "busy"  # not known yet


class Activity(StrEnum):
    """What the nozzle is doing."""

    RESTING = "resting"  # the arm is not armed
    ENTERING = "entering"  # on its way to where printing begins
    PRINTING = "printing"
    TRAVELLING = "travelling"  # along the path without extruding
    HOLDING = "holding"  # it stands, or is carried along, until the reason is gone
    LEAVING = "leaving"
    HOMING = "homing"


@dataclass(frozen=True, slots=True)
class Check:
    """One line of the check table."""

    name: str
    verdict: CheckVerdict
    found: str = ""  # the result in words
    remedy: str = ""  # what to do, "" where nothing is to be done


@dataclass(frozen=True, slots=True, eq=False)
class TrackingView:
    """The estimate, as it is shown."""

    state: TrackState
    reason: str  # of the state
    age: float  # s, of the pose
    sigma: float  # mm, of the position along its worst direction
    base_from_surface: Array  # (4, 4) mm
    covariance: Array  # (3, 3) mm^2, of the position in the surface frame
    tracks: int = 0  # in use


@dataclass(frozen=True, slots=True)
class HoldCause:
    """The figure that holds the nozzle, so that the place that shows it can be marked.

    tile: which of the page's figures it is: age, error, flight, tracking, or "cause" of one not shown otherwise.
    """

    tile: str
    words: str  # what is measured
    unit: str  # of both figures, "" without figures
    got: float = nan
    limit: float = nan


NORMAL_95 = 1.96  # standard deviations that hold 95 % of errors of one direction: the limit as that
CAUSE_TILES = {  # tile of the page, what is measured, its unit, and how many of that the guard's unit is
    RefusalCode.POSE_AGE: ("age", "age of pose", "ms", 1000.0),
    RefusalCode.POSE_ERROR: ("error", "predicted error", "mm", 1.0),
    RefusalCode.NO_POSE: ("tracking", "no pose", "", 1.0),
    RefusalCode.POSE_NOT_FINITE: ("tracking", "no pose", "", 1.0),
    RefusalCode.TRACK_STATE: ("tracking", "tracking", "", 1.0),
    RefusalCode.SURFACE_SPEED: ("cause", "surface speed", "mm/s", 1.0),
    RefusalCode.SURFACE_TURN: ("cause", "surface turn", "°/s", 180 / pi),
    RefusalCode.JUMP: ("cause", "step", "mm", 1.0),
    RefusalCode.CLEARANCE: ("cause", "tool in the tissue", "mm", 1.0),
    RefusalCode.TURN: ("cause", "turn", "°", 180 / pi),
    RefusalCode.WATCHDOG: ("cause", "still moving", "s", 1.0),
    RefusalCode.STOP_DISTANCE: ("cause", "way to rest", "mm", 1.0),
}


def hold_cause(command: Command) -> HoldCause | None:
    """The figure that holds the nozzle, or makes it brake; None where there is none, or it has no figure."""
    found: HoldReason | Refusal | None = command if isinstance(command, Refusal) else None
    if found is None and isinstance(command.reason, HoldReason):
        found = command.reason
    if found is None or found.code not in CAUSE_TILES:
        return None
    tile, words, unit, scale = CAUSE_TILES[found.code]
    return HoldCause(tile, words, unit, scale * found.got, scale * found.limit)


@dataclass(frozen=True, slots=True)
class RestView:
    """A nozzle that stands while the surface moves under it."""

    slip: float  # mm, from end to end, by which the surface has moved against the nozzle
    seconds: float  # s, over which that was seen
    height: float  # mm of the tip above its place on the path along the nozzle's axis; NaN before a path was begun


@dataclass(frozen=True, slots=True, eq=False)
class MotionView:
    """What the arm does, and why."""

    activity: Activity
    reason: str = ""  # why the nozzle is held
    error: float = nan  # mm, predicted: the nozzle will be within it of its place in 95 % of cases
    limit: float = nan  # mm of `sigma`, beyond which nothing is extruded
    true_error: float = nan  # mm, known in a simulated world
    in_flight: float = nan  # s of motion under way in the arm
    most_in_flight: float = nan  # s, its limit
    base_from_nozzle: Array | None = None  # (4, 4) mm, z from the tip into the tool
    arm: str = ""  # its state in words
    speed: float = nan  # mm/s of the nozzle over the surface
    material: str = ""  # what the dispenser does, in words; "" where nothing is extruded
    error_age: float = nan  # s since the two errors were taken: while nothing is extruded they are of earlier
    cause: HoldCause | None = None  # of a hold, where a figure is the cause
    rest: RestView | None = None  # of a nozzle that stands where it was stopped or paused
    sigma: float = nan  # mm, standard deviation of the place under the nozzle then, along its worst direction


@dataclass(frozen=True, slots=True)
class ProgressView:
    """How far the print is."""

    fraction: float  # place, in checkpoints
    total: int  # checkpoints
    share: float  # 0 to 1, of the time or of the length
    left: float = nan  # s until it is done, by the share of the time in which it got on so far
    spread: tuple[float, float] | None = None  # s, between which that lies 9 times of 10; None while unknown
    duty: float = nan  # 0 to 1, share of the time since the start in which it was not held
    layer: int = 0  # from 1; 0 where there are none
    layers: int = 0
    ink: float = nan  # mm^3 that the dispensers were told to let out in this run; NaN where there is none
    begun: float = 0.0  # place, in checkpoints, where this run goes on


@dataclass(frozen=True, slots=True)
class LatencyView:
    """From the newest image handed over to the bytes on the wire, s."""

    median: float
    high: float  # 99 %
    limit: float = nan  # of that


@dataclass(frozen=True, slots=True)
class CameraView:
    """The state of one camera."""

    name: str
    verdict: CheckVerdict
    rate: float = nan  # pictures per second that arrive
    tracks: int = 0  # in use
    words: str = ""  # what is wrong, or ""
    sharpness: float = nan  # of the newest picture, as a share of the sharpest so far


@dataclass(frozen=True, slots=True, eq=False)
class PlacementView:
    """Where the path lies, while somebody may move it."""

    by: str  # scan, region, truth, earlier run or hand
    verdict: str  # what it is worth, in words
    certain: bool  # found, unique and determined by a scan, and not moved since
    moved: bool  # whether the operator has moved it
    confirmable: bool  # whether it may be confirmed as it lies
    surface_from_tangent: Array | None  # (4, 4) mm, in which a move is meant; None where the surface is not mapped


@dataclass(frozen=True, slots=True)
class RequestAnswer:
    """What became of a request."""

    number: int  # of the request
    wish: Wish
    followed: bool
    words: str = ""  # why it was not followed


@dataclass(frozen=True, slots=True)
class LogLine:
    """A line of the run's log."""

    number: int  # counts up from 1
    stamp: float  # s
    warning: bool
    text: str


@dataclass(slots=True)
class HoldRow:
    """The holds for one reason."""

    reason: str
    count: int = 0
    seconds: float = 0.0


@dataclass(frozen=True, slots=True, eq=False)
class RunResult:
    """What a run came to. Errors are at the nozzle while material left it, mm; NaN where none did."""

    printed: float  # 0 to 1, share of the path that is printed, with what runs before this one printed
    fraction: float  # place reached, in checkpoints
    total: int  # checkpoints
    begun: float  # place where this run went on, in checkpoints
    seconds: float  # s from the approach on
    duty: float  # 0 to 1
    error: tuple[float, float]  # predicted: 95 % over the run, and the largest claim
    true_error: tuple[float, float]  # the same of the true error, where the world is simulated
    ink: float  # mm^3, NaN of none
    holds: tuple[HoldRow, ...]  # the longest first
    stretches: tuple[float, ...]  # mm, largest error of each of the path's stretches of equal checkpoints; NaN: none
    record: str  # files as the user named them
    report: str
    again: str = ""  # the command that goes on, "" where nothing is left


@dataclass(frozen=True, slots=True, eq=False)
class OperatorView:
    """All that the page shows, but for pictures and scene."""

    stamp: float  # s, on any clock that never goes back; a view that is not newer than the last one counts as none
    turn: int  # goes up whenever stage or question changes; a request tells the turn it was asked under
    stage: RunStage
    question: str = ""  # what the operator is asked or told now, in a sentence
    reason: str = ""  # of the stage
    offers: tuple[Wish, ...] = ()  # what would be followed now, but for Wish.STOP, which always is
    checks: tuple[Check, ...] = ()
    tracking: TrackingView | None = None
    motion: MotionView | None = None
    progress: ProgressView | None = None
    latency: LatencyView | None = None
    cameras: tuple[CameraView, ...] = ()
    answer: RequestAnswer | None = None
    placement: PlacementView | None = None
    notes: tuple[str, ...] = ()  # what one should know all the time, such as "dry run" or "simulated"
    log: tuple[LogLine, ...] = ()  # the last lines, newest last
    result: RunResult | None = None  # once the run is over
    draws: bool = False  # whether the region has to be drawn now, by whoever sees the newest view


def tracking_from_pose(pose: SurfacePose, now: float, tracks: int = 0) -> TrackingView:
    """The estimate as it is shown at `now`, s. tracks: in use."""
    sigma, place = position_sigma(pose.covariance), pose.covariance[3:, 3:]
    return TrackingView(pose.state, pose.reason, now - pose.stamp, sigma, pose.base_from_surface, place, tracks)
