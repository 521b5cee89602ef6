"""The tracks of a session: those that were recorded, or made from its images by the tracker and kept."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TextIO

import numpy as np

from estimation.errors import InputError
from estimation.observations import Observations
from estimation.pose import SurfacePose
from estimation.trajectory import Trajectory
from hardware.channels import read_observations, read_poses
from hardware.files.session import Session
from hardware.process.clock import WallClock
from hardware.process.progress import Progress
from hardware.smoothing.kept import keeping, made_of
from hardware.tracker import tracker

TRACKS = "tracks.mcap"


@dataclass(frozen=True, slots=True, eq=False)
class Tracks:
    """What a causal run left. observations: of each frame set, in order of stamp. poses: its own, in order of stamp."""

    observations: tuple[Observations, ...]
    poses: tuple[SurfacePose, ...]

    @property
    def start(self) -> Trajectory | None:
        """The poses that were measured; None where there are none."""
        measured = [pose for pose in self.poses if pose.state.measured]
        if not measured:
            return None
        stamps = np.array([pose.stamp for pose in measured])
        return Trajectory(stamps, np.stack([pose.base_from_surface for pose in measured]), exact=False)


def tracks_of(session: Session, out: Path, contents: str, stream: TextIO | None = None) -> Tracks:
    """The session's tracks. Where it has none, its images are tracked first, into tracks.mcap in the folder `out`.

    contents: the session's hash; tracks.mcap of another one is made anew. stream: where progress is said, stderr
    without.
    """
    if session.path.is_file():
        recorded = read_tracks(session.path)
        if any(map(len, recorded.observations)):
            return recorded
    kept = out / TRACKS
    if made_of(kept) != contents:
        _track(session, kept, contents, stream)
    found = read_tracks(kept)
    if not any(map(len, found.observations)):
        raise InputError(session.path, "tracks", "none in its images", "a surface that the tracker finds")
    return found


def read_tracks(path: Path) -> Tracks:
    """By stamp, each once: a run that was interrupted while it wrote may have stored a stretch twice."""
    observations = {seen.stamp: seen for seen in read_observations(path)}
    poses = {pose.stamp: pose for pose in read_poses(path) if np.isfinite(pose.base_from_surface).all()}
    return Tracks(
        tuple(observations[stamp] for stamp in sorted(observations)), tuple(poses[stamp] for stamp in sorted(poses))
    )


def _track(session: Session, target: Path, contents: str, stream: TextIO | None) -> None:
    clock = WallClock()
    with (
        tracker(session.rig, session.roi, session.surface, clock.now) as step,
        keeping(target, session.rig, contents) as recorder,
        Progress("track", "frame sets", clock.now, stream) as progress,
    ):
        for done, frames in enumerate(session.frame_sets(), 1):
            pose = step(frames)
            recorder.write(step.last.observations)
            recorder.write(pose)
            step.idle()
            progress(done, len(session))
