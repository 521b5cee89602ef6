"""Faults of cameras and of the tracking, on frame sets that have been taken already: of a recording, or of a feed."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace

import numpy as np

from estimation.errors import InputError
from estimation.rig import Rig
from hardware.process.faults import Fault, Kind, Part, struck
from perception.frames import Frame, FrameSet, Image


class FrameFaults:
    """What cameras deliver of one frame set after the other, in order."""

    def __init__(self, faults: Sequence[Fault], rig: Rig, where: object) -> None:
        """InputError where cables are exchanged between cameras whose pictures differ in size."""
        self._faults, self._count = struck(faults, Part.CAMERA), len(rig)
        self._last: dict[int, Image] = {}  # of each camera, before it stuck
        for fault in struck(self._faults, Part.CAMERA, Kind.SWAP):
            sizes = [rig.cameras[camera].size for camera in self._pair(fault)]
            if sizes[0] != sizes[1]:
                raise InputError(where, "--fault", str(fault), "cameras whose pictures are of one size")

    def __call__(self, frames: FrameSet, instant: float) -> FrameSet:
        """The set as it comes at `instant`, s; frames may be missing from it."""
        images = {frame.camera: frame.image for frame in frames.frames}
        for fault in self._faults:
            if fault.kind is Kind.SWAP and fault.covers(instant):
                one, other = self._pair(fault)
                if one in images and other in images:
                    images[one], images[other] = images[other], images[one]
        found = [self._one(frame, images[frame.camera], instant) for frame in frames.frames]
        return replace(frames, frames=tuple(frame for frame in found if frame is not None))

    def _pair(self, fault: Fault) -> tuple[int, int]:
        return fault.number, (fault.number + 1) % self._count

    def _one(self, frame: Frame, image: Image, instant: float) -> Frame | None:
        kinds = {fault.kind for fault in self._faults if fault.number == frame.camera and fault.covers(instant)}
        if Kind.OFF in kinds:
            return None
        if Kind.STUCK in kinds:
            return replace(frame, image=self._last.setdefault(frame.camera, image))
        self._last[frame.camera] = image
        if Kind.BLACK in kinds:
            image = np.zeros_like(image)
        elif Kind.FLASH in kinds:
            image = np.full_like(image, 255)
        return frame if image is frame.image else replace(frame, image=image)


def tracked_sets(sets: Iterable[FrameSet], faults: Sequence[Fault], rig: Rig, where: object) -> Iterator[FrameSet]:
    """The sets of a recording that a tracking with faults gets to see; instants count from the first set's stamp."""
    spoil, idle, start = FrameFaults(faults, rig, where), struck(faults, Part.TRACKING), None
    for frames in sets:
        start = frames.stamp if start is None else start
        spoilt = spoil(frames, frames.stamp - start)
        if spoilt.frames and not any(fault.covers(frames.stamp - start) for fault in idle):
            yield spoilt
