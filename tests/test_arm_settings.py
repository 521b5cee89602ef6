"""The table [arm]: what it may say, and what it may not."""

from __future__ import annotations

import numpy as np
import pytest

from estimation.errors import InputError
from hardware.simulator.arm.settings import KEYS, ArmSettings, Replies, arm_settings_from_table

FULL = {
    "fifo": 20,
    "dead_time_s": 0.01,
    "servo_lag_s": 0.0,
    "acceleration_mm_s2": 3000,
    "top_speed_mm_s": 200,
    "top_turn_deg_s": 90,
    "low_mm_deg": [-1, -2, -3, -4, -5, -6],
    "high_mm_deg": [1, 2, 3, 4, 5, 180],
    "replies": "stray",
    "reply_period_s": 0.1,
    "seed": 7,
}


def test_a_table_gives_the_settings_in_mm_s_and_rad() -> None:
    assert set(FULL) == set(KEYS)
    arm = arm_settings_from_table("a.toml", FULL)
    assert (arm.fifo, arm.seed, arm.replies) == (20, 7, Replies.STRAY)
    assert (arm.dead_time, arm.servo_lag, arm.acceleration, arm.reply_period) == (0.01, 0.0, 3000.0, 0.1)
    assert (arm.top_speed, arm.top_turn) == pytest.approx((200, np.pi / 2))
    assert arm.high == pytest.approx([1, 2, 3, *np.deg2rad([4, 5, 180])])


def test_what_a_table_leaves_out_keeps_its_default() -> None:
    arm, default = arm_settings_from_table("a.toml", {}), ArmSettings()
    assert all(np.all(getattr(arm, name) == getattr(default, name)) for name in ArmSettings.__slots__)


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("fifo", 0),
        ("fifo", 1.5),
        ("seed", -1),
        ("dead_time_s", -0.001),
        ("servo_lag_s", "20 ms"),
        ("servo_lag_s", -1e-9),
        ("acceleration_mm_s2", 0),
        ("top_speed_mm_s", 0),
        ("top_turn_deg_s", -1),
        ("low_mm_deg", [0] * 5),
        ("low_mm_deg", [1000, -1, -1, -1, -1, -1]),
        ("high_mm_deg", [1601, 1, 1, 1, 1, 1]),
        ("replies", "on"),
        ("replies", 3),
        ("reply_period_s", 0),
    ],
)
def test_a_wrong_value_is_refused_by_the_name_it_has_in_the_file(key: str, value: object) -> None:
    with pytest.raises(InputError, match=rf"a\.toml: arm\.{key.replace('high', '(low|high)')} = .*allowed"):
        arm_settings_from_table("a.toml", {key: value})


def test_an_unknown_key_is_refused_with_the_nearest_one() -> None:
    with pytest.raises(InputError, match="did you mean 'servo_lag_s'"):
        arm_settings_from_table("a.toml", {"servo_lag": 0.02})
