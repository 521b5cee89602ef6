"""The heap gives free memory back or keeps it, as was asked; quick median and spline are right; what is left out."""

from __future__ import annotations

import ctypes
import subprocess
import sys
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.interpolate import CubicSpline

from estimation.runtime import CubicCurve, median, stub_modules, trim_heap
from tests.campaigns.estimator import resident


def printed(code: str) -> int:
    root = Path(__file__).parents[1]
    done = subprocess.run([sys.executable, "-c", code], cwd=root, capture_output=True, text=True, check=True)
    return int(done.stdout)


@pytest.mark.skipif(not hasattr(ctypes.CDLL(None), "malloc_trim"), reason="this C library does not give back on demand")
def test_what_is_free_below_what_is_in_use_is_given_back() -> None:
    blocks = [bytes(5000) for _ in range(10_000)]  # 50 MB
    last = blocks[-1]
    full = resident()
    blocks.clear()
    trim_heap()
    assert full - resident() > 40.0 and last == bytes(5000)


@pytest.mark.skipif(not hasattr(ctypes.CDLL(None), "mallopt"), reason="this C library cannot be told to keep pages")
def test_pages_that_are_kept_are_not_asked_for_again() -> None:
    code = """
from resource import RUSAGE_SELF, getrusage
from estimation.runtime import retain_freed_pages
retain_freed_pages(2**25)
def fill():
    return [bytearray(b"x") * 2**22 for _ in range(4)]
for _ in range(3):
    fill()
before = getrusage(RUSAGE_SELF).ru_minflt
for _ in range(10):
    fill()
print(getrusage(RUSAGE_SELF).ru_minflt - before)
"""
    assert printed(code) < 1000  # of 40,000 pages that were filled


@pytest.mark.skipif(not hasattr(ctypes.CDLL(None), "mallopt"), reason="this C library cannot be told of its heaps")
def test_threads_that_share_pages_have_no_heap_of_their_own() -> None:
    code = """
from concurrent.futures import ThreadPoolExecutor
from threading import Barrier
from estimation.runtime import use_one_arena
use_one_arena()
before, together = open("/proc/self/maps").read().count("---p"), Barrier(4)
def fill(_):
    together.wait()
    return sum(len(bytes(5000)) for _ in range(1000))
with ThreadPoolExecutor(4) as threads:
    list(threads.map(fill, range(4)))
    print(open("/proc/self/maps").read().count("---p") - before)
"""
    assert printed(code) == 4  # a guard page of each stack; a heap of its own would reserve more


NUMBERS = st.floats(-1e6, 1e6)


@given(st.lists(NUMBERS, min_size=1, max_size=41))
def test_it_is_the_middle_one_and_of_an_even_count_the_upper_of_the_two(values: list[float]) -> None:
    assert median(np.array(values)) == sorted(values)[len(values) // 2]


@pytest.mark.parametrize("place", range(3))
def test_what_is_not_a_number_is_not_hidden(place: int) -> None:
    values = np.arange(3.0)
    values[place] = np.nan
    assert np.isnan(median(values))


@given(st.lists(st.floats(0.01, 1.0), min_size=1, max_size=12), st.booleans(), st.integers(0, 99))
def test_the_cubic_curve_is_scipys_spline(steps: list[float], at_rest: bool, seed: int) -> None:
    knots = np.concatenate([[0.3], 0.3 + np.cumsum(steps)])
    values = np.random.default_rng(seed).normal(size=(len(knots), 2, 3))
    at = np.linspace(knots[0] - 0.1, knots[-1] + 0.1, 57)
    spline = CubicSpline(knots, values, bc_type="clamped" if at_rest else "not-a-knot")
    for found, expected in zip(CubicCurve(knots, values, at_rest)(at), (spline(at), spline(at, 1)), strict=True):
        assert np.abs(found - expected).max() < 1e-12 * np.abs(expected).max()


def test_a_part_that_is_left_out_is_empty_in_its_package_too() -> None:
    code = """
import sys, numpy
from estimation.runtime import stub_modules
with stub_modules("numpy.f2py"):
    assert numpy.f2py.whatever is None
assert "numpy.f2py" not in sys.modules and "f2py" not in vars(numpy)
print(callable(numpy.f2py.get_include) + 0)
"""
    assert printed(code) == 1


def test_what_is_left_out_stands_empty_for_a_while_and_what_was_there_stays() -> None:
    before = sys.modules["numpy"]
    with stub_modules("no_such_package", "no_such_package.part", "numpy"):
        part = import_module("no_such_package.part")
        assert part.whatever is None and sys.modules["numpy"] is before
    assert "no_such_package" not in sys.modules and sys.modules["numpy"] is before
    with pytest.raises(ImportError):
        import_module("no_such_package")
