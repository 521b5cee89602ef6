"""What is wrong with a frame: nothing new, nothing to see, or nothing at all."""

from __future__ import annotations

import math
from enum import Enum

import numpy as np

from perception.frames import Image
from perception.freshness import Freshness

SPARSE = 8  # rows and columns of which one is looked at
DARK = 20  # grey level: a covered sensor's noise stays below, and limited-range black is 16
LIT = 0.01  # share of pixels that are brighter, from which a picture shows something


class Fault(Enum):
    """Why a frame is not given out, in words that follow a camera's name."""

    DAMAGED = "sends pictures that cannot be decoded"
    WRONG_SIZE = "sends pictures of another size"
    DUPLICATED = "sends the same stamp again"
    BACKLOG = "sends what had been held up"
    FROZEN = "shows the same picture again"
    BLACK = "shows black"


class FrameWatch:
    """Looks at one camera's frames. size: (W, H) px that they must have; None: any."""

    def __init__(self, size: tuple[int, int] | None) -> None:
        self._size, self._fresh, self._position = size, Freshness(), math.nan

    def repeats(self, position: float) -> bool:
        """Whether the source tells the same instant (s; nan: none) for a frame as for the last one."""
        same, self._position = position == self._position, position
        return same

    def fault(self, image: Image | None) -> Fault | None:
        """What is wrong with an image (H, W) or (H, W, 3); black comes before frozen, as a covered lens shows both."""
        if image is None or not image.size:
            return Fault.DAMAGED
        if self._size is not None and image.shape[1::-1] != self._size:
            return Fault.WRONG_SIZE
        new = self._fresh(0, image)
        if is_black(image):
            return Fault.BLACK
        return None if new else Fault.FROZEN


def is_black(image: Image) -> bool:
    """Whether an image (H, W) or (H, W, 3) shows nothing but the dark."""
    sample = image[::SPARSE, ::SPARSE]
    return bool(np.count_nonzero(sample >= DARK) <= LIT * sample.size)
