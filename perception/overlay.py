"""A picture with what was found drawn over it."""

from __future__ import annotations

import cv2
import numpy as np

from perception.frames import Image
from perception.wound.segmentation import Mask, Segmentation

FOUND, TRUTH = (60, 220, 60), (255, 160, 40)  # BGR of the outlines
TINT = 0.25  # of the outline's colour inside it


def overlaid(image: Image, found: Segmentation, truth: Mask | None = None, told: bool = True) -> Image:
    """(H, W, 3) BGR: the wound's outline, the true outline where there is one, and in words how sure it is."""
    drawn = cv2.cvtColor(image, cv2.COLOR_GRAY2BGR) if image.ndim == 2 else image.copy()
    inside = found.mask
    drawn[inside] = ((1 - TINT) * drawn[inside] + TINT * np.array(FOUND)).astype(np.uint8)
    width = max(1, round(max(image.shape[:2]) / 500))
    for mask, colour in ((truth, TRUTH), (found.mask, FOUND)):
        if mask is not None:
            outlines, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
            cv2.drawContours(drawn, outlines, -1, colour, width)
    if not told:
        return np.asarray(drawn, np.uint8)
    text = f"wound {found.confidence:.2f}" if found.found else f"no wound {found.confidence:.2f}"
    scale = max(image.shape[:2]) / 1000
    cv2.putText(drawn, text, (8, int(8 + 28 * scale)), cv2.FONT_HERSHEY_SIMPLEX, scale, FOUND, max(1, round(2 * scale)))
    return np.asarray(drawn, np.uint8)
