"""Where frame sets come from: live cameras, or a recorded session that another process plays into a ring.

The ring is shared memory of a few slots, written in turn; a pipe gives notice of each set. Neither side waits for the
other: the reader takes the newest whole set and counts those that it never took.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from ctypes import c_bool
from dataclasses import dataclass, field, replace
from multiprocessing.connection import Connection
from multiprocessing.sharedctypes import RawArray, RawValue
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from estimation.errors import StillbedError
from estimation.se3 import Array
from hardware.process.clock import WallClock
from perception.frames import Frame, FrameSet, Image, PrintHead, frame_set

if TYPE_CHECKING:
    from hardware.cameras.feed import LiveHealth

RING_SLOTS = 4  # sets: a reader that takes the newest one has 100 ms at 30 fps to copy it, which takes 2
COLOUR_CHANNELS = 3
ENCODED_BYTES_PER_PIXEL = 2  # room for an encoded picture: more than any PNG of a camera's picture takes

Encoded = tuple[str, bytes]  # "png" or "jpeg", and the picture as the camera gave it


class SourceEnded(StillbedError):
    """There will be no more pictures; it says why."""


@dataclass(frozen=True, slots=True, eq=False)
class TimedFrameSet:
    """A frame set as it reaches the tracker."""

    frames: FrameSet
    encoded: Mapping[int, Encoded] = field(default_factory=dict)  # by camera, where the camera gave it so
    handed: float = 0.0  # s, when the newest of its frames was handed over
    source: float = float("nan")  # s, its stamp on the clock of a recorded session; NaN of live cameras
    dropped: int = 0  # sets before it that were not taken


@dataclass(frozen=True, slots=True)
class RingPicture:
    """One picture of a set in the ring."""

    camera: int  # number in the rig
    stamp: float  # s
    shape: tuple[int, ...]  # of its array
    kind: str  # as encoded, "" where it is not there so
    size: int  # bytes as encoded


@dataclass(frozen=True, slots=True)
class SetNotice:
    """The notice that a set is in the ring."""

    count: int  # of the sets so far
    handed: float  # s, when its pixels were there
    source: float  # s, its stamp on the clock of the recorded session
    pictures: tuple[RingPicture, ...]
    head: PrintHead | None  # where the session knows it


class FrameRing:
    """Handed to both processes when they are started; one puts, the other takes."""

    def __init__(self, sizes: Sequence[tuple[int, int]]) -> None:
        """sizes: (W, H) px of each camera."""
        self._pixels = [w * h * COLOUR_CHANNELS for w, h in sizes]
        self._stored = [w * h * ENCODED_BYTES_PER_PIXEL for w, h in sizes]
        self._slot = sum(self._pixels) + sum(self._stored)
        self._memory: Any = RawArray("B", self._slot * RING_SLOTS)
        self._counts: Any = RawArray("Q", RING_SLOTS)
        self.requested = RawValue(c_bool, False)  # whether the reader has begun to ask for frames
        self._count = 0  # of the writer

    def put(self, frames: FrameSet, encoded: dict[int, Encoded], now: Callable[[], float], source: float) -> SetNotice:
        """Write a set over the oldest one; the notice to be sent. now: the clock, read once the pixels are there."""
        self._count += 1
        slot = self._count % RING_SLOTS
        memory = np.frombuffer(self._memory, np.uint8)
        self._counts[slot] = 0
        pictures = []
        for frame in frames.frames:
            start = self._start(slot, frame.camera)
            memory[start : start + frame.image.size] = frame.image.reshape(-1)
            kind, data = encoded.get(frame.camera, ("", b""))
            if len(data) > self._stored[frame.camera]:
                kind, data = "", b""
            start += self._pixels[frame.camera]
            memory[start : start + len(data)] = np.frombuffer(data, np.uint8)
            pictures.append(RingPicture(frame.camera, frame.stamp, frame.image.shape, kind, len(data)))
        self._counts[slot] = self._count
        return SetNotice(self._count, now(), source, tuple(pictures), frames.head)

    def take(self, notice: SetNotice) -> tuple[FrameSet, dict[int, Encoded]] | None:
        """A copy of the set of a notice; None where it is written over already."""
        slot = notice.count % RING_SLOTS
        memory = np.frombuffer(self._memory, np.uint8)

        def copied(picture: RingPicture) -> Frame:
            start = self._start(slot, picture.camera)
            image: Image = memory[start : start + int(np.prod(picture.shape))].reshape(picture.shape).copy()
            return Frame(picture.camera, picture.stamp, image)

        frames = [copied(picture) for picture in notice.pictures]  # side by side it took ten times as long to wake up
        encoded = dict[int, Encoded]()
        for picture in notice.pictures:
            start = self._start(slot, picture.camera) + self._pixels[picture.camera]
            if picture.size:
                encoded[picture.camera] = picture.kind, memory[start : start + picture.size].tobytes()
        frame_set_with_head = replace(frame_set(frames), head=notice.head)
        return (frame_set_with_head, encoded) if self._counts[slot] == notice.count else None

    def _start(self, slot: int, camera: int) -> int:
        return slot * self._slot + sum(self._pixels[:camera]) + sum(self._stored[:camera])


class RingSource:
    """The reader of a ring."""

    def __init__(self, ring: FrameRing, notices: Connection) -> None:
        self._ring, self._notices, self._last = ring, notices, 0

    def take(self, patience: float) -> TimedFrameSet | None:
        """The newest set, waiting `patience` s for one; None where none came. SourceEnded once there will be none."""
        notice = None
        self._ring.requested.value = True
        try:
            if self._notices.poll(patience):
                notice = self._notices.recv()
                while self._notices.poll():
                    notice = self._notices.recv()
        except (EOFError, OSError):
            if notice is None:
                raise SourceEnded("the cameras have ended") from None
        if isinstance(notice, str):
            raise SourceEnded(notice)
        if notice is None or (copies := self._ring.take(notice)) is None:
            return None
        dropped, self._last = notice.count - self._last - 1, notice.count
        return TimedFrameSet(*copies, notice.handed, notice.source, dropped)

    def learn(self, offsets: Array) -> None:
        """Nothing to learn: sets come paired as they were recorded."""

    def close(self) -> None:
        """Close the pipe, which the writer notices."""
        self._notices.close()


class LiveCameraSource:
    """The newest frame set of the cameras in a rig.toml. rig: their calibration."""

    def __init__(self, file: Path) -> None:
        from hardware.cameras.live import LiveCameras
        from hardware.cameras.sources import read_live_rig

        self.rig, sources = read_live_rig(file)
        self._clock = WallClock()
        self._cameras = LiveCameras(self.rig, sources, self._clock)
        self._cameras.start()
        self._passed = 0

    def take(self, patience: float) -> TimedFrameSet | None:
        """The newest set, waiting `patience` s for one; None where none came. SourceEnded once all have ended."""
        until = self._clock.now() + patience
        frames = self._cameras.next_set(until)
        now = self._clock.now()
        if frames is None:
            if now < until:  # it did not wait: there is nothing to wait for
                raise SourceEnded("all have ended")
            return None
        passed = self._cameras.health().passed_over
        dropped, self._passed = passed - self._passed, passed
        return TimedFrameSet(frames, handed=now, dropped=dropped)

    def health(self) -> LiveHealth:
        """The state of every camera now."""
        return self._cameras.health()

    def learn(self, offsets: Array) -> None:
        """Pair frames as the cameras really expose: (C,) s later than their sets are stamped."""
        self._cameras.learn(offsets)

    def close(self) -> None:
        """Let the cameras go."""
        self._cameras.close()


FrameSource = RingSource | LiveCameraSource
