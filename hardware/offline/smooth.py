"""`stillbed smooth`: sessions smoothed into folders of results, one after the other or on a cluster, and their table.

What is done already is reported, not done again. On a cluster (owns dask.distributed) each session is one task, of an
existing scheduler or of a local one. Dask queues, sends a lost worker's task to another one, and gives up on a task
that took several workers with it. A task writes only into its session's folder and its summary last, so it can be begun
anew anywhere. All workers must reach sessions and results under the same paths.
"""

from __future__ import annotations

import csv
import hashlib
import io
import json
from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, TextIO

import numpy as np

from estimation.batch.smooth import smooth
from estimation.batch.smoothed import REFINED_PRIOR, CalibrationPrior, Smoothed
from estimation.errors import InputError, StillbedError
from hardware.files.folder_tables import write_tum
from hardware.files.rig_file import write_rig
from hardware.files.session import Session, damage_text
from hardware.offline.smooth_report import SmoothEvaluation, evaluate_smoothed, smooth_page, smooth_verdict
from hardware.offline.smooth_tracks import ReobservedTracks, SessionTracks, reobserve, tracks_of
from hardware.offline.trajectory_files import write_copy, write_instants, write_map
from hardware.process.clock import WallClock
from hardware.process.progress import Progress, prepare_out
from hardware.recording.session_reader import open_session
from hardware.report.evaluation import spread
from hardware.report.summary import finite

SUMMARY_FILE = "summary.json"
USUAL_PASSES = 12  # of a long recording; the estimate of the time left counts with them
HASH_BLOCK_BYTES = 2**20


@dataclass(frozen=True, slots=True)
class SmoothOptions:
    """What is asked for. rate: rows of smoothed.csv a second, Hz, or None for the stamps. refine: the cameras too.
    relink: look for the landmarks in all images.
    """

    rate: float | None = None
    refine: bool = False
    relink: bool = True


def check_options(options: SmoothOptions) -> None:
    """InputError for what cannot be done."""
    if options.rate is not None and not 0 < options.rate <= 1e5:
        raise InputError("command line", "--rate", options.rate, "0 < rate <= 100000 Hz")


def smooth_session(path: Path, out: Path, options: SmoothOptions, stream: TextIO | None = None) -> tuple[bool, str]:
    """Smooth one session into the folder `out`, unless that holds its results already: whether it does, and the summary
    as text. stream: where progress is said, stderr without.
    """
    session = open_session(path)
    recorded = session_hash(path)
    contents = content_hash(recorded, options)
    done = _earlier_summary(out, contents)
    if done is not None:
        return True, f"{path}: done already\n{done}"
    out.mkdir(parents=True, exist_ok=True)
    tracks = tracks_of(session, out, recorded, stream)
    result = _solve(session, tracks, options, stream)
    found = ReobservedTracks(tracks)
    if options.relink:
        motion = content_hash(recorded, SmoothOptions(refine=options.refine))  # the rate changes nothing of it
        found = reobserve(session, tracks, result, out, motion, stream)
    if found.looks:
        result = _solve(session, found.tracks, options, stream)
    evaluation = evaluate_smoothed(result, tracks, session.truth)
    _write(out, session, result, options)
    words = " ".join(filter(None, (damage_text(session.damage), smooth_verdict(result, evaluation)))) + found.text
    text = f"{words}\nreport: {out / 'report.html'}"
    (out / "report.html").write_text(smooth_page(session.path.name, words, result, evaluation), encoding="utf-8")
    summary = {"contents": contents, "text": text, **_figures(result, evaluation, session), **found.figures}
    (out / SUMMARY_FILE).write_text(json.dumps(finite(summary), indent=2) + "\n", encoding="utf-8")
    return False, text


def session_hash(path: Path) -> str:
    """Of a session's every byte."""
    digest = hashlib.sha256()
    files = sorted(p for p in path.rglob("*") if p.is_file()) if path.is_dir() else [path]
    for file in files:
        digest.update(file.name.encode())
        with file.open("rb") as stream:
            while block := stream.read(HASH_BLOCK_BYTES):
                digest.update(block)
    return digest.hexdigest()


def content_hash(recorded: str, options: SmoothOptions) -> str:
    """Of a session, by its hash, and of what is asked for."""
    return hashlib.sha256(json.dumps([recorded, asdict(options)]).encode()).hexdigest()


def _earlier_summary(out: Path, contents: str) -> str | None:
    """The summary's text of an earlier run on the same contents; None without one."""
    try:
        summary = json.loads((out / SUMMARY_FILE).read_text(encoding="utf-8"))
        return str(summary["text"]) if summary["contents"] == contents else None
    except (OSError, ValueError, KeyError, TypeError):
        return None


def _solve(session: Session, tracks: SessionTracks, options: SmoothOptions, stream: TextIO | None) -> Smoothed:
    passes = 0
    with Progress("smooth", "frame sets, passes taken together,", WallClock().now, stream) as progress:

        def say(what: str, done: int, total: int) -> None:
            nonlocal passes
            progress(passes * total + done, max(USUAL_PASSES, passes + 2) * total)
            passes += done == total

        prior = REFINED_PRIOR if options.refine else CalibrationPrior()
        return smooth(session.rig, tracks.observations, start=tracks.start, prior=prior, progress=say)


def _write(out: Path, session: Session, result: Smoothed, options: SmoothOptions) -> None:
    write_tum(out / "smoothed.tum", result.trajectory)
    first, end = result.stamps[[0, -1]]
    instants = result.instants if options.rate is None else result.at(np.arange(first, end, 1 / options.rate))
    write_instants(out / "smoothed.csv", instants)
    write_rig(out / "rig.toml", result.rig, [None] * len(result.rig))
    write_map(out / "map.ply", result, session)
    if session.path.is_file():
        write_copy(session.path, out / "smoothed.mcap", result)


def _figures(result: Smoothed, evaluation: SmoothEvaluation, session: Session) -> dict[str, Any]:
    fitted, names = result.fitted, [camera.name for camera in result.rig.cameras]
    sigma = np.sqrt(np.trace(result.covariance[:, 3:6, 3:6], axis1=1, axis2=2) / 3)
    ours, live = (None if e is None else spread(e.translation).rmse for e in evaluation.errors or (None, None))
    return {
        "session": str(session.path.name),
        "poses": len(result),
        "seconds": float(result.stamps[-1] - result.stamps[0]),
        "landmarks": len(result.map),
        "sigma_mm": float(np.median(sigma)),
        "residual_px": dict(zip(names, np.nanmedian(fitted.rms, axis=0).tolist(), strict=True)),
        "offset_ms": dict(zip(names, (1000 * result.offsets).tolist(), strict=True)),
        "offset_sigma_ms": dict(zip(names, (1000 * result.offset_sigma).tolist(), strict=True)),
        "jitter_ms": 1000 * fitted.jitter,
        "breathing_per_minute": 60 * evaluation.spectrum.breathing,
        "pulse_per_minute": 60 * evaluation.spectrum.pulse,
        "live_rms_mm": evaluation.live_rms,
        "error_mm": ours,
        "live_error_mm": live,
        "passes": fitted.passes,
        "cost": fitted.cost,
        "damage": session.damage,
    }


LOCAL_CLUSTER = "local"
SCHEDULER_TIMEOUT_S = 15  # s for a scheduler to answer
SPAWN_SETTING = "distributed.nanny.pre-spawn-environ"
DASK_SETTINGS = {  # of workers here: Dask's own cost a third of the time of work that makes and drops many arrays
    "distributed.worker.daemon": False,  # a daemon may have no process of its own, and tracking has one
    "distributed.worker.profile.enabled": False,  # a look at all threads each 10 ms
    f"{SPAWN_SETTING}.MALLOC_TRIM_THRESHOLD_": str(
        1 << 28
    ),  # bytes; 64 kB go back to the system and are asked for again
    f"{SPAWN_SETTING}.MALLOC_MMAP_THRESHOLD_": str(1 << 28),  # bytes; else each array of 128 kB is a mapping of its own
    f"{SPAWN_SETTING}.MALLOC_ARENA_MAX": "1",  # the work is done in a thread, whose own arena is given back as eagerly
}
MISSING_LIBRARY = "dask.distributed, by pip install 'stillbed[cluster]'"


def on_cluster(jobs: Sequence[SmoothJob], options: SmoothOptions, cluster: Cluster) -> Iterator[SmoothOutcome]:
    """What became of each job, as they are done; when interrupted, what is not done is called off."""
    with ExitStack() as stack:
        address = cluster.scheduler
        if address == LOCAL_CLUSTER:
            address = stack.enter_context(local_cluster(cluster.workers)).scheduler_address
        distributed = _library(cluster.scheduler)
        try:
            client = stack.enter_context(distributed.Client(address, timeout=SCHEDULER_TIMEOUT_S))
        except (OSError, TimeoutError, ValueError, ImportError) as error:
            allowed = f"{LOCAL_CLUSTER}, or the address of a running scheduler, such as tcp://host:8786 ({error})"
            raise InputError("command line", "--scheduler", cluster.scheduler, allowed) from error
        there = [SmoothJob(_absolute(job.session), _absolute(job.out)) for job in jobs]
        futures = [client.submit(smooth_job, job, options, pure=False) for job in there]
        own = {future.key: job for future, job in zip(futures, jobs, strict=True)}
        for future in distributed.as_completed(futures):
            yield _task_outcome(own[future.key], future)


@contextmanager
def local_cluster(workers: int | None) -> Iterator[Any]:
    """A Dask cluster of this machine's processes; `workers` of them, None for as many as cores.

    A thread each: the work holds Python's lock. Nothing outside this machine can reach it.
    """
    made = _library(LOCAL_CLUSTER).LocalCluster
    import dask  # is there where distributed is

    with (
        dask.config.set(DASK_SETTINGS),  # for as long as it stands: a worker that is started again is told by them too
        made(
            n_workers=workers,
            threads_per_worker=1,
            host="127.0.0.1",
            dashboard_address="127.0.0.1:0",
            silence_logs="CRITICAL",
        ) as cluster,
    ):
        yield cluster


def _library(scheduler: str) -> Any:
    try:
        import distributed
    except ImportError:
        raise InputError("command line", "--scheduler", scheduler, MISSING_LIBRARY) from None
    return distributed


def _absolute(path: Path) -> Path:
    return path.resolve()


def _task_outcome(job: SmoothJob, future: Any) -> SmoothOutcome:
    """The outcome under the paths that were asked for; a task that Dask gave up on failed with Dask's reason."""
    error = future.exception()
    if error is not None:
        return SmoothOutcome(job, FAILED, f"{type(error).__name__}: {error}", 0.0)
    found: SmoothOutcome = future.result()
    return SmoothOutcome(job, found.state, found.text, found.spent)


SESSION_TABLE = "sessions.csv"
SMOOTHED, ALREADY_DONE, FAILED = "smoothed", "done already", "failed"
SUMMARY_FIGURES = (  # of a session's summary.json
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
class SmoothJob:
    """A session and the folder of its results."""

    session: Path
    out: Path


@dataclass(frozen=True, slots=True)
class SmoothOutcome:
    """What became of a job. state: SMOOTHED, ALREADY or FAILED. text: its summary, or why it failed. spent: s."""

    job: SmoothJob
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


def run_smooth(
    paths: Sequence[Path], out: Path, options: SmoothOptions, cluster: Cluster | None = None
) -> Iterator[SmoothOutcome]:
    """Smooth sessions, and those in folders of sessions; of each what became of it, as they are done.

    A single one is smoothed into `out`, and raises what is wrong with it. Several get a folder of their own there, one
    that fails does not stop the others, and sessions.csv says at the end, or when interrupted, what became of all.
    """
    check_options(options)
    if cluster is not None and cluster.workers is not None and cluster.workers < 1:
        raise InputError("command line", "--workers", cluster.workers, "1 or more")
    sessions = [session for path in paths for session in sessions_in(path)]
    if sessions == list(paths) and len(sessions) == 1 and cluster is None:
        prepare_out(out, force=True)
        yield _outcome(SmoothJob(sessions[0], out), options, None)
        return
    jobs = [SmoothJob(session, out / name) for session, name in zip(sessions, _names(sessions), strict=True)]
    prepare_out(out, force=True)
    found: list[SmoothOutcome] = []
    try:
        with Progress("smooth", "sessions", WallClock().now) as progress:
            for outcome in _done(jobs, options, cluster):
                found.append(outcome)
                yield outcome
                progress(len(found), len(jobs))
    finally:
        write_table(out / SESSION_TABLE, jobs, found)


def sessions_in(path: Path) -> list[Path]:
    """The sessions that a word of the command line names: itself, or what lies in a folder that is no session."""
    if not path.is_dir() or (path / "rig.toml").exists():
        return [path]
    inside = sorted(p for p in path.iterdir() if p.suffix == ".mcap" or (p / "rig.toml").is_file())
    if not inside:
        raise InputError(path, "sessions", "none", "a session, or a folder of session folders and .mcap files")
    return inside


def smooth_job(job: SmoothJob, options: SmoothOptions) -> SmoothOutcome:
    """Smooth one of many, in silence: whatever goes wrong with it is its outcome."""
    try:
        return _outcome(job, options, io.StringIO())
    except (StillbedError, OSError) as error:
        return SmoothOutcome(job, FAILED, str(error), 0.0)
    except Exception as error:  # it must not take the others with it
        return SmoothOutcome(job, FAILED, f"{type(error).__name__}: {error}", 0.0)


def write_table(path: Path, jobs: Iterable[SmoothJob], outcomes: Iterable[SmoothOutcome]) -> None:
    """sessions.csv: a line for each job, in their order; those of which nothing is known yet are "not done"."""
    known = {outcome.job: outcome for outcome in outcomes}
    with path.open("w", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow(["session", "state", "reason", "folder", "spent_s", *SUMMARY_FIGURES])
        for job in jobs:
            outcome = known.get(job, SmoothOutcome(job, "not done", "interrupted", 0.0))
            done = outcome.state in (SMOOTHED, ALREADY_DONE)
            figures = _summary(job.out) if done else {}
            reason = "" if done else " ".join(outcome.text.split())
            head = [str(job.session), outcome.state, reason, str(job.out), f"{outcome.spent:.1f}"]
            writer.writerow([*head, *("" if figures.get(key) is None else figures[key] for key in SUMMARY_FIGURES)])


def _done(jobs: Sequence[SmoothJob], options: SmoothOptions, cluster: Cluster | None) -> Iterator[SmoothOutcome]:
    if cluster is None:
        yield from (smooth_job(job, options) for job in jobs)
        return

    yield from on_cluster(jobs, options, cluster)


def _outcome(job: SmoothJob, options: SmoothOptions, stream: TextIO | None) -> SmoothOutcome:
    clock = WallClock()
    start = clock.now()
    done, text = smooth_session(job.session, job.out, options, stream)
    return SmoothOutcome(job, ALREADY_DONE if done else SMOOTHED, text, clock.now() - start)


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
        found = json.loads((folder / SUMMARY_FILE).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return found if isinstance(found, dict) else {}
