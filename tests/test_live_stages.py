"""The stages of a live run: what leads from one to the next, what ends it, and what waits for the operator."""

from __future__ import annotations

import json
import re
import tracemalloc
from base64 import b64encode
from dataclasses import replace
from pathlib import Path
from pathlib import Path as File

import numpy as np
import pytest

from estimation import se3
from estimation.pose import SurfacePose, TrackState
from hardware.arm.device import ArmState, ArmStatus, Reason
from hardware.arm.profile import ARM_FROM_BENCH, ArmProfile
from hardware.live import records
from hardware.live.checklist import FIRST_PICTURE_TIME, PrintTask, run_checks
from hardware.live.outcome import RunOutcome, RunStatistics
from hardware.live.prepared import Prepared, RunFiles
from hardware.live.records import (
    TRACK_PLACES,
    LiveMotionReport,
    NozzleTrack,
    RecorderReport,
    RunReports,
    TrackingReport,
)
from hardware.live.settings import LiveSettings
from hardware.live.state_machine import RunStateMachine
from hardware.live.view import ViewBuilder, stage_line
from hardware.motion.loop import MaterialStatus, Order, Tick
from hardware.motion.step import BeginPrint, PauseOrder
from hardware.operator.shared_state import CameraPicture, OperatorRequest, PagePictures, Polygons
from hardware.operator.view import (
    MAX_MOVE_DEG,
    MAX_MOVE_MM,
    STAGE_OFFERS,
    CheckVerdict,
    HoldRow,
    MoveRequest,
    RequestAnswer,
    RunStage,
    Wish,
)
from hardware.process.progress import TimeLeft
from hardware.report.report import bead_map, track_map
from planning.command import Hold
from planning.material import FlowShares
from planning.path import LOOK, PrintPhase, PrintProgress, way_lengths
from planning.placement import PathPlacement, PlacedBy, path_middle
from tests.moving_surfaces import raster
from tests.session_files import rig

PROFILE = ArmProfile()
CERTAIN = PathPlacement(np.eye(4), PlacedBy.SCAN, "found", True, True, 0.05, 0.001)
X, Y = np.meshgrid(np.linspace(-60, 60, 25), np.linspace(-60, 60, 25))
GROUND = np.column_stack([X.ravel(), Y.ravel(), 0 * X.ravel()])  # (625, 3) mm, 5 mm apart
SURFACE = SurfacePose(0.0, ARM_FROM_BENCH, np.eye(6) * 1e-6, np.zeros(6), TrackState.TRACKING)


class Staged:
    """A conductor with the reports that it is given; time goes on by `look`."""

    def __init__(self, **task: object) -> None:
        self.conductor = RunStateMachine(PrintTask(raster(), PROFILE, stands_home=True, **task))
        self.now, self.arm = 0.0, ArmState.DISARMED
        self.phase: PrintPhase | None = None
        self.fraction = 1.0  # of 5 checkpoints
        self.wanted, self.material = "", MaterialStatus("gel: off", True, False)
        self.seen, self.pose = RunReports(recorder=RecorderReport(0, 0.0, "")), SURFACE
        self.ended, self.asked, self.answers = "", 0, 0
        self.placement: PathPlacement | None = CERTAIN
        self.points, self.looks, self.outlined = GROUND, 0, False
        self.looked, self.found = 0, ""
        self.orders: list[object] = []
        self.led: list[object] = []  # orders on the way to where it prints, begun paths by a word

    def look(self, *wishes: Wish | MoveRequest, seconds: float = 0.1) -> RunStage:
        self.now += seconds
        asked = []
        for wish in wishes:
            self.asked += 1
            move, wish = (wish, Wish.MOVE) if isinstance(wish, MoveRequest) else (None, wish)
            asked.append(OperatorRequest(self.asked, wish, self.conductor.turn, move))
        pose = replace(self.pose, stamp=self.now)
        self.seen.tracking = TrackingReport(
            self.now, ("a", "b"), (0, 1), pose, self.placement, 0.0, 5, ended=self.ended, used=(50, 50),
            surface=self.points, looks=self.looks, outlined=self.outlined, looked=self.looked, look=self.found,
        )  # fmt: skip
        nan = float("nan")
        status = ArmStatus(self.now, self.arm, "why", PROFILE.arm.home, None, 0.0, nan, nan, 0.0, 0, 0, self.answers, 0)
        tick = Tick(self.now, Hold(self.now, 0.001, "x"), b"", 0.0, status, Reason())
        place = 1, 6, self.fraction, 9.0, self.fraction, self.wanted
        progress = None if self.phase is None else PrintProgress(self.phase, *place)
        self.seen.motion = LiveMotionReport(tick, progress, self.material, (), (), 0, 0, None, 0, "ordinary")
        self.orders += self.conductor(self.now, self.seen, asked)
        return self.conductor.stage

    def to_homing(self) -> Staged:
        """Lead it to where the arm goes home, with nothing printed yet."""
        confirm, start = ((), ()) if self.conductor.task.unattended else ((Wish.CONFIRM,), (Wish.START,))
        self.look(seconds=0.0)
        self.look()
        self.look(*confirm)
        self.look(*start)
        self.arm = ArmState.ARMED
        self.look()
        return self

    def to_print(self) -> Staged:
        """Lead it to where it prints; the orders until then are forgotten."""
        self.to_homing()
        self.arm = ArmState.DISARMED
        self.look()
        self.arm, self.phase = ArmState.ARMED, PrintPhase.PRINTING
        self.look()
        assert self.look() is RunStage.PRINT
        self.led = [order if isinstance(order, Order | PauseOrder) else "begin" for order in self.orders]
        self.orders.clear()
        return self

    def stays(self, stage: RunStage, looks: int = 100) -> None:
        """Look again and again: it stays where it is."""
        assert {self.look() for _ in range(looks)} == {stage}


def test_stages_follow_each_other_and_the_arm_is_armed_only_after_it_went_home() -> None:
    run = Staged().to_print()
    assert run.led == [Order.AT_HOME, Order.HOME, "begin", PauseOrder.RESUME, Order.ARM]
    run.phase = PrintPhase.FINISHED
    assert run.look() is RunStage.HOMING
    run.look()
    run.arm = ArmState.DISARMED
    assert run.look() is RunStage.DONE and run.conductor.done


def test_nothing_moves_before_it_was_confirmed_and_started() -> None:
    run = Staged()
    for _ in range(50):
        assert run.look() in (RunStage.CHECK, RunStage.FIND, RunStage.CONFIRM)
    run.look(Wish.START, Wish.RESUME, Wish.HOME)
    assert not run.orders
    run.look(Wish.CONFIRM)
    assert not run.orders and run.conductor.stage is RunStage.READY


@pytest.mark.parametrize("stage", [RunStage.CHECK, RunStage.CONFIRM, RunStage.PRINT, RunStage.PAUSED, RunStage.HOMING])
def test_a_stop_is_always_ordered_whatever_the_window_showed(stage: RunStage) -> None:
    run = Staged().to_print()
    run.conductor.stage = stage
    assert run.conductor(run.now, run.seen, [OperatorRequest(1, Wish.STOP, -7)])[0] is Order.STOP


def test_a_wish_from_before_a_stop_lets_nothing_go_on() -> None:
    run = Staged().to_print()
    turn = run.conductor.turn
    run.arm = ArmState.STOPPED
    run.look(Wish.STOP)
    run.orders.clear()
    run.conductor(run.now, run.seen, [OperatorRequest(9, Wish.RESUME, turn)])
    assert run.conductor.stage is RunStage.STOPPED and not run.orders
    assert run.conductor.answer is not None and not run.conductor.answer.followed


def test_a_resume_right_after_a_stop_goes_on_though_the_arm_was_not_seen_to_stop_before() -> None:
    run = Staged().to_print()
    run.look(Wish.STOP)
    run.look(Wish.RESUME)  # the motion has not said yet that it stopped
    run.arm = ArmState.STOPPED
    assert {run.look() for _ in range(5)} == {RunStage.APPROACH} and run.orders[-1] is Order.ARM
    run.arm = ArmState.ARMED
    run.look()
    assert run.look() is RunStage.PRINT
    run.arm = ArmState.STOPPED
    assert run.look() is RunStage.STOPPED


def test_an_arm_that_stops_by_itself_is_not_armed_again_unasked() -> None:
    run = Staged().to_print()
    run.arm = ArmState.STOPPED
    run.stays(RunStage.STOPPED)
    assert not run.orders and run.conductor.reason == "why"
    run.look(Wish.RESUME)
    assert run.orders == [PauseOrder.RESUME, Order.ARM]


def test_what_goes_on_by_itself_ends_where_nobody_is_there_to_resume() -> None:
    run = Staged(unattended=True).to_print()
    run.arm = ArmState.STOPPED
    run.look()
    run.look()
    assert run.conductor.ended == "stopped: why" and run.orders[-1] is Order.STOP


@pytest.mark.parametrize(("fault", "words"), [("cameras", "no more"), ("recorder", "disk")])
def test_what_ends_a_run_stops_the_arm_and_says_so(fault: str, words: str) -> None:
    run = Staged().to_print()
    if fault == "cameras":
        run.ended = "no more"
    else:
        run.seen.recorder = RecorderReport(0, 0.0, "the disk is full")
    run.look()
    assert words in run.conductor.ended and run.conductor.stage is RunStage.FAILED and run.orders[-1] is Order.STOP


@pytest.mark.parametrize("phase", [PrintPhase.LEAVING, PrintPhase.WAITING, PrintPhase.FINISHED])
@pytest.mark.parametrize("unattended", [False, True])
def test_cameras_ending_after_the_print_end_nothing_and_the_arm_goes_home(phase: PrintPhase, unattended: bool) -> None:
    run = Staged(unattended=unattended, patience=1.0).to_print()
    run.phase, run.fraction, run.ended = phase, 5.0, "session is over"
    assert run.look() is RunStage.HOMING and run.orders == [Order.HOME]
    run.conductor(run.now + 1.1, run.seen, [])
    assert run.look() is RunStage.HOMING and not run.conductor.silence
    run.arm = ArmState.DISARMED
    assert run.look() is RunStage.DONE and run.conductor.done and run.orders == [Order.HOME]


def test_an_arm_that_was_stopped_when_all_was_printed_waits_for_the_operator_without_cameras() -> None:
    run = Staged().to_print()
    run.phase, run.fraction, run.arm = PrintPhase.LEAVING, 5.0, ArmState.STOPPED
    run.look(Wish.STOP)
    run.ended = "session is over"
    run.stays(RunStage.STOPPED)
    run.look(Wish.RESUME)
    run.arm = ArmState.ARMED
    assert run.look() is RunStage.HOMING
    run.look()
    run.arm = ArmState.DISARMED
    assert run.look() is RunStage.DONE and run.conductor.done


def test_whoever_ends_a_run_is_not_told_that_it_failed() -> None:
    run = Staged().to_print()
    assert run.look(Wish.END) is RunStage.ENDED and run.orders[-1] is Order.STOP and not run.conductor.done


def test_pictures_that_do_not_come_stop_the_arm_until_somebody_resumes() -> None:
    run = Staged(patience=2.0).to_print()
    assert run.conductor(run.now + 2.1, run.seen, []) == [Order.STOP]
    assert run.conductor.stage is RunStage.STOPPED and "no pictures for 2.1 s" in run.conductor.reason
    run.now += 2.1
    run.arm = ArmState.STOPPED
    run.stays(RunStage.STOPPED)
    run.look(Wish.RESUME)
    run.arm = ArmState.ARMED
    run.look()
    assert run.look() is RunStage.PRINT and not run.conductor.ended


@pytest.mark.parametrize("answers", [0, 5])
def test_an_arm_that_is_unplugged_is_waited_for_and_says_where_it_stands_or_is_told(answers: int) -> None:
    run = Staged()
    run.answers = answers
    run.to_print()
    run.arm = ArmState.UNPLUGGED
    for _ in range(200):
        assert run.look() is RunStage.STOPPED and "plug it in" in run.conductor.reason
    run.arm = ArmState.DISARMED
    run.look()
    assert set(run.orders) == {Order.STOP} and not run.conductor.ended
    assert ("by hand" in run.conductor.reason) == (not answers)
    run.orders.clear()
    run.look(Wish.HOME)
    assert run.orders == [PauseOrder.PAUSE, *([] if answers else [Order.AT_HOME]), Order.HOME]


def test_an_arm_that_is_unplugged_ends_a_run_that_nobody_attends() -> None:
    run = Staged(unattended=True).to_homing()
    run.arm = ArmState.UNPLUGGED
    run.look()
    run.look()
    assert "unplugged" in run.conductor.ended and run.orders[-1] is Order.STOP


def test_an_arm_that_stops_on_its_way_home_is_not_taken_to_be_there() -> None:
    run = Staged().to_homing()
    run.orders.clear()
    run.arm = ArmState.STOPPED
    run.stays(RunStage.STOPPED)
    assert run.conductor.reason == "why" and set(run.orders) <= {Order.STOP}


def test_a_path_out_of_reach_is_told_and_not_begun() -> None:
    run = Staged(unattended=True)
    run.pose = replace(SURFACE, base_from_surface=se3.make(np.eye(3), np.array([900.0, 0, 0])))
    for _ in range(4):
        run.look()
    assert "out of reach: checkpoint 0: X" in run.conductor.ended and run.orders == [Order.STOP]


@pytest.mark.parametrize("name", ["motion", "tracking"])
def test_a_process_that_says_nothing_is_missed_after_two_of_its_words_and_back_with_the_next(name: str) -> None:
    run = Staged().to_print()
    conductor, seen = run.conductor, run.seen
    assert seen.tracking is not None and seen.motion is not None and not conductor.silence
    interval = PROFILE.tick if name == "motion" else 0.033
    said = run.now
    for look in range(1, 40):
        now = said + look * 0.01
        tracking = replace(seen.tracking, interval=0.033, stamp=said if name == "tracking" else now)
        tick = replace(seen.motion.tick, stamp=said if name == "motion" else now)
        conductor(now, RunReports(tracking, replace(seen.motion, tick=tick), seen.recorder), [])
        assert bool(conductor.silence) == (now - said > 2 * interval + 0.01) and name in (conductor.silence or name)
    assert "0.39 s" in conductor.silence and conductor.stage is RunStage.PRINT
    run.look()
    assert not conductor.silence


@pytest.mark.parametrize(
    ("stage", "reason", "line"),
    [
        (RunStage.PRINT, "", "print"),
        (RunStage.DONE, "the path is printed", "done: the path is printed"),
        (RunStage.ENDED, "ended: Ctrl-C", "ended: Ctrl-C"),
        (RunStage.ENDED, "ended by the operator", "ended by the operator"),
    ],
)
def test_a_stage_and_why_are_said_once(stage: RunStage, reason: str, line: str) -> None:
    assert stage_line(stage, reason) == line


def test_another_material_is_asked_for_and_only_the_one_who_was_asked_says_that_it_is_in() -> None:
    run = Staged().to_print()
    run.look(seconds=1.0)
    run.wanted = "cells"
    assert run.look() is RunStage.PAUSED and run.orders == [PauseOrder.PAUSE]
    assert run.conductor.reason == "put in the material cells, then resume"
    run.stays(RunStage.PAUSED)
    run.orders.clear()
    run.look(Wish.RESUME)
    assert run.orders == [PauseOrder.MATERIAL_IN, PauseOrder.RESUME]


def test_between_layers_it_goes_on_once_the_look_is_done_and_nobody_is_asked() -> None:
    run = Staged(looks=True).to_print()
    run.look(seconds=1.0)
    run.wanted = LOOK
    run.stays(RunStage.PRINT)
    assert not run.orders
    run.looked, run.found = 1, "looked at: 5 of 5 mm³"
    assert run.look() is RunStage.PRINT and run.orders == [PauseOrder.MATERIAL_IN]
    assert run.conductor.reason == run.found
    run.stays(RunStage.PRINT)  # the motion's report is still from before
    assert run.orders == [PauseOrder.MATERIAL_IN]


def test_in_a_pause_the_operator_may_look_and_whoever_resumes_goes_on_without_it() -> None:
    run = Staged(looks=True).to_print()
    assert run.look(Wish.LOOK) is RunStage.PRINT and not run.orders  # not while it prints
    run.look(Wish.PAUSE)
    run.orders.clear()
    assert "look at the print" in run.conductor.question
    assert run.look(Wish.LOOK) is RunStage.PAUSED and run.orders == [PauseOrder.LOOK]
    run.wanted = LOOK
    run.stays(RunStage.PAUSED, 5)
    run.looked, run.found = 1, "looked at: nothing lies there"
    assert run.look() is RunStage.PAUSED and run.orders == [PauseOrder.LOOK, PauseOrder.MATERIAL_IN]
    assert run.conductor.reason == run.found
    run.orders.clear()
    run.look(Wish.RESUME)
    assert run.orders == [PauseOrder.MATERIAL_IN, PauseOrder.RESUME]
    assert Wish.LOOK not in Staged().to_print().conductor.offers


def test_without_amounts_in_the_path_nobody_may_look() -> None:
    run = Staged().to_print()
    run.look(Wish.PAUSE)
    assert Wish.RESUME in run.conductor.offers and Wish.LOOK not in run.conductor.offers
    assert run.conductor.question == "Paused: resume, go home, or finish"


def test_after_the_way_home_the_material_is_asked_for_again() -> None:
    run = Staged().to_print()
    run.wanted = "cells"
    run.look(seconds=1.0)
    run.look(Wish.HOME)
    run.arm = ArmState.ARMED
    run.look()
    run.arm = ArmState.DISARMED
    assert run.look() is RunStage.STOPPED
    run.orders.clear()
    run.look(Wish.RESUME)
    assert PauseOrder.MATERIAL_IN not in run.orders
    run.arm = ArmState.ARMED
    run.look()
    assert run.look(seconds=1.0) is RunStage.PAUSED and "cells" in run.conductor.reason


def test_an_unattended_run_has_a_dispenser_for_each_material() -> None:
    run = Staged(unattended=True).to_print()
    run.wanted = "cells"
    assert run.look(seconds=1.0) is RunStage.PRINT and run.orders == [PauseOrder.MATERIAL_IN]


def test_a_dispenser_that_fails_pauses_the_print_and_one_that_gets_ready_does_not() -> None:
    run = Staged().to_print()
    run.material = MaterialStatus("dispenser gel is preparing: 31 of 37 degrees C", False, False)
    run.stays(RunStage.PRINT)
    run.material = MaterialStatus("dispenser gel is failed: unplugged", False, True)
    assert run.look() is RunStage.PAUSED and run.conductor.reason == "dispenser gel is failed: unplugged"
    assert run.orders == [PauseOrder.PAUSE]


@pytest.mark.parametrize(("ready", "failed"), [(False, False), (False, True)])
def test_nothing_begins_before_the_dispenser_is_ready(ready: bool, failed: bool) -> None:
    run = Staged()
    run.material = MaterialStatus("dispenser gel is preparing: its line is opened", ready, failed)
    run.stays(RunStage.CHECK)
    assert [check.found for check in run.conductor.checks if check.name == "material"] == [run.material.text]
    run.material = MaterialStatus("gel: off", True, False)
    run.look()
    assert run.look() is not RunStage.CHECK


@pytest.mark.parametrize("state", [state for state in TrackState if not state.measured])
def test_a_surface_that_is_not_measured_is_not_found(state: TrackState) -> None:
    run = Staged()
    run.pose = replace(SURFACE, state=state)
    assert [run.look() for _ in range(5)][-1] is RunStage.FIND
    run.pose = SURFACE
    assert run.look() is RunStage.CONFIRM


@pytest.mark.parametrize(
    ("age", "delivering", "verdict"),
    [
        (0.99, (0, 1, 2), CheckVerdict.PASS),
        (1.01, (0, 1, 2), CheckVerdict.FAIL),
        (0.1, (0, 2), CheckVerdict.WARN),
        (0.1, (1,), CheckVerdict.FAIL),
    ],
)
def test_cameras_pass_that_deliver_now_and_one_alone_does_not(
    age: float, delivering: tuple[int, ...], verdict: CheckVerdict
) -> None:
    tracking = TrackingReport(5.0, ("a", "b", "c"), delivering, replace(SURFACE, stamp=5.0 - age))
    checks = run_checks(RunReports(tracking=tracking), PrintTask(raster(), PROFILE, stands_home=True), None, 5.0)
    assert {check.name: check.verdict for check in checks}["cameras"] is verdict


GUESS = replace(CERTAIN, by=PlacedBy.REGION, verdict="placed by the region, move it", certain=False)
NOT_FOUND = replace(CERTAIN, verdict="the scan was not found here", certain=False, usable=False)


def to_confirm(placement: PathPlacement, **task: object) -> Staged:
    run = Staged(**task)
    run.placement = placement
    run.look(seconds=0.0)
    run.look()
    return run


def test_what_a_scan_found_for_certain_may_be_confirmed_at_once_or_moved() -> None:
    run = to_confirm(CERTAIN)
    assert run.look() is RunStage.CONFIRM and run.conductor.offers == (Wish.CONFIRM, Wish.MOVE, Wish.AGAIN, Wish.END)
    assert run.look(Wish.CONFIRM) is RunStage.READY


@pytest.mark.parametrize("placement", [GUESS, replace(GUESS, by=PlacedBy.SCAN)], ids=["region", "open scan"])
def test_a_guess_is_confirmed_by_nobody_before_it_was_moved(placement: PathPlacement) -> None:
    run = to_confirm(placement)
    assert run.conductor.reason == placement.verdict and run.conductor.question.startswith("Move the path")
    assert Wish.CONFIRM not in run.conductor.offers
    assert run.look(Wish.CONFIRM) is RunStage.CONFIRM
    assert run.look(MoveRequest(1.0, -2.0, 5.0)) is RunStage.CONFIRM and run.conductor.answer.followed
    assert run.look(Wish.CONFIRM) is RunStage.READY
    run.look(Wish.START)
    run.arm = ArmState.ARMED
    run.look()
    run.arm = ArmState.DISARMED
    run.look()
    (begun,) = [order for order in run.orders if isinstance(order, BeginPrint)]
    turned = se3.exp_rotation([0.0, 0.0, np.deg2rad(5)])
    middle = path_middle(run.conductor.task.path)
    lies = se3.make(turned, middle + [1.0, -2.0, 0.0] - turned @ middle)
    assert begun.path.surface_from_nozzle == pytest.approx(lies @ run.conductor.task.path.surface_from_nozzle, abs=1e-9)


def test_a_run_that_resumes_begins_with_the_flows_that_looks_asked_for() -> None:
    flows = tuple(
        FlowShares(np.array([at]), np.array([at + 5.0]), np.array([share])) for at, share in ((0.0, 1.2), (5.0, 0.8))
    )
    run = to_confirm(CERTAIN, flows=flows)
    run.look()
    run.look(Wish.CONFIRM)
    run.look(Wish.START)
    run.arm = ArmState.ARMED
    run.look()
    run.arm = ArmState.DISARMED
    run.look()
    at = next(i for i, order in enumerate(run.orders) if isinstance(order, BeginPrint))
    assert tuple(run.orders[at + 1 : at + 3]) == flows


def test_what_cannot_be_placed_is_neither_confirmed_nor_moved_nor_printed() -> None:
    run = to_confirm(NOT_FOUND)
    assert run.conductor.offers == (Wish.AGAIN, Wish.END) and "cannot be placed" in run.conductor.question
    run.look(MoveRequest(1.0, 0.0, 0.0), Wish.CONFIRM, Wish.START)
    run.stays(RunStage.CONFIRM)
    assert run.orders == []


@pytest.mark.parametrize("placement", [GUESS, NOT_FOUND], ids=["guess", "not found"])
def test_nobody_there_and_no_certain_place_ends_the_run(placement: PathPlacement) -> None:
    run = to_confirm(placement, unattended=True)
    assert run.look() is RunStage.FAILED and placement.verdict in run.conductor.ended
    assert Order.HOME not in run.orders


@pytest.mark.parametrize(
    "move",
    [
        None, MoveRequest(MAX_MOVE_MM + 1e-9, 0, 0), MoveRequest(0, -MAX_MOVE_MM - 1e-9, 0),
        MoveRequest(0, 0, MAX_MOVE_DEG + 1e-9), MoveRequest(float("nan"), 0, 0), MoveRequest(0, 0, float("inf")),
    ],
)  # fmt: skip
def test_a_move_that_is_none_or_too_far_moves_nothing(move: MoveRequest | None) -> None:
    run = to_confirm(CERTAIN)
    placed, turn = run.conductor.placed_path, run.conductor.turn
    run.look(Wish.MOVE if move is None else move)
    assert run.conductor.placed_path is placed and run.conductor.turn == turn and not run.conductor.answer.followed


def test_a_move_off_the_mapped_surface_or_while_it_is_not_seen_says_why() -> None:
    run = to_confirm(CERTAIN)
    run.look(MoveRequest(90.0, 0.0, 0.0))
    assert "nothing of the surface is mapped there" in run.conductor.answer.words
    run.pose = replace(run.pose, state=TrackState.LOST)
    run.look(MoveRequest(1.0, 0.0, 0.0))
    assert "not seen" in run.conductor.answer.words


def test_each_move_is_a_turn_so_that_what_was_shown_before_is_not_confirmed() -> None:
    run = to_confirm(CERTAIN)
    shown = run.conductor.turn
    for _ in range(2):
        turn = run.conductor.turn
        run.look(MoveRequest(1.0, 0.0, 0.0))
        assert run.conductor.turn > turn
    run.conductor(run.now, run.seen, [OperatorRequest(99, Wish.CONFIRM, shown)])
    assert run.conductor.stage is RunStage.CONFIRM and "look again" in run.conductor.answer.words


@pytest.mark.parametrize("stage", [stage for stage in RunStage if stage is not RunStage.CONFIRM])
def test_a_path_is_moved_while_it_is_to_be_confirmed_and_at_no_other_stage(stage: RunStage) -> None:
    assert Wish.MOVE not in STAGE_OFFERS.get(stage, ())
    run = to_confirm(CERTAIN)
    run.conductor.stage, placed = stage, run.conductor.placed_path
    run.conductor._answer(
        OperatorRequest(7, Wish.MOVE, run.conductor.turn, MoveRequest(1.0, 0, 0)), run.seen.tracking, 1.0
    )
    assert run.conductor.placed_path is placed and not run.conductor.answer.followed


def test_again_looks_anew_and_takes_no_place_of_the_look_before() -> None:
    run = to_confirm(CERTAIN)
    run.look(MoveRequest(1.0, 0.0, 0.0))
    run.look(Wish.AGAIN)
    assert run.conductor.looks == 1 and run.conductor.moves == 0 and run.conductor.placed_path is None
    run.look()
    run.stays(RunStage.FIND, 5)
    run.looks = 1
    assert run.look() is RunStage.CONFIRM and run.conductor.placement is CERTAIN


OUTLINE = (("a", ((1.0, 2.0), (30.0, 2.0), (9.0, 40.0))), ("b", ((5.0, 5.0), (60.0, 5.0), (9.0, 70.0))))


def outlined(run: Staged, outline: Polygons = OUTLINE, turn: int | None = None) -> RequestAnswer:
    """What is answered to a corrected outline."""
    turn = run.conductor.turn if turn is None else turn
    run.orders += run.conductor(run.now, run.seen, [OperatorRequest(77, Wish.OUTLINE, turn, None, outline)])
    assert run.conductor.answer is not None
    return run.conductor.answer


def to_outlining() -> Staged:
    """A run that asks whether the path lies right, and whose page has pictures to correct the outline on."""
    run = to_confirm(CERTAIN)
    run.outlined = True
    run.look()
    return run


def test_a_corrected_outline_looks_anew_inside_it_and_takes_no_place_of_the_look_before() -> None:
    run = to_outlining()
    run.look(MoveRequest(1.0, 0.0, 0.0))
    assert outlined(run).followed
    machine = run.conductor
    assert (machine.looks, machine.outline, machine.moves) == (1, OUTLINE, 0) and machine.placed_path is None
    run.stays(RunStage.FIND, 5)
    assert "outline" in machine.reason and not run.orders
    run.looks = 1
    assert run.look() is RunStage.CONFIRM and machine.outline == OUTLINE
    run.look(Wish.AGAIN)
    assert (machine.looks, machine.outline) == (2, ())
    assert run.look() is RunStage.FIND and machine.reason == ""


def test_where_nothing_is_found_inside_an_outline_a_look_without_it_is_offered_and_else_not() -> None:
    run = to_outlining()
    run.look(Wish.AGAIN)
    assert run.look() is RunStage.FIND and Wish.AGAIN not in run.conductor.offers
    run.looks = 1
    run.look()
    assert outlined(run).followed
    assert run.look() is RunStage.FIND and Wish.AGAIN in run.conductor.offers
    run.look(Wish.AGAIN)
    assert (run.conductor.looks, run.conductor.outline) == (3, ())


@pytest.mark.parametrize("stage", [stage for stage in RunStage if stage is not RunStage.CONFIRM])
def test_an_outline_is_taken_while_the_path_is_to_be_confirmed_and_at_no_other_stage(stage: RunStage) -> None:
    run = to_outlining()
    run.conductor.stage = stage
    assert Wish.OUTLINE not in run.conductor.offers
    assert not outlined(run).followed and run.conductor.looks == 0


def test_an_outline_is_taken_on_pictures_of_this_look_alone_and_of_the_turn_that_was_shown() -> None:
    run = to_confirm(CERTAIN)
    assert not outlined(run).followed  # nothing to draw on
    run.outlined = True
    run.look()
    assert "look again" in outlined(run, turn=run.conductor.turn - 1).words
    assert "send it again" in outlined(run, ()).words  # another one has taken its place
    run.look(Wish.AGAIN)
    run.look()
    run.stays(RunStage.FIND, 3)
    run.looks = 1
    run.outlined = False
    assert run.look() is RunStage.CONFIRM and Wish.OUTLINE not in run.conductor.offers
    run.outlined = True
    run.look()
    assert outlined(run).followed and run.conductor.looks == 2


def test_a_path_that_was_moved_out_of_reach_is_not_confirmed_until_it_is_moved_back() -> None:
    run = Staged()
    run.pose = replace(SURFACE, base_from_surface=SURFACE.base_from_surface)
    low, high = PROFILE.limits.low.copy(), PROFILE.limits.high.copy()
    middle = (SURFACE.base_from_surface @ np.append(path_middle(run.conductor.task.path), 1.0))[:3]
    low[0], high[0] = middle[0] - 25, middle[0] + 25
    profile = replace(PROFILE, limits=replace(PROFILE.limits, low=low, high=high))
    run.conductor.task = replace(run.conductor.task, profile=profile)
    run.look(seconds=0.0)
    assert run.look() is RunStage.CONFIRM and Wish.CONFIRM in run.conductor.offers
    for far, offered in ((40.0, False), (-40.0, True)):
        run.look(MoveRequest(far, 0.0, 0.0))
        assert run.conductor.answer.followed and (Wish.CONFIRM in run.conductor.offers) is offered


@pytest.mark.parametrize(("state", "ends"), [(TrackState.INITIALISING, False), (TrackState.TRACKING, True)])
def test_a_tracker_that_looks_for_a_scan_for_long_is_no_camera_that_fails(state: TrackState, ends: bool) -> None:
    run = Staged(unattended=True, patience=1.0)
    run.pose = replace(SURFACE, state=state)
    run.look(seconds=0.0)
    report = run.seen.tracking
    for _ in range(80):
        run.now += 0.1
        run.seen.tracking = report
        run.orders += run.conductor(run.now, run.seen, [])
        run.conductor.stage = run.conductor.stage if run.conductor.ended else RunStage.CHECK
    assert bool(run.conductor.ended) is ends


def test_while_the_first_pictures_are_waited_for_nobody_is_told_to_plug_in_cameras() -> None:
    task, reports = PrintTask(raster(), PROFILE, stands_home=True), RunReports(TrackingReport(1.0, ("a", "b")))
    early = run_checks(reports, task, None, 5.0, 5.0)[0]
    late = run_checks(reports, task, None, 50.0, FIRST_PICTURE_TIME + 1)[0]
    assert early.verdict is late.verdict is CheckVerdict.BUSY and not early.remedy and "plug in" in late.remedy
    assert "first pictures, for 5 s" in early.found


@pytest.mark.parametrize(("virtual", "words"), [(True, "a virtual arm begins"), (False, "by the operator's word")])
def test_a_row_says_who_said_so(virtual: bool, words: str) -> None:
    run = Staged()
    run.look()
    task = replace(run.conductor.task, stands_home=True, virtual=virtual)
    checks = {check.name: check for check in run_checks(run.seen, task, None, run.now)}
    assert words in checks["arm"].found


def test_after_a_stop_the_nozzle_is_lifted_on_a_word_and_waits_as_in_a_pause() -> None:
    run = Staged().to_print()
    assert Wish.LIFT not in run.conductor.offers
    run.look(Wish.STOP)
    run.arm = ArmState.STOPPED
    run.look()
    assert Wish.LIFT in run.conductor.offers
    run.orders.clear()
    assert run.look(Wish.LIFT) is RunStage.PAUSED
    assert run.orders == [PauseOrder.PAUSE, Order.ARM]
    run.stays(RunStage.PAUSED, 5)  # the arm was not seen to be armed yet, and is asked again
    run.arm = ArmState.ARMED
    run.stays(RunStage.PAUSED, 20)
    run.orders.clear()
    assert run.look(Wish.RESUME) is RunStage.PRINT
    assert run.orders == [PauseOrder.RESUME]


def test_an_arm_at_home_has_nothing_to_be_lifted_off() -> None:
    run = Staged().to_print()
    run.look(Wish.HOME)
    run.look()
    run.arm = ArmState.DISARMED
    assert run.look() is RunStage.STOPPED and Wish.LIFT not in run.conductor.offers


def views_of(run: Staged, start: float = 0.0) -> ViewBuilder:
    task = replace(run.conductor.task, start=start)
    files = RunFiles(File("run.mcap"))
    return ViewBuilder(Prepared(LiveSettings(), File("s"), rig(), False, None, task, None, None, files, ()))


def test_what_any_process_could_not_record_stays_on_the_page_and_is_said_at_the_end() -> None:
    run, statistics = Staged().to_print(), RunStatistics()
    build = views_of(run)
    tracking, motion = replace(run.seen.tracking, unrecorded=3), replace(run.seen.motion, unrecorded=4)
    alone = RunReports(own_unrecorded=5)
    for seen, count in ((run.seen, 0), (RunReports(tracking, motion, None, 5), 12), (alone, 5)):
        notes = build(run.now, run.conductor, seen, statistics).notes
        assert len(notes) == (count > 0) and all(f" for {count} entries" in note for note in notes)
        words = RunOutcome(build.prepared, run.conductor, statistics, seen, 0, 4.0).words
        assert ("has gaps" in words) == (count > 0)


def test_the_view_says_how_far_the_surface_moves_under_a_nozzle_that_was_stopped() -> None:
    run, statistics = Staged().to_print(), RunStatistics()
    build = views_of(run)
    assert build(run.now, run.conductor, run.seen, statistics).motion.rest is None
    run.look(Wish.STOP)
    run.arm = ArmState.STOPPED
    turned = se3.make(se3.exp_rotation(np.array([0.3, -0.2, 0.1])), np.zeros(3))
    for k in range(150):
        breath = se3.make(np.eye(3), np.array([0.0, 0.0, 2.0 * np.sin(2 * np.pi * 0.1 * k / 4)]))
        run.pose = replace(SURFACE, base_from_surface=ARM_FROM_BENCH @ breath @ turned)
        run.look()
        rest = build(run.now, run.conductor, run.seen, statistics).motion.rest
    assert rest.slip == pytest.approx(4.0, abs=0.05) and 9 < rest.seconds <= 10.1
    run.look(Wish.RESUME)
    assert build(run.now, run.conductor, run.seen, statistics).motion.rest is None


def test_a_run_that_resumes_shows_its_place_before_it_moves() -> None:
    run = Staged(start=2.5)
    run.look(seconds=0.0)
    progress = views_of(run, 2.5)(run.now, run.conductor, run.seen, RunStatistics()).progress
    assert progress is not None and progress.begun == progress.fraction == 2.5 and 0 < progress.share < 1
    assert views_of(Staged())(run.now, run.conductor, run.seen, RunStatistics()).progress is None


@pytest.mark.parametrize("rate", [1.0, 0.6, 0.25])
def test_the_time_left_is_what_the_print_takes_by_how_it_got_on_so_far(rate: float) -> None:
    """Prints of 300 s, held at random: the time left is right on average, and its spread holds 9 of 10."""
    ratios, inside = [], []
    for seed in range(60):
        rng, left, done, now, holds = np.random.default_rng(seed), TimeLeft(), 0.0, 0.0, 0.0
        told = None
        while done < 300.0:
            if told is None and done >= 120.0:
                told = now, left(300.0 - done)
            left.add(now, 300.0 - done, True)
            now += 0.2
            if holds > 0:
                holds -= 0.2
            elif rate < 1 and rng.random() < 0.1 * (1 - rate):
                holds = rng.exponential(2.0)
            done += 0.2 if holds <= 0 else 0.0
        assert told is not None
        then, (expected, spread) = told
        assert spread is not None
        ratios.append((now - then) / expected)
        inside.append(spread[0] - 1.0 <= now - then <= spread[1] + 1.0)
    assert np.mean(ratios) == pytest.approx(1.0, abs=0.05)
    assert np.mean(inside) >= 0.8


def test_a_pause_does_not_count_against_the_time_left_and_little_is_said_of_few_blocks() -> None:
    left = TimeLeft()
    for k in range(100):
        left.add(0.2 * k, 300 - 0.2 * k, True)
    assert left(280.0)[0] == 280.0 and left(280.0)[1] is None
    left.add(20.0, 280.0, False)
    for k in range(200):
        left.add(500.0 + 0.2 * k, 280 - 0.2 * k, True)
    assert left(240.0)[0] == pytest.approx(240.0, rel=0.01)


def test_what_a_run_came_to_counts_what_runs_before_it_printed() -> None:
    run = Staged(start=2.5)
    prepared, seen = views_of(run, 2.5).prepared, replace(run.seen, recorder=RecorderReport(1000, 0.0, ""))
    nothing = RunOutcome(prepared, run.conductor, RunStatistics(), replace(seen, recorder=None), 0, 4.0)
    assert nothing.again == "" and "nothing was recorded yet" in nothing.words  # what is not there cannot be resumed
    for fraction, printed in ((float("nan"), 2.5), (4.0, 4.0)):
        outcome = RunOutcome(prepared, run.conductor, RunStatistics(), seen, 0, fraction)
        result = outcome.result()
        ways = np.concatenate([[0.0], np.cumsum(way_lengths(raster().surface_from_nozzle))])
        assert result.fraction == printed
        assert result.printed == pytest.approx(np.interp(printed, np.arange(len(ways)), ways) / ways[-1])
        assert result.begun == 2.5 and result.again == "stillbed live --resume run.mcap" and not result.report


def test_the_report_adds_up_and_shows_what_was_printed(tmp_path: Path) -> None:
    run = Staged(start=2.5)
    statistics = RunStatistics(stages={"approach": 10.0, "print": 50.0, "homing": 9.0}, extruding=40.0, printing=50.0)
    rows = HoldRow("pose is … s old", 3, 12.5), HoldRow("paused by the operator", 1, 2.5)
    statistics.holds = {row.reason: row for row in rows}
    for k in range(100):
        statistics.errors.add(0.2 + 0.001 * k)
        statistics.add_true_error(0.1 + 0.001 * k, 0.1795)
    statistics.add_true_error(float("nan"))
    statistics.stretches[300:350] = statistics.largest = 0.3
    prepared = replace(views_of(run, 2.5).prepared, files=RunFiles(tmp_path / "run.mcap"))
    seen = PagePictures(1.0, (CameraPicture("left", b"whole", near=b"near"), CameraPicture("right", b"whole")), None)
    outcome = RunOutcome(prepared, run.conductor, statistics, run.seen, 0, 4.0, seen).write()
    assert outcome.result().report == str(tmp_path / "run.report.html")
    page = (tmp_path / "run.report.html").read_text(encoding="utf-8")
    rows = dict(re.findall(r"<tr[^>]*><td>([^<]*)</td><td>\d*</td><td>([\d.]+)</td></tr>", page))
    parts = ("pose is … s old", "paused by the operator", "material left", "on the way without material")
    assert [rows[name] for name in parts] == ["12.50", "2.50", "40.00", "5.00"]
    assert rows["since the approach"] == "60.00"
    assert b64encode(b"near").decode() in page and "<figcaption>right</figcaption>" in page
    figures = "true error, 95 % / largest", "within the predicted 95 % bound", "printed by earlier runs"
    for words in (*figures, "the beads from above", "var(--amber)"):
        assert words in page
    summary = json.loads((tmp_path / "run.summary.json").read_text())
    assert summary["within_claim"] == 0.8
    assert summary["true_error_mm"]["max"] == pytest.approx(0.199) and summary["printed_share"] > 0.5


def test_the_track_of_the_nozzle_keeps_every_bead_apart_however_long_the_run() -> None:
    track, laid = NozzleTrack(), 0.0
    for bead in range(400):
        for x in np.arange(0.0, 10.0, 0.1):
            track.add(np.array([x, bead, 0.0]))
        track.lift()
        laid = bead
    rows = track.places
    cuts = np.isnan(rows[:, 0])
    assert len(rows) <= TRACK_PLACES and cuts.sum() == laid and not (cuts[1:] & cuts[:-1]).any()
    beads = np.split(rows, np.flatnonzero(cuts))
    assert all(np.ptp(each[np.isfinite(each[:, 0]), 1]) == 0 for each in beads)
    path = np.array([[0.0, 0, 0], [10, 0, 0], [10, 1, 0], [0, 1, 0]])
    drawn = track_map(rows[:120], path, np.array([0, 1, 0, 1], bool))
    assert drawn.count('class="estimate" d="') > 2 and drawn.count('class="aside" d="') >= 1


def test_the_track_of_the_nozzle_takes_no_more_memory_the_longer_the_run() -> None:
    track, poses = NozzleTrack(), np.tile(np.eye(4), (2, 1, 1))
    tracemalloc.start()
    try:
        begun = tracemalloc.get_traced_memory()[0]
        for number in range(TRACK_PLACES // 2):
            tip = poses[0] @ poses[1]
            tip[0, 3] = number
            track.add(tip[:3, 3])  # as the claims have it: it would keep the whole transform
        grown = tracemalloc.get_traced_memory()[0] - begun
    finally:
        tracemalloc.stop()
    assert grown < 10_000 and track.places[-1, 0] == TRACK_PLACES // 2 - 1  # bytes


def test_the_track_of_the_nozzle_stays_as_short_where_beads_are_many(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(records, "TRACK_PLACES", 100)
    track = NozzleTrack()
    for bead in range(1000):
        for x in range(0, 100, 50):
            track.add(np.array([x, bead, 0.0]))
        track.lift()
    rows = track.places
    steps = np.diff(rows[:, 1])
    assert len(rows) <= 2 * 100 and rows[-1, 1] > 900
    assert not steps[np.isfinite(steps)].any()  # no line from bead to bead


def test_a_way_to_a_checkpoint_has_the_largest_error_of_all_stretches_on_it() -> None:
    points, errors = np.column_stack([np.arange(4.0), np.zeros((4, 2))]), np.full(12, np.nan)
    errors[[1, 5, 6]] = 0.1, 0.3, 0.9
    ways = re.findall(
        r"stroke:var\(--(\w+)\);stroke-width:2;[^>]*d=\"([^\"]*)\"",
        bead_map(points, np.array([0, 1, 1, 0], bool), errors, 0.5),
    )
    drawn = {colour: way.count("M") for colour, way in ways if way}
    assert drawn == {"green": 1, "rose": 1}  # the last way carries no bead
