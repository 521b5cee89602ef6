"""Replay: poses and ticks merged by stamp, files that can be read, and the same bytes every time."""

from __future__ import annotations

import csv
import hashlib
import os
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from estimation.errors import InputError
from estimation.pose import SurfacePose, TrackState
from hardware.arm.profile import BENCH
from hardware.arm.protocol import G1, G4, decode
from hardware.motion.step import MotionStep
from hardware.offline.replay import COLUMNS, CommandWriter, placed_by, replay
from planning.command import Command, Hold, Move
from planning.kinematics import nozzle_from_axes
from tests.moving import breathing, pose_at, poses, raster

ROOT = Path(__file__).parents[1]
DIGEST = """
import hashlib
from hardware.motion.step import MotionStep
from hardware.offline.replay import replay
from tests.moving import breathing, poses, raster

frames = b"".join(f for _, _, f in replay(poses(breathing, 10.0), MotionStep(raster())))
print(hashlib.sha256(frames).hexdigest())
"""


class Listening(MotionStep):
    """A motion step that notes what it is given."""

    def __init__(self) -> None:
        super().__init__(raster())
        self.given: list[tuple[float, float | None]] = []

    def __call__(self, pose: SurfacePose | None, now: float) -> bytes:
        self.given.append((now, None if pose is None else pose.stamp))
        return super().__call__(pose, now)


@pytest.mark.parametrize("delay", [0.0, 0.05, 0.2])
def test_the_newest_pose_that_has_arrived_is_the_one_used(delay: float) -> None:
    motion, stream = Listening(), list(poses(breathing, 1.0))
    stamps = np.array([p.stamp for p in stream])
    list(replay(stream, motion, delay))
    for now, used in motion.given:
        arrived = stamps[stamps + delay <= now]
        assert used == (arrived[-1] if len(arrived) else None)
    ticks = np.array([now for now, _ in motion.given])
    assert ticks[0] == stamps[0]
    assert np.allclose(np.diff(ticks), 0.02)
    assert ticks[-2] < stamps[-1] + delay <= ticks[-1]
    assert motion.given[-1][1] == stamps[-1]


def test_poses_are_asked_for_only_when_they_are_due() -> None:
    asked: list[float] = []

    def stream() -> Iterator[SurfacePose]:
        for pose in poses(breathing, 1.0):
            asked.append(pose.stamp)
            yield pose

    for now, _, _ in replay(stream(), MotionStep(raster()), 0.05):
        assert asked[-1] <= now + 1 / 30 + 1e-9


def test_no_poses_are_no_ticks() -> None:
    assert list(replay([], MotionStep(raster()))) == []


def test_poses_out_of_order_are_refused() -> None:
    stream = list(poses(breathing, 0.5))
    with pytest.raises(InputError, match="stamp"):
        list(replay(stream[::-1], MotionStep(raster())))
    with pytest.raises(InputError, match="stamp"):
        list(replay([stream[0], replace(stream[1], stamp=np.nan)], MotionStep(raster())))


def test_a_delayed_loop_prints_the_path_on_a_breathing_surface() -> None:
    motion = MotionStep(raster())
    errors = []
    for now, command, _ in replay(poses(breathing, 20.0), motion):
        if isinstance(command, Move) and command.extrude:
            there = now + motion.profile.tick + motion.profile.lag
            tip = np.linalg.inv(breathing(there)) @ nozzle_from_axes(motion.profile.arm, command.axes)
            errors.append(abs(tip[2, 3]))
    assert motion.progress.place == pytest.approx(40.0)
    assert isinstance(motion.last, Hold)
    assert np.sqrt(np.mean(np.square(errors))) < 0.15  # mm along the normal; measured 0.100
    assert max(errors) < 0.2  # measured 0.153


def read(folder: Path) -> tuple[list[dict[str, str]], list[bytes]]:
    with (folder / "commands.csv").open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    frames = (folder / "frames.bin").read_bytes()
    assert len(frames) % 48 == 0
    return rows, [frames[i : i + 48] for i in range(0, len(frames), 48)]


def test_the_two_files_say_the_same(tmp_path: Path) -> None:
    commands: list[Command] = []
    with CommandWriter(tmp_path) as writer:
        for _, command, frame in replay(poses(breathing, 10.0), MotionStep(raster())):
            writer.write(command, frame)
            commands.append(command)
            assert (tmp_path / "frames.bin").stat().st_size == 48 * len(commands)  # nothing is kept back
    rows, frames = read(tmp_path)
    assert len(rows) == len(frames) == len(commands)
    assert tuple(rows[0]) == COLUMNS
    assert {row["kind"] for row in rows} == {"move", "hold"}
    for row, frame, command in zip(rows, frames, commands, strict=True):
        sent = decode(frame)
        assert float(row["stamp_s"]) == pytest.approx(command.stamp, abs=1e-6)
        if isinstance(sent, G1):
            shown = [float(row[name]) for name in COLUMNS[2:9]]
            assert np.allclose(
                shown, [*sent.axes[:3], *np.rad2deg(sent.axes[3:]), sent.feed * 60], rtol=1e-6, atol=2e-5
            )
            assert isinstance(command, Move)
            assert (row["checkpoint"], row["extrude"]) == (str(command.checkpoint), str(int(command.extrude)))
        else:
            assert isinstance(sent, G4)
            assert float(row["hold_ms"]) == pytest.approx(1.0)
            assert row["reason"]


def test_the_same_bytes_in_every_process() -> None:
    digests = set()
    for seed in ("0", "1"):
        environment = {**os.environ, "PYTHONHASHSEED": seed}
        done = subprocess.run(
            [sys.executable, "-c", DIGEST], cwd=ROOT, env=environment, capture_output=True, text=True, check=True
        )
        digests.add(done.stdout.strip())
    frames = b"".join(f for _, _, f in replay(poses(breathing, 10.0), MotionStep(raster())))
    assert digests == {hashlib.sha256(frames).hexdigest()}


def test_the_arm_is_placed_by_the_first_measured_pose_and_moves_only_then() -> None:
    def away(t: float) -> np.ndarray:
        return np.array([[0, -1, 0, 30], [-1, 0, 0, -50], [0, 0, -1, 700], [0, 0, 0, 1.0]]) @ breathing(t)

    stream = [pose_at(away, 10 + k / 30) for k in range(60)]
    unseen = [replace(p, state=TrackState.INITIALISING, base_from_surface=np.eye(4)) for p in stream[:20]]
    given, profile = placed_by([*unseen, *stream[20:]])
    assert np.allclose(profile.arm.arm_from_base @ stream[20].base_from_surface, BENCH, atol=1e-9)
    held = [isinstance(c, Hold) for _, c, _ in replay(given, MotionStep(raster(), profile), 0.05)]
    first_move = held.index(False)
    assert 10 + first_move * 0.02 >= stream[20].stamp + 0.05
    nothing, default = placed_by(unseen)
    assert len(list(nothing)) == 20
    assert np.array_equal(default.arm.arm_from_base, np.eye(4))
