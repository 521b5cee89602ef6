"""Damaged recordings: what was cut, killed, flipped or left no room keeps its whole chunks."""

from __future__ import annotations

import resource
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import SeekingReader

from estimation.errors import InputError, StillbedError
from hardware.arm.profile import ArmProfile, LinkSettings
from hardware.cli.main import main
from hardware.files.arm_file import write_arm
from hardware.files.mesh_file import write_ply
from hardware.files.rig_file import write_board
from hardware.live.prepared import rig_from_session
from hardware.offline.convert import import_folder
from hardware.recording import session_reader as channels
from hardware.recording.loop_record import LOOP_ARM_ATTACHMENT, LoopRecord
from hardware.recording.mcap_file import AttachedFile, ChunkMessages, Damage, walk
from hardware.recording.messages import message_from_rig
from hardware.recording.recorder import MAX_CHUNK_SECONDS, Recorder
from hardware.recording.session_reader import open_session
from tests.board_session import BOARD, rendered
from tests.command_processes import ROOT
from tests.recording_samples import whole_recording, write_frames
from tests.session_files import image, make_folder, rig, stamps
from tests.wound_scans import scan_of

SQUARE = ROOT / "data" / "paths" / "square_10mm.csv"


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return whole_recording(tmp_path_factory.mktemp("whole"))


@cache
def chunk_ends(path: Path) -> list[tuple[int, int]]:
    """End of each chunk, bytes, and the frames that can be read up to there."""
    with open(path, "rb") as file:
        summary = SeekingReader(file).get_summary()
    ends = []
    frames = 0
    chunks = {p.offset: p for p in walk(path) if isinstance(p, ChunkMessages)}
    for index in sorted(summary.chunk_indexes, key=lambda c: c.chunk_start_offset):
        frames += sum(m.topic == "/frames" for m in chunks[index.chunk_start_offset].messages)
        ends.append((index.chunk_start_offset + index.chunk_length, frames))
    return ends


@settings(max_examples=120)
@given(where=st.floats(0, 1), near=st.integers(-12, 12) | st.none(), pick=st.integers(0, 1000))
def test_a_cut_file_is_readable_to_its_last_whole_chunk(whole: Path, where: float, near: int | None, pick: int) -> None:
    data, ends = whole.read_bytes(), chunk_ends(whole)
    cut = int(where * (len(data) - 1)) if near is None else ends[pick % len(ends)][0] + near
    part = whole.parent / "cut.mcap"
    part.write_bytes(data[:cut])
    expected = max([frames for end, frames in ends if end <= cut], default=0)
    if cut < ends[0][0]:
        with pytest.raises(InputError):
            open_session(part)
        return
    session = open_session(part)
    assert sum(map(len, session.sets)) == expected
    assert len(list(session.frame_sets())) == len(session) and session.damage != ""
    assert sum(1 for _ in channels.read_poses(part)) >= expected // 2 - 1


def test_a_chunk_that_an_interrupted_run_wrote_twice_counts_once(whole: Path) -> None:
    data, ends = whole.read_bytes(), [end for end, _ in chunk_ends(whole)]
    starts = [p.offset for p in walk(whole) if isinstance(p, ChunkMessages)]
    again = whole.parent / "again.mcap"
    again.write_bytes(data[: ends[1]] + data[starts[1] : ends[1]] + data[ends[1] :])
    session = open_session(again)
    assert sum(map(len, session.sets)) == 48 == sum(len(s.frames) for s in session.frame_sets())


@settings(max_examples=60)
@given(where=st.floats(0.01, 0.999), bit=st.integers(0, 7))
def test_a_flipped_bit_never_gives_a_wrong_image(whole: Path, where: float, bit: int) -> None:
    data = bytearray(whole.read_bytes())
    data[int(where * len(data))] ^= 1 << bit
    part = whole.parent / "flip.mcap"
    part.write_bytes(data)
    session = open_session(part)  # the rig stands in two chunks
    frames = {(f.camera, f.stamp): f.image for s in session.frame_sets() for f in s.frames}
    original = {3 * stamp: number for number, stamp in enumerate(stamps(24, 0.0))}
    assert all(np.array_equal(i, image(c, original[s])) for (c, s), i in frames.items())
    assert len(frames) == 48 or session.damage


@settings(max_examples=150)
@given(where=st.floats(0, 1), near=st.integers(0, 40) | st.none(), pick=st.integers(0, 9), flip=st.integers(1, 255))
def test_one_wrong_byte_costs_one_chunk_and_is_told(
    whole: Path, where: float, near: int | None, pick: int, flip: int
) -> None:
    """near: bytes behind the beginning of a chunk, where its kind, length, times and check sum stand."""
    data, parts = bytearray(whole.read_bytes()), list(walk(whole))
    chunks = {part.offset: part for part in parts if isinstance(part, ChunkMessages)}
    at = int(where * (len(data) - 1)) if near is None else list(chunks)[pick % len(chunks)] + near
    data[at] ^= flip
    struck = whole.parent / "struck.mcap"
    struck.write_bytes(data)
    found = list(walk(struck))
    read = {part.offset: part for part in found if isinstance(part, ChunkMessages)}
    attached = [part for part in found if isinstance(part, AttachedFile)]
    assert read.items() <= chunks.items()
    lost = len(chunks) - len(read) + 1 - len(attached)
    assert lost == 0 or (lost == 1 and any(isinstance(part, Damage) for part in found))


def test_behind_a_broken_chunk_all_is_read_and_the_seconds_that_are_lost_are_told(whole: Path) -> None:
    starts = [part.offset for part in walk(whole) if isinstance(part, ChunkMessages)]
    data = bytearray(whole.read_bytes())
    data[starts[2] + 3000] ^= 4
    struck = whole.parent / "middle.mcap"
    struck.write_bytes(data)
    session = open_session(struck)
    held = sum(map(len, session.sets))
    assert 30 <= held < 48 == sum(map(len, open_session(whole).sets))
    assert sum(len(s.frames) for s in session.frame_sets()) == held
    assert session.damage.endswith("what was recorded from 1.10 to 1.80 s is lost")
    assert main(["export", str(struck), "-o", str(whole.parent / "exported")]) == 1


@pytest.mark.parametrize("closed", [True, False])
def test_without_its_first_chunk_a_recording_opens_closed_or_not(whole: Path, closed: bool, tmp_path: Path) -> None:
    chunks = [part for part in walk(whole) if isinstance(part, ChunkMessages)]
    data = bytearray(whole.read_bytes())
    data[chunks[0].offset + 500] ^= 4
    struck = tmp_path / "struck.mcap"
    struck.write_bytes(data if closed else data[: chunks[-1].offset])
    first, whole_session, session = chunks[0], open_session(whole), open_session(struck)
    lost = sum(message.topic == "/frames" for message in first.messages)
    assert 0 < lost < 24 and "what was recorded before " in session.damage
    assert message_from_rig(session.rig) == message_from_rig(whole_session.rig)
    if closed:
        assert sum(map(len, session.sets)) == 48 - lost == sum(len(s.frames) for s in session.frame_sets())
        assert len(list(channels.read_poses(struck))) >= 24 - lost
    assert rig_from_session(struck).cameras[0].name == session.rig.cameras[0].name


KILLED = """
import sys, time
sys.path.insert(0, "tests")
from tests.session_files import image, rig
from hardware.recording.recorder import Recorder
from perception.frames import Frame
recorder = Recorder(sys.argv[1], rig(2))
for k in range(10**6):
    for camera in range(2):
        recorder.write(Frame(camera, k / 30, image(camera, k % 50)))
    print(k, flush=True)
"""


def test_a_killed_run_is_readable_to_the_last_second(tmp_path: Path) -> None:
    root = Path(__file__).parent.parent
    command = [sys.executable, "-c", KILLED, str(tmp_path / "x.mcap")]
    child = subprocess.Popen(command, cwd=root, stdout=subprocess.PIPE, text=True)
    while int(child.stdout.readline()) < 100:
        pass
    child.send_signal(signal.SIGKILL)
    last = max([100, *(int(line) for line in child.stdout.read().split())])
    child.wait()
    session = open_session(tmp_path / "x.mcap")
    assert "not closed" in session.damage or "cut" in session.damage
    frames = list(session.frame_sets())
    assert last / 30 - frames[-1].stamp <= MAX_CHUNK_SECONDS + 2 / 30


@contextmanager
def disk_of(size: int) -> Iterator[None]:
    """No file may grow beyond `size` bytes: the system itself refuses the write."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def test_a_full_disk_is_one_error_and_what_was_written_stays_readable(tmp_path: Path) -> None:
    path = tmp_path / "x.mcap"
    recorder = Recorder(path, rig(2))
    with disk_of(400_000), pytest.raises(StillbedError, match="recording stopped") as caught:
        write_frames(recorder, 10_000)
    with pytest.raises(StillbedError, match="recording stopped"):
        recorder.event(1.0, "still there?")
    recorder.close()
    recorder.close()
    assert not isinstance(caught.value, InputError)
    session = open_session(path)
    assert len(session) > 10 and len(list(session.frame_sets())) == len(session)


def test_a_disk_that_is_full_at_once_leaves_nothing_and_that_is_said(tmp_path: Path) -> None:
    recorder = Recorder(tmp_path / "x.mcap", rig(2))
    with disk_of(2000), pytest.raises(StillbedError, match=r"x\.mcap: recording stopped.*; nothing of it can be read"):
        write_frames(recorder, 10_000)
    recorder.close()
    with pytest.raises(InputError):
        open_session(tmp_path / "x.mcap")


def test_an_import_onto_a_full_disk_names_its_file_and_keeps_nothing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    make_folder(tmp_path / "folder", 20)
    target = tmp_path / "out" / "y.mcap"
    with disk_of(20_000):
        assert main(["import", str(tmp_path / "folder"), "-o", str(target)]) == 2
    told = capsys.readouterr().err
    assert f"stillbed: {target}: cannot write: recording stopped, " in told and "; nothing is kept of it\n" in told
    assert not list(target.parent.iterdir())


def test_a_full_disk_is_told_with_the_file_that_it_struck_and_what_is_left(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    make_folder(tmp_path / "folder", 20)
    (tmp_path / "folder" / "surface.ply").unlink()  # it is none
    out = tmp_path / "out"
    with disk_of(800):
        assert main(["replay", str(tmp_path / "folder"), "--path", str(SQUARE), "-o", str(out)]) == 2
    told = capsys.readouterr().err.splitlines()[-1]
    assert "Errno" not in told and str(out) in told
    kept = sorted(file.name for file in out.iterdir()) if out.is_dir() else []
    assert all(name in told for name in kept) and (kept or "nothing was written" in told)


def test_an_error_inside_the_block_is_not_hidden_and_the_file_is_closed(tmp_path: Path) -> None:
    with pytest.raises(KeyboardInterrupt), Recorder(tmp_path / "x.mcap", rig(2)) as recorder:
        write_frames(recorder, 3)
        raise KeyboardInterrupt
    assert open_session(tmp_path / "x.mcap").damage == ""


@pytest.mark.parametrize("flags", [["export"], ["replay", "--path", str(SQUARE)], ["replay"]])
def test_what_damage_leaves_says_so(flags: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_arm(tmp_path / "arm.toml", ArmProfile(), "of a run")
    with Recorder(tmp_path / "x.mcap", rig(2)) as recorder:
        recorder.attach("path.csv", SQUARE.read_bytes())
        for name in ("arm.toml", LOOP_ARM_ATTACHMENT):
            recorder.attach(name, (tmp_path / "arm.toml").read_bytes())
        recorder.write(LoopRecord(0, (0.0,), ((0, 1, "start", {"link": asdict(LinkSettings())}),)))
        write_frames(recorder, 3)
    whole, cut = tmp_path / "x.mcap", tmp_path / "cut.mcap"
    cut.write_bytes(whole.read_bytes()[:-100])
    assert main([*flags, str(whole), "-o", str(tmp_path / "whole")]) == 0
    assert "is damaged" not in capsys.readouterr().out
    assert main([*flags, str(cut), "-o", str(tmp_path / "cut")]) == 1
    assert capsys.readouterr().out.startswith(f"The recording is damaged: {open_session(cut).damage}.\n")


@pytest.mark.slow
def test_a_plan_laid_into_a_damaged_recording_and_masks_of_one_say_so(
    whole: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(whole.read_bytes()[:-100])
    write_ply(tmp_path / "scan.ply", *scan_of())
    plan = ["plan", str(tmp_path / "scan.ply"), "-o", str(tmp_path / "path.csv"), "--no-pictures", "--bead", "2"]
    assert main([*plan, "--session", str(cut)]) == 1
    told = f"The recording is damaged: {open_session(cut).damage}.\n"
    assert capsys.readouterr().out.endswith(told)
    assert main(["segment", str(cut), "-o", str(tmp_path / "masks"), "--method", "shape"]) == 1
    assert f"The recording is damaged: {cut}: {open_session(cut).damage}.\n" in capsys.readouterr().out


@pytest.mark.slow  # plan and masks say it by the same words
def test_a_calibration_from_a_damaged_recording_says_so(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    cut = tmp_path / "cut.mcap"
    write_board(tmp_path / "board.toml", BOARD)
    import_folder(rendered(tmp_path / "waved", instants=12), tmp_path / "waved.mcap")
    calibrate = ["calibrate", "cameras", "--board", str(tmp_path / "board.toml"), "--limit-mm", "10"]
    assert main([*calibrate, str(tmp_path / "waved.mcap"), "-o", str(tmp_path / "rig.toml")]) == 0
    assert "is damaged" not in capsys.readouterr().out
    cut.write_bytes((tmp_path / "waved.mcap").read_bytes()[:-100])
    assert main([*calibrate, str(cut), "-o", str(tmp_path / "again.toml")]) == 1
    assert capsys.readouterr().out.endswith(f"The recording is damaged: {open_session(cut).damage}.\n")
