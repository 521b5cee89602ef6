"""A stop whose frame is lost on the line is said again, and not to an arm that rests."""

from __future__ import annotations

import pytest

from hardware.arm_insistence import AGAIN, BLIND
from hardware.arm_status import ArmState
from hardware.link_settings import LinkSettings
from hardware.protocol import G1, encode
from hardware.simulator.arm_settings import ArmSettings, Replies
from tests.linked import Linked, linked
from tests.virtual_arm import HOME, arm_fault

ANSWERING = ArmSettings(servo_lag=0.02, replies=Replies.STREAM)
LOST = 0.3  # s for which no frame arrives
ANSWERS = 0.05  # s between them
SPEED = 15.0  # mm/s: in LOST an arm is less far off its way than what stops it for that alone


def astray(link: Linked) -> None:
    """A frame that was damaged on the line sends the arm far away."""
    link.virtual.receive(encode(G1(HOME + [200, 0, 0, 0, 0, 0], SPEED)), link.virtual.now)


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
