"""Takes the live pictures where the images are: offered all frame sets, made a few times a second while somebody looks.

Offering costs a comparison or two; small JPEGs are made in a thread of their own, with OpenCV's calls outside of
Python's lock, and what comes while it is at work is dropped.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from threading import Condition, Thread

import numpy as np

from estimation.errors import InputError
from estimation.se3 import Array
from hardware.clock import Clock, WallClock
from hardware.images import small_jpeg
from hardware.newest import Newest
from hardware.operator.pictures import CameraPicture, Pictures
from hardware.operator.request import RequestLine
from perception.frames import Image

WIDTH = 640  # px: three side by side fill a screen
QUALITY = 75  # 35 kB each; the path's edges are drawn by the browser and do not suffer
PERIOD = 0.2  # s: breathing looks smooth, and 3 % of a core is not missed


@dataclass(frozen=True, slots=True, eq=False)
class Shot:
    """One camera's image (H, W) or (H, W, 3) BGR, which must not change any more, and what CameraPicture says of it."""

    camera: str
    image: Image
    outline: tuple[Array, ...] = ()
    tracks: Array = field(default_factory=lambda: np.zeros((0, 2)))


class PictureTaker:
    """One thread; `made` counts the pictures' instants that were put out, `dropped` those that were not."""

    def __init__(self, pictures: Newest[Pictures], requests: RequestLine, clock: Clock | None = None) -> None:
        self._pictures, self._requests, self._clock = pictures, requests, clock or WallClock()
        self._due = float("-inf")
        self._waiting: tuple[float, Sequence[Shot], Array | None] | None = None
        self._changed, self._ended = Condition(), False
        self.made = self.dropped = 0
        self._thread = Thread(target=self._work, name="live pictures", daemon=True)
        self._thread.start()

    def offer(self, stamp: float, shots: Sequence[Shot], base_from_surface: Array | None = None) -> bool:
        """Whether the shots of one instant (s) will be shown; never waits. base_from_surface: (4, 4) mm then."""
        now = self._clock.now()
        if now < self._due or not self._requests.windows:
            return False
        if not self._changed.acquire(blocking=False):
            return False
        try:
            if self._waiting is not None:
                return False
            self._due = now + PERIOD
            self._waiting = stamp, shots, base_from_surface
            self._changed.notify()
        finally:
            self._changed.release()
        return True

    def close(self) -> None:
        """End the thread."""
        with self._changed:
            self._ended = True
            self._changed.notify()
        self._thread.join()

    def _work(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._ended or self._waiting is not None)
                if self._ended or self._waiting is None:
                    return
                stamp, shots, pose = self._waiting
            self._put(Pictures(stamp, tuple(map(_picture, shots)), pose))
            with self._changed:
                self._waiting = None

    def _put(self, pictures: Pictures) -> None:
        try:
            self._pictures.put(pictures)
            self.made += 1
        except InputError:  # larger than their place: the next ones may be smaller
            self.dropped += 1


def _picture(shot: Shot) -> CameraPicture:
    return CameraPicture(shot.camera, small_jpeg(shot.image, WIDTH, QUALITY), shot.outline, shot.tracks)
