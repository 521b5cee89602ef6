"""Recordings and records that tests of the recorder share."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from estimation.pose import Forecast, MotionState, SurfacePose, TrackState
from estimation.surface_map import Warp
from hardware.recording import ros_messages
from hardware.recording.mcap_file import ChunkMessages, FileMetadata, epoch_of, walk
from hardware.recording.recorder import Recorder
from perception.frames import Frame
from tests.session_files import image, rig, stamps, trajectory


def write_frames(recorder: Recorder, count: int, cameras: int = 2, start: float = -0.1) -> None:
    for number, stamp in enumerate(stamps(count, start)):
        for camera in range(cameras):
            recorder.write(Frame(camera, stamp, image(camera, number)))


def pose(stamp: float, seed: int = 0) -> SurfacePose:
    draw = np.random.default_rng(seed)
    root = draw.normal(size=(6, 6))
    placed = trajectory(1, True).base_from_surface[0]
    return SurfacePose(
        stamp,
        placed,
        root @ root.T,
        draw.normal(size=6),
        TrackState.DEGRADED,
        np.eye(6) / 3,
        draw.random(6),
        'why "so"',
        MotionState(True, stamp - 0.1 if seed else float("nan"), 0.31, 0.002),
        Warp(draw.normal(size=(4, 3)), draw.normal(size=(4, 3)), np.eye(12) / 7, np.eye(12) / 9, 25.0, 0.3, 0.02),
        Forecast(np.array([0.1, 0.3]), draw.normal(size=(2, 6)), np.stack([np.eye(6) / 3, np.eye(6) / 7])),
    )


LOST = SurfacePose(0.0, np.full((4, 4), np.nan), np.full((6, 6), np.inf), np.zeros(6), TrackState.LOST)


def whole_recording(folder: Path) -> Path:
    """A closed recording x.mcap of 2.4 s with a scan in it."""
    (folder / "scan.ply").write_bytes(b"ply\n" * 500)
    with Recorder(folder / "x.mcap", rig(2)) as recorder:
        for number, stamp in enumerate(stamps(24, 0.0)):
            for camera in range(2):
                recorder.write(Frame(camera, 3 * stamp, image(camera, number)))
            recorder.write(pose(3 * stamp, number))
            if number == 12:
                recorder.surface(folder / "scan.ply")
    return folder / "x.mcap"


@dataclass(frozen=True)
class Event:
    """A line of a recording's log."""

    stamp: float  # s, to the ns
    level: int
    text: str
    name: str


def events(path: Path) -> list[Event]:
    """All of them, in the order of the file, up to its damage if there is any."""
    epoch, found = 0, []
    for part in walk(path):
        if isinstance(part, FileMetadata):
            epoch = epoch_of(part.table) or 0
        elif isinstance(part, ChunkMessages):
            told = (each.data for each in part.messages if each.topic == "/events")
            for log in (ros_messages.unpacked(ros_messages.LOG, data) for data in told):
                instant = log.stamp.sec * 1_000_000_000 + log.stamp.nanosec
                found.append(Event((instant - epoch) / 1e9, log.level, log.msg, log.name))
    return found
