"""Every command of the documents is run, in a folder that holds what they name."""

from __future__ import annotations

import re
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
from board_session import rendered

from hardware.cli.main import main
from hardware.cli.parser import INTERRUPTED
from hardware.simulator.arm.settings import ArmSettings, Replies
from tests.documents import commands
from tests.live_runs import ROOT, Running
from tests.shown_commands import MADE, to_run
from tests.streams import HttpCamera, served
from tests.test_arm_port import serving
from tests.workspace import left_by, prepare

pytestmark = [pytest.mark.slow, pytest.mark.timeout(900)]
TO_RUN = sorted({found for _, text in commands() if (found := to_run(text)) is not None and found not in MADE})
UNFINISHED = (  # may end with exit code 1
    *("stillbed calibrate cameras", "stillbed calibrate arm"),  # so short, it is not good enough to print with
    "stillbed live --rig",  # the session is over before the path is printed
)
UNTIL_CTRL_C = ("stillbed arm --virtual", "stillbed view", "python -m hardware.operator.demo")
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
            at = live.wait_for("confirm")
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
    assert process.stdout is not None
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


def run(text: str, cache: Path) -> int:
    """The exit code of a command."""
    words = shlex.split(text)
    if text.startswith(UNTIL_CTRL_C):
        return run_until_ctrl_c(words)
    if words[0] == "make":
        return subprocess.run(words, cwd=ROOT, capture_output=True, check=False).returncode
    if words[:2] == ["stillbed", "live"]:
        return run_live(words[2:], cache)
    try:
        return main(words[1:])
    except SystemExit as ended:
        return int(ended.code or 0)


@pytest.mark.parametrize("text", TO_RUN, ids=[text[:90] for text in TO_RUN])
def test_a_command_of_the_documents_runs_and_leaves_what_it_says(
    text: str, here: Path, cameras: list[str], workspace: Path
) -> None:
    for file in left_by(text):
        without(file)
    with ExitStack() as stack:
        if "./serving" in text:
            stack.enter_context(serving(here / "serving", ArmSettings(replies=Replies.STREAM)))
        code = run(text.replace("http://CAMERA", cameras[0]), workspace.parent / "cache")
    if text.startswith(UNTIL_CTRL_C):
        assert code in (0, INTERRUPTED)
        return
    assert code == 0 or (code == 1 and text.startswith(UNFINISHED))
    assert all(file.exists() for file in left_by(text))
