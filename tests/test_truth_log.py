"""The ledger of what was due and commanded each millisecond; the agenda's order; the line: ten bits a byte."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from estimation import se3
from estimation.errors import InputError
from estimation.se3 import Array
from estimation.synthetic.movements import ComposedMotion
from estimation.synthetic.world import BASE_FROM_REST
from hardware.arm.profile import ArmProfile, placed
from hardware.process.clock import SimClock
from hardware.simulator.arm.settings import SerialWire
from hardware.simulator.camera_pipeline import ARRIVAL_EVENT, EXPOSURE_EVENT, POSE_EVENT, TICK_EVENT, EventQueue
from hardware.simulator.truth import Truth, TruthLog, row_instants
from planning.command import Command, Hold, Move
from planning.material import FlowShares
from planning.path import Path, PrintPhase, PrintProgress
from tests.moving_surfaces import path_through

TICK, LAG = 0.02, 0.03
ARM = placed(ArmProfile(), BASE_FROM_REST).arm
TRUTH = Truth(BASE_FROM_REST, ComposedMotion(()))
PLACES = [0.0, 4.0, 10.0]  # mm along the path of its checkpoints


def bent() -> Path:
    """Two pieces of 4 and 6 mm; on the second the tool turns by 0.2 rad."""
    path = path_through(np.array([[0.0, 0, 0], [4, 0, 0], [4, 6, 0]]))
    path.surface_from_nozzle[2, :3, :3] = se3.exp_rotation([0.2, 0.0, 0.0])
    return path


def ledger(lag: float = LAG) -> TruthLog:
    return TruthLog(bent(), ARM, TRUTH, TICK, lag)


def progress(fraction: float, phase: PrintPhase = PrintPhase.PRINTING) -> PrintProgress:
    place = float(np.interp(fraction, [0, 1, 2], PLACES))
    return PrintProgress(phase, min(int(np.ceil(fraction)), 2), 3, place, 10.0, fraction)


def move(stamp: float, extrude: bool = True) -> Move:
    return Move(stamp, ARM.home, 5.0, 0, extrude)


def filled(fractions: list[float], start: float = 1.0, extrude: bool = True) -> TruthLog:
    """A print whose ticks, from `start` s on, ask for these fractional checkpoints."""
    book = ledger()
    for i, fraction in enumerate(fractions):
        book.write(move(start + i * TICK, extrude), progress(fraction))
    return book


def at_home(times: Array) -> Array:
    return np.broadcast_to(ARM.home, (len(times), 6))


def test_before_anything_is_commanded_there_is_no_target_and_nothing_is_extruded() -> None:
    log = ledger().rows(row_instants(0.0, 0.05), at_home)
    assert np.isnan(log.base_from_target).all() and np.isnan(log.place).all() and (log.checkpoint == -1).all()
    assert not log.extrude.any() and set(log.reason) == {"no surface is followed yet"}
    assert ledger().last_due == -np.inf


def test_a_command_is_due_one_tick_and_the_known_lag_after_it() -> None:
    book = filled([0.2, 0.4, 1.0])
    assert book.last_due == pytest.approx(1.04 + TICK + LAG)
    log = book.rows(1.0 + LAG + TICK * np.array([0.0, 0.5, 1.0, 1.5, 2.0, 2.5, 3.0, 3.5]), at_home)
    wanted = [np.nan, 0.8, 0.8, 1.2, 1.6, 2.8, 4.0, np.nan]  # mm; the first stretch has no place to come from
    assert log.place == pytest.approx(np.array(wanted), nan_ok=True, abs=1e-9)
    assert log.extrude.tolist() == [False, *[True] * 6, False]
    assert log.checkpoint.tolist() == [-1, 1, 1, 1, 1, 1, 1, -1]


def test_the_target_runs_evenly_along_the_straight_pieces_and_turns_evenly() -> None:
    log = filled([1.0, 1.5, 2.0]).rows(1.0 + LAG + TICK * np.array([1.5, 2.0, 2.5, 3.0]), at_home)
    target = se3.inverse(BASE_FROM_REST) @ log.base_from_target
    assert target[:, :3, 3] == pytest.approx(np.array([[4, 1.5, 0], [4, 3, 0], [4, 4.5, 0], [4, 6, 0]]))
    turns = [se3.log_rotation(t[:3, :3])[0] for t in target]
    assert turns == pytest.approx([0.05, 0.1, 0.15, 0.2]) and log.checkpoint.tolist() == [2, 2, 2, 2]


def test_a_bead_whose_flow_was_adapted_needs_that_and_lays_it_where_no_dispenser_is_simulated() -> None:
    times = 1.0 + LAG + TICK * np.array([1.5, 2.0, 2.5, 3.0])
    book = filled([1.0, 1.5, 2.0])
    planned = book.rows(times, at_home).flow
    book.adapt(FlowShares(np.array([1.4]), np.array([1.8]), np.array([1.5])))
    assert planned.min() > 0 and book.rows(times, at_home).flow == pytest.approx(planned * [1, 1.5, 1.5, 1])
    assert book.planned_flow(times) == pytest.approx(planned * [1, 1.5, 1.5, 1])


@given(st.lists(st.floats(0, 1), min_size=2, max_size=12), st.floats(0, 0.1))
def test_while_printing_the_place_never_goes_back(steps: list[float], lag: float) -> None:
    book = TruthLog(bent(), ARM, TRUTH, TICK, lag)
    for i, fraction in enumerate(np.minimum(np.cumsum(steps), 2.0).tolist()):
        book.write(move(i * TICK), progress(fraction))
    log = book.rows(np.append(row_instants(lag, book.last_due - 1e-9), book.last_due), at_home)
    assert np.isfinite(log.place).all() and (np.diff(log.place) >= -1e-9).all()
    assert log.place.min() >= 0 and log.place.max() <= 10.0
    assert log.place[-1] == pytest.approx(np.interp(min(sum(steps), 2.0), [0, 1, 2], PLACES))


@given(st.floats(0.001, 0.3), st.integers(1, 5))
def test_rows_do_not_depend_on_when_they_are_asked_for(until: float, parts: int) -> None:
    book = filled([0.1, 0.3, 0.9, 1.2], start=0.0)
    whole = book.rows(row_instants(0.0, until), at_home)
    edges = np.linspace(0, until, parts + 1)
    pieces = [book.rows(row_instants(a, b), at_home) for a, b in pairwise(edges)]
    for name in ("stamps", "place", "extrude", "base_from_target"):
        assert np.allclose(np.concatenate([getattr(p, name) for p in pieces]), getattr(whole, name), equal_nan=True)


def test_nothing_is_due_on_the_way_there_and_what_was_reached_stays_due_while_it_holds() -> None:
    book = ledger(lag=0.0)
    commands: list[tuple[Command, PrintProgress]] = [
        (Hold(0.0, 0.001, "no pose yet"), progress(0.0, PrintPhase.WAITING)),
        (move(0.02, extrude=False), progress(0.0, PrintPhase.ENTERING)),
        (move(0.04), progress(0.5)),
        (Hold(0.06, 0.001, "surface is lost"), progress(0.5, PrintPhase.WAITING)),
        (move(0.08, extrude=False), progress(0.5, PrintPhase.ENTERING)),
    ]
    for command, done in commands:
        book.write(command, done)
    log = book.rows(np.array([0.02, 0.04, 0.06, 0.08, 0.10]), at_home)
    assert np.isnan(log.place[:2]).all() and log.place[2:] == pytest.approx([2.0, 2.0, 2.0])
    assert log.extrude.tolist() == [False, False, True, False, False]
    assert log.reason.tolist() == ["no pose yet", "", "", "surface is lost", ""]


def test_the_nozzle_is_where_the_arm_really_stands() -> None:
    book, moved = filled([0.0, 1.0]), ARM.home + np.array([1.0, 2, 3, 0.1, 0, 0])
    log = book.rows(np.array([1.06]), lambda times: np.broadcast_to(moved, (len(times), 6)))
    assert (ARM.arm_from_base @ log.base_from_nozzle[0])[:3, 3] == pytest.approx(moved[:3])
    assert log.surface_from_tip[0] == pytest.approx((se3.inverse(BASE_FROM_REST) @ log.base_from_nozzle[0])[:3, 3])
    assert np.array_equal(log.base_from_surface[0], BASE_FROM_REST)


def test_extruding_is_what_the_rows_say() -> None:
    book = filled([0.5, 1.0])
    times = row_instants(0.9, 1.2)
    assert np.array_equal(book.extruding(times), book.rows(times, at_home).extrude)
    assert book.extruding(times).sum() == 40  # two ticks
    assert not filled([0.5, 1.0], extrude=False).extruding(times).any()


@given(st.floats(0, 100), st.floats(0, 3))
def test_rows_are_on_whole_milliseconds_after_the_start_up_to_the_end(start: float, length: float) -> None:
    rows = row_instants(start, start + length)
    assert (rows <= start + length).all()  # no arm is asked where it will be
    assert len(rows) == pytest.approx(length * 1000, abs=1.01)
    assert np.allclose(rows, np.round(rows, 3), rtol=0, atol=2e-9)
    assert np.allclose(np.diff(rows), 0.001, rtol=0, atol=2e-9)


RANKS = (ARRIVAL_EVENT, POSE_EVENT, TICK_EVENT, EXPOSURE_EVENT)


@given(st.lists(st.tuples(st.sampled_from([0.0, 0.02, 0.04, 1.5]), st.sampled_from(RANKS))))
def test_actions_come_by_instant_then_rank_then_in_the_order_they_were_put(entries: list[tuple[float, int]]) -> None:
    agenda, done = EventQueue(SimClock()), list[tuple[float, int, int]]()
    for i, (instant, rank) in enumerate(entries):
        agenda.at(instant, rank, lambda now, i=i, rank=rank: done.append((now, rank, i)))
    instants = list(agenda.run(lambda: np.inf))
    assert done == sorted((instant, rank, i) for i, (instant, rank) in enumerate(entries))
    assert instants == [instant for instant, _, _ in done]


def test_a_pose_that_becomes_known_on_a_tick_is_known_to_it() -> None:
    assert ARRIVAL_EVENT < POSE_EVENT < TICK_EVENT < EXPOSURE_EVENT  # and a picture shows what the tick before it did


def test_what_is_due_at_the_end_or_later_is_not_done() -> None:
    agenda, done = EventQueue(SimClock()), list[float]()
    for instant in (0.0, 1.0, 2.0):
        agenda.at(instant, TICK_EVENT, done.append)
    assert list(agenda.run(lambda: 1.0)) == [0.0] and done == [0.0]
    list(agenda.run(lambda: 3.0))
    assert done == [0.0, 1.0, 2.0]


def test_an_action_may_put_others_and_end_the_run() -> None:
    agenda, end, done = EventQueue(SimClock()), [10.0], list[float]()

    def tick(now: float) -> None:
        done.append(now)
        agenda.at(now + 1.0, TICK_EVENT, tick)
        if now == 3.0:
            end[0] = 4.5

    agenda.at(0.0, TICK_EVENT, tick)
    assert list(agenda.run(lambda: end[0])) == [0.0, 1.0, 2.0, 3.0, 4.0] == done


sends = st.lists(st.tuples(st.integers(0, 100), st.floats(0, 1)), min_size=1, max_size=10)


def test_a_frame_takes_4_17_ms_at_115200() -> None:
    assert SerialWire(115_200).send(bytes(48), 2.0)[-1] - 2.0 == pytest.approx(48 * 10 / 115_200, abs=1e-12)
    assert SerialWire(9600).send(bytes(48), 0.0)[-1] == pytest.approx(0.05)


@given(sends)
def test_bytes_keep_their_order_and_distance(pieces: list[tuple[int, float]]) -> None:
    wire, now, arrivals = SerialWire(1000.0), 0.0, np.zeros(0)
    for size, wait in pieces:
        now += wait
        sent = wire.send(bytes(size), now)
        assert len(sent) == size and (sent >= now + 0.01 - 1e-12).all()
        arrivals = np.append(arrivals, sent)
    assert (np.diff(arrivals) >= 0.01 - 1e-12).all() and wire.busy_until == max(arrivals, default=-math.inf)


@given(sends)
def test_a_line_without_delay_delivers_at_once(pieces: list[tuple[int, float]]) -> None:
    wire, now = SerialWire(math.inf), 0.0
    for size, wait in pieces:
        now += wait
        assert (wire.send(bytes(size), now) == now).all()


def test_a_busy_line_makes_the_next_frame_wait() -> None:
    wire = SerialWire(1000.0)
    assert wire.send(b"ab", 1.0).tolist() == pytest.approx([1.01, 1.02])
    assert wire.send(b"c", 1.005).tolist() == pytest.approx([1.03])
    assert wire.send(b"d", 2.0).tolist() == pytest.approx([2.01])


@pytest.mark.parametrize("baud", [0.0, -1.0, math.nan])
def test_a_baud_rate_that_makes_no_sense_is_refused(baud: float) -> None:
    with pytest.raises(InputError, match="baud"):
        SerialWire(baud)
