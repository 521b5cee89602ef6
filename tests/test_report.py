"""Report.html: well-formed, self-contained, true to the run; the laws of judging a run."""

from __future__ import annotations

import json
import re
from html.parser import HTMLParser
from importlib.resources import files
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from estimation import se3
from estimation.pose import TrackState, Trajectory
from hardware.report.evaluation import (
    Evaluation,
    as_dict,
    associate,
    best_constant,
    compare,
    evaluate,
    latency,
    percent,
    spread,
    state_shares,
    summary_text,
    text_of,
    verdict,
    write_summary,
)
from hardware.report.page import Plot, Scale, round_step, spanning, stretches, thinned
from hardware.report.report import track_page, write_report
from tests.tracking_runs import run

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


def test_the_page_is_well_formed_needs_nothing_from_outside_and_says_what_happened() -> None:
    html = track_page(eventful())
    text = text_of_page(html)
    for words in ("monday <1>", "One pose had an error above 10 mm", "LOST 1.3 %", "left, median", "row 31", "NEES"):
        assert words in text
    assert not re.search(r"https?:|src=|@import|url\(|<script", html)
    assert not re.search(r'[" ML](nan|inf|-inf)\b', html)


@pytest.mark.parametrize("rows", [0, 1, 2])
def test_a_run_of_next_to_nothing_has_a_page(rows: int) -> None:
    table, truth = run(rows)
    for known in (truth if rows else None, None):
        assert "stillbed" in text_of_page(track_page(evaluate(table, known, "short", complete=False)))


def test_a_run_without_any_known_pose_has_a_page() -> None:
    table, truth = run(5, states={i: TrackState.INITIALISING for i in range(5)})
    table.base_from_surface[:] = np.nan
    table.covariance[:] = np.nan
    assert "INITIALISING 100 %" in text_of_page(track_page(evaluate(table, truth)))


def test_the_page_says_when_each_camera_exposes_or_that_all_do_together() -> None:
    table, truth = run(40, sigma=SIGMA)
    result = evaluate(table, truth)
    text = text_of_page(track_page(result))
    at_end = "left +14.3 ± 0.4 ms, top -9.1 ± 0.4 ms, right -5.2 ± 0.4 ms"
    assert f"Clock offsets of the cameras, relative to their mean: {at_end}." in text
    assert "left, at the end +14.3 ± 0.4 ms" in text
    assert at_end in summary_text(result)
    assert as_dict(result)["clocks_ms"]["top"] == pytest.approx({"offset": -9.1, "sigma": 0.4})
    table.offsets[:] = 0
    said = verdict(evaluate(table, truth))
    assert "No camera has a significant clock offset (one sigma: 0.4 ms)." in said


@pytest.mark.parametrize("states", [{}, {i: TrackState.INITIALISING for i in range(40)}])
def test_a_method_that_learns_no_clocks_says_nothing_of_them(states: dict[int, TrackState]) -> None:
    table, truth = run(40, sigma=SIGMA, states=states)
    table.offset_sigmas[:] = np.nan
    result = evaluate(table, truth)
    text = text_of_page(track_page(result))
    assert "Clock" not in text
    assert as_dict(result)["clocks_ms"] is None


def test_a_perfect_run_has_a_page() -> None:
    table, truth = run(40)
    table.base_from_surface[:] = truth.base_from_surface[:] = np.eye(4)
    assert "0.0000 mm" in text_of_page(track_page(evaluate(table, truth)))


def test_a_measured_reference_is_not_called_truth() -> None:
    table, truth = run(40, sigma=SIGMA)
    reference = type(truth)(truth.stamps, truth.base_from_surface, False)
    text = text_of_page(track_page(evaluate(table, reference)))
    assert "measured reference" in text
    assert "exact truth" not in text


def test_a_long_run_stays_a_small_file(tmp_path: Path) -> None:
    write_report(tmp_path / "report.html", evaluate(*run(20_000, sigma=SIGMA)))
    assert (tmp_path / "report.html").stat().st_size < 2_000_000


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


@given(st.integers(0, 10_000))
def test_another_surface_frame_is_no_error(seed: int) -> None:
    change = se3.exp(np.random.default_rng(seed).normal(size=6) * [1, 1, 1, 50, 50, 50])
    comparison = compare(*run(20, surface_change=change))
    for errors in (comparison.start, comparison.aligned):
        assert errors.translation.max() < 1e-8 and errors.rotation.max() < 1e-8
        assert np.abs(errors.truth_surface_from_estimated_surface - change).max() < 1e-8


def test_a_known_offset_comes_out_as_itself() -> None:
    table, truth = run(60)
    table.base_from_surface[30] = table.base_from_surface[30] @ se3.exp([0, 0.02, 0, 0, 0, 0])
    table.base_from_surface[40, :3, 3] += [3, 0, 4]
    comparison = compare(table, truth)
    errors = dict(zip(comparison.rows, comparison.start.translation, strict=True))
    turns = dict(zip(comparison.rows, comparison.start.rotation, strict=True))
    assert (errors[40], turns[40]) == (pytest.approx(5), pytest.approx(0, abs=1e-9))
    assert (errors[30], turns[30]) == (pytest.approx(0, abs=1e-9), pytest.approx(0.02))
    assert sum(e > 1e-6 for e in errors.values()) == 1


def test_a_wrong_first_pose_is_in_every_error_from_the_start_but_not_aligned() -> None:
    table, truth = run(400)
    table.base_from_surface[1, :3, 3] += [0, 0, 2]
    comparison = compare(table, truth)
    assert comparison is not None and np.allclose(comparison.start.translation[1:], 2, atol=0.2)
    assert comparison.aligned.translation[1:].max() < 0.02


@given(st.integers(0, 10_000))
def test_no_other_constant_fits_better(seed: int) -> None:
    draw = np.random.default_rng(seed)
    table, truth = run(40, sigma=SIGMA, seed=seed)
    estimate, expected = table.base_from_surface, truth.base_from_surface
    best = best_constant(se3.inverse(expected) @ estimate)

    def cost(constant: np.ndarray) -> np.ndarray:
        difference = expected @ constant - estimate
        return np.array([np.sum(difference[:, :3, 3] ** 2), np.sum(difference[:, :3, :3] ** 2)])

    assert (cost(best) <= cost(best @ se3.exp(draw.normal(size=6) * 0.01)) + 1e-9).all()


def test_honest_noise_has_a_nees_of_six_and_is_inside_as_often_as_it_should() -> None:
    table, truth = run(3000, sigma=SIGMA)
    comparison = compare(table, truth)
    assert comparison is not None and comparison.aligned.mean_nees / 6 == pytest.approx(1, abs=0.04)
    assert comparison.aligned.nees_inside == pytest.approx(0.95, abs=0.012)


def test_a_covariance_that_claims_half_the_error_has_four_times_the_nees() -> None:
    table, truth = run(3000, sigma=SIGMA)
    table.covariance[:] /= 4
    comparison = compare(table, truth)
    assert comparison is not None and comparison.aligned.mean_nees / 6 == pytest.approx(4, abs=0.16)


@pytest.mark.parametrize(("share", "honest"), [(1.0, True), (0.1, False), (10.0, False)])
def test_the_report_says_where_covariances_are_not_calibrated(share: float, honest: bool) -> None:
    table, truth = run(3000, sigma=SIGMA)
    table.covariance[:] = share * (table.covariance + table.covariance[1:2])  # the first pose's error is in all
    assert ("Inconsistent" in track_page(evaluate(table, truth, "run"))) is not honest


def test_a_pose_without_covariance_does_not_spoil_the_nees() -> None:
    table, truth = run(300, sigma=SIGMA)
    table.covariance[7] = np.inf
    comparison = compare(table, truth)
    assert comparison is not None and np.isfinite(comparison.aligned.mean_nees)
    assert np.isnan(comparison.aligned.nees).sum() == 1


def test_only_a_pose_that_is_off_while_tracking_is_a_lie() -> None:
    table, truth = run(60, states={20: TrackState.DEGRADED, 21: TrackState.COASTING})
    table.base_from_surface[[20, 21, 22], 0, 3] += 10.001
    table.base_from_surface[23, 0, 3] += 9.999
    comparison = compare(table, truth)
    assert comparison is not None and comparison.off.tolist() == [22]
    assert 21 not in comparison.rows


def test_association_takes_the_nearest_within_half_a_period() -> None:
    truth = np.array([0.0, 1.0, 2.0, 3.0])
    rows, true_rows = associate(np.array([-0.6, -0.4, 0.9, 1.6, 2.4, 3.6]), truth)
    assert rows.tolist() == [1, 2, 3, 4]
    assert true_rows.tolist() == [0, 1, 2, 2]


def test_a_sparse_reference_is_not_stretched_over_a_dense_run() -> None:
    rows, true_rows = associate(np.arange(100) / 100, np.array([0.2, 0.7]))
    assert rows.tolist() == [20, 70]
    assert true_rows.tolist() == [0, 1]


@pytest.mark.parametrize("stamps", [[], [0.5], [0.0, 0.5]])
@pytest.mark.parametrize("truth", [[], [0.5], [0.5, 1.0]])
def test_association_of_next_to_nothing(stamps: list[float], truth: list[float]) -> None:
    rows, true_rows = associate(np.array(stamps), np.array(truth))
    assert [stamps[i] for i in rows] == [truth[i] for i in true_rows] == [s for s in stamps if s in truth]


def test_a_truth_of_another_time_is_no_truth() -> None:
    table, truth = run()
    assert compare(table, Trajectory(truth.stamps + 1000, truth.base_from_surface, True)) is None


def test_figures_of_a_spread() -> None:
    figures = spread(np.array([1.0, 2, 3, 4, 10]))
    assert (figures.median, figures.max, figures.p95) == (3, 10, pytest.approx(8.8))
    assert figures.rmse == pytest.approx(26**0.5)
    assert np.isnan(spread(np.empty(0)).median)


def test_latency_leaves_the_initialisation_out() -> None:
    states = {i: TrackState.INITIALISING for i in range(5)}
    table, _ = run(105, states=states)
    table.seconds[:6] = 5.0
    late = latency(table)
    assert (late.initial_sets, late.initialisation) == (6, pytest.approx(30_000))
    assert late.max.max() < 1000 and np.allclose(late.p50, 1000 * np.median(table.seconds[6:], axis=0))
    assert (late.p50 <= late.p95).all() and (late.p95 <= late.p99).all()
    assert len(late.total) == 99


def test_a_run_that_never_initialised_has_no_latency() -> None:
    table, truth = run(5, states={i: TrackState.INITIALISING for i in range(5)})
    result = evaluate(table, truth, "short")
    assert np.isnan(result.latency.p50).all() and result.latency.initial_sets == 5
    assert result.comparison is None
    assert "0 of 5" in verdict(result)[0]


def test_states_are_counted_from_an_instant_on() -> None:
    table, _ = run(10, states={9: TrackState.LOST})
    assert state_shares(table)["TRACKING"] == pytest.approx(0.8)
    assert state_shares(table, since=table.stamps[5])["LOST"] == pytest.approx(0.2)
    assert sum(state_shares(table).values()) == pytest.approx(1)
    assert state_shares(table, since=99.0) == {}


def test_the_summary_is_plain_json_and_says_the_same_again(tmp_path: Path) -> None:
    result = evaluate(*run(60, sigma=SIGMA), "monday")
    write_summary(tmp_path / "summary.json", as_dict(result))
    loaded = json.loads((tmp_path / "summary.json").read_text(), parse_constant=pytest.fail)
    assert set(loaded.pop("provenance")) >= {"started_utc", "stillbed", "commit", "host", "operator", "inputs_sha256"}
    assert loaded == as_dict(result) and loaded["states_since_s"] is None
    assert loaded["errors"]["start"]["translation_mm"]["max"] > 0
    assert text_of(loaded) == summary_text(result)


def test_a_run_cut_short_says_so_first() -> None:
    table, truth = run()
    assert "incomplete" in verdict(evaluate(table, truth, complete=False))[0]
    assert "incomplete" not in " ".join(verdict(evaluate(table, truth)))


@pytest.mark.parametrize(("share", "text"), [(1.0, "100 %"), (0.965, "96.5 %"), (0.5, "50 %"), (0.0, "0 %")])
def test_percent(share: float, text: str) -> None:
    assert percent(share) == text


def test_percent_keeps_the_decimals_asked_for() -> None:
    assert [percent(0.965, digits) for digits in (0, 2)] == ["96 %", "96.50 %"]


@pytest.mark.parametrize("folder", ["estimation", "perception", "planning", "hardware"])
def test_a_share_is_written_with_a_space_before_the_sign(folder: str) -> None:
    sources = {path: path.read_text(encoding="utf-8") for path in (Path(__file__).parents[1] / folder).rglob("*.py")}
    assert [str(path) for path, text in sources.items() if re.search(r":\.\d%\}", text)] == []


def test_a_chart_keeps_its_words_readable_on_a_phone() -> None:
    chart = Plot(900, 130, (0.0, 1.0), (0.0, 1.0)).svg()
    least = float(re.findall(r"min-width:(\d+)px", chart)[0])
    assert 11 * least / 900 >= 8  # px: the size of its words, where the window is narrower
    style = (files("hardware.report") / "report.css").read_text(encoding="utf-8")
    assert re.search(
        r"^section \{ overflow-x: auto; \}", style, re.MULTILINE
    )  # so that the page itself does not scroll
