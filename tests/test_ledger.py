"""The ledger: each millisecond has the checkpoint that was due then, and only what was commanded is printed."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from estimation import se3
from estimation.se3 import Array
from estimation.synthetic.arc_rig import REST
from estimation.synthetic.motions import Motion
from hardware.arm.profile import ArmProfile, placed
from hardware.simulator.ledger import Ledger, executed_rows
from hardware.simulator.truth import Truth
from planning.command import Command, Hold, Move
from planning.path import Path
from planning.progress import Phase, Progress
from tests.moving import path_through

TICK, LAG = 0.02, 0.03
ARM = placed(ArmProfile(), REST).arm
TRUTH = Truth(REST, Motion(()))
PLACES = [0.0, 4.0, 10.0]  # mm along the path of its checkpoints


def bent() -> Path:
    """Two pieces of 4 and 6 mm; on the second the tool turns by 0.2 rad."""
    path = path_through(np.array([[0.0, 0, 0], [4, 0, 0], [4, 6, 0]]))
    path.surface_from_nozzle[2, :3, :3] = se3.exp_rotation([0.2, 0.0, 0.0])
    return path


def ledger(lag: float = LAG) -> Ledger:
    return Ledger(bent(), ARM, TRUTH, TICK, lag)


def progress(fraction: float, phase: Phase = Phase.PRINTING) -> Progress:
    place = float(np.interp(fraction, [0, 1, 2], PLACES))
    return Progress(phase, min(int(np.ceil(fraction)), 2), 3, place, 10.0, fraction)


def move(stamp: float, extrude: bool = True) -> Move:
    return Move(stamp, ARM.home, 5.0, 0, extrude)


def filled(fractions: list[float], start: float = 1.0, extrude: bool = True) -> Ledger:
    """A print whose ticks, from `start` s on, ask for these fractional checkpoints."""
    book = ledger()
    for i, fraction in enumerate(fractions):
        book.write(move(start + i * TICK, extrude), progress(fraction))
    return book


def at_home(times: Array) -> Array:
    return np.broadcast_to(ARM.home, (len(times), 6))


def test_before_anything_is_commanded_there_is_no_target_and_nothing_is_extruded() -> None:
    times = executed_rows(0.0, 0.05)
    log = ledger().rows(times, at_home)
    assert np.isnan(log.base_from_target).all()
    assert np.isnan(log.place).all()
    assert (log.checkpoint == -1).all()
    assert not log.extrude.any()
    assert set(log.reason) == {"no surface is followed yet"}
    assert ledger().known_until == -np.inf


def test_a_command_is_due_one_tick_and_the_known_lag_after_it() -> None:
    book = filled([0.2, 0.4, 1.0])
    assert book.known_until == pytest.approx(1.04 + TICK + LAG)
    log = book.rows(1.0 + LAG + TICK * np.array([0.0, 0.5, 1.0, 1.5, 2.0, 2.5, 3.0, 3.5]), at_home)
    wanted = [np.nan, 0.8, 0.8, 1.2, 1.6, 2.8, 4.0, np.nan]  # mm; the first stretch has no place to come from
    assert log.place == pytest.approx(np.array(wanted), nan_ok=True, abs=1e-9)
    assert log.extrude.tolist() == [False, *[True] * 6, False]
    assert log.checkpoint.tolist() == [-1, 1, 1, 1, 1, 1, 1, -1]


def test_the_target_runs_evenly_along_the_straight_pieces_and_turns_evenly() -> None:
    log = filled([1.0, 1.5, 2.0]).rows(1.0 + LAG + TICK * np.array([1.5, 2.0, 2.5, 3.0]), at_home)
    target = se3.inverse(REST) @ log.base_from_target
    assert target[:, :3, 3] == pytest.approx(np.array([[4, 1.5, 0], [4, 3, 0], [4, 4.5, 0], [4, 6, 0]]))
    turns = [se3.log_rotation(t[:3, :3])[0] for t in target]
    assert turns == pytest.approx([0.05, 0.1, 0.15, 0.2])
    assert log.checkpoint.tolist() == [2, 2, 2, 2]


@given(st.lists(st.floats(0, 1), min_size=2, max_size=12), st.floats(0, 0.1))
def test_while_printing_the_place_never_goes_back(steps: list[float], lag: float) -> None:
    book = Ledger(bent(), ARM, TRUTH, TICK, lag)
    for i, fraction in enumerate(np.minimum(np.cumsum(steps), 2.0).tolist()):
        book.write(move(i * TICK), progress(fraction))
    log = book.rows(np.append(executed_rows(lag, book.known_until - 1e-9), book.known_until), at_home)
    assert np.isfinite(log.place).all()
    assert (np.diff(log.place) >= -1e-9).all()
    assert log.place.min() >= 0 and log.place.max() <= 10.0
    assert log.place[-1] == pytest.approx(np.interp(min(sum(steps), 2.0), [0, 1, 2], PLACES))


@given(st.floats(0.001, 0.3), st.integers(1, 5))
def test_rows_do_not_depend_on_when_they_are_asked_for(until: float, parts: int) -> None:
    book = filled([0.1, 0.3, 0.9, 1.2], start=0.0)
    whole = book.rows(executed_rows(0.0, until), at_home)
    edges = np.linspace(0, until, parts + 1)
    pieces = [book.rows(executed_rows(a, b), at_home) for a, b in pairwise(edges)]
    for name in ("stamps", "place", "extrude", "base_from_target"):
        assert np.allclose(np.concatenate([getattr(p, name) for p in pieces]), getattr(whole, name), equal_nan=True)


def test_nothing_is_due_on_the_way_there_and_what_was_reached_stays_due_while_it_holds() -> None:
    book = ledger(lag=0.0)
    commands: list[tuple[Command, Progress]] = [
        (Hold(0.0, 0.001, "no pose yet"), progress(0.0, Phase.WAITING)),
        (move(0.02, extrude=False), progress(0.0, Phase.ENTERING)),
        (move(0.04), progress(0.5)),
        (Hold(0.06, 0.001, "surface is lost"), progress(0.5, Phase.WAITING)),
        (move(0.08, extrude=False), progress(0.5, Phase.ENTERING)),
    ]
    for command, done in commands:
        book.write(command, done)
    log = book.rows(np.array([0.02, 0.04, 0.06, 0.08, 0.10]), at_home)
    assert np.isnan(log.place[:2]).all()
    assert log.place[2:] == pytest.approx([2.0, 2.0, 2.0])
    assert log.extrude.tolist() == [False, False, True, False, False]
    assert log.reason.tolist() == ["no pose yet", "", "", "surface is lost", ""]


def test_the_nozzle_is_where_the_arm_really_stands() -> None:
    book, moved = filled([0.0, 1.0]), ARM.home + np.array([1.0, 2, 3, 0.1, 0, 0])
    log = book.rows(np.array([1.06]), lambda times: np.broadcast_to(moved, (len(times), 6)))
    assert (ARM.arm_from_base @ log.base_from_nozzle[0])[:3, 3] == pytest.approx(moved[:3])
    assert log.surface_from_tip[0] == pytest.approx((se3.inverse(REST) @ log.base_from_nozzle[0])[:3, 3])
    assert np.array_equal(log.base_from_surface[0], REST)


def test_extruding_is_what_the_rows_say() -> None:
    book = filled([0.5, 1.0])
    times = executed_rows(0.9, 1.2)
    assert np.array_equal(book.extruding(times), book.rows(times, at_home).extrude)
    assert book.extruding(times).sum() == 40  # two ticks
    assert not filled([0.5, 1.0], extrude=False).extruding(times).any()


@given(st.floats(0, 100), st.floats(0, 3))
def test_rows_are_on_whole_milliseconds_after_the_start_up_to_the_end(start: float, length: float) -> None:
    rows = executed_rows(start, start + length)
    assert (rows <= start + length).all()  # no arm is asked where it will be
    assert len(rows) == pytest.approx(length * 1000, abs=1.01)
    assert np.allclose(rows, np.round(rows, 3), rtol=0, atol=2e-9)
    assert np.allclose(np.diff(rows), 0.001, rtol=0, atol=2e-9)
