"""report.html: well-formed, alone in the world, and true to the run."""

from __future__ import annotations

import re
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest

from estimation.pose import TrackState
from hardware.report.evaluation import Evaluation, evaluate
from hardware.report.page import Plot, Scale, round_step, spanning, stretches, thinned
from hardware.report.report import main, page, write_report
from hardware.report.summary import as_dict, summary_text, verdict, write_summary
from tests.runs import run

SIGMA = np.array([0.002, 0.002, 0.002, 0.1, 0.1, 0.1])
VOID = {"meta", "path", "rect", "circle", "image", "img"}


class Nesting(HTMLParser):
    """Fails on a tag that is closed out of turn."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.text: list[str] = []

    def handle_starttag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        if tag != "meta":
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        assert tag in VOID

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.text.append(data)


def text_of_page(html: str) -> str:
    reader = Nesting()
    reader.feed(html)
    reader.close()
    assert reader.open == []
    return " ".join(reader.text)


def eventful() -> Evaluation:
    states = {0: TrackState.INITIALISING, 30: TrackState.COASTING, 31: TrackState.LOST, 50: TrackState.DEGRADED}
    table, truth = run(80, sigma=SIGMA, states=states)
    table.base_from_surface[60, 0, 3] += 20
    return evaluate(table, truth, "monday <1>", since=0.1)


def test_the_page_is_well_formed_and_says_what_happened() -> None:
    text = text_of_page(page(eventful()))
    for words in ("monday <1>", "One pose was off by more than 10 mm", "LOST 1.3 %", "left, median", "row 31", "NEES"):
        assert words in text


def test_the_page_needs_nothing_from_outside() -> None:
    html = page(eventful())
    assert not re.search(r"https?:|src=|@import|url\(|<script", html)


def test_no_number_on_the_page_is_not_a_number() -> None:
    assert not re.search(r'[" ML](nan|inf|-inf)\b', page(eventful()))


@pytest.mark.parametrize("rows", [0, 1, 2])
def test_a_run_of_next_to_nothing_has_a_page(rows: int) -> None:
    table, truth = run(rows)
    for known in (truth if rows else None, None):
        assert "stillbed" in text_of_page(page(evaluate(table, known, "short", complete=False)))


def test_a_run_without_any_known_pose_has_a_page() -> None:
    table, truth = run(5, states={i: TrackState.INITIALISING for i in range(5)})
    table.base_from_surface[:] = np.nan
    table.covariance[:] = np.nan
    assert "INITIALISING 100 %" in text_of_page(page(evaluate(table, truth)))


def test_the_page_says_when_each_camera_exposes() -> None:
    table, truth = run(40, sigma=SIGMA)
    result = evaluate(table, truth)
    text = text_of_page(page(result))
    at_end = "left +14.3 ± 0.4 ms, top -9.1 ± 0.4 ms, right -5.2 ± 0.4 ms"
    assert f"the cameras expose at {at_end}." in text
    assert "left, at the end +14.3 ± 0.4 ms" in text
    assert at_end in summary_text(result)
    assert as_dict(result)["clocks_ms"]["top"] == pytest.approx({"offset": -9.1, "sigma": 0.4})


def test_cameras_that_expose_together_are_said_to() -> None:
    table, truth = run(40, sigma=SIGMA)
    table.offsets[:] = 0
    assert "No camera exposes clearly earlier or later than the others (known to 0.4 ms)." in verdict(
        evaluate(table, truth)
    )


@pytest.mark.parametrize("states", [{}, {i: TrackState.INITIALISING for i in range(40)}])
def test_a_method_that_learns_no_clocks_says_nothing_of_them(states: dict[int, TrackState]) -> None:
    table, truth = run(40, sigma=SIGMA, states=states)
    table.offset_sigmas[:] = np.nan
    result = evaluate(table, truth)
    text = text_of_page(page(result))
    assert "Clocks" not in text
    assert "expose" not in text
    assert as_dict(result)["clocks_ms"] is None


def test_a_perfect_run_has_a_page() -> None:
    table, truth = run(40)
    table.base_from_surface[:] = truth.base_from_surface[:] = np.eye(4)
    assert "0.0000 mm" in text_of_page(page(evaluate(table, truth)))


def test_a_measured_reference_is_not_called_truth() -> None:
    table, truth = run(40, sigma=SIGMA)
    reference = type(truth)(truth.stamps, truth.base_from_surface, False)
    text = text_of_page(page(evaluate(table, reference)))
    assert "measured reference" in text
    assert "exact truth" not in text


def test_a_long_run_stays_a_small_file(tmp_path: Path) -> None:
    write_report(tmp_path / "report.html", evaluate(*run(20_000, sigma=SIGMA)))
    assert (tmp_path / "report.html").stat().st_size < 2_000_000


def test_the_module_says_a_run_again(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_summary(tmp_path / "summary.json", eventful())
    assert main([str(tmp_path)]) == 0
    assert "from the start, mm" in capsys.readouterr().out


def test_scales_put_ends_at_ends() -> None:
    scale = Scale(2.0, 4.0, 100.0, 0.0)
    assert scale(np.array([2.0, 3.0, 4.0, 99.0])).tolist() == [100, 50, 0, 0]
    assert scale.ticks(4) == [2.0, 2.5, 3.0, 3.5, 4.0]
    decades = Scale(0.01, 100.0, 0.0, 4.0, True)
    assert np.allclose(decades(np.array([0.01, 0.1, 1.0, 10.0])), [0, 1, 2, 3])
    assert np.allclose(decades.ticks(), [0.01, 0.1, 1, 10, 100])
    assert np.allclose(Scale(0.15, 3.0, 0.0, 1.0, True).ticks(), [0.2, 0.5, 1, 2])


@pytest.mark.parametrize(("rough", "step"), [(1.0, 1.0), (1.01, 2.0), (0.03, 0.05), (70.0, 100.0), (5e-7, 5e-7)])
def test_steps_are_round(rough: float, step: float) -> None:
    assert round_step(rough) == pytest.approx(step)


def test_thinning_keeps_the_extremes() -> None:
    y = np.zeros(100_000)
    y[[123, 77_777]] = [-5, 9]
    kept = thinned(y, 1000)
    assert len(kept) <= 1000
    assert {123, 77_777} <= set(kept.tolist())
    assert (np.diff(kept) > 0).all()


def test_a_line_breaks_where_there_is_nothing() -> None:
    plot = Plot(400, 200, (0, 4), (0, 1))
    plot.line(np.arange(5.0), np.array([0, 1, np.nan, 1, 0]), "estimate")
    assert plot.svg().count('class="estimate"') == 2
    assert [(s.start, s.stop) for s in stretches(np.array([True, False, True, True]))] == [(0, 1), (2, 4)]


def test_a_span_is_never_empty() -> None:
    for values in ([], [np.array([3.0])], [np.array([np.nan])], [np.zeros(4)]):
        low, high = spanning(values)
        assert low < high
