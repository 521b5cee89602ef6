"""Progress: any checkpoint can be resumed, in this run or a later one; nothing is deposited twice or left out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path as File

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from estimation.errors import InputError
from estimation.pose import SurfacePose, TrackState
from hardware.arm.profile import ArmProfile
from hardware.files.path_file import ProgressFile, read_progress
from hardware.motion.step import MotionStep
from planning.command import MotionLimits, Move
from planning.kinematics import SimpleArm
from planning.motion.planner import Planner
from planning.path import Path, PrintPhase, fingerprint, progress_mark, resume_fraction
from tests.moving_surfaces import breathing, pose_at, raster

TICK = 0.02
CLOSE = SimpleArm(home=SimpleArm().home - [0, 0, 61, 0, 0, 0])  # 2 mm above the surface
Interval = tuple[float, float]  # mm of path, from and to


def printed_by(planner: Planner, start: float, seconds: float, lost: Sequence[Interval] = ()) -> list[Interval]:
    """What is extruded of the path, tick by tick, on a breathing surface that is lost at times."""
    intervals, before = [], planner.progress.place
    for k in range(round(seconds / TICK)):
        now = start + k * TICK
        pose: SurfacePose = pose_at(breathing, now)
        if any(a <= now - start < b for a, b in lost):
            pose = replace(pose, state=TrackState.LOST)
        command = planner(pose, now)
        if isinstance(command, Move) and command.extrude:
            intervals.append((before, planner.progress.place))
        before = planner.progress.place
    return intervals


def assert_once(intervals: Sequence[Interval], path: Path) -> None:
    """Each place of the path lies in exactly one interval."""
    a, b = np.array(intervals).T
    assert (b > a).all()
    assert (a[1:] >= b[:-1] - 1e-9).all(), "deposited twice"
    assert (a[1:] <= b[:-1] + 1e-9).all(), "left out"
    length = np.linalg.norm(np.diff(path.surface_from_nozzle[:, :3, 3], axis=0), axis=1).sum()
    assert (a[0], b[-1]) == (pytest.approx(0.0, abs=1e-9), pytest.approx(length))


@settings(max_examples=4)
@given(st.lists(st.tuples(st.floats(0.2, 6), st.floats(0.02, 0.6)), max_size=3), st.floats(0.5, 5.0))
def test_outages_and_a_second_run_deposit_every_place_once(outages: list[Interval], cut: float) -> None:
    path = raster(size=4, lines=2, speed=4.0)
    lost = [(a, a + b) for a, b in outages]
    first = Planner(path, MotionLimits(), CLOSE, TICK)
    intervals = printed_by(first, 10.0, cut, lost)
    start = resume_fraction(path, progress_mark(path, first.progress))
    second = Planner(path, MotionLimits(), CLOSE, TICK, start=start)
    intervals += printed_by(second, 100.0, 12.0, [(1.0, 1.3)])
    assert second.progress.phase is PrintPhase.FINISHED
    assert_once(intervals, path)


@pytest.mark.parametrize("checkpoint", range(6))
def test_any_checkpoint_can_be_the_first(checkpoint: int) -> None:
    path = raster(size=2, lines=3)
    planner = Planner(path, MotionLimits(), CLOSE, TICK, start=checkpoint)
    assert (planner.progress.printed, planner.progress.fraction) == (checkpoint, checkpoint)
    intervals = printed_by(planner, 10.0, 6.0)
    steps = np.linalg.norm(np.diff(path.surface_from_nozzle[:, :3, 3], axis=0), axis=1)
    lengths = np.concatenate([[0.0], np.cumsum(steps)])
    assert planner.progress.phase is PrintPhase.FINISHED
    if checkpoint == 5:
        assert intervals == []
    else:
        assert intervals[0][0] == pytest.approx(lengths[checkpoint])
        assert intervals[-1][1] == pytest.approx(lengths[-1])


@pytest.mark.parametrize("left", [1e-3, 1e-6, 1e-7, 1e-9])
def test_a_last_bit_too_short_to_go_along_ends_the_print(left: float) -> None:
    planner = Planner(raster(size=2, lines=3), MotionLimits(), CLOSE, TICK, start=5 - left)
    printed_by(planner, 10.0, 6.0)
    assert planner.progress.phase is PrintPhase.FINISHED


def test_printed_printing_and_next_are_told() -> None:
    planner = Planner(raster(size=2, lines=2), MotionLimits(), CLOSE, TICK)
    seen = set()
    for k in range(250):
        planner(pose_at(breathing, 10 + k * TICK), 10 + k * TICK)
        p = planner.progress
        if p.phase is PrintPhase.PRINTING and p.fraction % 1 > 0:
            assert p.printed == p.checkpoint - 1
            seen.add((p.printed, p.checkpoint, p.next))
    assert seen == {(0, 1, 2), (1, 2, 3), (2, 3, None)}


def test_a_record_serves_a_later_run_of_the_same_path_and_no_other(tmp_path: File) -> None:
    path, file = raster(), tmp_path / "progress.toml"
    motion = MotionStep(path, ArmProfile(arm=CLOSE))
    keeper = ProgressFile(file, path)
    for k in range(150):
        motion(pose_at(breathing, 10 + k * TICK), 10 + k * TICK)
        keeper.write(motion.progress)
    assert [f.name for f in tmp_path.iterdir()] == ["progress.toml"]
    start = read_progress(file, path)
    assert start == motion.progress.fraction > 0
    assert MotionStep(path, start=start).progress.place == pytest.approx(motion.progress.place)
    ProgressFile(tmp_path / "again.toml", path).write(motion.progress)
    assert (tmp_path / "again.toml").read_bytes() == file.read_bytes()
    with pytest.raises(InputError, match="fingerprint of the path"):
        read_progress(file, replace(path, speed=path.speed * 2))


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "empty"),
        ("fraction = 1.0\nprinted = 1", "path = 'missing'"),
        ('path = "PATH"\nfraction = 7.0\nprinted = 7', "0 to 5 checkpoints"),
        ('path = "PATH"\nfraction = -0.1\nprinted = 0', "0 to 5 checkpoints"),
        ('path = "PATH"\nfraction = nan\nprinted = 0', "finite"),
    ],
)
def test_a_damaged_record_is_refused(tmp_path: File, text: str, words: str) -> None:
    file = tmp_path / "progress.toml"
    file.write_text(text.replace("PATH", fingerprint(raster())))
    with pytest.raises(InputError, match=words):
        read_progress(file, raster())


def test_a_start_beyond_the_path_is_refused() -> None:
    for start in (-0.1, 5.1, float("nan")):
        with pytest.raises(InputError, match="fraction"):
            Planner(raster(), MotionLimits(), CLOSE, TICK, start=start)


def test_every_column_counts_in_the_fingerprint() -> None:
    path = raster()
    other = {
        "surface_from_nozzle": path.surface_from_nozzle + 1e-9,
        "speed": path.speed + 1e-9,
        "material": path.material + 1,
        "temperature": path.temperature + 1,
        "layer": path.layer + 1,
        "extrude": ~path.extrude,
    }
    prints = {fingerprint(replace(path, **{name: value})) for name, value in other.items()}
    assert len(prints | {fingerprint(path)}) == len(other) + 1
