"""Frame sets from the process of the cameras to that of the tracker: pixels in shared memory, word of them by a pipe.

Neither side waits for the other: what is written goes round a few slots, the reader takes the newest whole one and
counts those that it never saw.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from multiprocessing.connection import Connection
from multiprocessing.sharedctypes import RawArray
from typing import Any

import numpy as np

from estimation.se3 import Array
from hardware.live.arrived import Arrived, Encoded, SourceEnded
from perception.frames import Frame, FrameSet, Image, PrintHead
from perception.pairing import frame_set
from perception.side_by_side import side_by_side

SLOTS = 4  # sets: a reader that takes the newest one has 100 ms at 30 fps to copy it, which takes 2
COLOURS = 3
STORED = 2  # bytes a pixel that an encoded picture may take: more than any PNG of a camera's picture


@dataclass(frozen=True, slots=True)
class Part:
    """One picture of a set. camera: number in the rig. stamp: s. shape: of its array. kind, size: as encoded."""

    camera: int
    stamp: float
    shape: tuple[int, ...]
    kind: str
    size: int


@dataclass(frozen=True, slots=True)
class Word:
    """What is said of a set. count: of the sets so far. handed: s, when its pixels were there. source: s, its stamp on
    the clock of a recorded session, where it is of one. head: where the print head was, where the session knows.
    """

    count: int
    handed: float
    source: float
    parts: tuple[Part, ...]
    head: PrintHead | None


class FrameRing:
    """Handed to both processes when they are started; one puts, the other takes."""

    def __init__(self, sizes: Sequence[tuple[int, int]]) -> None:
        """sizes: (W, H) px of each camera."""
        self._pixels = [w * h * COLOURS for w, h in sizes]
        self._stored = [w * h * STORED for w, h in sizes]
        self._slot = sum(self._pixels) + sum(self._stored)
        self._memory: Any = RawArray("B", self._slot * SLOTS)
        self._counts: Any = RawArray("Q", SLOTS)
        self._wanted: Any = RawArray("B", 1)
        self._count = 0  # of the writer

    def put(self, frames: FrameSet, encoded: dict[int, Encoded], now: Callable[[], float], source: float) -> Word:
        """Write a set over the oldest one; what is to be told of it. now: asked once the pixels are there, s."""
        self._count += 1
        slot = self._count % SLOTS
        memory = np.frombuffer(self._memory, np.uint8)
        self._counts[slot] = 0
        parts = []
        for frame in frames.frames:
            start = self._start(slot, frame.camera)
            memory[start : start + frame.image.size] = frame.image.reshape(-1)
            kind, data = encoded.get(frame.camera, ("", b""))
            if len(data) > self._stored[frame.camera]:
                kind, data = "", b""
            start += self._pixels[frame.camera]
            memory[start : start + len(data)] = np.frombuffer(data, np.uint8)
            parts.append(Part(frame.camera, frame.stamp, frame.image.shape, kind, len(data)))
        self._counts[slot] = self._count
        return Word(self._count, now(), source, tuple(parts), frames.head)

    def take(self, word: Word) -> tuple[FrameSet, dict[int, Encoded]] | None:
        """A copy of a set that was told of; None where it is written over already."""
        slot = word.count % SLOTS
        memory = np.frombuffer(self._memory, np.uint8)

        def copied(part: Part) -> Frame:
            start = self._start(slot, part.camera)
            image: Image = memory[start : start + int(np.prod(part.shape))].reshape(part.shape).copy()
            return Frame(part.camera, part.stamp, image)

        frames, encoded = side_by_side(copied, word.parts), dict[int, Encoded]()
        for part in word.parts:
            start = self._start(slot, part.camera) + self._pixels[part.camera]
            if part.size:
                encoded[part.camera] = part.kind, memory[start : start + part.size].tobytes()
        whole = replace(frame_set(frames), head=word.head)
        return (whole, encoded) if self._counts[slot] == word.count else None

    @property
    def wanted(self) -> bool:
        """Whether somebody has begun to ask for frames."""
        return bool(self._wanted[0])

    def want(self) -> None:
        """Let the other side know that frames are asked for."""
        self._wanted[0] = 1

    def _start(self, slot: int, camera: int) -> int:
        before = sum(self._pixels[:camera]) + sum(self._stored[:camera])
        return slot * self._slot + before


class RingSource:
    """The reading end: the newest set each time it is asked."""

    def __init__(self, ring: FrameRing, words: Connection) -> None:
        self._ring, self._words, self._last = ring, words, 0

    def take(self, patience: float) -> Arrived | None:
        """The newest set, waiting `patience` s for one; None where none came. SourceEnded once there will be none."""
        word = None
        self._ring.want()
        try:
            if self._words.poll(patience):
                word = self._words.recv()
                while self._words.poll():
                    word = self._words.recv()
        except (EOFError, OSError):
            if word is None:
                raise SourceEnded("the cameras have ended") from None
        if isinstance(word, str):
            raise SourceEnded(word)
        if word is None or (taken := self._ring.take(word)) is None:
            return None
        dropped, self._last = word.count - self._last - 1, word.count
        return Arrived(taken[0], taken[1], word.handed, word.source, dropped)

    def learn(self, offsets: Array) -> None:
        """Sets come paired as they were recorded."""

    def close(self) -> None:
        """Let the other end know that nobody listens."""
        self._words.close()
