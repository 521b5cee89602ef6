"""Pairing: every frame in exactly one set, and synchronous cameras found again under jitter and drops."""

from __future__ import annotations

from dataclasses import dataclass
from heapq import heapify, heappop, heappush
from itertools import pairwise

import numpy as np
from hypothesis import assume, given
from hypothesis import strategies as st

from perception.frames import (
    DEFAULT_PERIOD,
    DELAY_SAMPLES,
    SILENT_PERIODS,
    Frame,
    FrameSet,
    Pairing,
    frame_period,
    frame_set,
    mean_stamp,
    pair,
    pairing_tolerance,
)


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
    each = [(c, k) for c in range(cameras) for k in range(count) if kept[c, k]]
    items = [Item(c, float(start + k * period + jitter[c, k]), k) for c, k in each]
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

    assert len(next(pair(frames(), 0.1, 2))) == 2


def test_the_stamp_of_a_set_is_the_mean_also_far_from_zero() -> None:
    image = np.zeros((2, 2), np.uint8)
    frames = [Frame(1, 1.7e9 + 0.5, image), Frame(0, 1.7e9, image)]
    made = frame_set(frames)
    assert made.stamp == 1.7e9 + 0.25 and [f.camera for f in made.frames] == [0, 1]
    assert mean_stamp([Item(0, 0.1)]) == 0.1


IMAGE = np.zeros((1, 1), np.uint8)
PERIOD = 0.04


def live(arrivals: list[tuple[float, Frame]], cameras: int) -> tuple[list[tuple[float, FrameSet]], Pairing]:
    """Sets with the instants at which they come out, from frames with theirs; nobody looks later than needed."""
    pairing, out = Pairing(cameras, PERIOD), []
    moments: list[tuple[float, int, Frame | None]] = [(now, i, frame) for i, (now, frame) in enumerate(arrivals)]
    heapify(moments)
    while moments:
        now, i, frame = heappop(moments)
        out += [(now, s) for s in (pairing.due(now) if frame is None else pairing.add(frame, now))]
        if frame is not None:
            heappush(moments, (now + pairing.patience, i + len(arrivals), None))
    return out, pairing


def shaken(seed: int, cameras: int, count: int, jitter: float, way: float, drop: float) -> list[tuple[float, Frame]]:
    """Arrivals of synchronous cameras: stamps off by `jitter`, ways longer by up to `way`, a share dropped."""
    rng = np.random.default_rng(seed)
    out, last = [], [-1.0] * cameras
    for k in range(count):
        for camera in range(cameras):
            stamp = k * PERIOD + rng.uniform(-jitter, jitter)
            arrival = max(last[camera] + 1e-6, k * PERIOD + 0.03 + rng.uniform(0, way))
            if rng.random() >= drop:
                last[camera] = arrival
                out.append((arrival, Frame(camera, float(stamp), IMAGE)))
    return sorted(out, key=lambda a: a[0])


@given(seed=st.integers(0, 2**32 - 1), cameras=st.integers(1, 4), way=st.floats(0, 0.1), drop=st.floats(0, 0.6))
def test_live_sets_rise_hold_a_frame_once_and_never_wait(seed: int, cameras: int, way: float, drop: float) -> None:
    arrivals = shaken(seed, cameras, 30, 0.018, way, drop)
    out, pairing = live(arrivals, cameras)
    frames = [f for _, s in out for f in s.frames]
    assert len({id(f) for f in frames}) == len(frames)
    assert len(frames) + pairing.late == len(arrivals)
    arrived = {id(frame): now for now, frame in arrivals}
    for now, s in out:
        assert now <= min(arrived[id(f)] for f in s.frames) + PERIOD + pairing_tolerance(PERIOD) + 1e-12
        assert all(now >= arrived[id(f)] for f in s.frames)
        stamps = [f.stamp for f in s.frames]
        assert max(stamps) - min(stamps) <= pairing_tolerance(PERIOD)
        assert [f.camera for f in s.frames] == sorted({f.camera for f in s.frames})
    for (_, earlier), (_, later) in pairwise(out):
        assert max(f.stamp for f in earlier.frames) < max(f.stamp for f in later.frames)
        assert earlier.stamp < later.stamp


@given(seed=st.integers(0, 2**32 - 1), cameras=st.integers(1, 4), drop=st.floats(0, 0.4))
def test_live_sets_are_the_recordings_where_frames_are_hardly_late(seed: int, cameras: int, drop: float) -> None:
    arrivals = shaken(seed, cameras, 30, 0.0095, 0.0195, drop)
    by_camera = [[now for now, frame in arrivals if frame.camera == camera] for camera in range(cameras)]
    gap = max(np.diff(times).max(initial=0.0) for times in by_camera)
    assume(gap < SILENT_PERIODS * PERIOD)  # else: not waited for
    out, pairing = live(arrivals, cameras)
    in_order = sorted((f for _, f in arrivals), key=lambda f: f.stamp)
    recorded = list(pair(in_order, pairing_tolerance(PERIOD), cameras))
    online = [[(f.camera, f.stamp) for f in frames.frames] for _, frames in out]
    assert pairing.late == 0 and online == [[(f.camera, f.stamp) for f in frames] for frames in recorded]


def test_a_full_set_comes_out_with_its_last_frame_and_not_a_moment_later() -> None:
    out, _ = live([(0.03, Frame(0, 0.0, IMAGE)), (0.031, Frame(1, 0.0, IMAGE)), (0.035, Frame(2, 0.001, IMAGE))], 3)
    assert [now for now, _ in out] == [0.035]


def test_a_dead_camera_delays_a_few_sets_by_half_a_period_and_then_none() -> None:
    arrivals = [(k * PERIOD + 0.03 + 0.001 * c, Frame(c, k * PERIOD, IMAGE)) for k in range(20) for c in range(2)]
    out, _ = live(arrivals, 3)
    waits = np.array([now - s.stamp for now, s in out]) - 0.031  # after the second camera's frame
    waiting = round(SILENT_PERIODS)
    assert len(out) == 20
    assert np.allclose(waits[:waiting], PERIOD / 2 - 0.001) and np.allclose(waits[waiting + 1 :], 0)
    back = [*arrivals, *((k * PERIOD + 0.033, Frame(2, k * PERIOD, IMAGE)) for k in range(12, 20))]
    out, pairing = live(sorted(back, key=lambda a: a[0]), 3)
    assert [len(s.frames) for _, s in out] == [2] * 13 + [3] * 7  # its first frame comes after its set has gone
    assert pairing.late == 1


def test_a_set_without_a_dropped_frame_leaves_when_that_camera_has_a_younger_one() -> None:
    pairing = Pairing(2, PERIOD)
    pairing.patience = 10.0
    assert not pairing.add(Frame(0, 0.0, IMAGE), 0.03)
    (left,) = pairing.add(Frame(1, PERIOD, IMAGE), 0.07)
    assert [f.camera for f in left.frames] == [0]
    (full,) = pairing.add(Frame(0, PERIOD, IMAGE), 0.08)
    assert [f.camera for f in full.frames] == [0, 1]


def test_a_frame_of_a_set_that_has_gone_is_counted_and_left_out() -> None:
    pairing = Pairing(2, PERIOD)
    pairing.add(Frame(0, 1.0, IMAGE), 1.03)
    assert len(pairing.due(1.03 + pairing.patience)) == 1 and not pairing.add(Frame(1, 1.001, IMAGE), 1.06)
    assert pairing.late == 1


def late_by(delays: list[float], count: int = 40) -> list[tuple[float, Frame]]:
    """Frames of one stamp each time, that arrive so late by camera, s."""
    return sorted(
        ((k * PERIOD + 0.03 + d, Frame(c, k * PERIOD, IMAGE)) for k in range(count) for c, d in enumerate(delays)),
        key=lambda a: a[0],
    )


@given(delay=st.floats(0, 0.99), other=st.floats(0, 0.99))
def test_a_camera_that_is_always_late_is_soon_waited_for(delay: float, other: float) -> None:
    """Where stamps do not tell that a camera exposes later than the others, only its frames' arrival does."""
    assume(min(abs(delay - 0.5), abs(other - 0.5)) > 1e-6)  # at the deadline itself, rounding decides
    out, _ = live(late_by([0.0, delay * PERIOD, other * PERIOD]), 3)
    assert all(len(s.frames) == 3 for _, s in out[DELAY_SAMPLES + 1 :])


def test_one_frame_that_is_late_makes_nobody_wait_for_the_next() -> None:
    arrivals = late_by([0.0, 0.001, 0.002])
    stuck = [(now + 0.03 * (f.camera == 2 and 0.4 < f.stamp < 0.49), f) for now, f in arrivals]
    _, pairing = live(sorted(stuck, key=lambda a: a[0]), 3)
    assert pairing.patience == pairing_tolerance(PERIOD) and pairing.late == 2
