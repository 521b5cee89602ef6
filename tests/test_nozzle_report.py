"""The page of a simulated print: well-formed, alone in the world, and true to the run; so are its words and figures."""

from __future__ import annotations

import base64
import json
import re
from dataclasses import replace
from pathlib import Path as File

import cv2
import numpy as np
import pytest

from estimation.se3 import Array
from hardware.report.evaluation import evaluate
from hardware.simulator.deposit import deposit_map
from hardware.simulator.nozzle_log import NozzleLog
from hardware.simulator.nozzle_report import nozzle_page, write_nozzle_report
from hardware.simulator.nozzle_run import NozzleResult, NozzleRun, judge
from hardware.simulator.nozzle_summary import nozzle_dict, nozzle_text, nozzle_verdict
from hardware.simulator.planned_line import planned_line
from hardware.simulator.print_picture import COLOURS, KINDS, bead_picture, kinds, view_of, way_keys, way_picture
from hardware.simulator.run_limits import RunLimits, limits_from_table
from planning.path import Path
from tests.moving import raster
from tests.nozzle_logs import breathing, held, nozzle_log, part, straight, through
from tests.runs import run
from tests.test_report import text_of_page

PATH = raster()
REASON = 'pose is 0.301 s old, <so> & "so"'


def eventful() -> NozzleLog:
    return nozzle_log(PATH, breathing, 0.03, np.array([0.1, -0.2, 0.3]), seconds=9.0, reasons=held(2.0, 2.5, REASON))


def judged(log: NozzleLog | None = None, path: Path = PATH, **more: object) -> NozzleResult:
    return judge(NozzleRun("monday <1>", eventful() if log is None else log, path, 0.8, **more))  # type: ignore[arg-type]


LIMITS = limits_from_table("x.toml", {"p95_mm": 0.1, "duty": 0.5, "max_mm": 1.0})


def test_the_page_is_well_formed_and_says_what_happened() -> None:
    tracking = evaluate(*run(60, sigma=np.full(6, 0.01)), "monday")
    result = judged(limits=LIMITS, tracking=tracking, files=(("nozzle.csv", "every millisecond"),))
    text = text_of_page(nozzle_page(result))
    said = ("monday <1>", REASON, "1 of 3 limits missed", "✗ missed", "✓ met", "limits missed", "duty", "Tracking")
    for words in (*said, "every millisecond", "as planned", "outside", "across the path", "NEES"):
        assert words in text


def test_the_page_needs_nothing_from_outside() -> None:
    picture = cv2.imencode(".png", np.zeros((4, 4, 3), np.uint8))[1].tobytes()
    html = nozzle_page(judged(pictures=(("left", picture), ("top", b"\xff\xd8 no png")), files=(("a.csv", "b"),)))
    assert re.findall(r'src="(.{22})', html) == ["data:image/png;base64,", "data:image/jpeg;base64"]
    assert re.findall(r'href="(.{5})', html) == ["data:", "a.csv"]
    assert not re.search(r"https?:|@import|url\(|<script", html)


def empty_plan() -> Path:
    return replace(PATH, extrude=np.zeros(len(PATH), bool))


@pytest.mark.parametrize("rows", [0, 1, 2, 600])
@pytest.mark.parametrize("path", [PATH, empty_plan()])
def test_a_run_of_next_to_nothing_has_a_page_without_a_number_that_is_none(rows: int, path: Path) -> None:
    log = part(nozzle_log(path, breathing), slice(0, rows))
    html = nozzle_page(judged(log, path, limits=LIMITS, complete=False))
    assert "cut short" in text_of_page(html)
    assert not re.search(r'[" ML](nan|inf|-inf)\b', html)


def test_a_run_that_never_printed_says_so_and_meets_no_limit_of_an_error() -> None:
    log = eventful()
    log.extrude[:] = False
    result = judged(log, limits=LIMITS)
    assert "Nothing was printed" in nozzle_verdict(result)[0]
    assert "3 of 3 limits missed" in " ".join(nozzle_verdict(result))
    assert text_of_page(nozzle_page(result))


def test_a_perfect_run_meets_its_limits_and_has_a_page() -> None:
    result = judged(nozzle_log(PATH), limits=LIMITS)
    assert result.met
    text = text_of_page(nozzle_page(result))
    assert "All 3 limits were met." in text
    assert "limits missed" not in text
    assert "The arm never held." in text


def test_a_run_cut_short_is_never_a_success() -> None:
    assert judged(nozzle_log(PATH), limits=LIMITS).met
    assert not judged(nozzle_log(PATH), limits=LIMITS, complete=False).met
    assert judged().verdicts == ()
    assert judged(limits=RunLimits()).met


def test_a_missed_limit_is_told_with_what_was_reached_and_allowed() -> None:
    sentence = nozzle_verdict(judged(limits=limits_from_table("x", {"duty": 0.99, "p95_mm": 9})))[-1]
    assert re.fullmatch(r"1 of 2 limits missed: duty 9\d\.\d %, at least 99 %\.", sentence)


def test_the_summary_is_plain_json_and_the_terminal_says_the_same() -> None:
    result = judged(limits=LIMITS)
    summary = nozzle_dict(result)
    loaded = json.loads(json.dumps(summary, allow_nan=False))
    assert loaded == summary
    assert loaded["errors"]["position_mm"]["max"] == result.figures.nozzle.position.max
    assert loaded["errors"]["angle_deg"]["max"] == pytest.approx(np.degrees(result.figures.nozzle.angle.max))
    assert loaded["holds"][0]["total_s"] == pytest.approx(0.5)
    text = nozzle_text(loaded)
    assert "MISSED  p95_mm" in text
    assert f"{result.figures.nozzle.position.p99:.3f}" in text
    assert REASON in text


def test_a_summary_of_nothing_has_a_text() -> None:
    summary = json.loads(json.dumps(nozzle_dict(judged(part(eventful(), slice(0, 0)), limits=LIMITS)), allow_nan=False))
    assert "–" in nozzle_text(summary)
    assert summary["duty"] is None


def test_a_long_run_stays_a_small_file_and_is_the_same_twice(tmp_path: File) -> None:
    log = nozzle_log(raster(30, 60), breathing, 0.03, seconds=60.0)
    log.base_from_nozzle[:, :3, 3] += np.random.default_rng(0).normal(size=(len(log), 3)) * 0.1
    log.extrude[:] &= np.arange(len(log)) % 40 < 35  # broken into 1500 stretches
    result = judged(log, raster(30, 60))
    for name in ("a.html", "b.html"):
        write_nozzle_report(tmp_path / name, result)
    assert (tmp_path / "a.html").read_bytes() == (tmp_path / "b.html").read_bytes()
    assert (tmp_path / "a.html").stat().st_size < 2_500_000


# -- pictures


def test_cells_are_of_one_kind() -> None:
    planned = np.array([[1.0, 1.0, 1.0, 0.0, 0.0, 2.0, 2.0]])
    laid = np.array([[1.0, 0.5, 1.51, 0.5, 0.49, 1.0, 3.01]])
    assert [KINDS[k] for k in kinds(planned, laid)[0]] == [
        "as planned",
        "missing",
        "double",
        "outside",
        "as planned",
        "as planned",
        "double",
    ]


def colours(svg: str) -> Array:
    data = re.search(r"base64,([^\"]+)", svg)
    assert data is not None
    picture = cv2.imdecode(np.frombuffer(base64.b64decode(data[1]), np.uint8), cv2.IMREAD_UNCHANGED)
    return np.where(picture[..., 3:] == 255, picture[..., 2::-1], 0)


def test_the_bead_map_has_x_to_the_right_and_y_up_and_each_kind_in_its_colour() -> None:
    path = through(np.array([[-10.0, 0, 0], [10, 0, 0]]))
    log = nozzle_log(path)
    log.extrude[log.place > 15] = False  # missing on the right
    log.surface_from_tip[log.place < 5, 1] += 3  # left: laid above instead
    picture = colours(bead_picture(judged(log, path), 0, 500.0))
    view = view_of(deposit_map(log, planned_line(path), 0.8), picture.shape[1])
    places = view.pixels(np.array([[0.0, 0], [8, 0], [-8, 0], [-8, 3]])).round().astype(int)
    assert [tuple(picture[y, x]) for x, y in places] == [COLOURS[0], COLOURS[1], COLOURS[1], COLOURS[3]]


def test_the_way_is_coloured_by_the_worst_error() -> None:
    assert len(way_keys()) == 5
    for off, style in ((0.0, "e0"), (0.2, "e1"), (0.4, "e2"), (0.9, "e3"), (5.0, "e4")):
        svg = way_picture(judged(nozzle_log(straight(), offset=np.array([0, off, 0])), straight()), 400)
        assert re.findall(r'class="(e\d)"', svg) == [style]


def test_every_layer_has_its_map() -> None:
    corners = np.array([[-5.0, 0, 0], [5, 0, 0], [5, 0, 1], [-5, 0, 1]])
    path = through(corners, layer=np.array([0, 0, 1, 1]))
    text = text_of_page(nozzle_page(judged(nozzle_log(path), path)))
    assert "layer 0" in text
    assert "layer 1" in text
