"""Material along the path: told early enough, told off in time, and never told on where nothing may leave."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from estimation.errors import InputError
from estimation.pose import SurfacePose, TrackState
from estimation.se3 import Array
from planning.command import Command, MotionLimits, Move
from planning.kinematics import SimpleArm, nozzle_from_axes
from planning.material import MAX_DELAY, Outlet, Outlets, SwitchDelay, material_plan, with_offsets
from planning.motion.guard import Guard
from planning.motion.planner import Planner
from planning.path import Path, PrintPhase, PrintProgress
from tests.moving_surfaces import Motion, breathing, path_through, pose_at, raster, still
from tests.slow_cases import slowly

TICK, LIMITS = 0.02, MotionLimits()
CLOSE = SimpleArm(home=SimpleArm().home - [0, 0, 62, 0, 0, 0])  # 1 mm above the surface: prints begin at once
START = 10.0  # s


@dataclass(frozen=True, slots=True, eq=False)
class Printed:
    """What was told and done, tick by tick."""

    commands: list[Command]
    progress: list[PrintProgress]

    @property
    def moves(self) -> list[Move]:
        return [command for command in self.commands if isinstance(command, Move)]

    def switches(self) -> list[tuple[float, bool]]:
        """Instants, s, at which the dispenser is told another state, and which."""
        told, found = False, []
        for command in self.commands:
            flow, after = (command.flow, command.flow_after) if isinstance(command, Move) else (0.0, 0.0)
            if (flow > 0) != told:
                told = not told
                found.append((command.stamp + after, told))
        return found

    def place(self, stamp: float, lag: float) -> float:
        """mm of the path at which the nozzle truly is at `stamp`, s."""
        stamps = [command.stamp + TICK + lag for command in self.commands]
        return float(np.interp(stamp, stamps, [progress.place for progress in self.progress]))


def printed(
    path: Path, seconds: float, lag: float = 0.0, outlets: Outlets | None = None, motion: Motion = still
) -> Printed:
    planner, guard = Planner(path, LIMITS, CLOSE, TICK, lag, 0.0, outlets), Guard(LIMITS, CLOSE, TICK, path.zone, lag)
    result = Printed([], [])
    for k in range(round(seconds / TICK)):
        now = START + k * TICK
        pose = pose_at(motion, now)
        wanted = planner(pose, now)
        assert guard(wanted, pose, now) is wanted
        result.commands.append(wanted)
        result.progress.append(planner.progress)
        if planner.progress.phase is PrintPhase.FINISHED:
            break
    return result


def gapped(speed: float = 5.0, gap: float = 3.0) -> Path:
    """Three beads of 6 mm in a row, and a gap after each."""
    x = np.cumsum([0.0, 6.0, gap, 6.0, gap, 6.0]) - 10.0
    path = path_through(np.column_stack([x, np.zeros((6, 2))]), speed)
    return replace(path, extrude=np.arange(6) % 2 == 1)


@pytest.mark.slow
@given(
    st.floats(0, MAX_DELAY),
    st.floats(0, MAX_DELAY),
    st.floats(0, 0.06),
    st.sampled_from([2.0, 5.0, 12.0]),
    st.sampled_from([still, breathing]),
)
@settings(max_examples=4, deadline=None)
def test_beads_begin_and_end_where_they_are_planned(
    on: float, off: float, lag: float, speed: float, motion: Motion
) -> None:
    path = gapped(speed, gap=max(3.0, speed * MAX_DELAY))
    result = printed(path, 60, lag, {"1": Outlet(SwitchDelay(on, off))}, motion)
    plan = material_plan(path, np.concatenate([[0.0], np.cumsum(np.diff(path.surface_from_nozzle[:, 0, 3]))]))
    switches = result.switches()
    assert [state for _, state in switches] == [True, False] * 3
    begins = [result.place(stamp + on, lag) for stamp, state in switches if state]
    ends = [result.place(stamp + off, lag) for stamp, state in switches if not state]
    tolerance = 0.02 + 0.002 * speed  # mm: a switch is timed to a millisecond, a horizon is timed anew under way
    assert np.abs(begins - plan.begins).max() < tolerance and np.abs(ends - plan.ends)[:-1].max() < tolerance
    assert (
        abs(ends[-1] - plan.ends[-1]) < tolerance + 0.006 * speed
    )  # where the path ends, in the tick in which it rests


def test_flow_follows_the_speed_of_a_metered_bead() -> None:
    path = gapped(5.0)
    path = replace(path, extra={"volume_mm3": np.array(["0", "3", "0", "1.5", "0", "3"])})
    moves = printed(path, 30, 0.024, {"1": Outlet(SwitchDelay(0.1, 0.1))}).moves
    flows = np.array([move.flow for move in moves])
    assert np.percentile(flows[flows > 0], 75) == pytest.approx(0.5 * 5.0, rel=0.02)  # 3 mm^3 on 6 mm: 0.5 mm^2
    assert flows.max() < 0.5 * 5.0 * 1.08
    between = [flow for move in moves if move.checkpoint == 3 and (flow := move.flow) > 0]
    assert np.median(between) == pytest.approx(0.25 * 5.0, rel=0.05)


@given(st.data())
@settings(max_examples=6, deadline=None)
def test_nothing_is_told_on_but_on_the_path_with_a_pose_to_trust(data: st.DataObject) -> None:
    lag, delay = data.draw(st.floats(0, 0.06)), data.draw(st.floats(0, MAX_DELAY))
    path, outlets = raster(6.0, 2, 5.0), {"1": Outlet(SwitchDelay(delay, delay))}
    planner, guard = Planner(path, LIMITS, CLOSE, TICK, lag, 0.0, outlets), Guard(LIMITS, CLOSE, TICK, path.zone, lag)
    faults = st.sampled_from(["", "", "", "lost", "old", "none", "unsure", "pause", "refused", "recalled"])
    axes, fault, led = CLOSE.home, "", 0
    for k in range(200):
        now = START + k * TICK
        if k % 10 == 0:
            fault = data.draw(faults)
        pose: SurfacePose | None = pose_at(breathing, now if fault != "old" else now - 0.5)
        assert pose is not None
        if fault == "lost":
            pose = replace(pose, state=TrackState.LOST)
        elif fault == "unsure":
            pose = replace(pose, covariance=np.diag([0.0, 0, 0, 9, 9, 9]))
        planner.paused = fault == "pause"
        command = guard(planner(pose if fault != "none" else None, now), pose if fault != "none" else None, now)
        if fault == "refused" and k % 10 == 5:
            planner.refused(guard.axes)
        if fault == "recalled" and k % 10 == 5 and isinstance(command, Move):
            planner.recalled(axes, axes)
            guard.stands(axes)
        if not isinstance(command, Move):
            continue
        axes = command.axes
        if not command.flow:
            continue
        led += 1
        assert fault in ("", "refused", "recalled")
        assert planner.progress.phase is PrintPhase.PRINTING
        nozzle = np.linalg.inv(breathing(now + TICK)) @ nozzle_from_axes(CLOSE, axes)
        assert (
            distance_to_path(nozzle[:3, 3], path) < LIMITS.on_path + 0.2 + 2 * lag
        )  # its pose is predicted by the lag


def distance_to_path(place: Array, path: Path) -> float:
    corners = path.surface_from_nozzle[:, :3, 3]
    a, b = corners[:-1], corners[1:]
    along = np.clip(np.einsum("nk,nk->n", place - a, b - a) / np.sum((b - a) ** 2, axis=1), 0, 1)
    return float(np.linalg.norm(a + along[:, None] * (b - a) - place, axis=1).min())


def test_a_wait_is_kept_on_the_moving_surface() -> None:
    path = replace(gapped(5.0), extra={"wait_s": np.array(["0", "0", "0", "1.5", "0", "0"])})
    result = printed(path, 30, 0.0, {"1": Outlet(SwitchDelay(0.1, 0.1))}, breathing)
    assert result.progress[-1].phase is PrintPhase.FINISHED
    at = [c.stamp for c, p in zip(result.commands, result.progress, strict=True) if p.place == pytest.approx(9.0)]
    assert 1.5 <= at[-1] - at[0] < 1.8
    resting = [move for move in result.moves if move.reason.startswith("rests for wait_s")]
    assert len(resting) == pytest.approx(1.5 / TICK, abs=3)
    for move in resting:
        nozzle = np.linalg.inv(breathing(move.stamp + TICK)) @ nozzle_from_axes(CLOSE, move.axes)
        assert np.linalg.norm(nozzle[:3, 3] - path.surface_from_nozzle[2, :3, 3]) < 0.1


def test_no_material_flows_while_a_bead_rests() -> None:
    path = replace(raster(6.0, 2, 5.0), extra={"wait_s": np.array(["0", "0", "1", "0"])})
    result = printed(path, 30, 0.0, {"1": Outlet(SwitchDelay(0.05, 0.05))})
    assert [state for _, state in result.switches()] == [True, False] * 2
    assert [result.place(stamp + 0.05, 0.0) for stamp, _ in result.switches()] == pytest.approx([0, 6, 6, 18], abs=0.05)


@pytest.mark.parametrize("offset", [(0.0, 20.0, 5.0), *slowly((0.0, 0.0, 0.0))])
def test_another_material_is_asked_for_above_the_surface(offset: tuple[float, float, float]) -> None:
    path = replace(gapped(5.0), material=np.array(["gel", "gel", "gel", "gel", "cells", "cells"]))
    outlets = {"gel": Outlet(SwitchDelay(0.1, 0.1)), "cells": Outlet(SwitchDelay(0.2, 0.1), offset)}
    path = with_offsets(path, outlets)
    planner, guard = Planner(path, LIMITS, CLOSE, TICK, 0.0, 0.0, outlets), Guard(LIMITS, CLOSE, TICK, path.zone)
    asked, tips, flows = 0, [], []
    for k in range(2000):
        now = START + k * TICK
        command = guard(planner(pose_at(still, now), now), pose_at(still, now), now)
        if planner.progress.phase is PrintPhase.FINISHED:
            break
        if planner.progress.wanted:
            asked += 1
            assert planner.progress.wanted == "cells" and not (isinstance(command, Move) and command.flow)
            if asked == 250:  # 5 s: long enough to go up and stand
                assert command.reason == "material cells is to be put in"
                planner.material_in()
        elif isinstance(command, Move):
            tips.append((np.linalg.inv(still(0)) @ nozzle_from_axes(CLOSE, command.axes))[:3, 3])
            flows.append(command.flow > 0)
    assert asked == 250 and planner.progress.phase is PrintPhase.FINISHED
    laid = np.array(tips)[flows]
    own = laid[laid[:, 0] > 7.9] + offset
    assert np.abs(own[:, 1:]).max() < 0.1 and own[:, 0].max() == pytest.approx(14.0 - 0.5, abs=0.6)


def test_another_nozzle_needs_a_way_without_material() -> None:
    path = replace(raster(6.0, 2, 5.0), material=np.array(["a", "a", "b", "b"]))
    with pytest.raises(InputError, match="extrude = 0"):
        with_offsets(path, {"b": Outlet(offset=(20.0, 0.0, 0.0))})


@pytest.mark.parametrize("text", ["-1", "nan", "soon", "1e9"])
def test_a_wait_that_is_no_time_is_refused(text: str) -> None:
    path = replace(raster(6.0, 2, 5.0), extra={"wait_s": np.array(["0", "0", text, "0"])})
    with pytest.raises(InputError, match="checkpoint 2: wait_s"):
        Planner(path, LIMITS, CLOSE, TICK)


@pytest.mark.parametrize("name", ["on", "off"])
def test_a_delay_that_cannot_be_led_is_refused(name: str) -> None:
    with pytest.raises(InputError, match=f"delay {name}"):
        SwitchDelay(**{name: MAX_DELAY + 0.01})
