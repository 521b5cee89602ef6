"""The estimator: states that mean what they say, a covariance as wide as the errors, cameras out of step."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from estimation import se3
from estimation.observations import Observations, no_observations
from estimation.online.estimator import Estimator
from estimation.online.surface_state import EstimatorSettings, StateSettings
from estimation.pose import SurfacePose, TrackState, identity_pose
from estimation.se3 import Array
from estimation.surface_map import SurfaceMap
from estimation.synthetic.world import BASE_FROM_REST, arc_rig, observations, patch
from tests.rendered_sets import Motion, breathing
from tests.slow_cases import slowly
from tests.test_smoother import broken

RIG = arc_rig()
LANDMARKS = patch(60, np.random.default_rng(3)).points
RATE = 30.0


def lively(stamp: float) -> Array:
    """About 40 mm/s: fast enough for capture instants to show."""
    w = 0.1 * np.sin(stamp * np.array([2.1, 2.7, 1.8]) + [0, 1, 2])
    return BASE_FROM_REST @ se3.make(se3.exp_rotation(w), 12.0 * np.sin(stamp * np.array([3.1, 2.6, 3.7]) + [2, 0, 1]))


def joined(stamp: float, parts: Sequence[Observations]) -> Observations:
    """The observations of several cameras as those of one frame set."""
    names = ("camera", "track", "pixels", "sigma")
    return Observations(stamp, *(np.concatenate([getattr(part, name) for part in parts]) for name in names))


def look(
    motion: Motion,
    stamp: float,
    seed: int,
    keep: int | None = None,
    cameras: Sequence[int] = (0, 1, 2),
    delays: Sequence[float] = (0, 0, 0),
    outliers: float = 0.0,
) -> Observations:
    """What `cameras` see, each `delays` s late; keep: so many tracks of each, all by default."""
    parts = []
    for c in cameras:
        only = np.zeros((len(RIG), len(LANDMARKS)), bool)
        only[c, :keep] = True
        draw = np.random.default_rng([seed, c, round(1000 * stamp)])
        parts.append(observations(RIG, LANDMARKS, motion(stamp + delays[c]), stamp, draw, 0.3, outliers, only))
    return joined(stamp, parts) if parts else no_observations(stamp)


FIRST = EstimatorSettings(states=StateSettings(averaged_poses=1))


def begun(motion: Motion, map_error: float = 0.0, seed: int = 0, settings: EstimatorSettings = FIRST) -> Estimator:
    """An estimator with a map whose landmarks are `map_error` mm off, one standard deviation an axis."""
    estimator = Estimator(RIG, settings)
    points = LANDMARKS + map_error * np.random.default_rng([seed, 9]).normal(size=LANDMARKS.shape)
    normals = np.tile([0.0, 0.0, 1.0], (len(points), 1))
    covariance = map_error**2 * np.eye(3 * len(points))
    estimator.begin(0.0, motion(0.0), SurfaceMap(points, normals, covariance))
    return estimator


def step(estimator: Estimator, seen: Observations) -> SurfacePose:
    """One frame set, as the tracker does it: fit from the prediction, take it or coast."""
    fit = estimator.fit(seen, estimator.predict(seen.stamp))
    return estimator.accept(fit, seen) if fit.measured else estimator.coast(fit)


def stamps(seconds: float, first: float = 1 / RATE) -> Array:
    return first + np.arange(round(seconds * RATE)) / RATE


def follow(
    estimator: Estimator, motion: Motion, seconds: float, seed: int = 1, first: float = 1 / RATE
) -> list[SurfacePose]:
    return [step(estimator, look(motion, float(t), seed)) for t in stamps(seconds, first)]


def error(pose: SurfacePose, motion: Motion) -> float:
    return float(np.linalg.norm(pose.base_from_surface[:3, 3] - motion(pose.stamp)[:3, 3]))


def test_before_a_map_there_is_no_certainty() -> None:
    pose = identity_pose(1.5, "waiting")
    assert (pose.stamp, pose.state, pose.reason) == (1.5, TrackState.INITIALISING, "waiting")
    assert np.sqrt(np.linalg.eigvalsh(pose.covariance)[-1]) >= 1000
    assert Estimator(RIG).pose is None and Estimator(RIG).sigma() == np.inf


def test_the_first_map_is_not_a_measurement_yet() -> None:
    estimator = begun(breathing)
    assert estimator.pose is not None and estimator.pose.state is TrackState.INITIALISING and estimator.pose.reason
    waited = estimator.hold(0.2, "nothing seen")
    assert (waited.state, waited.reason, waited.stamp) == (TrackState.INITIALISING, "nothing seen", 0.2)
    assert np.array_equal(waited.base_from_surface, breathing(0.0))


def dragged(seen: Observations, seed: int) -> Observations:
    """The tracks as they are when something that slides over the surface drags them along, some farther."""
    rng = np.random.default_rng([seed, 77])
    return replace(seen, pixels=seen.pixels + np.array([12.0, 8.0]) + rng.uniform(-4, 4, size=seen.pixels.shape))


@pytest.mark.parametrize("seed", [0, *slowly(1, 2)])
def test_the_last_tracks_that_a_hand_drags_along_do_not_throw_the_pose(seed: int) -> None:
    estimator, covered = begun(breathing), begun(breathing)
    for either in (estimator, covered):
        follow(either, breathing, 2.0, seed)
    first, *later = stamps(0.2, 2.0 + 1 / RATE)
    thrown = step(estimator, dragged(look(breathing, float(first), seed, 14, (2,)), seed))
    assert thrown.state is TrackState.COASTING and "few tracks" in thrown.reason
    for t in later:
        thrown, still = (step(one, look(breathing, float(t), seed, cameras=())) for one in (estimator, covered))
        assert np.allclose(thrown.base_from_surface, still.base_from_surface, atol=1e-9)
        assert np.allclose(thrown.covariance, still.covariance, atol=1e-9)


def test_a_lost_surface_is_not_found_in_few_tracks_that_disagree() -> None:
    estimator = begun(breathing)
    follow(estimator, breathing, 2.0)
    for t in stamps(0.7, 2.0 + 1 / RATE):
        step(estimator, look(breathing, float(t), 1, cameras=()))
    pose = step(estimator, dragged(look(breathing, 2.8, 1, 14, (2,)), 1))
    assert pose.state is TrackState.LOST and "each other" in pose.reason
    assert step(estimator, look(breathing, 2.9, 1, 14, (2,))).state is TrackState.DEGRADED
    assert step(estimator, look(breathing, 3.0, 1)).state.measured


def test_a_clear_view_is_tracking_without_a_reason() -> None:
    poses = follow(begun(breathing), breathing, 1.0)
    assert all(p.state is TrackState.TRACKING and p.reason == "" for p in poses)
    assert max(error(p, breathing) for p in poses) < 0.15


def test_a_window_that_is_rebuilt_is_told_for_as_long_as_a_fault_is() -> None:
    estimator = begun(breathing)
    follow(estimator, breathing, 1.0)
    broken(estimator._smoother)
    told, after, *_, later = follow(estimator, breathing, 0.3, first=1.0 + 1 / RATE)
    assert told.state is TrackState.DEGRADED and told.reason == "the window of poses failed and was rebuilt, 1 so far"
    assert after.state is TrackState.DEGRADED and "seen well again" in after.reason
    assert later.state is TrackState.TRACKING and error(told, breathing) < 0.15


def test_no_state_but_tracking_is_without_a_reason() -> None:
    estimator, draw = begun(breathing), np.random.default_rng(4)
    seen_states = set()
    for i, t in enumerate(stamps(7.0)):
        kind = draw.integers(0, 6) if i // 30 % 2 else 5
        cameras = [(), (0,), (0, 1), (0, 1, 2), (2,), (0, 1, 2)][kind]
        if 150 <= i < 180:
            cameras = ()
        pose = step(estimator, look(breathing, float(t), 2, keep=[60, 60, 30, 9, 8, 60][kind], cameras=cameras))
        seen_states.add(pose.state)
        assert (pose.reason == "") == (pose.state is TrackState.TRACKING)
        assert np.isfinite(pose.base_from_surface).all() and np.isfinite(pose.covariance).all()
    assert seen_states == set(TrackState) - {TrackState.INITIALISING}


def test_one_camera_alone_is_degraded_and_says_so() -> None:
    estimator = begun(breathing)
    follow(estimator, breathing, 0.5)
    for t in stamps(0.5, 0.55):
        pose = step(estimator, look(breathing, float(t), 3, cameras=(1,)))
        assert pose.state is TrackState.DEGRADED and "one camera" in pose.reason and error(pose, breathing) < 2.0
    after = [step(estimator, look(breathing, t, 3)).state for t in (1.1, 1.1 + 1 / RATE, 1.1 + 2 / RATE)]
    assert after[-1] is TrackState.TRACKING


def test_the_first_poses_are_averaged_before_one_is_given_out() -> None:
    poses = follow(begun(breathing, settings=EstimatorSettings()), breathing, 0.3)
    first = StateSettings().averaged_poses
    assert [p.state for p in poses[: first - 1]] == [TrackState.INITIALISING] * (first - 1)
    assert all(f"of {first}" in p.reason for p in poses[: first - 1])
    assert all(p.state is TrackState.TRACKING for p in poses[first - 1 :])


def test_two_cameras_are_enough() -> None:
    estimator = begun(breathing)
    poses = [step(estimator, look(breathing, float(t), 3, cameras=(0, 2))) for t in stamps(0.5)]
    assert all(p.state is TrackState.TRACKING for p in poses)


def test_few_tracks_degrade_and_the_way_back_asks_for_more_than_the_way_out() -> None:
    def after(keep: int, start: int) -> TrackState:
        estimator = begun(breathing)
        step(estimator, look(breathing, 1 / RATE, 3, keep=start))
        return [step(estimator, look(breathing, k / RATE, 3, keep=keep)).state for k in (2, 3, 4)][-1]

    assert after(keep=8, start=12) is TrackState.TRACKING  # 24 tracks: enough to stay
    assert after(keep=8, start=8) is TrackState.DEGRADED  # not enough to enter
    assert after(keep=11, start=8) is TrackState.TRACKING and after(keep=6, start=12) is TrackState.DEGRADED


def test_the_state_does_not_flicker_between_its_thresholds() -> None:
    estimator = begun(breathing)
    for t in stamps(0.5):
        step(estimator, look(breathing, float(t), 3, keep=12))
    draw = np.random.default_rng(8)
    seen = [look(breathing, float(t), 3, keep=int(draw.integers(8, 13))) for t in stamps(2.0, 0.55)]
    states = [step(estimator, each).state for each in seen]
    assert set(states) == {TrackState.TRACKING}


def test_too_few_tracks_are_no_measurement() -> None:
    estimator = begun(breathing)
    fit = estimator.fit(look(breathing, 0.1, 3, keep=3), breathing(0.1))
    assert not fit.measured and "9 tracks" in fit.reason
    few = estimator.fit(look(breathing, 0.1, 3, keep=5), breathing(0.1))  # of 60: such a share agrees by chance
    assert not few.measured and "landmarks" in few.reason
    assert estimator.fit(look(breathing, 0.1, 3, keep=6), breathing(0.1)).measured


@pytest.mark.parametrize("outliers", [*(pytest.param(o, marks=pytest.mark.slow) for o in (0.3, 0.7)), 1.0])
def test_tracks_that_scatter_widen_the_claim_to_what_they_cost(outliers: float) -> None:
    values = []
    for seed in range(12):
        estimator = begun(breathing)
        follow(estimator, breathing, 0.2)
        pose = step(estimator, look(breathing, 0.25, seed, outliers=outliers))
        e = se3.log(se3.inverse(pose.base_from_surface) @ breathing(pose.stamp))
        values.append(e @ np.linalg.solve(pose.covariance, e) / 6)
    assert np.mean(values) < 1.5


def test_a_pose_too_uncertain_is_no_measurement() -> None:
    sure, unsure = begun(breathing), begun(breathing, settings=EstimatorSettings(max_sigma=1e-3))
    seen = look(breathing, 0.1, 3)
    assert sure.fit(seen, breathing(0.1)).measured
    fit = unsure.fit(seen, breathing(0.1))
    assert not fit.measured and "uncertain" in fit.reason and len(unsure.carrying_cameras(fit)) == 0


def test_an_outage_coasts_then_is_lost_and_then_found() -> None:
    estimator = begun(breathing)
    last = follow(estimator, breathing, 2.0)[-1]
    dark = [step(estimator, look(breathing, float(t), 4, cameras=())) for t in stamps(1.0, last.stamp + 1 / RATE)]
    for p in dark:
        gone = p.stamp - last.stamp
        assert p.state is (TrackState.LOST if gone > estimator.settings.states.coast else TrackState.COASTING)
        assert f"{gone:.2f} s since" in p.reason
    assert {p.state for p in dark} == {TrackState.COASTING, TrackState.LOST} and (dark[-1].twist == 0).all()
    back = follow(estimator, breathing, 0.3, 5, dark[-1].stamp + 1 / RATE)
    assert back[0].state is TrackState.DEGRADED and "seen well again" in back[0].reason
    assert {p.state for p in back[1:]} == {TrackState.TRACKING} and max(error(p, breathing) for p in back) < 0.15


@pytest.mark.parametrize("seed", [0, *slowly(1, 2)])
def test_coasting_claims_less_with_every_frame_and_enough(seed: int) -> None:
    estimator = begun(breathing)
    last = follow(estimator, breathing, 2.0 + 0.7 * seed, seed)[-1]
    sigma, inside = [estimator.sigma()], []
    for t in stamps(0.45, last.stamp + 1 / RATE):
        pose = step(estimator, look(breathing, float(t), 4, cameras=()))
        sigma.append(estimator.sigma())
        inside.append(error(pose, breathing) < 3 * sigma[-1])
    assert (np.diff(sigma) > 0).all() and all(inside)


@pytest.mark.parametrize("map_error", [*(pytest.param(e, marks=pytest.mark.slow) for e in (0.0, 0.1)), 0.5])
def test_the_covariance_is_as_wide_as_the_errors(map_error: float) -> None:
    values = []
    for seed in range(4):  # each a single draw of the map
        estimator = begun(breathing, map_error, seed)
        for pose in follow(estimator, breathing, 1.5, seed)[10::5]:
            e = se3.log(se3.inverse(pose.base_from_surface) @ breathing(pose.stamp))
            values.append(e @ np.linalg.solve(pose.covariance, e) / 6)
    assert 0.15 < np.mean(values) < 1.3


def run_skewed(delays: Sequence[float], seconds: float, motion: Motion = lively) -> Estimator:
    estimator = begun(motion)
    for t in stamps(seconds):
        step(estimator, look(motion, float(t), 6, delays=delays))
    return estimator


@pytest.mark.slow
def test_offsets_widen_the_claim_to_what_they_cost() -> None:
    estimator, values, claimed = begun(lively), [], []
    for t in stamps(4.0):
        pose = step(estimator, look(lively, float(t), 6, delays=(0.016, 0.0, -0.016)))
        if t > 2.0:
            e = (se3.inverse(pose.base_from_surface) @ lively(pose.stamp))[:3, 3]
            values.append(e @ np.linalg.solve(pose.covariance[3:, 3:], e) / 3)
            claimed.append(estimator.sigma())
    assert np.mean(values) < 2.0 and np.median(claimed) > 1.2 * run_skewed((0, 0, 0), 4.0).sigma()


def test_fitting_changes_nothing() -> None:
    estimator = begun(breathing)
    follow(estimator, breathing, 0.3)
    estimator.learn()
    pose, doubt, surface_map = estimator.pose, estimator.cameras.delays.sigma, estimator.map
    estimator.fit(look(lively, 0.4, 7), estimator.predict(0.4))
    assert estimator.pose is pose and estimator.cameras.delays.sigma == doubt and estimator.map is surface_map


def test_learning_at_once_or_when_the_next_fit_needs_it_gives_the_same_poses() -> None:
    early, late = begun(lively), begun(lively)
    for t in stamps(0.5):
        seen = look(lively, float(t), 6, delays=(0.016, 0.0, -0.016))
        one, other = step(early, seen), step(late, seen)
        early.learn()
        assert one.base_from_surface.tobytes() == other.base_from_surface.tobytes()


def test_a_caveat_keeps_every_pose_from_being_called_tracking() -> None:
    estimator = Estimator(RIG)
    normals = np.tile([0.0, 0.0, 1.0], (len(LANDMARKS), 1))
    surface_map = SurfaceMap(LANDMARKS, normals, np.zeros((3 * len(LANDMARKS),) * 2))
    estimator.begin(0.0, breathing(0.0), surface_map, "the scan's place is open")
    for pose in follow(estimator, breathing, 0.3)[StateSettings().averaged_poses - 1 :]:
        assert pose.state is TrackState.DEGRADED and pose.reason == "the scan's place is open"
