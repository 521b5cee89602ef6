"""Wrong input is one line that names it, exit code 2, nothing written; processes end with the one they work for."""

from __future__ import annotations

import os
import shlex
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path

import cv2
import numpy as np
import pytest

from estimation.errors import InputError
from hardware.bench.figures import workers
from hardware.cli.main import main
from hardware.files.mesh_file import write_ply
from hardware.files.rig_file import write_board
from hardware.live.prerender import prerender
from hardware.live.view import Console
from hardware.recording.recorder import Recorder
from tests.board_session import BOARD
from tests.command_processes import ROOT
from tests.pictureless_run import prepare_files
from tests.recording_samples import write_frames
from tests.session_files import rig
from tests.slow_cases import slowly
from tests.wound_scans import scan_of

WRONG = """
track missing -o OUT
track empty -o OUT
track half.mcap -o OUT
track junk.mcap -o OUT
track whole.mcap -o OUT --arm typo.toml
track whole.mcap -o OUT --record half.mcap
track whole.mcap -o OUT --record whole.mcap --force  # would be overwritten
track whole.mcap -o OUT --graph whole.mcap --force  # would be overwritten
trace whole.mcap -o whole.mcap --force  # would be overwritten
trace whole.mcap --page whole.mcap --force  # would be overwritten
replay missing --path missing -o OUT
replay whole.mcap --path bad.csv -o OUT
replay whole.mcap --path PATH --resume typo.toml -o OUT
replay whole.mcap -o OUT  # or give --path
replay empty -o OUT
import missing -o OUT
import whole.mcap -o OUT
export missing -o OUT
export empty -o OUT
export half.mcap -o OUT
simulate missing -o OUT
simulate typo.toml -o OUT
simulate binary.toml -o OUT
simulate unknown.toml -o OUT
simulate empty -o OUT
simulate STILL -o OUT --threads 0
simulate STILL -o OUT --trace bad.csv
simulate STILL -o OUT --fault dance
smooth empty -o OUT
smooth missing -o OUT  # missing
smooth whole.mcap -o OUT --rate nan  # --rate
smooth whole.mcap -o OUT --rate 0  # --rate
smooth whole.mcap whole.mcap -o OUT  # different names
smooth whole.mcap -o OUT --workers 2  # --workers
smooth whole.mcap -o OUT --scheduler local --workers 0  # --workers
compare missing
compare bad.csv
compare nothing.tum empty  # allowed a TUM or CSV file
compare empty empty  # allowed a TUM or CSV file
compare whole.mcap:truth whole.mcap:truth
view empty
view smoothed  # --poses smoothed
view missing
view junk.mcap
view half.mcap
view whole.mcap --poses missing
segment empty -o OUT
segment missing -o OUT
segment empty -o OUT --threads 0
segment blank.png -o . --force  # would be overwritten
segment blank.png -o OUT --threads 0
segment blank.png -o OUT --mm-per-px 0
segment blank.png -o OUT --method shape --model x.onnx
segment blank.png -o OUT --scan x.ply
segment blank.png -o OUT --model gone.onnx
train empty -o OUT.txt --network shape
train empty -o gone/x.toml --network shape
train empty -o typo.toml --network shape
train empty -o OUT.toml --network shape --folds 1  # --folds
train empty -o OUT.toml --network shape
plan -o OUT.csv
plan junk.stl -o OUT.csv
plan bad.csv -o OUT.csv
plan --example foot wound.stl -o OUT.csv
plan --example foot -o OUT.csv --bead 0
plan --example foot -o OUT.csv --tissue dermis
plan contour.csv -o OUT.csv --pattern zigzag --angle steep  # --angle
plan contour.csv -o OUT.csv --speed -1  # --speed
plan contour.csv -o OUT.csv --bead 0  # --bead
plan contour.csv -o OUT.csv --bead nan  # --bead
plan contour.csv -o OUT.csv --material a,b  # --material
plan contour.csv -o OUT.csv --tissue dermis  # --tissue
plan contour.csv -o OUT.csv --tissue dermis=thick:1  # --tissue
plan contour.csv -o OUT.csv --tissue a=1:1 --tissue a=2:1  # once
plan contour.csv -o OUT.csv --tissue a=rest:1 --tissue b=rest:1  # rest
plan contour.csv -o OUT.csv --bead 15  # room
plan contour.csv -o OUT.txt  # .csv
plan contour.csv -o contour.csv --force  # would be overwritten
plan wound_scan.ply -o wound.csv  # would be overwritten
plan contour.csv -o OUT.csv --gcode contour.csv --force  # would be overwritten
reach bad.csv --arm ARM
reach PATH --arm unknown.toml
reach PATH --arm jointless.toml  # kinematics = 'missing'
live typo.toml
live unknown.toml
live --rig missing --path PATH --record OUT
live --resume whole.mcap
live --rig whole.mcap --path PATH --arm virtual --record whole.mcap --force  # would be overwritten
init unknown.toml
arm /dev/nothing --jog X
arm /dev/nothing --stands 1,2
arm /dev/nothing --origin here --yes
arm --virtual --arm typo.toml
arm --virtual --fault 'dance at 5s'
cameras missing
cameras typo.toml
cameras empty --seconds nan
cameras 0  # a name that stays
cameras http://h/1 --seconds 0  # 0 < seconds
cameras http://h/1 -o OUT.txt  # .jpg or .png
cameras a.toml http://h/1  # one RIG.toml alone
calibrate board -o OUT.txt
calibrate board -o OUT.pdf --marker 2
calibrate board -o OUT.pdf --dictionary 9X9
calibrate board -o OUT.pdf --page 0x0
calibrate cameras whole.mcap --board unknown.toml -o OUT
calibrate cameras missing --board typo.toml -o OUT
calibrate cameras 0 --board board.toml -o OUT.toml  # a name that stays
calibrate cameras a.toml http://h/1 --board board.toml -o OUT.toml  # one RIG.toml alone
calibrate cameras http://h/1 --seconds -1 --board board.toml -o OUT.toml  # --seconds = -1.0
calibrate cameras empty --seconds 3 --board board.toml -o OUT.toml  # with live cameras
calibrate cameras http://h/1 --keep-lenses --board board.toml -o OUT.toml  # --keep-lenses
calibrate arm -o OUT  # one of a recorded FOLDER, --device, --virtual or --touched
calibrate arm moved --virtual -o OUT.toml  # folder and virtual
calibrate arm --virtual -o OUT.toml  # --record = 'missing'
calibrate arm --device /dev/x --record r -o OUT.toml  # --cameras = 'missing'
calibrate arm --device /dev/x --terminal -o OUT.toml  # --terminal
calibrate arm --device /dev/x --cameras rig.toml --record r -o OUT.toml  # nobody is within the arm's reach
calibrate arm empty -o OUT
calibrate arm --touched typo.toml --cameras rig.toml -o OUT
calibrate dispenser DISPENSER  # one of --from, --device, --virtual or --measured
calibrate dispenser DISPENSER --virtual --from moved  # folder and virtual
calibrate dispenser DISPENSER --virtual  # --record = 'missing'
calibrate dispenser DISPENSER --virtual --record OUT --name pump  # --name
calibrate dispenser DISPENSER --virtual --record OUT --speeds 10  # two different ones
calibrate dispenser DISPENSER --virtual --record OUT --length-mm 11  # a second or more
calibrate dispenser DISPENSER --device /dev/x --arm ARM --cameras rig.toml --record OUT  # --yes
calibrate dispenser DISPENSER --from empty  # commanded.csv
calibrate dispenser DISPENSER --measured 9,1,10  # 0 to 0.4 s
calibrate dispenser missing --from empty  # missing
calibrate import empty --format opencv -o OUT
calibrate import binary.toml --format kalibr -o OUT
calibrate export missing --format anipose -o OUT
bench dance -o OUT
bench --all --against missing -o OUT
doctor --folder missing
"""
MISTYPED = """
dance
track
track empty
track empty -o OUT --speed
track empty -o OUT --method dance
simulate STILL -o OUT --threads many
arm /dev/nothing --seconds -1
arm --virtual --replies loud
smooth empty -o OUT --rate fast
plan --example foot -o OUT.csv --bead wide
reach PATH --arm ARM --surface 1,2
reach PATH --arm ARM --surface a,b,c,d,e,f
reach PATH --arm ARM --amplitude-mm nan
reach PATH --arm ARM --rate-hz -1
calibrate
calibrate board -o OUT.pdf --squares many
calibrate cameras empty --board b.toml -o OUT --distance-mm a,b,far
calibrate cameras empty --board b.toml -o OUT --limit-mm nan
calibrate arm --virtual --record OUT -o OUT.toml --limit-mm nan
calibrate dispenser d.toml --measured 1,2
bench latency --dance
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Everything that can be wrong with a file."""
    made = tmp_path_factory.mktemp("wrong")
    (made / "empty").mkdir()
    (made / "smoothed").mkdir()
    (made / "smoothed/smoothed.csv").touch()
    (made / "typo.toml").write_text("a = = 3\n")
    (made / "unknown.toml").write_text("[dance]\nsteps = 1\n")
    (made / "binary.toml").write_bytes(bytes(range(256)))
    (made / "bad.csv").write_text("left,right\nfar,1\n")
    (made / "contour.csv").write_text("x_mm,y_mm\n0,0\n12,0\n12,8\n0,8\n")
    (made / "jointless.toml").write_text("baud = 115200\n")
    write_board(made / "board.toml", BOARD)
    cv2.imwrite(str(made / "blank.png"), np.full((60, 60, 3), 90, np.uint8))
    write_ply(made / "wound_scan.ply", *scan_of())
    (made / "junk.stl").write_bytes(b"\0junk" * 100)
    (made / "junk.mcap").write_bytes(b"junk" * 100)
    with Recorder(made / "whole.mcap", rig()) as recorder:
        write_frames(recorder, 3, 3, 0.0)
    (made / "half.mcap").write_bytes((made / "whole.mcap").read_bytes()[:60])
    return made


def words(text: str) -> list[str]:
    data = ROOT / "data"
    named = {
        "STILL": "scenarios/still.toml",
        "PATH": "paths/square_10mm.csv",
        "ARM": "arms/s6h4d.toml",
        "DISPENSER": "dispensers/arduino.toml",
    }
    return [str(data / named[word]) if word in named else word for word in shlex.split(text, comments=True)]


@pytest.mark.parametrize("text", WRONG.strip().splitlines())
def test_one_line(text: str, folder: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]) -> None:
    monkeypatch.chdir(folder)
    before = {file: file.read_bytes() for file in folder.iterdir() if file.is_file()}
    assert main(words(text)) == 2
    told = capfd.readouterr()
    lines = [line for line in told.err.splitlines() if line.startswith("stillbed")]
    assert told.out == "" and len(lines) == 1 and told.err.splitlines()[-1] == lines[0]
    assert lines[0].startswith("stillbed: ") and "allowed" in lines[0] and "Errno" not in lines[0]
    assert text.partition("  # ")[2] in lines[0]
    assert not list(folder.glob("OUT*"))
    assert all(file.read_bytes() == data for file, data in before.items())


@pytest.mark.parametrize("text", MISTYPED.strip().splitlines())
def test_mistyped(text: str, folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.chdir(folder)
    with pytest.raises(SystemExit) as ended:
        main(words(text))
    told = capsys.readouterr()
    assert ended.value.code == 2 and told.out == ""
    (line,) = told.err.splitlines()
    assert line.startswith("stillbed") and line.endswith(" --help")
    assert "invalid _" not in line  # a function's name tells nobody anything
    assert not list(folder.glob("OUT*"))


def test_refusals_name_files(folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.chdir(folder)
    assert main(["init", "typo.toml/below"]) == 2
    assert capsys.readouterr().err == "stillbed: typo.toml/below: not a directory\n"


@pytest.mark.parametrize(
    ("line", "work"),
    [
        ("plan --example forearm -o /proc/p.csv", "hardware.plan.run.subject_of"),
        ("plan --example forearm -o p.csv --gcode /proc/p.gcode", "hardware.plan.run.subject_of"),
        ("cameras usb:A1 -o /proc/s.jpg", "hardware.cameras.live.sources_named"),
    ],
)
def test_a_place_that_cannot_be_written_is_refused_before_the_work(
    line: str, work: str, folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(folder)
    monkeypatch.setattr(work, lambda *_, **__: pytest.fail("the work began"))
    assert main(line.split()) == 2
    told = capsys.readouterr().err
    assert told.startswith("stillbed: /proc: --") and told.endswith("allowed a folder that can be written to\n")


def test_the_same_from_a_shell(folder: Path) -> None:
    command = [sys.executable, "-m", "hardware.cli.main", "track", str(folder / "missing"), "-o", str(folder / "OUT")]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=60)
    assert done.returncode == 2 and done.stdout == ""
    told = done.stderr.removeprefix("stillbed track: loading\n")  # where the machine is busy
    assert told.startswith(f"stillbed: {folder}/missing: ")


@pytest.mark.slow
def test_an_unwritable_cache(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "file").touch()
    scenario = ROOT / "data/live/small.toml"
    monkeypatch.setenv("XDG_CACHE_HOME", "/proc")
    assert main(["live", "--simulated", str(scenario), "--record", str(tmp_path / "x.mcap"), "--no-page"]) == 2
    told = capfd.readouterr().err
    (line,) = [line for line in told.splitlines() if line.startswith("stillbed")]
    assert "Traceback" not in told
    assert line.startswith("stillbed: /proc/stillbed: cache = ") and "XDG_CACHE_HOME" in line
    with pytest.raises(InputError, match=r"file/stillbed: cache = .*XDG_CACHE_HOME"):
        prerender(scenario, tmp_path / "file" / "stillbed")


PATIENCE = 20.0  # s, on a busy machine
AT_WORK = """
import os, time
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from hardware.bench.figures import workers
from hardware.offline.track import _start_map_process

def work(number):
    os.write(1, f"{os.getpid()}\\n".encode())
    time.sleep(600)

if __name__ == "__main__":
    with {pool} as pool:
        list(pool.map(work, range(8)))
"""
STARTS = """
import os, time
from hardware.process.system import set_up_process
from hardware.live.ipc import ProcessGroup
from hardware.offline.track import tracker

def tracked():
    with tracker([None, None], [None]):
        time.sleep(60)

def begun():
    crew = ProcessGroup()
    crew.start("small", set_up_process, ("small",))
    try:
        time.sleep(60)
    finally:
        crew.end("small")

if __name__ == "__mp_main__":
    os.write(1, b"loads\\n")
    time.sleep(1)
if __name__ == "__main__":
    try:
        {how}()
    except KeyboardInterrupt:
        print("interrupted")
"""
BENCH = "workers(2)"
TRACKER = "ProcessPoolExecutor(2, get_context('spawn'), _start_map_process)"


def pipe_closed(pid: int) -> bool:
    """Whether a process has ended; one that nobody has waited for yet has, too."""
    try:
        with open(f"/proc/{pid}/stat") as stat:
            return stat.read().rsplit(")", 1)[1].split()[0] == "Z"
    except OSError:
        return True


ONE, ALL = os.kill, os.killpg  # who is told: the parent alone, or all of them as a terminal does
ENDS = [
    *((BENCH, ONE, signal.SIGKILL), (BENCH, ONE, signal.SIGTERM), (TRACKER, ONE, signal.SIGKILL)),
    *((BENCH, ALL, signal.SIGKILL), (BENCH, ALL, signal.SIGTERM), (BENCH, ALL, signal.SIGINT)),
]


@pytest.mark.parametrize(("pool", "end", "word"), ENDS)
def test_they_end_with_their_parent(pool: str, end: Callable[[int, int], None], word: int, tmp_path: Path) -> None:
    (script := tmp_path / "at_work.py").write_text(AT_WORK.replace("{pool}", pool))
    started = subprocess.Popen(
        [sys.executable, str(script)], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, start_new_session=True
    )
    try:
        own = [int(started.stdout.readline()) for _ in range(2)]
        assert not any(map(pipe_closed, own))
        end(started.pid, word)
        assert started.wait(PATIENCE) != 0
        until = time.monotonic() + PATIENCE
        while not all(map(pipe_closed, own)) and time.monotonic() < until:
            time.sleep(0.02)
        assert all(map(pipe_closed, own))
    finally:
        with suppress(ProcessLookupError):
            os.killpg(started.pid, signal.SIGKILL)


@pytest.mark.parametrize("how", ["begun", *slowly("tracked")])
def test_ctrl_c_while_a_process_loads_is_its_parents_alone(how: str, tmp_path: Path) -> None:
    (script := tmp_path / "starts.py").write_text(STARTS.replace("{how}", how))
    started = subprocess.Popen(
        [sys.executable, str(script)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )
    try:
        assert started.stdout.readline() == "loads\n"
        os.killpg(started.pid, signal.SIGINT)
        assert started.communicate(timeout=PATIENCE) == ("interrupted\n", "") and started.returncode == 0
    finally:
        with suppress(ProcessLookupError):
            os.killpg(started.pid, signal.SIGKILL)


def test_what_has_not_begun_is_left_out() -> None:
    begun = time.monotonic()
    with pytest.raises(ZeroDivisionError), workers(1) as pool:
        for _ in pool.map(time.sleep, [0.1] * 3000):
            raise ZeroDivisionError
    assert time.monotonic() - begun < PATIENCE


SEEN = """
import os, sys
from hardware.cli import main as cli, sessions
sessions._track = lambda a: print(sorted(os.listdir('/proc/self/fd')), file=open('seen', 'w'))
sys.exit(cli.main(['track', 'x', '-o', 'y']))
"""


def without(streams: Sequence[int], *command: str, folder: Path = ROOT) -> subprocess.CompletedProcess[str]:
    """A command that begins with these streams closed; what it says on the others."""
    closed = " ".join(f"{number}>&-" for number in streams)
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    line = ["sh", "-c", f'exec "$0" "$@" {closed}', sys.executable, *command]
    return subprocess.run(line, cwd=folder, capture_output=True, text=True, timeout=200, env=environment)


@pytest.mark.parametrize("streams", [(0,), (1,), (2,), (0, 1), (0, 1, 2)])
def test_what_is_opened_takes_no_closed_streams_number(streams: tuple[int, ...], tmp_path: Path) -> None:
    done = without(streams, "-c", SEEN, folder=tmp_path)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")
    assert {"'0'", "'1'", "'2'", "'3'"} <= set((tmp_path / "seen").read_text().strip("[]\n").split(", "))


def test_a_wrong_command_line_is_exit_code_2_where_nobody_hears_it() -> None:
    done = without((0, 1, 2), "-m", "hardware.cli.main", "track", "nowhere", "-o", "nowhere")
    assert (done.returncode, done.stdout, done.stderr) == (2, "", "")


@pytest.mark.slow  # the console without one is tried below
def test_a_live_run_needs_no_standard_input(tmp_path: Path) -> None:
    prepare_files(tmp_path, lines=2, speed=10.0)
    """And a session that is over once all is printed is enough."""
    files = str(tmp_path), str(tmp_path / "x.mcap")
    done = without((0,), "-m", "tests.pictureless_run", *files, "--yes", "--until-printed")
    assert done.returncode == 0 and "done: the path is printed" in done.stderr
    assert "--resume" not in done.stderr and "Traceback" not in done.stderr


def test_a_console_without_a_standard_input_waits_for_no_key(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "stdin", None)
    with Console() as console:
        assert console.file is None
