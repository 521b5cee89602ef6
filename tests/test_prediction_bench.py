"""The benches of forecasts, smoothing and the link: known answers, small runs, what must not happen counted."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

from estimation import se3
from estimation.errors import InputError
from estimation.pose import Trajectory
from estimation.synthetic.world import arc_rig
from hardware.arm.driver import G1
from hardware.arm.protocol import encode
from hardware.bench.prediction import (
    POINTS_AROUND,
    PREDICTION_HORIZONS,
    SIMULATED,
    Chest,
    errors_of,
    prediction_figures,
    recorded,
    simulated,
)
from hardware.cli.main import subject_parser
from hardware.files.folder_tables import write_tum
from hardware.offline.smooth_tracks import ReobservedTracks, SessionTracks
from hardware.process.progress import cached
from perception import shipped_file
from tests.campaigns import link as link_run
from tests.campaigns.__main__ import CAMPAIGNS
from tests.campaigns.__main__ import main as campaigns
from tests.campaigns.link import LinkCounts, LinkRun, goal_at, soak_figures, windows
from tests.campaigns.smoothing import (
    PYCOLMAP_MISSING,
    MovementErrors,
    RenderedErrors,
    ceres_figures,
    cluster_figures,
    pair_figures,
    rendered_figure,
    rendered_figures,
    run_smoothing,
    smooth_rendered,
)
from tests.rendered_sets import write_session
from tests.slow_cases import slowly
from tests.virtual_arm import HOME

SECONDS, WARM = 14.0, 8.0


def gliding(speed: float) -> Chest:
    stamps = np.arange(0, SECONDS, 0.1)
    coordinates = np.zeros((len(stamps), 6))
    coordinates[:, 4] = speed * stamps
    return Chest("gliding", Trajectory(stamps, se3.exp(coordinates), True), POINTS_AROUND)


def test_hold_is_off_by_the_way_and_constant_velocity_by_nothing_on_a_steady_glide() -> None:
    errors = errors_of(gliding(5.0), WARM)
    assert errors.hold == pytest.approx(5.0 * np.array(PREDICTION_HORIZONS), rel=1e-9)
    assert np.abs(errors.steady).max() < 1e-9 and (errors.ours < 0.02 * errors.hold).all()


def test_breathing_of_the_simulator_is_foretold_better_than_it_is_held() -> None:
    errors = errors_of(simulated("breathing_deep", SECONDS), WARM)
    assert (errors.ours[1:] < 0.8 * errors.hold[1:]).all()
    rows = {figure.what: figure for figure in prediction_figures([errors], SIMULATED)}
    assert rows["200 ms: error by hold's"].target is None
    assert rows["200 ms: error by hold's"].value == pytest.approx(errors.ours[1] / errors.hold[1])


def test_a_recording_too_short_to_be_judged_is_refused(tmp_path: Path) -> None:
    chest = gliding(1.0)
    write_tum(tmp_path / "short.tum", chest.observed)
    assert len(recorded(tmp_path / "short.tum", WARM).observed) == len(chest.observed)
    with pytest.raises(InputError, match=r"short\.tum: duration"):
        recorded(tmp_path / "short.tum", 60.0)


def test_errors_of_worlds_are_pooled_by_their_squares() -> None:
    pairs = [MovementErrors(1e-6, 4e-6, 0.8, 0.7), MovementErrors(9e-6, 36e-6, 1.6, 0.9)]
    ratio, nees, twist = pair_figures("still", pairs)
    assert ratio.value == pytest.approx(0.5) and ratio.verdict == "met"
    assert nees.value == pytest.approx(1.2) and twist.value == pytest.approx(0.8)
    assert pair_figures("still", [MovementErrors(1e-6, 1e-6, 2.0, 1.0)])[0].verdict == "MISSED"


def test_a_small_run_has_a_value_for_every_figure() -> None:
    subject = CAMPAIGNS["smoothing"]
    words = "--movements still --seeds 1 --seconds 1 --count 40 --minutes 0.02 --adjusted 0 --sessions 0"
    words += " --scenarios --landmarks"
    figures = run_smoothing(subject_parser("smoothing", subject).parse_args(words.split()))
    assert [f.what for f in figures][:2] == ["still: error by the causal one's", "still: NEES/6"]
    assert len(figures) == 7 and all(np.isfinite(f.value) for f in figures)


def test_pictures_are_judged_with_and_without_what_was_found_besides() -> None:
    found = ReobservedTracks(SessionTracks((), ()), looks=7, early=3)
    figure = rendered_figure("still", RenderedErrors(0.004, 0.003, 0.002, found))
    assert figure.value == pytest.approx(0.5) and figure.verdict == "met"
    assert "2.0 against 4.0 um" in figure.note and "3.0 um without 7 looks found besides, 3 of them" in figure.note
    assert rendered_figure("still", RenderedErrors(0.004, 0.003, 0.003, found)).verdict == "MISSED"
    assert rendered_figures([], 1.0) == []


def test_a_shorter_scenario_is_rendered_apart(tmp_path: Path) -> None:
    file = shipped_file("scenarios", "still.toml")
    folders = {cached(file, tmp_path, seconds).folder for seconds in (None, 4.0, 6.0)}
    assert len(folders) == 3


@pytest.mark.slow  # tests/test_smooth_command.py has the same by the command
def test_a_session_of_pictures_is_tracked_smoothed_and_judged(tmp_path: Path) -> None:
    cameras = arc_rig(size=(320, 240), focal=280.0)
    write_session(tmp_path / "breathing", seconds=1.0, rate=10.0, seed=2, cameras=cameras)
    found = smooth_rendered(tmp_path / "breathing")
    assert found.reobserved.looks > 0
    assert 0 < found.smoothed < 0.1 and 0 < found.tracked < 0.1 and 0 < found.causal < 0.1


def test_ceres_finds_no_lower_cost() -> None:
    found = ceres_figures(0.5, 30)
    if all(f.note == PYCOLMAP_MISSING for f in found):
        pytest.skip(PYCOLMAP_MISSING)
    cost, time = found
    assert cost.verdict == "met" and cost.value > 0.999
    assert time.value > 0


def test_that_pycolmap_is_missing_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    assert [(f.note, f.verdict) for f in ceres_figures(0.5, 30)] == [(PYCOLMAP_MISSING, "")] * 2


@pytest.mark.slow  # three clusters; tests/test_smooth_many.py has the same of one
def test_two_workers_and_one_that_is_killed_finish_all_sessions() -> None:
    pytest.importorskip("distributed")
    faster, killed = cluster_figures(3)
    assert faster.value > 0 and faster.unit == ""
    assert killed.value == 3 and killed.verdict == "met"


@pytest.fixture
def short(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(link_run, "RUN_SECONDS", 40.0)


@pytest.mark.slow
@pytest.mark.usefixtures("short")
@pytest.mark.parametrize("seed", [0, *slowly(1, 2, 3, 4, 5)])
def test_a_run_in_which_everything_goes_wrong_breaks_nothing(seed: int) -> None:
    counts = LinkCounts()
    LinkRun(seed, counts).run()
    assert (counts.overflows, counts.foreign, counts.forged, counts.refused, counts.restless) == (0, 0, 0, 0, 0)
    assert counts.modelled <= 0.05
    assert counts.frames > 500 and counts.held > 0 and counts.stops and counts.strays
    kind, queued = counts.queued.popitem()
    assert queued <= 0.05 or not kind.startswith("obeying")


@pytest.mark.slow
@pytest.mark.usefixtures("short")
def test_the_same_seed_gives_the_same_run() -> None:
    first, second = LinkCounts(), LinkCounts()
    LinkRun(3, first).run()
    LinkRun(3, second).run()
    assert first == second


def test_a_frame_that_nobody_sent_and_an_answer_that_was_never_given_are_counted() -> None:
    counts = LinkCounts()
    tap = link_run._PortLogger(counts)
    sent, other = encode(G1(HOME, 5.0)), encode(G1(HOME + 1, 5.0))
    tap.from_host(sent[:20])
    tap.from_host(sent[20:])
    tap.to_arm(sent + other + sent[:3])
    assert counts.foreign == 1
    answer = bytes.fromhex("ce07e908ca046a00cf")
    tap.to_host(b"\x01" + answer, b"\x01" + answer + bytes.fromhex("ce07e908ca046b00cf"))
    assert (counts.forged, counts.strays) == (1, 1)


def test_figures_judge_what_was_counted() -> None:
    good = LinkCounts(seconds=3600.0, frames=10, queued={"obeying, silent": 0.04}, stops=[0.004] * 50)
    assert not [f.what for f in soak_figures(good) if f.verdict == "MISSED"]
    bad = LinkCounts(seconds=3600.0, overflows=1, foreign=1, refused=1, modelled=0.051, restless=1)
    bad.queued["obeying, silent"], bad.stops = 0.06, [0.02]
    assert len([f for f in soak_figures(bad) if f.verdict == "MISSED"]) == 7
    assert next(f for f in soak_figures(LinkCounts()) if f.verdict == "MISSED").unit == "ms"  # no stop was seen


def test_faults_come_in_order_and_the_motion_begins_at_home() -> None:
    found = windows(np.random.default_rng(0), 30.0, 0.6)
    assert len(found) > 5 and found == sorted(found)
    assert all(0.02 <= b - a <= 0.6 for a, b in found)
    assert np.array_equal(goal_at(0.0), HOME)


def test_the_command_prints_its_table(capsys: pytest.CaptureFixture[str], short: None) -> None:
    assert campaigns(["link", "--hours", "0.001"]) == campaigns(["guard", "--commands", "300"]) == 0
    text = capsys.readouterr().out
    assert "commands that found the queue full" in text and "that break a limit and passed" in text
