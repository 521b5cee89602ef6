"""Nozzle.csv, the limits of a run, and the page and summary of a simulated print: true to the run."""

from __future__ import annotations

import base64
import csv
import json
import re
import time
from dataclasses import replace
from functools import cache
from pathlib import Path as File

import cv2
import numpy as np
import pytest

from estimation.errors import InputError
from estimation.se3 import Array
from hardware.report.evaluation import evaluate, spread
from hardware.simulator.deposit import NozzleLog, deposit_figures, deposit_map, planned_line
from hardware.simulator.nozzle_error import material_figures, nozzle_errors, nozzle_figures
from hardware.simulator.nozzle_report import (
    CELL_COLOURS,
    CELL_KINDS,
    bead_picture,
    cell_kinds,
    error_legend,
    nozzle_page,
    nozzle_path_picture,
    whole_map_view,
)
from hardware.simulator.nozzle_summary import (
    BOUNDS,
    NozzleResult,
    NozzleRun,
    RunFigures,
    check_limits,
    evaluate_run,
    limits_from_table,
    nozzle_dict,
    nozzle_text,
    nozzle_verdict,
)
from hardware.simulator.run_folder import NozzleWriter
from planning.path import Path
from tests.moving_surfaces import raster
from tests.nozzle_logs import breathing, dry, held, nozzle_log, part, read_nozzle, straight, through, without_target
from tests.test_report import text_of_page
from tests.tracking_runs import run

PATH = raster()
LINE = planned_line(PATH)


def eventful() -> NozzleLog:
    log = nozzle_log(PATH, breathing, 0.03, np.array([0.1, -0.2, 0.3]), reasons=held(2.0, 2.5, 'so, <so> & "so"'))
    return without_target(log, slice(0, 50))


def write(file: File, *logs: NozzleLog) -> None:
    with NozzleWriter(file, LINE) as writer:
        for log in logs:
            writer.write(log)


def test_what_was_written_comes_back(tmp_path: File) -> None:
    log = eventful()
    write(tmp_path / "nozzle.csv", log)
    table, errors = read_nozzle(tmp_path / "nozzle.csv"), nozzle_errors(log, LINE)
    assert len(table) == len(log)
    pairs = [
        (table.stamps, log.stamps),
        (table.nozzle, log.base_from_nozzle[:, :3, 3]),
        (table.target, log.base_from_target[:, :3, 3]),
        (table.distance, errors.distance),
        (table.vector, errors.vector),
        (table.angle, errors.angle),
        (table.path, errors.path),
        (table.place, log.place),
        (table.flow, log.flow),
    ]
    for got, expected in pairs:
        assert np.allclose(got, expected, atol=1e-6, equal_nan=True)
    for got, expected in ((table.extrude, log.extrude), (table.checkpoint, log.checkpoint), (table.reason, log.reason)):
        assert (got == expected).all()
    assert np.isnan(table.target[:50]).all()


def test_rows_written_in_parts_are_those_written_at_once(tmp_path: File) -> None:
    log = eventful()
    write(tmp_path / "a.csv", log)
    write(tmp_path / "b.csv", *[part(log, slice(i, i + 333)) for i in range(0, len(log), 333)])
    assert (tmp_path / "a.csv").read_bytes() == (tmp_path / "b.csv").read_bytes()


def test_a_row_says_its_parts_in_words_and_what_is_not_known_is_empty(tmp_path: File) -> None:
    write(tmp_path / "nozzle.csv", part(eventful(), slice(49, 51)))
    with (tmp_path / "nozzle.csv").open(newline="") as file:
        first, second = csv.DictReader(file)
    assert (first["target_x_mm"], first["error_mm"], first["place_mm"], first["checkpoint"]) == ("", "", "", "-1")
    assert float(first["x_mm"]) == pytest.approx(202, abs=10)
    assert (second["stamp_s"], second["extrude"], second["checkpoint"]) == ("0.050000", "1", "1")
    assert float(second["error_z_mm"]) == pytest.approx(0.3, abs=0.5)


def test_rows_are_on_disk_before_the_file_is_closed_and_a_last_line_cut_short_is_left_out(tmp_path: File) -> None:
    log, file = eventful(), tmp_path / "nozzle.csv"
    with NozzleWriter(file, LINE) as writer:
        writer.write(log)
        text = file.read_text()
    assert text.count("\n") == len(log) + 1
    file.write_text(text[:-40])
    assert len(read_nozzle(file)) == len(log) - 1


def test_no_rows_make_an_empty_table(tmp_path: File) -> None:
    write(tmp_path / "nozzle.csv", part(eventful(), slice(0, 0)))
    assert len(read_nozzle(tmp_path / "nozzle.csv")) == 0


@pytest.mark.slow  # a busy machine is slower
def test_a_run_of_20_s_is_written_within_a_second(tmp_path: File) -> None:
    log = nozzle_log(raster(30, 60), breathing, seconds=20.0)
    start = time.process_time()
    write(tmp_path / "nozzle.csv", log)
    assert time.process_time() - start < 1.0


@cache
def figures() -> RunFigures:
    log = eventful()
    errors = nozzle_errors(log, LINE)
    late = nozzle_log(PATH, breathing, offset=np.array([0.1, 0.0, 0.0]))
    material = material_figures(late, LINE, nozzle_errors(late, LINE), 0.8, open_outside=0.002)
    deposit = deposit_figures(deposit_map(log, LINE, 0.8))
    return RunFigures(nozzle_figures(log, LINE, errors), deposit, material, spread(np.array([0.1, 0.2])))


@pytest.mark.parametrize("name", BOUNDS)
def test_a_limit_is_met_at_its_bound_and_missed_by_one_epsilon(name: str) -> None:
    run = figures()
    reached = BOUNDS[name].value_of(run)
    assert np.isfinite(reached)
    beyond = np.nextafter(reached, np.inf if BOUNDS[name].minimum else -np.inf)
    for allowed, met in ((reached, True), (float(beyond), False)):
        assert [v.met for v in check_limits({name: allowed}, run)] == [met]


def test_what_is_not_known_meets_no_limit() -> None:
    log = part(eventful(), slice(0, 0))
    errors = nozzle_errors(log, LINE)
    nozzle, material = nozzle_figures(log, LINE, errors), material_figures(log, LINE, errors, 0.8, float("nan"))
    empty = replace(figures().deposit, **{n: float("nan") for n in ("coverage", "gaps", "overlap", "outside")})
    names = [name for name in BOUNDS if name != "hold_s"]
    limits = {n: 0.0 if BOUNDS[n].minimum else 1e9 for n in names}
    assert not any(verdict.met for verdict in check_limits(limits, RunFigures(nozzle, empty, material)))


def test_limits_are_read_in_their_order() -> None:
    limits = limits_from_table("x.toml", {"duty": 1, "p95_mm": 0.5})
    assert limits == {"duty": 1.0, "p95_mm": 0.5}
    assert limits_from_table("x.toml", {}) == {}
    assert [v.bound.label for v in check_limits(limits, figures())] == ["duty cycle", "position error, 95 %"]


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ({"p95": 0.5}, r"x.toml: limits.p95 = .*did you mean 'p95_mm'"),
        ({"duty": 80}, r"limits.duty = 80, allowed 0 to 1"),
        ({"max_mm": -1}, r"limits.max_mm = -1, allowed 0 mm or more"),
        ({"lag_ms": "20"}, r"limits.lag_ms = '20', allowed a finite number"),
    ],
)
def test_a_limit_that_makes_no_sense_is_refused(table: dict[str, object], message: str) -> None:
    with pytest.raises(InputError, match=message):
        limits_from_table("x.toml", table)


REASON = 'pose is 0.301 s old, <so> & "so"'


def nozzle_report_eventful() -> NozzleLog:
    return nozzle_log(PATH, breathing, 0.03, np.array([0.1, -0.2, 0.3]), seconds=9.0, reasons=held(2.0, 2.5, REASON))


def judged(log: NozzleLog | None = None, path: Path = PATH, **more: object) -> NozzleResult:
    return evaluate_run(NozzleRun("monday <1>", nozzle_report_eventful() if log is None else log, path, 0.8, **more))


LIMITS = limits_from_table("x.toml", {"p95_mm": 0.1, "duty": 0.5, "max_mm": 1.0})


def test_the_page_is_well_formed_and_says_what_happened() -> None:
    tracking = evaluate(*run(60, sigma=np.full(6, 0.01)), "monday")
    result = judged(limits=LIMITS, tracking=tracking, files=(("nozzle.csv", "every millisecond"),))
    text = text_of_page(nozzle_page(result))
    said = (
        "monday <1>",
        REASON,
        "1 of 3 limits missed",
        "✗ missed",
        "✓ met",
        "limits missed",
        "duty cycle",
        "Tracking",
    )
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
    assert "incomplete" in text_of_page(html)
    assert not re.search(r'[" ML](nan|inf|-inf)\b', html)


def test_a_run_that_never_printed_says_so_and_meets_no_limit_of_an_error() -> None:
    log = nozzle_report_eventful()
    dry(log, slice(None))
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
    assert "No holds." in text


def test_a_run_cut_short_is_never_a_success() -> None:
    assert judged(nozzle_log(PATH), limits=LIMITS).met
    assert not judged(nozzle_log(PATH), limits=LIMITS, complete=False).met
    assert judged().verdicts == ()
    assert judged(limits={}).met


def test_a_missed_limit_is_told_with_what_was_reached_and_allowed() -> None:
    sentence = nozzle_verdict(judged(limits=limits_from_table("x", {"duty": 0.99, "p95_mm": 9})))[-1]
    assert re.fullmatch(r"1 of 2 limits missed: duty cycle 9\d\.\d %, at least 99 %\.", sentence)


def test_the_summary_is_plain_json_and_the_terminal_says_the_same() -> None:
    result = judged(limits=LIMITS)
    summary = nozzle_dict(result)
    loaded = json.loads(json.dumps(summary, allow_nan=False))
    assert loaded == summary and loaded["errors"]["position_mm"]["max"] == result.figures.nozzle.position.max
    assert loaded["errors"]["angle_deg"]["max"] == pytest.approx(np.degrees(result.figures.nozzle.angle.max))
    assert loaded["holds"][0]["total_s"] == pytest.approx(0.5)
    text = nozzle_text(loaded)
    assert "MISSED  p95_mm" in text
    assert f"{result.figures.nozzle.position.p99:.3f}" in text
    assert REASON in text


def test_a_summary_of_nothing_has_a_text() -> None:
    empty = judged(part(nozzle_report_eventful(), slice(0, 0)), limits=LIMITS)
    summary = json.loads(json.dumps(nozzle_dict(empty), allow_nan=False))
    assert "–" in nozzle_text(summary)
    assert summary["duty"] is None


@pytest.mark.slow
def test_a_long_run_stays_a_small_file_and_is_the_same_twice(tmp_path: File) -> None:
    log = nozzle_log(raster(30, 60), breathing, 0.03, seconds=60.0)
    log.base_from_nozzle[:, :3, 3] += np.random.default_rng(0).normal(size=(len(log), 3)) * 0.1
    log.extrude[:] &= np.arange(len(log)) % 40 < 35  # broken into 1500 stretches
    result = judged(log, raster(30, 60))
    for name in ("a.html", "b.html"):
        (tmp_path / name).write_text(nozzle_page(result), encoding="utf-8")
    assert (tmp_path / "a.html").read_bytes() == (tmp_path / "b.html").read_bytes()
    assert (tmp_path / "a.html").stat().st_size < 2_500_000


def test_cells_are_of_one_kind() -> None:
    planned = np.array([[1.0, 1.0, 1.0, 0.0, 0.0, 2.0, 2.0]])
    laid = np.array([[1.0, 0.5, 1.51, 0.5, 0.49, 1.0, 3.01]])
    found = ", ".join(CELL_KINDS[k] for k in cell_kinds(planned, laid)[0])
    assert found == "as planned, missing, double, outside, as planned, as planned, double"


def colours(svg: str) -> Array:
    data = re.search(r"base64,([^\"]+)", svg)
    picture = cv2.imdecode(np.frombuffer(base64.b64decode(data[1]), np.uint8), cv2.IMREAD_UNCHANGED)
    return np.where(picture[..., 3:] == 255, picture[..., 2::-1], 0)


def test_the_bead_map_has_x_to_the_right_and_y_up_and_each_kind_in_its_colour() -> None:
    path = through(np.array([[-10.0, 0, 0], [10, 0, 0]]))
    log = nozzle_log(path)
    dry(log, log.place > 15)  # missing on the right
    log.surface_from_tip[log.place < 5, 1] += 3  # left: laid above instead
    picture = colours(bead_picture(judged(log, path), 0, 500.0))
    view = whole_map_view(deposit_map(log, planned_line(path), 0.8), picture.shape[1])
    places = view.pixels(np.array([[0.0, 0], [8, 0], [-8, 0], [-8, 3]])).round().astype(int)
    assert [tuple(picture[y, x]) for x, y in places] == [CELL_COLOURS[kind] for kind in (0, 1, 1, 3)]


def test_the_way_is_coloured_by_the_worst_error() -> None:
    assert len(error_legend()) == 5
    for off, style in ((0.0, "e0"), (0.2, "e1"), (0.4, "e2"), (0.9, "e3"), (5.0, "e4")):
        svg = nozzle_path_picture(judged(nozzle_log(straight(), offset=np.array([0, off, 0])), straight()), 400)
        assert re.findall(r'class="(e\d)"', svg) == [style]


def test_every_layer_has_its_map() -> None:
    corners = np.array([[-5.0, 0, 0], [5, 0, 0], [5, 0, 1], [-5, 0, 1]])
    path = through(corners, layer=np.array([0, 0, 1, 1]))
    text = text_of_page(nozzle_page(judged(nozzle_log(path), path)))
    assert "layer 0" in text
    assert "layer 1" in text
