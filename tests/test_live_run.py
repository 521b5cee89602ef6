"""`stillbed live` as a whole: it prints, is stopped by whatever may stop it, loses nothing, and goes on."""

from __future__ import annotations

import base64
import json
import os
import resource
import signal
from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import islice, pairwise
from pathlib import Path

import numpy as np
import pytest

from hardware.bookmark_file import read_start
from hardware.clock import WallClock
from hardware.live.beside import Beside
from hardware.live.prerender import prerender
from hardware.live.remembered import recorded_poses
from hardware.live.replayed import replay_run
from hardware.path_file import read_path
from hardware.session import open_session
from hardware.tracker import tracker
from tests.live_runs import PATH, SCENARIO, Running, closed, messages, rests

CLOCK = WallClock()
Start = Callable[..., Running]


@pytest.fixture(scope="module")
def cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A scenario, rendered into a cache of its own."""
    folder = tmp_path_factory.mktemp("live")
    (folder / "small.toml").write_text(SCENARIO)
    (folder / "path.csv").write_text(PATH)
    prerender(folder / "small.toml", folder / "stillbed", threads=1)
    return folder


@pytest.fixture
def start(cache: Path) -> Iterator[Start]:
    """Starts runs, and leaves none behind."""
    running: list[Running] = []

    def started(*arguments: object, limits: Callable[[], None] | None = None) -> Running:
        running.append(Running(*map(str, arguments), "--no-page", cache=cache, limits=limits))
        return running[-1]

    yield started
    for run in running:
        run.close()


def begun(start: Start, cache: Path, record: Path, **more: Callable[[], None]) -> Running:
    """A run that prints."""
    run = start("--simulated", cache / "small.toml", "--record", record, "--yes", **more)
    run.wait_for(r"\nprint\n")
    CLOCK.wait_until(CLOCK.now() + 1.5)
    return run


def summary(record: Path) -> dict[str, object]:
    found: dict[str, object] = json.loads(Beside(record).summary.read_text())
    return found


def printed_once(*records: Path) -> None:
    """That no stretch of the path was extruded in two of the runs, and that hardly any was left out between them."""
    spans = []
    for record in records:
        extruding = {m["stamp"]: m["extrude"] for m in messages(record, "/move")}
        places = [float(str(m["fraction"])) for m in messages(record, "/tick") if extruding.get(m["stamp"])]
        assert places
        spans.append((min(places), max(places)))
    for before, after in pairwise(spans):
        assert after[0] >= before[1] - 1e-9
        assert after[0] - before[1] <= 1.0 + 1e-9


def retracked_alike(record: Path, count: int) -> None:
    """That the first sets of a recording, tracked anew, give the very poses that it holds."""
    session, poses = open_session(record), {pose.stamp: pose for pose in recorded_poses(record)}
    rois = [replace(roi, stamp=-np.inf) for roi in session.roi]
    with tracker(session.rig, rois) as step:
        for frames in islice(session.frame_sets(), count):
            pose, recorded = step(frames), poses[frames.stamp]
            step.idle()
            assert (pose.base_from_surface == recorded.base_from_surface).all() and pose.state is recorded.state


def test_stopped_in_the_terminal_it_rests_goes_on_and_a_signal_ends_it_for_another_run_to_resume(
    start: Start, cache: Path, tmp_path: Path
) -> None:
    record = tmp_path / "run.mcap"
    run = start("--simulated", cache / "small.toml", "--record", record)
    at = run.wait_for(r"confirm")
    run.press("y")
    at = run.wait_for(r"ready", at)
    run.press("s")
    at = run.wait_for(r"\nprint\n", at)
    CLOCK.wait_until(CLOCK.now() + 1.0)
    run.press(" ")
    at = run.wait_for(r"stopped: by the operator", at)
    CLOCK.wait_until(CLOCK.now() + 1.0)
    run.press("r")
    at = run.wait_for(r"\nprint\n", at)
    run.press("p")
    at = run.wait_for(r"paused", at)
    run.press("h")
    at = run.wait_for(r"stopped: at home", at)
    run.press("r")
    at = run.wait_for(r"\nprint\n", at)
    CLOCK.wait_until(CLOCK.now() + 1.0)
    os.kill(run.process.pid, signal.SIGTERM)
    assert run.end() == 128 + signal.SIGTERM
    assert "go on with: stillbed live --resume" in run.said
    found = summary(record)
    stops = found["latency_ms"]["stop decided to on the wire"]  # type: ignore[index,call-overload]
    assert stops["count"] >= 2 and stops["max"] <= 20.0
    resumed = start("--resume", record, "--yes")
    resumed.wait_for(r"\nprint\n")
    resumed.wait_for(r"the path is printed")
    assert resumed.end() == 0
    printed_once(record, tmp_path / "run-2.mcap")
    for file in (record, tmp_path / "run-2.mcap"):  # with a stop, a pause and a way home in the first
        ticks = list(replay_run(file))
        assert len(ticks) > 100 and all(tick.frame == tick.recorded for tick in ticks)
        wire = b"".join(base64.b64decode(str(m["data"])) for m in messages(file, "/arm/sent"))
        moves = [tick.frame for tick in ticks if tick.frame[1:2] == b"1"]
        assert np.mean([move in wire for move in moves]) > 0.95
    retracked_alike(record, 20)


@pytest.mark.parametrize("name", ["motion", "tracking", "recorder"])
def test_a_process_that_is_killed_is_noticed_the_arm_rests_and_the_place_is_kept(
    name: str, start: Start, cache: Path, tmp_path: Path
) -> None:
    record = tmp_path / "run.mcap"
    run = begun(start, cache, record)
    killed = run.kill(name)
    run.wait_for(f"the {name} process was killed by SIGKILL")
    assert CLOCK.now() - killed < 1.0
    assert run.end() == 1
    assert rests(record, killed, 0.5)
    session = open_session(record)
    assert killed - session.sets[-1][0].stamp < (1.0 if name == "recorder" else 0.3)
    path = read_path(next((cache / "stillbed").glob("small-*")) / "path.csv")
    ticks = messages(record, "/tick")
    kept = read_start(Beside(record).progress, path)
    assert kept >= float(str(ticks[-1]["fraction"])) - 1e-9
    if name != "recorder":
        assert kept - float(str(ticks[-1]["fraction"])) < 1.0


def test_the_conducting_process_killed_leaves_an_arm_at_rest_and_a_whole_recording(
    start: Start, cache: Path, tmp_path: Path
) -> None:
    record = tmp_path / "run.mcap"
    run = begun(start, cache, record)
    killed = CLOCK.now()
    run.process.kill()
    assert rests(record, killed, 0.5)
    session = closed(record)
    assert killed - session.sets[-1][0].stamp < 0.5
    ticks = messages(record, "/tick")
    path = read_path(next((cache / "stillbed").glob("small-*")) / "path.csv")
    assert read_start(Beside(record).progress, path) == pytest.approx(float(str(ticks[-1]["fraction"])), abs=0.2)


def test_a_closed_terminal_ends_the_run_in_order(start: Start, cache: Path, tmp_path: Path) -> None:
    record = tmp_path / "run.mcap"
    run = begun(start, cache, record)
    now = CLOCK.now()
    os.kill(run.process.pid, signal.SIGHUP)  # what the kernel sends when a terminal goes
    os.close(run.keys)
    run.keys = -1
    assert run.end() == 128 + signal.SIGHUP
    assert rests(record, now, 0.5) and not open_session(record).damage


def test_a_page_that_is_killed_leaves_the_arm_waiting_for_the_operator(cache: Path, tmp_path: Path) -> None:
    run = Running("--simulated", str(cache / "small.toml"), "--record", str(tmp_path / "run.mcap"), cache=cache)
    try:
        at = run.wait_for("confirm")
        run.press("y")
        at = run.wait_for("ready", at)
        run.press("s")
        at = run.wait_for(r"\nprint\n", at)
        CLOCK.wait_until(CLOCK.now() + 1.0)
        os.kill(run.page(), signal.SIGKILL)
        at = run.wait_for("paused: the operator's page was lost", at)
        run.press("r")
        run.wait_for(r"\nprint\n", at)
        run.press("q")
        assert run.end() == 1
    finally:
        run.close()


def test_an_arm_that_is_unplugged_ends_the_run_and_says_so(start: Start, cache: Path, tmp_path: Path) -> None:
    record = tmp_path / "run.mcap"
    run = begun(start, cache, record)
    run.kill("arm", signal.SIGTERM)
    run.wait_for("the arm is unplugged")
    assert run.end() == 1 and not open_session(record).damage


def test_cameras_that_end_end_the_run_with_the_arm_at_rest(start: Start, cache: Path, tmp_path: Path) -> None:
    record = tmp_path / "run.mcap"
    run = begun(start, cache, record)
    now = run.kill("feed")
    run.wait_for("the cameras have ended")
    assert run.end() == 1
    assert rests(record, now, 0.6)


def test_a_full_disk_ends_the_run_and_what_was_written_stays(start: Start, cache: Path, tmp_path: Path) -> None:
    record = tmp_path / "run.mcap"
    most = 6_000_000  # bytes of any file: what a disk says of them is another word, but comes by the same way
    run = start(
        *("--simulated", cache / "small.toml", "--record", record, "--yes"),
        limits=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (most, most)),
    )
    run.wait_for("recording stopped")
    assert run.end() == 1
    assert len(open_session(record)) > 20
    assert np.isfinite([ref.stamp for refs in open_session(record).sets for ref in refs]).all()
