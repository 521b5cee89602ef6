"""Labelled pictures for training: groups, folds, pieces of healthy skin, and augmented samples.

A folder has `images/` and `labels/`, one mask of the same name and size for each picture. A group is the pictures that
show one wound: two are joined if their thumbnails correlate, also mirrored or rotated, or if SIFT finds one scene in
both; groups are the connected components. A random split would put views of one wound into both parts and make the
result look better than it is.

A sample is a view of a picture as in one of the two passes, sometimes with an occlusion, in other light. It has its own
random generator: the same seed and number give the same sample.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import cos, exp, sin
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.sparse.csgraph import connected_components
from scipy.spatial.transform import Rotation
from scipy.special import expit

from estimation.errors import InputError
from perception.wound.network import box_round
from perception.wound.segmentation import picture_box

PICTURE_SUFFIXES = (".jpg", ".jpeg", ".png", ".bmp", ".tif", ".tiff")


@dataclass(frozen=True, slots=True)
class Labelled:
    """A picture and the mask of its wounds, without the black padding of some data sets."""

    name: str  # "folder/file"
    picture: NDArray[np.uint8]  # (H, W, 3) RGB
    wound: NDArray[np.bool_]  # (H, W)


def read_dataset(folder: Path, report: Callable[[int, int], None] = lambda done, total: None) -> list[Labelled]:
    """All pictures of a folder, sorted by name; `report(done, total)` is called after each.

    InputError: no such folder, no picture in it, a picture without its mask, one that cannot be read, another size.
    """
    files = [file for file in _files_of(folder / "images") if file.suffix.lower() in PICTURE_SUFFIXES]
    if not files:
        allowed = f"one at least, ending in {', '.join(PICTURE_SUFFIXES)}"
        raise InputError(str(folder / "images"), "pictures", "none", allowed)
    masks = {file.stem: file for file in _files_of(folder / "labels")}
    labelled = []
    for file in files:
        if file.stem not in masks:
            raise InputError(str(file), "mask", "none", f"a picture named {file.stem} in {folder / 'labels'}")
        labelled.append(_read_pair(folder.name, file, masks[file.stem]))
        report(len(labelled), len(files))
    return labelled


def _files_of(folder: Path) -> Sequence[Path]:
    if not folder.is_dir():
        raise InputError(str(folder), "data set", "no such folder", "a folder that holds images/ and labels/")
    return sorted(folder.iterdir())


def _read_pair(place: str, file: Path, mask_file: Path) -> Labelled:
    picture = np.asarray(cv2.cvtColor(_read(file, cv2.IMREAD_COLOR), cv2.COLOR_BGR2RGB), np.uint8)
    mask = _read(mask_file, cv2.IMREAD_GRAYSCALE)
    if mask.shape != picture.shape[:2]:
        raise InputError(str(mask_file), "size (H, W)", mask.shape, f"that of its picture, {picture.shape[:2]}")
    box = picture_box(picture)
    # masks are 0/255 or 0/1: the wound is above half of the maximum
    wound = mask > (127 if mask.max(initial=0) > 1 else 0)
    return Labelled(f"{place}/{file.name}", np.ascontiguousarray(picture[box]), np.ascontiguousarray(wound[box]))


def _read(file: Path, mode: int) -> NDArray[np.uint8]:
    picture = cv2.imread(str(file), mode)
    if picture is None:
        raise InputError(str(file), "picture", "unreadable", f"a whole file of one of {', '.join(PICTURE_SUFFIXES)}")
    return np.asarray(picture, np.uint8)


THUMBNAIL_SIDE_PX = 16
# Exact duplicates correlate by 0.99, two visits of one foot by 0.84 to 0.93, as do a few pictures of different feet:
# joining too many only makes the split stricter.
MIN_THUMBNAIL_CORRELATION = 0.84
MAX_CANDIDATES = 40
SCENE_FEATURES = 500
SCENE_SIDE_PX = 400
LOWE_RATIO = 0.8
MAX_SCENE_RESIDUAL_PX = 8.0
# Inliers of a similarity transform, and their standard deviation in the narrower direction: a date stamp or a floor
# board in two pictures is a short line.
MIN_SCENE_MATCHES = 10
MIN_MATCH_SPREAD_PX = 20.0

Features = tuple[NDArray[np.float32], NDArray[np.float32]]


def picture_groups(pictures: Sequence[Labelled]) -> NDArray[np.intp]:
    """(N,) number of each picture's group."""
    thumbnails = np.stack([_thumbnail(each.picture) for each in pictures])
    similarity = np.max([thumbnails @ _symmetric(thumbnails, turn).T for turn in range(8)], axis=0)
    joined = similarity > MIN_THUMBNAIL_CORRELATION
    features = [_features(each.picture) for each in pictures]
    nearest = np.argsort(-similarity, axis=1, kind="stable")[:, : MAX_CANDIDATES + 1]
    pairs = {(min(a, b), max(a, b)) for a, row in enumerate(nearest.tolist()) for b in row if a != b}
    for first, second in sorted(pairs):
        if not joined[first, second] and _same_scene(features[first], features[second]):
            joined[first, second] = True
    return connected_components(joined, directed=False)[1].astype(np.intp)


def fold_numbers(group: NDArray[np.intp], folds: int, rng: np.random.Generator) -> NDArray[np.intp]:
    """(N,) fold of each picture: whole groups in random order, each into the fold with the fewest pictures."""
    fold, filled = np.zeros(len(group), np.intp), np.zeros(folds, int)
    for number in rng.permutation(np.unique(group)):
        inside = group == number
        fold[inside] = np.argmin(filled)
        filled[fold[inside][0]] += inside.sum()
    return fold


def _thumbnail(picture: NDArray[np.uint8]) -> NDArray[np.float64]:
    """(3 * side^2,) a small square colour copy, centred and of unit length."""
    lab = cv2.cvtColor(picture, cv2.COLOR_RGB2LAB)
    small = cv2.resize(lab, (THUMBNAIL_SIDE_PX, THUMBNAIL_SIDE_PX), interpolation=cv2.INTER_AREA)
    centred = small.astype(np.float64) - small.mean((0, 1))
    return (centred / max(float(np.linalg.norm(centred)), 1e-9)).ravel()  # a picture of one colour correlates with none


def _symmetric(thumbnails: NDArray[np.float64], turn: int) -> NDArray[np.float64]:
    """The thumbnails under one of the eight symmetries of the square."""
    square = thumbnails.reshape(-1, THUMBNAIL_SIDE_PX, THUMBNAIL_SIDE_PX, 3)
    return np.rot90(square[:, :, ::-1] if turn & 4 else square, turn & 3, (1, 2)).reshape(len(thumbnails), -1)


def _features(picture: NDArray[np.uint8]) -> Features:
    scale = SCENE_SIDE_PX / max(picture.shape[:2])
    grey = cv2.resize(cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY), None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    points, descriptors = cv2.SIFT.create(SCENE_FEATURES).detectAndCompute(grey, None)
    if descriptors is None:
        return np.zeros((0, 2), np.float32), np.zeros((0, 128), np.float32)
    return np.array([point.pt for point in points], np.float32), np.asarray(descriptors, np.float32)


def _same_scene(first: Features, second: Features) -> bool:
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


PIECE_SIDES_PX = (96, 224)  # smaller pieces show nothing, larger ones nearly always contain the wound
WOUND_MARGIN_PX = 12  # between a piece and the wound: its inflamed rim is not healthy skin
MIN_SKIN_SHARE = 0.6  # share of a piece's pixels with the colour of skin
TRIES_PER_PICTURE = 40


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
    coloured = is_skin(labelled.picture)
    for _ in range(TRIES_PER_PICTURE):
        side = int(min(rng.integers(PIECE_SIDES_PX[0], PIECE_SIDES_PX[1] + 1), rows, columns))
        top, left = int(rng.integers(0, rows - side + 1)), int(rng.integers(0, columns - side + 1))
        part = np.s_[top : top + side, left : left + side]
        if not near[part].any() and coloured[part].mean() >= MIN_SKIN_SHARE:
            return np.ascontiguousarray(labelled.picture[part])
    return None


def is_skin(picture: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """(H, W) whether a pixel has the colour of skin (Chai and Ngan, 1999: Cr and Cb, at any brightness)."""
    _, red, blue = cv2.split(cv2.cvtColor(picture, cv2.COLOR_RGB2YCrCb))
    return np.asarray((red >= 133) & (red <= 178) & (blue >= 77) & (blue <= 130))


LONGEST_SIDE_PX = 640  # of the pictures that samples are drawn from
MAX_HALVINGS = 2  # of a picture before it is warped: one warp that shrinks by more would alias
COVER_CELLS = 16  # columns and rows of the grid in which an occlusion's place is drawn
GREY = (0.299, 0.587, 0.114)  # ITU-R BT.601
BLUR_PX = (9, 9)  # window of the blur

Planes = NDArray[np.float32]  # (side, side, 4) in 0..1: RGB and the wound


@dataclass(frozen=True, slots=True)
class Augmentation:
    """Ranges and shares of the random changes."""

    side: int = 256  # px of a sample: window of the second pass
    long_side: float = 320.0  # px of a whole picture: first pass
    whole: float = 0.42  # share of samples as in the first pass
    away: float = 0.13  # share at any place and scale; the rest is as in the second pass
    shares: tuple[float, float] = (0.2, 0.85)  # of the window that a wound takes in the second pass
    scales: tuple[float, float] = (0.3, 3.0)  # px of a sample per px of the picture
    stretch: float = 0.1  # standard deviation of the logarithm of height over width
    cover: float = 0.5  # share of samples with an occlusion


class Samples:
    """Samples by number: picture (3, side, side) RGB and wound (1, side, side), float32 in 0..1."""

    def __init__(
        self, pictures: Sequence[Labelled], weights: NDArray[np.float64], augmentation: Augmentation, seed: int
    ) -> None:
        """weights: (N,) relative frequency of each picture."""
        self._planes = [_shrink(each) for each in pictures]
        self._boxes = [box_round(each[..., 3] > 127) for each in self._planes]  # of the wound; None without one
        self._shares, self._augmentation, self._seed = weights / weights.sum(), augmentation, seed

    def __getitem__(self, number: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """One sample."""
        rng = np.random.default_rng([self._seed, number])
        planes = self._draw_view(rng)
        if rng.random() < self._augmentation.cover:
            planes = self._occlude(planes, rng)
        picture, wound = _change_light(planes[..., :3], rng), planes[None, ..., 3]
        return np.ascontiguousarray(picture.transpose(2, 0, 1)), np.ascontiguousarray(wound)

    def _draw_view(self, rng: np.random.Generator) -> Planes:
        """A view of one picture: rotated by any angle, mirrored half the time, stretched and sheared."""
        number, side = int(rng.choice(len(self._planes), p=self._shares)), self._augmentation.side
        scale, centre = self._scale_and_centre(number, rng)
        halved = 0.5 ** int(np.clip(np.floor(-np.log2(scale)), 0, MAX_HALVINGS))
        planes = cv2.resize(self._planes[number], None, fx=halved, fy=halved, interpolation=cv2.INTER_AREA)
        angle = rng.normal(0, 0.35) + rng.integers(4) * np.pi / 2
        stretch, shear = np.exp(rng.normal(0, self._augmentation.stretch / 2)), rng.normal(0, 0.06)
        rotation = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        shape = np.array([[stretch, shear], [0, 1 / stretch]]) @ np.diag([rng.choice((-1.0, 1.0)), 1.0])
        linear = halved / scale * rotation @ shape  # column and row in the picture from those in the sample
        offset = halved * centre[::-1] - linear @ np.full(2, (side - 1) / 2)
        warp, size, flags = np.column_stack([linear, offset]), (side, side), cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        planes = planes.astype(np.float32) / np.float32(255)  # in 8 bits, rounding would add grain
        if rng.random() < 0.5:
            return np.asarray(
                cv2.warpAffine(planes, warp, size, flags=flags, borderMode=cv2.BORDER_REFLECT_101), np.float32
            )
        # black beyond a sharp edge: OpenCV's own black border fades over a pixel
        flags_inside = cv2.INTER_NEAREST | cv2.WARP_INVERSE_MAP
        inside = cv2.warpAffine(np.ones(planes.shape[:2], np.float32), warp, size, flags=flags_inside)
        planes = cv2.warpAffine(planes, warp, size, flags=flags, borderMode=cv2.BORDER_REPLICATE)
        return np.asarray(planes * inside[..., None], np.float32)

    def _scale_and_centre(self, number: int, rng: np.random.Generator) -> tuple[float, NDArray[np.float64]]:
        """Px of the sample per px of the picture, and the place (row, column) at its middle."""
        ranges, box = self._augmentation, self._boxes[number]
        size = np.array(self._planes[number].shape[:2], float)
        kind, anywhere = rng.random(), rng.uniform(0.2, 0.8, 2) * size
        if kind < ranges.away:
            return float(np.exp(rng.uniform(np.log(0.4), np.log(3.0)))), anywhere
        if kind < ranges.away + ranges.whole or box is None:
            scale = ranges.long_side / size.max() * float(np.exp(rng.uniform(-0.3, 0.3)))
            target = (box[:2] + box[2:]) / 2 if box is not None and rng.random() < 0.6 else anywhere
            return scale, target + rng.uniform(-0.35, 0.35, 2) * ranges.side / scale
        share = float(np.exp(rng.uniform(*np.log(ranges.shares))))
        scale = float(np.clip(ranges.side * share / float(np.max(box[2:] - box[:2])), *ranges.scales))
        return scale, (box[:2] + box[2:]) / 2 + rng.normal(0, 0.12, 2) * ranges.side / scale

    def _occlude(self, planes: Planes, rng: np.random.Generator) -> Planes:
        """With one to three occlusions: a plain material, which hides the wound, or a part of another picture with its
        wound."""
        wound = planes[..., 3]
        for _ in range(int(rng.integers(1, 4)) if rng.random() < 0.4 else 1):
            shape = _cover_shape(self._augmentation.side, _cover_place(wound, rng), rng)
            front = self._draw_view(rng) if rng.random() < 0.3 else _cover_material(self._augmentation.side, rng)
            alpha: Planes = np.dstack([shape, shape, shape, shape > 0.5]).astype(np.float32)
            planes = np.asarray(planes + alpha * (front - planes), np.float32)
        return planes


def _shrink(labelled: Labelled) -> NDArray[np.uint8]:
    planes = np.dstack([labelled.picture, labelled.wound.astype(np.uint8) * np.uint8(255)])
    scale = min(1.0, LONGEST_SIDE_PX / max(labelled.wound.shape))
    return np.asarray(cv2.resize(planes, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA), np.uint8)


def _cover_place(wound: NDArray[np.float32], rng: np.random.Generator) -> NDArray[np.float64]:
    """(2,) column and row in 0..1: on the wound four times of five, anywhere if there is none."""
    density = cv2.resize(wound, (COVER_CELLS, COVER_CELLS), interpolation=cv2.INTER_AREA).ravel().astype(float)
    density = density * (rng.random() < 0.8) + 1e-9
    cell = int(rng.choice(len(density), p=density / density.sum()))
    return (np.array([cell % COVER_CELLS, cell // COVER_CELLS]) + rng.random(2)) / COVER_CELLS


def _cover_shape(side: int, place: NDArray[np.float64], rng: np.random.Generator) -> NDArray[np.float32]:
    """(side, side) opacity in 0..1: a bar, a half plane, or a lobed blob."""
    at = (np.arange(side, dtype=np.float32) + 0.5) / side
    right, down = at - place.astype(np.float32)[0], (at - place.astype(np.float32)[1])[:, None]
    angle, kind = rng.uniform(0, 2 * np.pi), rng.random()
    along, across = cos(angle) * right + sin(angle) * down, cos(angle) * down - sin(angle) * right
    if kind < 0.65:
        lengths, widths = ((0.15, 0.8), (0.015, 0.1)) if kind < 0.2 else ((0.05, 0.5), (0.15, 1.0))
        length, width = rng.uniform(*lengths), rng.uniform(*widths)
        distance = np.maximum(np.abs(along - length) - length, np.abs(across) - width)
    else:
        direction = np.arctan2(across, along * exp(rng.normal(0, 0.4)))
        radius = np.full_like(direction, rng.uniform(0.06, 0.3))
        for lobes in range(2, 6):
            radius *= 1 + rng.normal(0, 0.25 / lobes**0.5) * np.cos(lobes * direction + rng.uniform(0, 2 * np.pi))
        distance = cv2.magnitude(across, along) - radius
    return expit(-distance * (side / rng.uniform(0.3, 1.0)))


def _cover_material(side: int, rng: np.random.Generator) -> Planes:
    """Gloves, drapes, gauze, tools: one colour with a gradient and grain, a third of them woven; no wound."""
    at = np.linspace(-1, 1, side, dtype=np.float32)
    down = at[:, None]
    colour = rng.uniform(0, 1, 1 if rng.random() < 0.5 else 3).astype(np.float32)
    shade = rng.normal(0, 0.1) * at + rng.normal(0, 0.1) * down
    shade = shade + rng.uniform(0, 0.03) * rng.standard_normal((side, side), np.float32)
    if rng.random() < 0.33:
        angle, threads = rng.uniform(0, np.pi), rng.uniform(15, 120)  # radians from the middle to the edge
        u, v = threads * cos(angle), threads * sin(angle)
        shade = shade + rng.uniform(0.03, 0.3) * np.sin(u * at + v * down) * np.sin(u * down - v * at)
    planes = np.zeros((side, side, 4), np.float32)
    planes[..., :3] = np.clip(colour + shade[..., None], 0, 1)
    return planes


def _change_light(picture: NDArray[np.float32], rng: np.random.Generator) -> NDArray[np.float32]:
    """The picture (side, side, 3) with other gamma, white balance, saturation, hue, light gradient, blur and noise."""
    balance, gamma = np.exp(rng.normal(0, 0.15) + rng.normal(0, 0.08, 3)), exp(rng.normal(0, 0.25))
    saturation = 0.0 if rng.random() < 0.04 else rng.uniform(0.5, 1.4)
    hue = rng.normal(0, 0.15) if rng.random() < 0.3 else 0.0  # rad about the grey axis
    mix = saturation * Rotation.from_rotvec(np.full(3, hue / 3**0.5)).as_matrix()
    grey = np.tile(GREY, (3, 1))
    out = cv2.transform(
        cv2.pow(np.maximum(picture, np.float32(1e-4)), gamma), (grey + mix @ (np.eye(3) - grey)) * balance
    )
    if rng.random() < 0.33:
        at = np.linspace(-1, 1, len(out), dtype=np.float32)
        light = 1 + rng.normal(0, 0.25) * at + rng.normal(0, 0.25) * at[:, None]
        out = out * np.clip(light, 0.2, 2)[..., None]
    if rng.random() < 0.25:
        out = cv2.GaussianBlur(out, BLUR_PX, rng.uniform(0.4, 1.8), borderType=cv2.BORDER_REPLICATE)
    if rng.random() < 0.3:
        out = out + np.float32(rng.uniform(0.008, 0.04)) * rng.standard_normal(out.shape, np.float32)
    return np.asarray(np.round(np.clip(out, 0, 1) * 255) / 255, np.float32)  # as 8 bits give it
