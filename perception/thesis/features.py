"""SIFT features matched by FLANN with Lowe's ratio test: the thesis's core way (4.3, 4.4, `track` of Appendix A)."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from estimation.se3 import Array
from perception.frames import Image
from perception.thesis.pairs import Pairs, no_pairs
from perception.thesis.region import Box, cropped

FEATURES = 100  # SIFT is configured to find, 4.6
KD_TREE, TREES, CHECKS = 1, 4, 10  # of FLANN: FLANN_INDEX_KDTREE, 4 trees, 10 checks, 4.6
RATIO = 0.8  # of the nearest descriptor's distance to the next one's, Appendix A

Descriptors = NDArray[np.float32]


class KeyPoints:
    """The key points of one picture, found again in the next by their descriptors.

    Each picture's are extracted once and used twice, as thesis 4.3 and Fig. 4.17 (b) have it.
    """

    def __init__(self) -> None:
        self._sift = cv2.SIFT.create(nfeatures=FEATURES)
        self._flann = cv2.FlannBasedMatcher({"algorithm": KD_TREE, "trees": TREES}, {"checks": CHECKS})
        self._before: tuple[Array, Descriptors] = np.zeros((0, 2)), np.zeros((0, 128), np.float32)
        self._now = self._before

    def begin(self, view: Image, box: Box) -> Array:
        """Remember the key points in a box of a picture; their pixels (N, 2) there."""
        self._before = self._now = self._extract(view, box)
        return self._before[0]

    def find(self, view: Image, box: Box) -> Pairs:
        """The remembered key points in the next picture: thesis Eq. 4.11 and the ratio test."""
        self._now = self._extract(view, box)
        (points_before, before), (points_now, now) = self._before, self._now
        if len(before) < 2 or len(now) < 2:
            return no_pairs()
        cv2.setRNGSeed(0)  # of this thread: the trees are built by chance, and the same pictures must match alike
        nearest = [two for two in self._flann.knnMatch(before, now, k=2) if len(two) == 2]
        good = [m for m, n in nearest if m.distance < RATIO * n.distance]
        corner = np.array(box[:2], float)
        source, destination = [m.queryIdx for m in good], [m.trainIdx for m in good]
        return Pairs(points_before[source] - corner, points_now[destination] - corner)

    def keep(self) -> None:
        """Remember the key points of the picture last looked at."""
        self._before = self._now

    def _extract(self, view: Image, box: Box) -> tuple[Array, Descriptors]:
        found, descriptors = self._sift.detectAndCompute(cropped(view, box), None)
        if not found:
            return np.zeros((0, 2)), np.zeros((0, 128), np.float32)
        return np.array([k.pt for k in found]) + box[:2], np.asarray(descriptors, np.float32)
