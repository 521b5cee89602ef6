"""The guard before an oracle written from the limits alone: nothing that breaks one passes, nothing else is refused."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from estimation.pose import SurfacePose, TrackState
from hardware.bench.campaigns.guard import Rules, judge
from hardware.bench.link_guard import REST, jointed, random_log, simple
from planning.command import Code, Move, Refusal
from planning.kinematics import joints_from_axes
from planning.limits import Limits
from planning.motion.guard import Guard
from tests.slowly import slowly

COUNT = 500
HAIR = 1e-12  # rad, rad/s: the joints are solved anew under each limit, which moves their last bits


@pytest.mark.parametrize("seed", [0, *slowly(1, 2, 3)])
@pytest.mark.parametrize("rules", [simple, jointed])
def test_no_random_command_that_breaks_a_limit_passes_and_none_that_keeps_all_is_refused(
    rules: Callable[[], Rules], seed: int
) -> None:
    asked, passed, broken, refused = judge(random_log(seed, COUNT, rules()), rules())
    assert (asked, broken, refused) == (COUNT, 0, 0)
    assert 0.3 * COUNT < passed < 0.9 * COUNT  # both sides are tried


def loosened(limits: Limits, name: str) -> Limits:
    if name == "zones":
        return replace(limits, zones=limits.zones[:-1])
    value = getattr(limits, name)
    wide = value + {"low": -100, "high": 100}[name] if name in ("low", "high") else value * 1.6
    if name in ("low", "high"):
        wide[3:] = value[3:]
    return replace(limits, **{name: wide})


def forgetful(rules: Rules, name: str) -> Guard:
    """A guard with one limit looser than it was told."""
    return Guard(loosened(rules.limits, name), rules.arm, rules.tick, rules.zone, rules.lag)


@pytest.mark.parametrize(
    "name",
    [
        *("low", "high", "jump", "turn", "speed", "feed"),
        "zones",
        *("pose_age", "pose_error", "surface_speed", "surface_turn", "stop_time", "stop_distance"),
    ],
)
def test_the_oracle_finds_a_guard_that_is_loose_in_any_limit(name: str) -> None:
    rules = simple()
    if name == "turn":  # the speed alone would stop it
        rules = replace(rules, limits=replace(rules.limits, speed=np.append(rules.limits.speed[:3], [9.0] * 3)))
    if name == "speed":  # jump and turn alone would
        rules = replace(rules, limits=replace(rules.limits, jump=9.0, turn=1.0))
    if name == "stop_distance":  # none is tried for so long
        rules = replace(rules, limits=replace(rules.limits, stop_distance=2.0))
    far = name in ("low", "high")  # a wander from home takes long to get there
    count = COUNT if far else COUNT // 5
    logs = (random_log(seed, count, rules, forgetful(rules, name)) for seed in range(4 if far else 20))
    assert any(judge(log, rules)[2] for log in logs)


def test_the_oracle_finds_a_guard_that_refuses_too_much() -> None:
    rules = simple()
    strict = Guard(replace(rules.limits, jump=2.9), rules.arm, rules.tick, rules.zone, rules.lag)
    assert judge(random_log(0, COUNT, rules, strict), rules)[3] > 0


def standing(rules: Rules, **changes: np.ndarray) -> tuple[Guard, Move, np.ndarray, np.ndarray]:
    """A guard whose arm has these joints, a small move, and the joints before and after it (6,)."""
    model = rules.arm.jointed
    assert model is not None
    home = rules.arm.home
    axes = home + np.array([1.0, -0.5, 0.7, 0.01, -0.02, 0.015])
    before, after = joints_from_axes(model, np.stack([home, axes]))
    guard = Guard(rules.limits, replace(rules.arm, joints=replace(model, **changes)), rules.tick)
    return guard, Move(1.0, axes, 50.0, 0, False), before, after


def code_of(guard: Guard, move: Move) -> Code | None:
    """Why the guard refuses a move, None where it lets it pass."""
    answer = guard(move, SurfacePose(1.0, REST, np.zeros((6, 6)), np.zeros(6), TrackState.TRACKING), 1.0)
    return answer.code if isinstance(answer, Refusal) else None


@pytest.mark.parametrize("joint", range(6))
def test_the_range_and_speed_of_each_joint_are_met_and_broken_by_next_to_nothing(joint: int) -> None:
    rules = jointed()
    model = rules.arm.jointed
    assert model is not None
    _, _, before, after = standing(rules)
    for name, exact, beyond in (
        ("low", after[joint], HAIR),
        ("high", after[joint], -HAIR),
        ("speed", abs(after[joint] - before[joint]) / rules.tick, -HAIR),
    ):
        limit = getattr(model, name).copy()
        limit[joint] = exact - beyond
        guard, move, _, _ = standing(rules, **{name: limit})
        assert code_of(guard, move) is None, name
        limit = limit.copy()
        limit[joint] = exact + beyond
        guard, move, _, _ = standing(rules, **{name: limit})
        assert code_of(guard, move) is (Code.JOINT_SPEED if name == "speed" else Code.JOINT_RANGE)


def test_the_oracle_finds_a_guard_that_does_not_look_at_the_joints() -> None:
    rules = jointed()
    assert rules.arm.jointed is not None
    slow = replace(rules.arm.jointed, speed=rules.arm.jointed.speed / 10)
    tight = replace(rules, arm=replace(rules.arm, joints=slow))
    guard = Guard(rules.limits, rules.arm, rules.tick, rules.zone, rules.lag)
    assert judge(random_log(0, COUNT, tight, guard), tight)[2] > 0
