"""Motion detection: what counts is flagged at once and with its onset, and a surface at rest is left in peace."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from estimation import se3
from estimation.online.surface_state import MotionDetector
from estimation.pose import SurfaceMotion
from estimation.se3 import Array
from estimation.synthetic.arc_rig import REST
from tests.slowly import slowly
from tests.synthetic import breathing

RATE = 30.0
SIGMA = np.array([np.deg2rad(0.01)] * 3 + [0.005] * 3)  # one axis of a pose of the simulator's cameras at rest
CENTRE = np.array([4.0, -3.0, 1.0])
START = 90  # frames at rest before a step


def watched(poses: Array, noise: Array, claimed: float = 1.0, seed: int = 0) -> list[SurfaceMotion]:
    """What the detector says of poses (N, 4, 4) under white noise (6,), whose covariance claims `claimed` times it."""
    draw = np.random.default_rng([seed, 1])
    detector = MotionDetector(CENTRE)
    covariance = np.diag((claimed * np.maximum(noise, 1e-6)) ** 2)
    measured = poses @ se3.exp(draw.normal(size=(len(poses), 6)) * noise)
    return [detector(k / RATE, pose, covariance) for k, pose in enumerate(measured)]


def stepped(change: Array, frames: int = START + 30) -> Array:
    """Poses (frames, 4, 4) at REST that from frame START on are moved by `change` (4, 4) about the centre."""
    about = se3.make(np.eye(3), CENTRE)
    moved = REST @ about @ change @ se3.inverse(about)
    return np.stack([REST if k < START else moved for k in range(frames)])


def towards(seed: int) -> Array:
    vector = np.random.default_rng(seed).normal(size=3)
    return np.asarray(vector / np.linalg.norm(vector))


@settings(max_examples=60, deadline=None)
@given(seed=st.integers(0, 10**6), turn=st.booleans(), claimed=st.sampled_from([0.5, 1.0, 3.0]))
def test_a_step_of_300_um_or_a_tenth_of_a_degree_is_flagged_within_two_frames(
    seed: int, turn: bool, claimed: float
) -> None:
    size = np.deg2rad(0.1) if turn else 0.3
    change = np.concatenate([towards(seed) * size * turn, towards(seed) * size * (not turn)])
    said = watched(stepped(se3.exp(change)), SIGMA, claimed, seed)
    assert not any(motion.moving for motion in said[40:START])
    assert said[START + 1].moving
    assert said[START + 1].onset == START / RATE
    assert (said[START + 1].turned if turn else said[START + 1].moved) == pytest.approx(size, rel=0.3)


@pytest.mark.parametrize("claimed", [0.5, 4.0, *slowly(1.0, 2.0)])
def test_a_surface_at_rest_is_not_said_to_move(claimed: float) -> None:
    said = watched(np.broadcast_to(REST, (4000, 4, 4)), 2 * SIGMA, claimed)
    assert said[0].moving and np.isnan(said[0].onset)
    assert not any(motion.moving for motion in said[60:])


def test_a_single_wrong_pose_is_no_movement() -> None:
    poses = stepped(np.eye(4))
    poses[START] = REST @ se3.make(np.eye(3), [0.0, 0.0, 2.0])
    assert not any(motion.moving for motion in watched(poses, SIGMA)[40:])


@settings(max_examples=20, deadline=None)
@given(first=st.floats(-6.0, 6.0), second=st.floats(-6.0, 6.0))
@example(first=4.0, second=0.2)  # back at once, but for a little
def test_whatever_two_poses_do_a_movement_begins_with_one_that_was_seen(first: float, second: float) -> None:
    poses = stepped(np.eye(4), START + 2)
    poses[START:] = REST @ se3.make(np.eye(3), np.array([[0.0, 0.0, first], [0.0, 0.0, second]]))
    for number, motion in enumerate(watched(poses, SIGMA)[40:], 40):
        assert not motion.moving or 0.0 <= motion.onset <= number / RATE


@pytest.mark.parametrize("speed", [0.02, 0.1, 0.3])  # mm/s
def test_a_slow_drift_is_flagged_before_it_has_gone_300_um_more(speed: float) -> None:
    frames = int(START + 0.32 / speed * RATE)
    late = np.maximum(np.arange(frames) - START, 0) / RATE * speed
    poses = REST @ se3.make(np.eye(3), late[:, None] * towards(5))
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
    assert begun < first < begun + 10
    assert begun <= said[first].onset * RATE <= first
    assert all(motion.moving for motion in said[first : ended + 20])
    assert {motion.onset for motion in said[first:]} == {said[first].onset}
    assert not any(motion.moving for motion in said[ended + 40 :])
    assert said[-1].moved < 0.02


def test_a_surface_that_was_moved_while_nobody_looked_is_flagged_when_it_is_seen_again() -> None:
    detector = MotionDetector(CENTRE)
    covariance = np.diag(SIGMA**2)
    away = REST @ se3.make(np.eye(3), [0.5, 0.0, 0.0])
    for k in range(60):
        assert detector(k / RATE, REST, covariance).moving == (k < 31)
    assert [detector(10.0 + k / RATE, away, covariance).moving for k in range(2)] == [False, True]
    assert detector.motion.onset == 10.0


def test_more_noise_than_a_movement_only_takes_longer() -> None:
    change = se3.exp(np.concatenate([towards(3) * np.deg2rad(0.1), np.zeros(3)]))
    said = watched(stepped(change), 3 * SIGMA)
    assert not said[START + 1].moving
    assert said[START + 12].moving
