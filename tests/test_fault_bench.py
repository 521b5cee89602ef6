"""The campaign of faults: what is drawn, what is judged as harm, and a run whose faults are said and gone again."""

from __future__ import annotations

from argparse import Namespace
from collections.abc import Callable
from concurrent.futures import Executor, Future
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from estimation.errors import InputError
from estimation.se3 import Array
from hardware.bench import loop_run
from hardware.bench.loop_run import prepare_scenario
from hardware.process.faults import Fault, FaultKind, FaultPart, FaultRunner, check_faults, fault_from_text
from hardware.simulator.deposit import NozzleLog
from tests.campaigns import faults
from tests.campaigns.faults import (
    CAMPAIGN_KINDS,
    FAULT_SPACING,
    FAULTS_A_RUN,
    MAX_DETECTION,
    MAX_ERROR_MM,
    MAX_RECOVERY,
    FaultRow,
    append_log,
    draw_faults,
    fault_figures,
    fault_table,
    judge_fault,
    one_run,
    read_log,
    run_faults,
)
from tests.fault_run import FaultRun, FaultRunRecord, Statement

SCENARIOS = Path(__file__).parents[1] / "data" / "scenarios"
STAMPS, ROWS = np.arange(0.0, 8.0, 0.02), np.arange(0.001, 8.0, 0.001)
FAULT = Fault(FaultPart.CAMERA, FaultKind.OFF, 4.0, 0.5)


def test_the_faults_of_a_run_are_its_own_in_order_and_all_kinds_come_in_turn() -> None:
    assert draw_faults(1, 5) == draw_faults(1, 5) != draw_faults(2, 5)
    seen = set()
    for number in range(12):
        faults = draw_faults(3, number)
        starts = [fault.start for fault in faults]
        assert len(faults) == FAULTS_A_RUN and (np.diff(starts) > FAULT_SPACING - 0.5).all()
        assert all(fault.kind is not FaultKind.KILL and fault.end < after.start for fault, after in pairwise(faults))
        check_faults(faults, FaultRunner.SIMULATE, "x", "y", 3)
        assert [fault_from_text("x", "y", str(fault)) for fault in faults] == faults
        seen |= {(fault.part, fault.kind) for fault in faults}
    assert seen == set(CAMPAIGN_KINDS)


def ran(
    error: Array | None = None, said: tuple[float, float] | None = None, held: tuple[float, float] | None = None
) -> FaultRunRecord:
    """A run whose nozzle goes along x at 5 mm/s, off by `error` (N,) mm; said, held: from, to, s."""
    error = np.zeros(len(ROWS)) if error is None else error
    target = np.tile(np.eye(4), (len(ROWS), 1, 1))
    target[:, 0, 3] = 5 * ROWS
    nozzle = target.copy()
    nozzle[:, 1, 3] += error
    extrude = np.ones(len(ROWS), bool)
    extrude[np.array([held is not None and held[0] <= t < held[1] for t in ROWS])] = False
    none = np.zeros(len(ROWS))
    log = NozzleLog(
        ROWS, target, nozzle, target, none, none.astype(np.int64), extrude, none.astype(str), none[:, None], none
    )
    words = []
    for stamp in STAMPS.tolist():
        holds = held is not None and held[0] <= stamp < held[1]
        talks = said is not None and said[0] <= stamp < said[1]
        words.append(Statement(stamp, "x" if holds or talks else "", not holds, False, stamp - 0.05))
    return FaultRunRecord(statements=words, log=log, end=8.0)


def test_what_is_said_in_time_and_over_with_its_cause_is_well() -> None:
    verdict = judge_fault(ran(said=(4.06, 4.6)), FAULT, 7.0)
    assert verdict is not None and not (verdict.silent or verdict.restless or verdict.operator)
    assert verdict.detected == pytest.approx(0.06) and verdict.exposure == pytest.approx(0.01)
    assert verdict.recovered == pytest.approx(0.1) and verdict.worst == 0.0
    silent = replace(ran(), timeouts=[Statement(4.08, "the motion process has said nothing", False, False, 4.08)])
    hung = judge_fault(silent, replace(FAULT, part=FaultPart.MOTION, kind=FaultKind.HANG), 7.0)
    assert hung is not None and hung.exposure == hung.detected == pytest.approx(0.08) and not hung.restless
    jump = replace(FAULT, part=FaultPart.CLOCK, kind=FaultKind.JUMP, amount=1.0)
    jumped = judge_fault(ran(said=(4.06, 4.6)), jump, 7.0)
    assert jumped is not None and jumped.exposure == jumped.detected and np.isnan(jumped.recovered)


def test_an_error_of_which_nobody_says_a_word_is_silent_and_one_that_is_told_is_not() -> None:
    error = np.where((ROWS > 4.2) & (ROWS < 4.5), MAX_ERROR_MM + 0.1, 0.0)
    silent, told = judge_fault(ran(error), FAULT, 7.0), judge_fault(ran(error, said=(4.1, 4.6)), FAULT, 7.0)
    assert silent is not None and silent.silent and np.isnan(silent.detected) and silent.worst == pytest.approx(1.1)
    assert told is not None and not told.silent
    usual = np.where((ROWS > 1.0) & (ROWS < 1.5), MAX_ERROR_MM, 0.0) + error
    as_usual = judge_fault(ran(usual), FAULT, 7.0)
    assert as_usual is not None and not as_usual.silent


def test_an_arm_that_moves_on_while_it_is_held_is_restless() -> None:
    held = ran(held=(4.1, 5.0))
    moves_on = judge_fault(held, FAULT, 7.0)
    assert moves_on is not None and moves_on.restless and held.log is not None
    nozzle = held.log.base_from_nozzle.copy()
    nozzle[(ROWS > 4.2) & (ROWS < 5.0), 0, 3] = 5 * 4.2
    rests = judge_fault(replace(held, log=replace(held.log, base_from_nozzle=nozzle)), FAULT, 7.0)
    assert rests is not None and not rests.restless


def test_what_never_comes_back_is_told_and_what_struck_no_print_is_left_out() -> None:
    never = judge_fault(ran(said=(4.1, 8.0)), FAULT, 7.0)
    assert never is not None and never.recovered == np.inf and judge_fault(ran(held=(3.8, 4.2)), FAULT, 7.0) is None


def test_a_process_that_hangs_is_told_within_a_tenth_of_a_second(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(loop_run, "MAX_RUN_S", 6.0)
    texts = "motion hang at 3.2s for 0.4s", "tracking hang at 4.7s for 0.3s"
    faults = [fault_from_text("x", "y", text) for text in texts]
    hung = FaultRun(prepare_scenario(SCENARIOS / "still.toml"), faults, 1).record()
    for fault, until in zip(faults, (4.7, 6.0), strict=True):
        verdict = judge_fault(hung, fault, until)
        assert verdict is not None and 0 < verdict.exposure == verdict.detected <= MAX_DETECTION
        assert verdict.recovered <= MAX_RECOVERY and not (verdict.silent or verdict.restless)


@pytest.mark.slow  # single faults are judged above
def test_a_run_of_a_scenario_is_judged_kept_and_not_done_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(loop_run, "MAX_RUN_S", 8.0)
    rows = one_run(1, 1)
    assert rows and all(row.over == 0 and not row.verdict.silent for row in rows)
    append_log(log := tmp_path / "faults.csv", rows)
    again = read_log(log, 1)
    assert [str(row.verdict.fault) for row in again] == [str(row.verdict.fault) for row in rows]
    assert not read_log(log, 2) and "camera" in fault_table([row.verdict for row in again])
    assert {figure.what: figure.value for figure in fault_figures(again)}["silent failures"] == 0
    log.write_text("a,b\n")
    with pytest.raises(InputError, match="header"):
        read_log(log, 1)
    with pytest.raises(InputError, match="--count"):
        run_faults(Namespace(count=0, jobs=1, log=None, out=None, seed=1))


class Here(Executor):
    """Does what is submitted at once."""

    def submit(self, function: Callable[..., Any], /, *arguments: Any, **named: Any) -> Future[Any]:
        future: Future[Any] = Future()
        try:
            future.set_result(function(*arguments, **named))
        except Exception as error:
            future.set_exception(error)
        return future


def test_a_run_that_ends_in_a_traceback_is_counted_and_shown_and_the_others_go_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def falls(seed: int, number: int) -> list[FaultRow]:
        if number == 1:
            raise IndexError("deque index out of range")
        verdict = judge_fault(ran(said=(4.06, 4.6)), FAULT, 7.0)
        assert verdict is not None
        return [FaultRow(seed, number, "still", 0, 1.0, verdict)]

    monkeypatch.setattr(faults, "one_run", falls)
    monkeypatch.setattr(faults, "workers", lambda jobs: Here())
    options = Namespace(count=3 * FAULTS_A_RUN, jobs=1, log=tmp_path / "x.csv", out=None, seed=1)
    found = {figure.what: figure for figure in run_faults(options)}
    assert found["runs that ended in a traceback"].value == 1
    assert found["runs that ended in a traceback"].verdict == "MISSED"
    assert "run 1:" in (said := capsys.readouterr().err) and "IndexError: deque index out of range" in said
    assert sorted(row.run for row in read_log(tmp_path / "x.csv", 1)) == [0, 2]
