"""States change slowly up, at once down; failed cameras are left out and taken back; motion is flagged."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from estimation import se3
from estimation.online.camera_health import CameraHealth
from estimation.online.surface_state import Measurement, MotionDetector, PoseStateMachine, StateSettings
from estimation.pose import MotionState, TrackState
from estimation.se3 import Array
from estimation.synthetic.world import BASE_FROM_REST
from tests.rendered_sets import breathing
from tests.slow_cases import slowly

GOOD = Measurement(("left", "right"), 100, 0.1)
LIMITS = StateSettings(averaged_poses=1)
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


@settings(max_examples=200)
@given(st.lists(st.one_of(st.none(), measurements, st.just(GOOD)), max_size=40), st.floats(0.005, 0.2))
def test_whatever_comes_the_state_says_no_more_than_what_was_seen(seen: list[Measurement | None], step: float) -> None:
    machine, faulty, measured = PoseStateMachine(LIMITS), float("-inf"), 0.0
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


@given(st.lists(st.booleans(), min_size=1, max_size=60))
def test_tracking_never_comes_and_goes_faster_than_it_settles(good: list[bool]) -> None:
    machine, entered = PoseStateMachine(LIMITS), []
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
    inside, outside = PoseStateMachine(LIMITS), PoseStateMachine(LIMITS)
    inside.measured(0.0, GOOD)
    outside.measured(0.0, replace(GOOD, cameras=("left",)))
    for k in range(1, 10):
        assert inside.measured(k * STEP, replace(GOOD, **{name: between}))[0] is TrackState.TRACKING
        assert outside.measured(k * STEP, replace(GOOD, **{name: between}))[0] is TrackState.DEGRADED


def test_the_first_poses_are_averaged_before_one_is_given_out() -> None:
    machine = PoseStateMachine(StateSettings(averaged_poses=3))
    machine.begin(0.0)
    said = [machine.measured(k * STEP, GOOD) for k in (1, 2, 3)]
    assert [state for state, _ in said] == [TrackState.INITIALISING] * 2 + [TrackState.TRACKING]
    assert all(reason for _, reason in said[:2]) and not said[2][1]


def test_one_camera_is_named_with_those_that_are_missed() -> None:
    alone = replace(GOOD, cameras=("left",), trouble="right delivers no picture")
    _, reason = PoseStateMachine(LIMITS).measured(1.0, alone)
    assert reason == "one camera alone carries the pose: left; right delivers no picture"


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
    health.update(k * STEP, np.array(used), 9.0, away, health.offset_sigma(np.zeros(3)), odd)
    return health.trouble(k * STEP)


def test_cameras_that_never_carried_the_pose_are_not_missed() -> None:
    health = CameraHealth(["left", "right", "top"])
    assert [look(health, k, (90, 90, 0)) for k in range(10)] == [""] * 10


def test_a_camera_is_missed_within_a_tenth_of_a_second_but_not_for_a_dropped_frame() -> None:
    health = healthy()
    health.set_pictures({0, 1}, ())
    said = [look(health, k, (90, 90, 0), (0.1, 0.1, np.nan)) for k in (10, 11, 12)]
    assert said == ["", "", "top delivers no picture"]
    health = healthy()
    assert look(health, 10, (90, 90, 0)) == "" and look(health, 11) == ""


@pytest.mark.parametrize(("fresh", "again", "why"), [((0, 1), (2,), "same picture"), ((0, 1, 2), (), "hardly sees")])
def test_what_is_wrong_with_a_camera_is_said(fresh: tuple[int, ...], again: tuple[int, ...], why: str) -> None:
    health = healthy()
    health.set_pictures(fresh, again)
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
    narrow = health.offset_sigma(np.zeros(3))[2]
    for k in range(10, 100):
        look(health, k, off=(0.1, 0.1, 0.9))
    assert health.offset_sigma(np.zeros(3))[2] > 2 * narrow and health.offset_sigma(np.zeros(3))[0] == pytest.approx(
        narrow
    )
    assert health.offset_sigma(np.full(3, 2.0)).min() > 2.0


RATE = 30.0
SIGMA = np.array([np.deg2rad(0.01)] * 3 + [0.005] * 3)  # one axis of a pose of the simulator's cameras at rest
CENTRE = np.array([4.0, -3.0, 1.0])
START = 90  # frames at rest before a step


def watched(poses: Array, noise: Array, claimed: float = 1.0, seed: int = 0) -> list[MotionState]:
    """What the detector says of poses (N, 4, 4) under white noise (6,), whose covariance claims `claimed` times it."""
    draw = np.random.default_rng([seed, 1])
    detector = MotionDetector(CENTRE)
    covariance = np.diag((claimed * np.maximum(noise, 1e-6)) ** 2)
    measured = poses @ se3.exp(draw.normal(size=(len(poses), 6)) * noise)
    return [detector(k / RATE, pose, covariance) for k, pose in enumerate(measured)]


def stepped(change: Array, frames: int = START + 30) -> Array:
    """Poses (frames, 4, 4) at REST that from frame START on are moved by `change` (4, 4) about the centre."""
    about = se3.make(np.eye(3), CENTRE)
    moved = BASE_FROM_REST @ about @ change @ se3.inverse(about)
    return np.stack([BASE_FROM_REST if k < START else moved for k in range(frames)])


def towards(seed: int) -> Array:
    vector = np.random.default_rng(seed).normal(size=3)
    return np.asarray(vector / np.linalg.norm(vector))


@settings(max_examples=60)
@given(seed=st.integers(0, 10**6), turn=st.booleans(), claimed=st.sampled_from([0.5, 1.0, 3.0]))
def test_a_step_of_300_um_or_0_1_degrees_is_flagged_within_two_frames(seed: int, turn: bool, claimed: float) -> None:
    size = np.deg2rad(0.1) if turn else 0.3
    change = np.concatenate([towards(seed) * size * turn, towards(seed) * size * (not turn)])
    said = watched(stepped(se3.exp(change)), SIGMA, claimed, seed)
    assert not any(motion.moving for motion in said[40:START]) and said[START + 1].moving
    assert said[START + 1].onset * RATE in (START - 1, START)  # by noise, the pose before it may stand out as well
    assert (said[START + 1].angle if turn else said[START + 1].distance) == pytest.approx(size, rel=0.3)


@pytest.mark.parametrize("turn", [False, True])
def test_a_small_step_is_told_to_begin_at_its_own_frame_in_19_of_20_cases(turn: bool) -> None:
    sizes = np.array([[0.0, 0.3], [np.deg2rad(0.1), 0.0]])[int(turn)].repeat(3)
    steps = [sizes * np.tile(towards(seed), 2) for seed in range(40)]
    onsets = [watched(stepped(se3.exp(step)), SIGMA, 1.0, seed)[START + 1].onset for seed, step in enumerate(steps)]
    assert np.mean(np.array(onsets) == START / RATE) >= 0.95


@pytest.mark.parametrize("claimed", [0.5, 4.0, *slowly(1.0, 2.0)])
def test_a_surface_at_rest_is_not_said_to_move(claimed: float) -> None:
    said = watched(np.broadcast_to(BASE_FROM_REST, (4000, 4, 4)), 2 * SIGMA, claimed)
    assert said[0].moving and np.isnan(said[0].onset)
    assert not any(motion.moving for motion in said[60:])


def test_a_single_wrong_pose_is_no_movement() -> None:
    poses = stepped(np.eye(4))
    poses[START] = BASE_FROM_REST @ se3.make(np.eye(3), [0.0, 0.0, 2.0])
    assert not any(motion.moving for motion in watched(poses, SIGMA)[40:])


@settings(max_examples=20)
@given(first=st.floats(-6.0, 6.0), second=st.floats(-6.0, 6.0))
@example(first=4.0, second=0.2)  # back at once, but for a little
def test_whatever_two_poses_do_a_movement_begins_with_one_that_was_seen(first: float, second: float) -> None:
    poses = stepped(np.eye(4), START + 2)
    poses[START:] = BASE_FROM_REST @ se3.make(np.eye(3), np.array([[0.0, 0.0, first], [0.0, 0.0, second]]))
    for number, motion in enumerate(watched(poses, SIGMA)[40:], 40):
        assert not motion.moving or 0.0 <= motion.onset <= number / RATE


@pytest.mark.parametrize("speed", [0.02, 0.1, 0.3])  # mm/s
def test_a_slow_drift_is_flagged_before_it_has_gone_300_um_more(speed: float) -> None:
    frames = int(START + 0.32 / speed * RATE)
    late = np.maximum(np.arange(frames) - START, 0) / RATE * speed
    poses = BASE_FROM_REST @ se3.make(np.eye(3), late[:, None] * towards(5))
    said = watched(poses, SIGMA)
    flagged = next(k for k in range(40, frames) if said[k].moving)
    assert 0.1 < late[flagged] <= 0.3
    assert START / RATE - 0.5 <= said[flagged].onset <= flagged / RATE


def test_a_breathing_surface_moves_and_one_that_stops_is_at_rest_again() -> None:
    stop = 100
    poses = np.stack([breathing(min(k, stop) / RATE) for k in range(stop + 150)])
    poses = np.concatenate([np.broadcast_to(poses[0], (START, 4, 4)), poses])
    said = watched(poses, SIGMA)
    begun, ended = START, START + stop
    first = next(k for k in range(40, len(said)) if said[k].moving)
    assert begun < first < begun + 10 and begun <= said[first].onset * RATE <= first
    assert all(motion.moving for motion in said[first : ended + 20])
    assert {motion.onset for motion in said[first:]} == {said[first].onset}
    assert not any(motion.moving for motion in said[ended + 40 :]) and said[-1].distance < 0.02


def test_a_surface_that_was_moved_while_nobody_looked_is_flagged_when_it_is_seen_again() -> None:
    detector = MotionDetector(CENTRE)
    covariance = np.diag(SIGMA**2)
    away = BASE_FROM_REST @ se3.make(np.eye(3), [0.5, 0.0, 0.0])
    for k in range(60):
        assert detector(k / RATE, BASE_FROM_REST, covariance).moving == (k < 31)
    assert [detector(10.0 + k / RATE, away, covariance).moving for k in range(2)] == [False, True]
    assert detector.motion.onset == 10.0


def test_more_noise_than_a_movement_only_takes_longer() -> None:
    change = se3.exp(np.concatenate([towards(3) * np.deg2rad(0.1), np.zeros(3)]))
    said = watched(stepped(change), 3 * SIGMA)
    assert not said[START + 1].moving and said[START + 12].moving
