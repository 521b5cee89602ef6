"""Many sessions: which they are, one after the other or on a cluster, and the table of what became of each."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TextIO

from estimation.errors import InputError, StillbedError
from hardware.out_folder import prepare_out
from hardware.process.clock import WallClock
from hardware.process.progress import Progress
from hardware.smoothing.run import SUMMARY, Wishes, check_wishes, smooth_session

TABLE = "sessions.csv"
SMOOTHED, ALREADY, FAILED = "smoothed", "done already", "failed"
FIGURES = (  # of a session's summary.json
    "poses",
    "seconds",
    "landmarks",
    "sigma_mm",
    "error_mm",
    "live_error_mm",
    "live_rms_mm",
    "jitter_ms",
    "breathing_per_minute",
    "pulse_per_minute",
)


@dataclass(frozen=True, slots=True)
class Job:
    """A session and the folder of its results."""

    session: Path
    out: Path


@dataclass(frozen=True, slots=True)
class Outcome:
    """What became of a job. state: SMOOTHED, ALREADY or FAILED. text: its summary, or why it failed. spent: s."""

    job: Job
    state: str
    text: str
    spent: float

    @property
    def failed(self) -> bool:
        """Whether there are no results."""
        return self.state == FAILED


@dataclass(frozen=True, slots=True)
class Cluster:
    """Where sessions are smoothed.

    scheduler: "local", or the address of a Dask scheduler. workers: of a local one, None for as many as cores.
    """

    scheduler: str
    workers: int | None = None


def run_smooth(paths: Sequence[Path], out: Path, wishes: Wishes, cluster: Cluster | None = None) -> Iterator[Outcome]:
    """Smooth sessions, and those in folders of sessions; of each what became of it, as they are done.

    A single one is smoothed into `out`, and raises what is wrong with it. Several get a folder of their own there, one
    that fails does not stop the others, and sessions.csv says at the end, or when interrupted, what became of all.
    """
    check_wishes(wishes)
    if cluster is not None and cluster.workers is not None and cluster.workers < 1:
        raise InputError("command line", "--workers", cluster.workers, "1 or more")
    sessions = [session for path in paths for session in sessions_in(path)]
    if sessions == list(paths) and len(sessions) == 1 and cluster is None:
        prepare_out(out, force=True)
        yield _outcome(Job(sessions[0], out), wishes, None)
        return
    jobs = [Job(session, out / name) for session, name in zip(sessions, _names(sessions), strict=True)]
    prepare_out(out, force=True)
    found: list[Outcome] = []
    try:
        with Progress("smooth", "sessions", WallClock().now) as progress:
            for outcome in _done(jobs, wishes, cluster):
                found.append(outcome)
                yield outcome
                progress(len(found), len(jobs))
    finally:
        write_table(out / TABLE, jobs, found)


def sessions_in(path: Path) -> list[Path]:
    """The sessions that a word of the command line names: itself, or what lies in a folder that is no session."""
    if not path.is_dir() or (path / "rig.toml").exists():
        return [path]
    inside = sorted(p for p in path.iterdir() if p.suffix == ".mcap" or (p / "rig.toml").is_file())
    if not inside:
        raise InputError(path, "sessions", "none", "a session, or a folder of session folders and .mcap files")
    return inside


def smooth_job(job: Job, wishes: Wishes) -> Outcome:
    """Smooth one of many, in silence: whatever goes wrong with it is its outcome."""
    try:
        return _outcome(job, wishes, io.StringIO())
    except (StillbedError, OSError) as error:
        return Outcome(job, FAILED, str(error), 0.0)
    except Exception as error:  # it must not take the others with it
        return Outcome(job, FAILED, f"{type(error).__name__}: {error}", 0.0)


def write_table(path: Path, jobs: Iterable[Job], outcomes: Iterable[Outcome]) -> None:
    """sessions.csv: a line for each job, in their order; those of which nothing is known yet are "not done"."""
    known = {outcome.job: outcome for outcome in outcomes}
    with path.open("w", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow(["session", "state", "reason", "folder", "spent_s", *FIGURES])
        for job in jobs:
            outcome = known.get(job, Outcome(job, "not done", "interrupted", 0.0))
            done = outcome.state in (SMOOTHED, ALREADY)
            figures = _summary(job.out) if done else {}
            reason = "" if done else " ".join(outcome.text.split())
            head = [str(job.session), outcome.state, reason, str(job.out), f"{outcome.spent:.1f}"]
            writer.writerow([*head, *("" if figures.get(key) is None else figures[key] for key in FIGURES)])


def _done(jobs: Sequence[Job], wishes: Wishes, cluster: Cluster | None) -> Iterator[Outcome]:
    if cluster is None:
        yield from (smooth_job(job, wishes) for job in jobs)
        return
    from hardware.smoothing.cluster import on_cluster  # the library is loaded only where one is asked for

    yield from on_cluster(jobs, wishes, cluster)


def _outcome(job: Job, wishes: Wishes, stream: TextIO | None) -> Outcome:
    clock = WallClock()
    start = clock.now()
    done, text = smooth_session(job.session, job.out, wishes, stream)
    return Outcome(job, ALREADY if done else SMOOTHED, text, clock.now() - start)


def _names(sessions: Sequence[Path]) -> list[str]:
    """A folder's name for each session: its own, with its suffix where that is needed to tell it from others."""
    full = [path.resolve().name for path in sessions]
    short = [path.resolve().stem if path.is_file() else path.resolve().name for path in sessions]
    names = [s if short.count(s) == 1 else f for s, f in zip(short, full, strict=True)]
    if len(set(names)) < len(names):
        raise InputError("command line", "SESSION", ", ".join(names), "sessions of different names")
    return names


def _summary(folder: Path) -> dict[str, Any]:
    try:
        found = json.loads((folder / SUMMARY).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return found if isinstance(found, dict) else {}
