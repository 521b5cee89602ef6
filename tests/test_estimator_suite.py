"""The estimator on synthetic worlds: movements times conditions, judged by the bound, its own claim and its states.

An error is compared with the Cramer-Rao bound of the tracks that there were, a claim with the errors (NEES), and the
states with what was done to the cameras. Of a follower the map is honest, and of axes each limit that is broken counts.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cache
from typing import Any

import numpy as np
import pytest

from estimation import se3
from estimation.errors import InputError
from estimation.mapping.triangulation import triangulated_map
from estimation.observations import Observations
from estimation.online import fit
from estimation.online.surface_state import StateSettings
from estimation.pose import SurfacePose, TrackState
from estimation.synthetic.follow import Follower, FollowResult, Mapping, first_map, follow
from estimation.synthetic.world import World, synthetic_world
from planning.command import MotionLimits
from tests.campaigns.estimator import nees, pool_errors
from tests.fault_run import AXES_LIMITS, AxesOracle
from tests.slow_cases import slowly

TRACKING, DEGRADED, COASTING, LOST = (TrackState.TRACKING, TrackState.DEGRADED, TrackState.COASTING, TrackState.LOST)
MOVEMENTS = ("still", "breathing", "shaker", "steps", "turns", "sway", "lively")
FEW = ("breathing", "lively")  # that are always tried with everything: to and fro, at random
REST = tuple(name for name in MOVEMENTS if name not in FEW)
COUNT, SECONDS = 60, 2.0


@dataclass(frozen=True, slots=True)
class Case:
    """What is done, how far beyond the bound the error may be for it, and the states it is to lead to."""

    conditions: dict[str, Any] = field(default_factory=dict)
    beyond: float = 1.8  # the first pose's own error is one draw in all of a run's
    states: tuple[TrackState, ...] = (TRACKING,)


CASES = {
    "clean": Case(),
    "noise": Case({"noise": 1.0}),
    "dropouts": Case({"dropouts": 0.3}),
    "outage": Case({"outages": ((0.8, 1.1),)}, states=(TRACKING, COASTING, DEGRADED, TRACKING)),
    "outage of a camera": Case({"outages": ((0.8, 1.3, 1),)}, states=(TRACKING, DEGRADED, TRACKING)),
    "outage of two cameras": Case({"outages": ((0.8, 1.3, 1), (0.8, 1.3, 2))}, states=(TRACKING, DEGRADED, TRACKING)),
    "outliers": Case({"outliers": 0.2}, beyond=2.0),  # a fifth of the tracks is worth nothing, and some stand near
    "churn": Case({"churn": 1.0}),
    "restart": Case({"outages": ((0.6, 1.5),)}, states=(TRACKING, COASTING, LOST, DEGRADED, TRACKING)),
}


def world(movement: str, seed: int = 1, seconds: float = SECONDS, **conditions: Any) -> World:
    return synthetic_world(movement, seconds, count=COUNT, seed=seed, **conditions)


@cache
def followed(movement: str, case: str) -> FollowResult:
    return follow(world(movement, **CASES[case].conditions))


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("movement", [*FEW, *slowly(*REST)])
def test_errors_are_near_the_bound_and_states_say_what_was_done(movement: str, case: str) -> None:
    near_the_bound(movement, case)


@pytest.mark.slow
@pytest.mark.parametrize("case", ["clean", "churn", "restart"])
def test_at_rest_errors_are_near_the_bound_too(case: str) -> None:
    near_the_bound("still", case)


def near_the_bound(movement: str, case: str) -> None:
    run, found = followed(movement, case), pool_errors([followed(movement, case)])
    assert run.states == CASES[case].states and found.error_mm < CASES[case].beyond * found.bound_mm
    assert found.error_deg < CASES[case].beyond * found.bound_deg


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("movements", [FEW, *slowly(MOVEMENTS)], ids=len)
def test_the_claim_is_as_wide_as_the_errors(case: str, movements: tuple[str, ...]) -> None:
    found = pool_errors([followed(movement, case) for movement in movements])
    assert 0.35 < found.nees < 1.4 and found.inside > 0.87 and found.twist_nees < 10.0
    # a step has no twist that a motion without steps could claim (docs/estimator.md)
    assert pool_errors([followed(each, case) for each in movements if each != "steps"]).twist_nees < 2.5


@pytest.mark.slow
@pytest.mark.parametrize("movement", ["still", "lively", *slowly("breathing", "sway", "turns")])
def test_a_twist_is_as_uncertain_as_it_claims(movement: str) -> None:
    run = follow(world(movement, seconds=6.0))
    settled = run.measured & (np.arange(len(run.poses)) > 60)
    reported = nees(run.twist_errors, run.twist_covariances)[settled].mean() / 6
    assert 0.7 < reported < 1.4


def test_coasting_poses_are_where_they_claim_to_be() -> None:
    values = []
    for movement in FEW:
        run = followed(movement, "outage")
        away = ~run.measured
        assert away.sum() == 9
        values.append(nees(run.errors[away], run.covariances[away]).mean() / 6)
    assert np.mean(values) < 2.0


@pytest.mark.parametrize("movement", [*FEW, *slowly(*REST)])
def test_the_first_pose_after_a_loss_is_as_good_as_any(movement: str) -> None:
    run = followed(movement, "restart")
    back = int(np.flatnonzero(~run.measured)[-1]) + 1
    bound, error = np.linalg.inv(run.informations[back]), run.errors[back]
    assert error @ np.linalg.solve(2 * bound, error) < 25.0  # of chi-square 6, one in 3,000 is beyond


OFFSETS = (0.0, 0.016, -0.016)


@pytest.mark.parametrize("movement", ["lively", *slowly("breathing", "sway")])
def test_cameras_out_of_step_cost_no_more_than_is_claimed(movement: str) -> None:
    run = follow(world(movement, offsets=OFFSETS))
    found = pool_errors([run])
    assert run.states == (TRACKING,) and found.nees < 2.0 and found.error_mm < 0.25


@pytest.mark.parametrize("movement", ["breathing", *slowly("still", "turns")])
def test_a_condition_that_the_model_lacks_does_not_blow_the_error_up(movement: str) -> None:
    for conditions, limit in (({"coherent": 0.3}, 0.1), ({"correlated": 0.6}, 0.15), ({"map_error": 0.2}, 0.15)):
        found = pool_errors([follow(world(movement, seconds=1.5, **conditions))])
        assert found.measured == 1.0 and found.error_mm < limit


OWN_MAP: dict[str, tuple[str, dict[str, Any], float]] = {
    "clean": ("breathing", {}, 2.5),
    "outliers": ("sway", {"outliers": 0.1}, 3.5),  # they cost the map landmarks as well
    "dropouts": ("breathing", {"dropouts": 0.2}, 2.5),
    "offsets and lens": ("breathing", {"offsets": OFFSETS, "calibration": 0.3}, 10.0),
}


@pytest.mark.parametrize("case", ["clean", "offsets and lens", *slowly("outliers", "dropouts")])
def test_a_map_made_from_the_same_tracks_serves(case: str) -> None:
    """Twice the bound and not once: the frame is that of the first pose, and the map has errors of its own."""
    movement, conditions, beyond = OWN_MAP[case]
    run = follow(world(movement, **conditions), "seen")
    found = pool_errors([run])
    assert run.states[-1] is TRACKING and found.measured == 1.0 and found.error_mm < beyond * found.bound_mm
    assert 0.2 < found.nees < 3.0


def test_a_surface_that_comes_back_is_found_where_it_was() -> None:
    poses = follow(world("shaker", seconds=4.1)).poses  # two periods
    for k in (5, 20, 45):
        back = se3.log(se3.inverse(poses[k].base_from_surface) @ poses[k + 60].base_from_surface)
        assert np.linalg.norm(back[3:]) < 0.08 and np.linalg.norm(back[:3]) < 5e-3


def test_a_part_that_comes_into_view_moves_nothing() -> None:
    found = pool_errors([follow(world("breathing", reveal=(0.8, 1.6)))])
    assert found.error_mm < 1.8 * found.bound_mm and found.nees < 1.4


@pytest.mark.slow
@pytest.mark.parametrize("instants", [{"offsets": OFFSETS}, *slowly({"jitter": 0.005})])
def test_cameras_out_of_step_are_followed_better_than_by_their_plain_mean(
    monkeypatch: pytest.MonkeyPatch, instants: dict[str, Any]
) -> None:
    """Pose and twist, beside the same estimator that leaves each frame set's delays in its pose."""
    apart = world("breathing", seconds=4.0, **instants)
    ours = follow(apart)
    monkeypatch.setattr(fit, "delay_gain", lambda solution, shared, twist_variance: np.zeros((3, 9)))
    plain = follow(apart)
    pose, twist = (
        float(np.sqrt((a[:, 3:] ** 2).sum() / (b[:, 3:] ** 2).sum()))
        for a, b in ((ours.errors, plain.errors), (ours.twist_errors, plain.twist_errors))
    )
    assert (pose if "offsets" in instants else twist) < 0.95 and max(pose, twist) < 1.03


@pytest.mark.parametrize("mapping", ["seen", *slowly("told")])
def test_two_runs_give_the_same_bits(mapping: Mapping) -> None:
    conditions: dict[str, Any] = dict(offsets=OFFSETS, outliers=0.1, dropouts=0.1, outages=((0.5, 0.7),))
    first, second = (follow(world("sway", seconds=1.2, **conditions), mapping).poses for _ in range(2))
    for a, b in zip(first, second, strict=True):
        assert a.base_from_surface.tobytes() == b.base_from_surface.tobytes()
        assert a.covariance.tobytes() == b.covariance.tobytes() and a.twist.tobytes() == b.twist.tobytes()
        assert (a.state, a.reason) == (b.state, b.reason)


def test_nothing_is_learned_from_what_comes_later() -> None:
    """The poses up to an instant are the same whatever follows it."""
    whole = follow(world("breathing", seconds=1.5, outages=((1.0, 1.2),))).poses
    plain = follow(world("breathing", seconds=1.5)).poses
    for a, b in list(zip(whole, plain, strict=True))[:24]:
        assert a.base_from_surface.tobytes() == b.base_from_surface.tobytes()


def test_one_camera_does_not_confirm_a_first_map() -> None:
    made = world("still", seconds=0.5, outages=((0.1, 0.3, 1), (0.1, 0.3, 2)))
    seen = list(made)
    follower = Follower(made.rig, seen[0], first_map(made, seen[0], "told"), refine=False)
    poses: list[SurfacePose] = [follower(s) for s in seen[4:]]
    states = [pose.state for pose in poses]
    assert states[:3] == [TrackState.INITIALISING] * 3 and states[-1] is TRACKING and all(p.reason for p in poses[:3])


def test_late_exposures_of_a_fast_surface_are_claimed_and_leave_the_prior_no_say() -> None:
    fast = world("lively", seconds=6.0, rate=6.0, jitter=0.01)
    seen = fast.observations()
    first = next(seen)
    follower = Follower(fast.rig, first, first_map(fast, first, "told"), refine=False)
    estimator, pulled, smeared = follower.estimator, [], []
    for observations in map(follower.of_map, seen):
        fit = estimator.fit(observations, estimator.predict(observations.stamp))
        pose = estimator.accept(fit, observations)
        off = se3.log(se3.inverse(fit.solution.base_from_surface) @ pose.base_from_surface)
        pulled.append(float(off[3:] @ off[3:]))
        smeared.append(float(np.trace(fit.parts.smear[3:, 3:])))
        assert np.trace(pose.covariance[3:, 3:]) > smeared[-1]
    assert np.mean(pulled) < 0.01 * np.mean(smeared) and np.mean(smeared) > 0.05**2


def test_a_first_map_is_hasty_only_until_a_pose_is_given_out_and_only_of_what_is_fast() -> None:
    for speed, hasty in ((10.0, False), (200.0, True)):
        calm = world("still")
        seen = calm.observations()
        first = next(seen)
        follower = Follower(calm.rig, first, first_map(calm, first, "told"), refine=False)
        follower(next(seen))
        estimator = follower.estimator
        estimator.set_twist(np.array([0, 0, 0, speed, 0, 0]))
        later = follower.of_map(next(seen))
        fit = replace(estimator.fit(later, estimator.predict(later.stamp)), twist=np.array([0, 0, 0, speed, 0, 0]))
        assert estimator.too_fast_for_map(fit) is hasty
        for observations in seen:
            follower(observations)
        assert not estimator.too_fast_for_map(fit)


def first(world: World) -> Observations:
    return next(iter(world))


def test_a_triangulated_map_is_as_far_off_as_its_covariance_says() -> None:
    values = []
    for seed in range(12):
        world = synthetic_world("still", seconds=0.05, noise=0.3, seed=seed)
        made = triangulated_map(world.rig, first(world))
        true_from_map = se3.inverse(world.truth.base_from_surface[0]) @ made.base_from_surface
        points = se3.transform_points(true_from_map, made.map.points)
        off = (points - world.landmarks.points[made.tracks]) @ true_from_map[:3, :3]
        blocks = made.map.covariance.reshape(len(points), 3, len(points), 3)
        own = np.stack([blocks[i, :, i] for i in range(len(points))])
        values.append(np.einsum("ni,nij,nj->n", off, np.linalg.inv(own), off).mean() / 3)
        assert made.map.normals[:, 2].min() > 0
    assert np.mean(values) == pytest.approx(1.0, abs=0.08)


def test_landmarks_of_one_camera_and_wrong_matches_are_not_in_the_map() -> None:
    world = synthetic_world("still", seconds=0.05, outliers=0.1, views=2, seed=3)
    seen = first(world)
    alone = np.bincount(seen.track, minlength=100) < 2
    made = triangulated_map(world.rig, seen)
    assert not alone[made.tracks].any() and 50 < len(made.tracks) < 95
    true_from_map = se3.inverse(world.truth.base_from_surface[0]) @ made.base_from_surface
    off = se3.transform_points(true_from_map, made.map.points) - world.landmarks.points[made.tracks]
    assert np.median(np.linalg.norm(off, axis=1)) < 0.3


@pytest.mark.parametrize("shared", [0, 2])
def test_landmarks_that_no_two_cameras_see_make_no_map_and_that_is_said(shared: int) -> None:
    world = synthetic_world("still", seconds=0.05, seed=3)
    seen = first(world)
    mine = (seen.camera == 0) | (seen.track < shared)
    alone = replace(
        seen, camera=seen.camera[mine], track=seen.track[mine], pixels=seen.pixels[mine], sigma=seen.sigma[mine]
    )
    with pytest.raises(InputError, match=f"landmarks = {shared}, allowed 3 or more that two cameras see alike"):
        triangulated_map(world.rig, alone)


def test_errors_are_of_the_estimated_frame_and_nothing_is_fitted() -> None:
    world = synthetic_world("breathing", seconds=0.5, noise=0.02)
    for mapping in ("told", "seen"):
        run = follow(world, mapping)
        after_the_first = len(world) - 1 - StateSettings().averaged_poses
        assert len(run.poses) == after_the_first == len(run.expected) == len(run.seconds)
        assert np.abs(run.errors[:, 3:]).max() < 0.01 and np.abs(run.twist_errors[3:, 3:]).max() < 4.0


def test_observations_are_numbered_by_the_map() -> None:
    world = synthetic_world("still", seconds=0.1, count=40, views=2)
    seen = first(world)
    start = first_map(world, seen, "seen")
    follower = Follower(world.rig, seen, start, refine=True)
    of_map = follower.of_map(seen)
    assert set(start.tracks[of_map.track]) == set(seen.track) & set(start.tracks)
    for camera, row, pixel in zip(of_map.camera, of_map.track, of_map.pixels, strict=True):
        where = (seen.camera == camera) & (seen.track == start.tracks[row])
        assert np.array_equal(seen.pixels[where][0], pixel)


def test_pooled_figures_are_those_of_all_poses_together() -> None:
    runs = [follow(synthetic_world("breathing", seconds=0.6, count=40, seed=seed)) for seed in range(2)]
    one, two, both = pool_errors(runs[:1]), pool_errors(runs[1:]), pool_errors(runs)
    assert both.error_mm**2 == pytest.approx((one.error_mm**2 + two.error_mm**2) / 2)
    assert both.bound_mm**2 == pytest.approx((one.bound_mm**2 + two.bound_mm**2) / 2)
    assert both.nees == pytest.approx((one.nees + two.nees) / 2)
    assert 0.5 < both.error_mm / both.bound_mm < 1.5 and both.measured == 1.0


@pytest.mark.slow
@pytest.mark.parametrize("mapping", ["seen", *slowly("told")])
def test_the_bound_of_an_estimated_frame_holds_the_error_of_the_look_that_laid_it(mapping: Mapping) -> None:
    """Over many starts, since that error is one draw for a whole run."""
    worlds = [synthetic_world("still", seconds=0.3, count=40, seed=seed) for seed in range(16)]
    runs = [follow(world, mapping) for world in worlds]
    found = pool_errors(runs)
    assert 0.85 < found.error_mm / found.bound_mm < 1.3
    assert found.filtered_mm <= found.bound_mm and found.filtered_deg <= found.bound_deg
    assert all(np.isfinite(run.bounds).all() for run in runs)


def test_where_nothing_is_seen_nothing_is_known() -> None:
    run = follow(synthetic_world("still", seconds=0.5, outages=((0.2, 0.3),)))
    assert np.array_equal(np.isinf(run.bounds).all(axis=(1, 2)), ~run.measured)
    assert np.isfinite(run.filtered_bounds()).all()


@pytest.mark.parametrize("mapping", ["told", "seen"])
def test_a_world_too_short_to_be_judged_says_so(mapping: Mapping) -> None:
    with pytest.raises(InputError, match="length = '6 frame sets', allowed 7 or more"):
        follow(synthetic_world(seconds=6 / 30), mapping)
    judged = follow(synthetic_world(seconds=7 / 30), mapping)
    assert len(judged.poses) == 2 and judged.filtered_bounds().shape == (2, 6, 6)


TICK = 0.02
WIDE = np.full(6, 1e9)


@pytest.mark.parametrize("kind", AXES_LIMITS)
@pytest.mark.parametrize(("share", "over"), [(1.0, 0), (1.002, 1), (np.nan, 1)])
def test_a_sample_a_hair_over_a_limit_counts_and_one_at_it_does_not(kind: str, share: float, over: int) -> None:
    limits = MotionLimits(WIDE, WIDE, WIDE, 1e9, 1e9)
    step = np.array([0.0, 0, 0, 0, 0.01, 0]) if kind == "turn" else np.array([0.0, 0.01, 0, 0, 0, 0])
    size = 0.01 * share
    bound = {"speed": size / TICK, "acceleration": size / TICK**2, "jerk": size / TICK**3, "jump": size, "turn": size}
    one = 0.01 / size * bound[kind]  # the limit that a step of 0.01 meets
    value = one / share if kind in ("jump", "turn") else np.full(6, one / share)
    named = {f: getattr(limits, f) for f in ("speed", "acceleration", "jerk", "jump", "turn")}
    if np.isnan(share):
        step = step * np.nan
        value = named[kind]
    judge = AxesOracle(np.zeros(6), MotionLimits(**{**named, kind: value}), TICK)
    judge(step)
    assert judge.violations[AXES_LIMITS.index(kind)] == over and judge.samples == 1


def test_rest_after_a_stall_is_no_braking() -> None:
    limits = MotionLimits()
    judge = AxesOracle(np.zeros(6), limits, TICK)
    for k in range(1, 20):
        judge(np.array([1.0 * k, 0, 0, 0, 0, 0]))  # 50 mm/s
    fine = judge.violations.copy()
    judge(None)
    assert (judge.violations > fine).any()  # it stood from one tick to the next
    judge.rest()
    now = judge.violations.copy()
    judge(None)
    assert np.array_equal(judge.violations, now)
