"""The oracle of commanded motion counts each limit that is broken, and none that is kept."""

from __future__ import annotations

import numpy as np
import pytest

from hardware.bench.axes_judge import KINDS, AxesJudge
from planning.limits import Limits

TICK = 0.02
WIDE = np.full(6, 1e9)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(("share", "over"), [(1.0, 0), (1.002, 1), (np.nan, 1)])
def test_a_sample_a_hair_over_a_limit_counts_and_one_at_it_does_not(kind: str, share: float, over: int) -> None:
    limits = Limits(WIDE, WIDE, WIDE, 1e9, 1e9)
    step = np.array([0.0, 0, 0, 0, 0.01, 0]) if kind == "turn" else np.array([0.0, 0.01, 0, 0, 0, 0])
    size = 0.01 * share
    bound = {"speed": size / TICK, "acceleration": size / TICK**2, "jerk": size / TICK**3, "jump": size, "turn": size}
    one = 0.01 / size * bound[kind]  # the limit that a step of 0.01 meets
    value = one / share if kind in ("jump", "turn") else np.full(6, one / share)
    named = {f: getattr(limits, f) for f in ("speed", "acceleration", "jerk", "jump", "turn")}
    if np.isnan(share):
        step = step * np.nan
        value = named[kind]
    judge = AxesJudge(np.zeros(6), Limits(**{**named, kind: value}), TICK)
    judge(step)
    assert judge.over[KINDS.index(kind)] == over
    assert judge.samples == 1


def test_rest_after_a_stall_is_no_braking() -> None:
    limits = Limits()
    judge = AxesJudge(np.zeros(6), limits, TICK)
    for k in range(1, 20):
        judge(np.array([1.0 * k, 0, 0, 0, 0, 0]))  # 50 mm/s
    fine = judge.over.copy()
    judge(None)
    assert (judge.over > fine).any()  # it stood from one tick to the next
    judge.rest()
    now = judge.over.copy()
    judge(None)
    assert np.array_equal(judge.over, now)
