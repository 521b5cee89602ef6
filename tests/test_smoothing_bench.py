"""The bench of smoothing: what it counts, and one small run."""

from __future__ import annotations

import sys

import numpy as np
import pytest

from hardware.bench.bundle_adjustment import MISSING, ceres_figures
from hardware.bench.command import subject_parser
from hardware.bench.smoothing import Pair, pair_figures, run
from hardware.bench.smoothing_many import many_figures
from hardware.bench.subjects import SUBJECTS


def test_errors_of_worlds_are_pooled_by_their_squares() -> None:
    ratio, nees = pair_figures("still", [Pair(1e-6, 4e-6, 0.8), Pair(9e-6, 36e-6, 1.6)])
    assert ratio.value == pytest.approx(0.5) and ratio.verdict == "met"
    assert nees.value == pytest.approx(1.2)
    assert pair_figures("still", [Pair(1e-6, 1e-6, 2.0)])[0].verdict == "MISSED"


def test_a_small_run_has_a_value_for_every_figure() -> None:
    subject = SUBJECTS["smoothing"]
    words = "--movements still --seeds 1 --seconds 1 --count 40 --minutes 0.02 --adjusted 0 --sessions 0"
    figures = run(subject_parser("smoothing", subject).parse_args(words.split()))
    assert [f.what for f in figures][:2] == ["still: error by the causal one's", "still: NEES/6"]
    assert len(figures) == 6 and all(np.isfinite(f.value) for f in figures)


def test_ceres_finds_no_lower_cost() -> None:
    found = ceres_figures(0.5, 30)
    if all(f.note == MISSING for f in found):
        pytest.skip(MISSING)
    cost, time = found
    assert cost.verdict == "met" and cost.value > 0.999
    assert time.value > 0


def test_that_pycolmap_is_missing_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    assert [(f.note, f.verdict) for f in ceres_figures(0.5, 30)] == [(MISSING, "")] * 2


@pytest.mark.slow  # three clusters; tests/test_smooth_many.py has the same of one
def test_two_workers_and_one_that_is_killed_finish_all_sessions() -> None:
    pytest.importorskip("distributed")
    faster, killed = many_figures(3)
    assert faster.value > 0 and faster.unit == ""
    assert killed.value == 3 and killed.verdict == "met"
