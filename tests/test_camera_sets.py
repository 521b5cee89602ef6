"""Sets of live cameras whose frames jitter, skip and carry offsets: found whole, never wrong, never waited for long."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hardware.bench.cameras import OFFSETS, PERIOD, Shaking, paired, shown
from hardware.cameras.feed import Arrival
from hardware.cameras.frame_sets import Gathering
from hardware.cameras.phases import KEEP
from perception.frames import Frame

IMAGE = np.zeros((1, 1), np.uint8)


@pytest.mark.parametrize("told", [PERIOD, None])
def test_complete_sets_are_found_and_no_pair_is_wrong_with_offsets_drops_and_jitter(told: float | None) -> None:
    found = paired(shown(np.random.default_rng(8), 1000, Shaking()), OFFSETS, told)
    assert found.complete >= 0.995 and found.wrong == 0
    assert found.wait <= 1.5 * PERIOD


def test_without_the_offsets_the_same_frames_are_torn_apart() -> None:
    frames = shown(np.random.default_rng(8), 300, Shaking())
    assert paired(frames, np.zeros(3)).complete < 0.5


def test_normal_jitter_of_a_seventh_of_a_period_costs_few_sets() -> None:
    found = paired(shown(np.random.default_rng(5), 700, Shaking(normal=True)), OFFSETS)
    assert found.complete >= 0.985 and found.wrong <= 1


def frame(camera: int, stamp: float) -> Arrival:
    return Arrival(Frame(camera, stamp, IMAGE, "driver"), stamp, PERIOD, stamp + 0.03)


def test_offsets_can_be_told_while_running_and_leave_the_stamps_alone() -> None:
    gathering, sizes, stamps = Gathering(2, PERIOD), [], []
    for k in range(60):
        if k == 30:
            gathering.set_offsets([0.0, 0.02])
        for arrival in (frame(0, k * PERIOD), frame(1, k * PERIOD - 0.02)):
            for one in gathering.add(arrival):
                sizes.append((k, len(one.frames)))
                stamps += [f.stamp for f in one.frames if f.camera == 1]
    early = [size for k, size in sizes if k < 30]
    late = [size for k, size in sizes if k > 32]
    assert late == [2] * len(late) and early != [2] * len(early)
    assert set(stamps) <= {k * PERIOD - 0.02 for k in range(60)}


def test_a_missing_camera_holds_no_set_up_for_longer_than_a_period_and_a_half() -> None:
    gathering, waits = Gathering(3, PERIOD), []
    for k in range(60):
        first = frame(0, k * PERIOD)
        for now in np.arange(first.now, first.now + PERIOD, 0.001):
            sets = gathering.add(first) if now == first.now else gathering.due(float(now))
            waits += [float(now) - s.stamp - 0.03 for s in sets]
    assert len(waits) >= 58 and max(waits) <= 1.5 * PERIOD


@given(
    phases=st.lists(st.floats(0, 1), min_size=2, max_size=4),
    drop=st.floats(0, 0.05),
    seed=st.integers(0, 2**32 - 1),
)
@settings(max_examples=15, deadline=None)
def test_cameras_that_run_freely_make_whole_sets_that_spread_as_little_as_they_can(
    phases: list[float], drop: float, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    shots = [
        frame(camera, 5 + (k + phase) * PERIOD)
        for k in range(90)
        for camera, phase in enumerate(phases)
        if rng.random() >= drop
    ]
    gathering, sets = Gathering(len(phases), PERIOD), []
    for shot in sorted(shots, key=lambda shot: shot.now):
        sets += gathering.add(shot)
    settled = sets[len(sets) // 2 :]
    whole = [one for one in settled if len(one.frames) == len(phases)]
    assert len(whole) >= (1 - 3 * len(phases) * max(drop, 0.02)) * len(settled) - 3
    widest = max(max(f.stamp for f in one.frames) - min(f.stamp for f in one.frames) for one in settled)
    assert widest <= (1 - 1 / len(phases) / KEEP) * PERIOD + 1e-6


def test_phases_that_drift_past_each_other_cost_a_set_and_no_more() -> None:
    shots = [frame(0, k * PERIOD) for k in range(900)] + [frame(1, k * PERIOD * 1.001) for k in range(900)]
    gathering, sizes = Gathering(2, PERIOD), []
    for shot in sorted(shots, key=lambda shot: shot.now):
        sizes += [len(one.frames) for one in gathering.add(shot)]
    assert sizes[10:].count(1) <= 6


def test_how_far_a_camera_is_out_of_step_is_told() -> None:
    gathering = Gathering(2, PERIOD)
    for k in range(80):
        for camera, phase in enumerate((0.0, 0.3)):
            gathering.add(frame(camera, 1 + (k + phase) * PERIOD))
    assert gathering.behind == pytest.approx([-0.15 * PERIOD, 0.15 * PERIOD], rel=0.01)


@pytest.mark.parametrize(
    ("phases", "errors"),
    [((0.0, 0.33, 0.66), (0.0, 0.0, 0.0)), ((0.0, 0.3, 0.6), (0.0, 0.005, -0.005)), ((0.0, 0.0, 0.0), tuple(OFFSETS))],
)
def test_what_is_learned_of_sets_and_told_back_shifts_them_once_at_most(
    phases: tuple[float, ...], errors: tuple[float, ...]
) -> None:
    gathering, learned = Gathering(3, PERIOD), np.zeros(3)
    shots = [frame(c, 10 + (k + phase) * PERIOD + 1e-4 * c) for k in range(900) for c, phase in enumerate(phases)]
    spread: list[np.ndarray] = []
    for shot in sorted(shots, key=lambda shot: shot.now):
        for one in gathering.add(shot):
            if len(one.frames) == 3:
                spread.append(np.array([f.stamp for f in one.frames]) - one.stamp)
                late = spread[-1] + errors  # when they really exposed, beside the mean of all
                learned += (late - late.mean() - learned) / 150
            gathering.learn(learned)
    assert len(spread) >= 880
    assert (np.abs(np.diff(spread, axis=0)).max(axis=1) > 0.002).sum() <= 1
