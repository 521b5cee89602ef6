"""The bench of smoothing: what it counts, and one small run."""

from __future__ import annotations

import numpy as np
import pytest

from hardware.bench.command import subject_parser
from hardware.bench.smoothing import Pair, pair_figures, run
from hardware.bench.subjects import SUBJECTS


def test_errors_of_worlds_are_pooled_by_their_squares() -> None:
    ratio, nees = pair_figures("still", [Pair(1e-6, 4e-6, 0.8), Pair(9e-6, 36e-6, 1.6)])
    assert ratio.value == pytest.approx(0.5) and ratio.verdict == "met"
    assert nees.value == pytest.approx(1.2)
    assert pair_figures("still", [Pair(1e-6, 1e-6, 2.0)])[0].verdict == "MISSED"


def test_a_small_run_has_a_value_for_every_figure() -> None:
    subject = SUBJECTS["smoothing"]
    words = "--movements still --seeds 1 --seconds 1 --count 40 --minutes 0.02"
    figures = run(subject_parser("smoothing", subject).parse_args(words.split()))
    assert [f.what for f in figures][:2] == ["still: error by the causal one's", "still: NEES/6"]
    assert len(figures) == 6 and all(np.isfinite(f.value) for f in figures)
