"""What a segmenter is judged by: Dice of each picture, silence where there is no wound, a wound half covered."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from estimation.se3 import Array
from perception.dice import dice
from perception.frames import Image
from perception.training.dataset import Labelled
from perception.wound.segmentation import Mask, Segmenter

HOLDER = 0.6  # of the wound's larger side by which what covers it reaches beyond it


def bgr(picture: NDArray[np.uint8]) -> Image:
    """(H, W, 3) RGB as cameras give it."""
    return np.ascontiguousarray(picture[..., ::-1])


def scores(segmenter: Segmenter, pictures: Sequence[Labelled], seen: Callable[[int, int], None]) -> Array:
    """(N,) Dice of each picture; an empty truth scores 1 with an empty mask and 0 with any other."""
    found = []
    for each in pictures:
        found.append(dice(segmenter(bgr(each.picture)).mask, each.wound))
        seen(len(found), len(pictures))
    return np.array(found)


def silent(segmenter: Segmenter, pictures: Sequence[NDArray[np.uint8]]) -> float:
    """Share of pictures (H, W, 3) RGB without a wound in which none is found; nan without pictures."""
    return float(np.mean([not segmenter(bgr(each)).found for each in pictures] or np.nan))


def half_covered_fall(
    segmenter: Segmenter, pictures: Sequence[Labelled], rng: np.random.Generator
) -> tuple[float, float]:
    """Mean Dice on the half of the wound that stays open, before it is covered and after; pictures with a wound only.

    Both are taken over the open part of the picture; what is found on the cover itself is not a matter of it.
    """
    before: list[float] = []
    after: list[float] = []
    for each in pictures:
        if not each.wound.any():
            continue
        covered, cover = half_covered(each, rng)
        opened = ~cover
        for picture, kept in ((each.picture, before), (covered, after)):
            kept.append(dice(segmenter(bgr(picture)).mask & opened, each.wound & opened))
    return float(np.mean(before or np.nan)), float(np.mean(after or np.nan))


def half_covered(labelled: Labelled, rng: np.random.Generator) -> tuple[NDArray[np.uint8], Mask]:
    """The picture (H, W, 3) RGB with half of the wound's area behind a plain thing with a straight edge, and where that
    thing is (H, W)."""
    rows, columns = np.nonzero(labelled.wound)
    places = np.column_stack([columns, rows]).astype(float)
    angle = rng.uniform(0, 2 * np.pi)
    along = np.array([np.cos(angle), np.sin(angle)])
    across = np.array([-along[1], along[0]])
    edge = float(np.median(places @ along))
    spans = places @ along, places @ across
    reach = HOLDER * max(np.ptp(spans[0]), np.ptp(spans[1]), 8.0)
    near, far, low, high = edge, spans[0].max() + reach, spans[1].min() - reach, spans[1].max() + reach
    corners = [u * along + v * across for u, v in ((near, low), (far, low), (far, high), (near, high))]
    cover = np.zeros(labelled.wound.shape, np.uint8)
    cv2.fillPoly(cover, [np.round(corners).astype(np.int32)], 1)
    picture = labelled.picture.copy()
    shade = rng.uniform(30, 225) + rng.normal(0, 4, labelled.wound.shape)
    picture[cover > 0] = np.clip(shade, 0, 255).astype(np.uint8)[cover > 0, None]
    return picture, cover > 0
