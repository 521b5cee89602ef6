"""Cameras that hang or come late: who has moved tells who is believed; the claim covers whoever may be right."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import pytest

from estimation import se3
from estimation.online.camera_errors import RivalWatch
from estimation.online.estimator import Estimator
from estimation.online.fit import RivalPose
from estimation.pose import SurfacePose, TrackState, radius
from estimation.rig import Rig
from estimation.se3 import Array
from estimation.synthetic.world import BASE_FROM_REST, observations
from tests.rendered_sets import Motion, breathing, still
from tests.slow_cases import slowly
from tests.test_estimator import LANDMARKS, RIG, begun, error, look, step

START = 2.0  # s, when the trick begins
NAMES = [camera.name for camera in RIG.cameras]
Delay = Callable[[float], float]  # stamp, s -> how much older, s, what a camera shows is


def sway(stamp: float) -> Array:
    """20 mm to and fro, at 0.6 Hz: 75 mm/s."""
    phase = 2 * np.pi * 0.6 * stamp
    turn = 0.03 * np.array([np.sin(1.3 * phase), 0.5 * np.sin(phase), np.sin(0.7 * phase)])
    return BASE_FROM_REST @ se3.make(
        se3.exp_rotation(turn), [20 * np.sin(phase), 8 * np.sin(phase + 1), 2 * np.sin(phase)]
    )


def along(camera: int) -> Motion:
    """4 mm to and fro along the axis of a camera."""
    axis = BASE_FROM_REST[:3, :3].T @ RIG.cameras[camera].base_from_camera[:3, 2]
    return lambda t: BASE_FROM_REST @ se3.make(np.eye(3), 2.0 * (1 - np.cos(np.pi * t / 2)) * axis)


def frozen(stamp: float) -> float:
    return max(stamp - START, 0.0)


def late(stamp: float) -> float:
    return 0.1 * (stamp >= START)


def followed(
    motion: Motion, cameras: Sequence[int], delay: Delay, rate: float = 30.0, seconds: float = 3.0
) -> tuple[Estimator, list[SurfacePose]]:
    """The poses from START on, for so many seconds, where `cameras` show what was `delay` s before."""
    estimator, poses = begun(motion), []
    for number in range(1, round((START + seconds) * rate)):
        stamp = number / rate
        delays = [-delay(stamp) if c in cameras else 0.0 for c in range(len(RIG))]
        poses.append(step(estimator, look(motion, stamp, 1, delays=delays)))
    return estimator, [pose for pose in poses if pose.stamp >= START]


def silently_wrong(poses: Sequence[SurfacePose], motion: Motion) -> list[float]:
    """The stamps of measured poses off by more than a millimetre, and more than three times what they claim."""
    claims = radius(np.stack([p.covariance[3:, 3:] for p in poses]), 0.95).tolist()
    pairs = zip(poses, claims, strict=True)
    return [p.stamp for p, claim in pairs if p.state.measured and error(p, motion) > max(1.0, 3 * claim)]


PAIRS = [(1, 2), *slowly((0, 1), (0, 2))]


@pytest.mark.parametrize("cameras", PAIRS)
@pytest.mark.parametrize("motion_at", [(sway, 13.0), *slowly((breathing, 13.0), (breathing, 30.0), (sway, 30.0))])
def test_two_that_hang_never_outvote_the_third_in_silence(
    motion_at: tuple[Motion, float], cameras: tuple[int, int]
) -> None:
    motion, rate = motion_at
    _, poses = followed(motion, cameras, frozen, rate)
    assert not silently_wrong(poses, motion)
    doubts = [p for p in poses if "no majority can be trusted" in p.reason]
    assert len(doubts) > 0.7 * len(poses)
    (good,) = {0, 1, 2} - set(cameras)
    assert any(
        f"no motion in {NAMES[cameras[0]]}, {NAMES[cameras[1]]} while {NAMES[good]} moved" in p.reason for p in doubts
    )
    blamed = (f"{NAMES[good]} stands", f"{NAMES[good]} was bumped", f"{NAMES[good]} shows")
    assert not [p.reason for p in poses if any(words in p.reason for words in blamed)]


@pytest.mark.parametrize("cameras", PAIRS)
def test_two_that_come_late_are_told_by_how_much(cameras: tuple[int, int]) -> None:
    _, poses = followed(sway, cameras, late, seconds=2.0)
    assert not silently_wrong(poses, sway)
    assert TrackState.TRACKING not in {p.state for p in poses[2:]}
    told = f"{NAMES[cameras[0]]}, {NAMES[cameras[1]]} late by 0.1"
    assert sum(told in p.reason for p in poses) > 0.5 * len(poses)


@pytest.mark.parametrize("camera", [2, *slowly(0, 1)])
@pytest.mark.parametrize("trick", [(frozen, sway), (late, sway), *slowly((frozen, breathing))])
def test_one_that_hangs_or_is_late_is_left_out_and_the_others_are_believed(
    trick: tuple[Delay, Motion], camera: int
) -> None:
    delay, motion = trick
    estimator, poses = followed(motion, [camera], delay)
    assert not silently_wrong(poses, motion)
    settled = [p for p in poses if p.stamp > START + 1.5]
    assert estimator.health.left_out == {camera}
    assert max(error(p, motion) for p in settled) < 0.3
    assert np.median(radius(np.stack([p.covariance[3:, 3:] for p in settled]), 0.95)) < 1.0
    assert {p.state for p in settled} == {TrackState.DEGRADED}


@pytest.mark.parametrize("motion", [breathing, *slowly(still, along(0), along(1), along(2), sway)])
def test_cameras_in_time_are_never_doubted(motion: Motion) -> None:
    estimator, poses = followed(motion, (), frozen)
    assert {p.state for p in poses} == {TrackState.TRACKING} and not any(p.reason for p in poses)
    assert not estimator.health.bumps.unequal_motion.outliers and not estimator.health.rivals.untrusted


def test_two_that_hang_while_nothing_moves_are_not_told_from_a_surface_at_rest() -> None:
    _, poses = followed(still, (1, 2), frozen)
    assert {p.state for p in poses} == {TrackState.TRACKING}


@pytest.mark.slow  # of the two that hang, which the first test here knows by other motions
def test_a_motion_along_the_axis_of_the_one_that_does_not_hang_is_doubted_late() -> None:
    """It shows in a change of size only: 2.8 mm of 400 are 0.3 px of a patch that is 100 px wide."""
    motion = along(0)
    _, poses = followed(motion, (1, 2), frozen)
    trusted = [p for p in poses if p.state is TrackState.TRACKING]
    assert max(error(p, motion) for p in trusted) < 3.0


def test_a_camera_at_half_the_rate_is_not_doubted() -> None:
    estimator = begun(sway)
    for number in range(1, 90):
        stamp = number / 30
        pose = step(estimator, look(sway, stamp, 1, cameras=(0, 1, 2) if number % 2 else (0, 1)))
        assert "trusted" not in pose.reason and "motion" not in pose.reason


def test_a_bumped_camera_is_told_from_two_that_hang_by_the_motion_until_then() -> None:
    cameras = list(RIG.cameras)
    cameras[0] = replace(cameras[0], base_from_camera=cameras[0].base_from_camera @ se3.exp([0, 0, 0, 4.0, 3.0, 0]))
    rig, estimator, draw, poses = Rig(tuple(cameras)), begun(breathing), np.random.default_rng(2), []
    for number in range(1, 105):
        stamp = number / 30
        seen = observations(rig if stamp >= START else RIG, LANDMARKS, breathing(stamp), stamp, draw, 0.3)
        poses.append(step(estimator, seen))
    after = [p for p in poses if p.stamp >= START]
    assert all(p.state is TrackState.DEGRADED and "stands" in p.reason for p in after)
    assert max(error(p, breathing) for p in after) < 0.2 and not silently_wrong(after, breathing)
    assert np.median(radius(np.stack([p.covariance[3:, 3:] for p in after]), 0.95)) < 0.5


def test_all_cameras_that_lose_most_of_the_surface_at_a_jump_are_no_rivals_of_nobody() -> None:
    estimator = begun(breathing)
    for number in range(1, 60):
        step(estimator, look(breathing, number / 30, 1))
    for number in range(60, 75):
        few = look(lambda t: breathing(t) @ se3.make(np.eye(3), [20.0, 0, 0]), number / 30, 1)
        pose = step(estimator, few.select(few.track % 5 == 0))
        assert not (pose.state is TrackState.TRACKING and error(pose, breathing) < 1.0)


# -- the watch itself


def rival(carried: Array, own: Array, cameras: Sequence[int] = (0,), carriers: Sequence[int] = (1, 2)) -> RivalPose:
    return RivalPose(frozenset(cameras), frozenset(carriers), carried, own, (0.02, 0.02), np.zeros(0, bool))


def watched(carried: Motion, own: Motion, seconds: float = 1.5, **who: Sequence[int]) -> RivalWatch:
    """A watch for which both agree until one second, and part then."""
    watch, anchors = RivalWatch(LANDMARKS[:5]), np.arange(round((1 + seconds) * 30)) / 30
    for stamp in anchors.tolist():
        parted = [rival(carried(stamp), own(stamp), **who)] if stamp >= 1 else []
        out = frozenset(who.get("cameras", (0,))) if parted else frozenset[int]()
        watch.update(RIG, stamp, own(stamp), parted, out)
    return watch


def late_from_one(motion: Motion, lag: float) -> Motion:
    return lambda t: motion(t - lag * (t >= 1))


def test_whoever_trails_the_other_is_the_one_that_is_late() -> None:
    behind, ahead = watched(late_from_one(sway, 0.1), sway), watched(sway, late_from_one(sway, 0.1))
    assert behind.messages(NAMES) == [
        f"{NAMES[1]}, {NAMES[2]} late by 0.10 s against {NAMES[0]}: no majority can be trusted"
    ]
    assert not ahead.untrusted and ahead.fault_text(0) == "shows what the others showed 0.10 s before"


def test_the_claim_covers_what_both_sides_see() -> None:
    watch = watched(lambda t: sway(min(t, 1.0)), sway)
    apart = se3.log(se3.inverse(sway(1.0)) @ sway(2.5 - 1 / 30))
    assert np.allclose(watch.covariance, np.outer(apart, apart), atol=1e-6)


def test_two_are_not_believed_less_for_a_constant_offset() -> None:
    bump = se3.exp([0, 0, 0, 1.5, -2.0, 0.5])
    assert not watched(sway, lambda t: sway(t) @ bump if t >= 1 else sway(t)).untrusted


def test_one_is_never_believed_against_two_that_agree() -> None:
    watch = watched(sway, lambda t: sway(min(t, 1.0)), cameras=(1, 2), carriers=(0,))
    assert watch.messages(NAMES) == [
        f"no motion in {NAMES[1]}, {NAMES[2]} while {NAMES[0]} moved: no majority can be trusted"
    ]


def test_a_rival_out_of_sight_stays_one_while_it_is_left_out() -> None:
    watch = watched(lambda t: sway(min(t, 1.0)), sway)
    for stamp in (2.6, 3.6, 4.6):
        watch.update(RIG, stamp, sway(1.0), [], frozenset([0]))
        assert watch.untrusted
    watch.update(RIG, 5.7, sway(1.0), [], frozenset())
    assert not watch.untrusted
