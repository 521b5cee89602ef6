"""Pieces of pictures that show skin and no wound: what a segmenter should keep silent about."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from perception.training.dataset import Labelled

SIDES = (96, 224)  # px: less shows nothing, more nearly always holds the wound
MARGIN = 12  # px between a piece and the wound: its inflamed rim is no healthy skin
SKIN = 0.6  # share of a piece that must have skin's colour
TRIES = 40  # places tried in each picture


def healthy_pieces(pictures: Sequence[Labelled], rng: np.random.Generator, count: int) -> list[NDArray[np.uint8]]:
    """Up to `count` pieces (H, W, 3) uint8 RGB, one of each picture at most, in random order."""
    found: list[NDArray[np.uint8]] = []
    for number in rng.permutation(len(pictures)).tolist():
        piece = _piece(pictures[number], rng)
        if piece is not None:
            found.append(piece)
        if len(found) == count:
            break
    return found


def _piece(labelled: Labelled, rng: np.random.Generator) -> NDArray[np.uint8] | None:
    rows, columns = labelled.wound.shape
    kernel = np.ones((2 * MARGIN + 1, 2 * MARGIN + 1), np.uint8)
    near = cv2.dilate(labelled.wound.astype(np.uint8), kernel)
    coloured = skin(labelled.picture)
    for _ in range(TRIES):
        side = int(min(rng.integers(SIDES[0], SIDES[1] + 1), rows, columns))
        top, left = int(rng.integers(0, rows - side + 1)), int(rng.integers(0, columns - side + 1))
        part = np.s_[top : top + side, left : left + side]
        if not near[part].any() and coloured[part].mean() >= SKIN:
            return np.ascontiguousarray(labelled.picture[part])
    return None


def skin(picture: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """(H, W) whether a pixel has a skin's colour (Chai and Ngan, 1999: Cr and Cb, whatever the brightness)."""
    _, red, blue = cv2.split(cv2.cvtColor(picture, cv2.COLOR_RGB2YCrCb))
    return np.asarray((red >= 133) & (red <= 178) & (blue >= 77) & (blue <= 130))
