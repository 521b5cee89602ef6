"""What a run or a calibration shows its operator a few times a second, what it offers, and which wishes it follows.

Everything but stamp, turn and stage may be missing: a part that does not exist yet is None, an unknown figure is NaN.
The fields of the records go to the page under their names.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from enum import StrEnum
from math import nan

from estimation.pose import SurfacePose, TrackState, position_sigma
from estimation.se3 import Array


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
    RESUME = "resume"  # go on printing where it left off
    STOP = "stop"  # come to rest now
    HOME = "home"  # move the arm to its home
    END = "end"  # end the run, and write its report


CALMING_WISHES = frozenset({Wish.STOP, Wish.PAUSE, Wish.END})  # lead towards rest: right whatever the window showed
ACTIVE_STAGES = (RunStage.APPROACH, RunStage.PRINT, RunStage.HOMING, RunStage.PAUSED)  # the arm may move, or is armed
STAGE_OFFERS = {
    RunStage.CHECK: (Wish.END,),
    RunStage.FIND: (Wish.END,),
    RunStage.CONFIRM: (Wish.CONFIRM, Wish.MOVE, Wish.OUTLINE, Wish.AGAIN, Wish.END),
    RunStage.READY: (Wish.START, Wish.AGAIN, Wish.END),
    RunStage.APPROACH: (Wish.PAUSE, Wish.HOME, Wish.END),
    RunStage.PRINT: (Wish.PAUSE, Wish.HOME, Wish.END),
    RunStage.PAUSED: (Wish.RESUME, Wish.HOME, Wish.END),
    RunStage.STOPPED: (Wish.RESUME, Wish.HOME, Wish.END),
    RunStage.HOMING: (Wish.END,),
}
STAGE_QUESTIONS = {
    RunStage.CHECK: "Checking cameras, arm, path and recording",
    RunStage.FIND: "Looking for the wound and laying the path on it",
    RunStage.CONFIRM: "Does the path lie where it should be printed?",
    RunStage.READY: "Is nobody within the arm's reach? Then it may start",
    RunStage.APPROACH: "The nozzle goes to where printing begins",
    RunStage.PRINT: "Printing",
    RunStage.PAUSED: "Paused: resume, go home, or end",
    RunStage.STOPPED: "Stopped: resume, go home, or end",
    RunStage.HOMING: "The arm goes home",
    RunStage.DONE: "The path is printed",
    RunStage.ENDED: "The run was ended; what is left can be resumed",
    RunStage.FAILED: "The run cannot go on; what is left can be resumed",
}
DRAW_QUESTION = "Click round what is to be followed, in two pictures or more"


def refusal(wish: Wish, turn: int, offers: Collection[Wish], present: int) -> str:
    """Why a wish cannot be followed, "" if it can.

    turn: of the view it was asked under; present: of the newest view, which `offers` wishes. A window that shows an
    older turn may stop, pause or end, and nothing else: it cannot let a run go on that another window has stopped.
    """
    if wish is Wish.STOP:
        return ""
    if wish not in CALMING_WISHES and turn != present:
        return "the run has changed since this was shown: look again, then ask again"
    return "" if wish in offers else f"{wish} cannot be done at this stage"


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


@dataclass(frozen=True, slots=True, eq=False)
class MotionView:
    """What the arm does, and why."""

    activity: Activity
    reason: str = ""  # why the nozzle is held
    error: float = nan  # mm, predicted at the nozzle when it will be there
    limit: float = nan  # mm of that, beyond which nothing is extruded
    true_error: float = nan  # mm, known in a simulated world
    in_flight: float = nan  # s of motion under way in the arm
    most_in_flight: float = nan  # s, its limit
    base_from_nozzle: Array | None = None  # (4, 4) mm, z from the tip into the tool
    arm: str = ""  # its state in words
    speed: float = nan  # mm/s of the nozzle over the surface
    material: str = ""  # what the dispenser does, in words; "" where nothing is extruded


@dataclass(frozen=True, slots=True)
class ProgressView:
    """How far the print is."""

    fraction: float  # place, in checkpoints
    total: int  # checkpoints
    share: float  # 0 to 1, of the time or of the length
    left: float = nan  # s until it is done if nothing holds it
    duty: float = nan  # 0 to 1, share of the time since the start in which it was not held
    layer: int = 0  # from 1; 0 where there are none
    layers: int = 0


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
    sigma: float = nan  # mm, of the path's middle
    turn_sigma: float = nan  # rad


@dataclass(frozen=True, slots=True)
class RequestAnswer:
    """What became of a request."""

    number: int  # of the request
    wish: Wish
    followed: bool
    words: str = ""  # why it was not followed


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
    events: tuple[str, ...] = ()  # the last ones, newest last
    draws: bool = False  # whether the region has to be drawn now, by whoever sees the newest view


def tracking_from_pose(pose: SurfacePose, now: float, tracks: int = 0) -> TrackingView:
    """The estimate as it is shown at `now`, s. tracks: in use."""
    sigma, place = position_sigma(pose.covariance), pose.covariance[3:, 3:]
    return TrackingView(pose.state, pose.reason, now - pose.stamp, sigma, pose.base_from_surface, place, tracks)


class RecordingStage(StrEnum):
    """Where a recording is."""

    RECORD = "record"
    ENDED = "ended"  # what is on the disk is whole
    FAILED = "failed"  # what was written before is kept


@dataclass(frozen=True, slots=True)
class RecordingView:
    """The state of a recording without an arm."""

    stamp: float  # s
    turn: int
    stage: RecordingStage
    seconds: float  # of it so far
    size: int  # bytes on the disk
    sets: int  # frame sets taken
    dropped: int  # of them, for which the recorder had no room
    cameras: tuple[CameraView, ...] = ()
    words: str = ""  # what ended it
    offers: tuple[Wish, ...] = ()
    answer: RequestAnswer | None = None
    draws: bool = False  # whether a region may be drawn now


class WavingStage(StrEnum):
    """Where a calibration is."""

    WAVE = "wave"  # the board is looked for
    SOLVE = "solve"  # enough was seen: lenses and places are computed
    PASSED = "passed"
    FAILED = "failed"  # not good enough, or not to be calibrated from this
    STOPPED = "stopped"  # the corners are kept


@dataclass(frozen=True, slots=True)
class WavingCamera:
    """One camera's views of the board so far."""

    name: str
    size: tuple[int, int]  # (W, H) px of its picture
    corners: int  # in the newest picture
    parts: tuple[tuple[float, ...], ...]  # of the picture, row by row: 0 to 1 of the corners that each should have
    tilts: tuple[float, ...]  # left, right, top, bottom nearer: 0 to 1 of the views that should be tilted so
    depth: float  # 0 to 1 of how much nearer than the far views the near ones should be


@dataclass(frozen=True, slots=True)
class WavingView:
    """The state of a calibration."""

    stamp: float  # s
    turn: int
    stage: WavingStage
    hints: tuple[str, ...] = ()  # what to do next, the most needed first
    cameras: tuple[WavingCamera, ...] = ()
    together: float = 0.0  # 0 to 1 of the frame sets in which two cameras should have seen the board
    looked: int = 0  # frame sets looked at
    words: tuple[str, ...] = ()  # the result
    offers: tuple[Wish, ...] = ()
    answer: RequestAnswer | None = None
