"""A recorded session: its rig, its images by stamp, and what else was recorded: truth, scan, print head."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from estimation import se3
from estimation.errors import InputError
from estimation.pose import Trajectory
from estimation.rig import Rig
from estimation.se3 import Array
from perception.frames import Frame, FrameSet, Image, PrintHead, Roi, frame_period, frame_set, pair, pairing_tolerance

SURFACE_SUFFIXES = (".ply", ".stl", ".obj")  # of a scan in a session folder; other formats are for planning
HEAD_STAMP_TOLERANCE = 0.002  # s from a row to its frame set: the rounding of stamps, far below a frame's period


@dataclass(frozen=True, slots=True, eq=False)
class PrintHeadLog:
    """The print head at each of N frame sets of a session with an arm, in order of stamp, as stored."""

    rows: Array  # (N, 8) stamp x y z qx qy qz qw of base_from_nozzle, s and mm
    extruding: NDArray[np.bool_]  # (N,) whether ink flowed

    def __len__(self) -> int:
        return len(self.rows)

    def at(self, stamp: float) -> PrintHead | None:
        """The head of the frame set at `stamp`, s; None without a row within HEAD_STAMP_TOLERANCE of it."""
        if not len(self):
            return None
        after = int(np.searchsorted(self.rows[:, 0], stamp))
        index = min({max(after - 1, 0), min(after, len(self) - 1)}, key=lambda i: abs(float(self.rows[i, 0]) - stamp))
        if abs(self.rows[index, 0] - stamp) > HEAD_STAMP_TOLERANCE:
            return None
        return head_from_row(self.rows[index], bool(self.extruding[index]))


NO_PRINT_HEADS = PrintHeadLog(np.empty((0, 8)), np.empty(0, bool))


def head_from_row(row: Array | Sequence[float], extruding: bool) -> PrintHead:
    """The print head in a row (8,) of stamp x y z qx qy qz qw, s and mm."""
    return PrintHead(se3.make(se3.rotation_from_quaternion(row[4:]), row[1:4]), extruding)


def row_from_head(stamp: float, head: PrintHead) -> Array:
    """The row (8,) of stamp x y z qx qy qz qw, s and mm, that holds a print head."""
    nozzle = head.base_from_nozzle
    return np.array([stamp, *nozzle[:3, 3], *se3.quaternion_from_rotation(nozzle[:3, :3])])


@dataclass(frozen=True, slots=True)
class FrameRef:
    """One stored image."""

    camera: int
    number: int  # among its camera's images, from 0
    camera_stamp: float  # s, on the camera's own clock, as stored
    stamp: float  # s, with the camera's clock offset added


class FrameReader(Protocol):
    """Decodes images; those of one camera must be read in rising order."""

    def read(self, ref: FrameRef) -> Image:
        """The image; InputError where it is missing, undecodable or not of the camera's size."""

    def encoded(self, ref: FrameRef) -> tuple[str, bytes] | None:
        """Format ("png" or "jpeg") and bytes of the image as stored; None for a frame of a video."""

    def close(self) -> None:
        """Close files and decoders."""


@dataclass(frozen=True, slots=True, eq=False)
class Session:
    """A recorded session; everything in it is checked but the decoding of its images."""

    path: Path
    rig: Rig
    roi: tuple[Roi, ...]  # where the surface is at the start
    surface: Path | None  # the scan's file, mm; of an MCAP file a copy that lives as long as the session
    truth: Trajectory | None  # base_from_surface; `exact`: a truth, else a measured reference
    sets: tuple[tuple[FrameRef, ...], ...]  # the images of one instant each, in order of stamp
    open_reader: Callable[[], FrameReader]  # each call gives a new reader, at the beginning
    damage: str = ""  # which part of the file could not be read, "" if none
    heads: PrintHeadLog = NO_PRINT_HEADS
    began: int | None = None  # ns since 1970, UTC, at stamp 0; None where nobody knows it

    def __len__(self) -> int:
        return len(self.sets)

    def frame_sets(self) -> Iterator[FrameSet]:
        """The frame sets in order of stamp on the cameras' common clock, decoded one by one.

        InputError at the first image that is missing or undecodable.
        """
        reader = self.open_reader()
        try:
            for refs in self.sets:
                frames = frame_set([Frame(ref.camera, ref.stamp, reader.read(ref)) for ref in refs])
                yield replace(frames, head=self.heads.at(frames.stamp))
        finally:
            reader.close()


def check_exists(path: Path) -> None:
    """InputError where there is no such session: known before what reads it is loaded."""
    if not path.exists():
        raise InputError(path, "session", "no such file or folder", "a session folder (with rig.toml) or an .mcap file")
    if path.is_file() and (path.parent / "rig.toml").is_file() and path.suffix.lower() != ".mcap":
        raise InputError(path, "session", "a file of a session folder", f"the folder: {path.parent}")


def damage_text(damage: str) -> str:
    """A session's damage as a sentence; "" where there is none."""
    return f"The recording is damaged: {damage}." if damage else ""


def common_stamps(rig: Rig, stamps: Sequence[Array]) -> list[Array]:
    """Each camera's stamps (N,), s, with its clock offset added."""
    return [s + c.clock_offset for s, c in zip(stamps, rig.cameras, strict=True)]


def frame_refs(rig: Rig, stamps: Sequence[Array]) -> tuple[tuple[FrameRef, ...], ...]:
    """The frame sets of images with the rising stamps (N,), s, of each camera's own clock."""
    common = common_stamps(rig, stamps)
    refs = [
        FrameRef(camera, number, float(stamps[camera][number]), float(stamp))
        for camera, times in enumerate(common)
        for number, stamp in enumerate(times)
    ]
    return pair_refs(refs, common, len(rig))


def pair_refs(refs: Sequence[FrameRef], stamps: Sequence[Array], cameras: int) -> tuple[tuple[FrameRef, ...], ...]:
    """Sets of refs by stamp; stamps: one (N,) array per camera, s, on the common clock."""
    tolerance = pairing_tolerance(frame_period(stamps))
    return tuple(pair(sorted(refs, key=lambda r: (r.stamp, r.camera)), tolerance, cameras))
