"""Faults of the port, and what is settled about the link: each happens here, ends at rest and is said."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from estimation.errors import InputError
from hardware.arm.device import ArmState
from hardware.arm.driver import Reply, ReplyKind, UnpluggedError
from hardware.arm.jog import lifted_travel_steps, travel_steps
from hardware.arm.link import Arm
from hardware.arm.profile import ArmProfile, LinkSettings, at_baud
from hardware.arm.protocol import encode_reply
from hardware.arm.s6h4d import S6H4D
from hardware.simulator.arm.ports import VirtualPort
from hardware.simulator.arm.settings import ArmSettings, ReplyMode
from planning.command import feed_for
from tests.faulty_port import PortFaults
from tests.linked_arm import circle, linked, moving, waiting
from tests.virtual_arm import HOME, arm_fault

ANSWERING = ArmSettings(servo_lag=0.02, replies=ReplyMode.STREAM)


def test_partial_writes_change_nothing_that_arrives() -> None:
    link = linked(port=PortFaults(partial=0.5))
    link.follow(3.0)
    assert link.arm.state is ArmState.ARMED
    link.run(0.2)
    assert link.virtual.garbage == [] and link.virtual.frames == link.arm.frames > 100
    assert link.executed() == pytest.approx(link.arm.target, abs=1e-3)


def test_a_port_that_takes_nothing_for_a_moment_is_a_hold() -> None:
    link = linked(port=PortFaults(blocked=[(1.0, 1.15)]))
    refused = link.follow(2.0)
    assert any("taken no bytes" in reason for reason in refused)
    assert link.arm.state is ArmState.ARMED and len(refused) < 12
    assert max(link.deepest, link.virtual.peak_work) <= 0.05


@pytest.mark.parametrize("partial", [0.0, 0.9])
def test_a_port_that_takes_nothing_for_long_is_a_stop_and_a_torn_frame_is_completed(partial: float) -> None:
    link = linked(port=PortFaults(blocked=[(1.0, 1.6)], partial=partial))
    link.follow(1.5)
    assert link.arm.state is ArmState.STOPPED and "took no bytes" in link.arm.reason
    link.run(0.5)
    assert link.virtual.garbage == [] and link.arm.frames == link.virtual.frames
    assert link.executed() == pytest.approx(link.arm.target, abs=1e-3) and link.virtual.peak_work <= 0.05


def gone(data: bytes) -> int:
    raise UnpluggedError("the device is gone")


def test_a_port_that_goes_while_a_wrong_origin_is_stopped_is_an_arm_unplugged(monkeypatch: pytest.MonkeyPatch) -> None:
    link = linked(ANSWERING)
    link.run(0.5)
    line = link.arm.driver
    monkeypatch.setattr(line.port, "write", gone)
    monkeypatch.setattr(line, "receive", lambda: ([Reply(ReplyKind.ORIGIN, np.array([5.0, 0, 0]))], b""))
    link.arm.poll(link.clock.now())
    assert link.arm.state is ArmState.UNPLUGGED and "gone" in link.arm.reason


def test_a_port_that_goes_while_an_arm_is_asked_to_obey_is_an_arm_unplugged(monkeypatch: pytest.MonkeyPatch) -> None:
    link = linked(ANSWERING, arm_fault("drop at 1s for 900ms"))
    link.follow(1.4)
    line, frames = link.arm.driver, link.arm.frames
    monkeypatch.setattr(line.port, "write", gone)
    link.run(0.2)
    assert link.arm.frames == frames and any("gone" in event.text for event in link.arm.events())


@pytest.mark.slow
@settings(max_examples=40)
@given(blocked=st.floats(0.84, 0.98), stalls=st.floats(0.80, 0.96))
def test_a_step_home_that_waited_in_the_port_when_called_back_is_made_after_all(blocked: float, stalls: float) -> None:
    port = PortFaults(blocked=[(blocked, blocked + 0.15)])
    link = linked(ANSWERING, arm_fault(f"stall 200ms at {stalls}s"), port=port)
    goal = HOME + [8, 0, 0, 0, 0, 0]
    link.run(0.5)
    assert link.arm.go(goal, link.clock.now()) == ""
    link.run(3.0)
    assert link.arm.arrived(link.clock.now()) and link.executed() == pytest.approx(goal, abs=0.05)


def test_bytes_that_wait_in_the_port_are_a_hold() -> None:
    link = linked()
    port = link.arm.driver.port
    port.waiting = lambda: 500
    assert "500 bytes wait" in link.arm.hold(0.0)


def test_a_device_that_was_away_is_found_again_and_moves_only_when_armed_anew() -> None:
    link = linked(port=PortFaults(away=[(1.0, 3.0)]))
    link.follow(2.0)
    assert link.arm.state is ArmState.UNPLUGGED
    assert "unplugged" in link.arm.hold(2.0) and link.arm.arm(2.0) != ""
    link.follow(2.0)
    assert link.arm.state is ArmState.DISARMED
    assert "nobody knows" in link.arm.arm(4.0)
    frames = link.virtual.frames
    link.follow(1.0)
    assert link.virtual.frames == frames
    link.arm.stand(link.executed(), 5.0)
    assert link.arm.arm(5.0) == ""
    texts = [event.text for event in link.arm.events()]
    assert [text.split(":")[0] for text in texts] == ["disarmed", "armed", "unplugged", "disarmed", "armed"]


def test_a_device_that_is_not_there_is_waited_for() -> None:
    link = linked(port=PortFaults(away=[(0.0, 1.2)]), stand=False)
    assert link.arm.state is ArmState.UNPLUGGED
    link.run(2.0)
    assert link.arm.state is ArmState.DISARMED


def test_every_fault_of_the_line_ends_at_rest() -> None:
    for text in ("drop at 1s for 1s", "garble at 1s for 1s", "unplug at 1s for 1s", "stall 600ms at 1s"):
        link = linked(ANSWERING, arm_fault(text))
        link.follow(4.0)
        link.arm.stop("the end", link.clock.now())
        link.run(1.0)
        before = link.executed()
        link.run(1.0)
        assert np.array_equal(before, link.executed()) or np.allclose(before, link.executed(), atol=1e-6)
        assert not link.virtual.ignored


@pytest.mark.parametrize("name", ["flight", "frames", "poll", "off", "patience"])
def test_settings_of_the_link_are_checked(name: str) -> None:
    for wrong in (0.0, -1.0, np.nan):
        with pytest.raises(InputError, match=name):
            LinkSettings(**{name: wrong})
    with pytest.raises(InputError, match="ease"):
        LinkSettings(ease=0.2)


def test_a_slower_line_leaves_room_for_less() -> None:
    slow = ArmProfile(baud=24_000)  # 20 ms a frame
    assert linked(profile=slow).arm.send(waiting(0.0299), 0.0) == ""
    assert "limit 50 ms" in linked(profile=slow).arm.send(waiting(0.0301), 0.0)


def test_at_9600_bits_a_second_one_frame_is_on_the_wire_and_one_move_in_the_arm() -> None:
    slow = at_baud(ArmProfile(), 9600)
    assert (slow.frame_time, slow.tick) == (0.05, 0.05)
    link = linked(profile=slow)
    refused: list[str] = []

    def each(now: float) -> None:
        goal = circle(link.phase + 0.05)
        feed = feed_for(link.arm.target, goal, 0.05)
        if reason := link.arm.hold(now) or link.arm.send(moving(goal, feed), now):
            refused.append(reason)
        else:
            link.phase += 0.05

    link.run(10.0, each, tick=0.05025)
    assert not refused and link.arm.state is ArmState.ARMED and link.arm.frames > 195
    assert link.virtual.peak_work <= 0.05 and link.deepest <= 0.1 + 1e-5 and link.virtual.peak_commands <= 2
    link.arm.stop("asked for", link.clock.now())
    decided, on_wire = link.arm.stops[0]
    assert on_wire - decided <= 2 * slow.frame_time + 1e-9
    assert linked(profile=slow).arm.send(waiting(0.05), 0.0) == ""
    assert "limit 100" in linked(profile=slow).arm.send(waiting(0.0501), 0.0)


@pytest.mark.parametrize("off", [0.02, 0.3, 0.9])
def test_an_arm_that_stands_a_hair_beside_where_it_is_thought_to_is_not_sent_there_for_minutes(off: float) -> None:
    link = linked(begin=HOME + [off, 0, 0, 0.001, 0, 0], stand=False)
    link.arm.stand(HOME, 0.0)
    for goal in (HOME, HOME + [0.001, 0, 0, 0, 0, 0], HOME + [0, 0.0, 0, 1e-6, 0, 0]):
        assert link.arm.arm(link.clock.now(), goal) == ""
        link.run(0.3)
        assert link.arm.hold(link.clock.now()) == "" and link.virtual.in_flight == 0
        assert link.executed() == pytest.approx(goal, abs=1e-4)
        link.arm.disarm(link.clock.now())
    assert link.virtual.peak_work <= 0.05


def test_travel_ends_at_its_goal_and_no_step_is_faster_than_asked() -> None:
    rng = np.random.default_rng(0)
    for way in (travel_steps, lifted_travel_steps):
        start, goal = HOME + rng.normal(size=6) * [20, 20, 20, 0.2, 0.2, 0.2], HOME
        steps = [step.axes for step in way(start, goal, 20.0, 0.3, 0.02)]
        moved = np.diff([start, *steps], axis=0)
        assert np.array_equal(steps[-1], goal) and np.linalg.norm(moved[:, :3], axis=1).max() <= 20 * 0.02 + 1e-9
        assert np.linalg.norm(moved[:, 3:], axis=1).max() <= 0.3 * 0.02 + 1e-9


def test_an_origin_that_is_not_the_one_it_was_told_stops_it() -> None:
    link = linked()
    port = link.arm.driver.port
    answers = [encode_reply(Reply(ReplyKind.ORIGIN, place)) for place in (np.array([0.1, 0, 0]), HOME[:3])]
    port.read = lambda: answers.pop(0) if answers else b""
    link.arm.poll(0.0)
    assert link.arm.state is ArmState.ARMED  # a count of rounding
    link.arm.poll(0.001)
    assert link.arm.state is ArmState.STOPPED and "origin" in link.arm.reason


def test_a_device_that_another_program_took_meanwhile_is_waited_for() -> None:
    link = linked(port=PortFaults(away=[(1.0, 1.2)]))
    taken = [InputError("arm", "port", "x", "a port that is free")]

    def opener() -> VirtualPort:
        if taken:
            raise taken.pop()
        return link.device()

    link.arm.driver.opener = opener
    link.run(1.9)
    assert link.arm.state is ArmState.UNPLUGGED and "a port that is free" in link.arm.reason
    link.run(0.6)
    assert link.arm.state is ArmState.DISARMED
    with pytest.raises(InputError):  # at the very first there is nothing to wait for
        taken.append(InputError("arm", "port", "x", "a port that is free"))
        Arm(S6H4D(opener, ArmProfile()), ArmProfile(), 0.0)


def test_a_device_that_goes_while_a_frame_is_given_out_is_unplugged_and_nothing_is_thought_sent() -> None:
    link = linked()
    link.device.away = [(0.0, 1.0)]
    frames = link.arm.frames
    assert link.arm.send(moving(HOME + [1, 0, 0, 0, 0, 0], 50.0), 0.0) == ""
    assert link.arm.state is ArmState.UNPLUGGED and link.arm.frames == frames and link.arm.target is None
    link.arm.stop("too late", 0.01)
    assert link.arm.state is ArmState.UNPLUGGED


def test_closed_it_is_not_opened_again() -> None:
    link = linked()
    link.arm.close()
    link.run(2.0)
    assert link.arm.state is ArmState.UNPLUGGED and link.arm.reason == "closed"


def test_an_arm_turned_off_its_way_is_held() -> None:
    link = linked(ANSWERING)
    link.follow(1.0)
    for _ in range(2):
        tool = Reply(ReplyKind.TOOL, HOME[3:] + np.deg2rad([0, 3.0, 0]))
        link.arm._feedback.take(tool, link.arm._queue, link.clock.now())
    assert "degrees off its way, limit 2 degrees" in link.arm.hold(link.clock.now())
    link.run(0.5)
    assert link.arm.take_up() is not None and link.arm.hold(link.clock.now()) == ""
