"""Writes a session folder, as its pictures come."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import TextIO

from estimation.rig import Rig
from estimation.se3 import Array
from estimation.trajectory import Trajectory
from hardware.files.folder_tables import frame_line, head_line, write_frames, write_heads, write_roi
from hardware.files.rig_file import ImageSource, write_rig
from hardware.files.session import FrameRef
from hardware.heads import NO_HEADS
from hardware.tum import write_tum
from perception.frames import Roi

SUFFIX = {"png": ".png", "jpeg": ".jpg"}


class SessionFolder:
    """A session folder in the making; readable at every instant, whole once the context ends."""

    def __init__(self, folder: Path, rig: Rig, rois: Sequence[Roi]) -> None:
        """folder: made if it is not there. rois: where the surface is in the first picture of each camera."""
        self.folder, self._rig = folder, rig
        self._counts = [0] * len(rig)
        self._truth: Trajectory | None = None
        self._heads: TextIO | None = None  # a session without an arm has no such file
        for camera in rig.cameras:
            (folder / camera.name).mkdir(parents=True, exist_ok=True)
        write_rig(folder / "rig.toml", rig, [ImageSource("images", f"{c.name}/*") for c in rig.cameras])
        if rois:
            write_roi(folder / "roi.toml", rig, rois, [0] * len(rois))
        write_frames(folder / "frames.csv", rig, [])
        self._frames = (folder / "frames.csv").open("a", encoding="utf-8")

    def picture(self, camera: int, stamp: float, kind: str, data: bytes) -> None:
        """An encoded picture ("png" or "jpeg") of a camera at `stamp`, s; stamps of a camera rise."""
        number, name = self._counts[camera], self._rig.cameras[camera].name
        (self.folder / name / f"{number:06d}{SUFFIX[kind]}").write_bytes(data)
        self._frames.write(frame_line(self._rig, FrameRef(camera, number, stamp, stamp)))
        self._frames.flush()
        self._counts[camera] += 1

    def head_row(self, row: Array, extruding: bool) -> None:
        """Where the print head was at a frame set: (8,) stamp x y z qx qy qz qw, s and mm; stamps rise."""
        if self._heads is None:
            write_heads(self.folder / "head.csv", NO_HEADS)
            self._heads = (self.folder / "head.csv").open("a", encoding="utf-8")
        self._heads.write(head_line(row, extruding))
        self._heads.flush()

    def truth(self, trajectory: Trajectory) -> None:
        """The exact poses, written when the folder is closed."""
        self._truth = trajectory

    def __enter__(self) -> SessionFolder:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, tb: TracebackType | None) -> None:
        self._frames.close()
        if self._heads is not None:
            self._heads.close()
        if self._truth is not None:
            write_tum(self.folder / "truth.tum", self._truth)
