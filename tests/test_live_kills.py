"""When an arm came to rest after a kill, as the bench tells it from what a virtual arm has executed."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from hardware.bench.live_kills import SHORTEST, STILL, WITHIN, Kills, rest

STEP, END = 0.002, 3.0
STAMPS = np.arange(0.0, END, STEP)


@given(st.floats(1.0, END + 0.5), st.floats(1.0, 60.0))
def test_it_rests_from_when_it_stays_where_it_ended(stop: float, speed: float) -> None:
    axes = np.zeros((len(STAMPS), 6))
    axes[:, 1] = speed * np.minimum(STAMPS, stop)
    found, arrived = rest(STAMPS, axes, 1.0), max(stop - 1.0 - STILL / speed, 0.0)
    if found == np.inf:
        assert stop > END - SHORTEST - 2 * STEP
    else:
        assert abs(found - arrived) <= 2 * STEP


def test_an_arm_that_stood_all_the_time_rests_at_once_and_a_turning_tool_moves_no_arm() -> None:
    axes = np.zeros((len(STAMPS), 6))
    axes[:, 5] = STAMPS
    assert rest(STAMPS, axes, 1.0) == 0.0


def test_what_an_arm_that_moved_on_has_left_is_kept(tmp_path: Path) -> None:
    left, kept = tmp_path / "left", tmp_path / "kept"
    left.mkdir()
    kept.mkdir()
    kills = Kills(kept)
    for name, rested in (("a", WITHIN / 2), ("b", WITHIN * 1.1)):
        (left / f"{name}.mcap").write_bytes(b"x")
        kills.rests.append(rested)
        kills.keep(left / f"{name}.mcap", "feed", 3.0)
    assert sorted(file.name for file in kept.iterdir()) == ["b.mcap", "kills.csv"]
    assert (kept / "kills.csv").read_text().splitlines()[1:] == ["a.mcap,feed,0.250,3.000", "b.mcap,feed,0.550,3.000"]
