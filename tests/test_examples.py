"""The examples run as they stand, and print what they say they do."""

from __future__ import annotations

import os
import runpy
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from estimation import se3
from estimation.errors import InputError
from estimation.synthetic.arc_rig import arc_rig
from estimation.trajectory import Trajectory
from hardware.files.path_file import read_path, write_path
from hardware.script import run_script
from hardware.tum import write_tum
from tests.moving import raster
from tests.synthetic import write_session

EXAMPLES = Path(__file__).parents[1] / "docs" / "examples"


def run(name: str, *words: object) -> None:
    runpy.run_path(str(EXAMPLES / name))["main"](*map(str, words))


def test_a_folder_of_pictures_is_tracked(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_session(tmp_path / "s", seconds=0.7, rate=10.0, seed=2, cameras=arc_rig(size=(640, 360), focal=700.0))
    run("track_videos.py", tmp_path / "s")
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 7 and "TRACKING" in lines[-1]
    assert 0 < float(lines[-1].split("+-")[1]) < 0.2  # mm


def test_a_scanned_wound_is_planned(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    from hardware.plan.run import example_scan
    from hardware.ply_file import write_ply

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
    told = capsys.readouterr().out
    assert "off by: rmse 0.3536, median 0.2500, max 0.5000" in told


@pytest.mark.parametrize("file", sorted(EXAMPLES.glob("*.py")), ids=lambda file: file.name)
def test_each_example_is_shown_in_the_documents(file: Path) -> None:
    assert f"docs/examples/{file.name}" in (EXAMPLES.parents[1] / "README.md").read_text(encoding="utf-8")


def started(file: Path, *words: str) -> subprocess.CompletedProcess[str]:
    environment = os.environ | {"PYTHONPATH": str(EXAMPLES.parents[1])}
    command = [sys.executable, str(file), *words]
    return subprocess.run(command, capture_output=True, text=True, timeout=100, env=environment)


@pytest.mark.parametrize("file", sorted(EXAMPLES.glob("*.py")), ids=lambda file: file.name)
def test_each_example_says_how_it_is_started(file: Path) -> None:
    asked, wrong = started(file, "--help"), started(file, "a", "b", "c")
    assert (asked.returncode, asked.stderr) == (0, "") and f"python docs/examples/{file.name}" in asked.stdout
    assert (wrong.returncode, wrong.stdout) == (2, "")
    (line,) = wrong.stderr.splitlines()
    assert line.startswith(f"usage: python docs/examples/{file.name}")


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
        assert code(*words) == 2
        assert capsys.readouterr() == ("", "usage: python own.py SCAN [SECONDS]\n")
    assert code("wrong", "2") == 2
    assert capsys.readouterr() == ("", "wrong: size = 2.0, allowed less\n")
    assert code("nowhere") == 2
    assert capsys.readouterr() == ("", "nowhere: no such file or directory\n")
    assert code(__file__, "2") == 0
    assert capsys.readouterr() == (f"{__file__} 2.0\n", "")
