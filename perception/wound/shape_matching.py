"""Segmentation by shape (thesis 3.2): the outline in the picture that is most like the scan's.

`thesis_mask` is the thesis's own method: adaptive threshold, contours, matchShapes. `ShapeSegmenter` keeps the idea and
mends what failed there: outlines come from colour separation at many levels instead of one noisy threshold, each is
rated by colour and contrast as well as by its Hu moments, and an active contour (GrabCut) refines the chosen one.
"""

from __future__ import annotations

import tomllib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from estimation.errors import InputError
from estimation.scans.scan import Scan
from estimation.se3 import Array
from perception.frames import Image
from perception.wound.segmentation import Segmentation, WoundMask, dice, picture_box, rgb

Contour = NDArray[np.int32]  # (N, 1, 2) px, as OpenCV has them

SMALL_SIDE_PX = 256  # px of the picture's longer side: outlines are no finer than the network's first look
SURROUNDINGS_SIGMA_PX = 24.0  # px, one sigma: what a pixel's own surroundings are
ODDS_LEVELS = np.arange(-4.0, 6.0, 0.5)  # of the colour's log odds
REDNESS_PERCENTILES = (80.0, 86.0, 90.0, 93.0, 95.0, 97.0, 98.5, 99.3)  # percentiles above which a* may be a wound's
DARKNESS_PERCENTILES = (88.0, 93.0, 96.0, 98.0, 99.0)  # the same of darkness: dead tissue is black
YELLOWNESS_PERCENTILES = (90.0, 94.0, 97.0, 98.5)  # and of b*: slough
MIN_OUTLINE_AREA_PX, MAX_OUTLINE_SHARE = 10.0, 0.4  # px, share of the picture
RING_SHARE = 0.25  # width of an outline's surroundings, of its longer side
MAX_SHAPE_DISTANCE = 3.0  # matchShapes beyond this says no more
SHAPE_DISTANCES = (cv2.CONTOURS_MATCH_I1, cv2.CONTOURS_MATCH_I2, cv2.CONTOURS_MATCH_I3)
COLOUR_TERMS = 28  # of `colour_terms`
OUTLINE_FEATURES = 19  # of `outline_features`
MAX_LOG_AREA_RATIO = 2.5  # the logarithm of two areas' ratio beyond which more says no more


@dataclass(frozen=True, slots=True, eq=False)
class SmallPicture:
    """A picture made small."""

    lab: NDArray[np.float32]  # (H, W, 3) CIE Lab, blurred by a pixel
    odds: NDArray[np.float32]  # (H, W) log odds of the wound's colours
    scale: float  # px of it per px of the picture


def small_picture(picture: NDArray[np.uint8], weights: Array) -> SmallPicture:
    """What outlines are looked for in. picture: (H, W, 3) RGB. weights: (COLOUR_TERMS,) of the log odds."""
    scale = min(1.0, SMALL_SIDE_PX / max(picture.shape[:2]))
    small = cv2.resize(picture, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    colours = cv2.cvtColor(small, cv2.COLOR_RGB2LAB).astype(np.float32)
    lab = np.asarray(cv2.GaussianBlur(colours, (0, 0), 1.0), np.float32)
    return SmallPicture(lab, np.asarray(colour_terms(lab) @ weights, np.float32), scale)


def colour_terms(lab: NDArray[np.float32]) -> NDArray[np.float32]:
    """(H, W, COLOUR_TERMS): one, the colour, how it differs from its surroundings, and all products of two."""
    around = cv2.GaussianBlur(lab, (0, 0), SURROUNDINGS_SIGMA_PX)
    terms = cv2.split(np.dstack([lab / 64 - 2, (lab - around) / 64]))
    products = [terms[i] * terms[j] for i in range(len(terms)) for j in range(i, len(terms))]
    return np.dstack([np.ones_like(terms[0]), *terms, *products])


def find_outlines(scene: SmallPicture) -> list[Contour]:
    """Outlines of everything above some level of the colour's odds, of redness, darkness or yellowness."""
    light, red, yellow = cv2.split(scene.lab)
    maps = [(scene.odds, ODDS_LEVELS)]
    for value, shares in ((red, REDNESS_PERCENTILES), (-light, DARKNESS_PERCENTILES), (yellow, YELLOWNESS_PERCENTILES)):
        maps.append((np.asarray(value), np.percentile(value, shares)))
    outlines: list[Contour] = []
    for value, levels in maps:
        for level in levels:
            above = (value > level).astype(np.uint8)
            for mask in (above, cv2.morphologyEx(above, cv2.MORPH_OPEN, np.ones((5, 5), np.uint8))):
                contours, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
                outlines += [np.asarray(each, np.int32) for each in contours]
    return [c for c in outlines if MIN_OUTLINE_AREA_PX <= cv2.contourArea(c) <= MAX_OUTLINE_SHARE * scene.odds.size]


def outline_features(scene: SmallPicture, contour: Contour, patterns: Sequence[Contour], area: float | None) -> Array:
    """(OUTLINE_FEATURES,) colour inside and around, compactness, size, place, and distances to the nearest pattern.

    area: px^2 of the picture that the wound should cover, None where nobody knows.
    """
    x, y, width, height = cv2.boundingRect(contour)
    reach = max(3, int(RING_SHARE * max(width, height)))
    rows, columns = scene.odds.shape
    x0, x1 = max(0, x - reach), min(columns, x + width + reach)
    y0, y1 = max(0, y - reach), min(rows, y + height + reach)
    filled = np.zeros((y1 - y0, x1 - x0), np.uint8)
    cv2.drawContours(filled, [contour - np.array([[x0, y0]], np.int32)], -1, 1, -1)
    wide = np.asarray(cv2.dilate(filled, np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)), np.uint8)
    inside, ring = _means(scene, (slice(y0, y1), slice(x0, x1)), filled, wide - filled)
    covered, length = cv2.contourArea(contour), cv2.arcLength(contour, True)
    hull = max(cv2.contourArea(cv2.convexHull(contour)), 1.0)
    cut = x <= 1 or y <= 1 or x + width >= columns - 1 or y + height >= rows - 1
    away = np.hypot((x + width / 2) / columns - 0.5, (y + height / 2) / rows - 0.5)
    compactness = 4 * np.pi * covered / max(length, 1.0) ** 2
    shape = covered / hull, compactness, np.log(covered / scene.odds.size), float(cut), away
    ratio = 0.0 if area is None else np.log(covered / (area * scene.scale**2))
    size = np.clip(ratio, -MAX_LOG_AREA_RATIO, MAX_LOG_AREA_RATIO)
    # the square root of the least distance to any pattern, by each of OpenCV's three measures of Hu moments
    scores = [[cv2.matchShapes(contour, pattern, method, 0.0) for method in SHAPE_DISTANCES] for pattern in patterns]
    least = np.min(scores, axis=0) if scores else np.full(3, MAX_SHAPE_DISTANCE)
    distances = np.sqrt(np.minimum(least, MAX_SHAPE_DISTANCE))
    return np.array([*inside, *ring, inside[0] - ring[0], *shape, *distances, size, abs(size)])


def _means(
    scene: SmallPicture, part: tuple[slice, slice], inside: NDArray[np.uint8], ring: NDArray[np.uint8]
) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Mean log odds and mean colour inside an outline and in the ring around it."""
    odds, lab = scene.odds[part], scene.lab[part]
    means = []
    for mask in (inside, ring if ring.any() else inside):
        level = cv2.mean(odds, mask)[0]
        means.append((level, *(value / 64 - 2 for value in cv2.mean(lab, mask)[:3])))
    return means[0], means[1]


THRESHOLD_BLOCK_PX, THRESHOLD_OFFSET = 11, 2  # of the adaptive threshold, thesis 3.2
MIN_CONTOUR_AREA_PX = 20.0  # px^2: smaller outlines of the threshold are its noise
SCAN_LAYERS = 10  # of a scan's height, whose topmost gives the outline
SCAN_GRID_CELLS = 128  # cells along a scan's longer side
GRABCUT_ROUNDS = 2  # of GrabCut
RANK_TERMS = (OUTLINE_FEATURES + 1) * (OUTLINE_FEATURES + 2) // 2


@dataclass(frozen=True, slots=True, eq=False)
class ShapeModel:
    """Parameters that were fitted to labelled pictures."""

    colour: Array  # (COLOUR_TERMS,) weights of the log odds of the wound's colours
    rank: Array  # (RANK_TERMS,) weights of the expected Dice of an outline, against a scan's outline and size
    rank_usual: Array  # (RANK_TERMS,) the same, against usual shapes
    trust: float  # expected Dice below which there is no wound
    patterns: tuple[Contour, ...]  # the usual shapes


class ShapeSegmenter:
    """Finds the wound by the shape of a scan's outline, or by those of usual wounds."""

    def __init__(self, model: ShapeModel, pattern: Contour | None = None, area: float | None = None) -> None:
        """pattern: (N, 1, 2), at any scale; None: the model's own. area: px^2 that the wound covers in a picture, by
        the scan's size and the camera's distance; None: unknown. A pattern without its area is one among the usual."""
        self._model, self._area = model, None if pattern is None else area
        self._patterns = model.patterns if pattern is None else (pattern,)
        self._rank = model.rank_usual if self._area is None else model.rank

    def __call__(self, image: Image) -> Segmentation:
        """The most plausible outline, its edge settled; empty where none is plausible."""
        colour = rgb(image)
        box = picture_box(colour)
        scene = small_picture(colour[box], self._model.colour)
        outlines = find_outlines(scene)
        mask = np.zeros(image.shape[:2], bool)
        if not outlines:
            return Segmentation(mask, 0.0, np.nan)
        features = [outline_features(scene, outline, self._patterns, self._area) for outline in outlines]
        expected = products(np.array(features)) @ self._rank  # (N,) Dice
        best = int(np.argmax(expected))
        confidence = float(np.clip(expected[best], 0, 1))
        if confidence < self._model.trust:
            return Segmentation(mask, confidence, np.nan)
        small = refine_outline(scene.lab, outlines[best])
        mask[box] = cv2.resize(small.astype(np.float32), colour[box].shape[1::-1]) > 0.5
        return Segmentation(mask, confidence, np.nan)


def products(features: Array) -> Array:
    """(N, RANK_TERMS) all products of two of (N, OUTLINE_FEATURES) features and one."""
    full = np.column_stack([np.ones(len(features)), features])
    first, second = np.triu_indices(full.shape[1])
    return np.asarray(full[:, first] * full[:, second])


def _outline_mask(outline: Contour, size: tuple[int, ...]) -> WoundMask:
    filled = np.zeros(size, np.uint8)
    cv2.drawContours(filled, [outline], -1, 1, -1)
    return filled > 0


def refine_outline(lab: NDArray[np.float32], contour: Contour) -> WoundMask:
    """(H, W) the outline filled, its edge moved to where the colours part (GrabCut, Rother et al. 2004)."""
    filled = np.zeros(lab.shape[:2], np.uint8)
    cv2.drawContours(filled, [contour], -1, 1, -1)
    reach = max(2, int(0.15 * np.sqrt(cv2.contourArea(contour))))
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * reach + 1, 2 * reach + 1))
    sure, possible = cv2.erode(filled, kernel), cv2.dilate(filled, kernel)
    labels = np.where(sure > 0, cv2.GC_FGD, np.where(possible > 0, cv2.GC_PR_BGD, cv2.GC_BGD)).astype(np.uint8)
    labels[(filled > 0) & (sure == 0)] = cv2.GC_PR_FGD
    if not (sure.any() and (labels == cv2.GC_BGD).any()):
        return filled > 0
    x, y, width, height = cv2.boundingRect(possible)
    part = np.s_[max(0, y - height) : y + 2 * height, max(0, x - width) : x + 2 * width]
    colours = np.ascontiguousarray(np.clip(lab[part], 0, 255).astype(np.uint8))
    state = np.ascontiguousarray(labels[part])
    cv2.setRNGSeed(0)
    background, foreground = np.zeros((1, 65)), np.zeros((1, 65))  # colour models, filled by OpenCV
    cv2.grabCut(colours, state, (0, 0, 1, 1), background, foreground, GRABCUT_ROUNDS, cv2.GC_INIT_WITH_MASK)
    filled[part] = np.isin(state, (cv2.GC_FGD, cv2.GC_PR_FGD))
    return filled > 0


def thesis_mask(image: Image, pattern: Contour) -> WoundMask:
    """(H, W) the thesis's own method: of the contours of an adaptive threshold, the one most like the pattern."""
    grey = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
    kind = cv2.ADAPTIVE_THRESH_GAUSSIAN_C
    threshold = cv2.adaptiveThreshold(grey, 255, kind, cv2.THRESH_BINARY, THRESHOLD_BLOCK_PX, THRESHOLD_OFFSET)
    contours, _ = cv2.findContours(threshold, cv2.RETR_TREE, cv2.CHAIN_APPROX_SIMPLE)
    mask = np.zeros(grey.shape, np.uint8)
    likely = [c for c in contours if cv2.contourArea(c) > MIN_CONTOUR_AREA_PX]
    if likely:
        best = min(likely, key=lambda c: cv2.matchShapes(c, pattern, cv2.CONTOURS_MATCH_I1, 0.0))
        cv2.drawContours(mask, [best], -1, 1, -1)
    return mask > 0


def largest_outline(mask: WoundMask) -> Contour | None:
    """The outline of the largest part of a mask (H, W); None of an empty one."""
    contours, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    return np.asarray(max(contours, key=cv2.contourArea), np.int32) if contours else None


def scan_outline(scan: Scan, layers: int = SCAN_LAYERS) -> tuple[Contour, float]:
    """The outline of the topmost layer of a scan of the wound itself, seen along z (thesis Fig. 3.7, 3.8), at a scale
    of its own, and its area, mm^2."""
    height = scan.vertices[:, 2]
    top = scan.vertices[height >= height.max() - np.ptp(height) / layers][:, :2]
    cell = max(float(np.ptp(top, axis=0).max()) / SCAN_GRID_CELLS, 1e-9)
    hull = cv2.convexHull(np.round((top - top.min(0)) / cell).astype(np.int32))
    if cv2.contourArea(hull) == 0:
        raise InputError("scan", "top layer", f"{len(top)} vertices in a line", "an area seen along z")
    return np.asarray(hull, np.int32), cv2.contourArea(hull) * cell**2


def read_shape_model(file: Path) -> ShapeModel:
    """The model in a TOML file; InputError where it is missing or not one."""
    try:
        table = tomllib.loads(file.read_text(encoding="utf-8"))
        colour, rank, usual = (np.array(table[key], float) for key in ("colour", "rank", "rank_usual"))
        patterns = tuple(np.array(each, np.int32).reshape(-1, 1, 2) for each in table["patterns"])
        trust = float(table["trust"])
    except (OSError, KeyError, ValueError, TypeError, OverflowError, RecursionError) as error:
        raise InputError(file, "shape model", str(error), "the file that comes with stillbed") from None
    if colour.shape != (COLOUR_TERMS,) or rank.shape != (RANK_TERMS,) or usual.shape != (RANK_TERMS,):
        raise InputError(file, "shape model", (colour.shape, rank.shape), f"{COLOUR_TERMS} and {RANK_TERMS} numbers")
    if not np.isfinite([*colour, *rank, *usual, trust]).all():
        raise InputError(file, "shape model", "a number that is not finite", "the file that comes with stillbed")
    return ShapeModel(colour, rank, usual, trust, patterns)


Outlined = tuple[NDArray[np.uint8], WoundMask]  # a picture (H, W, 3) RGB and its wound (H, W)
WOUND_PIXELS, OTHER_PIXELS = 60, 120  # of each picture: pixels beside each other tell little more
NEWTON_STEPS = 25  # steps of the logistic regression
RANK_RIDGE = 30.0  # of the ranking, against 210 terms
PATTERN_COUNT = 8
PATTERN_CORNERS = 24  # of a stored pattern
AREA_LOG_SIGMA = 0.2  # standard deviation of the logarithm of an area in px from a scan and the camera's distance
MIN_EXPECTED_DICE = 0.4  # below this expected Dice, no outline is returned


def fit_shapes(pictures: Sequence[Outlined], seed: int, report: Callable[[int, int], None]) -> ShapeModel:
    """The model of these pictures; `report(done, total)` after each.

    Outlines are ranked against the wound's true shape and size, as a scan gives them, and against the usual shapes.
    """
    rng = np.random.default_rng(seed)
    wounded = [each for each in pictures if each[1].any()]
    colour = _colours(wounded, rng)
    patterns = _usual_outlines(wounded, rng)
    scanned: list[Array] = []
    usual: list[Array] = []
    dices: list[float] = []
    for number, (picture, wound) in enumerate(wounded):
        scene = small_picture(picture, colour)
        truth = _made_small(wound, scene)
        own = largest_outline(truth)
        if own is None:  # too small at this size
            continue
        area = float(wound.sum()) * float(np.exp(rng.normal(0, AREA_LOG_SIGMA)))
        for outline in find_outlines(scene):
            scanned.append(outline_features(scene, outline, [own], area))
            usual.append(outline_features(scene, outline, patterns, None))
            dices.append(dice(_outline_mask(outline, truth.shape), truth))
        report(number + 1, len(wounded))
    ranks = [_ranking(np.array(features), np.array(dices)) for features in (scanned, usual)]
    return ShapeModel(colour, ranks[0], ranks[1], MIN_EXPECTED_DICE, tuple(patterns))


def write_shape_model(file: Path, model: ShapeModel) -> None:
    """As TOML, eight digits a number."""
    lines = [f"trust = {model.trust}"]
    for name, values in (("colour", model.colour), ("rank", model.rank), ("rank_usual", model.rank_usual)):
        lines.append(f"{name} = [{', '.join(f'{value:.8g}' for value in values)}]")
    corners = [str(pattern.reshape(-1).tolist()) for pattern in model.patterns]
    lines.append("patterns = [\n    " + ",\n    ".join(corners) + ",\n]")
    file.write_text("\n".join(lines) + "\n", encoding="utf-8")


def _made_small(wound: WoundMask, scene: SmallPicture) -> WoundMask:
    size = scene.odds.shape[::-1]
    return np.asarray(cv2.resize(wound.astype(np.float32), size, interpolation=cv2.INTER_AREA) > 0.5)


def _colours(pictures: Sequence[Outlined], rng: np.random.Generator) -> Array:
    terms, wounds = [], []
    for picture, outlined in pictures:
        scene = small_picture(picture, np.zeros(COLOUR_TERMS))
        wound = _made_small(outlined, scene)
        flat = colour_terms(scene.lab).reshape(-1, COLOUR_TERMS)
        for is_wound, count in ((True, WOUND_PIXELS), (False, OTHER_PIXELS)):
            places = np.flatnonzero(wound.ravel() == is_wound)
            if len(places):
                terms.append(flat[rng.choice(places, count)].astype(float))
                wounds.append(np.full(count, float(is_wound)))
    return _logistic_weights(np.concatenate(terms), np.concatenate(wounds))


def _logistic_weights(terms: Array, outcomes: Array) -> Array:
    weights = np.zeros(terms.shape[1])
    for _ in range(NEWTON_STEPS):
        expected = 1 / (1 + np.exp(-terms @ weights))
        curvature = (terms * (expected * (1 - expected))[:, None]).T @ terms + 0.1 * np.eye(len(weights))
        weights = weights + np.linalg.solve(curvature, terms.T @ (outcomes - expected) - 0.1 * weights)
    return weights


def _ranking(features: Array, dices: Array) -> Array:
    """Ridge regression of Dice on the products of features, whitened for it."""
    terms = products(features)
    middle, spread = terms.mean(0), terms.std(0) + 1e-9
    white = (terms - middle) / spread
    normal = white.T @ white + RANK_RIDGE * np.eye(white.shape[1])
    weights = np.linalg.solve(normal, white.T @ (dices - dices.mean())) / spread
    weights[0] += dices.mean() - middle @ weights  # the first product is one times one
    return np.asarray(weights)


def _usual_outlines(pictures: Sequence[Outlined], rng: np.random.Generator) -> list[Contour]:
    """Outlines of wounds drawn at random, each by a few corners."""
    outlines = []
    for number in rng.permutation(len(pictures)).tolist():
        outline = largest_outline(pictures[number][1])
        if outline is not None and len(outline) > 4 * PATTERN_CORNERS:
            outlines.append(outline[np.linspace(0, len(outline) - 1, PATTERN_CORNERS).astype(int)])
        if len(outlines) == PATTERN_COUNT:
            break
    return outlines
