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
from hardware.files.images import small_jpeg
from hardware.operator.pictures import CameraPicture, Pictures
from hardware.operator.shared_state import RequestLine
from hardware.process.clock import Clock, WallClock
from hardware.process.shared_latest import Newest
from perception.frames import Image

WIDTH = 640  # px: three side by side fill a screen
QUALITY = 75  # 35 kB each; the path's edges are drawn by the browser and do not suffer
NEAR_WIDTH = 480  # px, of the part around the wound: seldom more than the camera has there
MARGIN = 1.4  # of that part over what was found: breathing stays inside
FEWEST = 8  # points that say where the wound is
PERIOD = 0.2  # s: breathing looks smooth, and 3 % of a core is not missed

Crop = tuple[int, int, int, int]  # x, y, width, height px


@dataclass(frozen=True, slots=True, eq=False)
class Shot:
    """One camera's image (H, W) or (H, W, 3) BGR, which must not change any more, and what CameraPicture says of it."""

    camera: str
    image: Image
    outline: tuple[Array, ...] = ()
    tracks: Array = field(default_factory=lambda: np.zeros((0, 2)))


class PictureTaker:
    """One thread; `made` counts the pictures' instants that were put out, `dropped` those that were not."""

    def __init__(
        self, pictures: Newest[Pictures], requests: RequestLine, clock: Clock | None = None, near: bool = True
    ) -> None:
        """near: whether the part around what was found is shown as well."""
        self._pictures, self._requests, self._clock, self._near = pictures, requests, clock or WallClock(), near
        self._due = float("-inf")
        self._crops: dict[str, Crop] = {}
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
            self._put(Pictures(stamp, tuple(map(self._picture, shots)), pose))
            with self._changed:
                self._waiting = None

    def _put(self, pictures: Pictures) -> None:
        try:
            self._pictures.put(pictures)
            self.made += 1
        except InputError:  # larger than their place: the next ones may be smaller
            self.dropped += 1

    def _picture(self, shot: Shot) -> CameraPicture:
        crop = crop_around(shot, self._crops.get(shot.camera)) if self._near else None
        whole, near = small_jpeg(shot.image, WIDTH, QUALITY), b""
        if crop is not None:
            self._crops[shot.camera] = crop
            x, y, width, height = crop
            near = small_jpeg(shot.image[y : y + height, x : x + width], NEAR_WIDTH, QUALITY)
        return CameraPicture(shot.camera, whole, shot.outline, shot.tracks, near, crop)


def crop_around(shot: Shot, present: Crop | None) -> Crop | None:
    """The part of an image around outline and tracks, of its own proportions; None where that is all of it.

    present: what was shown before; it stays while all is in it and not much less would do, so that the view rests.
    """
    found = np.concatenate([*shot.outline, shot.tracks])
    if len(found) < FEWEST:
        return present
    low, high = np.percentile(found, [2, 98], axis=0)  # single tracks may lie anywhere
    height, width = shot.image.shape[:2]
    wanted = MARGIN * max(high[0] - low[0], (high[1] - low[1]) * width / height, width / 8)
    if present is not None and wanted > present[2] / 2 and _holds(present, low, high):
        return present
    if wanted >= width:
        return None
    size = np.array([round(wanted), round(wanted * height / width)])
    corner = np.clip(np.round((low + high - size) / 2), 0, [width, height] - size).astype(int)
    return int(corner[0]), int(corner[1]), int(size[0]), int(size[1])


def _holds(crop: Crop, low: Array, high: Array) -> bool:
    corner, size = np.array(crop[:2]), np.array(crop[2:])
    return bool((low >= corner).all() and (high <= corner + size).all())
