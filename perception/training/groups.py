"""Groups of pictures that show one wound, and a split that never parts a group.

Two pictures are joined when small colour copies of them agree, mirrored and turned ones included, or when SIFT finds
one scene in both; groups are the connected components. A split at random would put views of one wound on both sides
and flatter the result.
"""

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from perception.training.dataset import Labelled

COPY_SIDE = 16
# Correlation of two colour copies above which they are joined. Exact duplicates reach 0.99; two visits of one foot
# 0.84 to 0.93, where a few pictures of different feet lie as well: joining too much only makes the split stricter.
SAME_PICTURE = 0.84
CANDIDATES = 40
FEATURES = 500
PICTURE_SIDE = 400
RATIO = 0.8
INLIER_PX = 8.0
# A similarity must carry this many matches, and spread them (deviation along their narrower direction): a date stamp
# or a floor board that two pictures share is a short line.
SAME_SCENE = 10
SPREAD_PX = 20.0

Features = tuple[NDArray[np.float32], NDArray[np.float32]]


def groups(pictures: Sequence[Labelled]) -> NDArray[np.intp]:
    """(N,) number of each picture's group."""
    copies = np.stack([_copy(each.picture) for each in pictures])
    likeness = np.max([copies @ _turned(copies, turn).T for turn in range(8)], axis=0)
    joined = likeness > SAME_PICTURE
    features = [_features(each.picture) for each in pictures]
    for first, second in _candidates(likeness):
        if not joined[first, second] and _one_scene(features[first], features[second]):
            joined[first, second] = True
    return _components(joined | joined.T)


def split(group: NDArray[np.intp], held_out: int, rng: np.random.Generator) -> NDArray[np.bool_]:
    """(N,) True for the pictures held out: whole groups in random order until there are at least `held_out`."""
    chosen = np.zeros(len(group), bool)
    for number in rng.permutation(np.unique(group)):
        if chosen.sum() >= held_out:
            break
        chosen |= group == number
    return chosen


def _copy(picture: NDArray[np.uint8]) -> NDArray[np.float64]:
    """(3 * side^2,) a small square colour copy, centred and of unit length."""
    small = cv2.resize(cv2.cvtColor(picture, cv2.COLOR_RGB2LAB), (COPY_SIDE, COPY_SIDE), interpolation=cv2.INTER_AREA)
    centred = small.astype(np.float64) - small.mean((0, 1))
    return (centred / np.linalg.norm(centred)).ravel()


def _turned(copies: NDArray[np.float64], turn: int) -> NDArray[np.float64]:
    """The copies under one of the eight symmetries of the square."""
    square = copies.reshape(-1, COPY_SIDE, COPY_SIDE, 3)
    mirrored = square[:, :, ::-1] if turn & 4 else square
    return np.rot90(mirrored, turn & 3, (1, 2)).reshape(len(copies), -1)


def _candidates(likeness: NDArray[np.float64]) -> list[tuple[int, int]]:
    nearest = np.argsort(-likeness, axis=1, kind="stable")[:, : CANDIDATES + 1]
    pairs = {(min(a, b), max(a, b)) for a, row in enumerate(nearest.tolist()) for b in row if a != b}
    return sorted(pairs)


def _features(picture: NDArray[np.uint8]) -> Features:
    """Places (N, 2) and descriptors (N, 128)."""
    scale = PICTURE_SIDE / max(picture.shape[:2])
    grey = cv2.resize(cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY), None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    points, descriptors = cv2.SIFT.create(FEATURES).detectAndCompute(grey, None)
    if descriptors is None:
        return np.zeros((0, 2), np.float32), np.zeros((0, 128), np.float32)
    return np.array([point.pt for point in points], np.float32), np.asarray(descriptors, np.float32)


def _one_scene(first: Features, second: Features) -> bool:
    if min(len(first[0]), len(second[0])) < SAME_SCENE:
        return False
    pairs = cv2.BFMatcher().knnMatch(first[1], second[1], k=2)
    good = [best for best, runner_up in pairs if best.distance < RATIO * runner_up.distance]
    if len(good) < SAME_SCENE:
        return False
    places = first[0][[match.queryIdx for match in good]], second[0][[match.trainIdx for match in good]]
    cv2.setRNGSeed(0)
    _, inside = cv2.estimateAffinePartial2D(*places, method=cv2.RANSAC, ransacReprojThreshold=INLIER_PX)
    if inside is None or inside.sum() < SAME_SCENE:
        return False
    return all(_spread(each[inside.ravel() > 0]) >= SPREAD_PX for each in places)


def _spread(places: NDArray[np.float32]) -> float:
    """Standard deviation of (N, 2) places along their narrower direction, px."""
    return float(np.sqrt(max(0.0, np.linalg.eigvalsh(np.cov(places.T))[0])))


def _components(joined: NDArray[np.bool_]) -> NDArray[np.intp]:
    number = np.arange(len(joined))
    while True:
        lowest = np.min(np.where(joined, number[None, :], len(joined)), axis=1)
        spread = np.minimum(number, lowest)
        if (spread == number).all():
            return number
        number = spread
