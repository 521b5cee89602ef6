"""Material is on only with a Move with a flow that the guard let pass and the arm was sent, whatever its line does."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from estimation.pose import SurfacePose, TrackState
from hardware.arm.device import ArmState
from hardware.arm.driver import G1, G4, Sent
from hardware.arm.profile import ArmProfile
from hardware.arm.protocol import Dialect, decode
from hardware.dispenser.dispenser import ArmPwmDispenser, DispenserProfile, Dispensers
from hardware.motion.loop import MaterialControl, MotionLoop, Order, Tick
from hardware.motion.step import MotionStep
from hardware.process.clock import SimClock
from planning.command import Command, Hold, Move
from planning.material import Outlet, SwitchDelay
from tests.dispenser_bench import Bench
from tests.faulty_port import PortFaults
from tests.linked_arm import Linked, linked
from tests.moving_surfaces import breathing, pose_at, raster
from tests.slow_cases import slowly

GEL = DispenserProfile("gel", ("1",), on_dead_time=0.08, on_lag=0.04, off_dead_time=0.08, off_lag=0.04, watchdog=0.1)
OUTLETS = {"1": Outlet(SwitchDelay(GEL.on_delay, GEL.off_delay))}
SLACK = 0.003  # s: the loop's poll, and a line that takes bytes at once


class Printing:
    """A loop on a virtual arm and a virtual dispenser, both in virtual time; orders are given by instant."""

    def __init__(
        self,
        orders: list[tuple[float, Order]],
        pose: Callable[[float], SurfacePose | None] = lambda now: seen(now),
        port: PortFaults | None = None,
        at: Callable[[Printing, float], None] = lambda run, now: None,
    ) -> None:
        """at: called before each look at the pose."""
        self.link: Linked = linked(port=port, stand=False)
        self.bench = Bench(profile=GEL)
        self.bench.clock = self.bench.port.clock = clock = self.link.clock
        self.bench.port._clock = clock
        self.bench.model.now = self.bench.model._last_message = 0.0
        self.bench.model._knots.clear()
        self.bench.model._knots.append((0.0, 0.0, 0.0, 1.0, 0.0))
        path = raster(speed=10.0)
        self.motion, self.ticks = MotionStep(path, self.link.arm.profile, 0.0, OUTLETS), list[Tick]()
        self.material = MaterialControl(Dispensers([self.bench.driver]), path)
        self.material.begin(0.0, 0.0)
        self._orders = list(orders)
        self._resting = [at for at, order in orders if order in (Order.STOP, Order.DISARM)]

        def newest(now: float) -> SurfacePose | None:
            at(self, now)
            return pose(now)

        self.loop = MotionLoop(
            self.motion, self.link.arm, clock, lambda: newest(clock.now()), self._due, self.ticks.append,
            material=self.material,
        )  # fmt: skip

    def _due(self) -> list[Order]:
        due = [order for at, order in self._orders if at <= self.link.clock.now()]
        self._orders = [(at, order) for at, order in self._orders if at > self.link.clock.now()]
        return due

    def run(self, until: float) -> Printing:
        self.loop.run(until)
        return self

    def allowed(self) -> list[tuple[float, float]]:
        """The stretches of time, s, in which a Move with a flow was the last thing that was decided."""
        spans = []
        for tick, after in zip(self.ticks, [*self.ticks[1:], None], strict=True):
            end = self.link.clock.now() if after is None else after.stamp
            if isinstance(tick.command, Move) and (tick.command.flow or tick.command.flow_after):
                assert tick.frame and tick.status.state is ArmState.ARMED
                spans.append((tick.stamp, min([end, *(at for at in self._resting if tick.stamp < at)])))
        return spans

    def told(self) -> list[tuple[float, float]]:
        """The stretches in which the dispenser was told to be on."""
        spans, since = list[tuple[float, float]](), float("nan")
        for stamp, flow in [*self.bench.model.switches, (self.link.clock.now(), 0.0)]:
            if flow and np.isnan(since):
                since = stamp
            elif not flow and not np.isnan(since):
                spans.append((since, stamp))
                since = float("nan")
        return spans


def seen(now: float) -> SurfacePose:
    return _seen(round(now - 0.02, 2))


@cache
def _seen(stamp: float) -> SurfacePose:
    return pose_at(breathing, stamp)


def outside(spans: list[tuple[float, float]], allowed: list[tuple[float, float]]) -> float:
    """Seconds of spans that are in no allowed one, each of which may last SLACK longer."""
    instants = np.arange(0.0, max([end for _, end in spans], default=0.0), 0.0005)

    def within(parts: list[tuple[float, float]], slack: float) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
        return np.any([(instants >= a) & (instants < b + slack) for a, b in parts] or [instants < 0], axis=0)

    return float(0.0005 * (within(spans, 0.0) & ~within(allowed, SLACK)).sum())


BEGIN = [(0.0, Order.AT_HOME), (0.1, Order.ARM)]


@pytest.mark.slow
def test_a_print_switches_the_material_with_its_moves() -> None:
    run = Printing(BEGIN).run(14.0)
    told = run.told()
    assert len(told) == 1 and outside(told, run.allowed()) == 0.0
    extruding = [tick.stamp for tick in run.ticks if isinstance(tick.command, Move) and tick.command.extrude]
    lead = GEL.on_delay - run.link.arm.profile.lag
    assert told[0][0] == pytest.approx(extruding[0] - lead, abs=0.025)
    records = run.material.records()
    assert [record.flow and record.flow > 0 for record in records if record.flow is not None][-2:] == [True, 0.0]


@pytest.mark.parametrize("instant", [5.0091, *slowly(5.0003, 5.0177)])
@pytest.mark.parametrize(
    "what", [Order.STOP, "blocked", "lost", *slowly(Order.DISARM, Order.HOME, Order.QUIT, "refused")]
)
def test_what_ends_extrusion_ends_the_material(what: Order | str, instant: float) -> None:
    orders = [(instant, what)] if isinstance(what, Order) else []

    def pose(now: float) -> SurfacePose | None:
        return replace(seen(now), state=TrackState.LOST) if what == "lost" and now >= instant else seen(now)

    def at(run: Printing, now: float) -> None:
        if what == "refused" and now >= instant:  # the guard alone knows of it: a hold follows the move directly
            run.motion._guard._limits = replace(run.motion._guard._limits, pose_age=0.001)

    port = PortFaults(blocked=[(instant, 5.4)]) if what == "blocked" else None
    run = Printing([*BEGIN, *orders], pose, port, at).run(5.3)
    assert len(run.told()) == 1 and outside(run.told(), run.allowed()) == 0.0
    assert instant - 0.001 < run.told()[0][1] < instant + (0.05 if what == "blocked" else 0.025)


@given(st.data())
@settings(max_examples=4, deadline=None)
def test_whatever_happens_it_is_on_only_with_a_move_that_was_sent(data: st.DataObject) -> None:
    instant = st.floats(2.0, 6.0)
    orders = data.draw(
        st.lists(st.tuples(instant, st.sampled_from([Order.STOP, Order.ARM, Order.DISARM, Order.HOME])), max_size=4)
    )
    outages = data.draw(st.lists(st.tuples(instant, st.sampled_from(["lost", "none", "old", "unsure"])), max_size=3))
    blocked = data.draw(instant)

    def pose(now: float) -> SurfacePose | None:
        for at, kind in outages:
            if at <= now < at + 0.4:
                if kind == "none":
                    return None
                if kind == "old":
                    return seen(at)
                if kind == "lost":
                    return replace(seen(now), state=TrackState.LOST)
                return replace(seen(now), covariance=np.eye(6) * 25.0)
        return seen(now)

    pulled = data.draw(st.tuples(instant, st.floats(0.0, 1.0)))

    def at(run: Printing, now: float) -> None:
        run.bench.port.plugged = not pulled[0] <= now < sum(pulled)

    run = Printing(
        [*BEGIN, *sorted(orders, key=lambda each: each[0])], pose, PortFaults([(blocked, blocked + 0.15)]), at
    )
    run.run(6.5)
    assert not run.bench.open
    if run.bench.model.watchdog_stops:  # nothing could be said to it: its watchdog is all there is
        allowed = [(a, b + GEL.watchdog) for a, b in run.allowed() if GEL.watchdog]
        assert outside(run.told(), allowed) == 0.0
    else:
        assert outside(run.told(), run.allowed()) == 0.0


def test_a_switch_that_waits_is_dropped_with_the_move_and_one_that_is_due_is_made() -> None:
    bench = Bench(profile=GEL)
    material = MaterialControl(Dispensers([bench.driver]), raster())
    material.begin(0.0, bench.clock.now())
    bench.run(0.5)

    def told(command: Move | Hold, seconds: float) -> bool:
        material.follow(command, bench.clock.now())
        for _ in range(round(seconds / 0.001)):
            bench.clock.wait_until(bench.clock.now() + 0.001)
            material.poll(bench.clock.now())
        return bench.open

    move = Move(bench.clock.now(), np.zeros(6), 1.0, 1, extrude=True, flow=2.0, flow_after=0.01)
    assert not told(move, 0.008) and told(move, 0.004)
    assert not told(Hold(bench.clock.now(), 0.001, "held"), 0.001)
    late = replace(move, stamp=bench.clock.now())
    assert not told(late, 0.005) and not told(Hold(bench.clock.now(), 0.001, "held"), 0.05)
    assert told(replace(late, stamp=bench.clock.now(), flow_after=0.0), 0.001)
    closing = replace(move, stamp=bench.clock.now(), flow=0.0)
    assert told(closing, 0.008) and not told(closing, 0.004)


@pytest.mark.parametrize("instant", [4.0071, *slowly(4.0001, 4.0191)])
def test_a_stop_closes_within_a_poll(instant: float) -> None:
    run = Printing([*BEGIN, (instant, Order.STOP)]).run(4.5)
    assert run.told()[-1][1] - instant <= 0.0021


def test_a_dispenser_that_is_not_ready_or_fails_is_a_reason_and_nothing_is_told_on() -> None:
    heard: dict[float, tuple[str, str, bool]] = {}

    def at(run: Printing, now: float) -> None:
        run.bench.port.plugged = not 4.0 <= now < 5.0
        heard[round(now, 2)] = run.material.reason, run.material.status.text, run.bench.model.on
        if now >= 6.0 and "closed" in run.material.reason:
            run.material.begin(run.motion.progress.fraction, now)

    Printing(BEGIN, at=at).run(7.0)
    assert heard[3.9] == ("", "1 by gel: on", True)
    assert heard[4.5][0] == heard[4.5][1] == "dispenser gel is failed: the cable is out"
    assert "gel is closed" in heard[5.9][0] and not heard[5.9][2]
    assert heard[6.6][0] == "" and heard[6.6][2]


def test_whatever_ends_the_loop_closes_the_material() -> None:
    def at(run: Printing, now: float) -> None:
        if now > 4.0:
            raise KeyboardInterrupt

    run = Printing(BEGIN, at=at)
    with pytest.raises(KeyboardInterrupt):
        run.run(8.0)
    assert not run.bench.model.on and run.told()[-1][1] < 4.01


def test_an_arm_switches_the_material_with_its_own_frames() -> None:
    dialect = Dialect(pwm=0.0, pwm_on=1500.0)
    link = linked(profile=ArmProfile(dialect=dialect), stand=False)
    path, clock, ticks = raster(speed=10.0), link.clock, list[Tick]()
    material = MaterialControl(Dispensers([ArmPwmDispenser(GEL, 1500.0, 0.0)]), path)
    material.begin(0.0, 0.0)
    lost = (5.0, 5.5)

    def pose(now: float) -> SurfacePose | None:
        return None if lost[0] <= now < lost[1] else seen(now)

    outlets = {"1": Outlet(SwitchDelay(0.05, 0.05, with_moves=True))}
    motion, orders = MotionStep(path, link.arm.profile, 0.0, outlets), dict(BEGIN)

    def due() -> list[Order]:
        return [orders.pop(at) for at in list(orders) if at <= clock.now()]

    assert isinstance(clock, SimClock)
    MotionLoop(motion, link.arm, clock, lambda: pose(clock.now()), due, ticks.append, material=material).run(14.0)
    on = [bool(getattr(decode(tick.frame, dialect), "material", False)) for tick in ticks if tick.frame]
    flows = [isinstance(tick.command, Move) and tick.command.flow > 0 for tick in ticks if tick.frame]
    assert on == flows and 100 < sum(on) < len(on)
    state = False  # of the arm's output: a pause frame leaves it as it was
    for tick in ticks:
        if tick.frame:
            frame = decode(tick.frame, dialect)
            state = getattr(frame, "material", state)
            if not isinstance(tick.command, Move):
                assert not state


@given(
    st.lists(st.tuples(st.floats(0.018, 0.055), st.floats(0.5, 4.0), st.floats(0.0, 0.018)), min_size=2, max_size=20),
    st.integers(0, 20),
)
def test_an_arm_s_moves_are_given_all_that_flows_and_nothing_over_a_hold(
    ticks: list[tuple[float, float, float]], hold: int
) -> None:
    """ticks: s to the next one, mm^3/s that flow from then on, and s into a tick that opens or closes."""
    arm, clock, given_out, tick = (link := linked()).arm, link.clock, list[G1 | G4](), ArmProfile().tick
    send = arm.driver.send

    def noted(instruction: G1 | G4, now: float) -> Sequence[Sent]:
        given_out.append(instruction)
        return send(instruction, now)

    arm.driver.send = noted  # type: ignore[method-assign]
    flows, end = list[tuple[float, float]](), 0.0  # s, and mm^3/s from then on; s, when the last move ends
    for k, (gap, flow, after) in enumerate([*ticks, (0.03, 0.0, ticks[-1][2])]):
        now = clock.now()
        command: Command = Hold(now, 0.001, "")
        if k == hold < len(ticks):
            flows.append((end, 0.0))
        else:
            told = after if k in (0, hold + 1, len(ticks)) else 0.0
            axes = arm.profile.arm.home + [0.01 * (k + 1), 0, 0, 0, 0, 0]
            command, end = Move(now, axes, 1.0, 0, True, "", flow, told), now + tick
            flows.append((now + told, flow))
        assert arm.send(command, now) == ""
        while (now := clock.now()) < command.stamp + gap - 1e-9:
            arm.poll(now)
            clock.wait_until(min(now + 0.002, command.stamp + gap))
    stamps, values = np.array(flows).T
    volumes = [each.volume for each in given_out if isinstance(each, G1)]
    assert sum(volumes) == pytest.approx((values[:-1] * np.diff(stamps)).sum(), abs=4 * 0.002 + 1e-9)
    assert min(volumes) >= 0


def test_an_arm_that_was_given_no_move_for_longer_than_is_under_way_is_not_given_what_was_not_laid() -> None:
    arm, clock, given_out = (link := linked()).arm, link.clock, list[G1 | G4]()
    arm.driver.send = lambda instruction, now: given_out.append(instruction) or ()  # type: ignore[method-assign]
    for gap in (0.04, 0.3, 0.02):
        now = clock.now()
        assert arm.send(Move(now, arm.profile.arm.home + 0.01, 1.0, 0, True, "", 2.0), now) == ""
        clock.wait_until(now + gap)
    assert [each.volume for each in given_out if isinstance(each, G1)] == pytest.approx([0.04, 0.08, 0.04])


def test_another_temperature_on_the_path_is_waited_for() -> None:
    profile = replace(GEL, temperature_range=(4.0, 60.0))
    bench, path = Bench(profile=profile), raster()
    path = replace(path, temperature=np.array([20.0, 25, 25, 37, 37, 37]))
    material = MaterialControl(Dispensers([bench.driver]), path)
    material.begin(0.0, bench.clock.now())

    def told(checkpoint: int, seconds: float) -> str:
        for _ in range(round(seconds / 0.02)):
            now = bench.clock.now()
            material.follow(Move(now, np.zeros(6), 1.0, checkpoint, extrude=True, flow=2.0), now)
            bench.run(0.02)
            material.poll(bench.clock.now())
        return material.reason

    bench.run(30.0)
    assert bench.model.temperature_at(bench.clock.now()) == pytest.approx(25.0, abs=1.0) and told(1, 0.1) == ""
    assert bench.open
    assert "preparing" in told(3, 0.1) and not bench.open
    assert told(3, 30.0) == "" and bench.open
    assert bench.model.temperature_at(bench.clock.now()) == pytest.approx(37.0, abs=1.0)


@pytest.mark.parametrize(("asked", "told"), [(0.01, 0.5), (2.0, 2.0), (50.0, 4.0)])
def test_a_metered_flow_keeps_the_range_of_its_dispenser(asked: float, told: float) -> None:
    bench = Bench("new_era", DispenserProfile("gel", ("1",), metered=True, flow_range=(0.5, 4.0)))
    material = MaterialControl(Dispensers([bench.driver]), raster())
    material.begin(0.0, bench.clock.now())
    bench.run(1.0)
    now = bench.clock.now()
    material.follow(Move(now, np.zeros(6), 1.0, 1, extrude=True, flow=asked), now)
    bench.run(0.5)
    assert material.reason == "" and bench.driver.status.flow == pytest.approx(told)
    assert bench.open and bench.model.switches[-1][1] == pytest.approx(told, rel=1e-3)
