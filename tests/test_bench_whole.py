"""All subjects in one go: figures come back as they were saved, what failed is told, what became worse is named."""

from __future__ import annotations

import json
import math
import re
from dataclasses import replace
from pathlib import Path

import pytest

from estimation.errors import InputError
from hardware.bench import whole
from hardware.bench.command import subject_parser
from hardware.bench.figures import Figure, Target, at_least, at_most
from hardware.bench.machine import this_machine
from hardware.bench.saved import save, saved_figures, whole_table
from hardware.bench.subjects import SUBJECTS
from hardware.bench.whole import PARTS, Measured, Part, measure_all, read_whole, regressions, summary
from hardware.bench.whole_page import counted, whole_markdown, whole_page
from hardware.cli.main import main

FIGURES = [
    Figure("error", 0.02, "mm", at_most(0.03), "thesis", "a note"),
    Figure("nees", 1.1, "", Target(0.8, 1.25)),
    Figure("inside", 0.97, "", at_least(0.93)),
    Figure("missing", math.nan, "s", at_most(1.0)),
    Figure("tracks", 300.0),
]


def test_what_is_saved_comes_back(tmp_path: Path) -> None:
    save(tmp_path, "toy", {}, FIGURES, this_machine())
    again = saved_figures(tmp_path / "figures.json")
    assert [f for f in again if f.what != "missing"] == [f for f in FIGURES if f.what != "missing"]
    assert math.isnan(again[3].value) and again[3].verdict == "MISSED"


def test_each_part_has_a_folder_of_its_own() -> None:
    assert len({part.name or part.subject for part in PARTS}) == len(PARTS)


@pytest.mark.parametrize("part", PARTS, ids=lambda part: part.name or part.subject)
def test_each_part_is_a_subject_with_options_that_it_has(part: Part) -> None:
    for options in (part.options, part.quick or ()):
        subject_parser(part.subject, SUBJECTS[part.subject]).parse_args(list(options))


def test_all_parts_are_measured_and_a_failed_one_is_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    parts = (
        Part("planner", ("--updates", "20"), ("--updates", "20")),
        Part("prediction", (), ("--traces", "none"), name="chests"),
        Part("plan"),
    )
    done = measure_all(tmp_path, True, parts)
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
    assert counted(parts) == (4, 1, 1)
    page = whole_page(parts, {"<odd>": "why & not"}, {"toy": "toy/toy.html"}, this_machine())
    assert page.count('<td class="met">') == 3 and page.count('<td class="missed">') == 1
    assert 'href="toy/toy.html"' in page and "&lt;odd&gt;" in page and "why &amp; not" in page
    missed = next(figure.what for figure in FIGURES if figure.verdict == "MISSED")
    assert f'class="words">{missed}</td>' in page  # in the overview, too
    for link in re.findall(r'href="#([^"]+)"', page):
        assert f'id="{link}"' in page


def test_a_table_in_markdown_has_a_line_for_each_figure() -> None:
    odd = Figure("a | b", 2.0, "mm", at_most(1.0))
    lines = whole_markdown({"toy": [*FIGURES, odd]}, this_machine()).splitlines()
    rows = [line for line in lines if line.startswith("| ")]
    assert len(rows) == len(FIGURES) + 2 and all(row.replace(r"\|", "").count("|") == 7 for row in rows)
    assert "3 of 5 targets are met;" in "\n".join(lines)


def test_what_was_measured_of_the_same_code_is_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    machine = replace(this_machine(), commit="abc")
    monkeypatch.setattr(whole, "this_machine", lambda: machine)
    (tmp_path / "plan").mkdir()
    save(tmp_path / "plan", "plan", {}, FIGURES[:1], machine)
    (tmp_path / "plan/options.json").write_text(json.dumps(["abc", "--body", "foot"]))
    (done,) = measure_all(tmp_path, False, [Part("plan", ("--body", "foot"))])
    assert done.figures == (FIGURES[0],)
    assert whole._kept(tmp_path / "plan", ["--body", "chest"], machine) is None
    other = replace(machine, commit="abd")
    assert whole._kept(tmp_path / "plan", ["--body", "foot"], other) is None


@pytest.mark.parametrize(("line", "quick"), [(["--all"], False), (["--quick"], True), (["--all", "--quick"], True)])
def test_the_whole_is_asked_for_by_either_word(
    line: list[str], quick: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = list[tuple[Path, bool]]()
    monkeypatch.setattr(whole, "measure_all", lambda out, quick: asked.append((out, quick)) or [])
    assert main(["bench", *line, "-o", str(tmp_path)]) == 0
    assert asked == [(tmp_path, quick)]


def table(tmp_path: Path, figures: list[Figure]) -> Path:
    file = tmp_path / "before.json"
    file.write_text(json.dumps(whole_table({"toy": figures}, this_machine())))
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
    text = regressions([Measured("toy", (Figure("error", now, "mm", at_most(0.03)),))], file)
    assert ("error" in text) == told and f": {int(told)}" in text


def test_worse_has_a_side(tmp_path: Path) -> None:
    file = table(tmp_path, [Figure("inside", 0.97, "", at_least(0.93)), Figure("nees", 1.05, "", Target(0.8, 1.25))])
    found = (Figure("inside", 0.99, "", at_least(0.93)), Figure("nees", 0.7, "", Target(0.8, 1.25)))
    text = regressions([Measured("toy", found)], file)
    assert "nees 1.05 -> 0.7" in text and "inside" not in text


def test_a_file_that_is_no_table_is_one_clear_line(tmp_path: Path) -> None:
    (tmp_path / "x.json").write_text('{"subjects": [1]}')
    for file in (tmp_path / "x.json", tmp_path / "none.json"):
        with pytest.raises(InputError, match="bench --all"):
            read_whole(file)
