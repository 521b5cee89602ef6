"""A recorded session: rig, images by stamp, and what is known beside them; one reader for both containers."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Protocol

from estimation.errors import InputError
from estimation.rig import Rig
from estimation.se3 import Array
from estimation.trajectory import Trajectory
from hardware.heads import NO_HEADS, Heads
from perception.frames import Frame, FrameSet, Image, Roi
from perception.pairing import frame_period, frame_set, pair, pairing_tolerance

SURFACE_SUFFIXES = (".ply", ".stl", ".obj")


@dataclass(frozen=True, slots=True)
class FrameRef:
    """One image that is stored somewhere. number: its place among its camera's images, from 0.

    camera_stamp: s, on the camera's own clock, as stored. stamp: s, with the camera's clock offset added.
    """

    camera: int
    number: int
    camera_stamp: float
    stamp: float


class FrameReader(Protocol):
    """Decodes images; asked for each camera's in rising order."""

    def read(self, ref: FrameRef) -> Image:
        """The image; InputError where it is missing, undecodable or not of the camera's size."""
        ...

    def encoded(self, ref: FrameRef) -> tuple[str, bytes] | None:
        """Format ("png" or "jpeg") and bytes of the image as stored, None where it is not stored as a picture."""
        ...

    def close(self) -> None:
        """Give files and decoders back."""
        ...


class FrameStore(Protocol):
    """Where a session's images are."""

    def open(self) -> FrameReader:
        """A reader of its own, at the beginning."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class Session:
    """A recorded session, checked as far as that goes without decoding every image.

    rig: the cameras. roi: where the surface is at the start. surface: the scan's file (mm) or None (of an MCAP a copy
    that lives as long as the session). truth: base_from_surface or None; `truth.exact` tells truth.tum from
    reference.tum. sets: what belongs to one instant, in order of stamp. damage: what was lost of the file, "" if
    nothing; all that is here was read whole. heads: where the print head was, of the sets that had one.
    """

    path: Path
    rig: Rig
    roi: tuple[Roi, ...]
    surface: Path | None
    truth: Trajectory | None
    sets: tuple[tuple[FrameRef, ...], ...]
    store: FrameStore
    damage: str = ""
    heads: Heads = NO_HEADS

    def __len__(self) -> int:
        return len(self.sets)

    def frame_sets(self) -> Iterator[FrameSet]:
        """The frame sets in order of stamp, each decoded when it is asked for; stamps are on the cameras' common clock.

        InputError where an image turns out to be missing or undecodable; the sets before it have been given out.
        """
        reader = self.store.open()
        try:
            for refs in self.sets:
                frames = frame_set([Frame(ref.camera, ref.stamp, reader.read(ref)) for ref in refs])
                yield replace(frames, head=self.heads.at(frames.stamp))
        finally:
            reader.close()


def damage_told(damage: str) -> str:
    """A session's damage as a sentence; "" where there is none."""
    return f"The recording is damaged: {damage}." if damage else ""


def open_session(path: str | Path) -> Session:
    """Open a session folder or an .mcap file; InputError says what is wrong with it."""
    path = Path(path)
    if path.is_dir():
        from hardware.files.session_folder import (
            open_folder,  # each container's libraries are loaded only for its own files
        )

        return open_folder(path)
    if not path.exists():
        raise InputError(path, "session", "no such file or folder", "a session folder (with rig.toml) or an .mcap file")
    from hardware.recording.session_reader import open_recording

    return open_recording(path)


def common_stamps(rig: Rig, stamps: Sequence[Array]) -> list[Array]:
    """Each camera's stamps (N,), s, with its clock offset added."""
    return [s + c.clock_offset for s, c in zip(stamps, rig.cameras, strict=True)]


def frame_refs(rig: Rig, stamps: Sequence[Array]) -> tuple[tuple[FrameRef, ...], ...]:
    """The sets that images of each camera, stored with the rising stamps (N,), s, of its own clock, belong to."""
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
