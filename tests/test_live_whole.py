"""`stillbed live` before rendered pictures holds what test_live_run.py shows; rest after a kill, as benched."""

from __future__ import annotations

import base64
import os
import resource
import signal
from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import islice
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hardware.bench.live import MAX_REST_DELAY, MIN_REST, REST_RADIUS, Kills, rest_delay
from hardware.live.prerender import prerender
from hardware.live.recorded_run import replay_run
from hardware.live.tracking_process import MAP_LATE
from hardware.offline.track import tracker
from hardware.process.clock import WallClock
from hardware.recording.mcap_file import ChunkMessages, walk
from hardware.recording.session_reader import open_session, read_poses
from tests.live_runs import PATH, SCENARIO, Running, messages, printed_once, rests, summary

pytestmark = pytest.mark.slow
CLOCK = WallClock()
MAP_DUE_S = 1.0  # a refined map is due 0.3 s after the third key frame, of which there is one each 0.4 s
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


def retracked_alike(record: Path, count: int) -> None:
    """That the first sets of a recording, tracked anew, give the very poses that it holds, before any late map."""
    stored = (m for part in walk(record) if isinstance(part, ChunkMessages) for m in part.messages)
    late = any(MAP_LATE.encode() in m.data for m in stored if m.topic == "/events")  # a machine that is that busy
    session, poses = open_session(record), {pose.stamp: pose for pose in read_poses(record)}
    rois = [replace(roi, stamp=-np.inf) for roi in session.roi]
    with tracker(session.rig, rois) as step:
        for frames in islice(session.frame_sets(), count):
            if late and frames.stamp - min(poses) > MAP_DUE_S:
                break
            pose, recorded = step(frames), poses[frames.stamp]
            step.idle()
            assert (pose.base_from_surface == recorded.base_from_surface).all() and pose.state is recorded.state


def test_stopped_in_the_terminal_it_rests_and_another_run_resumes(start: Start, cache: Path, tmp_path: Path) -> None:
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
    assert run.end() == 128 + signal.SIGTERM and "go on with: stillbed live --resume" in run.said
    found = summary(record)
    stops = found["latency_ms"]["stop decided to on the wire"]
    assert stops["count"] >= 2
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


def test_cameras_that_end_end_the_run_with_the_arm_at_rest(start: Start, cache: Path, tmp_path: Path) -> None:
    record = tmp_path / "run.mcap"
    run = begun(start, cache, record)
    now = run.kill("feed")
    run.wait_for("the cameras have ended")
    assert run.end() == 1 and rests(record, now, 0.6)


def test_a_full_disk_ends_the_run_and_what_was_written_stays(start: Start, cache: Path, tmp_path: Path) -> None:
    record = tmp_path / "run.mcap"
    run = start("--simulated", cache / "small.toml", "--record", record, "--yes")
    run.wait_for(r"\nprint\n")
    full = record.stat().st_size + 2**20  # bytes: what a disk says of more is another word, the way is one
    resource.prlimit(run.pid("recorder"), resource.RLIMIT_FSIZE, (full, full))
    run.wait_for("recording stopped")
    assert run.end() == 1 and len(open_session(record)) > 20 and record.stat().st_size <= full
    assert np.isfinite([ref.stamp for refs in open_session(record).sets for ref in refs]).all()


def test_a_stuck_camera_is_said_and_left_out_and_the_print_goes_on(start: Start, cache: Path, tmp_path: Path) -> None:
    record, stuck = tmp_path / "run.mcap", "camera0 stuck at 1s for 1.5s"
    run = start("--simulated", cache / "small.toml", "--record", record, "--yes", f"--fault={stuck}")
    run.wait_for("the path is printed")
    assert run.end() == 0
    poses = list(read_poses(record))
    same = [[f"cam_{c} shows the same picture again" in pose.reason for c in range(3)] for pose in poses]
    said = [pose.stamp for pose, (first, *others) in zip(poses, same, strict=True) if first and not any(others)]
    assert len(said) > 10 and said[-1] - said[0] == pytest.approx(1.5, abs=0.2)
    assert poses[0].stamp < said[0] - 1.0 and said[-1] + 1.0 < poses[-1].stamp
    assert all(pose.state.measured for pose in poses if said[0] <= pose.stamp <= said[-1])  # two see enough
    printed_once(record)


STEP, END = 0.002, 3.0
STAMPS = np.arange(0.0, END, STEP)


@given(st.floats(1.0, END + 0.5), st.floats(1.0, 60.0))
def test_it_rests_from_when_it_stays_where_it_ended(stop: float, speed: float) -> None:
    axes = np.zeros((len(STAMPS), 6))
    axes[:, 1] = speed * np.minimum(STAMPS, stop)
    seen = min(stop, STAMPS[-1])  # of a motion that goes on, the record holds no more
    found, arrived = rest_delay(STAMPS, axes, 1.0), max(seen - 1.0 - REST_RADIUS / speed, 0.0)
    if found == np.inf:
        assert stop > END - MIN_REST - 2 * STEP
    else:
        assert abs(found - arrived) <= 2 * STEP


def test_an_arm_that_stood_all_the_time_rests_at_once_and_a_turning_tool_moves_no_arm() -> None:
    axes = np.zeros((len(STAMPS), 6))
    axes[:, 5] = STAMPS
    assert rest_delay(STAMPS, axes, 1.0) == 0.0


def test_what_an_arm_that_moved_on_has_left_is_kept(tmp_path: Path) -> None:
    left, kept = tmp_path / "left", tmp_path / "kept"
    left.mkdir()
    kept.mkdir()
    kills = Kills(kept)
    for name, rested in (("a", MAX_REST_DELAY / 2), ("b", MAX_REST_DELAY * 1.1)):
        (left / f"{name}.mcap").write_bytes(b"x")
        kills.rest_delays.append(rested)
        kills.save(left / f"{name}.mcap", "feed", 3.0)
    assert sorted(file.name for file in kept.iterdir()) == ["b.mcap", "kills.csv"]
    assert (kept / "kills.csv").read_text().splitlines()[1:] == ["a.mcap,feed,0.250,3.000", "b.mcap,feed,0.550,3.000"]
