"""The virtual arm: its axes do what its line is sent, however the bytes come; the servo follows it late."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from estimation.errors import InputError
from estimation.se3 import Array
from hardware.arm.driver import G1, G4, G54, Pause, ReplyKind
from hardware.arm.protocol import THESIS_DIALECT, ControllerReset, Dialect, Mode, Reset, encode, reply_stream
from hardware.simulator.arm.controller import Polyline, Servo, VirtualArm
from hardware.simulator.arm.settings import ArmSettings, ReplyMode
from planning.command import MIN_TRAVEL
from tests.virtual_arm import HOME, IDEAL, axes_at, motion, move, virtual_arm

step = st.integers(-160, 160).map(lambda eighths: eighths / 8)  # exact in binary32
targets = st.lists(step, min_size=6, max_size=6).map(lambda s: HOME + np.array([*s[:3], *np.deg2rad(s[3:])]))
moves = st.tuples(targets, st.integers(1, 300)).map(lambda m: G1(*m))
commands = st.one_of(moves, moves, st.floats(0.001, 0.5).map(G4), st.sampled_from([Pause(), Reset(), Mode(9)]))
scripts = st.lists(st.tuples(st.floats(0, 0.3), commands), min_size=1, max_size=12)
ARMS = st.sampled_from(
    [
        IDEAL,
        ArmSettings(),
        ArmSettings(dead_time=0.013),
        ArmSettings(replies=ReplyMode.STRAY),
        ArmSettings(replies=ReplyMode.STREAM),
    ]
)


def far(before: G1 | None, after: G1) -> bool:
    """Whether there is a way in X Y Z from one target, or from home, to the next."""
    start = HOME if before is None else before.axes
    return bool(np.linalg.norm((after.axes - start)[:3]) > 0.01)


@settings(max_examples=60)
@given(st.lists(moves, min_size=1, max_size=8).filter(lambda path: all(far(a, b) for a, b in pairwise([None, *path]))))
def test_every_target_is_reached_in_a_straight_line_at_its_feed(path: list[G1]) -> None:
    arm = virtual_arm()
    arm.receive(b"".join(map(encode, path)), 1.0)
    start, begin = HOME, 1.0
    for each in path:
        way = each.axes - start
        duration = max(np.linalg.norm(way[:3]) / min(each.feed, 250), np.abs(way[3:]).max() / np.pi)
        arm.advance(begin + duration)
        passed = arm.axes_at(begin + duration * np.array([0, 0.5, 1]))
        assert passed == pytest.approx(start + way * np.array([[0], [0.5], [1]]), abs=1e-6)
        start, begin = each.axes, begin + duration
    assert arm.in_flight == pytest.approx(0, abs=1e-6)


@settings(max_examples=80)
@given(scripts, ARMS, st.lists(st.integers(0, 48), max_size=5), st.lists(st.floats(0, 1), max_size=4))
def test_neither_the_split_of_bytes_nor_who_looks_when_changes_the_motion(
    script: list[tuple[float, G1]], chosen: ArmSettings, cuts: list[int], looks: list[float]
) -> None:
    plain, watched = virtual_arm(chosen), virtual_arm(chosen)
    now, sent, got = 0.0, b"", b""
    for wait, command in script:
        for share in sorted(looks):
            got += watched.transmit(now + share * wait)
            watched.axes_at(np.array([now + share * wait]))
        now += wait
        frame = encode(command)
        plain.receive(frame, now)
        for start, end in pairwise([0, *sorted(cuts), 48]):
            watched.receive(frame[start:end], now)
    for arm in plain, watched:
        arm.advance(now + 1)
    sent, got = plain.transmit(now + 1), got + watched.transmit(now + 1)
    assert sent == got and motion(plain)[1].tobytes() == motion(watched)[1].tobytes()
    assert (plain.frames, plain.ignored, plain.underruns) == (watched.frames, watched.ignored, watched.underruns)


@pytest.mark.parametrize("length", [0.0, 0.5 * MIN_TRAVEL])
def test_a_turn_with_next_to_no_way_takes_the_time_that_its_feed_in_degrees_says(length: float) -> None:
    arm = virtual_arm()
    arm.receive(move(25.0, x=HOME[0] + length, c=0.5), 0.0)  # 0.5 degrees at 25 degrees/s
    assert arm.in_flight == pytest.approx(0.02) and axes_at(arm, 0.01)[0, 5] == pytest.approx(0.25)


@settings(max_examples=60)
@given(scripts, ARMS)
def test_what_has_been_executed_never_changes(script: list[tuple[float, G1]], chosen: ArmSettings) -> None:
    arm, now = virtual_arm(chosen), 0.0
    seen: list[tuple[float, list[float]]] = []
    for wait, command in script:
        now += wait
        arm.receive(encode(command), now)
        seen.append((now, arm.axes_at(np.array([now]))[0].tolist()))
    arm.advance(now + 1)
    for instant, axes in seen:
        assert np.abs(arm.axes_at(np.array([instant]))[0] - axes).max() < 1e-9


@settings(max_examples=60)
@given(scripts)
def test_the_setpoint_has_no_jump_and_keeps_the_top_speeds(script: list[tuple[float, G1]]) -> None:
    arm, now = virtual_arm(), 0.0
    for wait, command in script:
        now += wait
        arm.receive(encode(command), now)
    arm.advance(now + 5)
    stamps, axes = motion(arm)
    change = np.diff(axes, axis=0) / np.diff(stamps)[:, None]
    assert np.linalg.norm(change[:, :3], axis=1).max() <= 250 * (1 + 1e-6)
    assert np.abs(change[:, 3:]).max() <= np.pi * (1 + 1e-6)


@settings(max_examples=40)
@given(scripts, st.binary(max_size=100).filter(lambda b: not {0xEE, 0xFC} & set(b)))
def test_noise_between_frames_changes_no_motion(script: list[tuple[float, G1]], noise: bytes) -> None:
    plain, noisy = virtual_arm(), virtual_arm()
    now = 0.0
    for wait, command in script:
        now += wait
        plain.receive(encode(command), now)
        noisy.receive(noise + encode(command), now)
    for arm in plain, noisy:
        arm.advance(now + 1)
    assert motion(plain)[1].tobytes() == motion(noisy)[1].tobytes()
    assert b"".join(data for _, data in noisy.garbage) == noise * len(script)


def test_no_move_is_faster_than_the_arm() -> None:
    arm = virtual_arm()
    arm.receive(move(1000.0, x=302.5), 0.0)
    assert arm.in_flight == pytest.approx(100 / 250)
    arm.receive(move(1000.0, x=302.501, c=90), 0.0)
    assert arm.in_flight == pytest.approx(100 / 250 + 0.5)


def test_a_pause_of_the_queue_waits_its_turn() -> None:
    arm = virtual_arm()
    arm.receive(move(10.0, x=212.5) + encode(G4(0.5)) + move(10.0, x=222.5), 0.0)
    assert arm.queued == 3
    assert axes_at(arm, 1.0, 1.25, 1.5, 2.0)[:, 0] == pytest.approx([212.5, 212.5, 212.5, 217.5])
    assert arm.queued == 1


def test_a_work_origin_moves_the_moves_after_it() -> None:
    arm = virtual_arm()
    arm.receive(move(10.0, x=212.5) + encode(G54(np.array([200.0, 225, 113]))), 0.0)
    arm.receive(encode(G1(np.array([2.5, 0, 0, 0, 0, 0]), 10.0)), 0.5)
    assert axes_at(arm, 1.0, 2.0)[:, :3] == pytest.approx(np.array([[212.5, 225, 113], [202.5, 225, 113]]))


def test_targets_and_origins_out_of_reach_are_refused() -> None:
    arm = virtual_arm()
    arm.receive(move(10.0, x=1000.0), 0.0)
    assert arm.queued == 1 and not arm.refused
    arm.receive(move(10.0, x=1000.1) + move(10.0, c=180.1) + encode(G54(np.array([0, 0, 501.0]))), 0.5)
    assert arm.refused == [0.5] * 3 and arm.queued == 1 and not arm.origin.any()


def test_the_fifo_holds_200_commands_and_ignores_the_rest() -> None:
    arm = virtual_arm()
    arm.receive(b"".join(move(10.0, x=202.5 + k) for k in range(1, 206)), 0.0)
    assert (arm.queued, len(arm.ignored), arm.frames) == (200, 5, 205) and arm.in_flight == pytest.approx(20.0)
    arm.receive(move(10.0, y=226.0), 0.05)
    assert len(arm.ignored) == 6
    arm.receive(move(10.0, x=402.5, y=226.0), 0.2)
    assert (arm.queued, len(arm.ignored)) == (199, 6) and axes_at(arm, 30.0)[0, :2] == pytest.approx([402.5, 226])


def test_a_queue_that_runs_dry_within_a_motion_is_an_underrun() -> None:
    arm = virtual_arm()
    arm.receive(move(10.0, x=203.5), 0.0)  # until 0.1
    arm.receive(move(10.0, x=204.5), 0.1)  # just in time
    arm.receive(move(10.0, x=205.5), 0.25)  # late
    assert arm.underruns == pytest.approx([0.2])
    arm.receive(encode(G4(0.1)), 0.3)  # a stop that was asked for
    arm.receive(move(10.0, x=206.5), 1.0)
    assert len(arm.underruns) == 1


@pytest.mark.parametrize("frame", [Pause(), Reset(), ControllerReset()])
def test_a_stop_does_not_wait_behind_the_queue(frame: Pause | Reset | ControllerReset) -> None:
    arm = virtual_arm()
    arm.receive(b"".join(move(10.0, x=202.5 + k) for k in range(1, 201)), 0.0)
    arm.receive(encode(frame), 1.234)
    assert (arm.queued, arm.in_flight) == (0, 0.0)
    assert axes_at(arm, 1.234, 5.0)[:, 0] == pytest.approx([214.84, 214.84])
    arm.receive(move(10.0, x=204.84), 6.0)
    assert arm.in_flight == pytest.approx(1.0) and axes_at(arm, 6.5, 7.0)[:, 0] == pytest.approx([209.84, 204.84])
    assert not arm.underruns


def test_only_a_controller_reset_takes_origin_and_mode_back() -> None:
    arm = virtual_arm()
    arm.receive(encode(G54(np.array([1.0, 2, 3]))) + encode(Mode(9)) + encode(Reset()) + encode(Pause()), 0.0)
    assert (arm.origin.tolist(), arm.mode) == ([1, 2, 3], 9)
    arm.receive(encode(ControllerReset()), 0.0)
    assert (arm.origin.tolist(), arm.mode) == ([0, 0, 0], 0)


def test_another_dialect_is_garbage_to_it() -> None:
    arm = virtual_arm()
    arm.receive(encode(G1(HOME + 1, 10.0), Dialect(motion_byte=0)) + move(10.0, x=203), 0.5)
    assert (arm.frames, arm.queued) == (1, 1) and [(now, len(data)) for now, data in arm.garbage] == [(0.5, 48)]


def test_replies_give_place_and_angles_every_period() -> None:
    arm = VirtualArm(ArmSettings(servo_lag=0.0, replies=ReplyMode.STREAM), THESIS_DIALECT, HOME)
    arm.receive(encode(G54(np.array([200.0, 200, 100]))) + encode(G1(np.array([12.5, 25, 13, 0.1, 0, 0]), 10.0)), 0.0)
    assert arm.transmit(0.05) == b""  # on the line, which takes 2.3 ms
    replies, stray = reply_stream()(arm.transmit(0.5) + arm.transmit(0.6))
    assert not stray and [reply.kind for reply in replies] == [ReplyKind.PLACE, ReplyKind.TOOL, ReplyKind.ARM] * 11
    assert replies[0].values == pytest.approx([3.0, 25, 13]) and replies[30].values == pytest.approx([8.0, 25, 13])
    assert replies[31].values == pytest.approx([0.055, 0, 0], abs=1e-4) and not replies[32].values.any()


def test_a_line_too_slow_for_the_period_skips_replies_and_tears_none() -> None:
    arm = VirtualArm(ArmSettings(replies=ReplyMode.STREAM, reply_period=0.01), THESIS_DIALECT, HOME, baud=9600)
    replies, stray = reply_stream()(arm.transmit(3.0))
    assert not stray
    assert len(replies) == pytest.approx(3 * 100, abs=3)  # every third period


def test_stray_bytes_come_one_by_one_at_random_and_are_the_same_for_a_seed() -> None:
    def strays(seed: int) -> list[tuple[float, bytes]]:
        arm = virtual_arm(ArmSettings(replies=ReplyMode.STRAY, seed=seed))
        times = np.arange(1, 20_001) / 1000
        return [(now, data) for now in times.tolist() if (data := arm.transmit(now))]

    first = strays(0)
    assert 300 < len(first) < 500
    assert {len(data) for _, data in first} == {1, 2}  # now and then two in a millisecond
    assert len({data for _, data in first}) > 100
    assert np.std(np.diff([now for now, _ in first])) == pytest.approx(0.05, rel=0.2)
    assert strays(0) == first != strays(1)


def test_an_arm_that_sends_nothing_sends_nothing() -> None:
    assert virtual_arm().transmit(10.0) == b""


@pytest.mark.parametrize("home", [np.zeros(5), np.array([np.nan, 0, 0, 0, 0, 0])])
def test_a_home_that_makes_no_sense_is_refused(home: np.ndarray) -> None:
    with pytest.raises(InputError, match="home"):
        VirtualArm(IDEAL, THESIS_DIALECT, home)


GRID = np.arange(3001) * 0.001
slopes = st.lists(st.floats(-100, 100), min_size=6, max_size=6)
stretches = st.lists(st.tuples(st.floats(0.001, 0.4), slopes), min_size=1, max_size=8)


def line_of(parts: list[tuple[float, list[float]]]) -> Polyline:
    """A line from home at 0 s: for so many s at such a slope, one after the other, then rest."""
    line, now, axes = Polyline(0.0, HOME), 0.0, HOME
    for duration, slope in parts:
        line.append(now, axes, np.array(slope))
        now, axes = now + duration, axes + duration * np.array(slope)
    line.append(now, axes, np.zeros(6))
    return line


def executed(line: Polyline, dead_time: float = 0.0, tau: float = 0.0) -> Array:
    return Servo(line, dead_time, tau).at(GRID, 3.0)


@settings(max_examples=25)
@given(stretches)
def test_without_dead_time_and_lag_it_is_the_setpoint_itself(parts: list[tuple[float, list[float]]]) -> None:
    line = line_of(parts)
    assert (executed(line) == line.at(GRID)).all()


@settings(max_examples=25)
@given(stretches, st.integers(1, 300), st.sampled_from([0.0, 0.02]))
def test_dead_time_shifts(parts: list[tuple[float, list[float]]], late: int, tau: float) -> None:
    line = line_of(parts)
    shifted = executed(line, late / 1000, tau)
    assert (shifted[:late] == HOME).all() and np.abs(shifted[late:] - executed(line, 0.0, tau)[:-late]).max() < 1e-9


@settings(max_examples=20)
@given(stretches, st.floats(0.002, 0.3))
def test_lag_is_the_solution_of_its_equation(parts: list[tuple[float, list[float]]], tau: float) -> None:
    line = line_of(parts)
    fine = np.arange(30_001) * 0.0001
    y, u = Servo(line, 0.0, tau).at(fine, 3.0), line.at(fine)
    rise = np.cumsum((((u - y)[1:] + (u - y)[:-1]) / 2) * 0.0001 / tau, axis=0)
    assert np.abs(y[1:] - (HOME + rise)).max() < 1e-3


def test_a_line_that_stops_is_cut_at_that_instant() -> None:
    line = line_of([(1.0, [10.0] * 6), (1.0, [20.0] * 6)])
    line.stop(1.5)
    assert line.at(np.array([0.5, 1.5, 3.0])) == pytest.approx(HOME + np.array([[5.0], [20], [20]]))
    assert len(line) == 3
