"""How a region moved and turned in the picture: the median of its features, and their homography (4.4, 4.5)."""

from __future__ import annotations

import cv2
import numpy as np

from estimation.se3 import Array
from perception.thesis.pairs import Pairs

LEAST = 4  # pairs that a homography takes
REPROJECTION = 3.0  # px, of RANSAC, Appendix A


def displacement(pairs: Pairs) -> Array:
    """The median move (2,) px, each image axis for itself: thesis 4.4 and `track` of Appendix A.

    4.6 says "mean" of the shaking table's measurement; the median is what 4.4, the second experiment and the program
    say, and the mean would follow a single wrong match.
    """
    return np.asarray(np.median(pairs.destination - pairs.source, axis=0))


def turn(pairs: Pairs) -> float | None:
    """The turn in the image, rad, from x towards y: about the camera's optical axis; None without a homography.

    The arctangent of h21 / h11 of the homography H (thesis Eq. 4.19) by RANSAC. Eq. 4.20 writes H from the second
    picture to the first; as in Appendix A it is that from the first to the second, so the turn is the surface's own.

    Of Eq. 4.21-4.22, P_x = t_x / (1 - cos) and P_y = t_y / sin, no use is made: the point that a turn leaves in place
    solves (I - R) P = t, which is another one, and turning about it while moving by the median as well (Eq. 5.4-5.7)
    would count the same motion twice. The surface turns about its own middle instead, which the median moves.
    """
    if len(pairs) < LEAST:
        return None
    homography, _ = cv2.findHomography(pairs.source, pairs.destination, cv2.RANSAC, REPROJECTION)
    if homography is None:
        return None
    return float(np.arctan2(homography[1, 0], homography[0, 0]))
