"""The model of the arm's queue: what it says is under way is what the virtual arm has yet to do."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hardware.arm.protocol import G1, G4, Pause, decode, encode
from hardware.arm.queue import ArmQueue
from hardware.simulator.arm.settings import ArmSettings
from tests.virtual_arm import HOME, virtual_arm

FRAME = 1 / 240
FREE = ArmSettings(servo_lag=0.0, top_turn=1e6)  # as fast as it is told
step = st.floats(-3, 3)
moves = st.tuples(st.lists(step, min_size=6, max_size=6), st.floats(1, 250)).map(
    lambda m: G1(HOME + np.array([*m[0][:3], *np.deg2rad(m[0][3:])]), m[1])
)
scripts = st.lists(st.tuples(st.floats(0, 0.06), st.one_of(moves, moves, st.floats(0.001, 0.05).map(G4))), max_size=12)


@settings(max_examples=80)
@given(scripts, st.floats(0, 0.2))
def test_what_is_under_way_is_what_the_virtual_arm_has_yet_to_do(
    script: list[tuple[float, G1 | G4]], after: float
) -> None:
    arm, queue, now, wire = virtual_arm(FREE), ArmQueue(HOME.tolist(), FRAME, 0.0), 0.0, 0.0
    for wait, command in script:
        now += wait
        told = decode(encode(command))
        assert isinstance(told, G1 | G4)
        queue.add(told, now)
        wire = max(wire, now) + FRAME
        arm.receive(encode(command), wire)
    then = max(now + after, wire)
    arm.advance(then)
    assert queue.in_flight(then) == pytest.approx(arm.in_flight, abs=1e-6)
    assert abs(queue.frames(then - 1e-6) - arm.queued) <= 1  # what ends just now may count in one and not in the other
    assert np.allclose(queue.at(then), arm.axes_at(np.array([then]))[0], atol=1e-4)


@settings(max_examples=60)
@given(scripts, st.floats(0, 0.1))
def test_after_a_stop_it_knows_where_the_set_point_rests(script: list[tuple[float, G1 | G4]], after: float) -> None:
    arm, queue, now, wire = virtual_arm(FREE), ArmQueue(HOME.tolist(), FRAME, 0.0), 0.0, 0.0
    for wait, command in script:
        now += wait
        queue.add(decode(encode(command)), now)  # type: ignore[arg-type]
        wire = max(wire, now) + FRAME
        arm.receive(encode(command), wire)
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
def test_when_it_passed_a_place_last_is_when_its_set_point_was_last_there(
    moves: list[tuple[float, float]], share: float
) -> None:
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
