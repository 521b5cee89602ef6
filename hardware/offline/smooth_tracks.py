"""The tracks of a session that is smoothed: recorded ones, else the tracker's on its images; and reobserved landmarks.

Tracks take long to compute, so they are kept as a recording beside the results, with the hash of their source.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TextIO

import numpy as np

from estimation.batch.smoothed import Smoothed
from estimation.errors import InputError
from estimation.observations import Observations
from estimation.pose import SurfacePose, Trajectory
from estimation.rig import Rig
from hardware.files.session import Session
from hardware.offline.track import tracker
from hardware.process.clock import WallClock
from hardware.process.progress import Progress
from hardware.recording.mcap_file import AttachedFile, ChunkMessages, walk
from hardware.recording.recorder import Recorder
from hardware.recording.session_reader import read_observations, read_poses
from perception.frames import mean_stamp
from perception.tracking.reobservation import KnownMotion, ReferencePictures, Reobserver, joined_observations

SOURCE_ATTACHMENT = "made_of.txt"  # name of the attachment with the hash, the recording's first record


def source_hash(path: Path) -> str:
    """The hash that `track_writer` stored in a recording; "" where there is no recording, or no hash in it."""
    with suppress(InputError):  # unreadable: the tracks are computed again
        for part in walk(path):
            if isinstance(part, AttachedFile) and part.name == SOURCE_ATTACHMENT:
                return part.data.decode()
            if isinstance(part, ChunkMessages):
                break
    return ""


def part_path(target: Path) -> Path:
    """The recording while it is written, and what an interruption leaves of it."""
    return target.with_suffix(".part.mcap")


@contextmanager
def track_writer(target: Path, rig: Rig, contents: str, began: int | None = None) -> Iterator[Recorder]:
    """A recorder for tracks computed from a source of the hash `contents`; the file gets its name once it is whole."""
    part = part_path(target)
    with Recorder(part, rig, overwrite=True, began=began) as recorder:
        recorder.attach(SOURCE_ATTACHMENT, contents.encode())
        yield recorder
    os.replace(part, target)


TRACKS_FILE = "tracks.mcap"


@dataclass(frozen=True, slots=True, eq=False)
class SessionTracks:
    """The results of a causal run."""

    observations: tuple[Observations, ...]  # of each frame set, in order of stamp
    poses: tuple[SurfacePose, ...]  # in order of stamp

    @property
    def start(self) -> Trajectory | None:
        """The poses that were measured; None where there are none."""
        measured = [pose for pose in self.poses if pose.state.measured]
        if not measured:
            return None
        stamps = np.array([pose.stamp for pose in measured])
        return Trajectory(stamps, np.stack([pose.base_from_surface for pose in measured]), exact=False)


def tracks_of(session: Session, out: Path, contents: str, stream: TextIO | None = None) -> SessionTracks:
    """The session's tracks. Where it has none, its images are tracked first, into tracks.mcap in the folder `out`.

    contents: the session's hash; tracks.mcap of another one is replaced. stream: for progress, by default stderr.
    """
    if session.path.is_file():
        recorded = read_tracks(session.path)
        if any(map(len, recorded.observations)):
            return recorded
    if source_hash(out / TRACKS_FILE) != contents:
        _track(session, out / TRACKS_FILE, contents, stream)
    tracks = read_tracks(out / TRACKS_FILE)
    if not any(map(len, tracks.observations)):
        raise InputError(session.path, "tracks", "none in its images", "a surface that the tracker finds")
    return tracks


def read_tracks(path: Path) -> SessionTracks:
    """The tracks in a recording, each stamp once: a run interrupted while it wrote may have stored a chunk twice."""
    observations = {seen.stamp: seen for seen in read_observations(path)}
    poses = {pose.stamp: pose for pose in read_poses(path) if np.isfinite(pose.base_from_surface).all()}
    return SessionTracks(
        tuple(observations[stamp] for stamp in sorted(observations)), tuple(poses[stamp] for stamp in sorted(poses))
    )


def _track(session: Session, target: Path, contents: str, stream: TextIO | None) -> None:
    clock = WallClock()
    with (
        tracker(session.rig, session.roi, session.surface, clock.now) as step,
        track_writer(target, session.rig, contents, session.began) as recorder,
        Progress("track", "frame sets", clock.now, stream) as progress,
    ):
        for done, frames in enumerate(session.frame_sets(), 1):
            pose = step(frames)
            recorder.write(step.last.observations)
            recorder.write(pose)
            step.idle()
            progress(done, len(session))


RELINKED_FILE = "relinked.mcap"
STAMP_TOLERANCE_S = 1e-6  # s


@dataclass(frozen=True, slots=True, eq=False)
class ReobservedTracks:
    """The session's tracks with the landmarks that were found again in its images."""

    tracks: SessionTracks
    looks: int = 0  # number of added observations
    early: int = 0  # those of them that precede their landmark's first track
    sets: int = 0  # frame sets that had no track before
    trouble: str = ""  # why not all images were searched, "" if they were

    @property
    def text(self) -> str:
        """A sentence to follow others, "" where nothing was found."""
        found = f" {self.looks} looks at landmarks were found besides the tracks'" if self.looks else ""
        parts = [(self.early, "of landmarks that joined the map later"), (self.sets, "frame sets had none")]
        details = ", ".join(f"{count} {what}" for count, what in parts if count)
        trouble = f" Images were not searched to their end: {self.trouble}." if self.trouble else ""
        return f"{found}{': ' if found and details else ''}{details}{'.' if found else ''}{trouble}"

    @property
    def figures(self) -> dict[str, int]:
        """For summary.json."""
        return {"looks_found": self.looks, "looks_before_joining": self.early, "frame_sets_found": self.sets}


def reobserve(
    session: Session, tracks: SessionTracks, smoothed: Smoothed, out: Path, contents: str, stream: TextIO | None = None
) -> ReobservedTracks:
    """The session's tracks, and observations of its landmarks in images that show one without a track.

    They are kept in relinked.mcap in the folder `out`. smoothed: by these tracks. contents: hash of the session and of
    how it was smoothed; a file of another one is replaced. stream: for progress, by default stderr.
    """
    file, trouble = out / RELINKED_FILE, ""
    if source_hash(file) != contents:
        try:
            with track_writer(file, session.rig, contents) as recorder:
                for seen in _searched(session, tracks, smoothed, stream):
                    recorder.write(seen)
        except InputError as damage:  # the tracks do not need the images
            file, trouble = part_path(file), str(damage)
    return replace(with_looks(tracks, read_tracks(file).observations), trouble=trouble)


def with_looks(tracks: SessionTracks, found: Iterable[Observations]) -> ReobservedTracks:
    """The tracks together with more observations, in order of stamp."""
    whole = {seen.stamp: seen for seen in tracks.observations}
    first: dict[int, float] = {}
    for seen in tracks.observations:
        for track in np.unique(seen.track).tolist():
            first.setdefault(track, seen.stamp)
    looks = early = sets = 0
    for seen in found:
        before = whole.get(seen.stamp)
        whole[seen.stamp] = seen if before is None else joined_observations(before, seen)
        looks += len(seen)
        early += sum(seen.stamp < first[track] for track in seen.track.tolist())
        sets += before is None or not len(before)
    observations = tuple(whole[stamp] for stamp in sorted(whole))
    return ReobservedTracks(replace(tracks, observations=observations), looks, early, sets)


def _searched(
    session: Session, tracks: SessionTracks, smoothed: Smoothed, stream: TextIO | None
) -> Iterable[Observations]:
    motion = KnownMotion(session.rig, smoothed, tracks.observations)
    references = ReferencePictures(motion)
    stamps = np.array([mean_stamp(refs) for refs in session.sets])
    wanted = np.abs(stamps[:, None] - references.stamps).min(1, initial=np.inf) < STAMP_TOLERANCE_S
    some = replace(session, sets=tuple(refs for refs, mine in zip(session.sets, wanted, strict=True) if mine))
    total = len(some) + len(session)
    with Progress("relink", "frame sets", WallClock().now, stream) as progress:
        for done, frames in enumerate(some.frame_sets(), 1):
            references.cut(frames)
            progress(done, total)
        found = references.matcher()
        if found is None:
            return
        relinker, looks = Reobserver(motion, *found), list[Observations]()
        try:
            for done, frames in enumerate(session.frame_sets(), 1 + len(some)):
                looks += relinker(frames)
                progress(done, total)
        finally:
            yield from map(relinker.as_tracks, looks)
