"""The bench: every figure stands beside its target, on the screen and in the files, with what it was measured on."""

from __future__ import annotations

import argparse
import csv
import json
import math
from pathlib import Path

import numpy as np
import pytest

from estimation.errors import InputError
from estimation.synthetic.world import synthetic_world
from hardware.bench.command import add_bench, run_bench, subject_parser
from hardware.bench.figures import Figure, Target, at_least, at_most
from hardware.bench.live import growth
from hardware.bench.machine import this_machine
from hardware.bench.solve_pnp import best_camera, pnp_pose
from hardware.bench.subjects import SUBJECTS, Subject
from hardware.bench.table import table_text
from hardware.cli.main import main
from tests import bench_subject

SUBJECT = {"toy": Subject("tests.bench_subject", bench_subject.add_options, "one figure of each kind")}


def _arguments(*words: str) -> argparse.Namespace:
    parser = argparse.ArgumentParser()
    add_bench(parser.add_subparsers())
    return parser.parse_args(["bench", *words])


def bench(*words: str) -> None:
    run_bench(_arguments(*words), SUBJECT)


@pytest.mark.parametrize("target", [at_most(2.0), at_least(-1.0), Target(-1.0, 2.0)])
def test_a_target_holds_its_ends_and_not_a_hair_more(target: Target) -> None:
    for value in (-1.0, 2.0):
        assert target.met(value)
    assert target.met(math.nextafter(2.0, 3.0)) == math.isinf(target.high)
    assert target.met(math.nextafter(-1.0, -2.0)) == math.isinf(target.low)
    assert not target.met(math.nan)


def test_targets_say_their_direction() -> None:
    assert [str(t) for t in (at_most(0.03), at_least(0.93), Target(0.8, 1.25))] == ["<= 0.03", ">= 0.93", "0.8 to 1.25"]


def test_the_table_marks_what_is_met_and_what_is_missed() -> None:
    text = table_text(
        [Figure("a", 1.0, "mm", at_most(1.0)), Figure("longer", 20.0, "", at_least(30.0)), Figure("c", 3)]
    )
    lines = text.splitlines()
    assert [("met" in line.split(), "MISSED" in line) for line in lines[1:4]] == [
        (True, False),
        (False, True),
        (False, False),
    ]
    assert lines[-1] == "1 of 2 targets met"
    ends = {line.index(value) + len(value) for line, value in zip(lines[1:4], ("1.00", "20.0", "3.00"), strict=True)}
    assert len(ends) == 1  # numbers stand under each other


def test_a_run_prints_its_table_and_saves_the_same_figures(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bench("toy", "-o", str(tmp_path / "out"), "--error", "0.05")
    printed = capsys.readouterr().out
    assert this_machine().cpu in printed and "2 of 4 targets met" not in printed and "1 of 4 targets met" in printed
    saved = json.loads((tmp_path / "out" / "figures.json").read_text())
    assert saved["subject"] == "toy" and saved["options"]["error"] == 0.05
    assert saved["machine"]["cores"] >= 1 and saved["machine"]["versions"]["numpy"]
    error, *_, missing = saved["figures"]
    assert (error["value"], error["high"], error["low"], error["verdict"]) == (0.05, 0.03, None, "MISSED")
    assert missing["value"] is None and missing["note"] == "not here"
    with (tmp_path / "out" / "figures.csv").open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert [row["what"] for row in rows] == [row["what"] for row in saved["figures"]]
    assert [row["value"] for row in rows] == ["0.05", "1.0", "0.9", "300.0", ""]


def test_a_folder_that_holds_something_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "mine.txt").write_text("mine")
    with pytest.raises(InputError, match="--force"):
        bench("toy", "-o", str(tmp_path))
    bench("toy", "-o", str(tmp_path), "--force")
    assert (tmp_path / "figures.json").exists()


def test_without_a_subject_the_subjects_are_listed(capsys: pytest.CaptureFixture[str]) -> None:
    for words in ([], ["--list"]):
        bench(*words)
        assert capsys.readouterr().out == "toy  one figure of each kind\n"


def test_an_unknown_subject_is_told_the_near_one() -> None:
    with pytest.raises(InputError, match="did you mean 'toy'"):
        bench("toi")


@pytest.mark.parametrize("name", SUBJECTS)
def test_every_subject_has_its_options_and_its_run(name: str) -> None:
    assert subject_parser(name, SUBJECTS[name]).parse_args([]).out is None
    assert callable(SUBJECTS[name].run)


def test_the_estimator_is_measured_beside_its_bound(capsys: pytest.CaptureFixture[str]) -> None:
    command = ["bench", "estimator", "--only", "still, clean", "--seeds", "1", "--seconds", "0.5", "--maps", "told"]
    assert main(command) == 0
    text = capsys.readouterr().out
    for words in ("still, clean, exact map: error by bound", "NEES/6", "time, exact map: p99", "differ run twice"):
        assert words in text


def test_a_pattern_that_meets_no_scene_is_told_the_scenes() -> None:
    with pytest.raises(InputError, match="breathing, clean"):
        run_bench(_arguments("estimator", "--only", "dancing"))


def test_a_soak_compares_its_end_with_its_start(capsys: pytest.CaptureFixture[str]) -> None:
    run_bench(_arguments("estimator", "--soak", "0.001", "--maps", "told"))
    lines = capsys.readouterr().out.splitlines()
    assert sum(line.startswith("soak 0.001 h, exact map") for line in lines) == 4


@pytest.mark.slow
def test_where_clocks_differ_the_bench_asks_what_is_known_of_them(capsys: pytest.CaptureFixture[str]) -> None:
    command = ["estimator", "--only", "breathing, offsets 16 ms", "--seeds", "1", "--seconds", "0.3", "--maps", "told"]
    run_bench(_arguments(*command))
    assert "offsets 16 ms, exact map: offsets off by" in capsys.readouterr().out


def test_what_grows_is_told_process_by_process() -> None:
    seconds = np.arange(0.0, 600.0, 2.0)
    held = [(s, {"run": 50.0, "recorder": 80.0 + 0.01 * s} | ({"map": 100.0} if s > 300 else {})) for s in seconds]
    grown = growth(held)
    assert grown["run"] == pytest.approx((0.0, 50.0), abs=1e-6)
    assert grown["recorder"] == pytest.approx((36.0, 85.98), abs=1e-6) and grown["map"][1] == 100.0
    assert growth(held[:4]) == {}


def test_solve_pnp_finds_exact_tracks_exactly_and_no_pose_of_too_few() -> None:
    world = synthetic_world("still", seconds=0.1, noise=1e-6, seed=2)
    place, turn = best_camera([world])
    assert place < 1e-4 and turn < 1e-4
    camera = world.rig.cameras[0]
    assert pnp_pose(camera, world.map.points[:3], np.zeros((3, 2))) is None


def test_solve_pnp_by_one_camera_is_off_by_more_than_the_bound_of_all() -> None:
    world = synthetic_world("breathing", seconds=0.5, outliers=0.1, seed=3)
    place, turn = best_camera([world])
    assert 0.02 < place < 1.0 and 0.05 < turn < 3.0
