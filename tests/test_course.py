"""The course of a run: bounded, whatever its length, and nothing of what matters is lost in its bins."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hardware.live.course import BINS, SHORTEST, Course

TICK = 0.05  # s


@given(seconds=st.floats(0.1, 400.0), seed=st.integers(0, 1000))
def test_the_largest_error_and_the_time_of_holds_stay_where_they_were(seconds: float, seed: int) -> None:
    draw, course = np.random.default_rng(seed), Course()
    stamps = 1000.0 + np.arange(0.0, seconds, TICK)
    error = np.where(draw.random(len(stamps)) < 0.3, np.nan, draw.exponential(0.1, len(stamps)))
    held = np.where(np.isnan(error), TICK, 0.0)
    for tick in zip(stamps.tolist(), error.tolist(), held.tolist(), strict=True):
        course.add(*tick)
    known = len(course.stamps)
    assert known <= BINS == len(course.error) == len(course.held)
    assert course.stamps[-1] == pytest.approx(stamps[-1] - stamps[0], abs=course.width)
    assert course.width == SHORTEST or seconds > BINS / 2 * course.width
    assert course.held.sum() == pytest.approx(held.sum()) and not course.held[known:].any()
    if np.isfinite(error).any():
        largest = np.nanargmax(error)
        assert np.nanmax(course.error) == error[largest]
        where = course.stamps[np.nanargmax(course.error[:known])]
        assert where == pytest.approx(stamps[largest] - stamps[0], abs=course.width)
    else:
        assert np.isnan(course.error).all()
