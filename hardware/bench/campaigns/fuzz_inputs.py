"""Readers whose input is one file of several in a folder, or that stillbed wrote itself, each with valid input."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from estimation import se3
from estimation.batch.smoothed import Instants
from estimation.synthetic.arc_rig import REST, arc_rig
from hardware.bench.mjpeg_avi import mjpeg_avi
from hardware.calibration.corners import read_corners, write_corners
from hardware.comparing.posed import read_posed
from hardware.files.folder_tables import read_heads, write_heads
from hardware.files.images import encode
from hardware.files.rig_file import ImageSource, write_rig
from hardware.files.session import open_session
from hardware.heads import Heads
from hardware.offline.trajectory_files import write_instants
from perception.boards.collection import CornerTable

SMALL, RATE = (48, 32), 30  # px, Hz
FRAMES = 3
KEY = "0123456789abcdef" * 4  # of the recording that corners were found in


def make_videos(folder: Path) -> None:
    """A session whose cameras' pictures are videos."""
    rig = arc_rig(size=SMALL, focal=40)
    names = [camera.name for camera in rig.cameras]
    write_rig(folder / "rig.toml", rig, [ImageSource("video", f"{name}.avi") for name in names])
    lines = ["camera,frame,stamp_s"]
    for name in names:
        pictures = [encode(_picture(k), 90)[1] for k in range(FRAMES)]
        (folder / f"{name}.avi").write_bytes(mjpeg_avi(pictures, SMALL, RATE))
        lines += [f"{name},{k},{k / RATE!r}" for k in range(FRAMES)]
    (folder / "frames.csv").write_text("\n".join(lines) + "\n")


def whole_session(path: Path) -> object:
    """The session in the folder of `path`, its frame sets decoded."""
    return [frames.stamp for frames in open_session(path.parent).frame_sets()]


def make_heads(folder: Path) -> None:
    """head.csv."""
    rows = np.array([[k / RATE, 1.0, 2.0, 300.0 + k, 0, 0, 0, 1] for k in range(FRAMES)])
    write_heads(folder / "head.csv", Heads(rows, np.array([False, True, True])))


def make_corners(folder: Path) -> None:
    """corners.npz of a camera calibration."""
    count, whole = 4, np.zeros(2, np.int64)
    pixels = np.random.default_rng(1).uniform(0, 48, (2, count, 2))
    ones, instants = np.ones(2), np.arange(2)
    told = CornerTable(whole, instants, instants / RATE, pixels, ones, ones, ones, whole, whole[:0], 2)
    write_corners(folder / "corners.npz", KEY, told)


def corners(path: Path) -> object:
    """The corners in a file; whatever else it holds is as if there were none."""
    return read_corners(path, KEY)


def make_smoothed(folder: Path) -> None:
    """smoothed.csv."""
    stamps = np.arange(FRAMES) / RATE
    spread = np.broadcast_to(np.eye(6) * 1e-4, (FRAMES, 6, 6))
    poses = REST @ se3.exp(np.outer(stamps, [0.1, 0, 0, 0, 0, 1.0]))
    write_instants(folder / "smoothed.csv", Instants(stamps, poses, spread, np.zeros((FRAMES, 6)), spread))


def trajectory(path: Path) -> object:
    """The trajectory in a file, as `stillbed compare` reads it."""
    return read_posed(str(path))


def make_trajectory(folder: Path) -> None:
    """Rows of stamp, place and quaternion with commas."""
    (folder / "x.csv").write_text("".join(f"{k / RATE},1,2,{300 + k},0,0,0,1\n" for k in range(FRAMES)))


def _picture(number: int) -> np.ndarray[tuple[int, ...], np.dtype[np.uint8]]:
    return np.random.default_rng(number).integers(0, 256, (SMALL[1], SMALL[0], 3), np.uint8)


Entry = tuple[str, Callable[[Path], None], Callable[[Path], object]]
FOLDERS: dict[str, Entry] = {  # the file that is struck, who makes it, who reads it
    "video": ("cam_0.avi", make_videos, whole_session),
    "print head": ("head.csv", make_heads, read_heads),
    "corners": ("corners.npz", make_corners, corners),
    "smoothed": ("smoothed.csv", make_smoothed, trajectory),
    "trajectory": ("x.csv", make_trajectory, trajectory),
}
