"""Closed outlines in a picture that could be a wound's, and what can be said of each: colour, contrast, shape."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from estimation.se3 import Array

Contour = NDArray[np.int32]  # (N, 1, 2) px, as OpenCV has them

SIDE = 256  # px of the picture's longer side: outlines are no finer than the network's first look
AROUND = 24.0  # px, one sigma: what a pixel's own surroundings are
LEVELS = np.arange(-4.0, 6.0, 0.5)  # of the colour's log odds
REDNESS = (80.0, 86.0, 90.0, 93.0, 95.0, 97.0, 98.5, 99.3)  # percentiles above which a* may be a wound's
DARKNESS = (88.0, 93.0, 96.0, 98.0, 99.0)  # the same of darkness: dead tissue is black
YELLOWNESS = (90.0, 94.0, 97.0, 98.5)  # and of b*: slough
SMALLEST, LARGEST = 10.0, 0.4  # px, share of the picture
RING = 0.25  # width of an outline's surroundings, of its longer side
UNLIKE = 3.0  # matchShapes beyond this says no more
METHODS = (cv2.CONTOURS_MATCH_I1, cv2.CONTOURS_MATCH_I2, cv2.CONTOURS_MATCH_I3)
COLOUR_TERMS = 28  # of `colour_terms`
FEATURES = 19  # of `described`
OTHER_SIZE = 2.5  # the logarithm of two areas' ratio beyond which more says no more


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """A picture made small. lab: (H, W, 3) CIE Lab, blurred by a pixel. odds: (H, W) log odds of the wound's colours.
    scale: px of it per px of the picture."""

    lab: NDArray[np.float32]
    odds: NDArray[np.float32]
    scale: float


def scene_of(picture: NDArray[np.uint8], weights: Array) -> Scene:
    """What outlines are looked for in. picture: (H, W, 3) RGB. weights: (COLOUR_TERMS,) of the log odds."""
    scale = min(1.0, SIDE / max(picture.shape[:2]))
    seen = cv2.resize(picture, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    lab = np.asarray(
        cv2.GaussianBlur(cv2.cvtColor(seen, cv2.COLOR_RGB2LAB).astype(np.float32), (0, 0), 1.0), np.float32
    )
    return Scene(lab, np.asarray(colour_terms(lab) @ weights, np.float32), scale)


def colour_terms(lab: NDArray[np.float32]) -> NDArray[np.float32]:
    """(H, W, COLOUR_TERMS): one, the colour, how it differs from its surroundings, and all products of two."""
    around = cv2.GaussianBlur(lab, (0, 0), AROUND)
    terms = cv2.split(np.dstack([lab / 64 - 2, (lab - around) / 64]))
    products = [terms[i] * terms[j] for i in range(len(terms)) for j in range(i, len(terms))]
    return np.dstack([np.ones_like(terms[0]), *terms, *products])


def outlines(scene: Scene) -> list[Contour]:
    """Outlines of everything above some level of the colour's odds, of redness, darkness or yellowness."""
    light, red, yellow = cv2.split(scene.lab)
    maps = [(scene.odds, LEVELS)]
    for value, shares in ((red, REDNESS), (-light, DARKNESS), (yellow, YELLOWNESS)):
        maps.append((np.asarray(value), np.percentile(value, shares)))
    found: list[Contour] = []
    for value, levels in maps:
        for level in levels:
            above = (value > level).astype(np.uint8)
            for mask in (above, cv2.morphologyEx(above, cv2.MORPH_OPEN, np.ones((5, 5), np.uint8))):
                seen, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
                found += [np.asarray(each, np.int32) for each in seen]
    return [c for c in found if SMALLEST <= cv2.contourArea(c) <= LARGEST * scene.odds.size]


def described(scene: Scene, contour: Contour, patterns: Sequence[Contour], area: float | None) -> Array:
    """(FEATURES,) colour inside and around, compactness, size, place, and how unlike the most alike pattern it is.

    area: px^2 of the picture that the wound should cover, None where nobody knows.
    """
    x, y, width, height = cv2.boundingRect(contour)
    reach = max(3, int(RING * max(width, height)))
    rows, columns = scene.odds.shape
    x0, y0, x1, y1 = (
        max(0, x - reach),
        max(0, y - reach),
        min(columns, x + width + reach),
        min(rows, y + height + reach),
    )
    filled = np.zeros((y1 - y0, x1 - x0), np.uint8)
    cv2.drawContours(filled, [contour - np.array([[x0, y0]], np.int32)], -1, 1, -1)
    wide = np.asarray(cv2.dilate(filled, np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)), np.uint8)
    inside, ring = _means(scene, (slice(y0, y1), slice(x0, x1)), filled, wide - filled)
    covered, length = cv2.contourArea(contour), cv2.arcLength(contour, True)
    hull = max(cv2.contourArea(cv2.convexHull(contour)), 1.0)
    cut = x <= 1 or y <= 1 or x + width >= columns - 1 or y + height >= rows - 1
    away = np.hypot((x + width / 2) / columns - 0.5, (y + height / 2) / rows - 0.5)
    shape = (
        covered / hull,
        4 * np.pi * covered / max(length, 1.0) ** 2,
        np.log(covered / scene.odds.size),
        float(cut),
        away,
    )
    size = 0.0 if area is None else np.clip(np.log(covered / (area * scene.scale**2)), -OTHER_SIZE, OTHER_SIZE)
    return np.array([*inside, *ring, inside[0] - ring[0], *shape, *_unlike(contour, patterns), size, abs(size)])


def _means(
    scene: Scene, part: tuple[slice, slice], inside: NDArray[np.uint8], ring: NDArray[np.uint8]
) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Log odds and Lab colour, means inside and around."""
    odds, lab = scene.odds[part], scene.lab[part]
    found = []
    for mask in (inside, ring if ring.any() else inside):
        level = cv2.mean(odds, mask)[0]
        found.append((level, *(value / 64 - 2 for value in cv2.mean(lab, mask)[:3])))
    return found[0], found[1]


def _unlike(contour: Contour, patterns: Sequence[Contour]) -> Array:
    """(3,) root of the least matchShapes score of any pattern, by each of OpenCV's three measures of Hu moments."""
    scores = [[cv2.matchShapes(contour, pattern, method, 0.0) for method in METHODS] for pattern in patterns]
    least = np.min(scores, axis=0) if scores else np.full(3, UNLIKE)
    return np.asarray(np.sqrt(np.minimum(least, UNLIKE)))
