"""Pairing: every frame in exactly one set, and synchronous cameras found again under jitter and drops."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from perception.frames import Frame
from perception.pairing import DEFAULT_PERIOD, frame_period, frame_set, mean_stamp, pair, pairing_tolerance


@dataclass(frozen=True)
class Item:
    camera: int
    stamp: float
    instant: int = 0


times = st.lists(st.floats(-1e3, 1e3), max_size=12, unique=True)


@given(cameras=st.lists(times, min_size=1, max_size=4), tolerance=st.floats(0, 10))
def test_every_frame_is_in_exactly_one_set(cameras: list[list[float]], tolerance: float) -> None:
    items = sorted((Item(c, t) for c, ts in enumerate(cameras) for t in ts), key=lambda i: (i.stamp, i.camera))
    sets = list(pair(items, tolerance, len(cameras)))
    assert sorted((i for s in sets for i in s), key=lambda i: (i.stamp, i.camera)) == items
    for s in sets:
        numbers = [i.camera for i in s]
        assert numbers == sorted(set(numbers))  # one of each camera, in the rig's order
        assert max(i.stamp for i in s) - min(i.stamp for i in s) <= tolerance
    for earlier, later in pairwise(sets):
        assert max(i.stamp for i in earlier) <= min(i.stamp for i in later)


@given(
    period=st.floats(1e-3, 1.0),
    start=st.floats(-1e4, 1e4),
    cameras=st.integers(1, 4),
    count=st.integers(3, 40),
    drop=st.floats(0, 0.3),
    seed=st.integers(0, 2**32 - 1),
)
def test_jittered_synchronous_cameras_with_drops_are_recovered_exactly(
    period: float, start: float, cameras: int, count: int, drop: float, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    jitter = rng.uniform(-0.24, 0.24, (cameras, count)) * period
    kept = rng.random((cameras, count)) >= drop
    items = [
        Item(c, float(start + k * period + jitter[c, k]), k) for c in range(cameras) for k in range(count) if kept[c, k]
    ]
    items.sort(key=lambda i: i.stamp)
    sets = list(pair(items, pairing_tolerance(period), cameras))
    instants = [{i.instant for i in s} for s in sets]
    assert all(len(i) == 1 for i in instants)
    assert [min(i) for i in instants] == [k for k in range(count) if kept[:, k].any()]


@given(period=st.floats(1e-3, 1.0), drop=st.floats(0, 0.25), seed=st.integers(0, 2**32 - 1))
def test_the_period_survives_drops_and_a_slow_camera(period: float, drop: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    grid = np.linspace(0.0, 200 * period, 201)
    fast = grid[rng.random(201) >= drop]
    assert np.isclose(frame_period([fast, grid[::3], grid[:1], grid[:0]]), period)


def test_a_period_that_cannot_be_told_is_the_default() -> None:
    assert frame_period([np.array([1.0]), np.array([])]) == DEFAULT_PERIOD


def test_the_tolerance_is_kept_to_one_epsilon() -> None:
    inside, outside = 0.5, float(np.nextafter(0.5, 1))
    assert len(list(pair([Item(0, 0.0), Item(1, inside)], 0.5, 2))) == 1
    assert len(list(pair([Item(0, 0.0), Item(1, outside)], 0.5, 2))) == 2


def test_a_full_set_is_given_out_before_the_next_frame_is_there() -> None:
    def frames() -> object:
        yield Item(0, 0.0)
        yield Item(1, 0.001)
        raise AssertionError("looked ahead")

    assert len(next(pair(frames(), 0.1, 2))) == 2  # type: ignore[arg-type]


def test_the_stamp_of_a_set_is_the_mean_also_far_from_zero() -> None:
    image = np.zeros((2, 2), np.uint8)
    frames = [Frame(1, 1.7e9 + 0.5, image), Frame(0, 1.7e9, image)]
    made = frame_set(frames)
    assert made.stamp == 1.7e9 + 0.25
    assert [f.camera for f in made.frames] == [0, 1]
    assert mean_stamp([Item(0, 0.1)]) == 0.1
