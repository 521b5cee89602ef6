"""Where in an image tracks can begin, and which features of two images show the same spot."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from estimation.se3 import Array
from perception.frames import Image

Mask = NDArray[np.uint8]
SIFT_SHIFT = 0.25  # px: cv2's SIFT doubles the image and does not take the half pixel back (measured on blobs: 0.26)
MANY, KD_TREE = 12_000_000, 1  # distances, above which FLANN's trees are quicker; their number there
MOST_FEATURES = 5000  # strongest first: matching two images then takes 0.15 s and 100 MB


def grey(image: Image) -> Image:
    """The image as one grey channel (H, W)."""
    return image if image.ndim == 2 else np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), np.uint8)


def polygon_mask(size: tuple[int, int], polygon: Array) -> Mask:
    """Mask (H, W), 255 inside a polygon (N, 2) px that may leave the image. size: (W, H)."""
    mask = np.zeros((size[1], size[0]), np.uint8)
    cv2.fillPoly(mask, [np.round(np.clip(polygon, -30000, 30000)).astype(np.int32)], 255)
    return mask


def bounding_box(points: Array, size: tuple[int, int], margin: float) -> tuple[int, int, int, int]:
    """x0, y0, x1, y1 px of the points' box (N, 2) plus a margin, clipped to the image; never empty."""
    low = np.floor(points.min(0) - margin).astype(int)
    high = np.ceil(points.max(0) + margin).astype(int) + 1
    x0, y0 = np.clip(low, 0, np.array(size) - 8)
    x1, y1 = np.clip(high, (x0 + 8, y0 + 8), size)
    return int(x0), int(y0), int(x1), int(y1)


def corners(image: Image, mask: Mask, count: int, border: int = 16) -> Array:
    """Up to `count` Shi-Tomasi corners (N, 2) px, spread over the mask, best first, refined to sub-pixel."""
    inner = mask.copy()
    inner[:border], inner[-border:], inner[:, :border], inner[:, -border:] = 0, 0, 0, 0
    area = cv2.countNonZero(inner)
    if area == 0:
        return np.zeros((0, 2))
    spread = max(4.0, 0.55 * np.sqrt(area / count))
    found = cv2.goodFeaturesToTrack(image, count, 0.005, spread, mask=inner, blockSize=7)
    if found is None:
        return np.zeros((0, 2))
    return np.asarray(found, np.float64).reshape(-1, 2)


def sift(
    image: Image, mask: Mask | None = None, count: int = 1500, tilted: bool = False
) -> tuple[Array, NDArray[np.float32]]:
    """SIFT keypoints (N, 2) px and descriptors (N, 128) inside a mask.

    tilted: also as the image would look from the side (affine SIFT, Morel and Yu 2009): 0.1 s and ten times the
    features, but cameras that stand 60 degrees apart then share hundreds of matches instead of ten.
    """
    x0, y0, x1, y1 = 0, 0, image.shape[1], image.shape[0]
    if mask is not None:
        if cv2.countNonZero(mask) == 0:
            return np.zeros((0, 2)), np.zeros((0, 128), np.float32)
        x, y, w, h = cv2.boundingRect(mask)
        x0, y0, x1, y1 = max(x - 16, 0), max(y - 16, 0), min(x + w + 16, x1), min(y + h + 16, y1)
        mask = np.ascontiguousarray(mask[y0:y1, x0:x1])
    detector: cv2.Feature2D = cv2.SIFT.create(nfeatures=count, contrastThreshold=0.02)
    if tilted:
        detector = cv2.AffineFeature.create(detector, maxTilt=3)
    keypoints, descriptors = detector.detectAndCompute(np.ascontiguousarray(image[y0:y1, x0:x1]), mask)
    if not keypoints:
        return np.zeros((0, 2)), np.zeros((0, 128), np.float32)
    best = np.argsort([-k.response for k in keypoints], kind="stable")[:MOST_FEATURES]
    pixels = np.array([k.pt for k in keypoints]) + (x0 - SIFT_SHIFT, y0 - SIFT_SHIFT)
    return pixels[best], np.asarray(descriptors, np.float32)[best]


def match(a: NDArray[np.float32], b: NDArray[np.float32], ratio: float = 0.8) -> NDArray[np.int64]:
    """Pairs (M, 2) of rows of a and b that choose each other and pass Lowe's ratio test (thesis 4.4: 0.8).

    All distances are compared, which numpy does four times quicker than OpenCV's brute force, as long as they are not
    too many; beyond that FLANN's trees are asked, which miss one pair in 500 and give the same answer every time.
    """
    if len(a) < 2 or len(b) < 2:
        return np.zeros((0, 2), np.int64)
    first, second, best, back = _by_trees(a, b) if len(a) * len(b) > MANY else _by_all_distances(a, b)
    rows = np.arange(len(a))
    good = (first < ratio**2 * second) & (back[best] == rows)
    return np.stack([rows[good], best[good]], -1).astype(np.int64)


Nearest = tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.int64], NDArray[np.int64]]


def _by_all_distances(a: NDArray[np.float32], b: NDArray[np.float32]) -> Nearest:
    """Squared distances (N,) of a to the nearest and next row of b, which row is nearest, and the same back (M,)."""
    distance = np.maximum((a * a).sum(1)[:, None] + (b * b).sum(1) - 2 * (a @ b.T), 0.0)
    best, back = np.argmin(distance, axis=1), np.argmin(distance, axis=0)
    rows = np.arange(len(a))
    first = distance[rows, best]
    distance[rows, best] = np.inf
    return first, distance.min(axis=1), best, back


def _by_trees(a: NDArray[np.float32], b: NDArray[np.float32]) -> Nearest:
    """As `_by_all_distances`, nearly always."""
    cv2.setRNGSeed(0)  # of this thread; the trees are cut at random
    trees: dict[str, bool | int | float | str] = {"algorithm": KD_TREE, "trees": 4}
    checks: dict[str, bool | int | float | str] = {"checks": 32}
    rows, distances = cv2.flann.Index(b, trees).knnSearch(a, 2, params=checks)
    back = cv2.flann.Index(a, trees).knnSearch(b, 1, params=checks)[0][:, 0]
    nearest = np.asarray(distances, np.float32)
    return nearest[:, 0], nearest[:, 1], np.asarray(rows[:, 0], np.int64), np.asarray(back, np.int64)
