"""The best, the median and the worst of many segmented pictures on one sheet."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from perception.dice import dice
from perception.frames import Image
from perception.overlay import overlaid
from perception.wound.segmentation import Mask, Segmentation

COLUMNS = 8  # pictures a row; a row each of the best, the median and the worst
CELL = 240  # px, side of a picture on the sheet
PLACE = 1.5  # of the wound's longer side that is shown beyond it on every side


@dataclass(frozen=True, slots=True, eq=False)
class Shown:
    """A picture (H, W, 3) BGR, what was found in it and the truth (H, W)."""

    image: Image
    found: Segmentation
    truth: Mask

    @property
    def dice(self) -> float:
        """How well the two agree."""
        return dice(self.found.mask, self.truth)


def contact_sheet(shown: Sequence[Shown]) -> Image:
    """(H, W, 3) BGR of three rows: best, median, worst; truth in blue, found in green, Dice below each."""
    order = sorted(shown, key=lambda each: -each.dice)
    middle = max(0, (len(order) - COLUMNS) // 2)
    rows = (order[:COLUMNS], order[middle : middle + COLUMNS], order[-COLUMNS:])
    return np.vstack([np.hstack([_cell(each) for each in _filled(row)]) for row in rows])


def _filled(row: Sequence[Shown]) -> list[Shown]:
    """A row of a short list, its last picture repeated."""
    return [*row, *[row[-1]] * (COLUMNS - len(row))]


def _cell(shown: Shown) -> Image:
    """The part of a picture round truth and finding, square, with its Dice."""
    rows, columns = _square(shown.truth | shown.found.mask)
    part = Segmentation(shown.found.mask[rows, columns], shown.found.confidence, shown.found.threshold)
    drawn = overlaid(np.ascontiguousarray(shown.image[rows, columns]), part, shown.truth[rows, columns], False)
    cell = np.asarray(cv2.resize(drawn, (CELL, CELL), interpolation=cv2.INTER_AREA), np.uint8)
    cv2.putText(cell, f"{shown.dice:.2f}", (6, CELL - 8), cv2.FONT_HERSHEY_SIMPLEX, 0.6, (255, 255, 255), 2)
    return cell


def _square(mask: Mask) -> tuple[slice, slice]:
    """Rows and columns of a square round a mask, inside the picture; of its middle where the mask is empty."""
    least = min(mask.shape)
    rows, columns = np.nonzero(mask)
    if not len(rows):
        rows, columns, extent = np.array([mask.shape[0] // 2]), np.array([mask.shape[1] // 2]), least
    else:
        extent = max(int(np.ptp(rows)), int(np.ptp(columns)), 16)
    side = min(least, int((1 + 2 * PLACE) * extent))
    spans = []
    for places, full in ((rows, mask.shape[0]), (columns, mask.shape[1])):
        start = int(np.clip((places.min() + places.max()) // 2 - side // 2, 0, full - side))
        spans.append(slice(start, start + side))
    return spans[0], spans[1]
