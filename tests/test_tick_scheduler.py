"""Ticks in step with regular poses, never too fast; the newest value between processes; how evenly a machine works."""

from __future__ import annotations

import multiprocessing
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from estimation.errors import InputError
from hardware.cli import doctor
from hardware.operator.view import CheckVerdict
from hardware.process.clock import (
    EASE_RANGE,
    MAX_EARLY_SHARE,
    SLOW_RATIO,
    Evenness,
    PoseLockedSchedule,
    SimClock,
    TickSchedule,
    WallClock,
    evenness_from_times,
    measure_evenness,
    own_interval,
    tick_in_step,
)
from hardware.process.system import SharedLatest
from tests.moving_surfaces import breathing, pose_at

LOOK = 0.002  # s between looks of the loop


def waits(tick: float, arrivals: np.ndarray, seconds: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """How long each pose waited for its tick, the instants for which ticks were made, and when they were."""
    rhythm, now, seen, taken, waited, instants, made = PoseLockedSchedule(tick, 0.005, 0.0), 0.0, 0, 0, [], [], []
    while now < seconds:
        if (newest := int(np.searchsorted(arrivals, now, "right"))) > seen:
            rhythm.arrived(arrivals[newest - 1])
            seen = newest
        if now >= rhythm.opens(seen > taken):
            if seen > taken:
                waited.append(now - arrivals[seen - 1])
                taken = seen
            instants.append(max(now, rhythm.due))
            made.append(now)
            rhythm.advance(now)
        now = min(max(rhythm.opens(False), now + 1e-6), now + LOOK)
    return np.array(waited), np.array(instants), np.array(made)


@pytest.mark.parametrize("rate", [20.0, 25.0, 29.97, 30.0, 50.0, 60.0])
@pytest.mark.parametrize("begin", [0.0, 0.004, 0.011])
def test_poses_that_come_regularly_wait_for_no_tick(rate: float, begin: float) -> None:
    jitter = np.random.default_rng(1).uniform(-0.002, 0.002, 2000)
    arrivals = begin + np.arange(2000) / rate + jitter
    waited, instants, _ = waits(tick_in_step(0.02, 1 / rate, 0.01), np.sort(arrivals), 12.0)
    settled = waited[len(waited) // 4 :]
    assert settled.max() <= LOOK + 1e-5  # the loop looks no more often
    even = np.diff(instants[len(instants) // 4 :])
    assert even.std() < 0.02 * even.mean()


def test_a_pose_that_is_late_now_and_then_is_taken_half_a_tick_later_at_most() -> None:
    rng = np.random.default_rng(2)
    late = np.where(rng.random(600) < 0.1, rng.uniform(0.0, 0.015, 600), 0.0)
    waited, _, _ = waits(tick_in_step(0.02, 1 / 30, 0.01), np.sort(np.arange(600) / 30 + late), 18.0)
    assert waited[100:].max() <= (1 - MAX_EARLY_SHARE) * 0.0165 + LOOK and waited[100:].mean() < LOOK


@pytest.mark.parametrize("seed", range(5))
def test_between_two_ticks_the_arm_has_time_for_its_move_and_rests_hardly(seed: int) -> None:
    rng = np.random.default_rng(seed)
    arrivals = np.cumsum(rng.uniform(0.01, 0.08, 400))
    _, instants, made = waits(0.0165, arrivals, 15.0)
    for before, after in pairwise(instants):
        assert 1 + EASE_RANGE[0] <= (after - before) / 0.0165 + 1e-9
        assert after - before <= 0.0165 * (1 + EASE_RANGE[1]) + LOOK
    assert (instants - made).max() <= MAX_EARLY_SHARE * 0.0165 + 1e-9


def test_poses_that_come_at_random_leave_ticks_as_they_were() -> None:
    rhythm, rng, free = PoseLockedSchedule(0.0165, 0.005, 0.0), np.random.default_rng(3), 0
    for _ in range(500):
        rhythm.arrived(rhythm.due - rng.uniform(0, 0.0165))
        before = rhythm.due
        rhythm.advance(before)
        free += rhythm.due - before == pytest.approx(0.0165 * 1.005)
    assert free > 450


@given(st.floats(1e-3, 0.5), st.floats(0.005, 0.05))
def test_a_tick_in_step_is_no_longer_than_allowed_and_goes_into_the_interval(interval: float, longest: float) -> None:
    tick = tick_in_step(longest, interval, longest / 2)
    assert longest / 2 <= tick <= longest
    if tick != longest:
        ratio = 0.99 * interval / tick if interval > tick else tick / (0.99 * interval)
        assert ratio == pytest.approx(round(ratio), abs=1e-6)


def test_without_an_interval_or_where_no_shorter_one_is_carried_a_tick_is_as_long_as_it_may_be() -> None:
    assert [tick_in_step(0.02, interval, 0.01) for interval in (float("nan"), 0.0, -1.0)] == [0.02] * 3
    assert tick_in_step(0.05, 1 / 30, 0.05) == 0.05


@given(st.sampled_from([0.02, 1 / 30, 0.1]), st.lists(st.integers(2, 6), max_size=18), st.floats(0.0, 0.02))
def test_the_cameras_interval_is_told_though_most_sets_were_lost(own: float, lost: list[int], jitter: float) -> None:
    kept = max(len(lost) // 2, 3)  # of those one after the other: a third is enough
    between = [own * (1 + jitter * (-1) ** k) * times for k, times in enumerate([*lost, *[1] * kept])]
    assert own_interval(between) == pytest.approx(own, rel=jitter + 1e-9)


def test_of_no_sets_there_is_no_interval() -> None:
    assert np.isnan(own_interval([])) and np.isnan(own_interval([0.0, 0.0]))


def test_ticks_whose_time_has_passed_are_left_out() -> None:
    rhythm = TickSchedule(0.02, 0.0, 0.0)
    assert rhythm.advance(0.001) == 0 and rhythm.due == pytest.approx(0.02)
    assert rhythm.advance(0.055) == 0 and rhythm.due == pytest.approx(0.04)
    assert rhythm.advance(0.105) == 2 and rhythm.due == pytest.approx(0.1)


def test_there_is_nothing_before_the_first_and_then_only_the_newest() -> None:
    newest: SharedLatest[int] = SharedLatest()
    assert newest.get() is None
    for k in range(5):
        newest.put(k)
    assert newest.get() == 4


def test_a_value_is_read_once_and_then_the_same_object() -> None:
    newest: SharedLatest[list[int]] = SharedLatest()
    newest.put([1])
    first = newest.get()
    assert first == [1] and newest.get() is first
    newest.put([1])
    assert newest.get() == [1] and newest.get() is not first


def test_a_pose_comes_through_whole() -> None:
    newest: SharedLatest[object] = SharedLatest()
    pose = pose_at(breathing, 1.0)
    newest.put(pose)
    back = newest.get()
    assert type(back) is type(pose)
    assert np.array_equal(back.base_from_surface, pose.base_from_surface)


def test_what_is_too_large_is_refused_and_what_was_there_stays() -> None:
    newest: SharedLatest[bytes] = SharedLatest(100)
    newest.put(b"x" * 50)
    with pytest.raises(InputError, match="at most 100 bytes"):
        newest.put(b"x" * 101)
    assert newest.get() == b"x" * 50


def test_a_torn_value_is_never_taken() -> None:
    newest: SharedLatest[bytes] = SharedLatest(100)
    newest.put(b"first")
    assert newest.get() == b"first"
    newest.put(b"second")
    memory = memoryview(newest._memory).cast("B")
    memory[8 + 16 + 5] ^= 0xFF  # in the slot of even counts
    assert newest.get() == b"first"
    newest.put(b"third")
    assert newest.get() == b"third"


def put_many(newest: SharedLatest[np.ndarray], count: int) -> None:
    for k in range(count):
        newest.put(np.full(5000, k))


def test_what_another_process_writes_as_fast_as_it_can_is_whole_and_never_older() -> None:
    context = multiprocessing.get_context("spawn")
    newest: SharedLatest[np.ndarray] = SharedLatest()
    writer = context.Process(target=put_many, args=(newest, 2000))
    writer.start()
    last, seen = -1, 0
    while last < 1999 and (writer.is_alive() or newest.get() is not None):
        value = newest.get()
        if value is None:
            continue
        assert (value == value[0]).all() and value[0] >= last
        seen += value[0] > last
        last = int(value[0])
    writer.join(10)
    assert last == 1999 and seen > 1


@given(st.integers(20, 200), st.integers(0, 9), st.floats(1e-4, 1e-2), st.floats(1.01, 20.0))
def test_slow_pieces_count_by_the_time_that_they_take(usual: int, slow: int, piece: float, factor: float) -> None:
    spent = np.array([piece] * usual + [factor * SLOW_RATIO * piece] * slow)
    found = evenness_from_times(spent)
    assert found.usual == pytest.approx(piece) and found.largest == spent.max()
    assert found.slow == pytest.approx(spent[usual:].sum() / spent.sum())


def test_work_is_done_and_a_machine_without_time_is_even() -> None:
    found = measure_evenness(WallClock(), 20)
    assert 0 < found.usual <= found.largest and 0 <= found.slow < 1
    assert measure_evenness(SimClock(), 5) == Evenness(0.0, 0.0, 0.0)


@pytest.mark.parametrize(("slow", "verdict"), [(0.0, CheckVerdict.PASS), (0.02, CheckVerdict.WARN)])
def test_the_doctor_says_so(slow: float, verdict: CheckVerdict, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor, "measure_evenness", lambda clock, pieces: Evenness(0.001, 0.03, slow))
    check = doctor.evenness_check(SimClock())
    assert check.verdict is verdict and "30 ms" in check.found and bool(check.remedy) == (verdict is CheckVerdict.WARN)
