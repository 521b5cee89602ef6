"""One training sample from one labelled picture: where it is looked at, what covers it, and under what light."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from perception.training.dataset import Labelled
from perception.training.light import relit
from perception.training.occluders import covered


@dataclass(frozen=True, slots=True)
class Pyramid:
    """A picture (H, W, 3) uint8 RGB and its wound (H, W) uint8 0/255 at full, half and quarter size, and the box
    [top, left, bottom, right] round the wound at full size (None: no wound)."""

    pictures: tuple[NDArray[np.uint8], ...]
    wounds: tuple[NDArray[np.uint8], ...]
    box: NDArray[np.float64] | None


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


def pyramid(labelled: Labelled) -> Pyramid:
    """The picture at three sizes: shrinking by more than half in one warp would alias."""
    pictures, wounds = [labelled.picture], [labelled.wound.astype(np.uint8) * np.uint8(255)]
    for _ in range(2):
        height, width = pictures[-1].shape[:2]
        size = (max(1, width // 2), max(1, height // 2))
        for planes in (pictures, wounds):
            planes.append(np.asarray(cv2.resize(planes[-1], size, interpolation=cv2.INTER_AREA), np.uint8))
    return Pyramid(tuple(pictures), tuple(wounds), _box(labelled.wound))


def sample(
    source: Pyramid, other: Pyramid, how: Augmentation, rng: np.random.Generator
) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """Picture (side, side, 3) RGB and wound (side, side) 0..255; `other` lends its texture to what covers."""
    scale, centre = _look(source, how, rng)
    picture, wound = _warped(source, scale, centre, how, rng)
    if rng.random() < how.cover:
        picture, wound = covered(picture, wound, other.pictures[1], rng)
    return relit(picture, rng), wound


def _box(wound: NDArray[np.bool_]) -> NDArray[np.float64] | None:
    rows, columns = (np.flatnonzero(wound.any(axis)) for axis in (1, 0))
    return np.array([rows[0], columns[0], rows[-1] + 1, columns[-1] + 1], np.float64) if len(rows) else None


def _look(source: Pyramid, how: Augmentation, rng: np.random.Generator) -> tuple[float, NDArray[np.float64]]:
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
    source: Pyramid, scale: float, centre: NDArray[np.float64], how: Augmentation, rng: np.random.Generator
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
