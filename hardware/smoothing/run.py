"""One session smoothed into a folder of results; what is done already is told, not done again."""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, TextIO

import numpy as np

from estimation.batch.smooth import smooth
from estimation.batch.smoothed import Smoothed
from estimation.errors import InputError
from estimation.smoothing.cameras import REFINED, CalibrationPrior
from hardware.files.rig_file import write_rig
from hardware.files.session import Session, damage_told, open_session
from hardware.offline.smooth_report import lead, page
from hardware.offline.smooth_tracks import Relinked, relinked
from hardware.offline.trajectory_files import write_instants, write_map
from hardware.process.clock import WallClock
from hardware.process.progress import Progress
from hardware.report.evaluation import spread
from hardware.report.summary import finite
from hardware.smoothing.judged import Judged, judge
from hardware.smoothing.recording_copy import write_copy
from hardware.smoothing.tracks import Tracks, tracks_of
from hardware.tum import write_tum

SUMMARY = "summary.json"
USUAL_PASSES = 12  # of a long recording; the estimate of the time left counts with them
BLOCK = 2**20


@dataclass(frozen=True, slots=True)
class Wishes:
    """What is asked for. rate: rows of smoothed.csv a second, Hz, or None for the stamps. refine: the cameras too.
    relink: look for the landmarks in all images.
    """

    rate: float | None = None
    refine: bool = False
    relink: bool = True


def check_wishes(wishes: Wishes) -> None:
    """InputError for what cannot be done."""
    if wishes.rate is not None and not 0 < wishes.rate <= 1e5:
        raise InputError("command line", "--rate", wishes.rate, "0 < rate <= 100000 Hz")


def smooth_session(path: Path, out: Path, wishes: Wishes, stream: TextIO | None = None) -> tuple[bool, str]:
    """Smooth one session into the folder `out`, unless that holds its results already: whether it does, and the summary
    as text. stream: where progress is said, stderr without.
    """
    session = open_session(path)
    recorded = session_hash(path)
    contents = content_hash(recorded, wishes)
    done = _done(out, contents)
    if done is not None:
        return True, f"{path}: done already\n{done}"
    out.mkdir(parents=True, exist_ok=True)
    tracks = tracks_of(session, out, recorded, stream)
    result = _solved(session, tracks, wishes, stream)
    found = Relinked(tracks)
    if wishes.relink:
        motion = content_hash(recorded, Wishes(refine=wishes.refine))  # the rate changes nothing of it
        found = relinked(session, tracks, result, out, motion, stream)
    if found.looks:
        result = _solved(session, found.tracks, wishes, stream)
    judged = judge(result, tracks, session.truth)
    _write(out, session, result, wishes)
    words = " ".join(filter(None, (damage_told(session.damage), lead(result, judged)))) + found.text
    text = f"{words}\nreport: {out / 'report.html'}"
    (out / "report.html").write_text(page(session.path.name, words, result, judged), encoding="utf-8")
    summary = {"contents": contents, "text": text, **_figures(result, judged, session), **found.figures}
    (out / SUMMARY).write_text(json.dumps(finite(summary), indent=2) + "\n", encoding="utf-8")
    return False, text


def session_hash(path: Path) -> str:
    """Of a session's every byte."""
    digest = hashlib.sha256()
    files = sorted(p for p in path.rglob("*") if p.is_file()) if path.is_dir() else [path]
    for file in files:
        digest.update(file.name.encode())
        with file.open("rb") as stream:
            while block := stream.read(BLOCK):
                digest.update(block)
    return digest.hexdigest()


def content_hash(recorded: str, wishes: Wishes) -> str:
    """Of a session, by its hash, and of what is asked for."""
    return hashlib.sha256(json.dumps([recorded, asdict(wishes)]).encode()).hexdigest()


def _done(out: Path, contents: str) -> str | None:
    """The summary's text of an earlier run on the same contents; None without one."""
    try:
        summary = json.loads((out / SUMMARY).read_text(encoding="utf-8"))
        return str(summary["text"]) if summary["contents"] == contents else None
    except (OSError, ValueError, KeyError, TypeError):
        return None


def _solved(session: Session, tracks: Tracks, wishes: Wishes, stream: TextIO | None) -> Smoothed:
    passes = 0
    with Progress("smooth", "frame sets, passes taken together,", WallClock().now, stream) as progress:

        def say(what: str, done: int, total: int) -> None:
            nonlocal passes
            progress(passes * total + done, max(USUAL_PASSES, passes + 2) * total)
            passes += done == total

        prior = REFINED if wishes.refine else CalibrationPrior()
        return smooth(session.rig, tracks.observations, start=tracks.start, prior=prior, progress=say)


def _write(out: Path, session: Session, result: Smoothed, wishes: Wishes) -> None:
    write_tum(out / "smoothed.tum", result.trajectory)
    first, end = result.stamps[[0, -1]]
    instants = result.instants if wishes.rate is None else result.at(np.arange(first, end, 1 / wishes.rate))
    write_instants(out / "smoothed.csv", instants)
    write_rig(out / "rig.toml", result.rig, [None] * len(result.rig))
    write_map(out / "map.ply", result, session)
    if session.path.is_file():
        write_copy(session.path, out / "smoothed.mcap", result)


def _figures(result: Smoothed, judged: Judged, session: Session) -> dict[str, Any]:
    fitted, names = result.fitted, [camera.name for camera in result.rig.cameras]
    sigma = np.sqrt(np.trace(result.covariance[:, 3:6, 3:6], axis1=1, axis2=2) / 3)
    ours, live = (None if e is None else spread(e.translation).rmse for e in judged.errors or (None, None))
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
        "breathing_per_minute": 60 * judged.rhythms.breathing,
        "pulse_per_minute": 60 * judged.rhythms.pulse,
        "live_rms_mm": judged.live_rms,
        "error_mm": ours,
        "live_error_mm": live,
        "passes": fitted.passes,
        "cost": fitted.cost,
        "damage": session.damage,
    }
