"""A stop whose frame is lost on the line is said again, and not to an arm that rests."""

from __future__ import annotations

import numpy as np
import pytest

from hardware.arm.protocol import G1, encode
from hardware.arm_insistence import AGAIN, BLIND
from hardware.arm_status import ArmState
from hardware.farewell import farewell
from hardware.link_settings import LinkSettings
from hardware.motion.loop import Order
from hardware.replies import Reply, ReplyKind
from hardware.simulator.arm.ports import PortFaults
from hardware.simulator.arm.settings import ArmSettings, Replies
from tests.linked import Linked, linked
from tests.test_motion_loop import Looping
from tests.virtual_arm import HOME, arm_fault

ANSWERING = ArmSettings(servo_lag=0.02, replies=Replies.STREAM)
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
    after = LOST + AGAIN + ANSWERS + 0.05  # s, the last of it for the frame, the lag and the way to rest
    assert link.virtual.in_flight == 0
    assert 0 < link.executed()[0] - HOME[0] < SPEED * after
    assert link.arm.state is (ArmState.STOPPED if stopped else ArmState.ARMED)


def test_an_arm_that_stops_is_told_once() -> None:
    assert frames_of_a_stop(linked(ANSWERING), 2.0) == 1


@pytest.mark.parametrize("seconds", [(BLIND + 0.5) * AGAIN, 2.0])
def test_an_arm_that_does_not_answer_is_told_a_few_times_more(seconds: float) -> None:
    link = linked()
    assert frames_of_a_stop(link, seconds) == 1 + BLIND
    assert len(link.arm.stops) == 1  # one decision, and how soon it was on the wire


def test_without_the_frame_that_stops_it_nothing_is_said_again() -> None:
    assert frames_of_a_stop(linked(link=LinkSettings(pause_frame=False)), 2.0) == 0


def test_armed_again_it_is_no_longer_told_to_stop() -> None:
    link = linked(ANSWERING)
    assert frames_of_a_stop(link, 1.0) == 1
    assert link.arm.arm(link.clock.now()) == ""
    assert link.follow(1.0) == []
    assert link.virtual.held <= 0.06


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
    assert link.executed()[0] - HOME[0] < SPEED * (LOST + AGAIN + ANSWERS + 0.05)


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
    assert link.arm.frames == before and not link.arm.insists(link.clock.now())


def test_a_stop_while_it_goes_home_stays_a_stop() -> None:
    begin = HOME - [60, 0, 0, 0, 0, 0]
    link = linked(ANSWERING, arm_fault(f"drop at 1s for {LOST}s"), begin=begin, stand=False)
    assert link.arm.stand(begin, 0.0) == ""
    places: list[np.ndarray] = []

    def pose(now: float) -> None:
        if now >= 0.99 and not places:
            astray(link)
            places.append(link.executed())

    Looping({0.4: Order.HOME, 1.01: Order.STOP}, link, pose).run(3.0)  # type: ignore[arg-type]
    assert link.arm.state is ArmState.STOPPED and link.virtual.in_flight == 0
    assert link.executed()[0] - places[0][0] < SPEED * (LOST + AGAIN + ANSWERS + 0.07)


@pytest.mark.parametrize("ends", ["the loop", "a console"])
def test_the_last_stop_of_a_session_is_said_again_too(ends: str) -> None:
    link = linked(ANSWERING, arm_fault("drop at 1s for 0.02s"))
    link.run(0.99)
    astray(link)
    link.run(0.012)
    if ends == "the loop":
        Looping({1.0: Order.QUIT}, link, lambda now: None).run(5.0)  # type: ignore[arg-type, return-value]
    else:
        farewell(link.arm, "interrupted", link.clock, 0.002)
    ended = link.clock.now()
    link.arm.close()
    link.virtual.advance(ended + 0.1)
    assert link.virtual.in_flight == 0 and ended < 1.5


@pytest.mark.parametrize("kind", [ReplyKind.PLACE, ReplyKind.TOOL])
def test_an_arm_that_answers_half_is_told_for_as_long_as_that_half_moves(kind: ReplyKind) -> None:
    link = linked(ANSWERING, arm_fault("drop at 1s for 0.7s"))
    line = link.arm._line
    assert line is not None
    whole = line.receive

    def half() -> tuple[list[Reply], bytes]:
        replies, strays = whole()
        return [reply for reply in replies if reply.kind is kind], strays

    line.receive = half  # type: ignore[method-assign]
    link.run(0.98)
    far = [200, 0, 0, 0, 0, 0] if kind is ReplyKind.PLACE else [0, 0, 0, 0, 0, 1.0]
    link.virtual.receive(encode(G1(HOME + far, SPEED)), link.virtual.now)
    link.run(0.03)
    link.arm.stop("by the operator", link.clock.now())
    link.run(0.5)
    assert link.arm.arm(link.clock.now()) == "the arm still moves"
    link.run(1.0)
    assert link.virtual.in_flight == 0
