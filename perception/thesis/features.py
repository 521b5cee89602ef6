"""The region that is looked at, and two ways to follow its features: SIFT with FLANN, or corners with optical flow."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from estimation.se3 import Array
from perception.frames import Image
from perception.lens import bilateral
from perception.matching.features import bounding_box

Box = tuple[int, int, int, int]  # x0, y0, x1, y1 px, the last two excluded

REGION_BORDER_PX = 5.0  # px around the region, Appendix A


def corners_of(polygon: Array, size: tuple[int, int]) -> Array:
    """Lowest and highest x and y (2, 2) px of a polygon (N, 2) px, as far as an image of `size` (W, H) shows it."""
    seen = np.clip(polygon, 0.0, np.array(size) - 1.0)
    return np.stack([seen.min(0), seen.max(0)])


def united(before: Array, now: Array, size: tuple[int, int]) -> Box:
    """The box around where the region was and where it is, corners (2, 2) px each, and the border (thesis Fig. 3.4)."""
    return bounding_box(np.concatenate([before, now]), size, REGION_BORDER_PX)


def cropped(view: Image, box: Box) -> Image:
    """The box of a picture, its reflections filtered out and its contours kept (thesis Fig. 4.9)."""
    x0, y0, x1, y1 = box
    return bilateral(np.ascontiguousarray(view[y0:y1, x0:x1]))


@dataclass(frozen=True, slots=True, eq=False)
class Pairs:
    """The same features in two pictures: source (N, 2) px in the one before, destination (N, 2) px in this one.

    Both count from the corner of the box looked at. In Appendix A each counts from the corner of its own picture's
    box, so whenever the box changes its corner's move is taken for the surface's; that is a slip and not repeated.
    """

    source: Array
    destination: Array

    def __len__(self) -> int:
        return len(self.source)


class Finder(Protocol):
    """Remembers the features of one picture and finds them again in the next."""

    def begin(self, view: Image, box: Box) -> Array:
        """Remember the features in a box of a picture; their pixels (N, 2) there."""

    def find(self, view: Image, box: Box) -> Pairs:
        """The remembered features in the next picture, within `box`, which holds both places of the region."""

    def keep(self) -> None:
        """Remember the picture last looked at instead; not asked for where nothing was to be made of it."""


def no_pairs() -> Pairs:
    """Nothing was found again."""
    return Pairs(np.zeros((0, 2)), np.zeros((0, 2)))


SIFT_FEATURES = 100  # SIFT is configured to find, 4.6
FLANN_KD_TREE, FLANN_TREES, FLANN_CHECKS = 1, 4, 10  # of FLANN: FLANN_INDEX_KDTREE, 4 trees, 10 checks, 4.6
LOWE_RATIO = 0.8  # of the nearest descriptor's distance to the next one's, Appendix A

Descriptors = NDArray[np.float32]


class KeyPoints:
    """The key points of one picture, found again in the next by their descriptors.

    Each picture's are extracted once and used twice, as thesis 4.3 and Fig. 4.17 (b) have it.
    """

    def __init__(self) -> None:
        self._sift = cv2.SIFT.create(nfeatures=SIFT_FEATURES)
        self._flann = cv2.FlannBasedMatcher(
            {"algorithm": FLANN_KD_TREE, "trees": FLANN_TREES}, {"checks": FLANN_CHECKS}
        )
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
        good = [m for m, n in nearest if m.distance < LOWE_RATIO * n.distance]
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


MAX_CORNERS, CORNER_QUALITY, CORNER_SPACING_PX = 30, 0.3, 1.0  # at most, of the best one's quality, px between two: 4.6


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
        found = cv2.goodFeaturesToTrack(inside, MAX_CORNERS, CORNER_QUALITY, CORNER_SPACING_PX)
        return np.zeros((0, 2)) if found is None else np.asarray(found, float).reshape(-1, 2)
