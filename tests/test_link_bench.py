"""The bench of the link: everything goes wrong in its runs, and what must not happen is counted when it does."""

from __future__ import annotations

import numpy as np
import pytest

from hardware.arm.protocol import G1, encode
from hardware.bench.campaigns import link as link_run
from hardware.bench.campaigns.link import Counts, Run, goal_at, windows
from hardware.bench.link import soak_figures
from hardware.cli.main import main
from tests.slowly import slowly
from tests.virtual_arm import HOME


@pytest.fixture
def short(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(link_run, "SECONDS", 40.0)


@pytest.mark.usefixtures("short")
@pytest.mark.parametrize("seed", [0, 1, *slowly(2, 3, 4, 5)])
def test_a_run_in_which_everything_goes_wrong_breaks_nothing(seed: int) -> None:
    counts = Counts()
    Run(seed, counts).run()
    assert (counts.overflows, counts.foreign, counts.forged, counts.refused, counts.restless) == (0, 0, 0, 0, 0)
    assert counts.modelled <= 0.05
    assert counts.frames > 500 and counts.held > 0 and counts.stops and counts.strays
    kind, queued = counts.queued.popitem()
    assert queued <= 0.05 or not kind.startswith("obeying")


@pytest.mark.slow
@pytest.mark.usefixtures("short")
def test_the_same_seed_gives_the_same_run() -> None:
    first, second = Counts(), Counts()
    Run(3, first).run()
    Run(3, second).run()
    assert first == second


def test_a_frame_that_nobody_sent_and_an_answer_that_was_never_given_are_counted() -> None:
    counts = Counts()
    tap = link_run._Tap(counts)
    sent, other = encode(G1(HOME, 5.0)), encode(G1(HOME + 1, 5.0))
    tap.from_host(sent[:20])
    tap.from_host(sent[20:])
    tap.to_arm(sent + other + sent[:3])
    assert counts.foreign == 1
    answer = bytes.fromhex("ce07e908ca046a00cf")
    tap.to_host(b"\x01" + answer, b"\x01" + answer + bytes.fromhex("ce07e908ca046b00cf"))
    assert (counts.forged, counts.strays) == (1, 1)


def test_figures_judge_what_was_counted() -> None:
    good = Counts(seconds=3600.0, frames=10, queued={"obeying, silent": 0.04}, stops=[0.004] * 50)
    assert not [f.what for f in soak_figures(good) if f.verdict == "MISSED"]
    bad = Counts(seconds=3600.0, overflows=1, foreign=1, refused=1, modelled=0.051, restless=1)
    bad.queued["obeying, silent"], bad.stops = 0.06, [0.02]
    assert len([f for f in soak_figures(bad) if f.verdict == "MISSED"]) == 7
    assert next(f for f in soak_figures(Counts()) if f.verdict == "MISSED").unit == "ms"  # no stop was seen


def test_faults_come_in_order_and_the_motion_begins_at_home() -> None:
    found = windows(np.random.default_rng(0), 30.0, 0.6)
    assert len(found) > 5 and found == sorted(found)
    assert all(0.02 <= b - a <= 0.6 for a, b in found)
    assert np.array_equal(goal_at(0.0), HOME)


def test_the_command_prints_its_table(capsys: pytest.CaptureFixture[str], short: None) -> None:
    assert main(["bench", "link", "--hours", "0.001", "--commands", "300"]) == 0
    text = capsys.readouterr().out
    assert "commands that found the queue full" in text and "that break a limit and passed" in text
