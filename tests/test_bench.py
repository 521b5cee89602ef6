"""The bench: each figure beside its target, on screen and in files; all subjects in one go, compared with before."""

from __future__ import annotations

import argparse
import json
import math
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from estimation.errors import InputError
from estimation.synthetic.world import synthetic_world
from hardware.bench import whole
from hardware.bench.figures import (
    Figure,
    Target,
    at_least,
    at_most,
    memory_figures,
    memory_growth,
    read_figures,
    save,
    table_text,
    this_machine,
    whole_text,
)
from hardware.bench.subjects import BENCH_WHOLE, SUBJECTS, BenchPart, Subject, Subjects, Whole
from hardware.bench.whole import (
    MeasuredPart,
    measure_all,
    read_whole,
    regressions,
    summary,
    target_counts,
    whole_markdown,
    whole_page,
)
from hardware.cli.main import add_bench, main, run_bench, subject_parser
from hardware.cli.parser import Commands
from tests import bench_subject
from tests.campaigns import __main__ as campaigns
from tests.campaigns.__main__ import CAMPAIGNS, PROGRAM, WHOLE
from tests.campaigns.estimator import best_camera, pnp_pose

SUBJECT = {"toy": Subject("tests.bench_subject:run", bench_subject.add_options, "one figure of each kind")}


def _arguments(*words: str) -> argparse.Namespace:
    parser = argparse.ArgumentParser()
    add_bench(Commands(parser, "COMMAND"))
    return parser.parse_args(["bench", *words])


def bench(*words: str) -> None:
    run_bench(_arguments(*words), SUBJECT)


@pytest.mark.parametrize("target", [at_most(2.0), at_least(-1.0), Target(-1.0, 2.0)])
def test_a_target_holds_its_ends_and_not_a_hair_more(target: Target) -> None:
    for value in (-1.0, 2.0):
        assert target.met(value)
    assert target.met(math.nextafter(2.0, 3.0)) == math.isinf(target.high)
    assert target.met(math.nextafter(-1.0, -2.0)) == math.isinf(target.low) and not target.met(math.nan)


def test_targets_say_their_direction() -> None:
    assert [str(t) for t in (at_most(0.03), at_least(0.93), Target(0.8, 1.25))] == ["<= 0.03", ">= 0.93", "0.8 to 1.25"]


def test_the_table_marks_what_is_met_and_what_is_missed() -> None:
    figures = [Figure("a", 1.0, "mm", at_most(1.0)), Figure("longer", 20.0, "", at_least(30.0)), Figure("c", 3)]
    lines = table_text(figures).splitlines()
    assert ["met" in line.split() for line in lines[1:4]] == [True, False, False]
    assert ["MISSED" in line for line in lines[1:4]] == [False, True, False]
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


@pytest.mark.parametrize(("subjects", "name"), [(each, name) for each in (SUBJECTS, CAMPAIGNS) for name in each])
def test_every_subject_has_its_options_and_its_run(subjects: Subjects, name: str) -> None:
    assert subject_parser(name, subjects[name]).parse_args([]).out is None and callable(subjects[name].run)


def test_who_asks_for_what_developers_measure_is_told_where_it_is(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["bench", "estimator"]) == 2 and campaigns.main(["estimatr"]) == 2
    told, other = [line for line in capsys.readouterr().err.splitlines() if "SUBJECT" in line]
    assert PROGRAM in told and "did you mean 'estimator'" in other and PROGRAM not in other


def test_the_estimator_is_measured_beside_its_bound(capsys: pytest.CaptureFixture[str]) -> None:
    command = ["estimator", "--only", "still, clean", "--seeds", "1", "--seconds", "0.5", "--maps", "told"]
    assert campaigns.main(command) == 0
    text = capsys.readouterr().out
    for words in ("still, clean, exact map: error by bound", "NEES/6", "time, exact map: p99", "differ run twice"):
        assert words in text


def test_a_pattern_that_meets_no_scene_is_told_the_scenes(capsys: pytest.CaptureFixture[str]) -> None:
    assert campaigns.main(["estimator", "--only", "dancing"]) == 2
    assert "breathing, clean" in capsys.readouterr().err


@pytest.mark.slow
def test_a_soak_compares_its_end_with_its_start(capsys: pytest.CaptureFixture[str]) -> None:
    assert campaigns.main(["estimator", "--soak", "0.001", "--maps", "told"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert sum(line.startswith("soak 0.001 h, exact map") for line in lines) == 4


@pytest.mark.slow
def test_where_clocks_differ_the_bench_asks_what_is_known_of_them(capsys: pytest.CaptureFixture[str]) -> None:
    command = ["estimator", "--only", "breathing, offsets 16 ms", "--seeds", "1", "--seconds", "0.3", "--maps", "told"]
    assert campaigns.main(command) == 0
    assert "offsets 16 ms, exact map: offsets off by" in capsys.readouterr().out


def test_what_grows_is_told_process_by_process() -> None:
    seconds = np.arange(0.0, 600.0, 2.0)
    held = [(s, {"run": 50.0, "recorder": 80.0 + 0.01 * s} | ({"map": 100.0} if s > 300 else {})) for s in seconds]
    grown = memory_growth(held)
    assert grown["run"] == pytest.approx((0.0, 50.0), abs=1e-6)
    assert grown["recorder"] == pytest.approx((36.0, 85.98), abs=1e-6) and grown["map"][1] == 100.0
    warming = [(s, {"map": 100.0 + min(s, 90.0) / 6}) for s in seconds]  # fills its heap, and grows no more
    assert memory_growth(warming)["map"] == pytest.approx((0.0, 115.0), abs=1e-6)
    (slope, size), nothing = memory_growth(warming[:60])["map"], memory_growth([])
    assert np.isnan(slope) and size == 115.0 and nothing == {}  # too short to tell


def test_the_growth_of_memory_leaves_out_the_first_minutes_and_says_so() -> None:
    steps = [(s, {"run": 50.0 + min(s, 90.0), "map": 100.0 + s / 1800}) for s in np.arange(0.0, 600.0, 2.0).tolist()]
    grown, size = memory_figures("live", steps)
    assert grown.value == pytest.approx(2.0) and grown.note == "run +0.0, map +2.0; without the first 2 min"
    assert size.value == pytest.approx(240.33, abs=0.01) and grown.target == at_most(5)
    short = memory_figures("live", steps[:60])[0]
    assert np.isnan(short.value) and short.target is None and "4 min and more" in short.note


def test_solve_pnp_finds_exact_tracks_exactly_and_no_pose_of_too_few() -> None:
    world = synthetic_world("still", seconds=0.1, noise=1e-6, seed=2)
    place, turn = best_camera([world])
    assert place < 1e-4 and turn < 1e-4
    assert pnp_pose(world.rig.cameras[0], world.map.points[:3], np.zeros((3, 2))) is None


def test_solve_pnp_by_one_camera_is_off_by_more_than_the_bound_of_all() -> None:
    world = synthetic_world("breathing", seconds=0.5, outliers=0.1, seed=3)
    place, turn = best_camera([world])
    assert 0.02 < place < 1.0 and 0.05 < turn < 3.0


FIGURES = [
    Figure("error", 0.02, "mm", at_most(0.03), "thesis", "a note"),
    Figure("nees", 1.1, "", Target(0.8, 1.25)),
    Figure("inside", 0.97, "", at_least(0.93)),
    Figure("missing", math.nan, "s", at_most(1.0)),
    Figure("tracks", 300.0),
]


def test_what_is_saved_comes_back(tmp_path: Path) -> None:
    save(tmp_path, "toy", {}, FIGURES, this_machine())
    again = read_figures(tmp_path / "figures.json")
    assert [f for f in again if f.what != "missing"] == [f for f in FIGURES if f.what != "missing"]
    assert math.isnan(again[3].value) and again[3].verdict == "MISSED"


def test_each_part_has_a_folder_of_its_own() -> None:
    assert len({part.name or part.subject for part in WHOLE.parts}) == len(WHOLE.parts)
    assert set(BENCH_WHOLE.parts) <= set(WHOLE.parts) and {part.program for part in BENCH_WHOLE.parts} != {PROGRAM}


@pytest.mark.parametrize("part", WHOLE.parts, ids=lambda part: part.name or part.subject)
def test_each_part_is_a_subject_with_options_that_it_has(part: BenchPart) -> None:
    for options in (part.options, part.quick or ()):
        subjects = CAMPAIGNS if part.program == PROGRAM else SUBJECTS
        subject_parser(part.subject, subjects[part.subject]).parse_args(list(options))


@pytest.mark.slow  # what they are made of is measured, kept and shown below
def test_all_parts_are_measured_and_a_failed_one_is_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    parts = (
        BenchPart("planner", ("--updates", "20"), ("--updates", "20"), program=PROGRAM),
        BenchPart("prediction", (), ("--traces", "none"), name="chests"),
        BenchPart("plan"),
    )
    done = measure_all(tmp_path, True, Whole(PROGRAM, parts))
    assert [one.subject for one in done] == ["planner", "chests"]  # the quick look leaves `plan` out
    assert any(f.what == "uncaught errors" and f.verdict == "met" for f in done[0].figures)
    assert "stillbed bench prediction" in done[1].trouble and "no figures" in summary(done)
    assert "1 of 2: planner --updates 20" in capsys.readouterr().out
    assert ("planner", "uncaught errors") in read_whole(tmp_path / "figures.json")
    page, table = (tmp_path / "report.html").read_text(), (tmp_path / "table.md").read_text()
    for figure in done[0].figures:
        assert figure.what in page and f"| {figure.what} |" in table
    assert "no figures" in page and "## chests" in table


def test_the_page_counts_colours_and_leads_to_the_pictures(tmp_path: Path) -> None:
    parts = {"toy": FIGURES, "<odd>": []}
    assert target_counts(parts) == (4, 1, 1)
    page = whole_page(PROGRAM, parts, {"<odd>": "why & not"}, {"toy": "toy/toy.html"}, this_machine())
    assert page.count('<td class="met">') == 3 and page.count('<td class="missed">') == 1
    assert 'href="toy/toy.html"' in page and "&lt;odd&gt;" in page and "why &amp; not" in page
    missed = next(figure.what for figure in FIGURES if figure.verdict == "MISSED")
    assert f'class="words">{missed}</td>' in page  # in the overview, too
    for link in re.findall(r'href="#([^"]+)"', page):
        assert f'id="{link}"' in page


def test_a_table_in_markdown_has_a_line_for_each_figure() -> None:
    odd = Figure("a | b", 2.0, "mm", at_most(1.0))
    lines = whole_markdown(PROGRAM, {"toy": [*FIGURES, odd]}, this_machine()).splitlines()
    rows = [line for line in lines if line.startswith("| ")]
    assert len(rows) == len(FIGURES) + 2 and all(row.replace(r"\|", "").count("|") == 7 for row in rows)
    assert "3 of 5 targets are met;" in "\n".join(lines)


def test_what_was_measured_of_the_same_code_is_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    machine = replace(this_machine(), commit="abc")
    monkeypatch.setattr(whole, "this_machine", lambda: machine)
    (tmp_path / "plan").mkdir()
    save(tmp_path / "plan", "plan", {}, FIGURES[:1], machine)
    (tmp_path / "plan/options.json").write_text(json.dumps(["abc", "--body", "foot"]))
    (done,) = measure_all(tmp_path, False, Whole(PROGRAM, (BenchPart("plan", ("--body", "foot")),)))
    assert done.figures == (FIGURES[0],) and whole._earlier(tmp_path / "plan", ["--body", "chest"], machine) is None
    assert whole._earlier(tmp_path / "plan", ["--body", "foot"], replace(machine, commit="abd")) is None


@pytest.mark.parametrize(("line", "quick"), [(["--all"], False), (["--quick"], True), (["--all", "--quick"], True)])
def test_either_word_means_all(line: list[str], quick: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked = list[tuple[Path, bool, Whole]]()
    monkeypatch.setattr(whole, "measure_all", lambda out, quick, parts: asked.append((out, quick, parts)) or [])
    assert main(["bench", *line, "-o", str(tmp_path)]) == campaigns.main([*line, "-o", str(tmp_path)]) == 0
    assert asked == [(tmp_path, quick, BENCH_WHOLE), (tmp_path, quick, WHOLE)]


def table(tmp_path: Path, figures: list[Figure]) -> Path:
    file = tmp_path / "before.json"
    file.write_text(whole_text({"toy": figures}, this_machine()))
    return file


@pytest.mark.parametrize(
    ("before", "now", "told"),
    [
        (0.020, 0.0235, False),  # within what machines vary by
        (0.020, 0.0245, True),
        (0.029, 0.031, True),  # met no more
        (0.040, 0.045, False),
        (0.040, 0.049, True),
        (0.020, 0.010, False),
    ],
)
def test_what_became_worse_is_named(before: float, now: float, told: bool, tmp_path: Path) -> None:
    file = table(tmp_path, [Figure("error", before, "mm", at_most(0.03))])
    text = regressions([MeasuredPart("toy", (Figure("error", now, "mm", at_most(0.03)),))], file)
    assert ("error" in text) == told and f": {int(told)}" in text


def test_worse_has_a_side(tmp_path: Path) -> None:
    file = table(tmp_path, [Figure("inside", 0.97, "", at_least(0.93)), Figure("nees", 1.05, "", Target(0.8, 1.25))])
    found = (Figure("inside", 0.99, "", at_least(0.93)), Figure("nees", 0.7, "", Target(0.8, 1.25)))
    text = regressions([MeasuredPart("toy", found)], file)
    assert "nees 1.05 -> 0.7" in text and "inside" not in text


def test_a_file_that_is_no_table_is_one_clear_line(tmp_path: Path) -> None:
    (tmp_path / "x.json").write_text('{"subjects": [1]}')
    for file in (tmp_path / "x.json", tmp_path / "none.json"):
        with pytest.raises(InputError, match="bench --all"):
            read_whole(file)


@pytest.mark.slow
def test_too_few_views_to_calibrate_from_are_told_and_the_figures_are_not_measured(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    line = ["bench", "calibration", "--instants", "2", "--runs", "1", "-o", str(tmp_path / "out")]
    assert main(line) == 0
    told = capsys.readouterr().out
    assert "not measured: camera a: views of the board = 2, allowed 10 or more" in told and "0 of 6" not in told
    *rendered, drawn = read_figures(tmp_path / "out" / "figures.json")
    assert all(math.isnan(f.value) and f.note.startswith("not measured") for f in rendered)
    assert len(rendered) == 10 and math.isfinite(drawn.value)
