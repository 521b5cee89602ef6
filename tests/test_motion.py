"""MotionStep: one frame a tick, the guard's word is the last, and nothing heavy is loaded."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from estimation import se3
from estimation.errors import InputError
from estimation.pose import TrackState
from hardware.arm.profile import BENCH, ArmProfile, placed
from hardware.arm.protocol import G1, G4, Dialect, decode
from hardware.motion.step import MotionStep
from hardware.process.clock import Clock, SimClock, WallClock
from planning.command import Hold, Move
from planning.kinematics import axes_from_nozzle
from planning.limits import Limits
from planning.progress import Phase
from tests.moving import REST, breathing, pose_at, raster


def test_a_move_is_a_g1_frame_and_a_hold_a_g4_frame() -> None:
    motion = MotionStep(raster())
    hold = motion(None, 1.0)
    assert isinstance(motion.last, Hold)
    assert motion.last.reason == "no pose yet"
    pause = decode(hold)
    assert isinstance(pause, G4)
    assert pause.duration == pytest.approx(0.001)
    frame = motion(pose_at(breathing, 1.02), 1.02)
    assert isinstance(motion.last, Move)
    move = decode(frame)
    assert isinstance(move, G1)
    assert np.allclose(move.axes, motion.last.axes, atol=1e-4)
    assert move.feed == pytest.approx(motion.last.feed, rel=1e-6)
    assert len(hold) == len(frame) == 48


def test_the_dialect_of_the_arm_is_spoken() -> None:
    dialect = Dialect(motion_byte=0, slots=("J5", "J4", "J6"))
    motion = MotionStep(raster(), ArmProfile(dialect=dialect))
    frame = motion(pose_at(breathing, 1.0), 1.0)
    assert frame[2] == 0
    assert isinstance(decode(frame, dialect), G1)


def test_progress_counts_up_to_the_end() -> None:
    motion = MotionStep(raster(speed=10.0))
    seen = []
    for k in range(800):
        motion(pose_at(breathing, 1 + k * 0.02), 1 + k * 0.02)
        seen.append(motion.progress)
    assert [p.phase for p in (seen[0], seen[-1])] == [Phase.ENTERING, Phase.FINISHED]
    assert (np.diff([p.checkpoint for p in seen]) >= 0).all()
    assert (seen[0].checkpoint, seen[-1].checkpoint, seen[-1].total) == (0, 5, 6)
    assert seen[-1].place == seen[-1].length
    assert motion.last == Hold(motion.last.stamp, 0.001, "path finished")


def test_after_a_refusal_the_planner_knows_where_the_arm_stands() -> None:
    """A guard with a tighter box than the planner's: the arm stays at its wall, and does not jump when it opens."""
    motion = MotionStep(raster())
    wide = motion.profile.limits
    motion._guard._limits = replace(wide, low=np.array([-650, -650, 100, -1, -1, -1.0]))
    axes = [motion.profile.arm.home]
    for k in range(500):
        if k == 300:
            motion._guard._limits = wide
        motion(pose_at(breathing, 1 + k * 0.02), 1 + k * 0.02)
        axes.append(motion.last.axes if isinstance(motion.last, Move) else axes[-1])
        if isinstance(motion.last, Hold):
            assert motion.last.reason.startswith("refused: Z = ")
    heights = np.array(axes)[:, 2]
    assert 100 <= heights[:301].min() < 101
    assert heights[-1] < 95
    assert np.linalg.norm(np.diff(np.array(axes)[:, :3], axis=0), axis=1).max() <= wide.jump


def test_the_bytes_depend_on_the_input_only() -> None:
    def frames() -> bytes:
        motion, out = MotionStep(raster()), b""
        for k in range(400):
            pose = pose_at(breathing, 1 + k * 0.02)
            lost = 250 < k < 280
            out += motion(replace(pose, state=TrackState.LOST) if lost else pose, 1 + k * 0.02)
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
    assert profile.frame_time == pytest.approx(1 / 240)
    assert profile.tick == 1 / 50
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
        ArmProfile(limits=Limits(low=np.array([210.0, -650, -200, -1, -1, -1])))


def test_a_placed_arm_has_the_surface_on_its_bench() -> None:
    somewhere = se3.exp([2.0, -1.0, 0.5, 100, -300, 900])
    profile = placed(ArmProfile(), somewhere)
    assert np.allclose(axes_from_nozzle(profile.arm, somewhere), [*BENCH[:3, 3], 0, 0, 0], atol=1e-9)
    assert np.allclose(placed(ArmProfile(), REST, REST).arm.arm_from_base, np.eye(4))


@pytest.mark.parametrize("clock", [SimClock(5.0), WallClock()])
def test_clocks_wait_and_never_go_back(clock: Clock) -> None:
    start = clock.now()
    clock.wait_until(start - 1.0)
    assert start <= clock.now() < start + 1.0
    clock.wait_until(start + 0.03)
    assert start + 0.03 <= clock.now() < start + 3.0
