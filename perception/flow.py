"""Optical flow from the last frame to this one: a predictor for the alignment, never a measurement."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from estimation.se3 import Array
from perception.features import bounding_box
from perception.frames import Image

WINDOW = 21  # px
MARGIN = 48.0  # px around the tracks: flow sees that far beyond them


def flow(
    previous: Image, current: Image, pixels: Array, guess: Array, levels: int = 4
) -> tuple[Array, NDArray[np.bool_]]:
    """Where pixels (N, 2) of the previous image stand in the current one (N, 2), and whether they were found (N,).

    guess: (N, 2) px, where to begin. Pyramidal Lucas-Kanade (thesis 4.4, Eq. 4.7-4.10) on the box around the tracks.
    """
    h, w = current.shape[:2]
    reach = np.concatenate([pixels, guess])
    x0, y0, x1, y1 = bounding_box(np.clip(reach, 0, [w, h]), (w, h), MARGIN)
    corner = np.array([x0, y0], float)
    begin = np.ascontiguousarray((guess - corner)[:, None], np.float32)
    found, status, _ = cv2.calcOpticalFlowPyrLK(
        np.ascontiguousarray(previous[y0:y1, x0:x1]),
        np.ascontiguousarray(current[y0:y1, x0:x1]),
        np.ascontiguousarray((pixels - corner)[:, None], np.float32),
        begin.copy(),
        winSize=(WINDOW, WINDOW),
        maxLevel=levels,
        criteria=(cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 15, 0.05),
        flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
        minEigThreshold=1e-4,
    )
    moved = np.asarray(found, np.float64)[:, 0]
    return moved + corner, (np.asarray(status).ravel() > 0) & np.isfinite(moved).all(1)
