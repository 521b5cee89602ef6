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
    placement: PathPlacement | None = None  # of that path: by what, and what it is worth
    moves: int = 0  # how often the operator has moved it
    looks: int = 0  # how often the surface is to be looked for anew
    outline: Polygons = ()  # the wound as the operator corrected its outline, inside which that is done; or none
    answer: RequestAnswer | None = None  # to the last request
    checks: tuple[Check, ...] = ()
    _since: float = nan  # s, when the stage was entered
    _ordered: float = -inf  # s, when the last order went to the arm
    _failing: float = inf  # s, since when a check has failed
    _begun: bool = False  # whether the order to print was given
    _home_declared: bool = False  # whether the operator's word that the arm stands at home was passed on
    _unplugged: bool = False
    _answers: bool = False  # whether the arm ever answered
    _homed: bool = False  # whether the arm was armed since it was ordered home
    _armed: bool = False  # whether it was armed since that was ordered
    _at_home: bool = True  # whether it stands where homing led, and has not left for the surface
    _after_homing: RunStage = RunStage.APPROACH
    _outlined: bool = False  # whether the page has pictures of this look, on which the outline can be corrected
    _wanted: str = ""  # material that the operator was asked for in this pause
    _looked: int = 0  # looks that the tracking reported and that are known to the motion

    @property
    def offers(self) -> tuple[Wish, ...]:
        """The wishes that would be followed now; where nothing is found inside an outline, a look without it is one."""
        offers = STAGE_OFFERS.get(self.stage, ())
        if self.stage is RunStage.FIND and self.outline:
            return (Wish.AGAIN, *offers)
        held = [Wish.LIFT] if self._at_home else []
        held += [] if self.task.looks and not self._at_home else [Wish.LOOK]
        if self.stage is RunStage.CONFIRM and self.placement is not None:
            held += [Wish.CONFIRM] if not self.confirmable else []
            held += [Wish.MOVE] if not self.placement.usable else []
            held += [Wish.OUTLINE] if not self._outlined else []
        return tuple(wish for wish in offers if wish not in held)

    @property
    def confirmable(self) -> bool:
        """Whether the path may be confirmed as it lies: found for certain, or moved there by somebody."""
        placement, placed = self.placement, self.placed_path
        if placement is None or placed is None or placed.unreachable:
            return False
        return placement.certain or (placement.usable and self.moves > 0)

    @property
    def question(self) -> str:
        """What the operator is asked or told now."""
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
        if isnan(self._since):
            self._since = now
        orders: Orders = []
        tracking = reports.tracking
        self._outlined = tracking is not None and tracking.outlined and tracking.looks == self.looks
        for request in requests:
            orders += self._answer(request, tracking, now)
        task = self.task
        waited = now - self._since if self.stage is RunStage.CHECK else 0.0
        self.checks = run_checks(reports, task, self.placed_path, now, waited)
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
        why = refusal(request.wish, request.turn, self.offers, self.turn)
        if not why and request.wish is Wish.MOVE:
            why = self._move(request.move, tracking, now)
        if not why and request.wish is Wish.OUTLINE and not request.outline:
            why = "another outline came at the same time: send it again"
        self.answer = RequestAnswer(request.number, request.wish, not why, why)
        return [] if why else self._follow(request, now)

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
            self._ordered, self._armed = now, False
            return [PauseOrder.PAUSE, Order.ARM]
        elif wish is Wish.RESUME:
            resting = self.stage is RunStage.STOPPED
            material: Orders = [PauseOrder.MATERIAL_IN] if self._wanted else []
            self._enter(RunStage.APPROACH, "", now)
            self._ordered, self._armed, self._at_home = now, not resting, False
            return [*material, PauseOrder.RESUME, *([Order.ARM] if resting else [])]
        return []

    def _move(self, move: MoveRequest | None, tracking: TrackingReport | None, now: float) -> str:
        """Move the path along the surface; why it stays where it is, "" where it was moved."""
        placement, placed, task = self.placement, self.placed_path, self.task
        assert placement is not None and placed is not None
        moved = moved_placement(placement, task.path, tracking, move)
        if isinstance(moved, str):
            return moved
        assert move is not None and tracking is not None and tracking.pose is not None
        self.moves, self.placement, lies = self.moves + 1, moved, moved.surface_from_path
        self.placed_path = place_path(task.path, lies, tracking.pose, placed.profile, False, task.outlets)
        where = f"x {move.x_mm:.2f} mm, y {move.y_mm:.2f} mm, turn {move.turn_deg:.2f} degrees"
        reach = f"; out of reach: {self.placed_path.unreachable}" if self.placed_path.unreachable else ""
        self._enter(RunStage.CONFIRM, f"moved by hand, move {self.moves}: {where}{reach}", now)
        return ""

    def _home(self, after: RunStage, now: float, reason: str = "") -> Orders:
        self._after_homing, self._homed, self._ordered = after, False, now
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
        self._answers |= motion.tick.status.answers > 0
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
        waits = [c for c in self.checks if c.name != "reach" and c.verdict in (CheckVerdict.FAIL, CheckVerdict.BUSY)]
        if not waits:
            self._enter(RunStage.FIND, OUTLINED_TEXT if self.outline else "", now)
            return []
        fails = [check for check in waits if check.verdict is CheckVerdict.FAIL]
        self._failing = min(self._failing, now) if fails else inf
        late = now - self._failing > self.task.patience or now - self._since > SEARCH_TIMEOUT
        if self.task.unattended and late:
            check = (fails or waits)[0]
            return self.end(f"the check failed: {check.name}: {check.found}", now)
        return []

    def _await_surface(self, tracking: TrackingReport, now: float) -> Orders:
        task = self.task
        if self.stage is RunStage.FIND:
            placement = tracking.placement if tracking.looks == self.looks else None
            if placement is None or tracking.pose is None or not tracking.pose.state.measured:
                if task.unattended and now - self._since > SEARCH_TIMEOUT:
                    why = "no pictures" if tracking.pose is None else tracking.pose.reason
                    return self.end(f"the surface was not found: {why}", now)
                return []
            if task.unattended and not placement.certain:
                return self.end(f"where the path belongs is not certain: {placement.verdict}", now)
            by = task.profile, task.place, task.outlets
            placed = place_path(task.path, placement.surface_from_path, tracking.pose, *by)
            self.placed_path, self.placement = placed, placement
            if placed.unreachable and (placement.certain or task.unattended):
                return self.end(f"out of reach: {placed.unreachable}", now) if task.unattended else []
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
            self._armed |= motion.tick.stamp > self._ordered  # else the report is from before the last order
        elif status.state is ArmState.STOPPED and self._armed and self.stage is not RunStage.HOMING:
            self._enter(RunStage.STOPPED, status.reason, now)
        return []

    def _await_home(self, tracking: TrackingReport, motion: LiveMotionReport, now: float) -> Orders:
        """Wait until the arm is home; then begin the path, then arm, or what else homing leads to."""
        status = motion.tick.status
        if status.state is ArmState.ARMED:
            self._homed = True
        elif self._homed and status.state is ArmState.STOPPED:
            return self._stop(status.reason, now)
        if not self._homed or status.state is ArmState.ARMED:
            if now - self._since > HOMING_TIMEOUT:
                return self.end(f"the arm did not come home: {motion.tick.answer or status.reason}", now)
            if not self._homed and now - self._ordered > RESEND_AFTER:
                self._ordered = now
                return [Order.HOME]
            return []
        if self._after_homing is RunStage.DONE:
            return self.end("the path is printed", now, RunStage.DONE)
        self._at_home = self._after_homing is RunStage.STOPPED
        self._enter(self._after_homing, "at home" if self._at_home else "", now)
        if self._after_homing is RunStage.STOPPED:
            return []
        self._ordered, self._armed = now, False
        return [*self._begin(tracking.interval, motion), PauseOrder.RESUME, Order.ARM]

    def _begin(self, interval: float, motion: LiveMotionReport) -> Orders:
        """The order to print, once. interval: s between two poses, with which the ticks are to be in step.

        The lag is what is known of it by now; the motion process goes on learning it.
        """
        if self._begun:
            return []
        assert self.placed_path is not None and self.placement is not None
        self._begun = True
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
        heeded = now - self._ordered > RESEND_AFTER  # the report is no longer from before the last order
        if progress.wanted and heeded:
            return self._ask_for(progress.wanted, now)
        if motion.material is not None and motion.material.failed and heeded:
            return self.pause(motion.material.text, now)
        if self.stage is RunStage.APPROACH and progress.phase is PrintPhase.PRINTING:
            self._enter(RunStage.PRINT, "", now)
        return []

    def _await_look(self, tracking: TrackingReport, now: float) -> Orders:
        """Go on once the look is done for which the nozzle stands aside; resuming in a pause goes on without it."""
        self._wanted = LOOK if self.stage is RunStage.PAUSED else ""
        if tracking.looked == self._looked:
            return []
        self._looked = tracking.looked
        self._enter(self.stage, tracking.look, now)
        return [PauseOrder.MATERIAL_IN]

    def _ask_for(self, material: str, now: float) -> Orders:
        """Have the operator put in another material; an unattended run has a dispenser for each."""
        if self.task.unattended:
            return [PauseOrder.MATERIAL_IN]
        orders = self.pause(f"put in the material {material}, then resume", now)
        self._wanted = material
        return orders

    def _arm_again(self, motion: LiveMotionReport, now: float) -> Orders:
        """Order again, for a while, to arm an arm that still moved."""
        if now - self._since > ARMING_TIMEOUT:
            self._enter(RunStage.STOPPED, motion.tick.answer or motion.tick.status.reason, now)
            return []
        if now - self._ordered < RESEND_AFTER:
            return []
        self._ordered = now
        return [Order.ARM]

    def _stop(self, reason: str, now: float) -> Orders:
        """Stop the arm and wait for the operator."""
        self._enter(RunStage.STOPPED, reason, now)
        return [Order.STOP]

    def _check_replugged(self, motion: LiveMotionReport, now: float) -> None:
        """Tell the operator once an arm that was unplugged is there again, and what to do then."""
        status = motion.tick.status
        if self._unplugged and status.state is not ArmState.UNPLUGGED:
            self._unplugged = False
            self._home_declared = self._answers
            self._enter(RunStage.STOPPED, ARM_BACK_TEXT if self._answers else ARM_UNPLACED_TEXT, now)

    def _enter(self, stage: RunStage, reason: str, now: float) -> None:
        if (stage, reason) != (self.stage, self.reason):
            self.turn += 1
        if stage is not RunStage.PAUSED:
            self._wanted = ""
        self.stage, self.reason, self._since = stage, reason, now
