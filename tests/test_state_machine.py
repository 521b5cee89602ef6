"""States change by two thresholds, slowly up and at once down; cameras that fail are named, left out and taken back."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from estimation.online.camera_health import CameraHealth
from estimation.pose import TrackState
from estimation.state_machine import Measurement, StateMachine, StateSettings

GOOD = Measurement(("left", "right"), 100, 0.1)
LIMITS = StateSettings(first=1)
STEP = 1 / 30

measurements = st.builds(
    Measurement,
    st.lists(st.sampled_from(["left", "right", "top"]), unique=True).map(tuple),
    st.integers(0, 60),
    st.floats(0.0, 4.0),
    st.sampled_from(["", "", "top delivers no picture"]),
    st.sampled_from(["", "", "the scan's place is open"]),
    st.floats(0.0, 0.5),
)


@settings(deadline=None, max_examples=200)
@given(st.lists(st.one_of(st.none(), measurements, st.just(GOOD)), max_size=40), st.floats(0.005, 0.2))
def test_whatever_comes_the_state_says_no_more_than_what_was_seen(seen: list[Measurement | None], step: float) -> None:
    machine, faulty, measured = StateMachine(LIMITS), float("-inf"), 0.0
    machine.begin(0.0)
    for k, one in enumerate(seen, 1):
        stamp = k * step
        state, reason = machine.missed(stamp, "hidden") if one is None else machine.measured(stamp, one)
        assert (reason == "") == (state is TrackState.TRACKING) and machine.state is state
        assert state.measured == (one is not None)
        if one is None:
            assert state is (TrackState.LOST if stamp - measured > LIMITS.coast else TrackState.COASTING)
            faulty = stamp
            continue
        measured = stamp
        bad = len(one.cameras) < 2 or one.tracks < LIMITS.leave_tracks or one.sigma > LIMITS.leave_sigma
        bad |= bool(one.trouble or one.caveat) or one.deformation > LIMITS.leave_deformation
        if bad:
            faulty = stamp
        if bad or stamp - faulty < LIMITS.settle:
            assert state is TrackState.DEGRADED


@settings(deadline=None)
@given(st.lists(st.booleans(), min_size=1, max_size=60))
def test_tracking_never_comes_and_goes_faster_than_it_settles(good: list[bool]) -> None:
    machine, entered = StateMachine(LIMITS), []
    machine.measured(0.0, replace(GOOD, tracks=0))
    before = machine.state
    for k, one in enumerate(good, 1):
        state, _ = machine.measured(k * STEP, GOOD if one else replace(GOOD, tracks=0))
        if state is TrackState.TRACKING and before is not state:
            entered.append(k * STEP)
        before = state
    assert all(b - a > LIMITS.settle for a, b in pairwise(entered))


@pytest.mark.parametrize(
    ("name", "between"), [("tracks", 25), ("sigma", 2.2), ("deformation", 0.25)], ids=["tracks", "sigma", "deformation"]
)
def test_between_two_thresholds_the_state_stays_what_it_was(name: str, between: float) -> None:
    inside, outside = StateMachine(LIMITS), StateMachine(LIMITS)
    inside.measured(0.0, GOOD)
    outside.measured(0.0, replace(GOOD, cameras=("left",)))
    for k in range(1, 10):
        assert inside.measured(k * STEP, replace(GOOD, **{name: between}))[0] is TrackState.TRACKING
        assert outside.measured(k * STEP, replace(GOOD, **{name: between}))[0] is TrackState.DEGRADED


def test_the_first_poses_are_averaged_before_one_is_given_out() -> None:
    machine = StateMachine(StateSettings(first=3))
    machine.begin(0.0)
    said = [machine.measured(k * STEP, GOOD) for k in (1, 2, 3)]
    assert [state for state, _ in said] == [TrackState.INITIALISING] * 2 + [TrackState.TRACKING]
    assert all(reason for _, reason in said[:2]) and not said[2][1]


def test_one_camera_is_named_with_those_that_are_missed() -> None:
    _, reason = StateMachine(LIMITS).measured(
        1.0, replace(GOOD, cameras=("left",), trouble="right delivers no picture")
    )
    assert reason == "one camera alone carries the pose: left; right delivers no picture"


# -- cameras


def healthy() -> CameraHealth:
    health = CameraHealth(["left", "right", "top"])
    for k in range(10):
        look(health, k)
    return health


def look(
    health: CameraHealth,
    k: int,
    used: tuple[int, int, int] = (90, 90, 90),
    off: tuple[float, float, float] = (0.1, 0.1, 0.1),
    odd: frozenset[int] = frozenset(),
) -> str:
    away = np.array(off)
    health.update(k * STEP, np.array(used), 9.0, away, health.allowed(np.zeros(3)), odd)
    return health.trouble(k * STEP)


def test_cameras_that_never_carried_the_pose_are_not_missed() -> None:
    health = CameraHealth(["left", "right", "top"])
    assert [look(health, k, (90, 90, 0)) for k in range(10)] == [""] * 10


def test_a_camera_is_missed_within_a_tenth_of_a_second_but_not_for_a_dropped_frame() -> None:
    health = healthy()
    health.pictures({0, 1}, ())
    said = [look(health, k, (90, 90, 0), (0.1, 0.1, np.nan)) for k in (10, 11, 12)]
    assert said == ["", "", "top delivers no picture"]
    health = healthy()
    assert look(health, 10, (90, 90, 0)) == "" and look(health, 11) == ""


@pytest.mark.parametrize(("fresh", "again", "why"), [((0, 1), (2,), "same picture"), ((0, 1, 2), (), "hardly sees")])
def test_what_is_wrong_with_a_camera_is_said(fresh: tuple[int, ...], again: tuple[int, ...], why: str) -> None:
    health = healthy()
    health.pictures(fresh, again)
    assert health.trouble(9 * STEP, at_once=True) == ""
    look(health, 10, (90, 90, 0))
    assert why in health.trouble(10 * STEP, at_once=True) and "top" in health.trouble(10 * STEP, at_once=True)


def test_a_camera_that_lost_most_of_its_tracks_must_win_more_of_them_back() -> None:
    health = healthy()
    assert "right" in [look(health, k, (90, 25, 90)) for k in range(10, 14)][-1]  # less than three in ten
    assert "right" in look(health, 14, (90, 35, 90))
    assert look(health, 15, (90, 45, 90)) == ""


def test_a_camera_that_stands_off_is_left_out_until_it_agrees_twice() -> None:
    health = healthy()
    odd = frozenset({1})
    assert "right stands 5.0 px off" in look(health, 10, (90, 0, 90), (0.1, 5.0, 0.1), odd)
    assert health.left_out == odd
    look(health, 11, (90, 0, 90), (0.1, 0.7, 0.1), odd)  # between the two thresholds
    look(health, 12, (90, 0, 90), (0.1, np.nan, 0.1), odd)  # nothing seen is no agreement
    look(health, 13, (90, 0, 90), (0.1, 0.1, 0.1), odd)
    assert health.left_out == odd
    look(health, 14, (90, 0, 90), (0.1, 0.1, 0.1), odd)
    assert health.left_out == frozenset()


def test_what_a_camera_usually_stands_off_is_learned() -> None:
    health = healthy()
    narrow = health.allowed(np.zeros(3))[2]
    for k in range(10, 100):
        look(health, k, off=(0.1, 0.1, 0.9))
    assert health.allowed(np.zeros(3))[2] > 2 * narrow and health.allowed(np.zeros(3))[0] == pytest.approx(narrow)
    assert health.allowed(np.full(3, 2.0)).min() > 2.0
