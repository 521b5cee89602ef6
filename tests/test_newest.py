"""The newest value between two processes: whole, newest, and nobody waits."""

from __future__ import annotations

import multiprocessing

import numpy as np
import pytest

from estimation.errors import InputError
from hardware.process.shared_latest import Newest
from tests.moving import breathing, pose_at


def test_there_is_nothing_before_the_first_and_then_only_the_newest() -> None:
    newest: Newest[int] = Newest()
    assert newest.get() is None
    for k in range(5):
        newest.put(k)
    assert newest.get() == 4


def test_a_value_is_read_once_and_then_the_same_object() -> None:
    newest: Newest[list[int]] = Newest()
    newest.put([1])
    first = newest.get()
    assert first == [1] and newest.get() is first
    newest.put([1])
    assert newest.get() == [1] and newest.get() is not first


def test_a_pose_comes_through_whole() -> None:
    newest: Newest[object] = Newest()
    pose = pose_at(breathing, 1.0)
    newest.put(pose)
    back = newest.get()
    assert type(back) is type(pose)
    assert np.array_equal(back.base_from_surface, pose.base_from_surface)  # type: ignore[attr-defined]


def test_what_is_too_large_is_refused_and_what_was_there_stays() -> None:
    newest: Newest[bytes] = Newest(100)
    newest.put(b"x" * 50)
    with pytest.raises(InputError, match="at most 100 bytes"):
        newest.put(b"x" * 101)
    assert newest.get() == b"x" * 50


def test_a_torn_value_is_never_taken() -> None:
    newest: Newest[bytes] = Newest(100)
    newest.put(b"first")
    assert newest.get() == b"first"
    newest.put(b"second")
    memory = memoryview(newest._memory).cast("B")
    memory[8 + 16 + 5] ^= 0xFF  # in the slot of even counts
    assert newest.get() == b"first"
    newest.put(b"third")
    assert newest.get() == b"third"


def put_many(newest: Newest[np.ndarray], count: int) -> None:
    for k in range(count):
        newest.put(np.full(5000, k))


def test_what_another_process_writes_as_fast_as_it_can_is_whole_and_never_older() -> None:
    context = multiprocessing.get_context("spawn")
    newest: Newest[np.ndarray] = Newest()
    writer = context.Process(target=put_many, args=(newest, 2000))
    writer.start()
    last, seen = -1, 0
    while last < 1999 and (writer.is_alive() or newest.get() is not None):
        value = newest.get()
        if value is None:
            continue
        assert (value == value[0]).all() and value[0] >= last
        seen += value[0] > last
        last = int(value[0])
    writer.join(10)
    assert last == 1999 and seen > 1
