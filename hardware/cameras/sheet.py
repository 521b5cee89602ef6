"""What a camera shows: how sharp and how bright, and all cameras on one sheet (owns cv2 for it)."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from perception.frames import Image

CELL = (640, 360)  # px, width and height of a camera's picture on the sheet
LINE = 26  # px, height of a line of words
COLUMNS = 2
FULL = 250  # grey level from which a pixel is blown out
PAPER, INK, ALARM = (32, 32, 32), (235, 235, 235), (80, 80, 255)


def sharpness(image: Image) -> float:
    """Variance of the Laplacian (Pech-Pacheco 2000) of an (H, W) or (H, W, 3) BGR image; to be compared with itself."""
    return float(cv2.Laplacian(_grey(image), cv2.CV_32F).var())


def brightness(image: Image) -> tuple[float, float]:
    """Mean grey level, and the share of pixels that are blown out, of an (H, W) or (H, W, 3) BGR image."""
    grey = _grey(image)
    return float(grey.mean()), float((grey >= FULL).mean())


def sheet(shown: Sequence[tuple[Image | None, Sequence[str], bool]]) -> Image:
    """(H, W, 3) BGR: a cell each of a picture (None: there is none), the words below it, and whether all is well."""
    lines = max(len(words) for _, words, _ in shown)
    cells = [_cell(image, words, well, lines) for image, words, well in shown]
    columns = min(COLUMNS, len(cells))
    empty = np.full_like(cells[0], PAPER)
    rows = [cells[i : i + columns] for i in range(0, len(cells), columns)]
    return np.vstack([np.hstack([*row, *[empty] * (columns - len(row))]) for row in rows])


def _cell(image: Image | None, words: Sequence[str], well: bool, lines: int) -> Image:
    cell = np.full((CELL[1] + lines * LINE + LINE // 2, CELL[0], 3), PAPER, np.uint8)
    if image is not None:
        scale = min(CELL[0] / image.shape[1], CELL[1] / image.shape[0])
        size = (max(1, round(scale * image.shape[1])), max(1, round(scale * image.shape[0])))
        small = cv2.resize(_colour(image), size, interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR)
        x, y = (CELL[0] - size[0]) // 2, (CELL[1] - size[1]) // 2
        cell[y : y + size[1], x : x + size[0]] = small
    for i, line in enumerate(words):
        place = (8, CELL[1] + LINE * (i + 1) - LINE // 4)
        cv2.putText(cell, line, place, cv2.FONT_HERSHEY_SIMPLEX, 0.5, INK if well else ALARM, 1, cv2.LINE_AA)
    return cell


def _grey(image: Image) -> Image:
    return image if image.ndim == 2 else np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), np.uint8)


def _colour(image: Image) -> Image:
    return image if image.ndim == 3 else np.asarray(cv2.cvtColor(image, cv2.COLOR_GRAY2BGR), np.uint8)
