"""The bench of smoothing: what it counts, and one small run."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

from estimation.synthetic.arc_rig import arc_rig
from hardware.bench.bundle_adjustment import MISSING, ceres_figures
from hardware.bench.command import subject_parser
from hardware.bench.smoothing import Pair, pair_figures, run
from hardware.bench.smoothing_many import many_figures
from hardware.bench.smoothing_rendered import Judgement, judged, judged_figure, rendered_figures
from hardware.bench.subjects import SUBJECTS
from hardware.live.prerender import cached
from hardware.offline.smooth_tracks import Relinked
from hardware.smoothing.tracks import Tracks
from perception.package_data import shipped_file
from tests.synthetic import write_session


def test_errors_of_worlds_are_pooled_by_their_squares() -> None:
    ratio, nees = pair_figures("still", [Pair(1e-6, 4e-6, 0.8), Pair(9e-6, 36e-6, 1.6)])
    assert ratio.value == pytest.approx(0.5) and ratio.verdict == "met"
    assert nees.value == pytest.approx(1.2)
    assert pair_figures("still", [Pair(1e-6, 1e-6, 2.0)])[0].verdict == "MISSED"


def test_a_small_run_has_a_value_for_every_figure() -> None:
    subject = SUBJECTS["smoothing"]
    words = "--movements still --seeds 1 --seconds 1 --count 40 --minutes 0.02 --adjusted 0 --sessions 0"
    words += " --scenarios --landmarks"
    figures = run(subject_parser("smoothing", subject).parse_args(words.split()))
    assert [f.what for f in figures][:2] == ["still: error by the causal one's", "still: NEES/6"]
    assert len(figures) == 6 and all(np.isfinite(f.value) for f in figures)


def test_pictures_are_judged_with_and_without_what_was_found_besides() -> None:
    found = Relinked(Tracks((), ()), looks=7, early=3)
    figure = judged_figure("still", Judgement(0.004, 0.003, 0.002, found))
    assert figure.value == pytest.approx(0.5) and figure.verdict == "met"
    assert "2.0 against 4.0 um" in figure.note and "3.0 um without 7 looks found besides, 3 of them" in figure.note
    assert judged_figure("still", Judgement(0.004, 0.003, 0.003, found)).verdict == "MISSED"
    assert rendered_figures([], 1.0) == []


def test_a_shorter_scenario_is_rendered_apart(tmp_path: Path) -> None:
    file = shipped_file("scenarios", "still.toml")
    folders = {cached(file, tmp_path, seconds).folder for seconds in (None, 4.0, 6.0)}
    assert len(folders) == 3


@pytest.mark.slow  # tests/test_smooth_command.py has the same by the command
def test_a_session_of_pictures_is_tracked_smoothed_and_judged(tmp_path: Path) -> None:
    cameras = arc_rig(size=(320, 240), focal=280.0)
    write_session(tmp_path / "breathing", seconds=1.0, rate=10.0, seed=2, cameras=cameras)
    found = judged(tmp_path / "breathing")
    assert found.found.looks > 0
    assert 0 < found.smoothed < 0.1 and 0 < found.tracked < 0.1 and 0 < found.causal < 0.1


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
