"""A session's tracks with what its images show besides, once map and motion are known; made once and kept."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TextIO

import numpy as np

from estimation.batch.smoothed import Smoothed
from estimation.errors import InputError
from estimation.observations import Observations
from hardware.files.session import Session
from hardware.process.clock import WallClock
from hardware.process.progress import Progress
from hardware.smoothing.kept import keeping, made_of, part_of
from hardware.smoothing.tracks import Tracks, read_tracks
from perception.known_motion import KnownMotion
from perception.pairing import mean_stamp
from perception.tracking.reobservation import References, Relinker, joined

RELINKED = "relinked.mcap"
NEAR = 1e-6  # s


@dataclass(frozen=True, slots=True, eq=False)
class Relinked:
    """tracks: of the session, with what was found. looks: how many that are, early: of landmarks before they were first
    seen; sets: frame sets that had none before. trouble: why not all images were searched, "" if they were.
    """

    tracks: Tracks
    looks: int = 0
    early: int = 0
    sets: int = 0
    trouble: str = ""

    @property
    def text(self) -> str:
        """In words, behind others."""
        found = f" {self.looks} looks at landmarks were found besides the tracks'" if self.looks else ""
        parts = [(self.early, "of landmarks that joined the map later"), (self.sets, "frame sets had none")]
        told = ", ".join(f"{count} {what}" for count, what in parts if count)
        trouble = f" Images were not searched to their end: {self.trouble}." if self.trouble else ""
        return f"{found}{': ' if found and told else ''}{told}{'.' if found else ''}{trouble}"

    @property
    def figures(self) -> dict[str, int]:
        """For summary.json."""
        return {"looks_found": self.looks, "looks_before_joining": self.early, "frame_sets_found": self.sets}


def relinked(
    session: Session, tracks: Tracks, smoothed: Smoothed, out: Path, contents: str, stream: TextIO | None = None
) -> Relinked:
    """The session's tracks, and looks at its landmarks wherever its images show one and the tracks do not say so.

    What is found is kept in relinked.mcap in the folder `out`. smoothed: of these tracks. contents: hash of the session
    and of how it was smoothed; a file made of others is made anew. stream: where progress is said, stderr without.
    """
    kept = out / RELINKED
    if made_of(kept) == contents:
        return with_looks(tracks, read_tracks(kept).observations)
    try:
        with keeping(kept, session.rig, contents) as recorder:
            for seen in _searched(session, tracks, smoothed, stream):
                recorder.write(seen)
    except InputError as damage:  # the tracks do not need the images
        return replace(with_looks(tracks, read_tracks(part_of(kept)).observations), trouble=str(damage))
    return with_looks(tracks, read_tracks(kept).observations)


def with_looks(tracks: Tracks, found: Iterable[Observations]) -> Relinked:
    """The tracks with what was found besides, in order of stamp."""
    whole = {seen.stamp: seen for seen in tracks.observations}
    first: dict[int, float] = {}
    for seen in tracks.observations:
        for track in np.unique(seen.track).tolist():
            first.setdefault(track, seen.stamp)
    looks = early = sets = 0
    for seen in found:
        before = whole.get(seen.stamp)
        whole[seen.stamp] = seen if before is None else joined(before, seen)
        looks += len(seen)
        early += sum(seen.stamp < first[track] for track in seen.track.tolist())
        sets += before is None or not len(before)
    observations = tuple(whole[stamp] for stamp in sorted(whole))
    return Relinked(replace(tracks, observations=observations), looks, early, sets)


def _searched(session: Session, tracks: Tracks, smoothed: Smoothed, stream: TextIO | None) -> Iterable[Observations]:
    motion = KnownMotion(session.rig, smoothed, tracks.observations)
    references = References(motion)
    stamps = np.array([mean_stamp(refs) for refs in session.sets])
    wanted = np.abs(stamps[:, None] - references.stamps).min(1, initial=np.inf) < NEAR
    some = replace(session, sets=tuple(refs for refs, mine in zip(session.sets, wanted, strict=True) if mine))
    total = len(some) + len(session)
    with Progress("relink", "frame sets", WallClock().now, stream) as progress:
        for done, frames in enumerate(some.frame_sets(), 1):
            references.cut(frames)
            progress(done, total)
        found = references.matcher()
        if found is None:
            return
        relinker, looks = Relinker(motion, *found), list[Observations]()
        try:
            for done, frames in enumerate(session.frame_sets(), 1 + len(some)):
                looks += relinker(frames)
                progress(done, total)
        finally:
            yield from map(relinker.told, looks)
