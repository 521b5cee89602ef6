"""The stages of a run as an operator knows them: what is asked for and what has happened lead from one to the next.

Nothing here waits, sends or knows the time. Each call is given the newest reports and what was asked for, and answers
with orders for the motion process.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from hardware.arm.profile import ArmProfile
from hardware.arm_status import ArmState
from hardware.live import checklist
from hardware.live.laid import Laid, laid_on, lifted
from hardware.live.records import Begin, LiveMotionReport, Pace, RecorderReport, TrackingReport
from hardware.live.silence import silence
from hardware.live.stages import OFFERS, RUNNING
from hardware.motion.loop import Order
from hardware.operator.shared_state import Request, Wish, refusal
from hardware.operator.view import Answer, Check, Stage, Verdict
from hardware.process.ticks import tick_in_step
from planning.path import Path
from planning.progress import Phase, fingerprint

Orders = list[Order | Pace | Begin]

HOME_PATIENCE, ARM_PATIENCE = 60.0, 5.0  # s: across the whole room at 20 mm/s; until a stopped arm is at rest
ASK_AGAIN = 0.3  # s between orders to an arm that was not ready for the last one
LONGEST_LAG = 0.3  # s: a lag measured beyond this is no servo's
BACK = "the arm is back: resume, or go home first"
BACK_SOMEWHERE = "the arm is back and does not say where it stands: move it to its home by hand, then ask for Home"
SOUGHT = 180.0  # s in which all must be found, or nobody looks any longer where nobody watches


@dataclass(frozen=True, slots=True, eq=False)
class Task:
    """What is to be printed, and how. path: in its own frame; start: counted in checkpoints, where it goes on.

    place: put the arm where the surface lies below its home. stands_home: the operator says that the arm does.
    lift: mm, of a dry run; None for a real one. unattended: nobody confirms and nobody resumes: what stops such a run
    ends it. patience: s, without pictures, after which the arm is stopped.
    """

    path: Path
    profile: ArmProfile
    start: float = 0.0
    place: bool = False
    stands_home: bool = False
    lift: float | None = None
    unattended: bool = False
    patience: float = 10.0

    @property
    def fingerprint(self) -> str:
        """Of the path as its file has it; "" in a dry run, which prints nothing that need not be printed again."""
        return fingerprint(self.path) if self.lift is None else ""


@dataclass(slots=True)
class Seen:
    """The newest reports."""

    tracking: TrackingReport | None = None
    motion: LiveMotionReport | None = None
    recorder: RecorderReport | None = None


@dataclass(slots=True)
class Conductor:
    """Where the run is. turn: counts changes. ended: why it is over, "" while it is not. done: the path is printed.

    missed: which process says nothing while the arm may move, "" while both speak.
    """

    task: Task
    stage: Stage = Stage.CHECK
    reason: str = ""
    turn: int = 0
    ended: str = ""
    done: bool = False
    missed: str = ""
    laid: Laid | None = None
    answer: Answer | None = None
    checks: tuple[Check, ...] = ()
    _since: float = field(default=float("nan"))
    _asked: float = field(default=float("-inf"))
    _failing: float = field(default=float("inf"))  # s, since when a check has failed
    _begun: bool = False
    _told: bool = False  # where it stands: by the operator, who looks at it when it goes home
    _away: bool = False  # unplugged
    _answers: bool = False
    _homed: bool = False
    _armed: bool = False  # since it was last asked for
    _after: Stage = Stage.APPROACH  # the stage that homing leads to

    @property
    def offers(self) -> tuple[Wish, ...]:
        """What would be followed now."""
        return OFFERS.get(self.stage, ())

    def __call__(self, now: float, seen: Seen, requests: Sequence[Request]) -> Orders:
        """One look at all there is, at `now`, s."""
        if np.isnan(self._since):
            self._since = now
        orders: Orders = []
        for request in requests:
            orders += self._asked_for(request, now)
        self._check(seen, now)
        if not self.ended:
            orders += self._go_on(seen, now)
        self.missed = self._missed(seen, now) if self.stage in RUNNING else ""
        return orders

    def end(self, reason: str, now: float, stage: Stage = Stage.FAILED) -> Orders:
        """End the run; the arm is stopped where it may still move. stage: DONE, ENDED or FAILED."""
        if self.ended:
            return []
        self.ended, self.done = reason, stage is Stage.DONE
        self._to(stage, reason, now)
        return [] if self.done else [Order.STOP]

    def pause(self, reason: str, now: float) -> Orders:
        """Have the nozzle leave the surface and wait above it."""
        self._to(Stage.PAUSED, reason, now)
        return [Pace.PAUSE]

    # -- what is asked for

    def _asked_for(self, request: Request, now: float) -> Orders:
        why = refusal(request.wish, request.turn, self.offers, self.turn)
        self.answer = Answer(request.number, request.wish, not why, why)
        return [] if why else self._follow(request.wish, now)

    def _follow(self, wish: Wish, now: float) -> Orders:
        if wish is Wish.STOP:
            if self.stage in RUNNING:
                self._to(Stage.STOPPED, "by the operator", now)
            return [Order.STOP]
        if wish is Wish.END:
            return self.end("ended by the operator", now, Stage.ENDED)
        if wish is Wish.CONFIRM:
            self._to(Stage.READY, "", now)
        elif wish is Wish.AGAIN:
            self.laid = None
            self._to(Stage.CHECK, "", now)
        elif wish is Wish.START:
            return self._home(Stage.APPROACH, now)
        elif wish is Wish.PAUSE:
            return self.pause("by the operator", now)
        elif wish is Wish.HOME:
            return [Pace.PAUSE, *self._home(Stage.STOPPED, now)]
        elif wish is Wish.RESUME:
            resting = self.stage is Stage.STOPPED
            self._to(Stage.APPROACH, "", now)
            self._asked, self._armed = now, not resting
            return [Pace.RESUME, *([Order.ARM] if resting else [])]
        return []

    def _home(self, after: Stage, now: float) -> Orders:
        self._after, self._homed, self._asked = after, False, now
        self._to(Stage.HOMING, "", now)
        said, self._told = self.task.stands_home and not self._told, True
        return [*([Order.AT_HOME] if said else []), Order.HOME]

    # -- what happens

    def _check(self, seen: Seen, now: float) -> None:
        task = self.task
        cameras, calibration = checklist.camera_checks(seen.tracking, now)
        arm, path = checklist.arm_check(seen.motion, task.stands_home), checklist.path_check(task.path, task.start)
        reach, recorder = checklist.reach_check(self.laid), checklist.recorder_check(seen.recorder)
        self.checks = cameras, calibration, arm, path, reach, recorder

    def _missed(self, seen: Seen, now: float) -> str:
        motion, tracking = seen.motion, seen.tracking
        silent = "" if motion is None else silence("motion", motion.tick.stamp, self.task.profile.tick, now)
        if silent or tracking is None or tracking.ended:
            return silent
        return silence("tracking", tracking.stamp, tracking.interval, now)

    def _go_on(self, seen: Seen, now: float) -> Orders:
        tracking, motion = seen.tracking, seen.motion
        if tracking is not None and tracking.ended and not _printed(motion):
            return self.end(f"the cameras: {tracking.ended}", now)
        if seen.recorder is not None and seen.recorder.failed:
            return self.end(seen.recorder.failed, now)
        if self.stage is Stage.CHECK:
            return self._checking(now)
        if tracking is None or motion is None:
            return []
        if self.stage in (Stage.FIND, Stage.CONFIRM, Stage.READY):
            return self._finding(tracking, now)
        self._answers |= motion.tick.status.answers > 0
        if self.stage in RUNNING:
            if orders := self._faults(tracking, motion, now):
                return orders
            if self.stage is Stage.HOMING:
                return self._homing(tracking, motion, now)
            return self._printing(tracking, motion, now)
        if self.stage is Stage.STOPPED and self.task.unattended:
            return self.end(f"stopped: {self.reason}", now)
        self._came_back(motion, now)
        return []

    def _checking(self, now: float) -> Orders:
        verdicts = {check.name: check for check in self.checks if check.name != "reach"}
        waits = [check for check in verdicts.values() if check.verdict in (Verdict.FAIL, Verdict.BUSY)]
        if not waits:
            self._to(Stage.FIND, "", now)
            return []
        fails = [check for check in waits if check.verdict is Verdict.FAIL]
        self._failing = min(self._failing, now) if fails else float("inf")
        late = now - self._failing > self.task.patience or now - self._since > SOUGHT
        if self.task.unattended and late:
            return self.end(f"the check failed: {(fails or waits)[0].name}: {(fails or waits)[0].found}", now)
        return []

    def _finding(self, tracking: TrackingReport, now: float) -> Orders:
        task = self.task
        if self.stage is Stage.FIND:
            if tracking.surface_from_path is None or tracking.pose is None or not tracking.pose.state.measured:
                if task.unattended and now - self._since > SOUGHT:
                    why = "no pictures" if tracking.pose is None else tracking.pose.reason
                    return self.end(f"the surface was not found: {why}", now)
                return []
            self.laid = laid_on(task.path, tracking.surface_from_path, tracking.pose, task.profile, task.place)
            if self.laid.unreachable:
                return self.end(f"out of reach: {self.laid.unreachable}", now) if task.unattended else []
            self._to(Stage.CONFIRM, "", now)
        if task.unattended:
            return self._home(Stage.APPROACH, now)
        return []

    def _faults(self, tracking: TrackingReport, motion: LiveMotionReport, now: float) -> Orders:
        status = motion.tick.status
        if status.state is ArmState.UNPLUGGED:
            self._away = True
            return self._stop(f"the arm is unplugged: {status.reason}: plug it in", now)
        if tracking.pose is not None and not tracking.ended and (age := now - tracking.pose.stamp) > self.task.patience:
            return self._stop(f"no pictures for {age:.1f} s", now)
        if status.state is ArmState.ARMED:
            self._armed = True
        elif status.state is ArmState.STOPPED and self._armed and self.stage is not Stage.HOMING:
            self._to(Stage.STOPPED, status.reason, now)
        return []

    def _homing(self, tracking: TrackingReport, motion: LiveMotionReport, now: float) -> Orders:
        """Home, then the path, then armed: in this order, each once the one before is done."""
        status = motion.tick.status
        if status.state is ArmState.ARMED:
            self._homed = True
        elif self._homed and status.state is ArmState.STOPPED:
            return self._stop(status.reason, now)
        if not self._homed or status.state is ArmState.ARMED:
            if now - self._since > HOME_PATIENCE:
                return self.end(f"the arm did not come home: {motion.tick.answer or status.reason}", now)
            if not self._homed and now - self._asked > ASK_AGAIN:
                self._asked = now
                return [Order.HOME]
            return []
        if self._after is Stage.DONE:
            return self.end("the path is printed", now, Stage.DONE)
        self._to(self._after, "at home", now)
        if self._after is Stage.STOPPED:
            return []
        self._asked, self._armed = now, False
        return [*self._begin(tracking.interval, motion), Pace.RESUME, Order.ARM]

    def _begin(self, interval: float, motion: LiveMotionReport) -> Orders:
        """interval: s between two poses, with which the ticks are to be in step."""
        if self._begun:
            return []
        assert self.laid is not None
        self._begun = True
        task, laid, status = self.task, self.laid, motion.tick.status
        path = laid.path if task.lift is None else lifted(laid.path, task.lift)
        lag = task.profile.lag
        if 0 < status.lag < LONGEST_LAG:  # measured from set-point to answer, NaN where it does not answer
            lag = status.lag + task.profile.frame_time
        tick = tick_in_step(laid.profile.tick, interval, max(laid.profile.tick / 2, 2 * laid.profile.frame_time))
        return [Begin(path, replace(laid.profile, lag=lag, tick=tick), task.start, task.fingerprint)]

    def _printing(self, tracking: TrackingReport, motion: LiveMotionReport, now: float) -> Orders:
        progress = motion.progress
        if self.stage is Stage.STOPPED:
            return []
        if not self._armed:
            return self._arm_again(motion, now)
        if progress is None or self.stage is Stage.PAUSED:
            return []
        if progress.phase is Phase.FINISHED or tracking.ended:
            return self._home(Stage.DONE, now)
        if self.stage is Stage.APPROACH and progress.phase is Phase.PRINTING:
            self._to(Stage.PRINT, "", now)
        return []

    def _arm_again(self, motion: LiveMotionReport, now: float) -> Orders:
        """An arm that still moved when it was to be armed is asked again, for a while."""
        if now - self._since > ARM_PATIENCE:
            self._to(Stage.STOPPED, motion.tick.answer or motion.tick.status.reason, now)
            return []
        if now - self._asked < ASK_AGAIN:
            return []
        self._asked = now
        return [Order.ARM]

    def _stop(self, reason: str, now: float) -> Orders:
        """The arm stops and waits for the operator."""
        self._to(Stage.STOPPED, reason, now)
        return [Order.STOP]

    def _came_back(self, motion: LiveMotionReport, now: float) -> None:
        """Say so once an arm that was unplugged is there again, and what is then asked of the operator."""
        status = motion.tick.status
        if self._away and status.state is not ArmState.UNPLUGGED:
            self._away = False
            self._told = self._answers
            self._to(Stage.STOPPED, BACK if self._answers else BACK_SOMEWHERE, now)

    def _to(self, stage: Stage, reason: str, now: float) -> None:
        if (stage, reason) != (self.stage, self.reason):
            self.turn += 1
        self.stage, self.reason, self._since = stage, reason, now


def _printed(motion: LiveMotionReport | None) -> bool:
    """Whether the last checkpoint is printed: what is left, the way home, needs no pictures."""
    progress = None if motion is None else motion.progress
    return progress is not None and progress.fraction >= progress.total - 1
