"""The planner: within its limits whatever the poses do, on the path when they are good, at rest when they are not."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from estimation import se3
from estimation.pose import SurfacePose, TrackState
from estimation.se3 import Array
from estimation.surface_map import Warp
from planning.command import Command, Hold, MotionLimits, Move
from planning.kinematics import SimpleArm, axes_from_nozzle, nozzle_from_axes
from planning.motion.guard import Guard
from planning.motion.planner import Planner
from planning.path import Path, PrintPhase
from tests.campaigns.planner import StreamTally, bench_arm, follow_stream
from tests.moving_surfaces import REST, Motion, breathing, pose_at, raster, still
from tests.slow_cases import slowly

TICK, LIMITS, ARM = 0.02, MotionLimits(), SimpleArm()
CLOSE = SimpleArm(home=ARM.home - [0, 0, 62, 0, 0, 0])  # 1 mm above the surface, so that prints begin at once


@dataclass(frozen=True, slots=True, eq=False)
class Run:
    """What a planner and its guard did, tick by tick. axes: (T + 1, 6), the arm's place before the first tick first."""

    commands: Sequence[Command]
    axes: Array
    places: Array
    phases: Sequence[PrintPhase]

    @property
    def reasons(self) -> set[str]:
        return {c.reason for c in self.commands if isinstance(c, Hold)}


def run(
    path: Path, seen: Iterable[tuple[float, SurfacePose | None]], limits: MotionLimits = LIMITS, arm: SimpleArm = ARM
) -> Run:
    planner, guard = Planner(path, limits, arm, TICK), Guard(limits, arm, TICK, path.zone)
    commands: list[Command] = []
    axes, places, phases = [arm.home], [], []
    for now, pose in seen:
        wanted = planner(pose, now)
        given_out = guard(wanted, pose, now)
        assert given_out is wanted, given_out  # the planner stays within the guard's limits by itself
        commands.append(wanted)
        axes.append(wanted.axes if isinstance(wanted, Move) else axes[-1])
        places.append(planner.progress.place)
        phases.append(planner.progress.phase)
    return Run(commands, np.array(axes), np.array(places), phases)


def exact(motion: Motion, seconds: float, start: float = 10.0) -> Iterable[tuple[float, SurfacePose]]:
    """Perfect poses without delay."""
    for k in range(round(seconds / TICK)):
        yield start + k * TICK, pose_at(motion, start + k * TICK)


def over_limit(axes: Array, limits: MotionLimits) -> float:
    """The largest ratio of a difference quotient of axes (T, 6) to its limit."""
    quotients = [np.abs(np.diff(axes, n, axis=0)) / TICK**n for n in (1, 2, 3)]
    ratios = [q / limit for q, limit in zip(quotients, (limits.speed, limits.acceleration, limits.jerk), strict=True)]
    jump = np.linalg.norm(np.diff(axes[:, :3], axis=0), axis=1) / limits.jump
    turn = np.abs(np.diff(axes[:, 3:], axis=0)) / limits.turn
    return max(float(r.max()) for r in (*ratios, jump, turn))


def tips(result: Run, motion: Motion, start: float = 10.0) -> Array:
    """Where the nozzle's tip is on the true surface when each command is reached (T, 3)."""
    then = start + TICK * (np.arange(len(result.commands)) + 1)
    surfaces = np.stack([motion(float(t)) for t in then])
    return np.asarray((se3.inverse(surfaces) @ nozzle_from_axes(ARM, result.axes[1:]))[:, :3, 3])


def distance_to(points: Array, path: Path) -> Array:
    """Distances (N,) of points (N, 3) from the straight lines between checkpoints."""
    corners = path.surface_from_nozzle[:, :3, 3]
    a, b = corners[:-1], corners[1:]
    along = np.einsum("nki,ki->nk", points[:, None] - a, b - a) / np.sum((b - a) ** 2, axis=1)
    nearest = a + np.clip(along, 0, 1)[..., None] * (b - a)
    return np.asarray(np.linalg.norm(points[:, None] - nearest, axis=2).min(axis=1))


def extruding(result: Run) -> NDArray[np.bool_]:
    return np.array([isinstance(c, Move) and c.extrude for c in result.commands])


def moves_while(result: Run, phase: PrintPhase) -> list[Move]:
    return [c for c, p in zip(result.commands, result.phases, strict=True) if p is phase and isinstance(c, Move)]


@pytest.mark.parametrize("motion", [breathing, *slowly(still)])
def test_a_whole_print(motion: Motion) -> None:
    path = raster(speed=5.0)
    result = run(path, exact(motion, 16))
    order = list(dict.fromkeys(result.phases))
    assert order == [PrintPhase.ENTERING, PrintPhase.PRINTING, PrintPhase.LEAVING, PrintPhase.FINISHED]
    assert result.reasons == {"path finished"}
    assert over_limit(result.axes, LIMITS) <= 1
    printing, where = extruding(result), tips(result, motion)
    assert (np.diff(result.places) >= 0).all() and result.places[-1] == pytest.approx(40.0)
    off = distance_to(where[printing], path)
    rms, worst = (0.01, 0.05) if motion is still else (0.025, 0.06)  # mm; measured 0.004, 0.035 and 0.017, 0.041
    assert np.sqrt((off**2).mean()) < rms and off.max() < worst
    for corner in path.surface_from_nozzle[:, :3, 3]:
        assert np.linalg.norm(where[printing] - corner, axis=1).min() < 0.1  # cut by 0.05 mm, and half a tick
    steps = np.linalg.norm(np.diff(where, axis=0), axis=1)[printing[1:] & printing[:-1]] / TICK
    assert np.median(steps) == pytest.approx(5.0, rel=0.001)
    assert steps.max() < 5.0 * 1.08  # where the start is made good; measured 5.31
    assert not any(move.extrude for move in moves_while(result, PrintPhase.LEAVING))


def test_checkpoints_are_counted_and_their_extrusion_obeyed() -> None:
    path = raster(lines=3)
    quiet = replace(path, extrude=np.array([False, True, False, True, False, True]))
    moves = moves_while(run(quiet, exact(still, 16)), PrintPhase.PRINTING)
    assert list(dict.fromkeys(m.checkpoint for m in moves if m.extrude)) == [1, 3, 5]
    on_lines = {m.checkpoint for m in moves if not m.extrude}
    assert {2, 4} <= on_lines


@pytest.mark.parametrize("lag", [0.0, 0.03, 0.2])
def test_a_late_arm_is_sent_to_where_the_surface_will_be(lag: float) -> None:
    """A surface at constant velocity: what is commanded for a tick's end fits the surface `lag` s after it."""

    def gliding(t: float) -> Array:
        return REST @ se3.make(np.eye(3), np.array([12.0 * (t - 10), -5.0 * (t - 10), 0.0]))

    planner = Planner(raster(), LIMITS, CLOSE, TICK, lag)
    off = []
    for k in range(300):
        now = 10 + k * TICK
        command = planner(pose_at(gliding, now), now)
        if isinstance(command, Move) and command.extrude:
            surface = gliding(now + TICK + lag)
            place = planner._curve.poses(np.array([planner.progress.place]))[0]
            off.append(command.axes[:3] - (surface @ place)[:3, 3])
    assert len(off) > 50
    assert np.abs(off).max() < 0.02  # in corners and at the start
    assert np.median(np.abs(off)) < 1e-6


def test_progress_counts_in_checkpoints_too() -> None:
    planner = Planner(raster(lines=2, speed=10.0), LIMITS, CLOSE, TICK)
    for k in range(300):
        planner(pose_at(still, 10 + k * TICK), 10 + k * TICK)
        knots = planner._curve.knots
        i = min(int(planner.progress.fraction), len(knots) - 2)
        share = planner.progress.fraction - i
        assert np.isclose(planner.progress.place, knots[i] + share * (knots[i + 1] - knots[i]))
    assert planner.progress.fraction == planner.progress.total - 1


def test_the_speed_of_each_checkpoint_is_its_way_there() -> None:
    path = raster(size=8, lines=2)
    result = run(replace(path, speed=np.array([1.0, 4, 8, 2])), exact(still, 11), arm=CLOSE)
    moves = moves_while(result, PrintPhase.PRINTING)
    for checkpoint, speed in ((1, 4.0), (2, 8.0), (3, 2.0)):
        feeds = [m.feed for m in moves if m.checkpoint == checkpoint]
        assert np.median(feeds) == pytest.approx(speed, rel=0.05) and np.percentile(feeds, 80) < speed * 1.05


def test_an_outage_is_braked_held_and_resumed_where_it_stopped() -> None:
    def seen() -> Iterable[tuple[float, SurfacePose | None]]:
        for now, pose in exact(breathing, 16):
            lost = 12.0 <= now < 13.0
            yield now, replace(pose, state=TrackState.LOST, reason="covered by a hand") if lost else pose

    result = run(raster(), seen(), arm=CLOSE)
    assert result.reasons == {"surface is LOST: covered by a hand", "path finished"}
    assert over_limit(result.axes, LIMITS) <= 1
    stamps = np.array([c.stamp for c in result.commands])
    out = (stamps >= 12.0) & (stamps < 13.0)
    assert not extruding(result)[out].any()
    braking = sum(isinstance(c, Move) for c, o in zip(result.commands, out, strict=True) if o)
    assert 0 < braking <= 0.2 / TICK
    before, after = result.places[stamps < 12.0][-1], result.places[stamps >= 13.0]
    assert (result.places[out] == before).all()
    assert 0 < before < 40
    assert after[-1] == pytest.approx(40.0)
    printed = result.places[extruding(result)]
    assert np.diff(printed, prepend=0).max() < 0.25  # nothing is left out: no gap between two ticks that print
    assert (np.diff(printed) >= 0).all()  # nor printed twice


@pytest.mark.parametrize("motion", [breathing, *slowly(still)])
def test_one_pose_that_is_worth_nothing_costs_a_fifth_of_a_second(motion: Motion) -> None:
    seen = ((now, None if abs(now - 12.0) < TICK / 2 else pose) for now, pose in exact(motion, 3))
    result = run(raster(), seen, arm=CLOSE)
    stamps, printing = np.array([c.stamp for c in result.commands]), extruding(result)
    assert printing[stamps < 12.0 - TICK / 2][-1] and not printing[abs(stamps - 12.0) < TICK / 2].any()
    assert stamps[printing & (stamps > 12.0)][0] <= 12.2 + TICK / 2
    off = distance_to(tips(result, motion)[printing & (stamps > 12.0)], raster())
    assert off.max() < 0.06  # mm, as in a whole print: it is there when it prints
    assert over_limit(result.axes, LIMITS) <= 1


@pytest.mark.parametrize("lacks", ["age", "error"])
def test_what_a_pose_lacks_is_braked_for_before_the_guard_would_refuse(lacks: str) -> None:
    def seen() -> Iterable[tuple[float, SurfacePose]]:
        last = pose_at(breathing, 10.0)
        for now, pose in exact(breathing, 6):
            gone = now - 13.0
            if not 0 < gone < 1:
                last = pose
            worse = 0.7 * max(gone, 0.0) if gone < 1 else 0.0  # mm, over a second
            covariance = pose.covariance + worse**2 * np.diag([0, 0, 0, 1, 0, 0])
            yield now, last if lacks == "age" else replace(pose, covariance=covariance)

    result = run(raster(), seen(), arm=CLOSE)  # where the guard refuses nothing
    stamps, printing = np.array([c.stamp for c in result.commands]), extruding(result)
    assert printing[(stamps > 12.5) & (stamps <= 13.0)].all() and printing[stamps > 14.0].any()
    assert not printing[(stamps > 13.75) & (stamps < 14.0)].any()
    assert any(("old" if lacks == "age" else "is known to") in reason for reason in result.reasons)


def test_a_surface_that_jumps_is_found_again_before_printing_goes_on() -> None:
    def jumping(t: float) -> Array:
        return REST @ se3.exp([0, 0, 0, 0, 0, 0 if t < 12.0 else -4.0])

    path = raster()
    stamps = 10 + TICK * np.arange(700)
    result = run(path, [(t, replace(pose_at(jumping, t), twist=np.zeros(6))) for t in stamps.tolist()], arm=CLOSE)
    printing, where = extruding(result), tips(result, jumping)
    assert printing[stamps < 12.0 - TICK].any()
    assert result.reasons == {"path finished"}
    assert over_limit(result.axes, LIMITS) <= 1
    foreseen = ~((stamps < 12.0) & (stamps + TICK >= 12.0))  # not the tick during which it jumps
    assert distance_to(where[printing & foreseen], path).max() <= LIMITS.on_path
    printed = result.places[printing]
    assert printed[-1] == pytest.approx(40.0) and (np.diff(printed) >= 0).all()
    assert np.diff(printed, prepend=0).max() < 0.25  # no part of the path was passed without printing
    back = stamps[printing & (stamps >= 12.0)][0]
    assert 12.1 < back < 15.5  # up to 10 mm, and down again at 5 mm/s


@settings(max_examples=2)
@given(st.integers(0, 2**32 - 1))
def test_no_stream_of_poses_breaks_a_limit(seed: int) -> None:
    tally = StreamTally()
    follow_stream((seed, 0), tally, bench_arm(), 200)
    assert tally.samples == 200 and tally.max_shares.max() <= 1 + 1e-6
    assert (tally.refused, tally.errors) == (0, [])
    assert tally.twice < 1e-9


@pytest.mark.parametrize("seed", [0, *slowly(1, 2, 3)])
def test_nothing_is_printed_farther_off_the_path_than_may_be(seed: int) -> None:
    """Poses whose velocity is now and then off by some 12 mm/s, which no arm can follow at once."""
    draw = np.random.default_rng(seed)
    planner = Planner(raster(), LIMITS, CLOSE, TICK)
    off = []
    for k in range(300):
        now = 10 + k * TICK
        pose = pose_at(breathing, now)
        if draw.random() < 0.2:
            pose = replace(pose, twist=pose.twist + draw.normal(size=6) * [0.02, 0.02, 0.02, 12, 12, 12])
        command = planner(pose, now)
        if isinstance(command, Move) and command.extrude:
            place = planner._curve.poses(np.array([planner.progress.place]))[0]
            tip = nozzle_from_axes(CLOSE, command.axes)[:3, 3]
            off.append(np.linalg.norm(tip - (pose.predict(now + TICK).base_from_surface @ place)[:3, 3]))
    assert len(off) > 20 and 0.4 < max(off) <= LIMITS.on_path + 1e-9


def test_what_is_out_of_reach_is_held_with_its_axis_and_bounds() -> None:
    def far(t: float) -> Array:
        return breathing(t) @ se3.exp([0, 0, 0, 300.0, 0, 0])

    tight = replace(LIMITS, high=np.array([265.0, 650, 500, 1, 1, 1]))
    result = run(raster(), exact(far, 6), tight)
    assert any("out of reach: X = " in reason and "allowed -645 to 260 mm" in reason for reason in result.reasons)
    assert over_limit(result.axes, LIMITS) <= 1
    tilted = replace(LIMITS, high=np.array([650.0, 650, 500, 0.05, 1, 1]))
    assert any("A = " in r and "degrees" in r for r in run(raster(), exact(breathing, 3), tilted).reasons)


@pytest.mark.parametrize(
    ("motion", "words"),
    [
        (lambda t: REST @ se3.exp([0, 0, 0, 60 * (t - 10), 0, 0]), "surface moves at 60.0 mm/s, limit 50 mm/s"),
        (lambda t: REST @ se3.exp([0, 0, 0.8 * (t - 10), 0, 0, 0]), "degrees/s, limit 40 degrees/s"),
    ],
)
def test_a_surface_too_fast_is_not_chased(motion: Motion, words: str) -> None:
    near = replace(LIMITS, surface_speed=500.0) if "degrees" in words else LIMITS
    result = run(raster(), exact(motion, 0.5), near)
    assert np.array_equal(result.axes[-1], ARM.home) and all(words in reason for reason in result.reasons)


def test_without_any_pose_the_arm_stays_home() -> None:
    result = run(raster(), [(k * TICK, None) for k in range(20)])
    assert result.reasons == {"no pose yet"} and np.array_equal(result.axes[-1], ARM.home)


def test_a_stalled_caller_finds_the_arm_at_rest() -> None:
    seen = list(exact(still, 3))
    planner = Planner(raster(), LIMITS, ARM, TICK)
    moved = [planner(pose, now) for now, pose in seen[:100]]
    assert isinstance(moved[-1], Move) and moved[-1].feed > 10
    again = planner(seen[120][1], seen[120][0])
    assert isinstance(again, Move)
    assert np.linalg.norm(again.axes - moved[-1].axes) < 0.1  # from rest, not onwards at 20 mm/s


@given(st.integers(0, 10_000))
def test_axes_and_nozzle_are_one(seed: int) -> None:
    draw = np.random.default_rng(seed)
    pose = se3.exp(draw.normal(size=6) * [1, 1, 1, 300, 300, 300])
    arm = SimpleArm(pose, se3.exp_rotation(draw.normal(size=3)), tool_offset=draw.normal(size=3) * 5)
    axes = np.concatenate([draw.uniform(-500, 500, (5, 3)), draw.uniform(-1.5, 1.5, (5, 3))], axis=1)
    assert np.allclose(axes_from_nozzle(arm, nozzle_from_axes(arm, axes)), axes, atol=1e-9)


def test_in_the_simple_mode_the_angles_are_the_surfaces_own_turn() -> None:
    turn = se3.rotation_from_euler([0.1, -0.2, 0.3])
    upright = axes_from_nozzle(ARM, REST)
    tilted = axes_from_nozzle(ARM, REST @ se3.make(turn, np.zeros(3)))
    assert np.allclose(upright, [202.5, 225, 50, 0, 0, 0])
    assert np.allclose(tilted, [202.5, 225, 50, 0.1, -0.2, 0.3])


def test_a_surface_that_deforms_carries_the_checkpoints_with_it() -> None:
    bump = Warp(np.zeros((1, 3)), np.array([[0.3, -0.2, 1.0]]), 1e-4 * np.eye(3), np.zeros((3, 3)), 8.0, 0.4, 0.01)
    path, seconds = raster(size=6.0), 14.0
    seen = [(now, replace(p, warp=bump, state=TrackState.DEGRADED)) for now, p in exact(still, seconds)]
    result = run(path, seen, arm=CLOSE)
    printed = np.array([isinstance(c, Move) and c.extrude for c in result.commands])
    at = se3.inverse(REST) @ nozzle_from_axes(CLOSE, result.axes[1:][printed])
    off = bump.undo(at[:, :3, 3])
    assert printed.any() and np.abs(off[:, 2]).max() < 0.02  # the path lies in the plane of the undeformed surface
    assert at[:, 2, 3].max() > 0.9


def test_a_warp_that_is_not_known_well_enough_stops_the_print() -> None:
    vague = Warp(np.zeros((1, 3)), np.zeros((1, 3)), np.eye(3), np.zeros((3, 3)), 8.0, 0.4, 1.0)
    result = run(raster(), [(now, replace(p, warp=vague)) for now, p in exact(still, 0.2)], arm=CLOSE)
    assert any("the place under the nozzle is known to" in reason for reason in result.reasons)
    assert not any(isinstance(c, Move) for c in result.commands)
