"""Labelled pictures and what training makes of them.

A folder has `images/` and `labels/`, one mask of the same name and size for each picture. A group is the pictures that
show one wound: two are joined when small colour copies of them agree, mirrored and turned ones included, or when SIFT
finds one scene in both; groups are the connected components. A random split would put views of one wound on both sides
and flatter the result. One sample is one picture's view, what covers the wound, and the light.
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
from perception.wound.network import box_round
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


def hold_out_groups(group: NDArray[np.intp], held_out: int, rng: np.random.Generator) -> NDArray[np.bool_]:
    """(N,) True for the pictures held out: whole groups in random order until there are at least `held_out`."""
    chosen = np.zeros(len(group), bool)
    for number in rng.permutation(np.unique(group)):
        if chosen.sum() >= held_out:
            break
        chosen |= group == number
    return chosen


def _copy(picture: NDArray[np.uint8]) -> NDArray[np.float64]:
    """(3 * side^2,) a small square colour copy, centred and of unit length."""
    lab = cv2.cvtColor(picture, cv2.COLOR_RGB2LAB)
    small = cv2.resize(lab, (COPY_SIDE_PX, COPY_SIDE_PX), interpolation=cv2.INTER_AREA)
    centred = small.astype(np.float64) - small.mean((0, 1))
    return (centred / np.linalg.norm(centred)).ravel()


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


def relight(picture: NDArray[np.uint8], rng: np.random.Generator) -> NDArray[np.uint8]:
    """(H, W, 3) RGB as another camera might have taken it."""
    seen = np.asarray(_shaded(_coloured(picture, rng), rng))
    if rng.random() < 0.2:
        seen = np.asarray(cv2.GaussianBlur(seen, (0, 0), rng.uniform(0.4, 1.6)), np.float32)
    if rng.random() < 0.25:
        seen = seen + rng.normal(0, rng.uniform(2, 10), seen.shape).astype(np.float32)
    exposed = np.clip(seen, 0, 255).astype(np.uint8)
    if rng.random() >= 0.1:
        return exposed
    written, data = cv2.imencode(".jpg", exposed, [cv2.IMWRITE_JPEG_QUALITY, int(rng.integers(25, 80))])
    assert written
    return np.asarray(cv2.imdecode(data, cv2.IMREAD_COLOR), np.uint8)


def _coloured(picture: NDArray[np.uint8], rng: np.random.Generator) -> NDArray[np.float32]:
    """White balance, gamma, brightness, saturation and a small turn of the hue; now and then no colour at all."""
    levels = np.arange(256, dtype=np.float32) / 255
    gamma, gain = np.exp(rng.normal(0, 0.25)), np.exp(rng.normal(0, 0.15))
    balance = np.exp(rng.normal(0, 0.08, 3))
    tables = np.clip(255 * gain * balance[None] * levels[:, None] ** gamma, 0, 255).astype(np.uint8)
    seen = cv2.LUT(picture, np.ascontiguousarray(tables[None]))
    if rng.random() < 0.3:
        turned = cv2.cvtColor(seen, cv2.COLOR_RGB2HSV)
        turned[..., 0] = (turned[..., 0].astype(np.int16) + int(rng.integers(-7, 8))) % 180
        seen = cv2.cvtColor(turned, cv2.COLOR_HSV2RGB)
    saturation = 0.0 if rng.random() < 0.04 else rng.uniform(0.5, 1.4)
    grey = cv2.cvtColor(seen, cv2.COLOR_RGB2GRAY).astype(np.float32)[..., None]
    return np.asarray(grey + np.float32(saturation) * (seen - grey), np.float32)


def _shaded(picture: NDArray[np.float32], rng: np.random.Generator) -> NDArray[np.float32]:
    """Light that falls off to one side, a third of the time."""
    if rng.random() > 0.33:
        return picture
    height, width = picture.shape[:2]
    across, down = rng.normal(0, 0.25, 2)
    slope = 1 + down * np.linspace(-1, 1, height)[:, None] + across * np.linspace(-1, 1, width)[None]
    return picture * np.clip(slope, 0.2, 2).astype(np.float32)[..., None]


def cover_sample(
    picture: NDArray[np.uint8], wound: NDArray[np.uint8], texture: NDArray[np.uint8], rng: np.random.Generator
) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """One to three shapes drawn over the picture (H, W, 3); what they hide is no longer wound (H, W)."""
    picture, wound = picture.copy(), wound.copy()
    for _ in range(int(rng.integers(1, 4)) if rng.random() < 0.4 else 1):
        shape = _shape(wound, rng)
        edge = cv2.GaussianBlur(shape, (0, 0), rng.uniform(0.4, 1.2))
        opaque = edge[..., None].astype(np.float32) / 255
        picture = (picture + opaque * (_surface(picture.shape[0], texture, rng) - picture)).astype(np.uint8)
        wound[shape > 127] = 0
    return picture, wound


def _shape(wound: NDArray[np.uint8], rng: np.random.Generator) -> NDArray[np.uint8]:
    """(H, W) 0/255: a bar, an ellipse, a polygon, or everything beyond a line through the wound."""
    side = wound.shape[0]
    drawn = np.zeros((side, side), np.uint8)
    rows, columns = np.nonzero(wound > 127)
    place = rng.uniform(0, side, 2)
    if len(rows) and rng.random() < 0.8:
        chosen = rng.integers(len(rows))
        place = np.array([columns[chosen], rows[chosen]], np.float64)
    angle = rng.uniform(0, 2 * np.pi)
    along = np.array([np.cos(angle), np.sin(angle)])
    kind = rng.integers(4)
    if kind == 0:
        _fill(drawn, place + _rectangle(along, rng.uniform(0.3, 1.6) * side, rng.uniform(0.03, 0.2) * side, shift=True))
    elif kind == 1:
        axes = (int(rng.uniform(0.05, 0.3) * side), int(rng.uniform(0.05, 0.3) * side))
        cv2.ellipse(drawn, (int(place[0]), int(place[1])), axes, np.degrees(angle), 0, 360, 255, -1)
    elif kind == 2:
        turns = np.sort(rng.uniform(0, 2 * np.pi, int(rng.integers(3, 8))))
        radius = rng.uniform(0.06, 0.35, len(turns)) * side
        _fill(drawn, place + radius[:, None] * np.column_stack([np.cos(turns), np.sin(turns)]))
    else:
        depth = rng.uniform(0.1, 1.0) * side
        corners = _rectangle(along, depth, rng.uniform(0.3, 2) * side, shift=False)
        _fill(drawn, place + along[None] * depth / 2 + corners)
    return drawn


def _rectangle(along: NDArray[np.float64], length: float, width: float, shift: bool) -> NDArray[np.float64]:
    """(4, 2) corners round the origin, or with one short side there."""
    across = np.array([-along[1], along[0]])
    ends = np.array([[0, -1], [1, -1], [1, 1], [0, 1]] if shift else [[-0.5, -1], [0.5, -1], [0.5, 1], [-0.5, 1]])
    return ends[:, :1] * length * along + ends[:, 1:] * width / 2 * across


def _fill(drawn: NDArray[np.uint8], corners: NDArray[np.float64]) -> None:
    cv2.fillPoly(drawn, [np.round(corners).astype(np.int32)], 255)


def _surface(side: int, texture: NDArray[np.uint8], rng: np.random.Generator) -> NDArray[np.float32]:
    """(side, side, 3) what the thing looks like: one colour under a slope of light, or cut from another picture."""
    if rng.random() < 0.3 and min(texture.shape[:2]) > 32:
        length = int(rng.integers(24, min(texture.shape[:2])))
        top, left = (int(rng.integers(0, full - length + 1)) for full in texture.shape[:2])
        cut = texture[top : top + length, left : left + length]
        return cv2.resize(cut, (side, side), interpolation=cv2.INTER_LINEAR).astype(np.float32)
    grey = rng.uniform(0, 255)
    colour = np.full(3, grey) if rng.random() < 0.6 else rng.uniform(0, 255, 3)
    slope = np.linspace(-1, 1, side)[:, None] * rng.normal(0, 25) + np.linspace(-1, 1, side)[None] * rng.normal(0, 25)
    grain = rng.normal(0, rng.uniform(0, 8), (side, side))
    return np.clip(colour + (slope + grain)[..., None], 0, 255).astype(np.float32)


@dataclass(frozen=True, slots=True)
class SamplePyramid:
    """A picture and its wound at full, half and quarter size."""

    pictures: tuple[NDArray[np.uint8], ...]  # (H, W, 3) RGB
    wounds: tuple[NDArray[np.uint8], ...]  # (H, W) 0/255
    box: NDArray[np.float64] | None  # [top, left, bottom, right] round the wound at full size; None: no wound


@dataclass(frozen=True, slots=True)
class Augmentation:
    """What is varied, and how often."""

    side: int = 192  # px of a sample: the second look's window
    long_side: float = 256.0  # px of a whole picture: the first look
    whole: float = 0.46  # share of samples seen as the first look sees them
    away: float = 0.13  # share seen at any place and scale; the rest is seen as by the second look
    shares: tuple[float, float] = (0.2, 0.85)  # of the window that a wound takes in the second look
    scales: tuple[float, float] = (0.3, 3.0)  # px of a sample per px of the picture
    stretch: float = 0.1  # deviation of the logarithm of height over width
    cover: float = 0.42  # share of samples with something in front


def sample_pyramid(labelled: Labelled) -> SamplePyramid:
    """The picture at three sizes: shrinking by more than half in one warp would alias."""
    pictures, wounds = [labelled.picture], [labelled.wound.astype(np.uint8) * np.uint8(255)]
    for _ in range(2):
        height, width = pictures[-1].shape[:2]
        size = (max(1, width // 2), max(1, height // 2))
        for planes in (pictures, wounds):
            planes.append(np.asarray(cv2.resize(planes[-1], size, interpolation=cv2.INTER_AREA), np.uint8))
    return SamplePyramid(tuple(pictures), tuple(wounds), box_round(labelled.wound))


def draw_sample(
    source: SamplePyramid, other: SamplePyramid, how: Augmentation, rng: np.random.Generator
) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """Picture (side, side, 3) RGB and wound (side, side) 0..255; `other` lends its texture to what covers."""
    scale, centre = _draw_view(source, how, rng)
    picture, wound = _warped(source, scale, centre, how, rng)
    if rng.random() < how.cover:
        picture, wound = cover_sample(picture, wound, other.pictures[1], rng)
    return relight(picture, rng), wound


def _draw_view(source: SamplePyramid, how: Augmentation, rng: np.random.Generator) -> tuple[float, NDArray[np.float64]]:
    """Scale and centre (row, column) of one look at the picture."""
    size = np.array(source.pictures[0].shape[:2], np.float64)
    kind = rng.random()
    anywhere = rng.uniform(0.2, 0.8, 2) * size
    if kind < how.away:
        return float(np.exp(rng.uniform(np.log(0.4), np.log(3.0)))), anywhere
    if kind < how.away + how.whole or source.box is None:
        scale = how.long_side / size.max() * float(np.exp(rng.uniform(-0.3, 0.3)))
        near = source.box is not None and rng.random() < 0.6
        target = _middle(source.box) if near and source.box is not None else anywhere
        return scale, target + rng.uniform(-0.35, 0.35, 2) * how.side / scale
    extent = float(np.max(source.box[2:] - source.box[:2]))
    share = float(np.exp(rng.uniform(*np.log(how.shares))))
    scale = float(np.clip(how.side * share / extent, *how.scales))
    return scale, _middle(source.box) + rng.normal(0, 0.12, 2) * how.side / scale


def _middle(box: NDArray[np.float64]) -> NDArray[np.float64]:
    return (box[:2] + box[2:]) / 2


def _warped(
    source: SamplePyramid, scale: float, centre: NDArray[np.float64], how: Augmentation, rng: np.random.Generator
) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """The look, turned by any angle, mirrored half the time, stretched and sheared a little."""
    level = int(np.clip(np.floor(-np.log2(scale)), 0, 2))
    angle = rng.normal(0, 0.35) + rng.integers(4) * np.pi / 2
    stretch, shear = np.exp(rng.normal(0, how.stretch / 2)), rng.normal(0, 0.06)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    shape = np.array([[stretch, shear], [0, 1 / stretch]]) @ np.diag([rng.choice((-1.0, 1.0)), 1.0])
    matrix = turn @ shape / scale / 2**level  # picture px from sample px
    middle = centre[::-1] / 2**level
    inverse = np.column_stack([matrix, middle - matrix @ np.full(2, how.side / 2)])
    border = cv2.BORDER_REFLECT_101 if rng.random() < 0.5 else cv2.BORDER_CONSTANT
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    size = (how.side, how.side)
    return tuple(
        np.asarray(cv2.warpAffine(plane[level], inverse, size, flags=flags, borderMode=border), np.uint8)
        for plane in (source.pictures, source.wounds)
    )  # type: ignore[return-value]
