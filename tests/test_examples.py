"""The examples and every command of the documents run, in a folder that holds what they name."""

from __future__ import annotations

import json
import os
import re
import runpy
import shlex
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import cv2
import numpy as np
import pytest

from estimation import se3
from estimation.errors import InputError
from estimation.pose import Trajectory
from estimation.synthetic.world import arc_rig
from hardware.cli.main import main
from hardware.cli.parser import INTERRUPTED, run_script
from hardware.files.folder_tables import write_tum
from hardware.files.path_file import read_path, write_path
from hardware.operator.view import MoveRequest
from hardware.simulator.arm.settings import ArmSettings, ReplyMode
from tests.board_session import rendered
from tests.camera_streams import HttpCamera, served
from tests.documents import commands
from tests.live_runs import ROOT, Running, asks_to_move
from tests.moving_surfaces import raster
from tests.recording_samples import whole_recording
from tests.rendered_sets import write_session
from tests.shown_commands import MADE, to_run
from tests.test_arm_port import serving
from tests.test_dispenser import served as dispensing
from tests.test_viewers import columns, rerun
from tests.workspace import left_by, prepare

EXAMPLES = Path(__file__).parents[1] / "docs" / "examples"


def run(name: str, *words: object) -> None:
    runpy.run_path(str(EXAMPLES / name))["main"](*map(str, words))


@pytest.mark.slow
def test_a_folder_of_pictures_is_tracked(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_session(tmp_path / "s", seconds=0.7, rate=10.0, seed=2, cameras=arc_rig(size=(640, 360), focal=700.0))
    run("track_videos.py", tmp_path / "s")
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 7 and "TRACKING" in lines[-1]
    assert 0 < float(lines[-1].split("+-")[1]) < 0.2  # mm


@pytest.mark.slow  # test_plan_command plans the same
def test_a_scanned_wound_is_planned(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    from hardware.files.mesh_file import write_ply
    from hardware.plan.order import example_scan

    vertices, triangles = example_scan("forearm")
    write_ply(tmp_path / "scan.ply", vertices, triangles)
    run("plan_wound.py", tmp_path / "scan.ply", tmp_path / "path.csv")
    told = capsys.readouterr().out
    path = read_path(tmp_path / "path.csv")
    assert f"{len(path)} checkpoints" in told and float(told.split(", ")[2].split()[0]) > 99


def test_another_arm_is_sent_its_own_words(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_path(tmp_path / "path.csv", raster())
    run("other_arm.py", tmp_path / "path.csv", 12)
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 600
    words = [text.split("p[")[1].split("]")[0] for text in lines if "p[" in text]
    moves = np.array([[float(number) for number in one.split(",")] for one in words])
    assert len(moves) > 500 and np.abs(moves[-1, :3] - [0.2, 0.225, 0.05]).max() < 0.02  # m: it is on the wound


def test_another_dispenser_is_opened_and_closed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "pin").write_text("")
    run("other_dispenser.py", tmp_path / "pin", 0.05)
    said = [line.split(" s: ")[-1] for line in capsys.readouterr().out.splitlines()]
    assert said[1:] == ["ready: prepared", "on: on", "closed: closed, off"] and (tmp_path / "pin").read_text() == "0"
    run("other_dispenser.py", tmp_path / "none" / "pin", 0.05)
    assert "No such file" in capsys.readouterr().out


@pytest.mark.slow  # test_prediction_bench compares predictors
def test_a_predictor_of_ones_own_is_compared(capsys: pytest.CaptureFixture[str]) -> None:
    run("own_predictor.py", 9)
    rows = [line.replace(",", "").split() for line in capsys.readouterr().out.splitlines()]
    hold, own = (np.array([float(row[k]) for row in rows]) for k in (3, 6))
    assert len(rows) == 4 and (own < hold).all()


def test_poses_are_judged_by_evo(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    stamps = np.arange(30) / 30
    true = se3.exp(np.outer(np.sin(stamps), [0.1, 0.2, 0.0, 5.0, 0.0, 3.0]))
    moved = se3.exp(np.array([0.3, 0.0, 0.1, 10.0, -4.0, 2.0]))
    shift = se3.make(np.eye(3), np.where(np.arange(30)[:, None] < 15, 0.0, [0.5, 0.0, 0.0]))
    write_tum(tmp_path / "truth.tum", Trajectory(stamps, true, True))
    write_tum(tmp_path / "poses.tum", Trajectory(stamps, true @ shift @ moved, True))
    run("evaluate_with_evo.py", tmp_path / "poses.tum", tmp_path / "truth.tum")
    assert "off by: rmse 0.3536, median 0.2500, max 0.5000" in capsys.readouterr().out


@pytest.mark.slow
def test_a_recording_is_made_ready_for_rerun(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    recording = whole_recording(tmp_path)
    run("show_in_rerun.py", recording)
    assert capsys.readouterr().out == f"rerun {tmp_path / 'x.rrd'} {tmp_path / 'x.rbl'}\n"
    assert {"/surface", "/camera/left/image"} <= set(columns(recording, tmp_path))
    plotted = rerun("rrd", "print", "-vvv", tmp_path / "x.rbl")
    assert "std_msgs.msg.Float64:message" in plotted and "Scalars:scalars" in plotted


@pytest.mark.parametrize("file", sorted(EXAMPLES.glob("*.py")), ids=lambda file: file.name)
def test_each_example_is_shown_in_the_documents(file: Path) -> None:
    assert f"docs/examples/{file.name}" in (EXAMPLES.parents[1] / "README.md").read_text(encoding="utf-8")


@pytest.mark.slow
def test_the_notebook_runs_from_its_first_cell_to_its_last(tmp_path: Path) -> None:
    """In a process of its own, as a kernel would: it plans, prints in the simulator, tracks and plots."""
    cells = json.loads((EXAMPLES / "first_steps.ipynb").read_text(encoding="utf-8"))["cells"]
    code = ["".join(cell["source"]) for cell in cells if cell["cell_type"] == "code"]
    assert len(code) >= 5 and all(cell.get("outputs", []) == [] for cell in cells)
    checks = "assert result.met or 'duty' in result.text; assert len(poses.stamps) > 80; assert printing.sum() > 500"
    environment = os.environ | {
        "PYTHONPATH": str(EXAMPLES.parents[1]),
        "MPLBACKEND": "Agg",
        "TMPDIR": str(tmp_path),
        "XDG_CACHE_HOME": str(tmp_path),
    }
    program = "\n".join([*code, checks])
    run = subprocess.run([sys.executable, "-c", program], env=environment, capture_output=True, text=True, timeout=280)
    assert run.returncode == 0, run.stderr
    assert (figure := next(tmp_path.glob("stillbed-*/figure.png"))).stat().st_size > 10_000, figure


@pytest.mark.parametrize("file", sorted(EXAMPLES.glob("*.py")), ids=lambda file: file.name)
def test_each_example_says_how_it_is_started(
    file: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def started(*words: str) -> tuple[object, str, str]:
        monkeypatch.setattr(sys, "argv", [str(file), *words])
        with pytest.raises(SystemExit) as ended:
            runpy.run_path(str(file), run_name="__main__")
        return ended.value.code, *capsys.readouterr()

    asked, wrong = started("--help"), started("a", "b", "c")
    assert (asked[0], asked[2]) == (0, "") and f"python docs/examples/{file.name}" in asked[1]
    assert wrong[:2] == (2, "")
    (line,) = wrong[2].splitlines()
    assert line.startswith(f"usage: python docs/examples/{file.name}")


def test_an_example_is_a_program() -> None:
    environment = os.environ | {"PYTHONPATH": str(EXAMPLES.parents[1])}
    command = [sys.executable, str(EXAMPLES / "other_dispenser.py"), "--help"]
    done = subprocess.run(command, capture_output=True, text=True, check=True, env=environment)
    assert "other_dispenser.py" in done.stdout


def test_what_a_script_cannot_take_is_one_line_and_exit_code_2(capsys: pytest.CaptureFixture[str]) -> None:
    def main(scan: str, seconds: float = 1.0) -> None:
        if scan == "wrong":
            raise InputError(scan, "size", seconds, "less")
        Path(scan).read_bytes()
        print(scan, seconds)

    def code(*words: str) -> object:
        with pytest.raises(SystemExit) as ended:
            run_script(main, "Do it: python own.py SCAN [SECONDS]  and look.", words)
        return ended.value.code

    for words in ([], ["a", "many"], ["a", "1", "2"], ["--fast"]):
        assert code(*words) == 2 and capsys.readouterr() == ("", "usage: python own.py SCAN [SECONDS]\n")
    assert code("wrong", "2") == 2 and capsys.readouterr() == ("", "wrong: size = 2.0, allowed less\n")
    assert code("nowhere") == 2 and capsys.readouterr() == ("", "nowhere: no such file or directory\n")
    assert code(__file__, "2") == 0 and capsys.readouterr() == (f"{__file__} 2.0\n", "")


TO_RUN = sorted({found for _, text in commands() if (found := to_run(text)) is not None and found not in MADE})
UNFINISHED = (  # may end with exit code 1
    *("stillbed calibrate cameras", "stillbed calibrate arm"),  # so short, it is not good enough to print with
    "stillbed live --rig",  # the session is over before the path is printed
)
UNTIL_CTRL_C = (
    "stillbed arm --virtual",
    "stillbed dispenser virtual",
    "stillbed view",
    "python -m hardware.operator.demo",
)
LONGEST = 300.0  # s: a live run whose pictures are rendered first, on a busy machine
READY = re.compile(r"http://\S+/|/dev/pts/\d+")  # where they can be found


@pytest.fixture(scope="module")
def cameras(tmp_path_factory: pytest.TempPathFactory) -> Iterator[list[str]]:
    """Where three cameras on the network show a board."""
    board = rendered(tmp_path_factory.mktemp("shown") / "session", instants=20)
    ways = [[cv2.imread(str(file)) for file in sorted((board / name).glob("*.png"))] for name in "abc"]
    three = [HttpCamera(8.0, lambda n, way=way: np.asarray(way[n % len(way)], np.uint8)) for way in ways]
    with served(*three):
        yield [camera.url for camera in three]


@pytest.fixture(scope="module")
def workspace(cameras: list[str], tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("reader") / "workspace"
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(folder.parent / "cache"))
        prepare(folder, cameras)
    return folder


@pytest.fixture
def here(workspace: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A copy of the workspace, to work in."""
    folder = tmp_path / "here"
    shutil.copytree(workspace, folder, symlinks=True)
    monkeypatch.chdir(folder)
    monkeypatch.setenv("XDG_CACHE_HOME", str(workspace.parent / "cache"))
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    return folder


def without(file: Path) -> None:
    """The file or folder, and what stands beside it by the same name, taken away."""
    for old in file.parent.glob(f"{file.stem}.*") if file.suffix else [file]:
        if old.is_dir():
            shutil.rmtree(old)
        else:
            old.unlink(missing_ok=True)


def run_live(words: list[str], cache: Path) -> int:
    """A live run with an operator who agrees to whatever is asked."""
    live = Running(*words, cache=cache, cwd=Path.cwd())
    try:
        if "--yes" not in words:
            at = live.wait_for("now: .*\n|is over\n")
            if "is over" in live.said:  # a short session, where the machine is slow to find its surface
                return live.process.wait(LONGEST)
            if "move the path" in live.said:  # without a scan it is a guess
                asks_to_move(live, MoveRequest(0.5, 0.0, 0.0))
                at = live.wait_for("moved by hand")
            live.press("y")
            live.wait_for("ready", at)
            live.press("s")
        return live.process.wait(LONGEST)
    finally:
        live.close()


def run_until_ctrl_c(words: list[str]) -> int:
    """Started, found where it says it is, and ended as a reader ends it."""
    program = ["hardware.cli.main", *words[1:]] if words[0] == "stillbed" else words[2:]
    process = subprocess.Popen(
        [sys.executable, "-u", "-m", *program],
        stdout=subprocess.PIPE,
        text=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )
    try:
        said = ""
        for line in process.stdout:
            said += line
            if READY.search(said):
                break
        assert READY.search(said), said
        process.send_signal(signal.SIGINT)
        process.stdout.read()
        return process.wait(30)
    finally:
        process.kill()


def every_command_run(text: str, cache: Path) -> int:
    """The exit code of a command."""
    words = shlex.split(text)
    if text.startswith(UNTIL_CTRL_C):
        return run_until_ctrl_c(words)
    if words[:2] == ["python", "-m"]:
        return subprocess.run([sys.executable, *words[1:]], check=False).returncode
    if words[0] == "make":
        return subprocess.run(words, cwd=ROOT, capture_output=True, check=False).returncode
    if words[:2] == ["stillbed", "live"]:
        return run_live(words[2:], cache)
    try:
        return main(words[1:])
    except SystemExit as ended:
        return int(ended.code or 0)


@pytest.mark.slow
@pytest.mark.timeout(900)
@pytest.mark.parametrize("text", TO_RUN, ids=[text[:90] for text in TO_RUN])
def test_a_documented_command_leaves_what_it_says(text: str, here: Path, cameras: list[str], workspace: Path) -> None:
    for file in left_by(text):
        without(file)
    with ExitStack() as stack:
        if "./serving" in text:
            stack.enter_context(serving(here / "serving", ArmSettings(replies=ReplyMode.STREAM)))
        if "dispenser.toml" in text:
            stack.enter_context(dispensing(here, "dispensing"))
        code = every_command_run(text.replace("http://CAMERA", cameras[0]), workspace.parent / "cache")
    if text.startswith(UNTIL_CTRL_C):
        assert code in (0, INTERRUPTED)
        return
    assert code == 0 or (code == 1 and text.startswith(UNFINISHED))
    assert all(file.exists() for file in left_by(text))
