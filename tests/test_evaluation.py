"""The laws of judging a run: nothing wrong gives zero, a known wrong gives itself."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from estimation import se3
from estimation.pose import TrackState
from estimation.trajectory import Trajectory
from hardware.report.evaluation import associate, best_constant, compare, evaluate, latency, spread, state_shares
from hardware.report.summary import as_dict, percent, summary_text, text_of, verdict, write_summary
from tests.runs import run

SIGMA = np.array([0.002, 0.002, 0.002, 0.1, 0.1, 0.1])


def test_identical_trajectories_have_no_error() -> None:
    comparison = compare(*run())
    assert comparison is not None
    for errors in (comparison.start, comparison.aligned):
        assert errors.translation.max() < 1e-9
        assert errors.rotation.max() < 1e-9
    assert len(comparison.rows) == 59  # the first row is still INITIALISING


@given(st.integers(0, 10_000))
def test_another_surface_frame_is_no_error(seed: int) -> None:
    change = se3.exp(np.random.default_rng(seed).normal(size=6) * [1, 1, 1, 50, 50, 50])
    comparison = compare(*run(20, surface_change=change))
    assert comparison is not None
    for errors in (comparison.start, comparison.aligned):
        assert errors.translation.max() < 1e-8
        assert errors.rotation.max() < 1e-8
        assert np.abs(errors.truth_surface_from_estimated_surface - change).max() < 1e-8


def test_a_known_offset_comes_out_as_itself() -> None:
    table, truth = run(60)
    table.base_from_surface[30] = table.base_from_surface[30] @ se3.exp([0, 0.02, 0, 0, 0, 0])
    table.base_from_surface[40, :3, 3] += [3, 0, 4]
    comparison = compare(table, truth)
    assert comparison is not None
    errors = dict(zip(comparison.rows, comparison.start.translation, strict=True))
    turns = dict(zip(comparison.rows, comparison.start.rotation, strict=True))
    assert (errors[40], turns[40]) == (pytest.approx(5), pytest.approx(0, abs=1e-9))
    assert (errors[30], turns[30]) == (pytest.approx(0, abs=1e-9), pytest.approx(0.02))
    assert sum(e > 1e-6 for e in errors.values()) == 1


def test_a_wrong_first_pose_is_in_every_error_from_the_start_but_not_aligned() -> None:
    table, truth = run(400)
    table.base_from_surface[1, :3, 3] += [0, 0, 2]
    comparison = compare(table, truth)
    assert comparison is not None
    assert np.allclose(comparison.start.translation[1:], 2, atol=0.2)
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
    assert comparison is not None
    assert comparison.aligned.mean_nees / 6 == pytest.approx(1, abs=0.04)
    assert comparison.aligned.nees_inside == pytest.approx(0.95, abs=0.012)


def test_a_covariance_that_claims_half_the_error_has_four_times_the_nees() -> None:
    table, truth = run(3000, sigma=SIGMA)
    table.covariance[:] /= 4
    comparison = compare(table, truth)
    assert comparison is not None
    assert comparison.aligned.mean_nees / 6 == pytest.approx(4, abs=0.16)


def test_a_pose_without_covariance_does_not_spoil_the_nees() -> None:
    table, truth = run(300, sigma=SIGMA)
    table.covariance[7] = np.inf
    comparison = compare(table, truth)
    assert comparison is not None
    assert np.isfinite(comparison.aligned.mean_nees)
    assert np.isnan(comparison.aligned.nees).sum() == 1


def test_only_a_pose_that_is_off_while_tracking_is_a_lie() -> None:
    table, truth = run(60, states={20: TrackState.DEGRADED, 21: TrackState.COASTING})
    table.base_from_surface[[20, 21, 22], 0, 3] += 10.001
    table.base_from_surface[23, 0, 3] += 9.999
    comparison = compare(table, truth)
    assert comparison is not None
    assert comparison.off.tolist() == [22]
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
    assert late.max.max() < 1000
    assert np.allclose(late.p50, 1000 * np.median(table.seconds[6:], axis=0))
    assert (late.p50 <= late.p95).all()
    assert (late.p95 <= late.p99).all()
    assert len(late.total) == 99


def test_a_run_that_never_initialised_has_no_latency() -> None:
    table, truth = run(5, states={i: TrackState.INITIALISING for i in range(5)})
    result = evaluate(table, truth, "short")
    assert np.isnan(result.latency.p50).all()
    assert result.latency.initial_sets == 5
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
    write_summary(tmp_path / "summary.json", result)
    loaded = json.loads((tmp_path / "summary.json").read_text(), parse_constant=pytest.fail)
    assert loaded == as_dict(result)
    assert loaded["states_since_s"] is None
    assert loaded["errors"]["start"]["translation_mm"]["max"] > 0
    assert text_of(loaded) == summary_text(result)


def test_a_run_cut_short_says_so_first() -> None:
    table, truth = run()
    assert "cut short" in verdict(evaluate(table, truth, complete=False))[0]
    assert "cut short" not in " ".join(verdict(evaluate(table, truth)))


@pytest.mark.parametrize(("share", "text"), [(1.0, "100 %"), (0.965, "96.5 %"), (0.5, "50 %"), (0.0, "0 %")])
def test_percent(share: float, text: str) -> None:
    assert percent(share) == text
