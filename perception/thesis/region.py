"""The rectangle of the picture that is looked at (thesis Fig. 3.4, 3.5 and `crop_ROI` of Appendix A)."""

from __future__ import annotations

import numpy as np

from estimation.se3 import Array
from perception.features import bounding_box
from perception.frames import Image
from perception.prefilter import bilateral

Box = tuple[int, int, int, int]  # x0, y0, x1, y1 px, the last two excluded

BORDER = 5.0  # px around the region, Appendix A


def corners_of(polygon: Array, size: tuple[int, int]) -> Array:
    """Lowest and highest x and y (2, 2) px of a polygon (N, 2) px, as far as an image of `size` (W, H) shows it."""
    seen = np.clip(polygon, 0.0, np.array(size) - 1.0)
    return np.stack([seen.min(0), seen.max(0)])


def united(before: Array, now: Array, size: tuple[int, int]) -> Box:
    """The box around where the region was and where it is, corners (2, 2) px each, and the border (thesis Fig. 3.4)."""
    return bounding_box(np.concatenate([before, now]), size, BORDER)


def cropped(view: Image, box: Box) -> Image:
    """The box of a picture, its reflections filtered out and its contours kept (thesis Fig. 4.9)."""
    x0, y0, x1, y1 = box
    return bilateral(np.ascontiguousarray(view[y0:y1, x0:x1]))
