"""Sets of live cameras whose frames jitter, skip and carry offsets: found whole, never wrong, never waited for long."""

from __future__ import annotations

import numpy as np
import pytest

from hardware.bench.cameras import OFFSETS, PERIOD, Shaking, paired, shown
from hardware.cameras.feed import Arrival
from hardware.cameras.gathering import Gathering
from perception.frames import Frame

IMAGE = np.zeros((1, 1), np.uint8)


@pytest.mark.parametrize("told", [PERIOD, None])
def test_complete_sets_are_found_and_no_pair_is_wrong_with_offsets_drops_and_jitter(told: float | None) -> None:
    found = paired(shown(np.random.default_rng(8), 1500, Shaking()), OFFSETS, told)
    assert found.complete >= 0.995 and found.wrong == 0
    assert found.wait <= 1.5 * PERIOD


def test_without_the_offsets_the_same_frames_are_torn_apart() -> None:
    frames = shown(np.random.default_rng(8), 300, Shaking())
    assert paired(frames, np.zeros(3)).complete < 0.5


def test_normal_jitter_of_a_seventh_of_a_period_costs_few_sets() -> None:
    found = paired(shown(np.random.default_rng(5), 1000, Shaking(normal=True)), OFFSETS)
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
