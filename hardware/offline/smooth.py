"""`stillbed smooth`: sessions smoothed into folders of results, one after the other or on a cluster, and their table.

A session whose results are there already is reported and not smoothed again. On a cluster (owns dask.distributed) each
session is one task of an existing scheduler or of a local one. Dask queues the tasks, sends a lost worker's task to
another worker, and gives up on a task that has killed several. A task writes only into its session's folder, its
summary last, so any worker can start it again. All workers must reach sessions and results under the same paths.
"""

from __future__ import annotations

import hashlib
import io
import json
from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, TextIO

import numpy as np

from estimation.batch.smooth import smooth
from estimation.batch.smoothed import REFINED_PRIOR, CalibrationPrior, Smoothed
from estimation.errors import InputError, StillbedError
from estimation.se3 import Array
from hardware.files.folder_tables import csv_table, write_tum
from hardware.files.rig_file import write_rig
from hardware.files.session import Session, damage_text
from hardware.offline.smooth_report import SmoothEvaluation, evaluate_smoothed, smooth_page, smooth_verdict
from hardware.offline.smooth_tracks import ReobservedTracks, SessionTracks, reobserve, tracks_of
from hardware.offline.trajectory_files import write_copy, write_instants, write_map
from hardware.process.clock import WallClock
from hardware.process.progress import Progress, check_apart, prepare_out
from hardware.process.system import file_hash
from hardware.recording.session_reader import open_session
from hardware.report.evaluation import write_summary

SUMMARY_FILE = "summary.json"
LAST_PASS = "covariances"  # how many there are before it, nobody knows: each tells how far it is itself


@dataclass(frozen=True, slots=True)
class SmoothOptions:
    """How sessions are smoothed."""

    rate: float | None = None  # Hz, rows of smoothed.csv a second; None: one for each stamp
    refine: bool = False  # the cameras' poses and lenses as well
    relink: bool = True  # search all images for the landmarks


def smooth_session(path: Path, out: Path, options: SmoothOptions, stream: TextIO | None = None) -> tuple[bool, str]:
    """Smooth one session into the folder `out`; returns whether its results were there already, and the summary's text.

    stream: for progress, by default stderr. InputError where `out` is the session, or holds another command's report.
    """
    check_apart("--out", out, path)
    session = open_session(path)
    recorded = file_hash(path)
    contents = content_hash(recorded, options)
    summary, report = _summary(out), out / "report.html"
    if report.is_file() and "text" in summary and summary.get("contents") == contents:
        return True, f"{path}: done already\n{summary['text']}"
    if (summary and "contents" not in summary) or (out / "compare.json").exists():
        raise InputError(out, "--out", "with another command's report", "a new folder, or one of stillbed smooth")
    out.mkdir(parents=True, exist_ok=True)
    tracks = tracks_of(session, out, recorded, stream)
    result = _solve(session, tracks, options, stream)
    reobserved = ReobservedTracks(tracks)
    if options.relink:
        source = content_hash(recorded, SmoothOptions(refine=options.refine))  # whatever the rate of smoothed.csv
        reobserved = reobserve(session, tracks, result, out, source, stream)
    if reobserved.looks:
        result = _solve(session, reobserved.tracks, options, stream)
    evaluation = evaluate_smoothed(result, tracks, session.truth)
    for stale in (report, out / SUMMARY_FILE):  # of other options or pictures: from here on neither tells of the files
        stale.unlink(missing_ok=True)
    _write(out, session, result, options)
    words = " ".join(filter(None, (damage_text(session.damage), smooth_verdict(result, evaluation)))) + reobserved.text
    text = f"{words}\nreport: {report}"
    report.write_text(smooth_page(session.path.name, words, result, evaluation), encoding="utf-8")
    summary = {"contents": contents, "text": text, **_figures(result, evaluation, session), **reobserved.figures}
    write_summary(out / SUMMARY_FILE, summary)
    return False, text


def content_hash(recorded: str, options: SmoothOptions) -> str:
    """Hash of a session, given its own hash, and of the options."""
    return hashlib.sha256(json.dumps([recorded, asdict(options)]).encode()).hexdigest()


def _summary(folder: Path) -> dict[str, Any]:
    """The summary of an earlier run, empty where there is none."""
    try:
        summary = json.loads((folder / SUMMARY_FILE).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return summary if isinstance(summary, dict) else {}


def _solve(session: Session, tracks: SessionTracks, options: SmoothOptions, stream: TextIO | None) -> Smoothed:
    passes = 0
    with Progress("smooth", "frame sets", WallClock().now, stream) as progress:

        def report(what: str, done: int, total: int) -> None:
            nonlocal passes
            progress.note = f"pass {passes + 1}: {what}"
            if done < total or what == LAST_PASS:
                progress(done, total)
            if done == total:
                passes += 1
                progress.restart()

        prior = REFINED_PRIOR if options.refine else CalibrationPrior()
        return smooth(session.rig, tracks.observations, start=tracks.start, prior=prior, progress=report)


def _write(out: Path, session: Session, result: Smoothed, options: SmoothOptions) -> None:
    write_tum(out / "smoothed.tum", result.trajectory)
    instants = result.states_at_stamps if options.rate is None else result.at(result.sample_times(options.rate))
    write_instants(out / "smoothed.csv", instants)
    write_rig(out / "rig.toml", result.rig, [None] * len(result.rig))
    write_map(out / "map.ply", result, session)
    if session.path.is_file():
        write_copy(session.path, out / "smoothed.mcap", result)
    else:
        (out / "smoothed.mcap").unlink(missing_ok=True)  # of another session: who reads the folder takes it first


def _figures(result: Smoothed, evaluation: SmoothEvaluation, session: Session) -> dict[str, Any]:
    fitted, names = result.statistics, [camera.name for camera in result.rig.cameras]
    ours, live = evaluation.rmse
    return {
        "session": str(session.path.name),
        "poses": len(result),
        "seconds": float(result.stamps[-1] - result.stamps[0]),
        "landmarks": len(result.map),
        "sigma_mm": evaluation.sigma,
        "residual_px": {name: _median(rms[np.isfinite(rms)]) for name, rms in zip(names, fitted.rms.T, strict=True)},
        "offset_ms": dict(zip(names, (1000 * result.offsets).tolist(), strict=True)),
        "offset_sigma_ms": dict(zip(names, (1000 * result.offset_sigma).tolist(), strict=True)),
        "jitter_ms": 1000 * fitted.delay_sigma,
        "breathing_per_minute": 60 * evaluation.spectrum.breathing.rate,
        "breathing_claim": 60 * evaluation.spectrum.breathing.claim,
        "pulse_per_minute": 60 * evaluation.spectrum.pulse.rate,
        "pulse_claim": 60 * evaluation.spectrum.pulse.claim,
        "live_rms_mm": evaluation.live_rms,
        "error_mm": ours,
        "live_error_mm": live,
        "passes": fitted.passes,
        "converged": fitted.converged,
        "cost": fitted.cost,
        "damage": session.damage,
    }


def _median(values: Array) -> float:
    """NaN where there is none, as of a camera that never saw a landmark."""
    return float(np.median(values)) if len(values) else float("nan")


LOCAL_CLUSTER = "local"
SCHEDULER_TIMEOUT_S = 15  # s for a scheduler to answer
SPAWN_SETTING = "distributed.nanny.pre-spawn-environ"
DASK_SETTINGS = {  # of workers here: Dask's own cost a third of the time of work that makes and drops many arrays
    "distributed.worker.daemon": False,  # a daemon may have no process of its own, and tracking has one
    "distributed.worker.profile.enabled": False,  # a look at all threads each 10 ms
    # bytes: else 64 kB go back to the system and are requested again, and each array of 128 kB is a mapping of its own
    **{f"{SPAWN_SETTING}.MALLOC_{kind}_THRESHOLD_": str(1 << 28) for kind in ("TRIM", "MMAP")},
    f"{SPAWN_SETTING}.MALLOC_ARENA_MAX": "1",  # tasks run in a thread, whose own arena would be given back as eagerly
}
MISSING_LIBRARY = "dask.distributed, by pip install 'stillbed[cluster]'"


def on_cluster(jobs: Sequence[SmoothJob], options: SmoothOptions, cluster: Cluster) -> Iterator[SmoothOutcome]:
    """The outcome of each job as it is done; when interrupted, the jobs that are not done are cancelled."""
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
        tasks = [SmoothJob(job.session.resolve(), job.out.resolve()) for job in jobs]
        futures = [client.submit(smooth_job, task, options, pure=False) for task in tasks]
        jobs_by_key = {future.key: job for future, job in zip(futures, jobs, strict=True)}
        for future in distributed.as_completed(futures):
            job, fault = jobs_by_key[future.key], future.exception()  # the job has the paths of the command line
            if fault is None:
                yield replace(future.result(), job=job)
            else:  # Dask gave up on the task
                yield SmoothOutcome(job, FAILED, f"{type(fault).__name__}: {fault}", 0.0)


@contextmanager
def local_cluster(workers: int | None) -> Iterator[Any]:
    """A Dask cluster of `workers` processes of this machine, None: as many as cores. Other machines cannot reach it.

    Each process has one thread, as the work holds Python's lock.
    """
    new_cluster = _library(LOCAL_CLUSTER).LocalCluster
    import dask  # comes with distributed

    local = {"host": "127.0.0.1", "dashboard_address": "127.0.0.1:0", "silence_logs": "CRITICAL"}
    with (
        dask.config.set(DASK_SETTINGS),  # while the cluster lives: restarted workers need the settings too
        new_cluster(n_workers=workers, threads_per_worker=1, **local) as cluster,
    ):
        yield cluster


def _library(scheduler: str) -> Any:
    try:
        import distributed
    except ImportError:
        raise InputError("command line", "--scheduler", scheduler, MISSING_LIBRARY) from None
    return distributed


SESSION_TABLE = "sessions.csv"
SMOOTHED, ALREADY_DONE, FAILED = "smoothed", "done already", "failed"
SUMMARY_FIGURES = (  # of a session's summary.json
    *("poses", "seconds", "landmarks", "sigma_mm", "error_mm", "live_error_mm", "live_rms_mm", "jitter_ms"),
    *("breathing_per_minute", "breathing_claim", "pulse_per_minute", "pulse_claim"),
)


@dataclass(frozen=True, slots=True)
class SmoothJob:
    """A session and the folder of its results."""

    session: Path
    out: Path


@dataclass(frozen=True, slots=True)
class SmoothOutcome:
    """The outcome of a job."""

    job: SmoothJob
    state: str  # SMOOTHED, ALREADY_DONE or FAILED
    text: str  # the summary, or why the job failed
    spent: float  # s
    damage: str = ""  # what was lost of the session's file, "" if nothing

    @property
    def failed(self) -> bool:
        """Whether there are no results."""
        return self.state == FAILED


@dataclass(frozen=True, slots=True)
class Cluster:
    """Where sessions are smoothed."""

    scheduler: str  # "local", or the address of a Dask scheduler
    workers: int | None = None  # of a local one; None: as many as cores


def run_smooth(
    paths: Sequence[Path], out: Path, options: SmoothOptions, cluster: Cluster | None = None
) -> Iterator[SmoothOutcome]:
    """Smooth sessions, and those in folders of sessions; yields the outcome of each as it is done.

    A single session is smoothed into `out`, and its errors are raised. Several get a folder each in `out`, one that
    fails does not stop the others, and sessions.csv lists all outcomes, also when the command is interrupted.
    """
    if options.rate is not None and not 0 < options.rate <= 1e5:
        raise InputError("command line", "--rate", options.rate, "0 < rate <= 100000 Hz")
    if cluster is not None and cluster.workers is not None and cluster.workers < 1:
        raise InputError("command line", "--workers", cluster.workers, "1 or more")
    sessions = [session for path in paths for session in sessions_in(path)]
    if sessions == list(paths) and len(sessions) == 1 and cluster is None:
        prepare_out(out, force=True)
        yield _outcome(SmoothJob(sessions[0], out), options, None)
        return
    jobs = [SmoothJob(session, out / name) for session, name in zip(sessions, _names(sessions), strict=True)]
    prepare_out(out, force=True)
    outcomes: list[SmoothOutcome] = []
    serial = (smooth_job(job, options) for job in jobs)
    try:
        with Progress("smooth", "sessions", WallClock().now) as progress:
            for outcome in serial if cluster is None else on_cluster(jobs, options, cluster):
                outcomes.append(outcome)
                yield outcome
                progress(len(outcomes), len(jobs))
    finally:
        write_table(out / SESSION_TABLE, jobs, outcomes)


def sessions_in(path: Path) -> list[Path]:
    """The sessions that an argument names: itself, or those in a folder that is no session itself."""
    if not path.is_dir() or (path / "rig.toml").exists():
        return [path]
    inside = sorted(p for p in path.iterdir() if p.suffix == ".mcap" or (p / "rig.toml").is_file())
    if not inside:
        raise InputError(path, "sessions", "none", "a session, or a folder of session folders and .mcap files")
    return inside


def smooth_job(job: SmoothJob, options: SmoothOptions) -> SmoothOutcome:
    """Smooth one of many without progress output; any error becomes its outcome."""
    try:
        return _outcome(job, options, io.StringIO())
    except (StillbedError, OSError) as error:
        return SmoothOutcome(job, FAILED, str(error), 0.0)
    except Exception as error:  # it must not end the other jobs
        return SmoothOutcome(job, FAILED, f"{type(error).__name__}: {error}", 0.0)


def write_table(path: Path, jobs: Iterable[SmoothJob], outcomes: Iterable[SmoothOutcome]) -> None:
    """sessions.csv: a line for each job, in their order; those without an outcome are "not done"."""
    known = {outcome.job: outcome for outcome in outcomes}
    with csv_table(path, ["session", "state", "reason", "folder", "spent_s", *SUMMARY_FIGURES]) as write:
        for job in jobs:
            outcome = known.get(job, SmoothOutcome(job, "not done", "interrupted", 0.0))
            done = outcome.state in (SMOOTHED, ALREADY_DONE)
            figures = _summary(job.out) if done else {}
            reason = "" if done else " ".join(outcome.text.split())
            head = [str(job.session), outcome.state, reason, str(job.out), f"{outcome.spent:.1f}"]
            write([*head, *("" if figures.get(key) is None else figures[key] for key in SUMMARY_FIGURES)])


def _outcome(job: SmoothJob, options: SmoothOptions, stream: TextIO | None) -> SmoothOutcome:
    clock = WallClock()
    start = clock.now()
    done, text = smooth_session(job.session, job.out, options, stream)
    damage = str(_summary(job.out).get("damage", ""))
    return SmoothOutcome(job, ALREADY_DONE if done else SMOOTHED, text, clock.now() - start, damage)


def _names(sessions: Sequence[Path]) -> list[str]:
    """The name of each session's folder: its own, with the suffix where two would be the same without."""
    full = [path.resolve().name for path in sessions]
    short = [path.resolve().stem if path.is_file() else path.resolve().name for path in sessions]
    names = [s if short.count(s) == 1 else f for s, f in zip(short, full, strict=True)]
    if len(set(names)) < len(names):
        raise InputError("command line", "SESSION", ", ".join(names), "sessions of different names")
    return names
