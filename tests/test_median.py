"""The quick median is the slow one."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from estimation.median import median

NUMBERS = st.floats(-1e6, 1e6)


@given(st.lists(NUMBERS, min_size=1, max_size=41).filter(lambda values: len(values) % 2 == 1))
def test_of_an_odd_count_it_is_the_middle_one(values: list[float]) -> None:
    assert median(np.array(values)) == np.median(values)


@given(st.lists(NUMBERS, min_size=2, max_size=40).filter(lambda values: len(values) % 2 == 0))
def test_of_an_even_count_it_is_the_upper_of_the_two(values: list[float]) -> None:
    assert median(np.array(values)) == sorted(values)[len(values) // 2]


@pytest.mark.parametrize("place", range(3))
def test_what_is_not_a_number_is_not_hidden(place: int) -> None:
    values = np.arange(3.0)
    values[place] = np.nan
    assert np.isnan(median(values))
