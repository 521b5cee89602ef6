"""Recordings after any uptime of the machine: tracked, smoothed, viewed and compared as after a short one.

The stamps of a recorded run are moved, with the floats that gives. A replay repeats bytes, so its runs are made under a
clock that has run for so long.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hardware.cli.main import main
from hardware.files.folder_tables import SessionFolderWriter, read_tum
from hardware.files.images import encode
from hardware.live.recorded_run import replay_run
from hardware.offline.smooth import SmoothOptions, smooth_session
from hardware.offline.track import run_track
from hardware.offline.trajectory_files import read_pose_series
from hardware.offline.viewer import instant_text, open_playback, session_text
from hardware.operator.broadcast import plain
from hardware.recording.session_reader import open_session
from hardware.report.page import Scale, number
from tests.live_runs import Running, closed, light_runs
from tests.printed_sheet import FPS, displacement_errors, pictures, region, rig
from tests.uptime import DAY, MINUTE, moved

SETS = 26
UPTIMES = {"10 s": 10.0, "an hour": 60 * MINUTE + 0.1, "100 days": 100 * DAY + 0.123}
RATES = {"10 s": (1000.0,), "100 days": (200.0, 999.0, 1000.0)}  # Hz
MAX_ERROR = 0.05  # mm
LOST = range(12, 18)  # sets in which the second camera shows nothing
CLOCK_FOLDER = Path(__file__).parent / "uptime_clock"


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A sheet that was tracked while it was recorded, one camera lost for a while."""
    folder = tmp_path_factory.mktemp("uptime")
    with SessionFolderWriter(folder / "session", rig(), region()) as session:
        for k, frames in enumerate(pictures(np.arange(SETS) / FPS)):
            for frame in frames.frames:
                if frame.camera != 1 or k not in LOST:
                    session.picture(frame.camera, frame.stamp, *encode(frame.image, 95))
    run_track(folder / "session", folder / "out", folder / "run.mcap")
    return folder / "run.mcap"


@pytest.fixture(scope="module", params=RATES)
def late(recording: Path, request: pytest.FixtureRequest) -> tuple[Path, str]:
    """The recording after an uptime, and which."""
    file = recording.parent / f"{request.param}.mcap"
    return moved(recording, file, UPTIMES[request.param]), request.param


@pytest.mark.slow
def test_a_late_recording_is_smoothed_at_any_rate_and_compared(
    late: tuple[Path, str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file, first = late[0], UPTIMES[late[1]]
    for rate in RATES[late[1]]:
        smooth_session(file, tmp_path / "out", SmoothOptions(rate, relink=False))
        times = np.loadtxt(tmp_path / "out" / "smoothed.csv", delimiter=",", skiprows=1, usecols=0)
        assert len(times) == np.ceil(round((SETS - 1) / FPS * rate, 6))
        assert abs(times[0] - first) < 1e-6 and np.abs(np.diff(times) - 1 / rate).max() < 2e-6
    smoothed = read_tum(tmp_path / "out" / "smoothed.tum", exact=False)
    off = displacement_errors(smoothed.stamps - first, smoothed.base_from_surface)
    assert len(off) == SETS and off.max() < MAX_ERROR
    assert main(["compare", str(file), str(tmp_path / "out"), "-o", str(tmp_path / "compared")]) == 0
    figures = json.loads((tmp_path / "compared" / "compare.json").read_text())
    assert figures["pairs"] == len(read_pose_series(str(file)).trajectory) >= SETS - 4
    assert figures["one surface frame"]["ape"]["translation_mm"]["rmse"] < MAX_ERROR
    assert "e+0" not in (tmp_path / "compared" / "report.html").read_text()  # as all ticks of an axis once were
    capsys.readouterr()


@pytest.mark.slow
def test_a_late_recording_is_viewed_instant_by_instant(late: tuple[Path, str]) -> None:
    file, first = late[0], UPTIMES[late[1]]
    playback = open_playback(file)
    shown = json.loads(session_text(playback))
    assert np.abs(np.array(shown["stamps"]) - np.arange(SETS) / FPS).max() < 1e-4
    assert abs(shown["first"] - first) < 1e-4
    seen = [json.loads(instant_text(playback, k))["tracking"] for k in range(SETS)]
    assert sum(each is not None and each["tracks"] > 0 for each in seen) >= SETS - 4


@pytest.mark.slow
def test_a_late_recording_is_tracked_as_it_was(recording: Path, tmp_path: Path) -> None:
    first = UPTIMES["100 days"]
    run_track(moved(recording, tmp_path / "late.mcap", first), tmp_path / "out")
    poses = read_tum(tmp_path / "out" / "poses.tum", exact=False)
    off = displacement_errors(poses.stamps - first, poses.base_from_surface)
    assert len(off) >= SETS - 4 and off.max() < MAX_ERROR


@given(st.floats(0, 200 * DAY), st.floats(1e-4, 1.0))
def test_what_the_page_is_told_of_a_stamp_tells_instants_apart(stamp: float, step: float) -> None:
    assert abs(plain(stamp) - stamp) < 1e-5
    assert plain(stamp + step) > plain(stamp)


@given(st.floats(0, 200 * DAY), st.floats(5.0, 3600.0))
def test_ticks_of_a_chart_are_told_apart(first: float, seconds: float) -> None:
    labels = [number(tick) for tick in Scale(first, first + seconds, 0, 100).ticks(9)]
    assert len(set(labels)) == len(labels)


@pytest.mark.slow
@pytest.mark.timeout(1500)
def test_a_hundred_recordings_are_smoothed(recording: Path, tmp_path: Path) -> None:
    draw = np.random.default_rng(3)
    for k, first in enumerate([10.0, *np.exp(draw.uniform(np.log(10.0), np.log(100 * DAY), 98)), 100 * DAY]):
        file = moved(recording, tmp_path / "late.mcap", float(first))
        smooth_session(file, tmp_path / f"{k}", SmoothOptions(float(draw.uniform(100, 1000)), relink=False))
        stamps = read_tum(tmp_path / f"{k}" / "smoothed.tum", exact=False).stamps
        assert len(stamps) == SETS and abs(stamps[0] - first) < 1e-6


@pytest.mark.slow
@pytest.mark.parametrize("uptime", UPTIMES)
def test_a_run_at_any_uptime_stopped_and_resumed_is_replayed_to_the_last_byte(
    uptime: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PYTHONPATH", str(CLOCK_FOLDER))
    monkeypatch.setenv("STILLBED_TEST_UPTIME", repr(UPTIMES[uptime]))
    with light_runs(tmp_path, "--yes", lines=3, speed=20.0) as start:
        record = tmp_path / "run.mcap"
        run: Running = start(record)
        run.wait_for(r"\nprint\n")
        run.kill("tracking")
        assert run.end() != 0
        again: Running = start(record, "--resume")
        assert again.end() == 0, again.said
    first = min(ref.stamp for refs in closed(record).sets for ref in refs)
    assert UPTIMES[uptime] - 1 < first < UPTIMES[uptime] + 120
    for file in (record, tmp_path / "run-2.mcap"):
        ticks = list(replay_run(file))
        assert len(ticks) > 10 and all(tick.frame == tick.recorded for tick in ticks)
        assert not open_session(file).damage
