"""Replay: poses and ticks merged by stamp, the same bytes every time; changes of reference recordings are found."""

from __future__ import annotations

import csv
import hashlib
import json
import os
import subprocess
import sys
from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from estimation.errors import InputError
from estimation.pose import SurfacePose, TrackState
from hardware.arm.driver import G1, G4, Pause
from hardware.arm.profile import ARM_FROM_BENCH, ArmProfile
from hardware.arm.protocol import FRAME_LENGTH, decode, encode
from hardware.motion.loop import Tick
from hardware.motion.step import BeginPrint, MotionStep
from hardware.offline.replay import COMMAND_COLUMNS, POSE_DELAY_S, CommandWriter, placed_by, replay
from planning.command import Command, Hold, Move
from planning.kinematics import nozzle_from_axes
from planning.path import PrintProgress
from tests import process_replay, reference_cases
from tests.moving_surfaces import breathing, pose_at, poses, raster
from tests.pinned_arithmetic import ENVIRONMENT, PACKAGES, made_with, run_pinned, unlike
from tests.reference_cases import CASES, FOLDER, Arrays, kept, recorded_tracks, replayed
from tests.reference_signals import changes, differing

ROOT = Path(__file__).parents[1]
DIGEST = """
import hashlib
from tests.moving_surfaces import breathing, poses
from tests.test_replay import replayed_print

print(hashlib.sha256(replayed_print(poses(breathing, 10.0))[1]).hexdigest())
"""


def replayed_print(
    stream: Iterable[SurfacePose], delay: float = POSE_DELAY_S, profile: ArmProfile | None = None
) -> tuple[list[tuple[Tick, PrintProgress]], bytes]:
    """Each tick of the raster's print on these poses, and the bytes that the arm was sent."""
    ticks, sent = list[tuple[Tick, PrintProgress]](), bytearray()
    order = BeginPrint(raster(), profile or ArmProfile(), 0.0, {}, "")
    replay(stream, order, lambda tick, progress: ticks.append((tick, progress)), sent.extend, delay)
    return ticks, bytes(sent)


@pytest.mark.parametrize("delay", [0.0, 0.05, 0.2])
def test_the_newest_pose_that_has_arrived_is_the_one_used(delay: float, monkeypatch: pytest.MonkeyPatch) -> None:
    given, stream = list[tuple[float, float | None]](), list(poses(breathing, 1.0))
    stamps = np.array([p.stamp for p in stream])
    decides = MotionStep.__call__

    def listening(self: MotionStep, pose: SurfacePose | None, now: float) -> Command:
        given.append((now, None if pose is None else pose.stamp))
        return decides(self, pose, now)

    monkeypatch.setattr(MotionStep, "__call__", listening)
    ticks, _ = replayed_print(stream, delay)
    for instant, used in given:  # a tick may be made up to half of one before its instant
        arrived = stamps[stamps + delay <= instant]
        assert used is None or used in arrived
        assert used is None or used >= stamps[stamps + delay <= instant - 0.02][-1:].max(initial=0.0)
    instants = np.array([tick.stamp for tick, _ in ticks])
    assert 0.019 < np.median(np.diff(instants)) < 0.021 and np.diff(instants).min() > 0.0
    assert stamps[-1] + delay - 0.05 < instants[-1] < stamps[-1] + delay + 0.05


def test_poses_are_asked_for_only_when_they_are_due() -> None:
    asked: list[float] = []

    def stream() -> Iterator[SurfacePose]:
        for pose in poses(breathing, 1.0):
            asked.append(pose.stamp)
            yield pose

    order, ahead = BeginPrint(raster(), ArmProfile(), 0.0, {}, ""), list[float]()
    replay(stream(), order, lambda tick, progress: ahead.append(asked[-1] - tick.stamp))
    assert max(ahead) <= 1 / 30 - POSE_DELAY_S + 0.02 + 1e-9


def test_no_poses_are_no_ticks_and_poses_out_of_order_are_refused() -> None:
    assert replayed_print([]) == ([], b"")
    stream = list(poses(breathing, 0.5))
    with pytest.raises(InputError, match="stamp"):
        replayed_print(stream[::-1])
    with pytest.raises(InputError, match="stamp"):
        replayed_print([stream[0], replace(stream[1], stamp=np.nan)])


def test_a_delayed_loop_prints_the_path_on_a_breathing_surface() -> None:
    errors, profile = [], ArmProfile()
    ticks, _ = replayed_print(poses(breathing, 20.0))
    for tick, _ in ticks:
        command = tick.command
        if isinstance(command, Move) and command.extrude:
            there = command.stamp + profile.tick + profile.lag
            tip = np.linalg.inv(breathing(there)) @ nozzle_from_axes(profile.arm, command.axes)
            errors.append(abs(tip[2, 3]))
    assert ticks[-1][1].place == pytest.approx(40.0)
    assert isinstance(ticks[-1][0].command, Hold)
    assert np.sqrt(np.mean(np.square(errors))) < 0.15  # mm along the normal; measured 0.100
    assert max(errors) < 0.2  # measured 0.153


def test_no_more_is_under_way_than_the_link_lets_and_the_arm_is_stopped_at_the_end() -> None:
    ticks, sent = replayed_print(poses(breathing, 3.0))
    assert max(tick.status.in_flight for tick, _ in ticks) <= 0.05 + 1e-9
    assert sent[-FRAME_LENGTH:] == encode(Pause())


def read(folder: Path) -> tuple[list[dict[str, str]], list[bytes]]:
    with (folder / "commands.csv").open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    frames = (folder / "frames.bin").read_bytes()
    assert len(frames) % 48 == 0
    return rows, [frames[i : i + 48] for i in range(0, len(frames), 48)]


def test_the_two_files_say_the_same(tmp_path: Path) -> None:
    commands: list[Command] = []
    with CommandWriter(tmp_path) as writer:

        def report(tick: Tick, progress: PrintProgress) -> None:
            writer.write(tick.command)
            if tick.frame:
                commands.append(tick.command)

        replay(poses(breathing, 10.0), BeginPrint(raster(), ArmProfile(), 0.0, {}, ""), report, writer.send)
    rows, frames = read(tmp_path)
    rows = [row for row in rows if not row["reason"].startswith(("the arm is", "what was", "50 ms"))]
    own, *frames = [frame for frame in frames if isinstance(decode(frame), G1 | G4)]
    assert np.allclose(decode(own).axes, ArmProfile().arm.home)  # armed, the arm first goes to where it should stand
    assert len(frames) == len(commands) <= len(rows) and tuple(rows[0]) == COMMAND_COLUMNS
    assert {row["kind"] for row in rows} == {"move", "hold"}
    told = {row["stamp_s"]: row for row in rows}
    for frame, command in zip(frames, commands, strict=True):
        sent, row = decode(frame), told[f"{command.stamp:.6f}"]
        if isinstance(sent, G1):
            shown = [float(row[name]) for name in COMMAND_COLUMNS[2:9]]
            numbers = [*sent.axes[:3], *np.rad2deg(sent.axes[3:]), sent.feed * 60]
            assert np.allclose(shown, numbers, rtol=1e-6, atol=2e-5)
            assert isinstance(command, Move)
            assert (row["checkpoint"], row["extrude"]) == (str(command.checkpoint), str(int(command.extrude)))
        else:
            assert isinstance(sent, G4) and float(row["hold_ms"]) == pytest.approx(1.0)
            assert row["reason"]


@pytest.mark.slow  # the process replay of `make check`, and test_loop_replay
def test_the_same_bytes_in_every_process() -> None:
    environment = {**os.environ, "PYTHONHASHSEED": "1"}
    command = [sys.executable, "-c", DIGEST]
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == hashlib.sha256(replayed_print(poses(breathing, 10.0))[1]).hexdigest()


def test_the_arm_is_placed_by_the_first_measured_pose_and_moves_only_then() -> None:
    def away(t: float) -> np.ndarray:
        return np.array([[0, -1, 0, 30], [-1, 0, 0, -50], [0, 0, -1, 700], [0, 0, 0, 1.0]]) @ breathing(t)

    stream = [pose_at(away, 10 + k / 30) for k in range(60)]
    unseen = [replace(p, state=TrackState.INITIALISING, base_from_surface=np.eye(4)) for p in stream[:20]]
    given, profile = placed_by([*unseen, *stream[20:]])
    assert np.allclose(profile.arm.arm_from_base @ stream[20].base_from_surface, ARM_FROM_BENCH, atol=1e-9)
    ticks, _ = replayed_print(given, 0.05, profile)
    moved = next(tick for tick, _ in ticks if isinstance(tick.command, Move))
    assert moved.stamp >= stream[20].stamp + 0.05
    nothing, default = placed_by(unseen)
    assert len(list(nothing)) == 20
    assert np.array_equal(default.arm.arm_from_base, np.eye(4))


@pytest.fixture(scope="module")
def now() -> Arrays:
    """What comes of a recording in whatever arithmetic this machine has."""
    return replayed("outage")


def test_references_are_small() -> None:
    assert sum(file.stat().st_size for file in FOLDER.rglob("*") if file.is_file()) < 700_000


def test_another_arithmetic_changes_nothing_but_the_last_digits(now: Arrays) -> None:
    before = kept("outage")
    other = differing(before, now)
    assert process_replay.passes("outage", other, changes(before, now), ["another kind of processor"])


def test_the_recording_shows_what_it_is_there_for(now: Arrays) -> None:
    assert {"TRACKING", "DEGRADED", "COASTING"} <= set(now["pose state"].tolist())
    assert now["tick extrude"].any() and (now["tick checkpoint"] < 0).any()
    assert len(recorded_tracks("outage")) == len(now["pose stamp"])


@pytest.mark.parametrize("case", CASES)
def test_one_bit_of_what_is_kept_is_found(case: str) -> None:
    before = kept(case)
    for name in before:
        after = {key: array.copy() for key, array in before.items()}
        row = len(after[name]) // 2
        if after[name].dtype.kind == "U":
            after[name][row] = "LOST" if name == "pose state" else "?"
        else:
            after[name].view(np.uint8).reshape(len(after[name]), -1)[row, 0] ^= 1
        assert set(differing(before, after)) == {name}
        if case != "pictures":
            found = changes(before, after) if "stamp" not in name else []
            assert not process_replay.passes(case, differing(before, after), found, [])


def test_what_rounding_cannot_do_is_no_rounding() -> None:
    before = kept("outage")
    for name, by in (("pose base_from_surface", 1e-3), ("pose twist", 0.1), ("tick axes", 1e-3), ("tick feed", 0.1)):
        after = before | {name: before[name] + by}
        assert not process_replay.passes("outage", differing(before, after), changes(before, after), ["another kind"])
    fewer = {name: array[:-1] if name.startswith("tick") else array for name, array in before.items()}
    assert not process_replay.passes("outage", differing(before, fewer), changes(before, fewer), ["another kind"])
    never = before | {"tick extrude": np.zeros_like(before["tick extrude"])}
    assert not process_replay.passes("outage", differing(before, never), changes(before, never), ["another kind"])


def test_a_change_is_told_with_a_picture_and_taken_by_one_command(
    tmp_path: Path, now: Arrays, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "outage").mkdir()
    for module in (process_replay, reference_cases):
        monkeypatch.setattr(module, "FOLDER", tmp_path)
    monkeypatch.setattr(process_replay, "ROOT", tmp_path)
    monkeypatch.setattr(process_replay, "MADE_WITH", tmp_path / "made_with.json")
    monkeypatch.setattr(process_replay, "PAGE", tmp_path / "out" / "references.html")
    monkeypatch.setattr(process_replay, "replayed", lambda case: now)
    assert process_replay.main(["--case", "outage"]) == 1 and "nothing is kept of it yet" in capsys.readouterr().out
    assert process_replay.main(["--case", "outage", "--update"]) == 0
    assert process_replay.main(["--case", "outage"]) == 0 and not process_replay.PAGE.exists()
    lower = now["tick axes"].copy()
    lower[100:, 2] -= 0.25
    monkeypatch.setattr(process_replay, "replayed", lambda case: now | {"tick axes": lower})
    capsys.readouterr()
    assert process_replay.main(["--case", "outage"]) == 1
    said, page = capsys.readouterr().out, process_replay.PAGE.read_text(encoding="utf-8")
    assert "axis Z by up to 0.25 mm from 2.010 s on" in said and "make references" in said
    assert "change of axis Z, mm" in page and "change of axis X" not in page
    assert process_replay.main(["--case", "outage", "--update"]) == 0
    assert process_replay.main(["--case", "outage"]) == 0


def test_bits_are_asked_for_only_where_the_same_libraries_run(monkeypatch: pytest.MonkeyPatch) -> None:
    made = json.loads((FOLDER / "made_with.json").read_text(encoding="utf-8"))
    assert set(made) == set(made_with()) >= set(PACKAGES)
    assert unlike(made_with() | {"numpy": "1.0"})[-1].endswith("not 1.0")
    monkeypatch.setattr("platform.machine", lambda: "aarch64")
    assert unlike(made_with())[0] == "the processor is aarch64, not x86_64"


def test_the_environment_reaches_the_libraries() -> None:
    asked = "import numpy; from numpy._core._multiarray_umath import __cpu_features__ as f; print(f['X86_V4'])"
    asked += "; import numba; print(numba.config.CPU_NAME)"
    environment = {**os.environ, **ENVIRONMENT}
    done = subprocess.run([sys.executable, "-c", asked], env=environment, capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["False", "haswell"]


@pytest.mark.slow
def test_a_constant_that_is_another_one_by_a_billionth_is_found(capfd: pytest.CaptureFixture[str]) -> None:
    if reasons := unlike(json.loads((FOLDER / "made_with.json").read_text(encoding="utf-8"))):
        pytest.skip("; ".join(reasons))
    changed = "import estimation.online.estimator as e\ne.ACCELERATION_PERSISTENCE_S *= 1 + 1e-9"
    assert run_pinned("tests.process_replay", ["--case", "outage"]) == 0
    assert run_pinned("tests.process_replay", ["--case", "outage"], changed) == 1
    assert "CHANGED" in capfd.readouterr().out
