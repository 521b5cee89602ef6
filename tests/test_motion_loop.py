"""The loop of the motion: a tick when it is due, a stop at once, and planner, guard and arm in one place."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from estimation.pose import SurfacePose, TrackState
from estimation.se3 import Array
from hardware.arm.device import BLIND_RESENDS, ArmState, LinkCode
from hardware.arm.profile import ArmProfile
from hardware.bench.link import LIVE_PARTS, run_part
from hardware.motion.loop import CommandedPose, MotionLoop, Order, Tick, TickMotion
from hardware.motion.step import MotionStep
from hardware.process.clock import Histogram, SimClock
from hardware.simulator.arm.settings import ArmSettings, ReplyMode
from planning.command import Hold, Move
from planning.kinematics import nozzle_from_axes
from tests.faulty_port import PortFaults
from tests.linked_arm import Linked, linked
from tests.moving_surfaces import breathing, pose_at, raster
from tests.virtual_arm import HOME, arm_fault

ROOT = Path(__file__).parents[1]


class Looping:
    """A motion loop on a virtual arm in virtual time; orders are given by instant."""

    def __init__(
        self,
        orders: dict[float, Order],
        link: Linked,
        pose: Callable[[float], SurfacePose | None],
        motion: TickMotion | None = None,
    ) -> None:
        self.link, self.ticks, self._orders = link, list[Tick](), dict(orders)
        self.motion = MotionStep(raster(speed=10.0), link.arm.profile)
        clock, report = link.clock, self.ticks.append
        self.homed = list[float]()  # s, when the arm had come home
        self.loop = MotionLoop(
            motion or self.motion, link.arm, clock, lambda: pose(clock.now()), self._due, report, self._begin_anew
        )

    def _begin_anew(self) -> None:
        self.homed.append(self.link.clock.now())
        begun = self.motion.progress.fraction
        self.loop.motion = self.motion = MotionStep(raster(speed=10.0), self.link.arm.profile, begun)

    def _due(self) -> list[Order]:
        due = [at for at in self._orders if at <= self.link.clock.now()]
        return [self._orders.pop(at) for at in due]

    def run(self, until: float) -> list[Tick]:
        self.loop.run(until)
        return self.ticks


def seen(now: float) -> SurfacePose:
    return pose_at(breathing, round(now - 0.02, 2))


ANSWERING = ArmSettings(servo_lag=0.02, replies=ReplyMode.STREAM)
START = {0.0: Order.AT_HOME, 0.1: Order.ARM}


def test_it_moves_only_between_arming_and_disarming() -> None:
    looping = Looping({**START, 2.0: Order.DISARM}, linked(stand=False), seen)
    ticks = looping.run(3.0)
    moving = [t.stamp for t in ticks if isinstance(t.command, Move)]
    assert 0.1 <= min(moving) < 0.13 and max(moving) < 2.0
    assert len(moving) == pytest.approx(1.9 / 0.02, abs=4)
    assert all("disarmed" in t.command.reason for t in ticks[:4] if isinstance(t.command, Hold))
    assert looping.link.virtual.frames == sum(bool(t.frame) for t in ticks) + 1  # to where it stands, when armed
    assert looping.link.arm.state is ArmState.DISARMED


def test_ticks_come_a_hair_slower_than_moves_last_so_that_no_queue_grows() -> None:
    looping = Looping(START, linked(stand=False), seen)
    ticks = looping.run(4.0)
    assert np.diff(np.array([t.stamp for t in ticks])) == pytest.approx(0.02 * 1.005, abs=1e-6)
    assert looping.link.virtual.peak_work <= 0.0245  # the first step, to where it stands, goes before a tick


def test_what_was_decided_is_what_arrives() -> None:
    looping = Looping({**START, 3.9: Order.DISARM}, linked(stand=False), seen)
    ticks = looping.run(4.0)
    looping.link.run(0.3)
    moves = [t.command for t in ticks if isinstance(t.command, Move)]
    assert looping.link.executed() == pytest.approx(moves[-1].axes, abs=1e-3)
    assert looping.motion.progress.checkpoint >= 1


def test_a_stop_waits_for_no_tick() -> None:
    for instant in (1.0001, 1.0051, 1.0111, 1.0191):
        looping = Looping({**START, instant: Order.STOP}, linked(stand=False), seen)
        looping.run(1.5)
        decided, on_wire = looping.link.arm.stops[0]
        assert decided - instant <= 0.0021 and on_wire - instant <= 0.010
        assert looping.link.arm.reason == "by the operator"


def test_after_a_stop_and_a_new_arming_the_print_goes_on_where_it_was() -> None:
    looping = Looping({**START, 2.0: Order.STOP, 3.0: Order.ARM}, linked(stand=False), seen)
    ticks = looping.run(9.0)
    before = [t for t in ticks if t.stamp < 2.0][-1]
    after = [t for t in ticks if t.stamp > 3.0]
    assert isinstance(after[-1].command, Move | Hold) and looping.motion.progress.checkpoint == 5
    assert isinstance(before.command, Move)
    axes = np.array([t.command.axes for t in ticks if isinstance(t.command, Move)])
    assert np.linalg.norm(np.diff(axes, axis=0)[:, :3], axis=1).max() <= 3.0
    assert not looping.link.virtual.ignored


def test_an_arm_far_from_home_is_not_armed_before_it_went_there() -> None:
    away = HOME + np.array([30.0, 0, 20, 0, 0, 0])
    link = linked(ArmSettings(servo_lag=0.01, replies=ReplyMode.STREAM), stand=False, begin=away)
    ticks = Looping({0.5: Order.ARM, 1.0: Order.HOME, 5.0: Order.ARM}, link, seen).run(6.0)
    assert any("from where the motion left off" in t.answer for t in ticks)
    assert {t.status.state for t in ticks if 4.5 < t.stamp < 5.0} == {ArmState.DISARMED}
    assert next(t for t in ticks if isinstance(t.command, Move)).stamp > 5.0


def test_at_home_the_motion_begins_anew_and_the_arm_is_armed_from_there() -> None:
    looping = Looping({**START, 2.0: Order.HOME, 8.0: Order.ARM}, linked(stand=False), seen)
    ticks = looping.run(8.05)
    moved = [t.command for t in ticks if isinstance(t.command, Move) and t.stamp < 2.0]
    assert np.linalg.norm((moved[-1].axes - HOME)[:3]) > 10  # farther than an arm goes back by itself
    assert len(looping.homed) == 1 and 2.0 < looping.homed[0] < 8.0
    assert {t.status.state for t in ticks if looping.homed[0] + 0.03 < t.stamp < 8.0} == {ArmState.DISARMED}
    assert looping.ticks[-1].answer == "" and looping.ticks[-1].status.state is ArmState.ARMED
    assert looping.link.executed() == pytest.approx(HOME, abs=3.0)


def test_an_arm_armed_again_stays_where_it_came_to_rest_when_moves_were_called_back() -> None:
    def gone(now: float) -> SurfacePose | None:
        return seen(now) if now < 1.3 else None

    link = linked(ANSWERING, arm_fault("stall 600ms at 1.2s"), stand=False)
    ticks = Looping({0.0: Order.AT_HOME, 0.5: Order.ARM, 3.0: Order.STOP, 3.5: Order.ARM}, link, gone).run(4.5)
    (stands,) = [t.recalled.stands for t in ticks if t.recalled is not None]
    sent = [t.command.axes for t in ticks if isinstance(t.command, Move)][-1]
    assert np.linalg.norm((sent - stands)[:3]) > 1.0
    assert ticks[-1].status.state is ArmState.ARMED and link.executed() == pytest.approx(stands, abs=0.01)


def test_what_the_link_does_not_send_is_told_as_a_hold() -> None:
    class Lunge:
        def __call__(self, pose: SurfacePose | None, now: float) -> Move:
            return Move(now, HOME + [20.0, 0, 0, 0, 0, 0], 100.0, 0, True)  # 0.2 s under way

        def recalled(self, place: Array, stands: Array) -> None: ...

    ticks = Looping(START, linked(stand=False), seen, Lunge()).run(0.3)
    assert ticks and all(isinstance(t.command, Hold) and t.frame == b"" for t in ticks)
    assert LinkCode.LIMIT in {t.hold for t in ticks} and ticks[-1].status.state is ArmState.STOPPED


@given(
    st.lists(st.tuples(st.floats(0.01, 0.05), st.booleans(), st.integers(0, 3)), min_size=1, max_size=12),
    st.floats(-0.2, 1.2),
    st.floats(0.0, 0.3),
)
def test_the_head_is_at_each_commands_end_a_tick_and_the_lag_after_it_was_sent(
    commands: list[tuple[float, bool, int]], share: float, lag: float
) -> None:
    profile = ArmProfile(lag=lag)
    commanded, now, place = CommandedPose(profile), 1.0, HOME
    due, places, flows = [], [], []
    for gap, extrude, kind in commands:
        now += gap
        move = bool(kind) or not due
        place = place + [0.3 * kind, -0.2, 0.1, 0, 0, 0] if move else place
        commanded.add(Move(now, place, 5.0, 0, extrude) if move else Hold(now, 0.001, ""), now)
        due.append(now + profile.tick + lag)
        places.append(place)
        flows.append(extrude and move)
    stamp = due[0] + share * (due[-1] - due[0]) + (share - 0.5) * 0.01
    head = commanded.at(stamp)
    if stamp < due[0]:
        assert head is None
        return
    assert head is not None
    axes = [np.interp(stamp, due, np.array(places)[:, k]) for k in range(3)]
    assert head.base_from_nozzle[:3, 3] == pytest.approx(
        nozzle_from_axes(profile.arm, np.array([*axes, 0, 0, 0]))[:3, 3]
    )
    under_way = int(np.searchsorted(due, stamp))
    assert head.extruding == (under_way < len(due) and flows[under_way])


def test_it_goes_on_from_the_last_move_that_was_sent_and_not_from_one_that_was_refused() -> None:
    looping = Looping({**START, 3.0: Order.ARM}, linked(stand=False), seen)
    motion, sent = looping.loop.motion, list[np.ndarray]()

    class Leaping:
        """Asks once for a move that the link refuses: 40 mm on, faster than any arm may go."""

        recalled = motion.recalled

        def __call__(self, pose: SurfacePose | None, now: float) -> Move | Hold:
            command = motion(pose, now)
            if 2.0 < now < 2.1 and isinstance(command, Move):
                return replace(command, axes=command.axes + [40.0, 0, 0, 0, 0, 0], feed=1e4)
            sent.append(command.axes if isinstance(command, Move) else sent[-1])
            return command

    looping.loop.motion = Leaping()
    ticks = looping.run(4.0)
    assert "feed of" in looping.link.arm.reason or any("feed of" in t.status.reason for t in ticks)
    again = [t for t in ticks if t.stamp > 3.0]
    assert not any("from where the motion left off" in t.answer for t in again)
    assert again[-1].status.state is ArmState.ARMED and isinstance(again[-1].command, Move)


def test_while_the_arm_is_held_the_motion_is_not_asked() -> None:
    link = linked(port=PortFaults(blocked=[(1.0, 1.15)]), stand=False)
    ticks = Looping(START, link, seen).run(2.0)
    held = [t for t in ticks if isinstance(t.command, Hold) and "taken no bytes" in t.command.reason]
    assert 4 <= len(held) <= 9
    assert max(link.virtual.peak_work, link.deepest) <= 0.05


def test_a_lost_surface_is_a_pause_on_the_wire_and_the_arm_at_rest() -> None:
    def lost(now: float) -> SurfacePose:
        return replace(seen(now), state=TrackState.LOST) if now > 1.0 else seen(now)

    looping = Looping(START, linked(stand=False), lost)
    ticks = looping.run(3.0)
    assert isinstance(ticks[-1].command, Hold) and len(ticks[-1].frame) == 48
    first, stop = 1, 1 + BLIND_RESENDS  # to where it stands; and the end, said again to an arm that does not answer
    assert looping.link.arm.frames == first + sum(bool(t.frame) for t in ticks) + stop


def test_a_late_tick_is_made_once_and_missed_ones_are_not_made_up() -> None:
    class Slow(SimClock):
        def wait_until(self, instant: float) -> None:
            late = 0.07 if 1.0 <= self.now() < 1.003 else 0.0
            super().wait_until(instant + late)

    link = linked(stand=False)
    link.clock.__class__ = Slow
    looping = Looping(START, link, seen)
    ticks = looping.run(2.0)
    assert looping.loop.skipped in (2, 3)
    assert np.diff([t.stamp for t in ticks]).max() > 0.06
    assert looping.loop.lateness.most > 0.005 and looping.loop.lateness.count == len(ticks)
    assert link.virtual.peak_work <= 0.05


def test_whatever_ends_it_the_arm_is_stopped() -> None:
    def broken(now: float) -> SurfacePose:
        if now > 1.0:
            raise RuntimeError("broken")
        return seen(now)

    looping = Looping(START, linked(stand=False), broken)
    with pytest.raises(RuntimeError):
        looping.run(2.0)
    assert looping.link.arm.state is ArmState.STOPPED
    looping.link.run(0.2)
    assert looping.link.virtual.in_flight == 0 and len(looping.link.arm.stops) == 1
    assert Looping({**START, 1.0: Order.QUIT}, linked(stand=False), seen).run(5.0)[-1].stamp < 1.03


def test_the_same_input_gives_the_same_bytes() -> None:
    runs = [Looping(START, linked(stand=False), seen).run(2.0) for _ in range(2)]
    assert b"".join(t.frame for t in runs[0]) == b"".join(t.frame for t in runs[1])


@pytest.mark.parametrize("seed", range(3))
def test_a_histogram_of_lateness_gives_percentiles_to_a_tenth_of_a_millisecond(seed: int) -> None:
    late = np.random.default_rng(seed).exponential(0.002, 5000)
    histogram = Histogram()
    assert np.isnan(histogram.percentile(50))
    for each in late:
        histogram.add(each)
    for share in (1, 50, 99, 100):
        assert histogram.percentile(share) == pytest.approx(np.percentile(late, share), abs=1.1e-4)
    assert histogram.most == late.max()


def test_a_percentile_is_never_cut_off_where_the_even_bins_end() -> None:
    late = np.random.default_rng(5).exponential(0.3, 4000)
    histogram = Histogram()
    for each in late:
        histogram.add(each)
    assert histogram.counts.sum() == len(late) and histogram.counts[-1] > len(late) / 2
    for share in (50, 95, 99):
        assert histogram.percentile(share) == pytest.approx(np.percentile(late, share), rel=0.025)
    assert histogram.percentile(100) == late.max()


def test_what_priority_was_granted_is_said() -> None:
    code = "from hardware.process.system import ask_for_real_time; print(ask_for_real_time())"
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout.split(",")[0].split(":")[0].strip() in {"real time", "nice -10", "nothing"}


def test_in_a_live_runs_processes_it_prints_over_a_pty_is_stopped_and_leaves_the_arm_at_rest() -> None:
    part = run_part(4.0, 1, 0, LIVE_PARTS[0])
    (arm,) = part.arms
    assert arm.frames > 60 and not (arm.garbage or arm.ignored or arm.refused or arm.left)
    assert part.stops and part.report is not None and part.report.progress is not None and part.rate > 25
    assert 0 < part.flight <= 0.05 and 0 < arm.deepest <= 0.05
