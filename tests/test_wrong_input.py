"""Wrong input, whatever is wrong with it: one line that names it and what is allowed, exit code 2, nothing written."""

from __future__ import annotations

import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from hardware.cli.main import main
from hardware.recording.recorder import Recorder
from tests.recorded import write_frames
from tests.session_files import rig
from tests.started import ROOT

WRONG = """
track missing -o OUT
track empty -o OUT
track half.mcap -o OUT
track junk.mcap -o OUT
track whole.mcap -o OUT --arm typo.toml
track whole.mcap -o OUT --record half.mcap
replay missing --path missing -o OUT
replay whole.mcap --path bad.csv -o OUT
replay whole.mcap --path PATH --resume typo.toml -o OUT
replay whole.mcap -o OUT
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
smooth whole.mcap -o OUT --rate nan
compare missing
compare bad.csv
compare whole.mcap:truth whole.mcap:truth
view empty
view missing
segment empty -o OUT
segment missing -o OUT
segment empty -o OUT --threads 0
plan -o OUT.csv
plan junk.stl -o OUT.csv
plan bad.csv -o OUT.csv
plan --example foot wound.stl -o OUT.csv
plan --example foot -o OUT.csv --bead 0
plan --example foot -o OUT.csv --tissue dermis
reach bad.csv --arm ARM
reach PATH --arm unknown.toml
live typo.toml
live unknown.toml
live --rig missing --path PATH --record OUT
live --resume whole.mcap
init unknown.toml
arm /dev/nothing --jog X
arm /dev/nothing --stands 1,2
arm /dev/nothing --origin here --yes
arm --virtual --arm typo.toml
arm --virtual --fault 'dance at 5s'
cameras missing
cameras typo.toml
cameras empty --seconds nan
calibrate board -o OUT.txt
calibrate board -o OUT.pdf --marker 2
calibrate board -o OUT.pdf --dictionary 9X9
calibrate board -o OUT.pdf --page 0x0
calibrate cameras whole.mcap --board unknown.toml -o OUT
calibrate cameras missing --board typo.toml -o OUT
calibrate arm -o OUT
calibrate arm empty -o OUT
calibrate arm --touched typo.toml --cameras rig.toml -o OUT
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
arm
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
bench growth --dance
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Everything that can be wrong with a file."""
    made = tmp_path_factory.mktemp("wrong")
    (made / "empty").mkdir()
    (made / "typo.toml").write_text("a = = 3\n")
    (made / "unknown.toml").write_text("[dance]\nsteps = 1\n")
    (made / "binary.toml").write_bytes(bytes(range(256)))
    (made / "bad.csv").write_text("left,right\nfar,1\n")
    (made / "junk.stl").write_bytes(b"\0junk" * 100)
    (made / "junk.mcap").write_bytes(b"junk" * 100)
    with Recorder(made / "whole.mcap", rig()) as recorder:
        write_frames(recorder, 3, 3, 0.0)
    (made / "half.mcap").write_bytes((made / "whole.mcap").read_bytes()[:60])
    return made


def words(text: str) -> list[str]:
    data = ROOT / "data"
    named = {"STILL": "scenarios/still.toml", "PATH": "paths/square_10mm.csv", "ARM": "arms/s6h4d.toml"}
    return [str(data / named[word]) if word in named else word for word in shlex.split(text)]


@pytest.mark.parametrize("text", WRONG.strip().splitlines())
def test_wrong_input_is_one_line_and_exit_code_2(
    text: str, folder: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(folder)
    assert main(words(text)) == 2
    told = capfd.readouterr()
    lines = [line for line in told.err.splitlines() if line.startswith("stillbed")]
    assert told.out == "" and len(lines) == 1 and told.err.splitlines()[-1] == lines[0]
    assert lines[0].startswith("stillbed: ") and "allowed" in lines[0] and "Errno" not in lines[0]
    assert not list(folder.glob("OUT*"))


@pytest.mark.parametrize("text", MISTYPED.strip().splitlines())
def test_a_mistyped_command_line_is_one_line_and_exit_code_2(
    text: str, folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(folder)
    with pytest.raises(SystemExit) as ended:
        main(words(text))
    told = capsys.readouterr()
    assert ended.value.code == 2 and told.out == ""
    (line,) = told.err.splitlines()
    assert line.startswith("stillbed") and line.endswith(" --help")
    assert "invalid _" not in line  # a function's name tells nobody anything
    assert not list(folder.glob("OUT*"))


def test_what_the_system_refuses_names_the_file_first(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(folder)
    assert main(["init", "typo.toml/below"]) == 2
    assert capsys.readouterr().err == "stillbed: typo.toml/below: not a directory\n"


def test_the_same_from_a_shell(folder: Path) -> None:
    command = [sys.executable, "-m", "hardware.cli.main", "track", str(folder / "missing"), "-o", str(folder / "OUT")]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=60)
    assert done.returncode == 2 and done.stdout == "" and done.stderr.startswith(f"stillbed: {folder}/missing: ")


def test_a_cache_that_cannot_be_written_is_one_line_that_says_where_to_have_another(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "file").touch()
    run = ["live", "--simulated", str(ROOT / "data/live/small.toml"), "--record", str(tmp_path / "x.mcap"), "--no-page"]
    for cache in (tmp_path / "file", Path("/proc")):
        monkeypatch.setenv("XDG_CACHE_HOME", str(cache))
        assert main(run) == 2
        told = capfd.readouterr().err
        (line,) = [line for line in told.splitlines() if line.startswith("stillbed")]
        assert "Traceback" not in told
        assert line.startswith(f"stillbed: {cache}/stillbed: cache = ") and "XDG_CACHE_HOME" in line
