"""What a recording tells a tracker that has never seen the surface: its pictures, its poses, its truth."""

from __future__ import annotations

from dataclasses import replace
from itertools import takewhile
from pathlib import Path

import numpy as np

from estimation import se3
from estimation.errors import InputError
from estimation.pose import SurfacePose, TrackState
from estimation.se3 import Array
from estimation.trajectory import Trajectory
from hardware.files.session import Session
from hardware.offline.track import Step
from hardware.recording.mcap_file import ChunkOf, parse, walk
from hardware.recording.messages import pose_from_message
from perception.frames import FrameSet

SETTLED = 1.0  # s of an earlier run, beyond where its path was laid, that make the map anew


def true_pose(truth: Trajectory, stamp: float) -> Array:
    """base_from_surface (4, 4) at `stamp`, s, between the truth's own stamps."""
    after = int(np.clip(np.searchsorted(truth.stamps, stamp), 1, len(truth) - 1))
    before, span = after - 1, truth.stamps[after] - truth.stamps[after - 1]
    share = (stamp - truth.stamps[before]) / span
    return np.asarray(se3.interpolate(truth.base_from_surface[before], truth.base_from_surface[after], share))


def remember(step: Step, record: Path, session: Session, until: float, now: float) -> Array:
    """Show the step what an earlier run saw first: it makes a map of the same surface. new_from_old (4, 4) mm.

    From pictures that were kept exactly it is the same map; from others its frame may lie elsewhere, by what both runs
    say of the last of them. InputError where the surface is not found again in its own pictures.
    """
    poses = {pose.stamp: pose for pose in recorded_poses(record) if pose.stamp <= until + SETTLED}
    sets = takewhile(lambda frames: frames.stamp <= until + SETTLED, session.frame_sets())
    shift = now - until - SETTLED - 1.0  # its stamps end a second ago: the clock may have begun anew since
    new_from_old: Array | None = None
    for frames in sets:
        shown = tuple(replace(frame, stamp=frame.stamp + shift) for frame in frames.frames)
        pose, old = step(FrameSet(frames.stamp + shift, shown, frames.head)), poses.get(frames.stamp)
        step.idle()
        if old is not None and old.state is pose.state is TrackState.TRACKING:
            new_from_old = se3.inverse(pose.base_from_surface) @ old.base_from_surface
    if new_from_old is None:
        raise InputError(record, "recording", "no surface", "pictures in which it is found again")
    return new_from_old


def recorded_poses(record: Path) -> list[SurfacePose]:
    """The poses in a recording, in the order of the file."""
    return [
        pose_from_message(parse(record, stored))
        for part in walk(record)
        if isinstance(part, ChunkOf)
        for stored in part.messages
        if stored.topic == "/pose"
    ]
