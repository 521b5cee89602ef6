"""The black padding round a picture, which some data sets carry and a network should not see."""

import numpy as np
from numpy.typing import NDArray

# A padded row is black but for what JPEG smears over its edge; a dark room still has sensor noise in most pixels.
DARK = 12
LIT_SHARE = 0.02
# What is left must still be a picture.
SMALLEST_SHARE = 0.3


def picture_box(picture: NDArray[np.uint8]) -> tuple[slice, slice]:
    """Rows and columns of (H, W, 3) or (H, W) that are not padding; all of them where hardly anything would be left."""
    lit = (picture.max(2) if picture.ndim == 3 else picture) > DARK
    rows, columns = (_span(lit.mean(axis)) for axis in (1, 0))
    left = (rows.stop - rows.start) * (columns.stop - columns.start)
    if left < SMALLEST_SHARE * lit.size:
        return slice(0, lit.shape[0]), slice(0, lit.shape[1])
    return rows, columns


def _span(lit_share: NDArray[np.float64]) -> slice:
    inside = np.flatnonzero(lit_share > LIT_SHARE)
    return slice(int(inside[0]), int(inside[-1]) + 1) if len(inside) else slice(0, 0)
