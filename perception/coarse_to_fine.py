"""A wound in two looks of one network: the whole picture made small, then the place found there made larger.

Half the wounds of the training pictures are smaller than 43 px of 512, so that half a pixel at their edge costs
several points of Dice; the second look sees each at a size that does not depend on the camera's distance.
"""

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

Network = Callable[[NDArray[np.float32]], NDArray[np.float32]]  # (1, 3, H, W) RGB in 0..1 -> (1, 1, H, W) logits

# The network halves its input five times.
STEP = 32


@dataclass(frozen=True, slots=True)
class Looks:
    """How the two looks are taken; chosen on pictures that were neither trained on nor judged by."""

    long_side: int = 320  # px of the first look
    window: int = 192  # px, side of the second look; 0: there is none
    share: float = 0.65  # of the window's side that the found place takes
    largest_zoom: float = 3.0  # beyond this the picture holds nothing more
    found: float = 0.3  # probability from which a place of the first look is looked at again
    second_weight: float = 0.75  # of the second look's logits where both looked


def wound_logits(picture: NDArray[np.uint8], network: Network, looks: Looks) -> NDArray[np.float32]:
    """(H, W) logits of "wound" for a picture (H, W, 3) RGB."""
    first = _first_look(picture, network, looks)
    box = _found(first, looks.found) if looks.window else None
    if box is None:
        return first
    rows, columns = window(box, picture.shape[:2], looks)
    second = _look(picture[rows, columns], network, (looks.window, looks.window))
    first[rows, columns] += looks.second_weight * (second - first[rows, columns])
    return first


def window(box: NDArray[np.float64], size: tuple[int, int], looks: Looks) -> tuple[slice, slice]:
    """Rows and columns of the second look at a box [top, left, bottom, right], moved and cut so that it lies inside
    the picture of `size` (H, W)."""
    middle = (box[:2] + box[2:]) / 2
    side = max(np.max(box[2:] - box[:2]) / looks.share, looks.window / looks.largest_zoom)
    spans = []
    for centre, full in zip(middle, size, strict=True):
        length = int(min(round(side), full))
        start = int(np.clip(round(centre - length / 2), 0, full - length))
        spans.append(slice(start, start + length))
    return spans[0], spans[1]


def _first_look(picture: NDArray[np.uint8], network: Network, looks: Looks) -> NDArray[np.float32]:
    scale = min(1.0, looks.long_side / max(picture.shape[:2]))  # a small piece, enlarged, is no whole picture
    height, width = (max(STEP, STEP * round(side * scale / STEP)) for side in picture.shape[:2])
    return _look(picture, network, (height, width))


def _look(picture: NDArray[np.uint8], network: Network, size: tuple[int, int]) -> NDArray[np.float32]:
    """Logits at the picture's own size, seen at `size` (H, W)."""
    shrinks = picture.shape[0] > size[0]
    seen = cv2.resize(picture, size[::-1], interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR)
    planes = np.ascontiguousarray(seen.transpose(2, 0, 1)[None], np.float32) / np.float32(255)
    logits = network(planes)[0, 0]
    return np.asarray(cv2.resize(logits, picture.shape[1::-1], interpolation=cv2.INTER_LINEAR), np.float32)


def _found(logits: NDArray[np.float32], probability: float) -> NDArray[np.float64] | None:
    """Box [top, left, bottom, right] round everything above the probability; None where there is nothing."""
    above = logits > np.log(probability / (1 - probability))
    rows, columns = (np.flatnonzero(above.any(axis)) for axis in (1, 0))
    if len(rows) == 0:
        return None
    return np.array([rows[0], columns[0], rows[-1] + 1, columns[-1] + 1], np.float64)
