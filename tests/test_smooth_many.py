"""Many sessions smoothed on a cluster: failures listed, nothing done twice, and a lost worker loses no session."""

from __future__ import annotations

import csv
import os
import shutil
import signal
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from estimation.errors import InputError
from estimation.synthetic.world import synthetic_world
from hardware.cli.main import main
from hardware.offline import smooth as many
from hardware.offline.smooth import (
    ALREADY_DONE,
    FAILED,
    SMOOTHED,
    Cluster,
    SmoothJob,
    SmoothOptions,
    SmoothOutcome,
    local_cluster,
    run_smooth,
    sessions_in,
)
from hardware.recording.recorder import Recorder
from perception.frames import Frame

distributed = pytest.importorskip("distributed")

BLANK = np.full((720, 1280), 90, np.uint8)


def record(path: Path, seed: int) -> None:
    """Half a second of a breathing surface, with its tracks."""
    world = synthetic_world("breathing", seconds=0.5, rate=20.0, count=30, seed=seed)
    with Recorder(path, world.rig) as recorder:
        recorder.truth(world.truth)
        for seen in world:
            for camera in range(3):
                recorder.frame(Frame(camera, seen.stamp, BLANK))
            recorder.write(seen)


@pytest.fixture(scope="module")
def sessions(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three sessions, and a file that is none."""
    folder = tmp_path_factory.mktemp("sessions")
    record(folder / "a.mcap", 0)
    for name in ("b", "c"):
        shutil.copy(folder / "a.mcap", folder / f"{name}.mcap")
    (folder / "broken.mcap").write_bytes(b"no recording")
    (folder / "notes.txt").write_text("nobody's session")
    return folder


@pytest.fixture(scope="module")
def address() -> Iterator[str]:
    """A running scheduler with two workers."""
    with local_cluster(2) as cluster:
        yield cluster.scheduler_address


def spared() -> tuple[bool, bool, bool]:
    """Whether the process it runs in looks at its threads, whether what an array leaves stays with it, and whether it
    may have processes of its own, as tracking has."""
    from multiprocessing import current_process

    import dask

    held = int(os.environ["MALLOC_TRIM_THRESHOLD_"]) == int(os.environ["MALLOC_MMAP_THRESHOLD_"]) > 1e8
    return bool(dask.config.get("distributed.worker.profile.enabled")), held, not current_process().daemon


@pytest.mark.slow
def test_workers_here_spend_their_time_on_the_work(address: str) -> None:
    with distributed.Client(address) as client:
        assert set(client.run(spared).values()) == {(False, True, True)}


def table(out: Path) -> dict[str, dict[str, str]]:
    with (out / "sessions.csv").open(encoding="utf-8") as stream:
        return {Path(row["session"]).name: row for row in csv.DictReader(stream)}


@pytest.mark.slow
def test_failures_are_listed(sessions: Path, address: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["smooth", str(sessions), "-o", str(tmp_path), "--scheduler", address]
    assert main(words) == 1
    assert "broken.mcap: not smoothed: " in capsys.readouterr().out
    rows = table(tmp_path)
    assert [row["state"] for row in rows.values()] == [SMOOTHED, SMOOTHED, FAILED, SMOOTHED]
    assert "broken.mcap" in rows["broken.mcap"]["reason"] and not rows["a.mcap"]["reason"]
    assert int(rows["b.mcap"]["poses"]) == 10 and 0 < float(rows["b.mcap"]["error_mm"]) < 0.1
    assert rows["a.mcap"]["error_mm"] == rows["c.mcap"]["error_mm"]

    before = (tmp_path / "a" / "summary.json").stat().st_mtime_ns
    (sessions / "c.mcap").unlink()
    record(sessions / "c.mcap", 1)
    assert main(words) == 1
    again = table(tmp_path)
    assert [row["state"] for row in again.values()] == [ALREADY_DONE, ALREADY_DONE, FAILED, SMOOTHED]
    assert (tmp_path / "a" / "summary.json").stat().st_mtime_ns == before
    assert again["a.mcap"]["error_mm"] == rows["a.mcap"]["error_mm"] != again["c.mcap"]["error_mm"]


def killed_once(job: SmoothJob, wishes: SmoothOptions) -> SmoothOutcome:
    """Half-way through the first session its worker is killed, as if its machine had gone."""
    mark = job.out.parent / "killed"
    if job.session.name == "a.mcap" and not mark.exists():
        mark.touch()
        job.out.mkdir(exist_ok=True)
        (job.out / "summary.json").write_text('{"conte')
        os.kill(os.getpid(), signal.SIGKILL)
    return many.smooth_job(job, wishes)


def test_a_kill_loses_no_session(sessions: Path, address: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from hardware.offline import smooth as cluster

    monkeypatch.setattr(cluster, "smooth_job", killed_once)
    found = list(run_smooth([sessions], tmp_path, SmoothOptions(), Cluster(address)))
    assert (tmp_path / "killed").exists()
    done = {outcome.job.session.name: outcome.state for outcome in found if not outcome.failed}
    assert done == dict.fromkeys(("a.mcap", "b.mcap", "c.mcap"), SMOOTHED)
    assert (tmp_path / "a" / "smoothed.tum").exists()


def test_what_was_interrupted_is_in_the_table(sessions: Path, tmp_path: Path) -> None:
    some = run_smooth([sessions], tmp_path, SmoothOptions())
    next(some)
    some.close()
    rows = list(table(tmp_path).values())
    assert [row["state"] for row in rows] == [SMOOTHED, "not done", "not done", "not done"]


def test_a_folder_names_its_sessions(sessions: Path, tmp_path: Path) -> None:
    assert [p.name for p in sessions_in(sessions)] == ["a.mcap", "b.mcap", "broken.mcap", "c.mcap"]
    assert sessions_in(sessions / "a.mcap") == [sessions / "a.mcap"]
    with pytest.raises(InputError, match="sessions = 'none'"):
        sessions_in(tmp_path)
    (tmp_path / "a").mkdir()
    (tmp_path / "a" / "rig.toml").write_text("")
    (tmp_path / "a.mcap").touch()
    found = list(run_smooth([tmp_path], tmp_path / "out", SmoothOptions()))
    assert [outcome.job.out.name for outcome in found] == ["a", "a.mcap"]
    assert all(outcome.failed for outcome in found)


def test_a_scheduler_nowhere_is_one_line(sessions: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["smooth", str(sessions), "-o", str(tmp_path), "--scheduler", "nowhere://1"]) == 2
    said = capsys.readouterr().err
    assert "--scheduler" in said and "allowed" in said and said.count("\n") == 1
