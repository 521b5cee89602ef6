"""The heap: what is free goes back to the system, even below what is still in use; or stays, where that was asked."""

from __future__ import annotations

import ctypes
import subprocess
import sys
from pathlib import Path

import pytest

from estimation.heap import give_back
from hardware.bench.soak import resident


@pytest.mark.skipif(not hasattr(ctypes.CDLL(None), "malloc_trim"), reason="this C library does not give back on demand")
def test_what_is_free_below_what_is_in_use_is_given_back() -> None:
    blocks = [bytes(5000) for _ in range(10_000)]  # 50 MB
    last = blocks[-1]
    full = resident()
    blocks.clear()
    give_back()
    assert full - resident() > 40.0 and last == bytes(5000)


@pytest.mark.skipif(not hasattr(ctypes.CDLL(None), "mallopt"), reason="this C library cannot be told to keep pages")
def test_pages_that_are_kept_are_not_asked_for_again() -> None:
    code = """
from resource import RUSAGE_SELF, getrusage
from estimation.heap import keep_pages
keep_pages(2**25)
def fill():
    return [bytearray(b"x") * 2**22 for _ in range(4)]
for _ in range(3):
    fill()
before = getrusage(RUSAGE_SELF).ru_minflt
for _ in range(10):
    fill()
print(getrusage(RUSAGE_SELF).ru_minflt - before)
"""
    root = Path(__file__).parents[1]
    done = subprocess.run([sys.executable, "-c", code], cwd=root, capture_output=True, text=True, check=True)
    assert int(done.stdout) < 1000  # of 40,000 pages that were filled


@pytest.mark.skipif(not hasattr(ctypes.CDLL(None), "mallopt"), reason="this C library cannot be told of its heaps")
def test_threads_that_share_pages_have_no_heap_of_their_own() -> None:
    code = """
from concurrent.futures import ThreadPoolExecutor
from threading import Barrier
from estimation.heap import share_pages
share_pages()
before, together = open("/proc/self/maps").read().count("---p"), Barrier(4)
def fill(_):
    together.wait()
    return sum(len(bytes(5000)) for _ in range(1000))
with ThreadPoolExecutor(4) as threads:
    list(threads.map(fill, range(4)))
    print(open("/proc/self/maps").read().count("---p") - before)
"""
    root = Path(__file__).parents[1]
    done = subprocess.run([sys.executable, "-c", code], cwd=root, capture_output=True, text=True, check=True)
    assert int(done.stdout) == 4  # a guard page of each stack; a heap of its own would reserve more
