"""MotionStep: one frame a tick, the guard's word is last, nothing heavy loaded; a pause goes on where it left."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from estimation import se3
from estimation.errors import InputError
from estimation.pose import TrackState
from hardware.arm.driver import G1, G4
from hardware.arm.profile import ARM_FROM_BENCH, ArmProfile, placed
from hardware.arm.protocol import Dialect, decode, encode, frame_from_command, motion_from_frame
from hardware.motion.step import MotionStep
from hardware.process.clock import Clock, SimClock, WallClock
from planning.command import Hold, MotionLimits, Move, Refusal
from planning.kinematics import axes_from_nozzle, nozzle_from_axes
from planning.motion.curve import APPROACH_HEIGHT
from planning.path import PrintPhase
from tests.moving_surfaces import REST, Motion, breathing, pose_at, raster, still
from tests.slow_cases import slowly


def test_a_move_is_a_g1_frame_and_a_hold_a_g4_frame() -> None:
    motion = MotionStep(raster())
    hold = motion(None, 1.0)
    assert isinstance(hold, Hold) and hold.reason == "no pose yet"
    pause = decode(held := frame_from_command(hold))
    assert isinstance(pause, G4) and pause.duration == pytest.approx(0.001)
    wanted = motion(pose_at(breathing, 1.02), 1.02)
    assert isinstance(wanted, Move)
    move = decode(frame := frame_from_command(wanted))
    assert isinstance(move, G1) and np.allclose(move.axes, wanted.axes, atol=1e-4)
    assert move.feed == pytest.approx(wanted.feed, rel=1e-6)
    assert len(held) == len(frame) == 48
    for one in (held, frame):
        assert encode(motion_from_frame(one)) == one


def test_the_dialect_of_the_arm_is_spoken() -> None:
    dialect = Dialect(motion_byte=0, slots=("J5", "J4", "J6"))
    motion = MotionStep(raster(), ArmProfile(dialect=dialect))
    frame = frame_from_command(motion(pose_at(breathing, 1.0), 1.0), dialect)
    assert frame[2] == 0
    assert isinstance(decode(frame, dialect), G1)


def test_progress_counts_up_to_the_end() -> None:
    motion = MotionStep(raster(speed=10.0))
    seen = []
    for k in range(800):
        last = motion(pose_at(breathing, 1 + k * 0.02), 1 + k * 0.02)
        seen.append(motion.progress)
    assert [p.phase for p in (seen[0], seen[-1])] == [PrintPhase.ENTERING, PrintPhase.FINISHED]
    assert (np.diff([p.checkpoint for p in seen]) >= 0).all()
    assert (seen[0].checkpoint, seen[-1].checkpoint, seen[-1].total) == (0, 5, 6)
    assert seen[-1].place == seen[-1].length
    assert last == Hold(last.stamp, 0.001, "path finished")


def test_after_a_refusal_the_planner_knows_where_the_arm_stands() -> None:
    """A guard with a tighter box than the planner's: the arm stays at its wall, and does not jump when it opens."""
    motion = MotionStep(raster())
    wide = motion.profile.limits
    motion._guard._limits = replace(wide, low=np.array([-650, -650, 100, -1, -1, -1.0]))
    axes = [motion.profile.arm.home]
    for k in range(500):
        if k == 300:
            motion._guard._limits = wide
        last = motion(pose_at(breathing, 1 + k * 0.02), 1 + k * 0.02)
        axes.append(last.axes if isinstance(last, Move) else axes[-1])
        if isinstance(last, Hold):
            assert last.reason.startswith("refused: Z = ")
    heights = np.array(axes)[:, 2]
    assert 100 <= heights[:301].min() < 101
    assert heights[-1] < 95
    assert np.linalg.norm(np.diff(np.array(axes)[:, :3], axis=0), axis=1).max() <= wide.jump


def test_its_guard_knows_the_arms_lag_and_where_is_printed() -> None:
    lag, error = 0.2, MotionLimits().pose_error
    motion = MotionStep(raster(), ArmProfile(lag=lag))
    tick, home = motion.profile.tick, motion.profile.arm.home
    stay = Move(1.0, home, 5.0, 0, True)
    for seconds, passes in ((tick + lag, True), (tick + lag - 0.02, False)):  # in which the error grows to the limit
        rate = 0.99 * error / seconds
        drifting = replace(pose_at(still, 1.0), covariance=np.zeros((6, 6)))
        drifting = replace(drifting, twist_covariance=np.diag([0, 0, 0, rate**2, 0, 0]))
        assert isinstance(MotionStep(raster(), ArmProfile(lag=lag))._guard(stay, drifting, 1.0), Move) is passes
    speed = 0.9 * motion.profile.limits.surface_turn * 1e3  # mm/s, a metre away
    assert speed > motion.profile.limits.surface_speed
    far = ArmProfile(arm=replace(ArmProfile().arm, home=home + [300.0, 0, 0, 0, 0, 0]))
    turning = replace(pose_at(still, 1.0), twist=np.array([0, 0, 0.9 * far.limits.surface_turn, 0, 0, 0]))
    guard = MotionStep(raster(), far)._guard
    assert isinstance(guard(replace(stay, axes=far.arm.home), turning, 1.0), Move)


def test_after_moves_were_called_back_planner_and_guard_go_on_from_where_the_arm_stands() -> None:
    motion = MotionStep(raster(speed=10.0))
    moved = [motion(pose_at(breathing, 1 + k * 0.02), 1 + k * 0.02) for k in range(60)]
    back, last = moved[49], moved[-1]
    assert isinstance(back, Move) and isinstance(last, Move)
    limits, tick = motion.profile.limits, motion.profile.tick
    assert np.linalg.norm((last.axes - back.axes)[:3]) > limits.jump
    motion.recalled(back.axes, back.axes)
    again = motion(pose_at(breathing, 2.3), 2.3)
    assert isinstance(again, Move) and np.abs(again.axes - back.axes)[:3].max() <= limits.acceleration[0] * tick**2


def test_the_bytes_depend_on_the_input_only() -> None:
    def frames() -> bytes:
        motion, out = MotionStep(raster()), b""
        for k in range(400):
            pose = pose_at(breathing, 1 + k * 0.02)
            lost = 250 < k < 280
            command = motion(replace(pose, state=TrackState.LOST) if lost else pose, 1 + k * 0.02)
            out += frame_from_command(command)
        return out

    assert frames() == frames()


def test_an_empty_path_or_one_with_nan_never_gets_a_motion() -> None:
    path = raster()
    with pytest.raises(InputError, match="checkpoints = 0, allowed 2 or more"):
        MotionStep(replace(path, surface_from_nozzle=np.zeros((0, 4, 4))))
    with pytest.raises(InputError, match="speed = nan"):
        MotionStep(replace(path, speed=np.full(6, np.nan)))


def test_the_wire_carries_the_ticks() -> None:
    profile = ArmProfile()
    assert profile.frame_time == pytest.approx(1 / 240) and profile.tick == 1 / 50
    with pytest.raises(InputError, match="tick"):
        ArmProfile(baud=9600)  # a frame takes 50 ms
    with pytest.raises(InputError, match="tick"):
        ArmProfile(tick=1 / 241)
    assert ArmProfile(tick=1 / 239).tick == 1 / 239
    with pytest.raises(InputError, match="baud"):
        ArmProfile(baud=0)
    with pytest.raises(InputError, match="tool"):
        ArmProfile(tool=np.array([[0.0, 1.0]]))
    with pytest.raises(InputError, match="home"):
        ArmProfile(limits=MotionLimits(low=np.array([210.0, -650, -200, -1, -1, -1])))


def test_a_placed_arm_has_the_surface_on_its_bench() -> None:
    somewhere = se3.exp([2.0, -1.0, 0.5, 100, -300, 900])
    profile = placed(ArmProfile(), somewhere)
    assert np.allclose(axes_from_nozzle(profile.arm, somewhere), [*ARM_FROM_BENCH[:3, 3], 0, 0, 0], atol=1e-9)
    assert np.allclose(placed(ArmProfile(), REST, REST).arm.arm_from_base, np.eye(4))


@pytest.mark.parametrize("clock", [SimClock(5.0), WallClock()])
def test_clocks_wait_and_never_go_back(clock: Clock) -> None:
    start = clock.now()
    clock.wait_until(start - 1.0)
    assert start <= clock.now() < start + 1.0
    clock.wait_until(start + 0.03)
    assert start + 0.03 <= clock.now() < start + 3.0


PROFILE = ArmProfile()
AGE = 0.03  # s of a pose
Lost = Callable[[float], bool]  # whether the surface is LOST at a stamp, s


class Paused:
    """A motion that is paused for a while; each tick with the nozzle's height over the surface, mm, and the place."""

    def __init__(self, motion: Motion, between: tuple[float, float], seconds: float, lost: Lost) -> None:
        step = MotionStep(raster(speed=4.0), PROFILE)
        self.stamps, self.commands, self.heights, self.places = [], [], [], []
        self.phases: list[PrintPhase] = []
        axes = PROFILE.arm.home
        for now in np.arange(0.0, seconds, PROFILE.tick).tolist():
            step.paused = between[0] <= now < between[1]
            pose = pose_at(motion, now - AGE)
            command = step(replace(pose, state=TrackState.LOST) if lost(now) else pose, now)
            if isinstance(command, Move):
                axes = command.axes
            surface = motion(now + PROFILE.tick + PROFILE.lag)
            self.heights.append(float((se3.inverse(surface) @ nozzle_from_axes(PROFILE.arm, axes))[2, 3]))
            self.stamps.append(now)
            self.commands.append(command)
            self.places.append(step.progress.place)
            self.phases.append(step.progress.phase)


@pytest.mark.parametrize("motion", [breathing, *slowly(still)])
@pytest.mark.parametrize("gone", [(6.1, 6.3), *slowly((9.0, 9.0))])  # s: the surface is lost on the way up
def test_it_waits_above_the_surface_and_goes_on_where_it_left_off(motion: Motion, gone: tuple[float, float]) -> None:
    run = Paused(motion, (6.0, 9.0), 13.0, lambda now: gone[0] <= now < gone[1])
    stamps, heights, places = (np.array(x) for x in (run.stamps, run.heights, run.places))
    extrudes = np.array([isinstance(c, Move) and c.extrude for c in run.commands])
    assert not any(isinstance(c, Refusal) for c in run.commands if not gone[0] <= c.stamp < gone[1] + 0.3)
    waits = (stamps > 8.0) & (stamps < 9.0)
    sway = 5.0 if motion is breathing else 0.5  # mm: it stands, and the surface breathes below it
    assert heights[waits].min() > APPROACH_HEIGHT - 2 * sway and heights[waits].max() < APPROACH_HEIGHT + 2 * sway
    assert all(isinstance(c, Hold) for c, w in zip(run.commands, waits, strict=True) if w)
    pause = (stamps > 6.0) & (stamps < 9.0)
    assert not extrudes[pause].any() and np.ptp(places[pause]) == 0
    assert PrintPhase.RETREATING in run.phases
    assert extrudes[stamps < 6.0].any() and extrudes[stamps > 9.0].any()
    again = np.flatnonzero(extrudes & (stamps > 9.0))[0]
    assert abs(heights[again]) < 0.1 and places[again] - places[pause][0] < 0.2
    assert (np.diff(places) >= 0).all()


def test_a_pause_that_ends_on_the_way_up_leads_back_to_the_path() -> None:
    run = Paused(breathing, (6.0, 6.2), 10.0, lambda now: False)
    assert max(run.heights[round(6.0 / PROFILE.tick) :]) < APPROACH_HEIGHT + 1
    assert run.places[-1] > run.places[round(6.2 / PROFILE.tick)] + 2
