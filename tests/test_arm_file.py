"""Arm files: round trip, defaults, and faults told by key."""

from __future__ import annotations

from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from estimation import se3
from estimation.errors import InputError
from hardware.arm.profile import ArmProfile
from hardware.arm.protocol import Dialect
from hardware.files.arm_file import read_arm, write_arm
from planning.kinematics import SimpleArm
from planning.limits import Limits


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
        Limits(speed=draw.uniform(1, 100, 6), turn=draw.uniform(0.01, 0.1), surface_turn=draw.uniform(0.1, 1)),
        Dialect(int(draw.integers(2)), ("J5", "J4", "J6"), (1, 10)[int(draw.integers(2))], (0.0, 1500.0)[seed % 2]),
        int(draw.integers(57_600, 1_000_000)),
        draw.uniform(0.01, 0.04),
        draw.uniform(0, 0.5),
        np.stack([np.cumsum(draw.uniform(0.1, 30, 3 + seed % 4)), draw.uniform(0, 9, 3 + seed % 4)], axis=-1),
    )
    file = tmp_path_factory.mktemp("arm") / "arm.toml"
    write_arm(file, profile, "made up\nfor a test")
    assert same(read_arm(file), profile)


def test_what_a_file_leaves_out_keeps_its_default(tmp_path: Path) -> None:
    file = tmp_path / "arm.toml"
    file.write_text("motion_byte = 0\n[limits]\nturn = 1.5\n", encoding="utf-8")
    profile = read_arm(file)
    assert same(profile, ArmProfile(limits=Limits(turn=np.deg2rad(1.5)), dialect=Dialect(0)))


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
        ("", ["empty"]),
        ("baud = ", ["syntax"]),
        ("boud = 9600", ["boud", "did you mean 'baud'"]),
        ("baud = 9600\ntick_s = 0.049", ["tick", "0.05"]),
        ("baud = 4800", ["tick", "0.1"]),
        ("baud = -1", ["baud", ">= 1"]),
        ("motion_byte = 2", ["motion_byte", "0 or 1"]),
        ("origin_scale = 2", ["origin_scale", "1 or 10"]),
        ("pwm = 7", ["pwm", "1500"]),
        ('slots = ["J4", "J4", "J6"]', ["slots", "each once"]),
        ("slots = 3", ["slots"]),
        ("tick_s = nan", ["tick_s", "finite"]),
        ("lag_s = -0.01", ["lag", "0 to 1"]),
        ("lag_s = 1.01", ["lag", "0 to 1"]),
        ("lag_s = 24", [": lag_s = 24, allowed 0 to 1"]),
        ("tick_s = 9", [": tick_s = 9, allowed"]),
        ("home_mm_deg = [0, 0, 9000, 0, 0, 90]", [": home_mm_deg = [0, 0, 9000, 0, 0, 90], allowed", "in degrees"]),
        ("[limits]\nturn = -3", [": limits.turn = -3, allowed > 0"]),
        ("[limits]\nspeed = [-1, 1, 1, 1, 1, 90]", [": limits.speed = [-1, 1, 1, 1, 1, 90], allowed > 0"]),
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
        ("[limits]\njump = -1", ["limits", "jump", "> 0"]),
        ("[limits]\nspead = 1", ["limits.spead", "did you mean 'speed'"]),
    ],
)
def test_faults_are_told_by_file_and_key(tmp_path: Path, text: str, words: list[str]) -> None:
    file = tmp_path / "arm.toml"
    file.write_text(text, encoding="utf-8")
    with pytest.raises(InputError) as caught:
        read_arm(file)
    for word in [str(file), "allowed", *words]:
        assert word in str(caught.value)
