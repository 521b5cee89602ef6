"""What may be done to pictures before anything is looked for in them."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np

from perception.frames import Image

DIAMETER, SIGMA_GREY, SIGMA_PX = 10, 75.0, 750.0  # of the bilateral filter, thesis Appendix A


def bilateral(image: Image) -> Image:
    """The picture, its reflections filtered out and its contours kept (thesis 4.6, Fig. 4.9)."""
    return np.asarray(cv2.bilateralFilter(image, DIAMETER, SIGMA_GREY, SIGMA_PX), np.uint8)


def untouched(image: Image) -> Image:
    """The picture as it is."""
    return image


NONE, BILATERAL = "none", "bilateral"
PREFILTERS: dict[str, Callable[[Image], Image]] = {NONE: untouched, BILATERAL: bilateral}
