"""Laws that every driver of a dispenser keeps: off wins, nothing waits, and what was lost comes back off."""

from __future__ import annotations

import math
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path as File

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, rule

from estimation import se3
from estimation.errors import InputError
from hardware.dispenser.dispenser import (
    ArmPwmDispenser,
    Dispenser,
    DispenserProfile,
    Dispensers,
    DispenserState,
    check_path_materials,
    close_dispensers,
    switch_off,
)
from hardware.dispenser.line_dispenser import LineDispenser
from hardware.dispenser.messages import PRESETS, DispenserMessages, MessageValues, message_lines
from hardware.process.clock import SimClock, WallClock
from hardware.simulator.dispenser import DispenserModel, VirtualDispenserSettings, run_virtual_dispenser
from planning.path import Path
from tests.dispenser_bench import POLL, Bench

MODELLED = ["arduino", "new_era", "gcode_valve"]


# -- every driver behind a line, in virtual time


@pytest.mark.parametrize("preset", MODELLED)
def test_it_is_on_from_on_until_off_and_at_no_other_time(preset: str) -> None:
    bench = Bench(preset)
    assert not bench.open and "closed" in bench.on() and not bench.open
    bench.prepared()
    assert not bench.open and bench.model.unknown_lines == []
    for flow in (1.0, 2.5):
        assert bench.on(flow) == ""
        bench.run(0.3)
        assert bench.open and bench.state is DispenserState.ON
        assert bench.model.switches[-1][1] == pytest.approx(bench.driver.status.flow, rel=1e-3)
        bench.off()
        assert not bench.open and bench.state is DispenserState.READY, "an off needs no poll"
        bench.run(0.3)
        assert not bench.open
    flows = [event.flow for event in bench.driver.events() if event.flow is not None]
    assert [flow > 0 for flow in flows] == [True, False, True, False]
    assert bench.model.unknown_lines == [] and bench.model.watchdog_stops == []


@pytest.mark.parametrize("preset", MODELLED)
def test_on_again_at_the_same_flow_sends_nothing_and_off_is_sent_each_time(preset: str) -> None:
    bench = Bench(preset, keepalive=10.0).prepared()
    bench.on(2.0)
    bench.run(0.06)
    before = len(bench.port.lines())
    for _ in range(5):
        assert bench.on(2.0) == ""
    assert len(bench.port.lines()) == before
    for _ in range(3):
        bench.off()
        bench.run(0.2)
    assert bench.port.lines()[-3:] == [bench.line.messages.off.encode()] * 3


@pytest.mark.parametrize("preset", MODELLED)
@pytest.mark.parametrize("room", range(8))
def test_off_wins_over_all_that_waits_and_a_torn_line_is_completed(preset: str, room: int) -> None:
    bench = Bench(preset).prepared()
    bench.port.room = room
    bench.on(3.0)
    bench.driver.retract(bench.clock.now())
    bench.off()
    bench.port.room = 10**9
    taken = len(bench.port.lines())
    bench.driver.poll(bench.clock.now())
    assert not bench.open
    assert len(bench.port.lines()) <= taken + 2, "at most the torn line and off"
    assert bench.port.lines()[-1] == bench.line.messages.off.encode()
    bench.run(0.3)
    assert not bench.open and bench.model.unknown_lines == []


@pytest.mark.parametrize("preset", MODELLED)
def test_a_full_line_is_a_failure_and_off_is_the_first_thing_it_takes(preset: str) -> None:
    bench = Bench(preset).prepared()
    bench.on(1.0)
    bench.run(0.1)
    bench.port.room = 0
    bench.off()
    bench.run(1.5)
    assert bench.state is DispenserState.FAILED and "took nothing" in bench.driver.status.reason
    bench.port.room = 10**9
    bench.run(POLL)
    assert not bench.open
    bench.run(0.1)
    assert bench.state is DispenserState.CLOSED
    assert "closed" in bench.on()
    bench.prepared()


@pytest.mark.parametrize("preset", MODELLED)
def test_an_unplugged_line_is_a_failure_and_it_comes_back_off(preset: str) -> None:
    bench = Bench(preset).prepared()
    bench.on(1.0)
    bench.run(0.1)
    bench.port.plugged = False
    bench.run(POLL)
    assert bench.state is DispenserState.FAILED and bench.driver.status.flow == 0 and "cable" in bench.on()
    bench.run(1.2)
    assert bench.open is (bench.driver.profile.watchdog is None), "only its watchdog can close it"
    bench.port.plugged = True
    bench.run(0.6)
    assert not bench.open and bench.state is DispenserState.CLOSED and "prepared" in bench.driver.status.reason
    assert "closed" in bench.on()
    bench.prepared()
    assert bench.on() == ""
    bench.run(0.2)
    assert bench.open


@pytest.mark.parametrize("preset", MODELLED)
def test_close_is_off_and_says_when_it_could_not(preset: str) -> None:
    bench = Bench(preset).prepared()
    bench.on()
    bench.run(0.2)
    assert close_dispensers(Dispensers([bench.driver]), bench.clock) == [] and not bench.open
    assert bench.driver.close(bench.clock.now()), "once more does nothing"
    bench = Bench(preset).prepared()
    bench.on()
    bench.run(0.2)
    bench.port.room = 0
    begun = bench.clock.now()
    (left,) = close_dispensers(Dispensers([bench.driver]), bench.clock)
    assert bench.clock.now() - begun == pytest.approx(1.0, abs=0.01) and "could not be switched off" in left
    assert ("by hand" in left) is (bench.driver.profile.watchdog is None)
    bench.run(1.0)
    assert bench.port.taken[-1][0] <= begun, "nothing is sent after that"
    assert close_dispensers(Dispensers([Bench(preset).driver]), bench.clock) == [], "one that was never opened"


def test_a_line_that_is_full_for_a_moment_still_gets_the_off_of_a_close() -> None:
    bench = Bench().prepared()
    bench.on()
    bench.port.room = 0
    now = bench.clock.now
    assert not bench.driver.close(now())
    bench.clock.wait_until(now() + 0.3)
    assert not bench.driver.close(now())
    bench.port.room = 100
    assert any(bench.driver.close(now()) for _ in range(2)) and not bench.open, "the first sends what waited"


def test_one_that_is_being_closed_is_not_switched_on() -> None:
    bench = Bench().prepared()
    bench.port.room = 0
    assert not bench.driver.close(bench.clock.now()) and bench.on() != ""
    bench.port.room = 100
    assert bench.driver.close(bench.clock.now()) and not bench.open and bench.on() != ""
    bench.prepared()
    assert bench.on() == "" and bench.open


def test_keepalives_come_evenly_while_it_is_on_and_only_then() -> None:
    bench = Bench().prepared()
    bench.on()
    bench.run(2.0)
    stamps = np.array([stamp for stamp, data in bench.port.taken if data == b"K\n"])
    assert len(stamps) == 49 and np.diff(stamps).max() <= 0.04 + POLL + 1e-9
    assert np.diff(stamps).mean() == pytest.approx(0.04, abs=1e-4) and bench.model.watchdog_stops == []
    bench.off()
    sent = len(bench.port.lines())
    bench.run(2.0)
    assert len(bench.port.lines()) == sent


def test_a_caller_that_stalls_finds_it_off_not_on() -> None:
    bench = Bench().prepared()
    bench.on()
    bench.run(0.1)
    bench.run(0.25, poll=0.25)
    assert not bench.open and bench.state is DispenserState.READY and "watchdog" in bench.driver.status.reason
    off = bench.driver.events()[-1]
    assert off.flow == 0 and off.stamp == pytest.approx(bench.model.watchdog_stops[0], abs=1e-6)
    assert bench.on() == "" and bench.open


def test_a_metered_one_refuses_a_flow_out_of_range_and_stays_as_it_was() -> None:
    profile = DispenserProfile("d", ("gel",), metered=True, flow_range=(0.5, 4.0))
    bench = Bench("new_era", profile).prepared()
    for flow in (0.4, 4.1, 0.0, -1.0, math.nan, math.inf):
        assert "cannot give" in bench.on(flow) and not bench.open
    bench.on(4.0)
    bench.run(0.2)
    assert "cannot give" in bench.on(5.0) and bench.open and bench.driver.status.flow == 4.0


def test_another_flow_while_it_waits_takes_the_place_of_the_one_before() -> None:
    bench = Bench("new_era").prepared()
    bench.on(1.0)
    bench.run(0.2)
    for flow in (2.0, 3.0, 4.0):
        bench.on(flow)
    bench.run(0.2)
    assert bench.port.lines()[-2:] == [b"RAT 120 UM", b"RAT 240 UM"]
    assert bench.model.switches[-1][1] == pytest.approx(4.0)


def test_material_is_drawn_back_once_and_pushed_again_before_on() -> None:
    profile = DispenserProfile("d", ("gel",), metered=True, retract_volume=2.0, prime_volume=2.0, watchdog=0.11)
    kind = PRESETS["gcode_extruder"].line
    bench = Bench("arduino", profile, messages=kind.messages, plunger=10.0, keepalive=0.05).prepared()
    step = b"G1 E0.00500 F6.000"  # 0.05 mm^3 of 10 mm^2 a keepalive
    bench.on(1.0)
    assert bench.port.lines()[-2:] == [step] * 2
    bench.off()
    bench.off()
    bench.driver.retract(bench.clock.now())
    assert bench.port.lines()[-3:] == [b"M410", b"G1 E-0.20000 F600", b"M410"]
    bench.on(1.0)
    assert bench.port.lines()[-3:] == [b"G1 E0.20000 F600", step, step]
    bench.run(0.101)
    assert bench.port.lines()[-3:] == [step] * 3 + [] and len(bench.port.lines()) == 12


def test_what_starts_slowly_is_told_off_at_once_and_the_rest_later() -> None:
    bench = Bench(start=2.0)
    bench.driver.prepare(bench.clock.now())
    assert bench.port.lines() == [b"OFF"] and bench.state is DispenserState.PREPARING
    bench.run(1.9)
    assert bench.port.lines() == [b"OFF"] and "preparing" in bench.on()
    bench.off()
    assert bench.port.lines() == [b"OFF"] * 2
    bench.run(0.2)
    assert bench.state is DispenserState.READY and bench.port.lines() == [b"OFF"] * 3


def test_temperature_is_reached_before_it_is_ready() -> None:
    profile = DispenserProfile("d", ("gel",), temperature_range=(4.0, 60.0), watchdog=0.1)
    bench = Bench("arduino", profile)
    bench.driver.prepare(bench.clock.now(), 37.0)
    bench.run(5.0)
    assert bench.state is DispenserState.PREPARING and "37" in bench.driver.status.reason and "preparing" in bench.on()
    bench.run(15.0)
    assert bench.state is DispenserState.READY and bench.driver.status.temperature == pytest.approx(37, abs=1)
    assert bench.driver.status.target == 37.0
    assert bench.on() == "" and bench.driver.set_temperature(50.0, bench.clock.now()) == ""
    bench.run(1.0)
    assert bench.state is DispenserState.ON, "material that flows is not interrupted by that"
    bench.off()
    assert bench.state is DispenserState.PREPARING
    assert "4 to 60" in bench.driver.set_temperature(61.0, bench.clock.now())


def test_what_the_device_says_of_its_failure_closes_it() -> None:
    bench = Bench().prepared()
    bench.on()
    bench.port.extra = b"FAIL stalled\n"
    bench.run(POLL)
    assert bench.state is DispenserState.FAILED and "stalled" in bench.driver.status.reason and not bench.open
    bench.prepared()


@settings(max_examples=100, deadline=None)
@given(
    st.lists(
        st.one_of(
            st.binary(max_size=600), st.sampled_from([b"x" * 1000, b"T nan\n", b"T 1e999\nT\n", b"T 36.5\r\n", b"\xff"])
        )
    )
)
def test_no_answer_is_too_bad(answers: list[bytes]) -> None:
    bench = Bench().prepared()
    bench.on()
    for answer in answers:
        bench.port.extra = answer
        bench.run(POLL)
        assert bench.driver.status.temperature is None or math.isfinite(bench.driver.status.temperature)
        assert len(bench.driver._partial) <= 256
    bench.off()
    assert not bench.open


class AnyCalls(RuleBasedStateMachine):
    """Any calls in any order, while the line is full, torn, unplugged, or the caller stalls."""

    @initialize(preset=st.sampled_from(MODELLED))
    def start(self, preset: str) -> None:
        self.bench, self.ordered = Bench(preset), False

    @rule(flow=st.sampled_from([0.5, 1.0, 3.0, 500.0, math.nan]))
    def on(self, flow: float) -> None:
        self.ordered = self.bench.on(flow) == "" or self.ordered

    @rule()
    def off(self) -> None:
        self.bench.off()
        self.ordered = False

    @rule(celsius=st.sampled_from([None, 37.0]))
    def prepare(self, celsius: float | None) -> None:
        self.bench.driver.prepare(self.bench.clock.now(), celsius)

    @rule()
    def close(self) -> None:
        self.bench.driver.close(self.bench.clock.now())
        self.ordered = False

    @rule()
    def retract(self) -> None:
        self.bench.driver.retract(self.bench.clock.now())

    @rule(room=st.sampled_from([0, 1, 3, 7, 10**9]))
    def hinder(self, room: int) -> None:
        self.bench.port.room = room

    @rule(plugged=st.booleans())
    def plug(self, plugged: bool) -> None:
        self.bench.port.plugged = plugged

    @rule(data=st.sampled_from([b"FAIL\n", b"00A?S\x03", b"Error\n", b"\x00" * 300]))
    def hear(self, data: bytes) -> None:
        self.bench.port.extra = data

    @rule(seconds=st.sampled_from([POLL, 0.02, 0.11, 0.6]), poll=st.sampled_from([POLL, 0.15]))
    def wait(self, seconds: float, poll: float) -> None:
        self.bench.run(seconds, poll)

    @invariant()
    def it_is_never_on_unless_the_last_order_was(self) -> None:
        bench = getattr(self, "bench", None)
        if bench is None:
            return
        assert bench.state is not DispenserState.ON or self.ordered
        if bench.state is not DispenserState.ON:
            self.ordered = False
        free = bench.port.plugged and bench.port.room > 100
        if free:
            bench.driver.poll(bench.clock.now())
        reached = free and bench.driver._port is not None
        quiet = bench.driver.profile.watchdog or math.inf
        silent = not bench.port.taken or bench.clock.now() - bench.port.taken[-1][0] > quiet
        if (reached or silent) and bench.state is not DispenserState.ON:
            assert not bench.open, bench.driver.status
        if reached and bench.state is DispenserState.ON and not bench.driver._queue:
            assert bench.open, bench.driver.status


AnyCalls.TestCase.settings = settings(
    max_examples=60, stateful_step_count=30, deadline=None, suppress_health_check=list(HealthCheck)
)
test_any_calls = AnyCalls.TestCase


# -- messages


@settings(max_examples=300, deadline=None)
@given(st.floats(0.02, 160.0))
def test_a_flow_is_written_with_four_digits_and_no_exponent(flow: float) -> None:
    (line, _) = message_lines(PRESETS["new_era"].line.messages.on, "\r", MessageValues(flow))
    text = line.decode().removeprefix("RAT ").removesuffix(" UM\r")
    assert len(text.replace(".", "")) <= 4 and len(text.partition(".")[2]) <= 3, "as New Era asks for"
    assert float(text) == pytest.approx(60 * flow, rel=5e-4)


def test_units_of_flow_agree_and_bytes_are_bytes() -> None:
    units = "{flow_ul_s} {flow_ul_min} {flow_ml_min} {flow_ul_h} {flow_ml_h} {flow_mm_min:.2f}"
    assert message_lines(units, "\n", MessageValues(2.5, plunger=10.0)) == [b"2.5 150 0.15 9000 9 15.00\n"]
    assert message_lines("hex:A0 01 01 A2\nX", "\r\n", MessageValues()) == [b"\xa0\x01\x01\xa2", b"X\r\n"]
    assert message_lines("{celsius}", "", MessageValues(celsius=36.55)) == [b"36.55"]


@pytest.mark.parametrize(
    "wrong", ["{speed}", "{}", "{flow_ul_s", "{flow_mm_s}", "hex:A", "{celsius:q}", "é", "{celsius.real}"]
)
def test_a_message_that_cannot_be_written_is_refused(wrong: str) -> None:
    with pytest.raises(InputError, match="allowed"):
        message_lines(wrong, "\n", MessageValues())
    with pytest.raises(InputError, match="keepalive"):
        DispenserMessages("ON", "OFF", keepalive=wrong).check(MessageValues())


# -- the device


@settings(max_examples=60, deadline=None)
@given(*[st.floats(0.0, 0.3)] * 4, st.floats(0.0, 2.0))
def test_half_the_flow_comes_after_the_delay_and_the_ooze_is_a_volume(
    on_dead: float, on_lag: float, off_dead: float, off_lag: float, ooze: float
) -> None:
    device = VirtualDispenserSettings("arduino", on_dead, on_lag, off_dead, off_lag, ooze, flow=2.0, watchdog=math.inf)
    profile = DispenserProfile("d", ("gel",), on_dead, on_lag, off_dead, off_lag)
    model = DispenserModel(device)
    model.receive(b"O", 0.5)
    model.receive(b"N\n", 1.0)
    model.receive(b"OFF\n", 10.0)
    model.advance(30.0)
    instants = np.arange(0.0, 30.0, 0.0005)
    flow = model.flow_at(instants)
    assert (flow[instants < 1.0 + on_dead] == 0).all()
    assert model.flow_at(np.array([1.0 + profile.on_delay + 1e-9])) == pytest.approx(
        1.0 if on_lag > 1e-6 else 2.0, rel=1e-4
    )
    pushed = 2.0 * (9.0 - on_dead - on_lag + off_dead + off_lag)  # each lag's area is flow times lag
    assert float(flow.sum()) * 0.0005 == pytest.approx(pushed + ooze, abs=0.01)
    if ooze == 0 and off_lag > 1e-6:
        assert model.flow_at(np.array([10.0 + profile.off_delay])) == pytest.approx(1.0, rel=1e-4)


def test_an_off_that_acts_before_the_on_before_it_leaves_nothing() -> None:
    model = DispenserModel(VirtualDispenserSettings(on_dead_time=0.2, off_dead_time=0.05, watchdog=math.inf))
    model.receive(b"ON\n", 0.0)
    model.receive(b"OFF\n", 0.1)
    model.advance(2.0)
    assert (model.flow_at(np.linspace(0, 2, 2001)) == 0).all()
    model = DispenserModel(model.settings)
    model.receive(b"ON 1\n", 2.0)
    model.receive(b"ON 2\n", 3.0)
    model.receive(b"OFF\n", 3.1)
    model.advance(3.2)
    for instant, flow in ((3.14, 1.0), (3.19, math.exp(-0.04 / 0.04))):
        assert model.flow_at(np.array([instant])) == pytest.approx(flow, rel=1e-3)


@pytest.mark.parametrize(("key", "value"), [("preset", "x"), ("on_lag", -1.0), ("flow", 0.0), ("watchdog", 0.0)])
def test_a_virtual_one_that_cannot_be_is_refused(key: str, value: object) -> None:
    with pytest.raises(InputError, match=key):
        replace(VirtualDispenserSettings(), **{key: value})  # type: ignore[arg-type]


# -- on a pseudo-terminal, in real time


@contextmanager
def served(folder: File, name: str = "line", **device: float) -> Iterator[tuple[File, list[DispenserModel]]]:
    """A virtual dispenser at folder/name; its model once it has ended; its log in folder/name.csv."""
    stop, models, up = threading.Event(), [], threading.Event()

    def serve() -> None:
        model = run_virtual_dispenser(
            VirtualDispenserSettings(**device), folder / f"{name}.csv", folder / name, None, stop, lambda _: up.set()
        )
        models.append(model)

    thread = threading.Thread(target=serve)
    thread.start()
    try:
        assert up.wait(10)
        yield folder / name, models
    finally:
        stop.set()
        thread.join(10)


def pty_driver(port: File, **line: float) -> LineDispenser:
    kind = replace(PRESETS["arduino"].line, port=str(port), start=0.0, **line)
    return LineDispenser(DispenserProfile("d", ("gel",), watchdog=0.1), kind)


def until(driver: Dispenser, state: DispenserState, seconds: float = 5.0) -> None:
    clock = WallClock()
    end = clock.now() + seconds
    while driver.status.state is not state:
        assert clock.now() < end, driver.status
        driver.poll(clock.now())
        clock.wait_until(clock.now() + POLL)


CLIENT = """
import sys
from hardware.dispenser.dispenser import DispenserProfile, DispenserState
from hardware.process.clock import WallClock
from tests.test_dispenser import pty_driver, until
clock, driver = WallClock(), pty_driver(sys.argv[1])
driver.prepare(clock.now())
until(driver, DispenserState.READY)
assert driver.on(1.0, clock.now()) == ""
until(driver, DispenserState.ON)
print("on", flush=True)
while True:
    driver.poll(clock.now())
    clock.wait_until(clock.now() + 0.002)
"""


def test_a_killed_client_leaves_it_off_within_its_watchdog(tmp_path: File) -> None:
    clock = WallClock()
    with served(tmp_path) as (port, models):
        client = subprocess.Popen([sys.executable, "-c", CLIENT, str(port)], stdout=subprocess.PIPE, text=True)
        assert client.stdout is not None and client.stdout.readline() == "on\n"
        clock.wait_until(clock.now() + 0.4)
        killed = clock.now()
        os.kill(client.pid, signal.SIGKILL)
        client.communicate()
        dead = clock.now()  # its last line may be read a little later, on a machine that is busy
        clock.wait_until(dead + 0.5)
    (model,) = models
    assert len(model.watchdog_stops) == 1 and not model.on
    assert killed + 0.03 < model.watchdog_stops[0] < dead + 0.1 + 0.03
    stamps, flow, switched = np.loadtxt(tmp_path / "line.csv", delimiter=",", skiprows=1).T
    assert np.diff(stamps) == pytest.approx(0.001, abs=1e-5)
    assert flow[(stamps > killed - 0.1) & (stamps < killed)] == pytest.approx(1.0, abs=0.01)
    assert flow[stamps > dead + 0.4].max() < 0.01
    assert (switched[stamps < model.watchdog_stops[0]][-100:] == 1).all() and switched[-1] == 0


def test_one_without_a_watchdog_stays_on_after_its_client_and_whoever_is_left_switches_it_off(tmp_path: File) -> None:
    clock = WallClock()
    with served(tmp_path, watchdog=float("inf")) as (port, models):
        client = subprocess.Popen([sys.executable, "-c", CLIENT, str(port)], stdout=subprocess.PIPE, text=True)
        assert client.stdout is not None and client.stdout.readline() == "on\n"
        os.kill(client.pid, signal.SIGKILL)
        client.communicate()
        clock.wait_until(clock.now() + 0.3)
        asked = clock.now()
        assert switch_off(Dispensers([pty_driver(port)]), clock) == []
    (model,) = models
    (stamp, flow) = model.switches[-1]
    assert flow == 0.0 and asked < stamp < asked + 0.1 and not model.on


def test_on_and_off_pass_a_pty_and_a_replugged_device_is_off_and_must_be_prepared(tmp_path: File) -> None:
    clock = WallClock()
    with served(tmp_path) as (port, models):
        driver = pty_driver(port)
        driver.prepare(clock.now())
        until(driver, DispenserState.READY)
        for _ in range(3):
            assert driver.on(1.0, clock.now()) == ""
            until(driver, DispenserState.ON)
            driver.off(clock.now())
        assert driver.on(1.0, clock.now()) == ""
        until(driver, DispenserState.ON)
        for _ in range(20):  # until the device has read what was sent
            driver.poll(clock.now())
            clock.wait_until(clock.now() + POLL)
    assert [flow for _, flow in models[0].switches] == [1.0, 0.0] * 3 + [1.0]
    until(driver, DispenserState.FAILED)
    assert "on" not in driver.on(1.0, clock.now())[:2]
    (tmp_path / "line.csv").rename(tmp_path / "first.csv")
    with served(tmp_path) as (_, models):
        until(driver, DispenserState.CLOSED)
        assert "prepared" in driver.status.reason and "closed" in driver.on(1.0, clock.now())
        driver.prepare(clock.now())
        until(driver, DispenserState.READY)
        assert close_dispensers(Dispensers([driver]), clock) == []
    assert models[0].switches == [] and models[0].unknown_lines == []


def test_two_programs_cannot_have_one_line(tmp_path: File) -> None:
    clock = WallClock()
    with served(tmp_path) as (port, _):
        first, second = pty_driver(port), pty_driver(port)
        first.prepare(clock.now())
        second.prepare(clock.now())
        assert second.status.state is DispenserState.FAILED and "free" in second.status.reason
        assert close_dispensers(Dispensers([first]), clock) == []


# -- by HTTP


class Web:
    """A web server that is a valve: asked keeps the requests, on says what it is, delay and code how it answers."""

    def __init__(self) -> None:
        self.asked: list[str] = []
        self.on, self.delay, self.code = False, 0.0, 200
        web = self

        class Handler(BaseHTTPRequestHandler):
            def do_GET(self) -> None:
                body = self.rfile.read(int(self.headers.get("Content-Length") or 0)).decode()
                web.asked.append(f"{self.command} {self.path} {body}".strip())
                web.on = self.path.startswith("/on") if web.code == 200 else web.on
                WallClock().wait_until(WallClock().now() + web.delay)
                self.send_response(web.code)
                self.end_headers()
                self.wfile.write(b"T 21.5")

            do_POST = do_GET

            def log_message(self, *_: object) -> None:
                pass

        self.server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self.url = f"http://127.0.0.1:{self.server.server_port}"


@pytest.fixture
def web() -> Iterator[Web]:
    web = Web()
    thread = threading.Thread(target=web.server.serve_forever, kwargs={"poll_interval": 0.01})
    thread.start()
    yield web
    web.server.shutdown()
    thread.join()
    web.server.server_close()


def web_driver(web: Web, timeout: float = 0.5) -> LineDispenser:
    messages = DispenserMessages(on="GET /on?ul_s={flow_ul_s}", off="POST /off now", answer=r"T (\S+)")
    line = replace(PRESETS["http"].line, port=web.url, messages=messages, timeout=timeout)
    driver = LineDispenser(DispenserProfile("d", ("gel",), metered=True), line)
    driver.prepare(WallClock().now())
    until(driver, DispenserState.READY)
    return driver


def polled(driver: Dispenser, seconds: float) -> None:
    clock = WallClock()
    end = clock.now() + seconds
    while clock.now() < end:
        begun = clock.now()
        driver.poll(begun)
        assert clock.now() - begun < 0.05, "it never waits"
        clock.wait_until(begun + POLL)


def test_requests_keep_their_order_and_the_newest_off_wins(web: Web) -> None:
    driver, clock = web_driver(web), WallClock()
    polled(driver, 0.1)
    web.delay = 0.1
    driver.on(1.0, clock.now())
    for flow in (2.0, 3.0):
        driver.on(flow, clock.now())
    driver.off(clock.now())
    polled(driver, 0.4)
    assert web.asked == ["POST /off now", "GET /on?ul_s=1", "POST /off now"] and not web.on
    assert driver.status.temperature == 21.5
    driver.on(4.0, clock.now())
    polled(driver, 0.2)
    assert web.on and web.asked[-1] == "GET /on?ul_s=4"
    assert close_dispensers(Dispensers([driver]), clock) == [] and not web.on


def test_an_error_and_a_silent_server_are_failures_until_an_off_gets_through(web: Web) -> None:
    driver, clock = web_driver(web, timeout=0.15), WallClock()
    polled(driver, 0.1)
    driver.on(1.0, clock.now())
    polled(driver, 0.1)
    web.code = 500
    driver.on(2.0, clock.now())
    until(driver, DispenserState.FAILED)
    assert "500" in driver.status.reason and web.on
    web.code = 200
    until(driver, DispenserState.CLOSED)
    assert not web.on
    driver.prepare(clock.now())
    until(driver, DispenserState.READY)
    web.delay = 0.4
    driver.on(1.0, clock.now())
    until(driver, DispenserState.FAILED)
    assert "timed out" in driver.status.reason
    web.delay = 0.0
    until(driver, DispenserState.CLOSED)
    assert not web.on


# -- the arm's own frames, and several dispensers


def test_the_arms_frames_carry_the_number_of_what_it_was_told_last() -> None:
    driver: Dispenser = ArmPwmDispenser(DispenserProfile("tool", ("gel",), kept_at=20.0), 2000.0, 1500.0)
    assert isinstance(driver, ArmPwmDispenser)
    assert driver.pwm == 1500.0 and "closed" in driver.on(1.0, 0.0) and driver.pwm == 1500.0
    driver.prepare(0.0)
    assert driver.on(1.0, 1.0) == "" and driver.pwm == 2000.0 and driver.status.flow == 1.0
    driver.off(2.0)
    assert driver.pwm == 1500.0 and driver.status.flow == 0
    driver.on(1.0, 3.0)
    assert driver.close(4.0) and driver.pwm == 1500.0 and driver.status.state is DispenserState.CLOSED
    assert driver.set_temperature(20.5, 4.0) == "" and "20" in driver.set_temperature(30.0, 4.0)
    assert [(e.stamp, e.flow) for e in driver.events() if e.flow is not None] == [(1, 1), (2, 0), (3, 1), (4, 0)]


def pwm(name: str, *materials: str, **profile: object) -> ArmPwmDispenser:
    return ArmPwmDispenser(DispenserProfile(name, materials, **profile), 1.0, 0.0)  # type: ignore[arg-type]


def path(
    material: list[object], celsius: float = 20.0, extrude: tuple[int, ...] = (0, 1, 1), **extra: list[str]
) -> Path:
    poses = se3.make(np.broadcast_to(np.eye(3), (3, 3, 3)), np.arange(9.0).reshape(3, 3))
    columns = {name: np.array(words) for name, words in extra.items()}
    layer, flags = np.zeros(3, np.int64), np.array(extrude, bool)
    return Path(poses, np.full(3, 5.0), np.array(material), np.full(3, celsius), layer, flags, columns)


def test_each_material_of_a_path_has_its_dispenser_temperature_and_flow() -> None:
    metered = pwm("b", "2", "gel", metered=True, temperature_range=(4.0, 40.0))
    both = Dispensers([pwm("a", "1", kept_at=20.0), metered])
    assert both.for_material(1) is both.for_material("1") is next(iter(both)) and both.for_material("none") is None
    assert both.materials == ("1", "2", "gel")
    check_path_materials(both, path([1, 1, 1], 20.9), "p.csv")
    check_path_materials(both, path([7, 1, 1]), "p.csv")  # what is not extruded needs none
    check_path_materials(both, path(["gel"] * 3, 37.0, volume_mm3=["0", "1", "1"]), "p.csv")
    check_path_materials(both, path([2] * 3, 37.0, width_mm=["1"] * 3, height_mm=["1"] * 3), "p.csv")
    for wrong, words in (
        (path([1, 1, 7]), "material = 7, allowed what a dispenser carries: 1, 2, gel"),
        (path([1, 1, 1], 21.1), "temperature_c of material 1 = 21.1, allowed 20 degrees C within 1"),
        (path([2] * 3, 41.0, volume_mm3=["1"] * 3), "temperature_c of material 2 = 41.0, allowed 4 to 40 degrees C"),
        (
            path([2] * 3, 30.0, width_mm=["1"] * 3),
            "columns = 'width_mm', allowed volume_mm3, or width_mm and height_mm",
        ),
        (
            path([2] * 3, 30.0, width_mm=["1", "1", "15"], height_mm=["1", "1", "15"]),
            "checkpoint 2: flow = '1.12e+03 mm^3/s', allowed 0.001 to 1000 mm^3/s",
        ),
    ):
        with pytest.raises(InputError, match=r"^p\.csv: ") as caught:
            check_path_materials(both, wrong, "p.csv")
        assert words in str(caught.value)
    with pytest.raises(InputError, match="kept_at_c"):
        check_path_materials(Dispensers([pwm("c", "1")]), path([1, 1, 1]), "p.csv")
    with pytest.raises(InputError, match="'a' carries it as well"):
        Dispensers([pwm("a", "1"), pwm("b", "1")])


def test_all_are_polled_switched_off_and_closed_together() -> None:
    benches = [Bench().prepared(), Bench("gcode_valve", DispenserProfile("e", ("ink",))).prepared()]
    both = Dispensers([bench.driver for bench in benches])
    for bench in benches:
        bench.on()
    clock = SimClock(benches[0].clock.now())
    both.poll(clock.now())
    both.off(clock.now())
    assert len(both) == 2 and not any(bench.open for bench in benches)
    assert close_dispensers(both, clock) == []


@pytest.mark.parametrize("value", [-0.1, 5.1, math.nan])
@pytest.mark.parametrize("name", ["on_dead_time", "on_lag", "off_dead_time", "off_lag"])
def test_a_delay_out_of_range_is_refused(name: str, value: float) -> None:
    with pytest.raises(InputError, match=name):
        DispenserProfile("d", ("gel",), **{name: value})  # type: ignore[arg-type]
