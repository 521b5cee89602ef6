"""The agenda: everything in its order, whenever it was put there."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from hardware.simulator.agenda import ARRIVAL, EXPOSURE, KNOWN, TICK, Agenda

RANKS = (ARRIVAL, KNOWN, TICK, EXPOSURE)


@given(st.lists(st.tuples(st.sampled_from([0.0, 0.02, 0.04, 1.5]), st.sampled_from(RANKS))))
def test_actions_come_by_instant_then_rank_then_in_the_order_they_were_put(entries: list[tuple[float, int]]) -> None:
    agenda, done = Agenda(), list[tuple[float, int, int]]()
    for i, (instant, rank) in enumerate(entries):
        agenda.at(instant, rank, lambda now, i=i, rank=rank: done.append((now, rank, i)))  # type: ignore[misc]
    instants = list(agenda.run(lambda: np.inf))
    assert done == sorted((instant, rank, i) for i, (instant, rank) in enumerate(entries))
    assert instants == [instant for instant, _, _ in done]


def test_a_pose_that_becomes_known_on_a_tick_is_known_to_it() -> None:
    assert ARRIVAL < KNOWN < TICK < EXPOSURE  # and a picture shows what the tick before it did


def test_what_is_due_at_the_end_or_later_is_not_done() -> None:
    agenda, done = Agenda(), list[float]()
    for instant in (0.0, 1.0, 2.0):
        agenda.at(instant, TICK, done.append)
    assert list(agenda.run(lambda: 1.0)) == [0.0]
    assert done == [0.0]
    list(agenda.run(lambda: 3.0))
    assert done == [0.0, 1.0, 2.0]


def test_an_action_may_put_others_and_end_the_run() -> None:
    agenda, end, done = Agenda(), [10.0], list[float]()

    def tick(now: float) -> None:
        done.append(now)
        agenda.at(now + 1.0, TICK, tick)
        if now == 3.0:
            end[0] = 4.5

    agenda.at(0.0, TICK, tick)
    assert list(agenda.run(lambda: end[0])) == [0.0, 1.0, 2.0, 3.0, 4.0] == done
