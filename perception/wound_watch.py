"""One camera's wound over time: what a single picture says is believed once it agrees with the pictures before."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from estimation.se3 import Array
from perception.wound.segmentation import Mask, Segmentation, centroid, largest_part
from perception.wound_region import Box, box_of, region

SAME = 0.3  # overlap of two boxes over their union, above which they show one wound: it moves little between looks
PATIENCE = 3  # looks without it, after which a wound is no longer believed in


@dataclass(frozen=True, slots=True, eq=False)
class Sight:
    """What is believed of a wound. mask: (H, W) bool, of its largest part, as last seen. box: round it; None: no wound.
    roi: where to look for it now. centroid: (2,) px. confidence: of the last look. missed: looks since it was seen."""

    mask: Mask
    box: Box | None
    roi: Box
    centroid: Array
    confidence: float
    missed: int


class WoundWatch:
    """Remembers where one camera saw the wound."""

    def __init__(self, size: tuple[int, int]) -> None:
        """size: (W, H) px of the camera's images."""
        self._size = size
        self._mask: Mask = np.zeros(size[::-1], bool)
        self._box: Box | None = None
        self._elsewhere: Box | None = None  # where another place was seen once
        self._missed = 0

    def take(self, seen: Segmentation) -> Sight:
        """Add one look. A wound that jumps is believed at the second look that shows it there; one that is not seen
        stays for a few looks; the region holds both where it is and where it was (thesis Fig. 3.4)."""
        before = self._box
        mask = largest_part(seen.mask)
        box = box_of(mask)
        if box is None or not self._believed(box):
            self._missed += 1
            if self._missed > PATIENCE:
                self._box, self._mask = None, np.zeros_like(self._mask)
        else:
            self._box, self._mask, self._missed = box, mask, 0
        self._elsewhere = box
        roi = region(self._box, before, self._size) if not self._missed else region(None, before, self._size)
        return Sight(self._mask, self._box, roi, centroid(self._mask), seen.confidence, self._missed)

    def _believed(self, box: Box) -> bool:
        if self._box is None:
            return True
        return overlap(box, self._box) > SAME or (self._elsewhere is not None and overlap(box, self._elsewhere) > SAME)


def overlap(a: Box, b: Box) -> float:
    """Area of two boxes' intersection over that of their union."""
    width, height = min(a[2], b[2]) - max(a[0], b[0]), min(a[3], b[3]) - max(a[1], b[1])
    both = max(0, width) * max(0, height)
    return both / ((a[2] - a[0]) * (a[3] - a[1]) + (b[2] - b[0]) * (b[3] - b[1]) - both)
