"""`stillbed smooth`: sessions in, a folder of results each; what is done already is told, not done again."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from estimation.errors import InputError, StillbedError
from estimation.smoothing.cameras import REFINED, CalibrationPrior
from estimation.smoothing.smooth import smooth
from estimation.smoothing.smoothed import Smoothed
from hardware.clock import WallClock
from hardware.out_folder import prepare_out
from hardware.progress import Progress
from hardware.rig_file import write_rig
from hardware.session import Session, open_session
from hardware.smoothing.files import write_instants, write_map
from hardware.smoothing.judged import Judged, judge
from hardware.smoothing.recording_copy import write_copy
from hardware.smoothing.report import lead, page
from hardware.smoothing.tracks import Tracks, tracks_of
from hardware.summary import finite
from hardware.tum import write_tum

SUMMARY = "summary.json"
USUAL_PASSES = 12  # of a long recording; the estimate of the time left counts with them
BLOCK = 2**20


@dataclass(frozen=True, slots=True)
class Wishes:
    """What is asked for. rate: rows of smoothed.csv a second, Hz, or None for the stamps. refine: the cameras too."""

    rate: float | None = None
    refine: bool = False


def run_smooth(paths: Sequence[Path], out: Path, wishes: Wishes) -> Iterator[tuple[str, bool]]:
    """Smooth sessions one after the other; of each a summary as text, and whether it was smoothed.

    Several get a folder of their own in `out`, and one that cannot be smoothed does not stop the others.
    """
    if wishes.rate is not None and not 0 < wishes.rate <= 1e5:
        raise InputError("command line", "--rate", wishes.rate, "0 < rate <= 100000 Hz")
    names = [path.resolve().stem if path.is_file() else path.resolve().name for path in paths]
    if len(set(names)) < len(names):
        raise InputError("command line", "SESSION", ", ".join(names), "sessions of different names")
    prepare_out(out, force=True)
    for path, name in zip(paths, names, strict=True):
        if len(paths) == 1:
            yield smooth_session(path, out, wishes), True
            continue
        try:
            yield smooth_session(path, out / name, wishes), True
        except (StillbedError, OSError) as error:
            yield f"{path}: not smoothed: {error}", False


def smooth_session(path: Path, out: Path, wishes: Wishes) -> str:
    """Smooth one session into the folder `out`, unless that holds its results already; the summary as text."""
    session = open_session(path)
    contents = content_hash(path, wishes)
    done = _done(out, contents)
    if done is not None:
        return f"{path}: done already\n{done}"
    out.mkdir(parents=True, exist_ok=True)
    tracks = tracks_of(session, out)
    result = _solved(session, tracks, wishes)
    judged = judge(result, tracks, session.truth)
    _write(out, session, result, wishes)
    text = f"{lead(result, judged)}\nreport: {out / 'report.html'}"
    (out / "report.html").write_text(page(session.path.name, result, judged), encoding="utf-8")
    summary = {"contents": contents, "text": text, **_figures(result, judged, session)}
    (out / SUMMARY).write_text(json.dumps(finite(summary), indent=2) + "\n", encoding="utf-8")
    return text


def content_hash(path: Path, wishes: Wishes) -> str:
    """Of a session's every byte, and of what is asked for."""
    digest = hashlib.sha256(json.dumps(asdict(wishes)).encode())
    files = sorted(p for p in path.rglob("*") if p.is_file()) if path.is_dir() else [path]
    for file in files:
        digest.update(file.name.encode())
        with file.open("rb") as stream:
            while block := stream.read(BLOCK):
                digest.update(block)
    return digest.hexdigest()


def _done(out: Path, contents: str) -> str | None:
    """The summary's text of an earlier run on the same contents; None without one."""
    try:
        summary = json.loads((out / SUMMARY).read_text(encoding="utf-8"))
        return str(summary["text"]) if summary["contents"] == contents else None
    except (OSError, ValueError, KeyError, TypeError):
        return None


def _solved(session: Session, tracks: Tracks, wishes: Wishes) -> Smoothed:
    passes = 0
    with Progress("smooth", "frame sets, passes taken together,", WallClock().now) as progress:

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
        "passes": fitted.passes,
        "cost": fitted.cost,
        "damage": session.damage,
    }
