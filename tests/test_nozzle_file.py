"""nozzle.csv and the limits of a run: what was written comes back, and a limit is missed by one epsilon."""

from __future__ import annotations

import csv
import time
from dataclasses import replace
from pathlib import Path as File

import numpy as np
import pytest

from estimation.errors import InputError
from hardware.report.evaluation import spread
from hardware.simulator.deposit import deposit_figures, deposit_map
from hardware.simulator.nozzle_error import nozzle_errors, nozzle_figures
from hardware.simulator.nozzle_file import HEADER, NozzleWriter, read_nozzle
from hardware.simulator.nozzle_log import NozzleLog
from hardware.simulator.planned_line import planned_line
from hardware.simulator.run_limits import BOUNDS, RunFigures, RunLimits, check, limits_from_table
from tests.moving import raster
from tests.nozzle_logs import breathing, held, nozzle_log, part, without_target

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
    writer = NozzleWriter(file, LINE)
    writer.write(log)
    text = file.read_text()
    writer.close()
    assert text.count("\n") == len(log) + 1
    file.write_text(text[:-40])
    assert len(read_nozzle(file)) == len(log) - 1


def test_no_rows_make_an_empty_table(tmp_path: File) -> None:
    write(tmp_path / "nozzle.csv", part(eventful(), slice(0, 0)))
    assert len(read_nozzle(tmp_path / "nozzle.csv")) == 0


def test_a_run_of_20_s_is_written_within_a_second(tmp_path: File) -> None:
    log = nozzle_log(raster(30, 60), breathing, seconds=20.0)
    start = time.process_time()
    write(tmp_path / "nozzle.csv", log)
    assert time.process_time() - start < 1.0


@pytest.mark.parametrize(
    ("row", "what"),
    [
        ("x" + ",0" * 15 + ",", "line 2: stamp_s"),
        ("0" + ",0" * 8 + ",x" + ",0" * 6 + ",", "line 2: error_x_mm"),
        (",0" * 15 + ",", "line 2"),
        ("0,0", "line 2"),
    ],
)
def test_a_wrong_file_is_refused_where_it_is_wrong(tmp_path: File, row: str, what: str) -> None:
    good = "0" + ",0" * 15 + ","
    (tmp_path / "bad.csv").write_text("\n".join([",".join(HEADER), row, good, ""]))
    with pytest.raises(InputError, match=what):
        read_nozzle(tmp_path / "bad.csv")


def test_a_file_of_something_else_is_refused(tmp_path: File) -> None:
    (tmp_path / "other.csv").write_text("stamp_s,frames\n0,1\n")
    for name in ("other.csv", "missing.csv"):
        with pytest.raises(InputError, match=name):
            read_nozzle(tmp_path / name)


# -- limits


def figures() -> RunFigures:
    log = eventful()
    nozzle = nozzle_figures(log, LINE, nozzle_errors(log, LINE))
    return RunFigures(nozzle, deposit_figures(deposit_map(log, LINE, 0.8)), spread(np.array([0.1, 0.2])))


@pytest.mark.parametrize("name", BOUNDS)
def test_a_limit_is_met_at_its_bound_and_missed_by_one_epsilon(name: str) -> None:
    run = figures()
    reached = BOUNDS[name].of(run)
    assert np.isfinite(reached)
    beyond = np.nextafter(reached, np.inf if BOUNDS[name].least else -np.inf)
    for allowed, met in ((reached, True), (float(beyond), False)):
        assert [v.met for v in check(RunLimits((name,), (allowed,)), run)] == [met]


def test_what_is_not_known_meets_no_limit() -> None:
    log = part(eventful(), slice(0, 0))
    nozzle = nozzle_figures(log, LINE, nozzle_errors(log, LINE))
    empty = replace(figures().deposit, **{n: float("nan") for n in ("coverage", "gaps", "overlap", "outside")})
    names = [name for name in BOUNDS if name != "hold_s"]
    limits = RunLimits(tuple(names), tuple(0.0 if BOUNDS[n].least else 1e9 for n in names))
    assert not any(verdict.met for verdict in check(limits, RunFigures(nozzle, empty)))


def test_limits_are_read_in_their_order() -> None:
    limits = limits_from_table("x.toml", {"duty": 1, "p95_mm": 0.5})
    assert (limits.names, limits.allowed) == (("duty", "p95_mm"), (1.0, 0.5))
    assert limits_from_table("x.toml", {}) == RunLimits()
    assert [v.bound.words for v in check(limits, figures())] == ["duty", "position error, 95 %"]


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
