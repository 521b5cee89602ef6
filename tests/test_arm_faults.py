"""Each fault of the virtual arm: it happens, it shows, and the arm comes back."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from estimation.errors import InputError
from hardware.arm.protocol import G4, Pause, encode
from hardware.process.faults import Fault, Kind, Part
from hardware.rates import Rates
from hardware.simulator.arm.settings import ArmSettings, Replies
from hardware.simulator.arm_faults import FaultyLine
from tests.virtual_arm import IDEAL, arm_fault, axes_at, motion, move, virtual_arm

# -- names


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("stall 600ms", Fault(Part.ARM, Kind.STALL, 0.0, 0.6)),
        ("stall 1.5s at 3s", Fault(Part.ARM, Kind.STALL, 3.0, 1.5)),
        ("drop", Fault(Part.ARM, Kind.DROP, 0.0, 0.0)),
        ("drop at 3s", Fault(Part.ARM, Kind.DROP, 3.0, 0.0)),
        ("garble at 250ms for 2s", Fault(Part.ARM, Kind.GARBLE, 0.25, 2.0)),
        ("unplug", Fault(Part.ARM, Kind.UNPLUG, 0.0, math.inf)),
        ("unplug at 5s for 2s", Fault(Part.ARM, Kind.UNPLUG, 5.0, 2.0)),
        ("unplug for 2s at 5s", Fault(Part.ARM, Kind.UNPLUG, 5.0, 2.0)),
        ("slow 80%", Fault(Part.ARM, Kind.SLOW, 0.0, math.inf, 80.0)),
        ("slow 12.5% at 2s for 1s", Fault(Part.ARM, Kind.SLOW, 2.0, 1.0, 12.5)),
    ],
)
def test_a_text_names_a_fault(text: str, expected: Fault) -> None:
    assert arm_fault(text) == expected


@pytest.mark.parametrize(
    "text",
    [
        "",
        "  ",
        7,
        "burn",
        "stal 600ms",
        "stall",
        "stall 0ms",
        "stall 600",
        "stall 600ms for 2s",
        "slow",
        "slow 0%",
        "slow 101%",
        "slow 80",
        "slow at 2s",
        "drop at",
        "drop at 3",
        "drop at -3s",
        "drop for 0s",
        "drop at 3s at 4s",
        "drop after 3s",
        "unplug 2s",
        "unplug at 2s for",
    ],
)
def test_what_names_none_is_refused(text: object) -> None:
    with pytest.raises(InputError, match=r"x\.toml: arm\.faults = "):
        arm_fault(text)  # type: ignore[arg-type]


def test_a_name_written_wrong_is_shown_right() -> None:
    with pytest.raises(InputError, match="did you mean 'unplug'"):
        arm_fault("unplugg")


# -- stall and slow


def test_a_stall_stops_a_move_and_then_it_goes_on() -> None:
    arm = virtual_arm(IDEAL, arm_fault("stall 600ms at 1s"))
    arm.receive(move(10.0, x=222.5), 0.0)
    assert arm.in_flight == pytest.approx(2.6)
    assert axes_at(arm, 1.0, 1.3, 1.6, 2.1, 2.6)[:, 0] == pytest.approx([212.5, 212.5, 212.5, 217.5, 222.5])


def test_a_stall_delays_pauses_and_what_comes_meanwhile() -> None:
    arm = virtual_arm(IDEAL, arm_fault("stall 600ms at 1s"))
    arm.receive(encode(G4(1.5)), 0.0)
    arm.receive(move(10.0, x=212.5), 1.2)
    assert axes_at(arm, 2.1, 3.1)[:, 0] == pytest.approx([202.5, 212.5])


def test_a_slow_arm_takes_longer_for_moves_and_not_for_pauses() -> None:
    arm = virtual_arm(IDEAL, arm_fault("slow 80% at 1s for 1s"))
    arm.receive(move(10.0, x=222.5) + encode(G4(1.0)), 0.0)
    assert arm.in_flight == pytest.approx(3.2)
    assert axes_at(arm, 1.0, 2.0, 2.2)[:, 0] == pytest.approx([212.5, 220.5, 222.5])
    always = virtual_arm(IDEAL, arm_fault("slow 50%"))
    always.receive(encode(G4(1.0)) + move(10.0, x=212.5), 0.0)
    assert always.in_flight == pytest.approx(3.0)


def test_a_pause_frame_stops_a_slow_move_where_it_is() -> None:
    arm = virtual_arm(IDEAL, arm_fault("slow 50% at 1s"))
    arm.receive(move(10.0, x=222.5), 0.0)
    arm.receive(encode(Pause()), 1.4)
    assert axes_at(arm, 3.0)[0, 0] == pytest.approx(214.5)


windows = st.lists(
    st.builds(
        Fault,
        st.just(Part.ARM),
        st.sampled_from([Kind.STALL, Kind.SLOW]),
        st.floats(0, 5),
        st.floats(0.01, 2),
        st.floats(10, 100),
    ),
    max_size=4,
)


@given(windows, st.floats(0, 6), st.floats(0, 5), st.booleans())
def test_the_work_done_in_all_stretches_is_the_work_there_was(
    faults: list[Fault], start: float, work: float, moving: bool
) -> None:
    stretches = Rates(faults).stretches(start, work, moving)
    assert stretches[0][0] == start
    assert all(a[1] == b[0] for a, b in pairwise(stretches))
    assert sum((end - begin) * rate for begin, end, rate in stretches) == pytest.approx(work, abs=1e-9)
    slowest = min([f.share for f in faults], default=1.0)
    stalled = sum(f.duration for f in faults)
    assert work - 1e-9 <= stretches[-1][1] - start <= stalled + work / slowest ** len(faults) + 1e-9


# -- the line


def test_a_dropped_frame_is_as_if_it_had_not_been_sent() -> None:
    arm = virtual_arm(IDEAL, arm_fault("drop at 3s"))
    for now, x in [(0.0, 203.5), (3.0, 210.5), (4.0, 204.5)]:
        arm.receive(move(10.0, x=x), now)
    assert (arm.frames, arm.struck, arm.garbage) == (2, [3.0], [])
    assert axes_at(arm, 3.9, 4.1)[:, 0] == pytest.approx([203.5, 204.5])


def test_frames_are_dropped_as_long_as_it_is_said() -> None:
    arm = virtual_arm(IDEAL, arm_fault("drop at 3s for 1s"))
    for now in np.arange(2.0, 5.0, 0.25):
        arm.receive(move(10.0, x=203.5), now)
    assert arm.struck == [3.0, 3.25, 3.5, 3.75]
    assert arm.frames == 8


def test_a_frame_that_has_begun_is_not_dropped() -> None:
    arm, frame = virtual_arm(IDEAL, arm_fault("drop at 3s")), move(10.0, x=203.5)
    arm.receive(frame[:20], 2.999)
    arm.receive(frame[20:] + frame[:5], 3.001)
    arm.receive(frame[5:] + frame, 3.01)
    assert (arm.frames, arm.struck) == (2, [3.001])


def test_a_garbled_frame_is_garbage_or_another_command_and_costs_no_other() -> None:
    refused = executed = 0
    for seed in range(60):
        arm = virtual_arm(ArmSettings(servo_lag=0.0, seed=seed), arm_fault("garble at 1s"))
        arm.receive(move(10.0, x=203.5), 0.0)
        arm.receive(move(10.0, x=204.5), 1.0)
        assert arm.struck == [1.0]
        arm.receive(encode(Pause()) + move(50.0, x=210.5), 1.05)
        assert arm.frames == 3 + (not arm.garbage)
        refused += bool(arm.garbage)
        executed += not arm.garbage
        assert axes_at(arm, 60.0)[0, 0] == pytest.approx(210.5)
    assert refused > 30 and executed > 5  # without a checksum some pass for what was not sent


@given(st.integers(0, 1000), st.lists(st.integers(0, 48), max_size=4))
def test_garbling_flips_one_to_eight_bits_of_one_frame(seed: int, cuts: list[int]) -> None:
    line = FaultyLine([arm_fault("garble at 1s")], np.random.default_rng(seed))
    frame = move(10.0, x=203.5)
    assert line(frame, 0.5) == frame
    edges = [0, *sorted(cuts), 48]
    came = b"".join(line(frame[a:b], 1.0 + a) for a, b in pairwise(edges))
    flipped = sum((a ^ b).bit_count() for a, b in zip(came, frame, strict=True))
    assert 1 <= flipped <= 8
    assert line(frame, 99.0) == frame


def test_nothing_goes_in_or_out_of_an_unplugged_arm_and_then_all_does() -> None:
    settings = ArmSettings(servo_lag=0.0, replies=Replies.STREAM)
    arm = virtual_arm(settings, arm_fault("unplug at 5s for 2s"))
    arm.receive(move(10.0, x=203.5), 4.99)
    assert len(arm.transmit(4.99)) == 99 * 27
    for now in 5.0, 6.0, 6.99:
        arm.receive(move(10.0, x=300.0), now)
        assert arm.transmit(now) == b""
    assert (arm.frames, arm.garbage) == (1, [])
    assert axes_at(arm, 6.995)[0, 0] == pytest.approx(203.5)  # what was queued is done
    arm.receive(move(10.0, x=204.5), 7.0)
    assert axes_at(arm, 7.1)[0, 0] == pytest.approx(204.5)
    assert len(arm.transmit(8.01)) == 21 * 27


def test_a_frame_torn_by_unplugging_costs_no_later_one() -> None:
    arm, frame = virtual_arm(IDEAL, arm_fault("unplug at 1s for 1s")), move(10.0, x=203.5)
    arm.receive(frame[:30], 0.9)
    arm.receive(frame[30:], 1.0)
    arm.receive(move(10.0, x=204.5), 2.0)
    assert [len(data) for _, data in arm.garbage] == [30]
    assert axes_at(arm, 2.2)[0, 0] == pytest.approx(204.5)


def test_faults_are_the_same_for_a_seed() -> None:
    def garbled(seed: int) -> bytes:
        arm = virtual_arm(ArmSettings(seed=seed), arm_fault("garble for 2s"))
        for now in np.arange(0, 3, 0.02):
            arm.receive(move(10.0, x=202.5 + now), now)
        return motion(arm)[1].tobytes()

    assert garbled(3) == garbled(3) != garbled(4)
