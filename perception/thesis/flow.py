"""Shi-Tomasi corners followed by Lucas-Kanade's optical flow: the thesis's fast way (4.3, 4.4, first of 4.6)."""

from __future__ import annotations

import cv2
import numpy as np

from estimation.se3 import Array
from perception.frames import Image
from perception.thesis.pairs import Pairs, no_pairs
from perception.thesis.region import Box, cropped

CORNERS, QUALITY, APART = 30, 0.3, 1.0  # at most, of the best one's quality, px between two: 4.6


class Corners:
    """The corners of one picture, followed into the next one: thesis Eq. 4.7-4.10 as calcOpticalFlowPyrLK solves them.

    They are chosen anew in each picture: followed on, fewer and fewer would be left, and the thesis tells no limit.
    """

    def __init__(self) -> None:
        self._before: Image | None = None
        self._now: Image | None = None

    def begin(self, view: Image, box: Box) -> Array:
        """Remember a picture; the corners (N, 2) px in a box of it."""
        self._before = self._now = view
        return self._corners(cropped(view, box)) + box[:2]

    def find(self, view: Image, box: Box) -> Pairs:
        """The corners of the remembered picture in the next one, those that the flow lost left out."""
        self._now = view
        assert self._before is not None
        before, now = cropped(self._before, box), cropped(view, box)
        source = self._corners(before)
        if not len(source):
            return no_pairs()
        start = source.astype(np.float32).reshape(-1, 1, 2)
        found, status, _ = cv2.calcOpticalFlowPyrLK(before, now, start, np.empty_like(start))
        followed = np.asarray(status).reshape(-1) == 1
        return Pairs(source[followed], np.asarray(found, float).reshape(-1, 2)[followed])

    def keep(self) -> None:
        """Remember the picture last looked at."""
        self._before = self._now

    @staticmethod
    def _corners(inside: Image) -> Array:
        found = cv2.goodFeaturesToTrack(inside, CORNERS, QUALITY, APART)
        return np.zeros((0, 2)) if found is None else np.asarray(found, float).reshape(-1, 2)
