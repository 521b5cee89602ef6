"""Arm files and the table [arm]: round trip, defaults, faults named by key; no-go zones."""

from __future__ import annotations

from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from estimation import se3
from estimation.errors import InputError
from estimation.se3 import Array
from hardware.arm.profile import (
    FAR_LIMIT,
    LIMIT_KEYS,
    LIMIT_RANGES,
    ArmProfile,
    far_limits_text,
    limit_unit,
    unreached_limits_text,
)
from hardware.arm.protocol import Dialect
from hardware.cli.main import main
from hardware.files.arm_file import read_arm, write_arm
from hardware.simulator.arm.settings import ARM_KEYS, ArmSettings, ReplyMode, arm_settings_from_table
from planning.command import MotionLimits, Move, NoGo, Refusal, RefusalCode, box, cylinder, half_space
from planning.kinematics import SimpleArm
from planning.motion.guard import Guard
from tests.test_guard import ARM, TICK, WIDE, axes, move, pose


def same(a: ArmProfile, b: ArmProfile) -> bool:
    pairs = [(getattr(a.limits, f.name), getattr(b.limits, f.name)) for f in fields(a.limits)]
    own = ("arm_from_base", "arm_from_upright", "home", "tool_offset")
    pairs += [(getattr(a.arm, name), getattr(b.arm, name)) for name in own]
    numbers = all(np.allclose(x, y, rtol=1e-14, atol=1e-14) for x, y in pairs)
    numbers &= np.array_equal(a.tool, b.tool)
    return numbers and (a.dialect, a.baud, a.tick, a.lag) == (b.dialect, b.baud, b.tick, b.lag)


def test_numbers_of_numpy_are_written_as_numbers(tmp_path: Path) -> None:
    profile = replace(ArmProfile(), lag=np.float64(0.0261), tick=np.float64(0.02))  # measured, and brought in step
    write_arm(tmp_path / "arm.toml", profile)
    assert same(read_arm(tmp_path / "arm.toml"), profile)


@given(st.integers(0, 10_000))
def test_a_profile_comes_back(tmp_path_factory: pytest.TempPathFactory, seed: int) -> None:
    draw = np.random.default_rng(seed)
    profile = ArmProfile(
        SimpleArm(
            *(se3.exp(draw.normal(size=6)), se3.exp_rotation(draw.normal(size=3)), draw.uniform(-0.5, 0.5, 6)),
            tool_offset=draw.uniform(-9, 9, 3),
        ),
        MotionLimits(speed=draw.uniform(1, 30, 6), turn=draw.uniform(0.01, 0.1), surface_turn=draw.uniform(0.1, 1)),
        Dialect(int(draw.integers(2)), ("J5", "J4", "J6"), (1, 10)[int(draw.integers(2))], (0.0, 1500.0)[seed % 2]),
        int(draw.integers(57_600, 1_000_000)),
        draw.uniform(0.01, 0.04),
        draw.uniform(0, 0.5),
        np.stack([np.cumsum(draw.uniform(0.1, 30, 3 + seed % 4)), draw.uniform(0, 9, 3 + seed % 4)], axis=-1),
        *(None if seed % 3 else draw.uniform(0, 0.009), None if seed % 2 else draw.uniform(0.05, 0.5)),
    )
    file = tmp_path_factory.mktemp("arm") / "arm.toml"
    write_arm(file, profile, "made up\nfor a test")
    assert same(read_arm(file), profile)


def test_what_a_file_leaves_out_keeps_its_default(tmp_path: Path) -> None:
    file = tmp_path / "arm.toml"
    file.write_text("motion_byte = 0\n[limits]\nturn = 1.5\n", encoding="utf-8")
    profile = read_arm(file)
    assert same(profile, ArmProfile(limits=MotionLimits(turn=np.deg2rad(1.5)), dialect=Dialect(0)))


def test_on_a_slow_line_ticks_and_lag_follow_unless_they_are_given(tmp_path: Path) -> None:
    file = tmp_path / "arm.toml"
    file.write_text("baud = 9600\n", encoding="utf-8")
    profile = read_arm(file)
    assert (profile.baud, profile.tick, profile.frame_time) == (9600, 0.05, 0.05)
    assert profile.lag == pytest.approx(0.024 - 1 / 240 + 0.05)
    file.write_text("baud = 9600\nlag_s = 0.1\n", encoding="utf-8")
    assert read_arm(file).lag == 0.1


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", ["empty"]), ("baud = ", ["syntax"]), ("boud = 9600", ["boud", "did you mean 'baud'"]),
        ("baud = 9600\ntick_s = 0.049", ["tick", "0.05"]), ("baud = 4800", [": baud = 4800", "9600"]),
        ("baud = -1", ["baud", ">= 1"]), ("motion_byte = 2", ["motion_byte", "0 or 1"]),
        ("origin_scale = 2", ["origin_scale", "1 or 10"]), ("pwm = 7", ["pwm", "1500"]),
        ('slots = ["J4", "J4", "J6"]', ["slots", "each once"]), ("slots = 3", ["slots"]),
        ("tick_s = nan", ["tick_s", "finite"]), ("lag_s = -0.01", ["lag", "0 to 1"]),
        ("lag_s = 1.01", ["lag", "0 to 1"]), ("lag_s = 24", [": lag_s = 24, allowed 0 to 1"]),
        ("tick_s = 9", [": tick_s = 9, allowed"]),
        ("home_mm_deg = [0, 0, 9000, 0, 0, 90]", [": home_mm_deg = [0, 0, 9000, 0, 0, 90], allowed", "in degrees"]),
        ("[limits]\nturn = -3", [": limits.turn = -3, allowed 0.001 to 40, degrees"]),
        ("[limits]\nspeed = [-1, 1, 1, 1, 1, 90]", [": limits.speed = [-1, 1, 1, 1, 1, 90], allowed 0.1 to 2000, mm"]),
        ("[limits]\nlow = [0, 0, 0, 0, 90, 0]\nhigh = [9, 9, 9, 9, 91, 9]", ["of B = [90.0, 91.0], allowed within 90"]),
        ("tool_mm = 3", ["tool_mm", "finite numbers"]),
        ("tool_mm = [[0, 1, 2], [5, 1, 2]]", ["tool_mm", "finite numbers"]),
        ("tool_mm = [[0, 1]]", ["tool_mm", "two or more"]),
        ("tool_mm = [[5, 1], [0, 1]]", ["tool_mm", "heights rising"]),
        ("tool_mm = [[0, -1], [5, 1]]", ["tool_mm", "none negative"]),
        ("tool_mm = [[0, nan], [5, 1]]", ["tool_mm", "finite"]),
        ("home_mm_deg = [0, 0]", ["home_mm_deg", "6 finite numbers"]),
        ("home_mm_deg = [0, 0, 9000, 0, 0, 0]", ["home", "within"]),
        ("arm_from_base = [[1, 0, 0, 0], [0, 2, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]", ["arm_from_base", "rigid motion"]),
        ("limits = 3", ["limits"]),
        ("[limits]\nspeed = 100", ["limits.speed", "6 finite numbers"]),
        ("[limits]\njump = -1", ["limits", "jump", "0.001 to 40"]),
        ("[limits]\nspead = 1", ["limits.spead", "did you mean 'speed'"]),
        ("[limits]\npose_age = 1e9", ["limits.pose_age = 1000000000.0, allowed 0.01 to 2, s"]),
        ("[limits]\npose_error = 500", ["limits.pose_error = 500, allowed 0.001 to 10, mm"]),
        ("[limits]\nstop_time = 1e9", ["limits.stop_time", "0.01 to 2, s"]),
        ("[limits]\nturn = 240", ["limits.turn = 240, allowed 0.001 to 40, degrees"]),
        ("[limits]\nspeed = [150, 150, 150, 120, 120, 1e308]", ["allowed 0.1 to 2000, mm and degrees per s"]),
        ("[limits]\njerk = [1e-300, 9e3, 9e3, 9e3, 9e3, 9e3]", ["allowed 10 to 1e+07, mm and degrees per s^3"]),
        ("[limits]\nsurface_speed = 1e9", ["limits.surface_speed", "0.1 to 1000, mm per s"]),
    ],
)  # fmt: skip
def test_faults_are_told_by_file_and_key(tmp_path: Path, text: str, words: list[str]) -> None:
    file = tmp_path / "arm.toml"
    file.write_text(text, encoding="utf-8")
    with pytest.raises(InputError) as caught:
        read_arm(file)
    for word in [str(file), "allowed", *words]:
        assert word in str(caught.value)


FULL = {
    "fifo": 20,
    "dead_time_s": 0.01,
    "servo_lag_s": 0.0,
    "top_speed_mm_s": 200,
    "top_turn_deg_s": 90,
    "low_mm_deg": [-1, -2, -3, -4, -5, -6],
    "high_mm_deg": [1, 2, 3, 4, 5, 180],
    "replies": "stray",
    "reply_period_s": 0.1,
    "seed": 7,
}


def test_a_table_gives_the_settings_in_mm_s_and_rad() -> None:
    assert set(FULL) == set(ARM_KEYS)
    arm = arm_settings_from_table("a.toml", FULL)
    assert (arm.fifo, arm.seed, arm.replies) == (20, 7, ReplyMode.STRAY)
    assert (arm.dead_time, arm.servo_lag, arm.reply_period) == (0.01, 0.0, 0.1)
    assert (arm.top_speed, arm.top_turn) == pytest.approx((200, np.pi / 2))
    assert arm.high == pytest.approx([1, 2, 3, *np.deg2rad([4, 5, 180])])


def test_what_a_table_leaves_out_keeps_its_default() -> None:
    arm, default = arm_settings_from_table("a.toml", {}), ArmSettings()
    assert all(np.all(getattr(arm, name) == getattr(default, name)) for name in ArmSettings.__slots__)


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("fifo", 0), ("fifo", 1.5), ("seed", -1), ("dead_time_s", -0.001), ("servo_lag_s", "20 ms"),
        ("servo_lag_s", -1e-9), ("top_speed_mm_s", 0), ("top_turn_deg_s", -1),
        ("low_mm_deg", [0] * 5), ("low_mm_deg", [1000, -1, -1, -1, -1, -1]), ("high_mm_deg", [1601, 1, 1, 1, 1, 1]),
        ("replies", "on"), ("replies", 3), ("reply_period_s", 0),
    ],
)  # fmt: skip
def test_a_wrong_value_is_refused_by_the_name_it_has_in_the_file(key: str, value: object) -> None:
    with pytest.raises(InputError, match=rf"a\.toml: arm\.{key.replace('high', '(low|high)')} = .*allowed"):
        arm_settings_from_table("a.toml", {key: value})


def test_an_unknown_key_is_refused_with_the_nearest_one() -> None:
    with pytest.raises(InputError, match="did you mean 'servo_lag_s'"):
        arm_settings_from_table("a.toml", {"servo_lag": 0.02})


BED = half_space("bed", np.array([0.0, 0, 2]), np.array([7.0, 7, -2]))
BLOCK = box("block", np.array([2.0, -1, -1]), np.array([4.0, 1, 1]))
POST = cylinder("post", np.array([0.0, 5, -10]), np.array([0.0, 5, 10]), 2.0)
FREE = replace(WIDE, speed=np.full(6, 1e9), zones=(BED, BLOCK, POST))


def judged(target: Array, begin: Array | None = None) -> Move | Refusal:
    guard = Guard(FREE, replace(ARM, home=np.zeros(6) if begin is None else begin), TICK)
    answer = guard(move(target), pose(1.0), 1.0)
    assert isinstance(answer, Move | Refusal)
    return answer


@pytest.mark.parametrize(
    ("surface", "inwards"), [(axes(0, 0, -2), axes(0, 0, -1)), (axes(2), axes(1)), (axes(0, 3), axes(0, 1))]
)
def test_the_surface_of_each_kind_of_zone_is_met_and_broken_by_a_hair(surface: Array, inwards: Array) -> None:
    assert isinstance(judged(surface), Move)
    answer = judged(np.where(inwards != 0, np.nextafter(surface, 100 * inwards), surface))
    assert isinstance(answer, Refusal) and answer.code is RefusalCode.NO_GO
    assert 0 < answer.got < 1e-12 and answer.limit == 0


def test_no_step_goes_through_a_zone_or_ends_behind_it() -> None:
    through = judged(axes(6))
    assert isinstance(through, Refusal) and through.code is RefusalCode.NO_GO and "'block'" in through.reason
    assert through.got == pytest.approx(1.0) and isinstance(judged(axes(6, 3), axes(0, 1.5)), Move)
    assert isinstance(judged(axes(0, 8)), Refusal) and isinstance(judged(axes(4, 8), axes(4, 2)), Move)
    assert isinstance(judged(axes(2, 8), axes(2, 2)), Move)  # along the post's surface


place = st.builds(lambda *xyz: np.array(xyz), *[st.floats(-6, 6)] * 3)


@settings(max_examples=60)
@given(place, place)
def test_a_straight_way_meets_a_zone_where_one_of_its_points_is_inside(start: Array, end: Array) -> None:
    for zone in (BED, BLOCK, POST):
        if zone.depth(start) > 0:
            continue
        depths = [zone.depth(start + share * (end - start)) for share in np.linspace(0, 1, 100)]
        if max(depths) > 1e-3:
            assert zone.depth_along(start, end) > 0
        if max(depths) < -0.2:
            assert zone.depth_along(start, end) == 0


def test_zones_come_back_from_a_file_and_home_must_be_outside(tmp_path: Path) -> None:
    file = tmp_path / "arm.toml"
    profile = ArmProfile(limits=MotionLimits(zones=(BED, BLOCK, POST)))
    write_arm(file, profile)
    for a, b in zip(read_arm(file).limits.zones, profile.limits.zones, strict=True):
        assert a.name == b.name and a.radius == b.radius
        assert np.allclose(a.normals, b.normals) and np.allclose(a.offsets, b.offsets) and np.allclose(a.axis, b.axis)
    with pytest.raises(InputError, match="no-go zone 'all'"):
        ArmProfile(limits=MotionLimits(zones=(half_space("all", np.array([0.0, 0, 1]), np.array([0.0, 0, 1000])),)))


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("box = [[0, 0, 0], [1, 1, 1]]", "no_go.name"),
        ('name = "x"', "half_space, box, or cylinder"),
        ('name = "x"\nbox = [[0, 0, 0], [1, 1, 1]]\nradius = 3', "cylinder with radius"),
        ('name = "x"\ncylinder = [[0, 0, 0], [1, 1, 1]]', "cylinder with radius"),
        ('name = "x"\nbox = [[0, 0, 2], [1, 1, 1]]', "low corner"),
        ('name = "x"\nbox = [[0, 0, nan], [1, 1, 1]]', "no_go.box"),
        ('name = "x"\nhalf_space = [[0, 0, 0], [1, 1, 1]]', "not zero"),
        ('name = "x"\ncylinder = [[1, 1, 1], [1, 1, 1]]\nradius = 3', "two ends apart"),
        ('name = "x"\ncylinder = [[0, 0, 0], [1, 1, 1]]\nradius = 0', "radius > 0"),
        ('name = "x"\nboxx = 3', "no_go.boxx"),
        ('name = "bed in m"\nbox = [[-0.3, -0.3, -0.1], [0.3, 0.3, 0.0]]', "1 mm or more"),
        ('name = "post in m"\ncylinder = [[0, 0, 0], [0, 0, 0.2]]\nradius = 0.05', "the unit is mm, not m"),
    ],
)
def test_a_zone_that_makes_no_sense_is_refused_by_its_key(tmp_path: Path, text: str, words: str) -> None:
    file = tmp_path / "arm.toml"
    file.write_text(f"[[no_go]]\n{text}\n", encoding="utf-8")
    with pytest.raises(InputError) as caught:
        read_arm(file)
    assert words in str(caught.value)


def test_a_zone_of_wrong_shapes_is_refused() -> None:
    with pytest.raises(InputError, match="normals"):
        NoGo("x", np.zeros((2, 3)), np.zeros(3))
    with pytest.raises(InputError, match="unit normals"):
        NoGo("x", np.ones((1, 3)), np.zeros(1))


def test_every_limit_has_a_range_with_room_around_its_default() -> None:
    defaults = MotionLimits()
    assert set(LIMIT_RANGES) == set(LIMIT_KEYS)
    for name, (low, high) in LIMIT_RANGES.items():
        value = np.asarray(getattr(defaults, name)) / limit_unit(name)
        assert (low < value).all() and (1.5 * value < high).all(), name


@given(name=st.sampled_from(LIMIT_KEYS), times=st.floats(0.2, 6.0), axis=st.integers(0, 5))
def test_a_limit_is_told_exactly_if_it_is_more_than_three_times_the_usual_one(
    name: str, times: float, axis: int
) -> None:
    usual = getattr(MotionLimits(), name)
    each = np.ones(6)
    each[axis] = times
    limits = object.__new__(MotionLimits)  # what no arm could have is none of its business
    for field in fields(MotionLimits):
        object.__setattr__(limits, field.name, getattr(MotionLimits(), field.name))
    object.__setattr__(limits, name, usual * (each if np.ndim(usual) else times))
    told = far_limits_text(limits)
    assert (f"limits.{name} = " in told) == (times > FAR_LIMIT) == bool(told)
    assert "\n" not in told


@given(st.floats(10.0, 300.0), st.floats(0.2, 10.0))
def test_a_speed_that_a_jump_never_allows_is_told_and_no_other(speed: float, jump: float) -> None:
    """By the planner's own rule: in one tick of 0.02 s all three axes may move at once."""
    limits = MotionLimits(speed=np.array([speed] * 3 + [0.1] * 3), jump=jump)
    told, most = unreached_limits_text(ArmProfile(limits=limits)), jump / 3**0.5 / 0.02
    assert bool(told) == (most < speed * (1 - 1e-9))
    assert not told or (f"X Y Z {speed:g}, at most {most:.1f}, as" in told)


def test_arms_that_come_along_have_usual_limits() -> None:
    for name in ("s6h4d", "six_axis"):
        assert far_limits_text(read_arm(f"data/arms/{name}.toml").limits) == ""


@pytest.mark.parametrize("words", [["reach", "data/paths/square_10mm.csv", "--arm"], ["arm", "/dev/none", "--arm"]])
def test_limits_far_beyond_the_usual_ones_are_told(
    words: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    text = Path("data/arms/s6h4d.toml").read_text()
    (tmp_path / "arm.toml").write_text(text + "[limits]\npose_error = 5\n")
    main([*words, str(tmp_path / "arm.toml")])
    told = capsys.readouterr().out
    assert told.count("limits.pose_error = 5, 10 times its 0.5") == 1
    main([*words, "data/arms/s6h4d.toml"])
    assert "limits far beyond" not in capsys.readouterr().out
