"""What can be compared: poses with their covariances out of a file or folder of any kind that stillbed writes."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from estimation.errors import InputError
from estimation.pose import SurfacePose
from estimation.se3 import Array
from estimation.trajectory import Trajectory
from hardware.channels import read_poses, read_smoothed
from hardware.files.pose_file import read_poses as read_pose_table
from hardware.files.session import open_session
from hardware.offline.trajectory_files import COLUMNS, read_instants
from hardware.process import checks
from hardware.tum import read_tum

IN_FOLDERS = ("smoothed.mcap", "smoothed.csv", "poses.csv", "truth.tum", "reference.tum")  # the first that is there
CHANNELS = ("smoothed", "pose", "truth")  # of a recording; the first that holds something
READERS: dict[str, Callable[[Path], Iterator[SurfacePose]]] = {"smoothed": read_smoothed, "pose": read_poses}
KINDS = f"a TUM or CSV file, an .mcap file, or a folder with one of {', '.join(IN_FOLDERS)}"


@dataclass(frozen=True, slots=True, eq=False)
class Posed:
    """A trajectory. name: where it is from. covariance: (N, 6, 6) of right perturbations, NaN where nothing is told."""

    name: str
    trajectory: Trajectory
    covariance: Array

    def __len__(self) -> int:
        return len(self.trajectory)


def read_posed(text: str) -> Posed:
    """The trajectory that a word of the command line names; InputError says what is wrong.

    A path; of an .mcap file also PATH:CHANNEL, with one of CHANNELS.
    """
    path, channel = _named(text)
    if path.is_dir():
        inside = [path / name for name in IN_FOLDERS if (path / name).exists()]
        if not inside:
            raise InputError(path, "poses", "none", KINDS)
        path = inside[0]
    if not path.exists():
        raise InputError(path, "file", "no such file or folder", KINDS)
    if path.suffix == ".mcap":
        return _of_recording(path, (channel,) if channel else CHANNELS)
    if path.suffix == ".csv":
        return _of_csv(path)
    return _bare(path, read_tum(path, exact=path.name == "truth.tum"))


def read_truth(text: str) -> Posed:
    """The truth or reference that lies in the session that a word of the command line names."""
    path, _ = _named(text)
    if path.is_dir():
        for name in ("smoothed.mcap", "truth.tum", "reference.tum"):
            if (path / name).exists():
                return read_truth(str(path / name)) if name.endswith(".mcap") else read_posed(str(path / name))
    elif path.suffix == ".mcap":
        return _of_recording(path, ("truth",))
    raise InputError(path, "truth", "none", "a session with its truth or reference; else name what it is compared with")


def _named(text: str) -> tuple[Path, str]:
    before, colon, channel = text.rpartition(":")
    if not colon or not before.endswith(".mcap") or Path(text).exists():
        return Path(text), ""
    if channel not in CHANNELS:
        raise InputError(before, "channel", channel, ", ".join(CHANNELS))
    return Path(before), channel


def _bare(path: Path, trajectory: Trajectory) -> Posed:
    return Posed(str(path), trajectory, np.full((len(trajectory), 6, 6), np.nan))


def _of_csv(path: Path) -> Posed:
    """A poses.csv, a smoothed.csv, or rows of `stamp,x,y,z,qx,qy,qz,qw`."""
    head = checks.read_csv(path)[:1]
    words = head[0][1] if head else []
    if words[: len(COLUMNS)] == list(COLUMNS):
        stamps, poses, covariance = read_instants(path)
        return Posed(str(path), Trajectory(stamps, poses, exact=False), covariance)
    if words[:1] == ["stamp_s"]:
        table = read_pose_table(path)
        rows = table.measured
        trajectory = Trajectory(table.stamps[rows], table.base_from_surface[rows], exact=False)
        return _filled(path, Posed(str(path), trajectory, table.covariance[rows]))
    return _bare(path, read_tum(path, exact=False))


def _of_recording(path: Path, channels: tuple[str, ...]) -> Posed:
    for channel in channels:
        found = _truth_of(path) if channel == "truth" else _poses_of(path, READERS[channel])
        if len(found):
            return Posed(f"{path}:{channel}", found.trajectory, found.covariance)
    raise InputError(path, "poses", "none", " or ".join(f"something in /{channel}" for channel in channels))


def _poses_of(path: Path, read: Callable[[Path], Iterator[SurfacePose]]) -> Posed:
    """Measured poses in order of stamp, each once."""
    found: dict[float, SurfacePose] = {}
    for pose in read(path):
        if np.isfinite(pose.base_from_surface).all() and pose.state.measured:
            found[pose.stamp] = pose
    poses = [found[stamp] for stamp in sorted(found)]
    placed = np.array([pose.base_from_surface for pose in poses]).reshape(-1, 4, 4)
    spread = np.array([pose.covariance for pose in poses]).reshape(-1, 6, 6)
    return Posed(str(path), Trajectory(np.array([pose.stamp for pose in poses]), placed, exact=False), spread)


def _truth_of(path: Path) -> Posed:
    truth = open_session(path).truth
    return _bare(path, Trajectory(np.zeros(0), np.zeros((0, 4, 4)), exact=False) if truth is None else truth)


def _filled(path: Path, posed: Posed) -> Posed:
    if not len(posed):
        raise InputError(path, "poses", "none that was measured", "one or more")
    return posed
