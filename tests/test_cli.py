"""The command line: instant help, one line for wrong input, and nothing lost when it is cut short."""

from __future__ import annotations

import errno
import fcntl
import json
import os
import shlex
import signal
import struct
import subprocess
import sys
import termios
import tomllib
from collections.abc import Iterator
from io import StringIO
from pathlib import Path

import numpy as np
import pytest

from estimation.errors import InputError
from estimation.pose import SurfacePose, TrackState
from hardware.cli.main import main
from hardware.files.pose_file import PoseWriter, read_poses
from hardware.live.view import Console
from hardware.offline.track import follow
from hardware.process.clock import WallClock
from hardware.process.progress import BAD, Progress, count_text, duration_text, left_files_text, painted, prepare_out
from hardware.recording.session_reader import open_session
from perception.frames import FrameSet
from perception.tracking.step import STAGES, StepReport
from tests.command_processes import ROOT, started
from tests.nozzle_logs import read_nozzle
from tests.simulated_worlds import IDEAL, SMALL, write_scenario
from tests.tracking_runs import Replayed

CLOCK = WallClock()
LARGE = {"numpy", "scipy", "numba", "gtsam", "cv2", "onnxruntime", "toppra", "ruckig", "shapely", "aiohttp", "mcap"}
HELP = """
import argparse, sys
from hardware.cli.main import subject_parser
from hardware.bench.subjects import SUBJECTS
from hardware.cli.main import parser

def told(here):
    assert here.format_help().startswith("usage: stillbed"), here.prog
    below = [a.choices.values() for a in here._actions if isinstance(a, argparse._SubParsersAction)]
    return 1 + sum(told(each) for each in (below[0] if below else ()))

count = told(parser()) + sum(told(subject_parser(name, subject)) for name, subject in SUBJECTS.items())
print(count, *{name.split(".")[0] for name in sys.modules})
"""


def stillbed(*arguments: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "hardware.cli.main", *arguments]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=60)


def test_help_is_there_at_once_as_nothing_large_is_loaded_for_any() -> None:
    done = subprocess.run([sys.executable, "-c", HELP], cwd=ROOT, capture_output=True, text=True, timeout=60)
    count, *loaded = done.stdout.split()
    assert int(count) > 40 and "argparse" in loaded and not set(loaded) & LARGE


def test_a_reader_that_goes_away_is_no_error() -> None:
    read, write = os.pipe()
    os.close(read)
    code = (
        "import sys; from hardware.cli import main as cli, sessions; sessions._track = lambda a: print('x' * 99);"
        " sys.exit(cli.main(sys.argv[1:]))"
    )
    command = [sys.executable, "-c", code, "track", "x", "-o", "y"]
    done = subprocess.run(command, cwd=ROOT, stdout=write, stderr=subprocess.PIPE, text=True, timeout=60)
    os.close(write)
    assert (done.returncode, done.stderr) == (0, "")


def test_version() -> None:
    assert stillbed("--version").stdout.startswith("stillbed")


def test_the_exit_code_says_whether_a_runs_limits_were_met(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    limits = {"p95_mm": 0.1, "duty": 0.9}
    met = write_scenario(tmp_path, IDEAL, seconds=2.5, limits=limits, name="met.toml")
    missed = write_scenario(tmp_path, IDEAL, seconds=2.5, limits={**limits, "max_mm": 0.001}, name="missed.toml")
    assert main(["simulate", str(met), "-o", str(tmp_path / "met")]) == 0
    assert "met     p95_mm" in capsys.readouterr().out
    assert main(["simulate", str(missed), "-o", str(tmp_path / "missed"), "--threads", "1"]) == 1
    assert "MISSED  max_mm" in capsys.readouterr().out


@pytest.mark.slow
def test_a_print_goes_on_under_its_own_head(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Head, needle, their shadow and the ink hide landmarks and change colours: no reason to hold."""
    demo = tomllib.loads((ROOT / "data/scenarios/demo.toml").read_text())
    tables = {key: demo[key] for key in ("scene", "motion", "cameras", "clearance_mm", "bead_mm")}
    (tmp_path / "path.csv").write_bytes((ROOT / "data/paths/wound_raster.csv").read_bytes())
    limits = {"duty": 0.9, "p95_mm": 0.5}
    file = write_scenario(tmp_path, {"arm": {"file": "arm.toml"}}, tables, seconds=8.0, limits=limits)
    assert main(["simulate", str(file), "-o", str(tmp_path / "out")]) == 0, capsys.readouterr().out
    states = read_poses(tmp_path / "out" / "tracking" / "poses.csv").states
    tracking = [state is TrackState.TRACKING for state in states]
    assert np.mean(tracking[tracking.index(True) :]) > 0.98


@pytest.mark.slow  # test_track ends a tracking by Ctrl-C, and finds what is kept of it
def test_a_simulation_ended_by_ctrl_c_keeps_what_there_was(tmp_path: Path) -> None:
    small = {"rig": {"size": [96, 64], "focal_px": 140}, "scene": {"texel_mm": 1.0}}
    file, out = write_scenario(tmp_path, SMALL, small, seconds=600.0), tmp_path / "out"
    running = started(["simulate", str(file), "-o", str(out), "--threads", "1"])
    try:
        for _ in range(2000):
            if (out / "nozzle.csv").exists() and (out / "nozzle.csv").stat().st_size > 30_000:
                break
            CLOCK.wait_until(CLOCK.now() + 0.05)
        running.send_signal(signal.SIGINT)
        _, errors = running.communicate(timeout=60)
    finally:
        running.kill()
    assert running.returncode == 130 and "interrupted; kept in" in errors and "Traceback" not in errors
    rows = read_nozzle(out / "nozzle.csv")
    assert len(rows) > 300 and np.allclose(np.diff(rows.stamps), 0.001)
    assert len(read_poses(out / "tracking" / "poses.csv")) >= 1
    sessions = [open_session(out / name) for name in ("session", "session.mcap")]
    assert len(sessions[0]) == len(sessions[1]) > 3
    assert all(session.truth is not None and session.damage == "" for session in sessions)
    assert not json.loads((out / "summary.json").read_text())["complete"]
    assert "incomplete" in (out / "report.html").read_text()


def test_a_folder_that_is_not_empty_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "mine.txt").write_text("mine")
    with pytest.raises(InputError, match="--force"):
        prepare_out(tmp_path, force=False)
    prepare_out(tmp_path, force=True)
    assert (tmp_path / "mine.txt").read_text() == "mine"
    with pytest.raises(InputError, match="a file"):
        prepare_out(tmp_path / "mine.txt", force=True)
    prepare_out(tmp_path / "deep" / "er", force=False)
    assert (tmp_path / "deep" / "er").is_dir()


def test_what_was_kept_is_said(tmp_path: Path) -> None:
    assert left_files_text(tmp_path / "nothing") == "nothing was written"
    assert left_files_text(None) == "nothing was to be written"
    (tmp_path / "poses.csv").write_text("x")
    assert left_files_text(tmp_path) == f"kept in {tmp_path}: poses.csv"
    assert "whole" in left_files_text(tmp_path / "poses.csv")
    (tmp_path / "x.mcap").write_text("x")
    assert "readable" in left_files_text(tmp_path / "x.mcap")
    (tmp_path / "arm.toml").write_text("x")
    assert left_files_text(tmp_path / "arm.toml") == f"kept {tmp_path / 'arm.toml'}"


def test_ctrl_c_before_a_command_is_read_is_one_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def pressed(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("hardware.cli.main.parser", pressed)
    assert main(["cache"]) == 130
    assert capsys.readouterr().err == "\nstillbed: interrupted; nothing was written\n"


def test_ctrl_c_while_a_library_loads_is_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """gtsam, interrupted while it loads, makes an ImportError of it."""

    def load(cause: BaseException) -> None:
        raise ImportError("initialization failed") from cause

    monkeypatch.setattr("hardware.files.session.check_exists", lambda path: load(KeyboardInterrupt()))
    assert main(["track", "x", "-o", str(tmp_path / "out")]) == 130
    assert capsys.readouterr().err == "\nstillbed: interrupted; nothing was written\n"
    monkeypatch.setattr("hardware.files.session.check_exists", lambda path: load(OSError()))
    with pytest.raises(ImportError):
        main(["track", "x", "-o", str(tmp_path / "out")])


def test_a_full_disk_is_told_with_what_was_to_be_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def full(self: Path, *_: object, **__: object) -> None:
        self.touch()
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patched:
        patched.setattr(Path, "write_text", full)
        assert main(["init", str(tmp_path / "mon day")]) == 2
    assert capsys.readouterr().err.startswith(f"stillbed: {tmp_path / 'mon day'}: no space left on device")
    assert not (tmp_path / "mon day").exists()
    assert main(["init", str(tmp_path / "mon day")]) == 0
    told = capsys.readouterr().out
    assert shlex.split(told.partition("then: ")[2]) == ["stillbed", "live", str(tmp_path / "mon day/session.toml")]


def test_a_full_disk_under_a_log_names_the_log(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def full(*_: object, **__: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("hardware.cli.live._run_arm", full)
    assert main(["arm", "--virtual", "--log", str(tmp_path / "axes.csv")]) == 2
    told = f"stillbed: {tmp_path / 'axes.csv'}: no space left on device; its last rows may be missing\n"
    assert capsys.readouterr().err == told


def frame_sets(count: int, ending: BaseException | None = None) -> Iterator[FrameSet]:
    for i in range(count):
        yield FrameSet(i / 30, ())
    if ending is not None:
        raise ending


def writer(folder: Path) -> PoseWriter:
    return PoseWriter(folder, ("left", "top", "right"), STAGES)


def test_each_pose_is_written_before_the_step_may_idle(tmp_path: Path) -> None:
    log: list[str] = []
    step, ticks = Replayed(log), iter(range(1000))
    counts: list[tuple[int, ...]] = []

    def sink(frames: FrameSet, pose: SurfacePose, report: StepReport) -> None:
        log.append(f"written {len(read_poses(tmp_path / 'poses.csv'))}")

    with writer(tmp_path) as poses:
        done = follow(frame_sets(3), step, poses, lambda: float(next(ticks)), lambda *c: counts.append(c), 3, [sink])
    assert done == 3
    assert log == ["step", "written 1", "idle", "step", "written 2", "idle", "step", "written 3", "idle"]
    assert counts == [(1, 3), (2, 3), (3, 3)]
    assert np.array_equal(read_poses(tmp_path / "poses.csv").seconds[:, -1], [1, 1, 1])  # one tick: the step alone


@pytest.mark.parametrize("ending", [KeyboardInterrupt(), InputError("cam.mp4", "frame 7", "truncated", "a whole file")])
def test_nothing_is_lost_when_a_run_is_cut_short(tmp_path: Path, ending: BaseException) -> None:
    with pytest.raises(type(ending)), writer(tmp_path) as poses:
        follow(frame_sets(7, ending), Replayed([]), poses, lambda: 0.0, lambda done, total: None, 20)
    assert len(read_poses(tmp_path / "poses.csv")) == 7
    assert len((tmp_path / "poses.tum").read_text().splitlines()) == 1 + 6  # a comment; the first row is INITIALISING


def test_poses_that_have_yet_to_come_are_read_back_as_none(tmp_path: Path) -> None:
    with writer(tmp_path):
        assert len(read_poses(tmp_path / "poses.csv")) == 0


class Terminal(StringIO):
    def isatty(self) -> bool:
        return True


def test_progress_on_a_terminal_is_one_line_that_changes() -> None:
    now, stream = [0.0], Terminal()
    with Progress("track", "frame sets", lambda: now[0], stream) as progress:
        for done in range(1, 101):
            now[0] += 0.0625  # exact in binary
            progress(done, 100)
    text = stream.getvalue()
    assert text.count("\n") == 1 and text.count("\r") == 50
    assert text.endswith("track: 100 of 100 frame sets, 16.0/s\n")
    assert "track: 50 of 100 frame sets, 16.0/s, 3 s left" in text


def test_progress_on_a_narrow_terminal_stays_one_line() -> None:
    ours, theirs = os.openpty()
    fcntl.ioctl(theirs, termios.TIOCSWINSZ, struct.pack("4H", 24, 60, 0, 0))
    now = [0.0]
    with os.fdopen(theirs, "w") as stream, Progress("reach", "steps", lambda: now[0], stream) as progress:
        progress.note = "joints and speeds of each checkpoint, wherever the surface moves to"
        now[0] = 1.0
        progress(1, 4)
    shown = os.read(ours, 1000).decode().rpartition("\x1b[K")[2]
    os.close(ours)
    assert shown.startswith("reach: 1 of 4 steps; joints") and len(shown.rstrip("\r\n")) == 60


def test_the_time_left_is_not_reckoned_from_what_went_before_the_first_report() -> None:
    now, stream = [0.0], StringIO()
    with Progress("pre-render", "frame sets", lambda: now[0], stream) as progress:
        now[0] = 20.0  # imports, a scene that is painted
        for done in range(1, 22):
            progress(done, 121)
            now[0] += 0.5
    assert stream.getvalue().splitlines()[-1] == "pre-render: 21 of 121 frame sets, 2.0/s, 50 s left"


def test_progress_in_a_log_is_a_line_every_few_seconds() -> None:
    now, stream = [0.0], StringIO()
    with Progress("import", "images", lambda: now[0], stream) as progress:
        for done in range(1, 101):
            now[0] += 0.2
            progress(done, 100)
    lines = stream.getvalue().splitlines()
    assert len(lines) == 4 and "\r" not in stream.getvalue()


@pytest.mark.parametrize(
    ("seconds", "words"), [(8.4, "8 s"), (59.9, "1 min 0 s"), (200, "3 min 20 s"), (3900, "1 h 5 min")]
)
def test_durations_are_said_as_people_do(seconds: float, words: str) -> None:
    assert duration_text(seconds) == words


def test_one_is_not_told_as_many() -> None:
    assert [count_text(n, "layer") for n in (0, 1, 2)] == ["0 layers", "1 layer", "2 layers"]


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("simulat", ["'simulat' is unknown", "did you mean simulate?"]),
        (
            "calibrate import x --format colmap -o r.toml",
            ["'colmap' is unknown", "allowed: opencv, ros, kalibr, anipose"],
        ),
        ("track x --outt y", ["stillbed track: unknown option --outt", "did you mean --out?"]),
        ("plan --example forarm -o x.csv", ["--example", "did you mean forearm?"]),
        ("simulate breathing_clam -o x", ["did you mean 'data/scenarios/breathing_calm.toml'?"]),
        ("simulate data/scenarios/stil.toml -o x", ["did you mean 'data/scenarios/still.toml'?"]),
        ("live", ["session.toml = 'missing'", "`stillbed init FOLDER`"]),
        ("live --simulated data/live/smal.toml", ["--simulated = data/live/smal.toml"]),
        ("live --simulated data/live/small.toml --record x.txt", ["command line: --record = x.txt"]),
        ("live --rig data/live/small.toml", ["command line: --path = 'missing'"]),
    ],
)
def test_what_is_wrong_on_a_command_line_is_named_as_it_was_given_with_what_was_meant(
    line: str, words: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    try:
        code = main(line.split())
    except SystemExit as stopped:
        code = int(stopped.code or 0)
    told = capsys.readouterr().err
    assert code == 2 and told.count("\n") == 1 and all(word in told for word in words), told


def test_what_a_file_says_is_named_by_its_key_and_what_a_flag_says_by_the_flag(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "session.toml"
    lines = '[cameras]\nsimulated = "gone.toml"\n[record]\nfile = "run.mcap"\n'
    file.write_text(lines)
    assert main(["live", str(file)]) == 2
    assert f"{file}: cameras.simulated = " in capsys.readouterr().err
    assert main(["live", str(file), "--simulated", "gone.toml"]) == 2
    assert "command line: --simulated = gone.toml" in capsys.readouterr().err


def test_colours_are_for_terminals_whose_owner_has_not_refused_them(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("NO_COLOR", raising=False)
    monkeypatch.setenv("TERM", "xterm")
    assert painted("bad", BAD, Terminal()) == "\x1b[31mbad\x1b[0m" and painted("bad", BAD, StringIO()) == "bad"
    monkeypatch.setenv("NO_COLOR", "1")
    assert painted("bad", BAD, Terminal()) == "bad"


def test_a_shell_is_told_which_commands_and_options_there_are() -> None:
    line = "stillbed live --page-a"
    asked = {"COMP_LINE": line, "COMP_POINT": str(len(line)), "_ARGCOMPLETE": "1", "_ARGCOMPLETE_IFS": " "}
    command = f"{sys.executable} -m hardware.cli.main 8>&1 9>/dev/null"
    run = subprocess.run(command, shell=True, env=os.environ | asked, capture_output=True, text=True, timeout=60)
    assert run.stdout.strip() == "--page-address"


def test_a_page_is_opened_by_what_the_system_has_and_else_that_is_said(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    Console(True).offer_page("http://127.0.0.1:1/x/")
    assert "no browser could be opened" in capsys.readouterr().err
    opener, opened = tmp_path / "xdg-open", tmp_path / "opened"
    opener.write_text(f'#!/bin/sh\necho "$1" > {opened}.new\n/bin/mv {opened}.new {opened}\n')
    opener.chmod(0o755)
    Console(False).offer_page("http://127.0.0.1:1/never/")
    Console(True).offer_page("http://127.0.0.1:1/x/")
    clock, said = WallClock(), capsys.readouterr().err
    until = clock.now() + 20
    while not opened.exists() and clock.now() < until:
        clock.wait_until(clock.now() + 0.02)
    assert opened.read_text() == "http://127.0.0.1:1/x/\n" and "no browser" not in said
