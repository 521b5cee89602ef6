"""The heap: what is free goes back to the system, even below what is still in use."""

from __future__ import annotations

import ctypes

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
