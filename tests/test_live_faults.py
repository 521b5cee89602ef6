"""Faults that a live run is given on purpose: the print goes on, and the ticks keep their time."""

from __future__ import annotations

import math
import re
import time
from collections.abc import Callable, Iterator
from ctypes import c_double
from multiprocessing.sharedctypes import RawValue
from pathlib import Path

import numpy as np
import pytest

from hardware.files.arm_file import read_arm
from hardware.live.fault_injection import FaultInjector
from hardware.live.ipc import ProcessGroup
from hardware.live.recorded_run import replay_run
from hardware.process.faults import fault_from_text, faults_from_texts
from hardware.simulator.arm.settings import ArmSettings, ReplyMode
from tests.live_runs import CLOCK, Running, light_runs, messages
from tests.recording_samples import events
from tests.test_arm_port import serving

Start = Callable[..., Running]


@pytest.fixture
def start(tmp_path: Path) -> Iterator[Start]:
    with light_runs(tmp_path, "--yes", lines=3, speed=8.0) as starter:
        yield starter


def ticks(record: Path) -> np.ndarray:
    """Stamps and ages of the poses (N, 2), s, of the ticks in which the motion was asked."""
    asked = [tick for tick in messages(record, "/tick") if tick["asked"] and tick["pose_stamp"]]
    rows = [(float(str(tick["stamp"])), float(np.ravel(tick["pose_stamp"])[0])) for tick in asked]
    return np.array([(stamp, stamp - pose) for stamp, pose in rows])


def span(record: Path, seconds: float) -> tuple[float, float]:
    """From when until when, s, the run's one fault went on."""
    begun = next(event.stamp for event in events(record) if "on purpose" in event.text)
    return begun, begun + seconds


def laid_in_order(record: Path) -> bool:
    """Whether what was extruded went along the path to its end, and never back."""
    extruding = {move["stamp"]: move["extrude"] for move in messages(record, "/move")}
    places = [float(str(tick["fraction"])) for tick in messages(record, "/tick") if extruding.get(tick["stamp"])]
    return len(places) > 50 and bool((np.diff(places) >= -1e-9).all()) and places[-1] > 4.5


def stands_still(pid: int, expected: bool) -> bool:
    """Whether a process comes to be stopped, or to run, as is expected of it."""
    for _ in range(500):
        stat = Path(f"/proc/{pid}/stat").read_text(encoding="ascii")
        if (stat.rsplit(")", 1)[1].split()[0] == "T") is expected:
            return True
        CLOCK.wait_until(CLOCK.now() + 0.01)
    return False


def test_what_is_slow_runs_for_its_share_of_every_period_and_freely_afterwards(tmp_path: Path) -> None:
    crew, begun = ProcessGroup(), RawValue(c_double, math.nan)
    slow = fault_from_text("here", "fault", "tracking slow 25% at 1s for 1s")
    try:
        crew.start("tracking", time.sleep, (600.0,))
        pid = crew.members["tracking"].pid
        injector = FaultInjector([slow], crew, tmp_path / "run.mcap", begun)
        assert injector.update(99.0) == []  # nothing has begun
        begun.value = 100.0
        assert injector.update(100.99) == [] and stands_still(pid, False)
        assert injector.update(101.01) == [str(slow)] and stands_still(pid, False)
        for k in range(1, 8):
            assert injector.update(101.01 + 0.05 * k) == [] and stands_still(pid, k % 4 != 0)
        injector.update(102.01)
        assert stands_still(pid, False)
        injector.update(102.1)
        assert stands_still(pid, False)
    finally:
        crew.kill("tracking")


@pytest.mark.slow
def test_a_flooded_page_turns_windows_away_and_the_print_goes_on_in_its_rhythm(start: Start, tmp_path: Path) -> None:
    record = tmp_path / "run.mcap"
    run = start(record, "--page", "--fault=page flood at 0.3s for 1.5s")
    end = run.wait_for("page flood is over: .* not let in")
    found = re.search(r"(\d+) messages sent, (\d+) windows closed for it, (\d+) not let in", run.said[:end])
    sent, _, refused = map(int, found.groups())  # how many are closed for it is up to how busy the machine is
    assert sent > 0 and refused > 0
    assert run.end() == 0 and "the path is printed" in run.said
    assert not re.search("paused|stopped", run.said)  # no wish of the flood was followed, none lost to it
    assert laid_in_order(record)
    rows, (first, last) = ticks(record), span(record, 1.5)
    during = (rows[:, 0] > first) & (rows[:, 0] < last)
    rhythms = [np.median(np.diff(rows[part, 0])) for part in (~during, during)]
    assert rhythms[1] == pytest.approx(rhythms[0], rel=0.2)
    assert all(tick.frame == tick.recorded for tick in replay_run(record))


@pytest.mark.slow
def test_a_slow_tracking_makes_poses_old_and_ticks_no_later(start: Start, tmp_path: Path) -> None:
    record = tmp_path / "run.mcap"
    run = start(record, "--fault=tracking slow 20% at 0.3s for 2s")
    run.wait_for("the path is printed")
    assert run.end() == 0
    rows, (first, last) = ticks(record), span(record, 2.0)
    during = (rows[:, 0] > first + 0.2) & (rows[:, 0] < last)
    calm = rows[rows[:, 0] < first]
    assert np.percentile(rows[during, 1], 90) > np.median(calm[:, 1]) + 0.08  # it stands still for 0.16 s of 0.2
    assert np.median(np.diff(rows[during, 0])) == pytest.approx(np.median(np.diff(calm[:, 0])), rel=0.2)
    assert laid_in_order(record)


@pytest.mark.slow
def test_a_run_whose_stalled_arm_was_called_back_is_replayed_to_the_byte(start: Start, tmp_path: Path) -> None:
    record, link = tmp_path / "run.mcap", tmp_path / "arm"
    texts = [f"arm stall 300ms at {instant}s" for instant in range(4, 90, 2)]  # whenever it comes to print
    stalls = faults_from_texts("here", "fault", texts)
    profile = read_arm(tmp_path / "arm.toml")
    with serving(link, ArmSettings(replies=ReplyMode.STREAM), profile=profile, faults=stalls):
        run = start(record, str(link))
        run.wait_for("the path is printed")
        assert run.end() == 0
    assert [tick for tick in messages(record, "/tick") if tick.get("recalled")]
    replayed = list(replay_run(record))
    assert len(replayed) > 50 and all(tick.frame == tick.recorded for tick in replayed)
