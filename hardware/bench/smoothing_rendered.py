"""The simulator's scenarios, rendered and tracked as a live run would, and smoothed: errors beside the causal ones."""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from estimation import smooth
from estimation.batch.smoothed import Smoothed
from estimation.errors import InputError
from hardware.bench.figures import Figure, at_most
from hardware.cache_folder import cache_folder
from hardware.files.session import Session, open_session
from hardware.live.prerender import prerender
from hardware.offline.smooth_tracks import Relinked, relinked
from hardware.report.evaluation import spread
from hardware.smoothing.judged import judge
from hardware.smoothing.run import session_hash
from hardware.smoothing.tracks import Tracks, tracks_of
from perception.package_data import shipped_file


@dataclass(frozen=True, slots=True, eq=False)
class Judgement:
    """RMS distances from the truth, mm, each after the constant that fits it best: of the causal poses, of those
    smoothed by the run's own tracks, and by what was found besides."""

    causal: float
    tracked: float
    smoothed: float
    found: Relinked


def rendered_figures(names: Sequence[str], seconds: float) -> list[Figure]:
    """A figure for each scenario, and the worst of them."""
    figures: list[Figure] = []
    for name in names:
        session = prerender(shipped_file("scenarios", f"{name}.toml"), cache_folder(), seconds=seconds).session
        figure = judged_figure(name, judged(session))
        print(f"{name}: {figure.value:.2f} of the causal error; {figure.note}", file=sys.stderr, flush=True)
        figures.append(figure)
    if figures:
        worst = max(figures, key=lambda figure: figure.value)
        figures.append(Figure("pictures: worst of them", worst.value, "", at_most(1.0), "", worst.what))
    return figures


def judged_figure(name: str, found: Judgement) -> Figure:
    """Smoothed by causal error of one scenario."""
    tracks = found.found
    note = (
        f"{1000 * found.smoothed:.1f} against {1000 * found.causal:.1f} um RMS, aligned; {1000 * found.tracked:.1f} um "
        f"without {tracks.looks} looks found besides, {tracks.early} of them before their landmarks joined"
    )
    return Figure(
        f"pictures, {name}: error by the causal one's", found.smoothed / found.causal, "", at_most(0.6), "", note
    )


def judged(path: Path) -> Judgement:
    """A session of pictures with its truth, tracked and smoothed."""
    session = open_session(path)
    with tempfile.TemporaryDirectory() as folder:
        contents, out = session_hash(path), Path(folder)
        tracks = tracks_of(session, out, contents)
        before = smooth(session.rig, tracks.observations, start=tracks.start)
        found = relinked(session, tracks, before, out, contents)
    after = smooth(session.rig, found.tracks.observations, start=tracks.start) if found.looks else before
    (tracked, causal), (smoothed, _) = (_errors(session, result, tracks) for result in (before, after))
    return Judgement(causal, tracked, smoothed, found)


def _errors(session: Session, result: Smoothed, tracks: Tracks) -> tuple[float, float]:
    """RMS distances, mm, of smoothed and of causal poses."""
    errors = judge(result, tracks, session.truth).errors
    if errors is None or errors[1] is None:
        raise InputError(session.path, "poses beside a truth", "none", "a rendered session that the tracker follows")
    return spread(errors[0].translation).rmse, spread(errors[1].translation).rmse
