"""The guard: a limit met exactly passes, broken by one epsilon is refused; also against an oracle of the limits."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from estimation import se3
from estimation.errors import InputError
from estimation.pose import Forecast, SurfacePose, TrackState
from estimation.se3 import Array
from estimation.surface_map import Warp
from planning.command import MAX_FLOW, Command, Hold, MotionLimits, Move, Refusal, RefusalCode
from planning.kinematics import SimpleArm, joints_from_axes
from planning.motion.guard import Guard
from tests.campaigns.guard import (
    SURFACE_REST,
    GuardRules,
    jointed_rules,
    judge_guard,
    random_log,
    simple_rules,
)
from tests.slow_cases import slowly

TICK = 1 / 64  # powers of two, so that a limit can be met to the last bit
ARM = SimpleArm(home=np.zeros(6))
WIDE = MotionLimits(
    speed=np.full(6, 128.0),
    jump=64.0,
    turn=64.0,
    low=np.array([-256.0, -256, -256, -1.5, -1.5, -1.5]),
    high=np.array([256.0, 256, 256, 1.5, 1.5, 1.5]),
    feed=250.0,
    pose_age=0.25,
    pose_error=0.5,
    surface_speed=50.0,
    surface_turn=0.75,
    stop_time=0.5,
    stop_distance=4.0,
)


def up(value: float) -> float:
    return float(np.nextafter(value, np.inf))


def pose(stamp: float = 0.0, **changes: object) -> SurfacePose:
    covariance = np.diag([0.0, 0, 0, 0.01, 0.01, 0.01])
    exact = SurfacePose(stamp, np.eye(4), covariance, np.zeros(6), TrackState.TRACKING)
    return replace(exact, **changes)


def axes(*values: float) -> Array:
    return np.array([*values, *[0.0] * (6 - len(values))])


def move(target: Array, stamp: float = 1.0, feed: float = 5.0, extrude: bool = False) -> Move:
    return Move(stamp, target, feed, 3, extrude)


def judged(
    command: Command, seen: SurfacePose | None = None, limits: MotionLimits = WIDE, begin: Array | None = None
) -> Command:
    """What a guard that stands at `begin` (6,) makes of a command."""
    guard = Guard(limits, replace(ARM, home=np.zeros(6) if begin is None else begin), TICK)
    return guard(command, pose(command.stamp) if seen is None else seen, command.stamp)


def refused(answer: Command, *words: str) -> bool:
    return isinstance(answer, Hold) and all(word in answer.reason for word in ("refused", *words))


@pytest.mark.parametrize("axis", range(6))
@pytest.mark.parametrize("side", [-1, 1])
def test_the_bounds_of_each_axis(axis: int, side: int) -> None:
    bound = (WIDE.low, WIDE.high)[side > 0][axis]
    limits, only = replace(WIDE, speed=np.full(6, 1e9)), np.eye(6)[axis]
    begin, exact = (bound - side * 0.25) * only, move(bound * only)
    assert judged(exact, limits=limits, begin=begin) is exact
    beyond = move(np.nextafter(bound, side * np.inf) * only)
    assert refused(judged(beyond, limits=limits, begin=begin), "XYZABC"[axis], "allowed")


FAST = np.full(6, 1e9)
ONE, MORE = np.eye(6), up(1.0) * np.eye(6)  # of an axis in a 64th of a second


@pytest.mark.parametrize(
    ("change", "exact", "beyond", "words"),
    [
        *(({"speed": np.full(6, 64.0)}, ONE[k], MORE[k], ("XYZABC"[k], "/s, limit")) for k in range(6)),
        ({"jump": 5.0, "speed": FAST}, axes(3, 4), axes(3, up(up(4))), ("jump",)),  # the way in space
        ({"turn": 0.25, "speed": FAST}, axes(0, 0, 0, 0.25, -0.25, 0.25), axes(0, 0, 0, 0.25, -up(0.25), 0), ("turn",)),
    ],
    ids=[*"XYZABC", "jump", "turn"],
)
def test_the_step_of_one_tick(change: dict[str, Any], exact: Array, beyond: Array, words: tuple[str, ...]) -> None:
    limits, wanted = replace(WIDE, **change), move(exact)
    assert judged(wanted, limits=limits) is wanted and refused(judged(move(beyond), limits=limits), *words)


@pytest.mark.parametrize(("feed", "passes"), [(250.0, True), (up(250.0), False), (5e-324, True), (0.0, False)])
def test_the_feed(feed: float, passes: bool) -> None:
    assert isinstance(judged(move(axes(1), feed=feed)), Move) is passes


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_only_finite_numbers_pass(bad: float) -> None:
    for axis in range(6):
        target = np.zeros(6)
        target[axis] = bad
        assert refused(judged(move(target)), "finite")
    assert refused(judged(move(axes(1), feed=bad)), "feed")
    assert refused(judged(move(axes(1)[:5])), "6 finite numbers")


def test_stamps_go_on() -> None:
    guard = Guard(WIDE, ARM, TICK)
    assert isinstance(guard(move(axes(0.1), 1.0), pose(1.0), 1.0), Move)
    assert refused(guard(move(axes(0.2), 1.0), pose(1.0), 1.0), "is not after")
    assert refused(guard(move(axes(0.2), 0.5), pose(0.5), 0.5), "is not after")
    assert refused(guard(move(axes(0.2), 2.0), pose(2.0), 2.5), "command of 2.0 s at 2.5 s")
    assert refused(guard(move(axes(0.2), np.nan), pose(2.0), np.nan))
    assert isinstance(guard(move(axes(0.2), up(1.0)), pose(1.0), up(1.0)), Move)


Pose = Callable[[], SurfacePose | None]
TRUST: list[tuple[str, Pose, bool]] = [
    ("age met", lambda: pose(0.75), True),
    ("age broken", lambda: pose(float(np.nextafter(0.75, 0))), False),
    ("of this instant", lambda: pose(1.0), True),
    ("of the future", lambda: pose(up(1.0)), False),
    ("none", lambda: None, False),
    ("nan stamp", lambda: pose(np.nan), False),
    ("nan pose", lambda: pose(1.0, base_from_surface=np.full((4, 4), np.nan)), False),
    ("nan twist", lambda: pose(1.0, twist=np.full(6, np.nan)), False),
    ("inf covariance", lambda: pose(1.0, covariance=np.full((6, 6), np.inf)), False),
    ("nan drift", lambda: pose(1.0, acceleration_psd=np.full(6, np.nan)), False),
    ("degraded", lambda: pose(1.0, state=TrackState.DEGRADED), True),
    ("coasting", lambda: pose(1.0, state=TrackState.COASTING), False),
    ("lost", lambda: pose(1.0, state=TrackState.LOST), False),
    ("initialising", lambda: pose(1.0, state=TrackState.INITIALISING), False),
    ("error met", lambda: pose(1.0, covariance=np.diag([0.0, 0, 0, 0.25, 0, 0])), True),
    ("error broken", lambda: pose(1.0, covariance=np.diag([0.0, 0, 0, up(up(0.25)), 0, 0])), False),
    ("error negative", lambda: pose(1.0, covariance=-np.eye(6)), False),
    ("speed met", lambda: pose(1.0, twist=axes(0, 0, 0, 30, 40)), True),
    ("speed broken", lambda: pose(1.0, twist=axes(0, 0, 0, 30, up(up(40)))), False),
    ("turn met", lambda: pose(1.0, twist=axes(0, 0, 0.75)), True),
    ("turn broken", lambda: pose(1.0, twist=axes(0, 0, up(0.75))), False),
]


@pytest.mark.parametrize(("seen", "passes"), [(seen, passes) for _, seen, passes in TRUST], ids=[t[0] for t in TRUST])
def test_what_a_pose_must_be_worth(seen: Pose, passes: bool) -> None:
    guard = Guard(WIDE, ARM, TICK)
    wanted = move(axes(0.5), extrude=True)
    answer = guard(wanted, seen(), 1.0)
    assert answer is wanted if passes else refused(answer)


def test_drift_makes_a_pose_worth_less_with_time() -> None:
    drifting = pose(0.75, twist_covariance=np.diag([0.0, 0, 0, 100, 0, 0]))  # 10 mm/s: 2.7 mm in 0.27 s
    assert refused(judged(move(axes(0.5)), drifting), "is known to 2.6")
    assert isinstance(judged(move(axes(0.5)), replace(drifting, stamp=1.0)), Move)


def test_a_late_arm_asks_more_of_a_pose() -> None:
    drifting = pose(1.0, twist_covariance=np.diag([0.0, 0, 0, 100, 0, 0]))  # 10 mm/s
    for lag, passes in ((0.0, True), (0.033, True), (0.034, False)):  # 0.5 mm after 49 ms, a tick of it
        assert isinstance(Guard(WIDE, ARM, TICK, lag=lag)(move(axes(0.5)), drifting, 1.0), Move) is passes


@pytest.mark.parametrize("foreseen", [False, True])
@pytest.mark.parametrize("seed", range(5))
def test_the_error_that_counts_is_the_one_the_pose_itself_foretells(seed: int, foreseen: bool) -> None:
    """A surface at rest: the guard's own arithmetic leaves out how motion turns a covariance."""
    draw = np.random.default_rng(seed)
    root, drift, ahead = draw.normal(size=(3, 6, 6)) * np.array([0.01, 0.01, 0.01, 0.5, 0.5, 0.5])[:, None]
    unsure = pose(1.0, covariance=root @ root.T, twist_covariance=30 * drift @ drift.T)
    if foreseen:
        grown = np.stack([share * ahead @ ahead.T + unsure.covariance for share in (1.0, 2.0)])
        unsure = replace(unsure, forecast=Forecast(np.array([0.05, 0.15]), np.zeros((2, 6)), grown))
    else:
        unsure = replace(unsure, acceleration_psd=draw.uniform(10, 100, 6) * [0.01, 0.01, 0.01, 9, 9, 9])
    begin, lag = axes(*draw.uniform(-30, 30, 3)), 0.3 * draw.random()
    guard = Guard(replace(WIDE, pose_error=1e-6), replace(ARM, home=begin), TICK, lag=lag)
    now = 1.0 + 0.2 * draw.random()
    answer = guard(move(begin, now, extrude=True), unsure, now)
    assert isinstance(answer, Refusal) and answer.code is RefusalCode.POSE_ERROR
    assert answer.got == pytest.approx(unsure.predicted_error(now + TICK + lag, begin[None, :3])[0], rel=1e-9)


def test_after_moves_were_called_back_a_step_counts_from_where_the_arm_stands() -> None:
    guard = Guard(WIDE, ARM, TICK)
    assert isinstance(guard(move(axes(1.5), 1.0), pose(1.0), 1.0), Move)
    guard.stands(axes(-1.5))
    assert refused(guard(move(axes(1.5), 1.1), pose(1.1), 1.1), "X at")
    assert isinstance(guard(move(axes(-3), 1.2), pose(1.2), 1.2), Move)


def test_a_turning_surface_is_fast_far_from_its_axis() -> None:
    turning = pose(1.0, twist=axes(0, 0, 0.5))
    assert isinstance(judged(move(axes(100)), turning, begin=axes(100.0)), Move)
    assert refused(judged(move(axes(101)), turning, begin=axes(101.0)), "moves at 50.5")


def test_what_the_surface_does_counts_where_is_printed() -> None:
    zone = np.array([[-10.0, -10, 0], [10, 10, 1]])
    far = replace(ARM, home=axes(200.0))
    turning = pose(1.0, twist=axes(0, 0, 0.5), covariance=np.diag([0, 0, 1e-4, 0.01, 0.01, 0.01]))
    assert refused(Guard(WIDE, far, TICK)(move(axes(200)), turning, 1.0), "moves at 100.0")
    assert isinstance(Guard(WIDE, far, TICK, zone)(move(axes(200)), turning, 1.0), Move)
    unsure = replace(turning, covariance=turning.covariance * 30)
    assert refused(Guard(WIDE, far, TICK, zone)(move(axes(200)), unsure, 1.0), "is known to")


@pytest.mark.parametrize(
    ("since", "way", "extrude", "passes"),
    [
        (0.5, 0.5, False, True),
        (up(up(1.5)) - 1, 0.5, False, False),
        (0.25, 4.0, False, True),
        (0.25, up(4.0), False, False),
        (0.25, 0.5, True, False),
    ],
)
def test_without_a_pose_only_a_stop_follows(since: float, way: float, extrude: bool, passes: bool) -> None:
    guard = Guard(replace(WIDE, speed=np.full(6, 1e9)), ARM, TICK)
    assert isinstance(guard(Hold(1.0, 0.001, "here"), pose(1.0), 1.0), Hold)
    answer = guard(move(axes(way), 1 + since, extrude=extrude), None, 1 + since)
    assert isinstance(answer, Move) if passes else refused(answer, "there is no pose")


def test_a_refused_move_leaves_the_arm_where_it_was() -> None:
    guard = Guard(WIDE, ARM, TICK)
    guard(move(axes(1.0), 1.0), pose(1.0), 1.0)
    assert refused(guard(move(axes(1000.0), 2.0), pose(2.0), 2.0)) and np.array_equal(guard.axes, axes(1.0))
    assert isinstance(guard(move(axes(2.0), 3.0), pose(3.0), 3.0), Move)


def test_a_hold_passes_and_moves_nothing() -> None:
    guard = Guard(WIDE, ARM, TICK)
    hold = Hold(1.0, 0.001, "lost")
    assert guard(hold, None, 1.0) is hold and np.array_equal(guard.axes, np.zeros(6))


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("speed", np.zeros(6)), ("jerk", np.full(6, np.nan)), ("acceleration", np.ones(5)), ("jump", -1.0),
        ("pose_age", np.inf), ("low", np.full(6, 900.0)), ("high", np.array([650.0, 650, 500, 1, 1.6, 1])),
    ],
)  # fmt: skip
def test_limits_are_checked(name: str, value: object) -> None:
    with pytest.raises(InputError, match="limits"):
        replace(MotionLimits(), **{name: value})


def test_the_arm_is_checked() -> None:
    with pytest.raises(InputError, match="arm_from_base"):
        SimpleArm(arm_from_base=np.zeros((4, 4)))
    with pytest.raises(InputError, match="arm_from_upright"):
        SimpleArm(arm_from_upright=se3.exp_rotation([0, 0, 0.1]) * 2)
    with pytest.raises(InputError, match="home"):
        SimpleArm(home=np.full(6, np.nan))


def test_a_warp_adds_its_own_doubt_and_what_grows_of_it() -> None:
    def warped(variance: float, growth: float) -> SurfacePose:
        bell = np.zeros((1, 3)), np.zeros((1, 3)), variance * np.eye(3), growth * np.eye(3), 1e4, 0.4, 0.1
        return pose(1.0, covariance=np.zeros((6, 6)), warp=Warp(*bell))

    assert not refused(judged(move(axes(0.5)), warped(0.2499, 0.0)))
    assert refused(judged(move(axes(0.5)), warped(0.2501, 0.0)), "is known to 0.500")
    assert refused(judged(move(axes(0.5)), warped(0.2499, 0.02)), "is known to 0.500")  # one tick ahead
    assert refused(judged(move(axes(0.5)), warped(np.nan, 0.0)), "not finite")


PRINT = move(axes(0.5), extrude=True)
REFUSED: list[tuple[RefusalCode, Move, SurfacePose | None, float, float]] = [
    (RefusalCode.ORDER, move(axes(0.5), 0.5), pose(1.0), 0.5, 1.0),
    (RefusalCode.NOT_FINITE, move(axes(np.nan)), pose(1.0), np.nan, np.nan),
    (RefusalCode.FEED, move(axes(0.5), feed=250.5), pose(1.0), 250.5, 250.0),
    (RefusalCode.WORKSPACE, move(axes(257)), pose(1.0), 257.0, 256.0),
    (RefusalCode.JUMP, move(axes(65)), pose(1.0), 65.0, 64.0),
    (RefusalCode.TURN, move(axes(0, 0, 0, 1.25)), pose(1.0), 1.25, 1.0),
    (RefusalCode.AXIS_SPEED, move(axes(3)), pose(1.0), 192.0, 128.0),
    (RefusalCode.NO_POSE, PRINT, None, np.nan, np.nan),
    (RefusalCode.POSE_NOT_FINITE, PRINT, pose(1.0, twist=np.full(6, np.inf)), np.nan, np.nan),
    (RefusalCode.TRACK_STATE, PRINT, pose(1.0, state=TrackState.LOST), np.nan, np.nan),
    (RefusalCode.POSE_AGE, PRINT, pose(0.5), 0.5, 0.25),
    (RefusalCode.SURFACE_SPEED, PRINT, pose(1.0, twist=axes(0, 0, 0, 51)), 51.0, 50.0),
    (RefusalCode.SURFACE_TURN, PRINT, pose(1.0, twist=axes(1.5)), 1.5, 0.75),
    (RefusalCode.POSE_ERROR, PRINT, pose(1.0, covariance=np.diag([0.0, 0, 0, 1, 0, 0])), 1.0, 0.5),
    (RefusalCode.STOP_DISTANCE, move(axes(5), 1.25), None, 5.0, 4.0),
    (RefusalCode.WATCHDOG, move(axes(0.5), 1.75), None, 0.75, 0.5),
    (RefusalCode.FLOW, replace(move(axes(0.5)), flow=-1.0), pose(1.0), -1.0, 0.0),
    (RefusalCode.FLOW, replace(move(axes(0.5)), flow=np.inf), pose(1.0), np.inf, MAX_FLOW),
    (RefusalCode.FLOW, replace(move(axes(0.5)), flow=1.0, flow_after=1.0), pose(1.0), 1.0, TICK),
    (RefusalCode.NO_POSE, replace(move(axes(0.5)), flow=1.0), None, np.nan, np.nan),
    (RefusalCode.POSE_AGE, replace(move(axes(0.5)), flow_after=TICK / 2), pose(0.5), 0.5, 0.25),
]


@pytest.mark.parametrize(("code", "command", "seen", "got", "limit"), REFUSED, ids=[r[0] for r in REFUSED])
def test_refusal_details(code: RefusalCode, command: Move, seen: SurfacePose | None, got: float, limit: float) -> None:
    fast = code in (RefusalCode.WORKSPACE, RefusalCode.JUMP, RefusalCode.TURN, RefusalCode.STOP_DISTANCE)
    limits = replace(WIDE, speed=np.full(6, 1e9 if fast else 128.0), turn=1.0)
    guard = Guard(limits, ARM, TICK)
    first = 1.0 if command.stamp != 1.0 else 0.9
    assert isinstance(guard(Hold(first, 0.001, "here"), pose(first), first), Hold)
    answer = guard(command, seen, command.stamp)
    assert isinstance(answer, Refusal) and answer.code is code
    assert (answer.got, answer.limit) == pytest.approx((got, limit), nan_ok=True)
    assert answer.reason.startswith("refused: ")


def test_every_code_is_documented() -> None:
    text = (Path(__file__).parents[1] / "docs" / "motion.md").read_text(encoding="utf-8")
    assert [code for code in RefusalCode if f"`{code}`" not in text] == []


COUNT = 500
HAIR = 1e-12  # rad, rad/s: the joints are solved anew under each limit, which moves their last bits


@pytest.mark.parametrize("seed", [0, *slowly(1, 2, 3)])
@pytest.mark.parametrize("rules", [simple_rules, jointed_rules])
def test_a_random_command_passes_exactly_if_it_keeps_all_limits(rules: Callable[[], GuardRules], seed: int) -> None:
    asked, passed, broken, refused = judge_guard(random_log(seed, COUNT, rules()), rules())
    assert (asked, broken, refused) == (COUNT, 0, 0)
    assert 0.3 * COUNT < passed < 0.9 * COUNT  # both sides are tried


def loosened(limits: MotionLimits, name: str) -> MotionLimits:
    if name == "zones":
        return replace(limits, zones=limits.zones[:-1])
    value = getattr(limits, name)
    wide = value + {"low": -100, "high": 100}[name] if name in ("low", "high") else value * 1.6
    if name in ("low", "high"):
        wide[3:] = value[3:]
    return replace(limits, **{name: wide})


def forgetful(rules: GuardRules, name: str) -> Guard:
    """A guard with one limit looser than it was told."""
    return Guard(loosened(rules.limits, name), rules.arm, rules.tick, rules.zone, rules.lag)


@pytest.mark.slow
@pytest.mark.parametrize(
    "name",
    [
        *("low", "high", "jump", "turn", "speed", "feed"),
        "zones",
        *("pose_age", "pose_error", "surface_speed", "surface_turn", "stop_time", "stop_distance"),
    ],
)
def test_the_oracle_finds_a_guard_that_is_loose_in_any_limit(name: str) -> None:
    rules = simple_rules()
    if name == "turn":  # the speed alone would stop it
        rules = replace(rules, limits=replace(rules.limits, speed=np.append(rules.limits.speed[:3], [9.0] * 3)))
    if name == "speed":  # jump and turn alone would
        rules = replace(rules, limits=replace(rules.limits, jump=9.0, turn=1.0))
    if name == "stop_distance":  # none is tried for so long
        rules = replace(rules, limits=replace(rules.limits, stop_distance=2.0))
    far = name in ("low", "high")  # a wander from home takes long to get there
    count = COUNT if far else COUNT // 5
    logs = (random_log(seed, count, rules, forgetful(rules, name)) for seed in range(4 if far else 20))
    assert any(judge_guard(log, rules)[2] for log in logs)


def test_the_oracle_finds_a_guard_that_refuses_too_much() -> None:
    rules = simple_rules()
    strict = Guard(replace(rules.limits, jump=2.9), rules.arm, rules.tick, rules.zone, rules.lag)
    assert judge_guard(random_log(0, COUNT, rules, strict), rules)[3] > 0


def standing(rules: GuardRules, **changes: np.ndarray) -> tuple[Guard, Move, np.ndarray, np.ndarray]:
    """A guard whose arm has these joints, a small move, and the joints before and after it (6,)."""
    model = rules.arm.jointed
    home = rules.arm.home
    axes = home + np.array([1.0, -0.5, 0.7, 0.01, -0.02, 0.015])
    before, after = joints_from_axes(model, np.stack([home, axes]))
    guard = Guard(rules.limits, replace(rules.arm, joints=replace(model, **changes)), rules.tick)
    return guard, Move(1.0, axes, 50.0, 0, False), before, after


def code_of(guard: Guard, move: Move) -> RefusalCode | None:
    """Why the guard refuses a move, None where it lets it pass."""
    answer = guard(move, SurfacePose(1.0, SURFACE_REST, np.zeros((6, 6)), np.zeros(6), TrackState.TRACKING), 1.0)
    return answer.code if isinstance(answer, Refusal) else None


@pytest.mark.parametrize("joint", range(6))
def test_the_range_and_speed_of_each_joint_are_met_and_broken_by_next_to_nothing(joint: int) -> None:
    rules = jointed_rules()
    model = rules.arm.jointed
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
        assert code_of(guard, move) is (RefusalCode.JOINT_SPEED if name == "speed" else RefusalCode.JOINT_RANGE)


@pytest.mark.slow
def test_the_oracle_finds_a_guard_that_does_not_look_at_the_joints() -> None:
    rules = jointed_rules()
    slow = replace(rules.arm.jointed, speed=rules.arm.jointed.speed / 10)
    tight = replace(rules, arm=replace(rules.arm, joints=slow))
    guard = Guard(rules.limits, rules.arm, rules.tick, rules.zone, rules.lag)
    assert judge_guard(random_log(0, COUNT, tight, guard), tight)[2] > 0


def test_a_warp_whose_control_points_are_no_numbers_is_refused() -> None:
    bell = np.full((1, 3), np.nan), np.zeros((1, 3)), np.zeros((3, 3)), np.zeros((3, 3)), 25.0, 0.0, 0.0
    strange = pose(1.0, covariance=np.zeros((6, 6)), warp=Warp(*bell))
    assert refused(judged(move(axes(0.5)), strange), "not finite")
