"""The arm on its line: nothing moves unasked, every fault ends at rest with a reason; the model of its queue."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from estimation.errors import InputError
from hardware.arm.device import ArmState
from hardware.arm.driver import G1, G4, Pause, Reply, ReplyKind
from hardware.arm.feedback import LAG_SPREAD
from hardware.arm.profile import ArmProfile, LinkSettings
from hardware.arm.protocol import Dialect, decode, encode
from hardware.arm.queue import ArmQueue, FlowControl
from hardware.simulator.arm.controller import VirtualArm
from hardware.simulator.arm.settings import ArmSettings, ReplyMode
from planning.command import feed_for
from tests.faulty_port import PortFaults
from tests.linked_arm import Linked, circle, linked, moving, waiting
from tests.virtual_arm import HOME, arm_fault, virtual_arm

ANSWERING = ArmSettings(servo_lag=0.02, replies=ReplyMode.STREAM)


def test_nothing_is_sent_before_an_operator_says_so() -> None:
    link = linked(stand=False)
    assert link.arm.state is ArmState.DISARMED
    link.arm.stand(HOME, 0.0)
    command = moving(HOME + 1, 50.0)
    assert "disarmed" in link.arm.send(command, 0.0)
    assert "disarmed" in link.arm.home(0.0)
    link.run(1.0)
    assert (link.virtual.frames, link.arm.frames) == (0, 0)
    assert link.arm.arm(1.0) == "" and link.arm.state is ArmState.ARMED
    assert link.arm.send(command, 1.0) == ""
    link.run(0.5)
    assert link.virtual.frames == 1


def test_an_arm_of_which_nobody_knows_where_it_stands_is_not_armed() -> None:
    link = linked(stand=False)
    assert "nobody knows" in link.arm.arm(0.0)
    with pytest.raises(InputError, match="axes"):
        link.arm.stand(np.full(6, np.nan), 0.0)
    answering = linked(ANSWERING, stand=False)
    answering.run(1.0)
    assert answering.arm.arm(1.0) == "" and answering.arm.target == pytest.approx(HOME, abs=0.05)


def test_an_arm_that_answers_at_rest_from_beside_where_it_is_thought_to_be_is_believed() -> None:
    link = linked(ANSWERING, stand=False, begin=HOME + [0.5, 0, 0, 0, 0, 0])
    link.arm.stand(HOME, 0.0)
    link.run(1.0)
    assert link.arm.arm(1.0, HOME) == "" and link.arm.target == pytest.approx(HOME + [0.5, 0, 0, 0, 0, 0], abs=0.06)
    link.run(0.5)
    assert link.executed() == pytest.approx(HOME, abs=1e-3) and link.virtual.peak_work <= 0.03


def test_disarmed_it_ends_what_is_under_way_and_no_more() -> None:
    link = linked()
    link.follow(1.0)
    frames = link.arm.frames
    link.arm.disarm(1.0)
    assert link.arm.stand(HOME, 1.0) == ""
    link.run(1.0, lambda now: link.arm.send(moving(HOME, 50.0), now) and None)
    assert (link.arm.state, link.arm.frames) == (ArmState.DISARMED, frames)


def test_a_command_that_no_frame_holds_is_not_taken() -> None:
    link = linked()
    for command in (moving(HOME, 0.0), moving(HOME, np.nan), moving(HOME + 1e39, 5.0), waiting(0.0), waiting(np.inf)):
        with pytest.raises(InputError):
            link.arm.send(command, 0.0)
    assert link.arm.frames == 0


def test_a_command_is_sent_in_the_dialect_and_reckoned_as_the_wire_rounds_it() -> None:
    dialect = Dialect(motion_byte=0, slots=("J5", "J4", "J6"))
    link = linked(profile=ArmProfile(dialect=dialect))
    command = moving(HOME + 1 / 3, 100 / 3)
    assert link.arm.send(command, 0.0) == ""
    assert link.arm.command_frame == encode(G1(command.axes, command.feed), dialect)
    told = decode(link.arm.command_frame, dialect)
    assert isinstance(told, G1) and (told.axes != command.axes).any() and (link.arm.target == told.axes).all()


def test_a_command_too_long_or_too_fast_stops_the_arm_and_is_not_sent() -> None:
    far = HOME + [3, 0, 0, 0, 0, 0]
    for wrong in (moving(far, 60.0), waiting(0.05), moving(far, 250.1)):
        link = linked()
        assert "limit" in link.arm.send(wrong, 0.0) and link.arm.state is ArmState.STOPPED
        link.run(0.5)
        assert link.executed() == pytest.approx(HOME)
    exact = 0.05 - 1 / 240
    link = linked()
    assert link.arm.send(waiting(exact * (1 - 1e-6)), 0.0) == ""
    assert "limit" in linked().arm.send(waiting(exact * (1 + 1e-6)), 0.0)


@settings(max_examples=15)
@given(st.lists(st.floats(0.0, 0.1), min_size=5, max_size=40), st.integers(0, 9))
def test_however_it_is_called_no_more_is_under_way_than_may_be(waits: list[float], seed: int) -> None:
    link = linked(port=PortFaults(partial=0.3))
    rng = np.random.default_rng(seed)
    for wait in waits:
        axes = link.arm.target
        step = np.append(rng.normal(size=3), np.zeros(3))
        step *= rng.uniform(0.2, 2.0) / np.linalg.norm(step)
        now = link.clock.now()
        if not link.arm.hold(now):
            link.send(axes + step)
        link.run(wait)
        assert link.arm.in_flight(link.clock.now()) <= 0.05 + 1e-9
    assert link.arm.state is ArmState.ARMED and max(link.deepest, link.virtual.peak_work) <= 0.05 + 1e-9
    link.run(0.3)
    assert link.executed() == pytest.approx(link.arm.target, abs=1e-3)


@settings(max_examples=15)
@given(st.lists(st.floats(0.0, 0.02), min_size=10, max_size=40), st.sampled_from([0.0, 0.3]))
def test_what_the_link_does_not_hold_back_it_takes_and_never_has_to_stop_the_arm(
    waits: list[float], partial: float
) -> None:
    link = linked(port=PortFaults(partial=partial))
    for wait in waits:
        if not link.arm.hold(link.clock.now()):
            assert link.send(link.arm.target + [0.5, 0, 0, 0, 0, 0], link.arm.profile.tick) == ""
        link.run(wait)
    assert link.arm.state is ArmState.ARMED and max(link.deepest, link.virtual.peak_work) <= 0.05 + 1e-9


def test_a_motion_at_the_tick_flows_and_is_where_it_is_reckoned() -> None:
    link = linked()
    assert link.follow(2.0) == [] and not link.virtual.underruns
    now = link.clock.now()
    reckoned = link.arm.reckoned(now + link.arm.profile.lag - link.arm.profile.frame_time)
    assert reckoned is not None and np.allclose(reckoned, link.executed(), atol=1e-3)
    assert link.arm.status(now).queued <= 2


def test_more_frames_than_may_be_are_never_under_way() -> None:
    link, sent = linked(link=LinkSettings(frames=2)), []
    for _ in range(3):
        sent.append(link.arm.send(waiting(0.018), link.clock.now()))
        link.run(0.005)
    assert sent[:2] == ["", ""] and "2 frames are under way, limit 2" in sent[2]


def test_a_frame_waits_for_the_one_on_the_wire_so_that_a_stop_waits_for_no_more_than_one() -> None:
    link = linked()
    assert link.arm.send(waiting(0.001), 0.0) == ""
    assert "48 bytes are on the wire" in link.arm.send(waiting(0.001), 0.0)
    assert link.arm.send(waiting(0.001), 1 / 240) == ""
    link.arm.stop("asked for", 1 / 240)
    decided, on_wire = link.arm.stops[0]
    assert on_wire - decided == pytest.approx(2 / 240)


def test_a_stop_does_not_wait_for_the_queue() -> None:
    link = linked()
    for k in (1, 2):
        assert link.arm.send(moving(HOME + [2 * k, 0, 0, 0, 0, 0], 100.0), (k - 1) / 200) == ""
    link.run(0.010)
    link.arm.stop("asked for", 0.010)
    link.run(1.0)
    decided, on_wire = link.arm.stops[0]
    assert on_wire - decided == pytest.approx(1 / 240)
    assert link.executed()[0] - HOME[0] == pytest.approx(100 * (on_wire - 1 / 240), abs=0.01)
    assert link.arm.target == pytest.approx(link.executed(), abs=0.01)
    assert (link.arm.state, link.arm.reason) == (ArmState.STOPPED, "asked for")
    assert "stopped" in link.arm.send(moving(HOME, 50.0), 1.1)


@pytest.mark.parametrize("end", ["stop", "disarm"])
def test_a_frame_of_which_no_byte_is_gone_goes_out_no_more_once_the_arm_is_to_rest(end: str) -> None:
    link = linked(port=PortFaults(blocked=[(0.0, 0.1)]))
    assert link.arm.send(moving(HOME + [0.5, 0, 0, 0, 0, 0], 25.0), 0.0) == ""
    link.run(0.05)
    if end == "stop":
        link.arm.stop("asked for", 0.05)
    else:
        link.arm.disarm(0.05)
    link.run(0.5)
    assert link.executed() == pytest.approx(HOME, abs=1e-9) and link.arm.target == pytest.approx(HOME)
    assert link.arm.state is (ArmState.STOPPED if end == "stop" else ArmState.DISARMED)


def test_an_arm_that_knows_no_pause_frame_stops_by_an_empty_queue() -> None:
    link = linked(link=LinkSettings(pause_frame=False))
    link.follow(0.5)
    frames = link.virtual.frames
    link.arm.stop("asked for", 0.5)
    link.run(0.5)
    assert link.virtual.frames <= frames + 1 and link.executed() == pytest.approx(link.arm.target, abs=1e-3)


def test_armed_again_it_goes_back_slowly_to_where_the_motion_left_off() -> None:
    link = linked()
    link.follow(1.0)
    left_off = link.arm.target
    assert left_off is not None
    link.arm.stop("asked for", 1.0)
    assert link.arm.arm(1.0, left_off) == "the arm still moves"
    link.run(0.5)
    assert "limit 10 mm" in link.arm.arm(1.5, left_off + [11, 0, 0, 0, 0, 0])
    assert link.arm.arm(1.5, left_off) == "" and link.arm.hold(1.5) == "the arm is on its way"
    link.run(0.5)
    assert link.arm.hold(2.0) == "" and link.executed() == pytest.approx(left_off, abs=1e-3)


def test_home_is_reached_slowly_by_way_of_above_and_never_much_is_under_way() -> None:
    low = HOME + np.array([-30.0, 20, -60, 0.2, 0, 0])
    link = linked(begin=low)
    assert link.arm.home(0.0) == ""
    seen: list[np.ndarray] = []
    link.run(8.0, lambda now: seen.append(link.executed()))
    assert link.arm.arrived(8.0) and link.executed() == pytest.approx(HOME, abs=1e-3)
    path = np.array(seen)
    assert np.linalg.norm(np.diff(path[:, :3], axis=0), axis=1).max() <= 20 * 0.0201
    across = np.abs(path[:, 0] - low[0]) > 1e-3
    assert path[across, 2].min() > HOME[2] - 0.01 and max(link.deepest, link.virtual.peak_work) <= 0.05


def test_a_place_out_of_bounds_is_not_gone_to() -> None:
    link = linked()
    for side in (-1000, 1000):
        assert "out of bounds" in link.arm.go(HOME + [side, 0, 0, 0, 0, 0], 0.0)
    assert "out of bounds" in link.arm.go(np.full(6, np.nan), 0.0) and not link.arm.travels


def test_a_work_origin_changes_what_is_said_and_not_where_it_goes() -> None:
    link = linked(ANSWERING)
    origin = np.array([200.0, 200, 100])
    assert link.arm.set_origin(origin, 0.0) == ""
    link.run(0.1)
    assert link.virtual.origin == pytest.approx(origin)
    refused = []
    link.run(3.0, lambda now: refused.append(link.arm.hold(now) or link.send(circle(now - 0.1))))
    assert not any(refused) and not link.virtual.refused
    link.run(0.5)
    assert link.executed() == pytest.approx(link.arm.target, abs=1e-3)
    assert link.arm.status(link.clock.now()).answered == pytest.approx(link.arm.target, abs=0.06)
    link.send(circle(3.0))
    assert "at rest" in link.arm.set_origin(np.zeros(3), link.clock.now())


def test_answers_give_lag_and_arrival_and_no_doubt_of_an_arm_that_follows() -> None:
    link = linked(ANSWERING)
    assert link.follow(4.0) == []
    status = link.arm.status(4.0)
    assert status.lag == pytest.approx(0.02, abs=0.004) and type(status.lag) is float  # goes into an arm file
    assert status.off < 0.2 and status.answer_rate == pytest.approx(20, rel=0.1) and not link.arm.arrived(4.0)
    link.run(0.5)
    assert link.arm.arrived(link.clock.now())


def test_stray_bytes_are_kept_with_their_instants_and_harm_nothing() -> None:
    link = linked(ArmSettings(replies=ReplyMode.STRAY), port=PortFaults(noise=20.0))
    assert link.follow(5.0) == []
    status = link.arm.status(5.0)
    assert status.strays > 100 and status.answers == 0
    stamps = [stamp for stamp, _ in link.arm.stray_bytes]
    assert stamps == sorted(stamps) and stamps[0] >= 0 and stamps[-1] <= 5.0


@pytest.mark.parametrize("seconds", [0.2, 0.3, 0.6])
def test_what_an_arm_that_stalls_has_queued_is_called_back_and_it_goes_on_by_itself(seconds: float) -> None:
    link = linked(ANSWERING, arm_fault(f"stall {1000 * seconds:g}ms at 2.01s"))
    refused = link.follow(2.01 + seconds)
    assert any("later on its way" in reason or "called back" in reason for reason in refused)
    assert link.virtual.queued_work <= 0.05 and link.virtual.queued <= 4
    assert link.virtual.peak_work < 0.15  # what was sent until an answer told
    link.follow(4.0)
    assert link.arm.state is ArmState.ARMED and link.arm.hold(link.clock.now()) == ""
    assert any("called back" in event.text for event in link.arm.events())
    link.run(0.3)
    assert link.executed() == pytest.approx(link.arm.target, abs=1e-3)
    assert link.virtual.in_flight == 0 and not link.virtual.ignored


def test_without_a_pause_frame_an_arm_that_stalls_is_held_until_it_has_caught_up() -> None:
    link = linked(ANSWERING, arm_fault("stall 600ms at 2s"), link=LinkSettings(pause_frame=False))
    refused = link.follow(6.0)
    assert any("later on its way than its lag, limit 50 ms" in reason for reason in refused)
    assert link.virtual.peak_work < 0.15 and link.arm.state is ArmState.ARMED
    assert link.arm.hold(6.0) == "" and link.arm.status(6.0).off < 0.2


def test_an_arm_that_stalls_on_its_way_home_gets_there() -> None:
    low = HOME + np.array([-20.0, 10, -20, 0, 0, 0])
    link = linked(ANSWERING, arm_fault("stall 600ms at 1s"), begin=low)
    assert link.arm.home(0.0) == ""
    link.run(8.0)
    assert link.virtual.peak_work < 0.16
    assert link.arm.arrived(8.0) and link.executed() == pytest.approx(HOME, abs=1e-3)


def test_an_arm_that_does_not_answer_works_off_what_a_stall_has_queued() -> None:
    link = linked(ArmSettings(servo_lag=0.0), arm_fault("stall 600ms at 1s"))

    def each(now: float) -> None:
        goal = circle(link.phase + 0.02)
        feed = feed_for(link.arm.target, goal, 0.02)
        if not link.arm.hold(now) and not link.arm.send(moving(goal, feed), now):
            link.phase += 0.02

    link.run(1.65, each, tick=0.0201)
    assert link.virtual.queued_work > 0.5  # nothing can tell
    link.run(30.0, each, tick=0.0201)
    assert link.virtual.queued_work <= 0.05


def test_faults_that_pass_each_in_time_do_not_add_up_to_a_stop() -> None:
    stalls = [arm_fault(f"stall 500ms at {second}s") for second in (1, 3, 5)]
    link = linked(ANSWERING, *stalls, link=LinkSettings(patience=1.0))
    link.follow(7.0)
    assert sum("called back" in event.text for event in link.arm.events()) >= 3
    assert link.arm.state is ArmState.ARMED and link.arm.hold(link.clock.now()) == ""


def test_an_arm_that_stays_behind_is_stopped() -> None:
    link = linked(ANSWERING, arm_fault("stall 5s at 1s"))
    link.follow(6.0)
    assert link.arm.state is ArmState.STOPPED and "called back" in link.arm.reason and link.virtual.peak_work < 0.15


@pytest.mark.parametrize(("share", "within"), [(50, 0.25), (70, 0.29), (80, 0.37)])
@pytest.mark.parametrize("begin", [2.0, 2.013, 2.031])
def test_an_arm_that_moves_too_slowly_is_held_before_it_is_far_behind(share: int, within: float, begin: float) -> None:
    link = linked(ANSWERING, arm_fault(f"slow {share}% at {begin}s for 3s"))
    assert link.follow(begin) == [] and any("called back" in reason for reason in link.follow(within))


def test_an_arm_that_runs_away_is_stopped_at_once() -> None:
    link = linked(ANSWERING)
    link.follow(1.0)
    link.virtual.receive(encode(G1(HOME + [200, 0, 0, 0, 0, 0], 200.0)), link.virtual.now)
    link.follow(0.4)
    assert link.arm.state is ArmState.STOPPED and "off its way" in link.arm.reason
    link.run(0.5)
    assert link.executed()[0] - HOME[0] < 60


def test_an_arm_that_falls_silent_is_held_and_then_stopped() -> None:
    link = linked(ANSWERING, arm_fault("unplug at 2s"))
    refused = link.follow(6.0)
    assert any("has not answered for" in reason for reason in refused) and link.arm.state is ArmState.STOPPED
    assert linked().follow(2.0) == []


def test_one_wrong_answer_alone_is_not_believed() -> None:
    link = linked(ANSWERING)
    link.follow(1.0)
    assert link.arm._queue is not None
    link.arm._feedback.take(Reply(ReplyKind.PLACE, HOME[:3] + 100), link.arm._queue, 1.0)
    assert link.arm.hold(1.0) == "" and link.follow(1.0) == []


@pytest.mark.parametrize("off", [3.0, 14.0])
def test_what_was_said_against_an_arm_before_it_was_armed_again_does_not_count(off: float) -> None:
    link = linked(ArmSettings(servo_lag=0.02, replies=ReplyMode.STREAM))
    link.run(1.0)
    link.virtual.receive(encode(G1(HOME + [off, 0, 0, 0, 0, 0], 200.0)), link.virtual.now)
    link.run(0.06)
    link.arm.stop("by the operator", link.clock.now())
    link.run(1.0)
    assert link.arm.arm(link.clock.now()) == "" and link.arm.home(link.clock.now()) == ""
    link.arm.events()
    link.run(3.0)
    assert link.arm.state is ArmState.ARMED and link.arm.events() == []
    assert link.arm.arrived(link.clock.now()) and link.executed() == pytest.approx(HOME, abs=0.01)


FRAME = 1 / 240
FREE = ArmSettings(servo_lag=0.0, top_turn=1e6)  # as fast as it is told
step = st.floats(-3, 3)
moves = st.tuples(st.lists(step, min_size=6, max_size=6), st.floats(1, 250)).map(
    lambda m: G1(HOME + np.array([*m[0][:3], *np.deg2rad(m[0][3:])]), m[1])
)
scripts = st.lists(st.tuples(st.floats(0, 0.06), st.one_of(moves, moves, st.floats(0.001, 0.05).map(G4))), max_size=12)


def played(script: list[tuple[float, G1 | G4]]) -> tuple[VirtualArm, ArmQueue, float, float]:
    """A virtual arm and the model of its queue that were told the same; when, and when the last of it arrived, s."""
    arm, queue, now, wire = virtual_arm(FREE), ArmQueue(HOME.tolist(), FRAME, 0.0), 0.0, 0.0
    for wait, command in script:
        now += wait
        told = decode(encode(command))
        assert isinstance(told, G1 | G4)
        queue.add(told, now)
        wire = max(wire, now) + FRAME
        arm.receive(encode(command), wire)
    return arm, queue, now, wire


@settings(max_examples=80)
@given(scripts, st.floats(0, 0.2))
def test_what_is_in_flight_is_what_the_virtual_arm_has_to_do(script: list[tuple[float, G1 | G4]], after: float) -> None:
    arm, queue, now, wire = played(script)
    then = max(now + after, wire)
    arm.advance(then)
    assert queue.in_flight(then) == pytest.approx(arm.in_flight, abs=1e-6)
    assert abs(queue.frames(then - 1e-6) - arm.queued) <= 1  # what ends just now may count in one and not in the other
    assert np.allclose(queue.at(then), arm.axes_at(np.array([then]))[0], atol=1e-4)


@settings(max_examples=60)
@given(scripts, st.floats(0, 0.1))
def test_after_a_stop_it_knows_where_the_set_point_rests(script: list[tuple[float, G1 | G4]], after: float) -> None:
    arm, queue, now, wire = played(script)
    now = now + after
    queue.occupy(now, 1.0)
    queue.stop()
    arm.receive(encode(Pause()), max(wire, now) + FRAME)
    arm.advance(now + 2)
    assert queue.in_flight(now + 1) == 0
    assert np.allclose(queue.target, arm.axes_at(np.array([now + 1.5]))[0], atol=1e-4)
    assert np.allclose(queue.at(now + 1), queue.target, atol=0)


def test_it_counts_the_wire_and_frames_to_come() -> None:
    queue = ArmQueue(HOME.tolist(), FRAME, 0.0)
    assert (queue.in_flight(0.0), queue.frames(0.0)) == (0.0, 0)
    queue.add(G1(HOME + [2, 0, 0, 0, 0, 0], 100.0), 0.0)
    assert queue.in_flight(0.0) == pytest.approx(FRAME + 0.02)
    assert queue.in_flight_with(0.02, 0.01) == pytest.approx(FRAME + 0.02 + 0.02 - 0.01)
    queue.add(G4(0.01), 0.01)
    assert queue.frames(0.02) == 2 and queue.frames(FRAME + 0.025) == 1
    assert queue.in_flight(0.02) == pytest.approx(FRAME + 0.01)
    assert queue.frames(1.0) == 0 and queue.in_flight(1.0) == 0.0


def test_a_frame_that_goes_in_parts_arrives_when_its_last_part_does() -> None:
    queue = ArmQueue(HOME.tolist(), FRAME, 0.0)
    queue.occupy(0.0, 0.5)
    queue.add(G1(HOME + [1, 0, 0, 0, 0, 0], 50.0), 0.3, left=0.5)
    assert queue.in_flight(0.3) == pytest.approx(FRAME / 2 + 0.02)


def test_bounds_hold_every_set_point_between() -> None:
    queue = ArmQueue(HOME.tolist(), FRAME, 0.0)
    for k in range(60):
        queue.add(G1(HOME + [np.sin(k / 5), 0, 0, 0, 0, 0], 60.0), 0.02 * k)
    low, high = queue.bounds(0.9, 1.1)
    seen = np.array([queue.at(t) for t in np.linspace(0.9, 1.1, 200)])
    assert (seen >= np.array(low) - 1e-9).all() and (seen <= np.array(high) + 1e-9).all()
    assert low[0] == pytest.approx(seen[:, 0].min(), abs=1e-3) and high[0] == pytest.approx(seen[:, 0].max(), abs=1e-3)


@given(st.lists(st.tuples(st.floats(-5, 5), st.floats(5.0, 50.0)), min_size=1, max_size=8), st.floats(0, 1))
def test_the_last_passage_of_a_place_is_its_set_points(moves: list[tuple[float, float]], share: float) -> None:
    queue, now = ArmQueue(HOME.tolist(), 1 / 240, 0.0), 0.0
    for way, feed in moves:
        queue.add(G1(HOME + [way, 0, 0, 0, 0, 0], feed), now)
        now += 0.05
    until = share * queue.in_flight(0.0)
    instants = np.linspace(0.0, until, 2000)
    places = np.array([queue.at(t)[0] for t in instants])
    for place in places[:: len(places) // 7]:
        passed = queue.passed([place, *HOME[1:3]], 0.1, until)
        near = instants[np.abs(places - place) <= 0.1]
        assert passed == pytest.approx(near[-1], abs=2 * until / 2000 + 1e-9)
    assert np.isnan(queue.passed([HOME[0] + 100, *HOME[1:3]], 0.1, until))


def stalled_on_its_way_home(seconds: float, start: float) -> Linked:
    fault = arm_fault(f"stall {1000 * seconds:.0f}ms at {start}s")
    link = linked(ANSWERING, fault, begin=HOME + np.array([60.0, -40, 20, 0, 0, 0]))
    assert link.arm.home(0.0) == ""
    link.run(6.0)
    assert link.arm.arrived(6.0)
    return link


@settings(max_examples=8)
@given(seconds=st.floats(0.02, 0.08), start=st.floats(0.8, 2.0))
def test_a_stall_on_the_way_home_is_not_taken_for_the_lag(seconds: float, start: float) -> None:
    link = stalled_on_its_way_home(seconds, start)
    assert link.arm.lag == pytest.approx(0.02, abs=0.004)


def test_a_lag_that_was_learned_of_a_stalled_arm_alone_is_learned_anew() -> None:
    link = stalled_on_its_way_home(0.06, 0.05)  # before its first answer: nothing tells it from a slow servo
    assert link.arm.lag > 0.05
    link.follow(3.0)
    assert link.arm.lag == pytest.approx(0.02, abs=0.004)


@settings(max_examples=8)
@given(seconds=st.floats(0.012, 0.029), start=st.floats(2.0, 2.1))
def test_the_backlog_is_never_taken_for_more_than_it_is(seconds: float, start: float) -> None:
    stall = arm_fault(f"stall {1000 * seconds:.1f}ms at {start}s")  # less than what is called back
    link = linked(ANSWERING, stall, link=LinkSettings(flight=0.036))
    link.follow(1.9)
    known, waited = [], 0
    for _ in range(40):  # ticks
        waited += len(link.follow(0.02))
        true = link.virtual.in_flight - link.arm.in_flight(link.clock.now())
        known.append(link.backlog)
        assert known[-1] <= max(true, 0.0) + LAG_SPREAD
    assert waited <= 2, "what it has made good while nothing was sent is known before its next answer"
    assert waited or seconds < 0.022


def test_what_a_stall_piled_up_counts_as_motion_under_way() -> None:
    flow, queue = FlowControl(ArmProfile(), LinkSettings()), ArmQueue(HOME.tolist(), 0.004, 0.0)
    line = linked().arm.driver
    assert flow.full(line, queue, 0.02, 0.0) == flow.full(line, queue, 0.02, 0.0, 0.02) == ""
    assert "under way" in flow.full(line, queue, 0.02, 0.0, 0.03)
    link = linked(ANSWERING, arm_fault("stall 28ms at 2s"))  # less than what is called back
    assert link.follow(2.0) == []
    assert link.follow(0.15) == []
    assert 0.02 < link.backlog < 0.035
    assert "under way" in str(link.follow(0.3)) and link.arm.lag == pytest.approx(0.02, abs=0.004)
    link.follow(1.0)
    assert link.backlog < 0.022  # with a tick of 24 ms no more than 50 ms are under way
