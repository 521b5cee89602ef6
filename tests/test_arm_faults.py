"""Each fault of the virtual arm happens, shows, and the arm comes back; a lost stop is sent again."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from estimation.errors import InputError
from hardware.arm.device import BLIND_RESENDS, RESEND_AFTER, ArmState
from hardware.arm.driver import G1, G4, Pause, Reply, ReplyKind
from hardware.arm.link import shut_down
from hardware.arm.profile import LinkSettings
from hardware.arm.protocol import encode
from hardware.motion.loop import Order
from hardware.process.faults import Fault, FaultKind, FaultPart, WorkRates
from hardware.simulator.arm.settings import ArmSettings, FaultyLine, ReplyMode
from tests.faulty_port import PortFaults
from tests.linked_arm import Linked, linked
from tests.test_motion_loop import Looping
from tests.virtual_arm import HOME, IDEAL, arm_fault, axes_at, motion, move, virtual_arm


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("stall 600ms", Fault(FaultPart.ARM, FaultKind.STALL, 0.0, 0.6)),
        ("stall 1.5s at 3s", Fault(FaultPart.ARM, FaultKind.STALL, 3.0, 1.5)),
        ("drop", Fault(FaultPart.ARM, FaultKind.DROP, 0.0, 0.0)),
        ("drop at 3s", Fault(FaultPart.ARM, FaultKind.DROP, 3.0, 0.0)),
        ("garble at 250ms for 2s", Fault(FaultPart.ARM, FaultKind.GARBLE, 0.25, 2.0)),
        ("unplug", Fault(FaultPart.ARM, FaultKind.UNPLUG, 0.0, math.inf)),
        ("unplug at 5s for 2s", Fault(FaultPart.ARM, FaultKind.UNPLUG, 5.0, 2.0)),
        ("unplug for 2s at 5s", Fault(FaultPart.ARM, FaultKind.UNPLUG, 5.0, 2.0)),
        ("slow 80%", Fault(FaultPart.ARM, FaultKind.SLOW, 0.0, math.inf, 80.0)),
        ("slow 12.5% at 2s for 1s", Fault(FaultPart.ARM, FaultKind.SLOW, 2.0, 1.0, 12.5)),
    ],
)
def test_a_text_names_a_fault(text: str, expected: Fault) -> None:
    assert arm_fault(text) == expected


@pytest.mark.parametrize(
    "text",
    [
        *("", "  ", 7, "burn", "stal 600ms", "stall", "stall 0ms", "stall 600", "stall 600ms for 2s"),
        *("slow", "slow 0%", "slow 101%", "slow 80", "slow at 2s", "unplug 2s", "unplug at 2s for"),
        *("drop at", "drop at 3", "drop at -3s", "drop for 0s", "drop at 3s at 4s", "drop after 3s"),
    ],
)
def test_what_names_none_is_refused(text: object) -> None:
    with pytest.raises(InputError, match=r"x\.toml: arm\.faults = "):
        arm_fault(text)


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
        st.just(FaultPart.ARM),
        st.sampled_from([FaultKind.STALL, FaultKind.SLOW]),
        st.floats(0, 5),
        st.floats(0.01, 2),
        st.floats(10, 100),
    ),
    max_size=4,
)


@given(windows, st.floats(0, 6), st.floats(0, 5), st.booleans())
def test_the_work_of_all_stretches_is_the_whole(faults: list[Fault], start: float, work: float, moving: bool) -> None:
    stretches = WorkRates(faults).stretches(start, work, moving)
    assert stretches[0][0] == start and all(a[1] == b[0] for a, b in pairwise(stretches))
    assert sum((end - begin) * rate for begin, end, rate in stretches) == pytest.approx(work, abs=1e-9)
    slowest = min([f.share for f in faults], default=1.0)
    stalled = sum(f.duration for f in faults)
    assert work - 1e-9 <= stretches[-1][1] - start <= stalled + work / slowest ** len(faults) + 1e-9


def test_a_dropped_frame_is_as_if_it_had_not_been_sent() -> None:
    arm = virtual_arm(IDEAL, arm_fault("drop at 3s"))
    for now, x in [(0.0, 203.5), (3.0, 210.5), (4.0, 204.5)]:
        arm.receive(move(10.0, x=x), now)
    assert (arm.frames, arm.faulty_frames, arm.garbage) == (2, [3.0], [])
    assert axes_at(arm, 3.9, 4.1)[:, 0] == pytest.approx([203.5, 204.5])


def test_frames_are_dropped_as_long_as_it_is_said() -> None:
    arm = virtual_arm(IDEAL, arm_fault("drop at 3s for 1s"))
    for now in np.arange(2.0, 5.0, 0.25):
        arm.receive(move(10.0, x=203.5), now)
    assert arm.faulty_frames == [3.0, 3.25, 3.5, 3.75] and arm.frames == 8


def test_a_frame_that_has_begun_is_not_dropped() -> None:
    arm, frame = virtual_arm(IDEAL, arm_fault("drop at 3s")), move(10.0, x=203.5)
    arm.receive(frame[:20], 2.999)
    arm.receive(frame[20:] + frame[:5], 3.001)
    arm.receive(frame[5:] + frame, 3.01)
    assert (arm.frames, arm.faulty_frames) == (2, [3.001])


def test_a_garbled_frame_is_garbage_or_another_command_and_costs_no_other() -> None:
    refused = executed = 0
    for seed in range(60):
        arm = virtual_arm(ArmSettings(servo_lag=0.0, seed=seed), arm_fault("garble at 1s"))
        arm.receive(move(10.0, x=203.5), 0.0)
        arm.receive(move(10.0, x=204.5), 1.0)
        assert arm.faulty_frames == [1.0]
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
    assert 1 <= flipped <= 8 and line(frame, 99.0) == frame


def test_nothing_goes_in_or_out_of_an_unplugged_arm_and_then_all_does() -> None:
    settings = ArmSettings(servo_lag=0.0, replies=ReplyMode.STREAM)
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
    assert [len(data) for _, data in arm.garbage] == [30] and axes_at(arm, 2.2)[0, 0] == pytest.approx(204.5)


def test_faults_are_the_same_for_a_seed() -> None:
    def garbled(seed: int) -> bytes:
        arm = virtual_arm(ArmSettings(seed=seed), arm_fault("garble for 2s"))
        for now in np.arange(0, 3, 0.02):
            arm.receive(move(10.0, x=202.5 + now), now)
        return motion(arm)[1].tobytes()

    assert garbled(3) == garbled(3) != garbled(4)


ANSWERING = ArmSettings(servo_lag=0.02, replies=ReplyMode.STREAM)
LOST = 0.3  # s for which no frame arrives
ANSWERS = 0.05  # s between them
SPEED = 15.0  # mm/s: in LOST an arm is less far off its way than what stops it for that alone


def astray(link: Linked) -> None:
    """A frame that was damaged on the line sends the arm far away."""
    link.virtual.receive(encode(G1(link.executed() + [200, 0, 0, 0, 0, 0], SPEED)), link.virtual.now)


def frames_of_a_stop(link: Linked, seconds: float) -> int:
    """How many frames the arm is sent within `seconds` of an operator's stop on its way."""
    link.follow(1.0)
    before = link.arm.frames
    link.arm.stop("by the operator", link.clock.now())
    link.run(seconds)
    return link.arm.frames - before


@pytest.mark.parametrize("stopped", [False, True], ids=["called back", "stopped"])
def test_an_arm_that_did_not_hear_it_rests_as_soon_as_frames_arrive_again(stopped: bool) -> None:
    link = linked(ANSWERING, arm_fault(f"drop at 1s for {LOST}s"))
    link.run(0.98)
    astray(link)
    link.run(0.03)
    if stopped:
        link.arm.stop("by the operator", link.clock.now())
    link.run(2.0)
    after = LOST + RESEND_AFTER + ANSWERS + 0.05  # s, the last of it for the frame, the lag and the way to rest
    assert link.virtual.in_flight == 0 and 0 < link.executed()[0] - HOME[0] < SPEED * after
    assert link.arm.state is (ArmState.STOPPED if stopped else ArmState.ARMED)


def test_an_arm_that_stops_is_told_once() -> None:
    assert frames_of_a_stop(linked(ANSWERING), 2.0) == 1


@pytest.mark.parametrize("seconds", [(BLIND_RESENDS + 0.5) * RESEND_AFTER, 2.0])
def test_an_arm_that_does_not_answer_is_told_a_few_times_more(seconds: float) -> None:
    link = linked()
    assert frames_of_a_stop(link, seconds) == 1 + BLIND_RESENDS
    assert len(link.arm.stops) == 1  # one decision, and how soon it was on the wire


def test_without_the_frame_that_stops_it_nothing_is_said_again() -> None:
    assert frames_of_a_stop(linked(link=LinkSettings(pause_frame=False)), 2.0) == 0


def test_armed_again_it_is_no_longer_told_to_stop() -> None:
    link = linked(ANSWERING)
    assert frames_of_a_stop(link, 1.0) == 1
    assert link.arm.arm(link.clock.now()) == ""
    assert link.follow(1.0) == [] and link.virtual.queued_work <= 0.06


@pytest.mark.parametrize("after", [0.0, 0.03, 0.25])
@pytest.mark.parametrize("stopped", [False, True], ids=["called back", "stopped"])
def test_an_arm_that_is_disarmed_before_it_heard_the_stop_is_still_told(stopped: bool, after: float) -> None:
    link = linked(ANSWERING, arm_fault(f"drop at 1s for {LOST}s"))
    link.run(0.98)
    astray(link)
    link.run(0.03 if stopped else 0.2)
    if stopped:
        link.arm.stop("by the operator", link.clock.now())
    link.run(after)
    link.arm.disarm(link.clock.now())
    link.run(2.0)
    assert link.arm.state is ArmState.DISARMED and link.virtual.in_flight == 0
    assert link.executed()[0] - HOME[0] < SPEED * (LOST + RESEND_AFTER + ANSWERS + 0.05)


def test_a_stop_that_waits_in_the_port_goes_out_though_the_arm_is_disarmed() -> None:
    link = linked(ANSWERING, port=PortFaults(blocked=[(1.0, 1.15)]))
    link.run(0.98)
    astray(link)
    link.run(0.03)
    link.arm.stop("by the operator", link.clock.now())
    link.run(0.02)
    link.arm.disarm(link.clock.now())
    link.run(2.0)
    assert link.virtual.in_flight == 0
    ((decided, on_wire),) = link.arm.stops
    assert decided == pytest.approx(1.01) and 1.15 < on_wire < 1.17


def test_an_arm_that_was_disarmed_at_rest_is_sent_nothing() -> None:
    link = linked(ANSWERING)
    link.follow(1.0)
    link.arm.stop("by the operator", link.clock.now())
    link.run(1.0)
    before = link.arm.frames
    link.arm.disarm(link.clock.now())
    link.run(1.0)
    assert link.arm.frames == before and not link.arm.stop_pending(link.clock.now())


def test_a_stop_while_it_goes_home_stays_a_stop() -> None:
    begin = HOME - [60, 0, 0, 0, 0, 0]
    link = linked(ANSWERING, arm_fault(f"drop at 1s for {LOST}s"), begin=begin, stand=False)
    assert link.arm.stand(begin, 0.0) == ""
    places: list[np.ndarray] = []

    def pose(now: float) -> None:
        if now >= 0.99 and not places:
            astray(link)
            places.append(link.executed())

    Looping({0.4: Order.HOME, 1.01: Order.STOP}, link, pose).run(3.0)
    assert link.arm.state is ArmState.STOPPED and link.virtual.in_flight == 0
    assert link.executed()[0] - places[0][0] < SPEED * (LOST + RESEND_AFTER + ANSWERS + 0.07)


@pytest.mark.parametrize("ends", ["the loop", "a console"])
def test_the_last_stop_of_a_session_is_said_again_too(ends: str) -> None:
    link = linked(ANSWERING, arm_fault("drop at 1s for 0.02s"))
    link.run(0.99)
    astray(link)
    link.run(0.012)
    if ends == "the loop":
        Looping({1.0: Order.QUIT}, link, lambda now: None).run(5.0)
    else:
        shut_down(link.arm, "interrupted", link.clock, 0.002)
    ended = link.clock.now()
    link.arm.close()
    link.virtual.advance(ended + 0.1)
    assert link.virtual.in_flight == 0 and ended < 1.5


@pytest.mark.parametrize("kind", [ReplyKind.PLACE, ReplyKind.TOOL])
def test_an_arm_that_answers_half_is_told_for_as_long_as_that_half_moves(kind: ReplyKind) -> None:
    link = linked(ANSWERING, arm_fault("drop at 1s for 0.7s"))
    line = link.arm.driver
    whole = line.receive

    def half() -> tuple[list[Reply], bytes]:
        replies, strays = whole()
        return [reply for reply in replies if reply.kind is kind], strays

    line.receive = half
    link.run(0.98)
    far = [200, 0, 0, 0, 0, 0] if kind is ReplyKind.PLACE else [0, 0, 0, 0, 0, 1.0]
    link.virtual.receive(encode(G1(HOME + far, SPEED)), link.virtual.now)
    link.run(0.03)
    link.arm.stop("by the operator", link.clock.now())
    link.run(0.5)
    assert link.arm.arm(link.clock.now()) == "the arm still moves"
    link.run(1.0)
    assert link.virtual.in_flight == 0
