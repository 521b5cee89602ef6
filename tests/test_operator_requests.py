"""Requests cross from the page to the run: bounded, in order, and a stop always."""

from __future__ import annotations

import multiprocessing
import os
import signal

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hardware.operator.shared_state import ALWAYS, OTHERS, SLOTS, Request, RequestLine, Wish, refusal

QUEUED = [wish for wish in Wish if wish is not Wish.STOP]


@given(st.lists(st.one_of(st.sampled_from(QUEUED), st.none()), max_size=80))
def test_requests_come_in_order_and_those_that_found_no_room_were_refused(steps: list[Wish | None]) -> None:
    line, asked, taken, waiting = RequestLine(), [], [], 0
    for turn, step in enumerate(steps):
        if step is None:
            taken += line.take()
            waiting = 0
            continue
        number = line.ask(step, turn)
        assert (number is None) == (waiting >= (SLOTS if step in ALWAYS else OTHERS))
        if number is not None:
            asked.append(Request(number, step, turn))
            waiting += 1
    assert taken + line.take() == asked
    assert [r.number for r in asked] == list(range(1, len(asked) + 1))


@given(st.lists(st.sampled_from([wish for wish in QUEUED if wish not in ALWAYS]), max_size=3 * SLOTS))
def test_a_flood_of_what_leads_elsewhere_leaves_room_for_what_leads_to_rest(flood: list[Wish]) -> None:
    line = RequestLine()
    for wish in flood:
        line.ask(wish, 1)
    assert line.ask(Wish.PAUSE, 1) is not None and line.ask(Wish.END, 1) is not None
    assert [r.wish for r in line.take()][-2:] == [Wish.PAUSE, Wish.END]


@given(st.integers(0, 3 * SLOTS), st.integers(1, 3), st.integers(0, 3 * SLOTS))
def test_a_stop_finds_room_in_any_line_and_voids_what_came_with_it(before: int, stops: int, after: int) -> None:
    line = RequestLine()
    for _ in range(before):
        line.ask(Wish.RESUME, 1)
    assert all(line.ask(Wish.STOP, 0) is not None for _ in range(stops))
    last = line.last_stop
    for _ in range(after):
        line.ask(Wish.START, 1)
    assert line.take() == [Request(last, Wish.STOP, 0)]
    assert line.take() == []
    line.ask(Wish.PAUSE, 2)
    assert [r.wish for r in line.take()] == [Wish.PAUSE]


def test_another_process_that_holds_the_line_sees_the_last_stop() -> None:
    line = RequestLine()
    context = multiprocessing.get_context("spawn")
    child = context.Process(target=_stop, args=(line,))
    child.start()
    child.join(20)
    assert line.last_stop == 1 and line.take() == [Request(1, Wish.STOP, 0)]


def test_a_page_that_is_killed_while_it_asks_leaves_a_line_that_still_works() -> None:
    line = RequestLine()
    context = multiprocessing.get_context("fork")
    for _ in range(10):
        child = context.Process(target=_ask_for_ever, args=(line,))
        child.start()
        before = line.last_stop
        while line.last_stop < before + 50:
            line.take()
        assert child.pid is not None
        os.kill(child.pid, signal.SIGKILL)
        child.join(5)
        line.take()
        number = line.ask(Wish.HOME, 7)
        assert [(r.number, r.wish, r.turn) for r in line.take()] == [(number, Wish.HOME, 7)]


@pytest.mark.parametrize("wish", list(Wish))
def test_a_window_that_shows_what_is_no_longer_so_may_only_stop_pause_and_end(wish: Wish) -> None:
    assert (refusal(wish, 3, list(Wish), 4) == "") == (wish in (Wish.STOP, Wish.PAUSE, Wish.END))
    assert refusal(wish, 4, list(Wish), 4) == ""


@pytest.mark.parametrize("wish", list(Wish))
def test_what_is_not_offered_is_refused_but_for_a_stop(wish: Wish) -> None:
    assert (refusal(wish, 4, [], 4) == "") == (wish is Wish.STOP)


def _stop(line: RequestLine) -> None:
    line.ask(Wish.STOP, 0)


def _ask_for_ever(line: RequestLine) -> None:
    while True:
        line.ask(Wish.STOP, 0)
        line.ask(Wish.PAUSE, 0)
