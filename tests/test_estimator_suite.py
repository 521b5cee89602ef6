"""The estimator on synthetic worlds: movements times conditions, judged by the bound, its own claim and its states.

An error is compared with the Cramer-Rao bound of the tracks that there were, a claim with the errors (NEES), and the
states with what was done to the cameras.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cache
from typing import Any

import numpy as np
import pytest

from estimation import se3
from estimation.pose import SurfacePose, TrackState
from estimation.synthetic.follow import Followed, Follower, Mapping, beginning, follow
from estimation.synthetic.world import World, synthetic_world
from hardware.bench.pooled import nees, pooled
from tests.slowly import slowly

TRACKING, DEGRADED, COASTING, LOST = (
    TrackState.TRACKING,
    TrackState.DEGRADED,
    TrackState.COASTING,
    TrackState.LOST,
)
MOVEMENTS = ("still", "breathing", "shaker", "steps", "turns", "sway", "lively")
FEW = ("still", "breathing", "lively")  # that are always tried: at rest, to and fro, at random
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
def followed(movement: str, case: str) -> Followed:
    return follow(world(movement, **CASES[case].conditions))


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("movement", [*FEW, *slowly(*REST)])
def test_errors_are_near_the_bound_and_states_say_what_was_done(movement: str, case: str) -> None:
    run, found = followed(movement, case), pooled([followed(movement, case)])
    assert run.states == CASES[case].states
    assert found.error_mm < CASES[case].beyond * found.bound_mm
    assert found.error_deg < CASES[case].beyond * found.bound_deg


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("movements", [FEW, *slowly(MOVEMENTS)], ids=len)
def test_the_claim_is_as_wide_as_the_errors(case: str, movements: tuple[str, ...]) -> None:
    found = pooled([followed(movement, case) for movement in movements])
    assert 0.35 < found.nees < 1.4
    assert found.inside > 0.87
    assert found.twist_nees < 4.0


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
    bound = np.linalg.inv(run.informations[back])
    assert (
        run.errors[back] @ np.linalg.solve(2 * bound, run.errors[back]) < 25.0
    )  # of chi-square 6, one in 3,000 is beyond


OFFSETS = (0.0, 0.016, -0.016)


@pytest.mark.parametrize("movement", ["breathing", "sway", "lively"])
def test_cameras_out_of_step_cost_no_more_than_is_claimed(movement: str) -> None:
    run = follow(world(movement, offsets=OFFSETS))
    found = pooled([run])
    assert run.states == (TRACKING,)
    assert found.nees < 2.0 and found.error_mm < 0.25


@pytest.mark.parametrize("movement", ["still", "breathing", "turns"])
def test_a_condition_that_the_model_lacks_does_not_blow_the_error_up(movement: str) -> None:
    for conditions, limit in (({"coherent": 0.3}, 0.1), ({"correlated": 0.6}, 0.15), ({"map_error": 0.2}, 0.15)):
        found = pooled([follow(world(movement, seconds=1.5, **conditions))])
        assert found.measured == 1.0 and found.error_mm < limit


OWN_MAP: dict[str, tuple[str, dict[str, Any], float]] = {
    "clean": ("breathing", {}, 2.5),
    "outliers": ("sway", {"outliers": 0.1}, 3.5),  # they cost the map landmarks as well
    "dropouts": ("breathing", {"dropouts": 0.2}, 2.5),
    "offsets and lens": ("breathing", {"offsets": OFFSETS, "calibration": 0.3}, 10.0),
}


@pytest.mark.parametrize("case", OWN_MAP)
def test_a_map_made_from_the_same_tracks_serves(case: str) -> None:
    """Twice the bound and not once: the frame is that of the first pose, and the map has errors of its own."""
    movement, conditions, beyond = OWN_MAP[case]
    run = follow(world(movement, **conditions), "seen")
    found = pooled([run])
    assert run.states[-1] is TRACKING and found.measured == 1.0
    assert found.error_mm < beyond * found.bound_mm
    assert 0.2 < found.nees < 3.0


def test_a_surface_that_comes_back_is_found_where_it_was() -> None:
    poses = follow(world("shaker", seconds=4.1)).poses  # two periods
    for k in (5, 20, 45):
        back = se3.log(se3.inverse(poses[k].base_from_surface) @ poses[k + 60].base_from_surface)
        assert np.linalg.norm(back[3:]) < 0.08 and np.linalg.norm(back[:3]) < 5e-3


def test_a_part_that_comes_into_view_moves_nothing() -> None:
    found = pooled([follow(world("breathing", reveal=(0.8, 1.6)))])
    assert found.error_mm < 1.8 * found.bound_mm and found.nees < 1.4


@pytest.mark.parametrize("mapping", ["told", "seen"])
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
    follower = Follower(made.rig, seen[0], beginning(made, seen[0], "told"), refine=False)
    poses: list[SurfacePose] = [follower(s) for s in seen[4:]]
    states = [pose.state for pose in poses]
    assert states[:3] == [TrackState.INITIALISING] * 3 and states[-1] is TRACKING and all(p.reason for p in poses[:3])


def test_late_exposures_of_a_fast_surface_are_claimed_and_leave_the_prior_no_say() -> None:
    fast = world("lively", seconds=6.0, rate=6.0, jitter=0.01)
    seen = fast.observations()
    first = next(seen)
    follower = Follower(fast.rig, first, beginning(fast, first, "told"), refine=False)
    estimator, pulled, smeared = follower.estimator, [], []
    for observations in map(follower.of_map, seen):
        fit = estimator.fit(observations, estimator.predict(observations.stamp))
        pose = estimator.accept(fit, observations)
        off = se3.log(se3.inverse(fit.solution.base_from_surface) @ pose.base_from_surface)
        pulled.append(float(off[3:] @ off[3:]))
        smeared.append(float(np.trace(fit.smear[3:, 3:])))
        assert np.trace(pose.covariance[3:, 3:]) > smeared[-1]
    assert np.mean(pulled) < 0.01 * np.mean(smeared) and np.mean(smeared) > 0.05**2


def test_a_first_map_is_hasty_only_until_a_pose_is_given_out_and_only_of_what_is_fast() -> None:
    for speed, hasty in ((10.0, False), (200.0, True)):
        calm = world("still")
        seen = calm.observations()
        first = next(seen)
        follower = Follower(calm.rig, first, beginning(calm, first, "told"), refine=False)
        follower(next(seen))
        estimator = follower.estimator
        estimator.moving(np.array([0, 0, 0, speed, 0, 0]))
        later = follower.of_map(next(seen))
        fit = replace(estimator.fit(later, estimator.predict(later.stamp)), twist=np.array([0, 0, 0, speed, 0, 0]))
        assert estimator.hasty(fit) is hasty
        for observations in seen:
            follower(observations)
        assert not estimator.hasty(fit)
