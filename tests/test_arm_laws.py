"""What every driver of an arm must do, tried on each: `tests/arm_benches.py` and its kin bring the arms.

A new driver adds a line to BENCHES, and passes.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from estimation.errors import InputError
from estimation.se3 import Array
from hardware.arm import franka, profile, s6h4d
from hardware.arm.console import drivers_text
from hardware.arm.device import ArmState, LinkCode
from hardware.arm.driver import UnpluggedError
from hardware.arm.profile import ArmProfile
from planning.command import Hold, Move
from tests import octoprint_bench
from tests.arm_benches import ArmBench, ExampleBench, PtyBench, VirtualTimeBench, closing_bench
from tests.franka_bench import MISSING, FrankaBench, fr3, installed
from tests.octoprint_bench import GcodeBench

BENCHES = [
    pytest.param(lambda folder: VirtualTimeBench(), id="s6h4d"),
    pytest.param(lambda folder: PtyBench(folder / "arm"), id="s6h4d-on-a-pty"),
    pytest.param(lambda folder: ExampleBench(), id="the-example"),
    pytest.param(
        FrankaBench, id="franka", marks=[pytest.mark.slow, pytest.mark.skipif(not installed(), reason=MISSING)]
    ),
    pytest.param(
        GcodeBench,
        id="gcode",
        marks=[
            pytest.mark.slow,
            pytest.mark.skipif(not octoprint_bench.installed(), reason=octoprint_bench.MISSING),
        ],
    ),
]
LEGS = np.array([[0, 0, 0], [6, 0, 0], [6, 6, 0], [0, 6, 3], [0, 0, 0]], float)  # mm from where it stands
SPEED = 12.0  # mm/s along the legs


@pytest.fixture(params=BENCHES)
def bench(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[ArmBench]:
    with closing_bench(request.param(tmp_path)) as made:
        yield made


def legs_from(start: Array) -> Callable[[float], Array]:
    """The way (6,) along LEGS from where the arm stands, that rests at each corner's end."""
    lengths = np.linalg.norm(np.diff(LEGS, axis=0), axis=1)
    knots = np.concatenate([[0.0], np.cumsum(lengths)]) / SPEED

    def way(s: float) -> Array:
        offset = [np.interp(s, knots, LEGS[:, axis]) for axis in range(3)]
        return start + np.array([*offset, 0, 0, 0])

    return way


def straight(start: Array, speed: float = SPEED) -> Callable[[float], Array]:
    return lambda s: start + np.array([speed * s, 0, 0, 0, 0, 0])


def test_moves_are_made_whole_and_in_order(bench: ArmBench) -> None:
    start = bench.begin()
    bench.follow(legs_from(start), 2.6)
    bench.run(0.4)
    assert bench.arm.state is ArmState.ARMED, bench.arm.reason
    target = bench.arm.target
    _, axes = bench.truth()
    places = [np.argmin(np.linalg.norm(axes[:, :3] - (start[:3] + leg), axis=1)) for leg in LEGS[1:4]]
    assert places == sorted(places)
    for place, leg in zip(places, LEGS[1:4], strict=True):
        assert axes[place, :3] == pytest.approx(
            start[:3] + leg, abs=bench.tolerance + 0.3
        )  # a corner is cut by the lag
    assert axes[-1, :3] == pytest.approx(target[:3], abs=bench.tolerance)
    assert axes[-1, 3:] == pytest.approx(target[3:], abs=np.deg2rad(0.1))


def test_what_it_is_sent_is_what_was_reported_as_sent(bench: ArmBench) -> None:
    start = bench.begin()
    goal = start + [0.2, 0, 0, 0, 0, 0]
    while bench.arm.hold(bench.clock.now()).code is LinkCode.FEEDBACK:  # a busy machine may keep an answer back
        bench.run(0.01)
    assert bench.arm.send(Move(0.0, goal, 10.0, 0, False), bench.clock.now()) == ""
    assert bench.arm.target == pytest.approx(goal, abs=1e-3) and bench.arm.frames == 1


def test_no_more_is_under_way_than_the_arm_file_allows(bench: ArmBench) -> None:
    start = bench.begin()
    bench.follow(straight(start), 1.5)
    flight = bench.profile.flight or bench.arm.settings.flight
    assert 0 < bench.most_in_flight <= flight + 1e-9
    bench.run(flight + 0.4)
    end = bench.clock.now() - 0.2
    stamps, axes = bench.truth()
    rest = axes[stamps >= end]
    assert np.ptp(rest[:, :3], axis=0).max() < bench.tolerance  # it does not go on by itself


def test_a_command_beyond_its_feed_is_not_sent_and_stops_it(bench: ArmBench) -> None:
    start = bench.begin()
    fast = bench.profile.limits.feed * 1.01
    reason = bench.arm.send(Move(0.0, start + [0.5, 0, 0, 0, 0, 0], fast, 0, False), bench.clock.now())
    assert reason.code is LinkCode.LIMIT and bench.arm.state is ArmState.STOPPED
    bench.run(0.3)
    _, axes = bench.truth()
    assert axes[-1, :3] == pytest.approx(start[:3], abs=bench.tolerance)


def test_it_is_never_faster_than_its_limits(bench: ArmBench) -> None:
    start = bench.begin()
    bench.follow(straight(start, 30.0), 1.0)
    bench.run(0.3)
    stamps, axes = bench.truth()
    span = 25  # ms: over which noise of the truth is no speed
    speed = np.abs(axes[span:] - axes[:-span])[:, :3] / (stamps[span:] - stamps[:-span])[:, None]
    assert 25.0 < speed.max() < bench.profile.limits.speed[:3].max()


def test_a_hold_keeps_it_where_it_is(bench: ArmBench) -> None:
    start = bench.begin()
    sent = 0
    for _ in range(20):
        bench.run(bench.profile.tick)
        if not bench.arm.hold(bench.clock.now()):  # a busy machine may keep an answer back
            sent += bench.arm.send(Hold(0.0, 0.001, "because"), bench.clock.now()) == ""
    assert sent > 10
    _, axes = bench.truth()
    assert np.linalg.norm(axes[:, :3] - start[:3], axis=1).max() < bench.tolerance


def test_after_a_stop_it_rests_within_its_time_and_way_and_takes_no_more(bench: ArmBench) -> None:
    start = bench.begin()
    bench.follow(straight(start, 20.0), 1.0)
    decided = bench.clock.now()
    bench.arm.stop("for the law", decided)
    assert bench.arm.send(Move(0.0, start, 10.0, 0, False), decided).code is LinkCode.STOPPED
    bench.run(bench.rest_time + 0.6)
    stamps, axes = bench.truth()
    rests = axes[-1, :3]
    late = stamps >= decided + bench.rest_time
    assert np.linalg.norm(axes[late, :3] - rests, axis=1).max() < 0.1
    at_stop = axes[np.searchsorted(stamps, decided), :3]
    assert np.linalg.norm(rests - at_stop) < bench.rest_way


def test_stopped_it_moves_again_only_once_it_is_armed(bench: ArmBench) -> None:
    start = bench.begin()
    bench.follow(straight(start), 0.4)
    bench.arm.stop("for the law", bench.clock.now())
    bench.run(0.8)
    assert bench.arm.hold(bench.clock.now()).code is LinkCode.STOPPED
    assert bench.arm.arm(bench.clock.now()) == ""
    again = bench.arm.target
    assert bench.follow(straight(again), 0.6) == [] or bench.arm.state is ArmState.ARMED
    assert bench.arm.target[0] > again[0] + 2.0


def test_an_arm_that_falls_silent_is_held_in_time(bench: ArmBench) -> None:
    start = bench.begin()
    bench.follow(straight(start), 0.5)
    bench.silence()
    since = bench.clock.now()
    while bench.arm.hold(bench.clock.now()).code not in (LinkCode.FEEDBACK, LinkCode.RECALLED, LinkCode.STOPPED):
        bench.follow(straight(bench.arm.target), 0.02)
        assert bench.clock.now() < since + bench.silent_time
    bench.run(0.3)
    end = bench.clock.now() - 0.1
    stamps, axes = bench.truth()
    rest = axes[stamps >= end]  # none where the physics itself stands still
    assert len(rest) == 0 or np.ptp(rest[:, :3], axis=0).max() < bench.tolerance


def test_unplugged_it_is_known_nowhere_and_back_it_waits_for_the_operator(bench: ArmBench) -> None:
    start = bench.begin()
    bench.follow(straight(start), 0.4)
    bench.unplug()
    bench.run(0.5)
    arm = bench.arm
    assert arm.state is ArmState.UNPLUGGED and arm.target is None
    assert arm.hold(bench.clock.now()).code is LinkCode.UNPLUGGED
    assert arm.arm(bench.clock.now()).code is LinkCode.UNPLUGGED
    bench.plug()
    bench.run(arm.settings.reopen + 1.0)
    assert arm.state is ArmState.DISARMED, arm.reason
    assert arm.hold(bench.clock.now()).code is LinkCode.DISARMED
    again = bench.begin()
    bench.follow(straight(again), 0.4)
    assert arm.state is ArmState.ARMED and arm.target[0] > again[0] + 2.0


def test_closed_it_is_sent_nothing(bench: ArmBench) -> None:
    start = bench.begin()
    bench.follow(straight(start), 0.3)
    bench.arm.disarm(bench.clock.now())
    frames = bench.arm.frames
    bench.arm.close()
    bench.run(0.7)
    assert bench.arm.state is ArmState.UNPLUGGED and bench.arm.frames == frames


# -- what the link makes of what a driver may say, whatever the arm


def test_an_arm_that_has_stopped_by_itself_is_stopped_and_says_why() -> None:
    bench = VirtualTimeBench()
    bench.begin()
    driver, whole = bench.arm.driver, bench.arm.driver.state
    driver.state = lambda now: replace(whole(now), fault="joint 3 is at its end")
    bench.run(0.01)
    assert bench.arm.state is ArmState.STOPPED and "joint 3 is at its end" in bench.arm.reason
    driver.enable = lambda now: "its brakes are shut"
    assert bench.arm.arm(bench.clock.now() + 1.0).code is not None  # not before it can
    bench.run(0.5)
    refused = bench.arm.arm(bench.clock.now())
    assert refused.code is LinkCode.ARM_FAULT and "brakes" in refused


def test_an_arm_that_finds_home_by_itself_is_left_alone_until_it_is_there() -> None:
    bench = VirtualTimeBench()
    start = bench.begin()
    driver, whole, asked = bench.arm.driver, bench.arm.driver.state, []
    driver.home = lambda now: asked.append(now) is None
    driver.state = lambda now: replace(whole(now), busy=bench.clock.now() < asked[-1] + 0.5)
    frames = bench.arm.frames
    assert bench.arm.home(bench.clock.now()) == ""
    bench.run(0.3)
    assert bench.arm.travels and bench.arm.hold(bench.clock.now()).code is LinkCode.OWN_MOVE
    assert bench.arm.frames == frames and not bench.arm.arrived(bench.clock.now())
    bench.run(0.5)
    assert not bench.arm.travels and bench.arm.arrived(bench.clock.now())
    assert bench.arm.target == pytest.approx(start, abs=0.11) and bench.arm.hold(bench.clock.now()) == ""


def test_each_driver_is_found_by_its_addresses(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(profile, "find_spec", lambda module: object())
    serial, robot = "SEED S6H4D", "Franka FR3, Panda"
    for address, name in (("/dev/ttyUSB0", serial), ("socket://a:1", serial), ("franka://a", robot)):
        assert profile.driver_kind(address).name == name
    monkeypatch.setattr(profile, "find_spec", lambda module: None)
    assert profile.driver_kind("/dev/ttyUSB0").installed
    with pytest.raises(InputError, match=r"pip install 'stillbed\[franka\]'"):
        profile.driver_kind("franka://a")


def test_the_drivers_are_listed_with_what_they_find_and_lack(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(profile, "find_spec", lambda module: None)
    monkeypatch.setattr(s6h4d, "serial_ports", lambda: [("/dev/ttyUSB7", "an adapter")])
    text = drivers_text()
    assert "  /dev/ttyUSB7  an adapter" in text.splitlines()
    assert "  not installed: pip install 'stillbed[franka]'" in text.splitlines()


def test_a_franka_without_what_hangs_on_it_is_refused() -> None:
    with pytest.raises(InputError, match="flange_from_nozzle"):
        franka.open_arm("franka://a", ArmProfile())
    with pytest.raises(InputError, match="franka://HOST"):
        franka.open_arm("franka://", fr3())


def test_a_robot_that_does_not_answer_is_said_and_leaves_nothing_behind(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without franky its process ends at once; with it nobody answers at that port."""
    robot = franka.open_arm("franka://127.0.0.9", fr3())
    with pytest.raises(UnpluggedError, match=r"franka://127\.0\.0\.9: "):
        robot.connect(0.0)
    robot.release()
    assert robot._former is None
