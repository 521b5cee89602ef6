"""The stages of a run as its operator sees them, and the requests, reports and timeouts that change the stage.

Nothing here waits, sends or reads a clock. Each call takes the newest reports and requests, and returns the orders for
the motion process that follow from them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import inf, isnan, nan

from hardware.arm.device import ArmState
from hardware.arm.profile import in_step, measured_lag
from hardware.live.checklist import (
    PlacedPath,
    PrintTask,
    moved_placement,
    place_path,
    raised_path,
    run_checks,
    silent_process,
)
from hardware.live.records import LiveMotionReport, RunReports, TrackingReport
from hardware.motion.loop import Order
from hardware.motion.print_loop import LoopOrder
from hardware.motion.step import BeginPrint, PauseOrder
from hardware.operator.shared_state import OperatorRequest, Polygons
from hardware.operator.view import (
    ACTIVE_STAGES,
    STAGE_OFFERS,
    STAGE_QUESTIONS,
    Check,
    CheckVerdict,
    MoveRequest,
    RequestAnswer,
    RunStage,
    Wish,
    refusal,
)
from planning.path import LOOK, PrintPhase
from planning.placement import PathPlacement

HOMING_TIMEOUT = 60.0  # s: across the whole room at 20 mm/s
ARMING_TIMEOUT = 5.0  # s until a stopped arm is at rest and can be armed
RESEND_AFTER = 0.3  # s between orders to an arm that was not ready for the last one
SEARCH_TIMEOUT = 180.0  # s in which an unattended run must pass its checks and find the surface
LOOKING_TEXT = "the nozzle steps aside, and what was laid is looked at"
OUTLINED_TEXT = "inside the outline that the operator corrected"
ARM_BACK_TEXT = "the arm is back: resume, or go home first"
ARM_UNPLACED_TEXT = "the arm is back and does not say where it stands: move it to its home by hand, then ask for Home"

Orders = list[LoopOrder]


@dataclass(slots=True)
class RunStateMachine:
    """The stage of a run; call it with each cycle's reports and requests."""

    task: PrintTask
    stage: RunStage = RunStage.CHECK
    reason: str = ""  # why the stage is what it is
    turn: int = 0  # counts changes of stage or reason
    ended: str = ""  # why the run is over, "" while it is not
    done: bool = False  # the path is printed
    silence: str = ""  # that a process is silent while the arm may move, "" while both report
    placed_path: PlacedPath | None = None
    placement: PathPlacement | None = None  # of that path: its source and certainty
    moves: int = 0  # how often the operator has moved it
    looks: int = 0  # how often the surface is to be looked for anew
    outline: Polygons = ()  # the wound's outline as the operator corrected it: the search stays inside; () without
    answer: RequestAnswer | None = None  # to the last request
    checks: tuple[Check, ...] = ()
    _stage_start: float = nan  # s, when the stage was entered
    _order_time: float = -inf  # s, of the last order to the arm
    _failing_since: float = inf  # s, since when a check has failed
    _print_ordered: bool = False  # whether the order to print was given
    _home_declared: bool = False  # whether AT_HOME was sent: the operator states that the arm is at home
    _unplugged: bool = False
    _arm_answered: bool = False  # whether the arm ever answered
    _homed: bool = False  # whether the arm was armed since the last Order.HOME
    _armed: bool = False  # whether it was armed since the last Order.ARM
    _at_home: bool = True  # whether it is at home, and has not left for the surface
    _after_homing: RunStage = RunStage.APPROACH
    _outline_offered: bool = False  # whether the page has pictures of this look to correct the outline on
    _requested_material: str = ""  # that the operator has to put in in this pause
    _looks_done: int = 0  # looks that tracking has reported and the motion was informed of

    @property
    def offers(self) -> tuple[Wish, ...]:
        """The wishes that are accepted now; AGAIN among them where a search inside an outline finds nothing."""
        offers = STAGE_OFFERS.get(self.stage, ())
        if self.stage is RunStage.FIND and self.outline:
            return (Wish.AGAIN, *offers)
        withheld = [Wish.LIFT] if self._at_home else []
        withheld += [] if self.task.looks and not self._at_home else [Wish.LOOK]
        if self.stage is RunStage.CONFIRM and self.placement is not None:
            withheld += [Wish.CONFIRM] if not self.confirmable else []
            withheld += [Wish.MOVE] if not self.placement.usable else []
            withheld += [Wish.OUTLINE] if not self._outline_offered else []
        return tuple(wish for wish in offers if wish not in withheld)

    @property
    def confirmable(self) -> bool:
        """Whether the path's placement may be confirmed: it is certain, or the operator moved the path."""
        placement, placed_path = self.placement, self.placed_path
        if placement is None or placed_path is None or placed_path.unreachable:
            return False
        return placement.certain or (placement.usable and self.moves > 0)

    @property
    def question(self) -> str:
        """The question or instruction for the operator now."""
        if self.stage is RunStage.CONFIRM and self.placement is not None and self.placed_path is not None:
            if not self.placement.usable:
                return "The path cannot be placed here: look again, or finish"
            if self.placed_path.unreachable:
                return "The arm cannot reach the path here: move it, or look again"
            if not self.confirmable:
                return "Move the path to where it should be printed"
        question = STAGE_QUESTIONS.get(self.stage, "")
        return question if Wish.LOOK in self.offers else question.replace(" look at the print,", "")

    def __call__(self, now: float, reports: RunReports, requests: Sequence[OperatorRequest]) -> Orders:
        """The orders that follow from reports and requests at `now`, s."""
        if isnan(self._stage_start):
            self._stage_start = now
        orders: Orders = []
        tracking = reports.tracking
        self._outline_offered = tracking is not None and tracking.outlined and tracking.looks == self.looks
        for request in requests:
            orders += self._answer(request, tracking, now)
        task = self.task
        waiting_time = now - self._stage_start if self.stage is RunStage.CHECK else 0.0
        self.checks = run_checks(reports, task, self.placed_path, now, waiting_time)
        if not self.ended:
            orders += self._advance(reports, now)
        self.silence = silent_process(reports, self.task.profile.tick, now) if self.stage in ACTIVE_STAGES else ""
        return orders

    def end(self, reason: str, now: float, stage: RunStage = RunStage.FAILED) -> Orders:
        """End the run; the arm is stopped where it may still move. stage: DONE, ENDED or FAILED."""
        if self.ended:
            return []
        self.ended, self.done = reason, stage is RunStage.DONE
        self._enter(stage, reason, now)
        return [] if self.done else [Order.STOP]

    def pause(self, reason: str, now: float) -> Orders:
        """Have the nozzle leave the surface and wait above it."""
        self._enter(RunStage.PAUSED, reason, now)
        return [PauseOrder.PAUSE]

    # -- requests

    def _answer(self, request: OperatorRequest, tracking: TrackingReport | None, now: float) -> Orders:
        reason = refusal(request.wish, request.turn, self.offers, self.turn)
        if not reason and request.wish is Wish.MOVE:
            reason = self._move(request.move, tracking, now)
        if not reason and request.wish is Wish.OUTLINE and not request.outline:
            reason = "another outline came at the same time: send it again"
        self.answer = RequestAnswer(request.number, request.wish, not reason, reason)
        return [] if reason else self._follow(request, now)

    def _follow(self, request: OperatorRequest, now: float) -> Orders:
        wish = request.wish
        if wish is Wish.STOP:
            if self.stage in ACTIVE_STAGES:
                self._enter(RunStage.STOPPED, "by the operator", now)
            return [Order.STOP]
        if wish is Wish.END:
            return self.end("finished by the operator", now, RunStage.ENDED)
        if wish is Wish.CONFIRM:
            self._enter(RunStage.READY, "", now)
        elif wish in (Wish.AGAIN, Wish.OUTLINE):
            self.placed_path = self.placement = None
            self.looks, self.moves, self.outline = self.looks + 1, 0, request.outline
            self._enter(RunStage.CHECK, "", now)
        elif wish is Wish.START:
            return self._home(RunStage.APPROACH, now)
        elif wish is Wish.PAUSE:
            return self.pause("by the operator", now)
        elif wish is Wish.HOME:
            return [PauseOrder.PAUSE, *self._home(RunStage.STOPPED, now)]
        elif wish is Wish.LOOK:
            self._enter(RunStage.PAUSED, LOOKING_TEXT, now)
            return [PauseOrder.LOOK]
        elif wish is Wish.LIFT:
            self._enter(RunStage.PAUSED, "lifted by the operator", now)
            self._order_time, self._armed = now, False
            return [PauseOrder.PAUSE, Order.ARM]
        elif wish is Wish.RESUME:
            resting = self.stage is RunStage.STOPPED
            material: Orders = [PauseOrder.MATERIAL_IN] if self._requested_material else []
            self._enter(RunStage.APPROACH, "", now)
            self._order_time, self._armed, self._at_home = now, not resting, False
            return [*material, PauseOrder.RESUME, *([Order.ARM] if resting else [])]
        return []

    def _move(self, move: MoveRequest | None, tracking: TrackingReport | None, now: float) -> str:
        """Move the path along the surface; the reason why it was not moved, "" where it was."""
        placement, placed_path, task = self.placement, self.placed_path, self.task
        assert placement is not None and placed_path is not None
        new_placement = moved_placement(placement, task.path, tracking, move)
        if isinstance(new_placement, str):
            return new_placement
        assert move is not None and tracking is not None and tracking.pose is not None
        self.moves, self.placement, surface_from_path = self.moves + 1, new_placement, new_placement.surface_from_path
        arm, pose = placed_path.profile, tracking.pose
        self.placed_path = place_path(task.path, surface_from_path, pose, arm, False, task.outlets)
        move_text = f"x {move.x_mm:.2f} mm, y {move.y_mm:.2f} mm, turn {move.turn_deg:.2f} degrees"
        reach = f"; out of reach: {self.placed_path.unreachable}" if self.placed_path.unreachable else ""
        self._enter(RunStage.CONFIRM, f"moved by hand, move {self.moves}: {move_text}{reach}", now)
        return ""

    def _home(self, after: RunStage, now: float, reason: str = "") -> Orders:
        self._after_homing, self._homed, self._order_time = after, False, now
        self._enter(RunStage.HOMING, reason, now)
        declared, self._home_declared = self.task.stands_home and not self._home_declared, True
        return [*([Order.AT_HOME] if declared else []), Order.HOME]

    # -- events

    def _advance(self, reports: RunReports, now: float) -> Orders:
        tracking, motion = reports.tracking, reports.motion
        progress = None if motion is None else motion.progress
        printed = progress is not None and progress.fraction >= progress.total - 1  # the way home needs no pictures
        if tracking is not None and tracking.ended and not printed:
            return self.end(f"the cameras: {tracking.ended}", now)
        if reports.recorder is not None and reports.recorder.failed:
            return self.end(reports.recorder.failed, now)
        if self.stage is RunStage.CHECK:
            return self._await_checks(now)
        if tracking is None or motion is None:
            return []
        if self.stage in (RunStage.FIND, RunStage.CONFIRM, RunStage.READY):
            return self._await_surface(tracking, now)
        self._arm_answered |= motion.tick.status.answers > 0
        if self.stage in ACTIVE_STAGES:
            if orders := self._check_faults(tracking, motion, now):
                return orders
            if self.stage is RunStage.HOMING:
                return self._await_home(tracking, motion, now)
            return self._follow_print(tracking, motion, now)
        if self.stage is RunStage.STOPPED and self.task.unattended:
            return self.end(f"stopped: {self.reason}", now)
        self._check_replugged(motion, now)
        return []

    def _await_checks(self, now: float) -> Orders:
        unmet = [c for c in self.checks if c.name != "reach" and c.verdict in (CheckVerdict.FAIL, CheckVerdict.BUSY)]
        if not unmet:
            self._enter(RunStage.FIND, OUTLINED_TEXT if self.outline else "", now)
            return []
        failed = [check for check in unmet if check.verdict is CheckVerdict.FAIL]
        self._failing_since = min(self._failing_since, now) if failed else inf
        timed_out = now - self._failing_since > self.task.patience or now - self._stage_start > SEARCH_TIMEOUT
        if self.task.unattended and timed_out:
            check = (failed or unmet)[0]
            return self.end(f"the check failed: {check.name}: {check.found}", now)
        return []

    def _await_surface(self, tracking: TrackingReport, now: float) -> Orders:
        task = self.task
        if self.stage is RunStage.FIND:
            placement = tracking.placement if tracking.looks == self.looks else None
            if placement is None or tracking.pose is None or not tracking.pose.state.measured:
                if task.unattended and now - self._stage_start > SEARCH_TIMEOUT:
                    reason = "no pictures" if tracking.pose is None else tracking.pose.reason
                    return self.end(f"the surface was not found: {reason}", now)
                return []
            if task.unattended and not placement.certain:
                return self.end(f"where the path belongs is not certain: {placement.verdict}", now)
            pose, surface_from_path = tracking.pose, placement.surface_from_path
            placed_path = place_path(task.path, surface_from_path, pose, task.profile, task.place, task.outlets)
            self.placed_path, self.placement = placed_path, placement
            if placed_path.unreachable and (placement.certain or task.unattended):
                return self.end(f"out of reach: {placed_path.unreachable}", now) if task.unattended else []
            self._enter(RunStage.CONFIRM, placement.verdict, now)
        if task.unattended and self.placement is not None:
            return self._home(RunStage.APPROACH, now, self.placement.verdict)
        return []

    def _check_faults(self, tracking: TrackingReport, motion: LiveMotionReport, now: float) -> Orders:
        status = motion.tick.status
        if status.state is ArmState.UNPLUGGED:
            self._unplugged = True
            return self._stop(f"the arm is unplugged: {status.reason}: plug it in", now)
        if tracking.pose is not None and not tracking.ended and (age := now - tracking.pose.stamp) > self.task.patience:
            return self._stop(f"no pictures for {age:.1f} s", now)
        if status.state is ArmState.ARMED:
            self._armed |= motion.tick.stamp > self._order_time  # else the report is from before the last order
        elif status.state is ArmState.STOPPED and self._armed and self.stage is not RunStage.HOMING:
            self._enter(RunStage.STOPPED, status.reason, now)
        return []

    def _await_home(self, tracking: TrackingReport, motion: LiveMotionReport, now: float) -> Orders:
        """Wait until the arm is home; then begin the path and arm, or enter another stage that follows homing."""
        status = motion.tick.status
        if status.state is ArmState.ARMED:
            self._homed = True
        elif self._homed and status.state is ArmState.STOPPED:
            return self._stop(status.reason, now)
        if not self._homed or status.state is ArmState.ARMED:
            if now - self._stage_start > HOMING_TIMEOUT:
                return self.end(f"the arm did not come home: {motion.tick.answer or status.reason}", now)
            if not self._homed and now - self._order_time > RESEND_AFTER:
                self._order_time = now
                return [Order.HOME]
            return []
        if self._after_homing is RunStage.DONE:
            return self.end("the path is printed", now, RunStage.DONE)
        self._at_home = self._after_homing is RunStage.STOPPED
        self._enter(self._after_homing, "at home" if self._at_home else "", now)
        if self._after_homing is RunStage.STOPPED:
            return []
        self._order_time, self._armed = now, False
        return [*self._begin(tracking.interval, motion), PauseOrder.RESUME, Order.ARM]

    def _begin(self, interval: float, motion: LiveMotionReport) -> Orders:
        """The order to print, once, with the arm's lag as measured so far. interval: s between poses, for the ticks."""
        if self._print_ordered:
            return []
        assert self.placed_path is not None and self.placement is not None
        self._print_ordered = True
        task, profile, status = self.task, self.placed_path.profile, motion.tick.status
        path = self.placed_path.path if task.lift is None else raised_path(self.placed_path.path, task.lift)
        profile = replace(in_step(profile, interval), lag=measured_lag(task.profile, status.lag))
        tissue = None if task.tissue is None else task.tissue.moved(self.placement.surface_from_path)
        return [BeginPrint(path, profile, task.start, task.outlets, task.fingerprint, tissue), *task.flows]

    def _follow_print(self, tracking: TrackingReport, motion: LiveMotionReport, now: float) -> Orders:
        progress = motion.progress
        if self.stage is RunStage.STOPPED:
            return []
        if not self._armed:
            return self._arm_again(motion, now)
        if progress is not None and progress.wanted == LOOK:
            return self._await_look(tracking, now)
        if progress is None or self.stage is RunStage.PAUSED:
            return []
        if progress.phase is PrintPhase.FINISHED or tracking.ended:
            return self._home(RunStage.DONE, now)
        report_current = now - self._order_time > RESEND_AFTER  # the report is no longer from before the last order
        if progress.wanted and report_current:
            return self._ask_for(progress.wanted, now)
        if motion.material is not None and motion.material.failed and report_current:
            return self.pause(motion.material.text, now)
        if self.stage is RunStage.APPROACH and progress.phase is PrintPhase.PRINTING:
            self._enter(RunStage.PRINT, "", now)
        return []

    def _await_look(self, tracking: TrackingReport, now: float) -> Orders:
        """Continue once the look is done for which the nozzle waits; resuming in a pause continues without it."""
        self._requested_material = LOOK if self.stage is RunStage.PAUSED else ""
        if tracking.looked == self._looks_done:
            return []
        self._looks_done = tracking.looked
        self._enter(self.stage, tracking.look, now)
        return [PauseOrder.MATERIAL_IN]

    def _ask_for(self, material: str, now: float) -> Orders:
        """Have the operator put in another material; an unattended run has a dispenser for each."""
        if self.task.unattended:
            return [PauseOrder.MATERIAL_IN]
        orders = self.pause(f"put in the material {material}, then resume", now)
        self._requested_material = material
        return orders

    def _arm_again(self, motion: LiveMotionReport, now: float) -> Orders:
        """Repeat the order to arm, for ARMING_TIMEOUT, while the arm still moves."""
        if now - self._stage_start > ARMING_TIMEOUT:
            self._enter(RunStage.STOPPED, motion.tick.answer or motion.tick.status.reason, now)
            return []
        if now - self._order_time < RESEND_AFTER:
            return []
        self._order_time = now
        return [Order.ARM]

    def _stop(self, reason: str, now: float) -> Orders:
        """Stop the arm and wait for the operator."""
        self._enter(RunStage.STOPPED, reason, now)
        return [Order.STOP]

    def _check_replugged(self, motion: LiveMotionReport, now: float) -> None:
        """Inform the operator when an unplugged arm is back, and say what to do then."""
        status = motion.tick.status
        if self._unplugged and status.state is not ArmState.UNPLUGGED:
            self._unplugged = False
            self._home_declared = self._arm_answered
            self._enter(RunStage.STOPPED, ARM_BACK_TEXT if self._arm_answered else ARM_UNPLACED_TEXT, now)

    def _enter(self, stage: RunStage, reason: str, now: float) -> None:
        if (stage, reason) != (self.stage, self.reason):
            self.turn += 1
        if stage is not RunStage.PAUSED:
            self._requested_material = ""
        self.stage, self.reason, self._stage_start = stage, reason, now
