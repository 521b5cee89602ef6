"""Labelled pictures and what training makes of them.

A folder has `images/` and `labels/`, one mask of the same name and size for each picture. A group is the pictures that
show one wound: two are joined when small colour copies of them agree, mirrored and turned ones included, or when SIFT
finds one scene in both; groups are the connected components. A random split would put views of one wound on both sides
and flatter the result.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.sparse.csgraph import connected_components

from estimation.errors import InputError
from perception.wound.segmentation import picture_box

PICTURE_SUFFIXES = (".jpg", ".jpeg", ".png", ".bmp", ".tif", ".tiff")


@dataclass(frozen=True, slots=True)
class Labelled:
    """One picture and the wounds in it; the black padding that some sets carry is cut off both."""

    name: str  # "folder/file"
    picture: NDArray[np.uint8]  # (H, W, 3) RGB
    wound: NDArray[np.bool_]  # (H, W)


def read_dataset(folder: Path, seen: Callable[[int, int], None] = lambda done, of: None) -> list[Labelled]:
    """All pictures of one folder in the order of their names; `seen(done, of)` is called after each.

    InputError: no such folder, no picture in it, a picture without its mask, one that cannot be read, another size.
    """
    files = [file for file in _listed(folder / "images") if file.suffix.lower() in PICTURE_SUFFIXES]
    if not files:
        allowed = f"one at least, ending in {', '.join(PICTURE_SUFFIXES)}"
        raise InputError(str(folder / "images"), "pictures", "none", allowed)
    masks = {file.stem: file for file in _listed(folder / "labels")}
    labelled = []
    for file in files:
        if file.stem not in masks:
            raise InputError(str(file), "mask", "none", f"a picture named {file.stem} in {folder / 'labels'}")
        labelled.append(_labelled(folder.name, file, masks[file.stem]))
        seen(len(labelled), len(files))
    return labelled


def _listed(folder: Path) -> Sequence[Path]:
    if not folder.is_dir():
        raise InputError(str(folder), "data set", "no such folder", "a folder that holds images/ and labels/")
    return sorted(folder.iterdir())


def _labelled(place: str, file: Path, mask_file: Path) -> Labelled:
    picture = np.asarray(cv2.cvtColor(_read(file, cv2.IMREAD_COLOR), cv2.COLOR_BGR2RGB), np.uint8)
    mask = _read(mask_file, cv2.IMREAD_GRAYSCALE)
    if mask.shape != picture.shape[:2]:
        raise InputError(str(mask_file), "size (H, W)", mask.shape, f"that of its picture, {picture.shape[:2]}")
    box = picture_box(picture)
    # Masks come as 0/255 and as 0/1; either way the wound is what lies above half of the format's own maximum.
    wound = mask > (127 if mask.max(initial=0) > 1 else 0)
    return Labelled(f"{place}/{file.name}", np.ascontiguousarray(picture[box]), np.ascontiguousarray(wound[box]))


def _read(file: Path, mode: int) -> NDArray[np.uint8]:
    picture = cv2.imread(str(file), mode)
    if picture is None:
        raise InputError(str(file), "picture", "unreadable", f"a whole file of one of {', '.join(PICTURE_SUFFIXES)}")
    return np.asarray(picture, np.uint8)


COPY_SIDE_PX = 16
# Correlation of two colour copies above which they are joined. Exact duplicates reach 0.99; two visits of one foot
# 0.84 to 0.93, where a few pictures of different feet lie as well: joining too much only makes the split stricter.
MIN_COPY_CORRELATION = 0.84
MAX_CANDIDATES = 40
SCENE_FEATURES = 500
SCENE_SIDE_PX = 400
LOWE_RATIO = 0.8
MAX_SCENE_RESIDUAL_PX = 8.0
# A similarity must carry this many matches, and spread them (deviation along their narrower direction): a date stamp
# or a floor board that two pictures share is a short line.
MIN_SCENE_MATCHES = 10
MIN_MATCH_SPREAD_PX = 20.0

Features = tuple[NDArray[np.float32], NDArray[np.float32]]


def picture_groups(pictures: Sequence[Labelled]) -> NDArray[np.intp]:
    """(N,) number of each picture's group."""
    copies = np.stack([_copy(each.picture) for each in pictures])
    likeness = np.max([copies @ _turned(copies, turn).T for turn in range(8)], axis=0)
    joined = likeness > MIN_COPY_CORRELATION
    features = [_features(each.picture) for each in pictures]
    nearest = np.argsort(-likeness, axis=1, kind="stable")[:, : MAX_CANDIDATES + 1]
    pairs = {(min(a, b), max(a, b)) for a, row in enumerate(nearest.tolist()) for b in row if a != b}
    for first, second in sorted(pairs):
        if not joined[first, second] and _one_scene(features[first], features[second]):
            joined[first, second] = True
    return connected_components(joined, directed=False)[1].astype(np.intp)


def fold_numbers(group: NDArray[np.intp], folds: int, rng: np.random.Generator) -> NDArray[np.intp]:
    """(N,) number of each picture's fold: whole groups in random order, each into the fold that has fewest pictures."""
    fold, filled = np.zeros(len(group), np.intp), np.zeros(folds, int)
    for number in rng.permutation(np.unique(group)):
        inside = group == number
        fold[inside] = np.argmin(filled)
        filled[fold[inside][0]] += inside.sum()
    return fold


def _copy(picture: NDArray[np.uint8]) -> NDArray[np.float64]:
    """(3 * side^2,) a small square colour copy, centred and of unit length."""
    lab = cv2.cvtColor(picture, cv2.COLOR_RGB2LAB)
    small = cv2.resize(lab, (COPY_SIDE_PX, COPY_SIDE_PX), interpolation=cv2.INTER_AREA)
    centred = small.astype(np.float64) - small.mean((0, 1))
    return (centred / max(float(np.linalg.norm(centred)), 1e-9)).ravel()  # nothing is like a picture of one colour


def _turned(copies: NDArray[np.float64], turn: int) -> NDArray[np.float64]:
    """The copies under one of the eight symmetries of the square."""
    square = copies.reshape(-1, COPY_SIDE_PX, COPY_SIDE_PX, 3)
    return np.rot90(square[:, :, ::-1] if turn & 4 else square, turn & 3, (1, 2)).reshape(len(copies), -1)


def _features(picture: NDArray[np.uint8]) -> Features:
    scale = SCENE_SIDE_PX / max(picture.shape[:2])
    grey = cv2.resize(cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY), None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    points, descriptors = cv2.SIFT.create(SCENE_FEATURES).detectAndCompute(grey, None)
    if descriptors is None:
        return np.zeros((0, 2), np.float32), np.zeros((0, 128), np.float32)
    return np.array([point.pt for point in points], np.float32), np.asarray(descriptors, np.float32)


def _one_scene(first: Features, second: Features) -> bool:
    if min(len(first[0]), len(second[0])) < MIN_SCENE_MATCHES:
        return False
    pairs = cv2.BFMatcher().knnMatch(first[1], second[1], k=2)
    good = [best for best, runner_up in pairs if best.distance < LOWE_RATIO * runner_up.distance]
    if len(good) < MIN_SCENE_MATCHES:
        return False
    places = first[0][[match.queryIdx for match in good]], second[0][[match.trainIdx for match in good]]
    cv2.setRNGSeed(0)
    _, inside = cv2.estimateAffinePartial2D(*places, method=cv2.RANSAC, ransacReprojThreshold=MAX_SCENE_RESIDUAL_PX)
    if inside is None or inside.sum() < MIN_SCENE_MATCHES:
        return False
    variances = [np.linalg.eigvalsh(np.cov(each[inside.ravel() > 0].T))[0] for each in places]  # the narrower way
    return all(float(np.sqrt(max(0.0, variance))) >= MIN_MATCH_SPREAD_PX for variance in variances)


PIECE_SIDES_PX = (96, 224)  # px: less shows nothing, more nearly always holds the wound
WOUND_MARGIN_PX = 12  # px between a piece and the wound: its inflamed rim is no healthy skin
MIN_SKIN_SHARE = 0.6  # share of a piece that must have skin's colour
TRIES_PER_PICTURE = 40  # places tried in each picture


def healthy_pieces(pictures: Sequence[Labelled], rng: np.random.Generator, count: int) -> list[NDArray[np.uint8]]:
    """Up to `count` pieces (H, W, 3) uint8 RGB, one of each picture at most, in random order."""
    pieces: list[NDArray[np.uint8]] = []
    for number in rng.permutation(len(pictures)).tolist():
        piece = _piece(pictures[number], rng)
        if piece is not None:
            pieces.append(piece)
        if len(pieces) == count:
            break
    return pieces


def _piece(labelled: Labelled, rng: np.random.Generator) -> NDArray[np.uint8] | None:
    rows, columns = labelled.wound.shape
    kernel = np.ones((2 * WOUND_MARGIN_PX + 1, 2 * WOUND_MARGIN_PX + 1), np.uint8)
    near = cv2.dilate(labelled.wound.astype(np.uint8), kernel)
    coloured = skin(labelled.picture)
    for _ in range(TRIES_PER_PICTURE):
        side = int(min(rng.integers(PIECE_SIDES_PX[0], PIECE_SIDES_PX[1] + 1), rows, columns))
        top, left = int(rng.integers(0, rows - side + 1)), int(rng.integers(0, columns - side + 1))
        part = np.s_[top : top + side, left : left + side]
        if not near[part].any() and coloured[part].mean() >= MIN_SKIN_SHARE:
            return np.ascontiguousarray(labelled.picture[part])
    return None


def skin(picture: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """(H, W) whether a pixel has a skin's colour (Chai and Ngan, 1999: Cr and Cb, whatever the brightness)."""
    _, red, blue = cv2.split(cv2.cvtColor(picture, cv2.COLOR_RGB2YCrCb))
    return np.asarray((red >= 133) & (red <= 178) & (blue >= 77) & (blue <= 130))
