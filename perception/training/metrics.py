"""Figures of a segmenter on labelled pictures, and what is chosen by them: its thresholds, or the shape model."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import product
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from estimation.se3 import Array
from perception.frames import Image
from perception.training.dataset import Labelled
from perception.wound.network import Looks, Network, Settings
from perception.wound.segmentation import NetworkSegmenter, Segmenter, WoundMask, dice, segmentation_from_logits
from perception.wound.shape_matching import (
    COLOUR_TERMS,
    Contour,
    ShapeModel,
    colour_terms,
    find_outlines,
    largest_outline,
    outline_features,
    products,
    small_picture,
)

COVER_MARGIN_SHARE = 0.6  # of the wound's larger side by which what covers it reaches beyond it


def bgr(picture: NDArray[np.uint8]) -> Image:
    """(H, W, 3) RGB as cameras give it."""
    return np.ascontiguousarray(picture[..., ::-1])


def scores(segmenter: Segmenter, pictures: Sequence[Labelled], seen: Callable[[int, int], None]) -> Array:
    """(N,) Dice of each picture; an empty truth scores 1 with an empty mask and 0 with any other."""
    reached = []
    for each in pictures:
        reached.append(dice(segmenter(bgr(each.picture)).mask, each.wound))
        seen(len(reached), len(pictures))
    return np.array(reached)


def silent_share(segmenter: Segmenter, pictures: Sequence[NDArray[np.uint8]]) -> float:
    """Share of pictures (H, W, 3) RGB without a wound in which none is found; nan without pictures."""
    return float(np.mean([not segmenter(bgr(each)).found for each in pictures] or np.nan))


def dice_before_and_after_cover(
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
        for picture, reached in ((each.picture, before), (covered, after)):
            reached.append(dice(segmenter(bgr(picture)).mask & opened, each.wound & opened))
    return float(np.mean(before or np.nan)), float(np.mean(after or np.nan))


def half_covered(labelled: Labelled, rng: np.random.Generator) -> tuple[NDArray[np.uint8], WoundMask]:
    """The picture (H, W, 3) RGB with half of the wound's area behind a plain thing with a straight edge, and where that
    thing is (H, W)."""
    rows, columns = np.nonzero(labelled.wound)
    places = np.column_stack([columns, rows]).astype(float)
    angle = rng.uniform(0, 2 * np.pi)
    along = np.array([np.cos(angle), np.sin(angle)])
    across = np.array([-along[1], along[0]])
    edge = float(np.median(places @ along))
    spans = places @ along, places @ across
    reach = COVER_MARGIN_SHARE * max(np.ptp(spans[0]), np.ptp(spans[1]), 8.0)
    near, far, low, high = edge, spans[0].max() + reach, spans[1].min() - reach, spans[1].max() + reach
    corners = [u * along + v * across for u, v in ((near, low), (far, low), (far, high), (near, high))]
    cover = np.zeros(labelled.wound.shape, np.uint8)
    cv2.fillPoly(cover, [np.round(corners).astype(np.int32)], 1)
    picture = labelled.picture.copy()
    shade = rng.uniform(30, 225) + rng.normal(0, 4, labelled.wound.shape)
    picture[cover > 0] = np.clip(shade, 0, 255).astype(np.uint8)[cover > 0, None]
    return picture, cover > 0


EDGE_CHOICES = (0.3, 0.35, 0.4, 0.45, 0.5, 0.55, 0.6)
SMALLEST_CHOICES = (0.0, 0.02, 0.05, 0.1, 0.2)
LOGISTIC_PRIOR = (4.0, 0.25)  # how firmly slope and offset of the confidence are held near one and nothing
TARGET_SILENT_SHARE = 0.96  # of pictures without a wound: what is promised is 0.95
SILENCE_PRICE = 0.5  # of mean Dice that a share of them is worth
MIN_HIT_DICE = 0.3  # Dice from which a mask has found the wound at all


def chosen_settings(
    network: Network, pictures: Sequence[Labelled], healthy: Sequence[NDArray[np.uint8]], looks: Looks
) -> Settings:
    """Edge and smallest part by the best mean Dice, then the confidence by what tells wounds from none."""
    anything = Settings(looks=looks, trust=0.0)
    see = NetworkSegmenter(network, anything).logits
    logits = [see(bgr(each.picture)) for each in pictures]
    empty = [see(bgr(each)) for each in healthy]
    best, most = anything, -1.0
    for edge, smallest in product(EDGE_CHOICES, SMALLEST_CHOICES):
        tried = Settings(looks=looks, edge=edge, smallest=smallest, trust=0.0)
        reached = _mean_dice(logits, pictures, tried)
        if reached > most:
            best, most = tried, reached
    return _trusting(best, logits, pictures, empty)


def _mean_dice(logits: Sequence[NDArray[np.float32]], pictures: Sequence[Labelled], settings: Settings) -> float:
    pairs = [(seen, each.wound) for seen, each in zip(logits, pictures, strict=True) if each.wound.any()]
    return float(np.mean([dice(segmentation_from_logits(seen, settings).mask, wound) for seen, wound in pairs] or 0.0))


def _trusting(
    settings: Settings,
    logits: Sequence[NDArray[np.float32]],
    pictures: Sequence[Labelled],
    empty: Sequence[NDArray[np.float32]],
) -> Settings:
    """The logistic of the mean logit, and the confidence below which to keep silent."""
    levels, right, gains = [], [], []
    for seen, each in zip(logits, pictures, strict=True):
        mask = segmentation_from_logits(seen, settings).mask
        if mask.any():
            levels.append(float(seen[mask].mean()))
            reached = dice(mask, each.wound)
            right.append(reached > MIN_HIT_DICE)
            gains.append(reached - float(not each.wound.any()))
    false_masks = [(seen, segmentation_from_logits(seen, settings).mask) for seen in empty]
    wrong = [float(seen[mask].mean()) for seen, mask in false_masks if mask.any()]
    slope, offset = _logistic(np.array(levels + wrong), np.array(right + [False] * len(wrong), float))
    confidence = 1 / (1 + np.exp(-(slope * np.array(levels) + offset)))
    false = 1 / (1 + np.exp(-(slope * np.array(wrong) + offset)))
    trust, most = 0.5, -np.inf
    for level in np.arange(0.02, 0.99, 0.02):
        quiet = 1 - (false >= level).sum() / max(1, len(empty))
        price = SILENCE_PRICE * max(0.0, TARGET_SILENT_SHARE - quiet)
        gain = float(np.array(gains)[confidence >= level].sum()) / len(pictures) - price
        if gain > most + 1e-9:
            trust, most = float(round(level, 2)), gain
    return Settings(settings.looks, settings.edge, settings.smallest, trust, slope, offset)


def _logistic(levels: Array, right: Array) -> tuple[float, float]:
    """Slope and offset of the most likely logistic, held near a slope of one: there are few wrong ones."""

    def cost(weights: Array) -> float:
        exponent = np.where(right > 0, -1, 1) * (weights[0] * levels + weights[1])
        prior = 0.5 * (np.array(LOGISTIC_PRIOR) * (weights - (1.0, 0.0)) ** 2).sum()
        return float(np.logaddexp(0, exponent).sum() + prior)

    slope, offset = minimize(cost, np.array([1.0, 0.0]), method="Nelder-Mead").x
    return float(slope), float(offset)


WOUND_PIXELS, OTHER_PIXELS = 60, 120  # of each picture: pixels beside each other tell little more
NEWTON_STEPS = 25  # steps of the logistic regression
RANK_RIDGE = 30.0  # of the ranking, against 210 terms
PATTERN_COUNT = 8
PATTERN_CORNERS = 24  # of a stored pattern
AREA_LOG_SIGMA = 0.2  # how well a scan and the camera's distance tell the area in px, deviation of its logarithm
MIN_EXPECTED_DICE = 0.4  # expected Dice below which no outline is worth giving out


def fit_shapes(pictures: Sequence[Labelled], seed: int, seen: Callable[[int, int], None]) -> ShapeModel:
    """The model of these pictures; `seen(done, of)` after each. Outlines are ranked against their own wound's shape and
    size, as a scan gives them, and against the usual shapes."""
    rng = np.random.default_rng(seed)
    wounded = [each for each in pictures if each.wound.any()]
    colour = _colours(wounded, rng)
    patterns = _usual_outlines(wounded, rng)
    scanned: list[Array] = []
    usual: list[Array] = []
    reached: list[float] = []
    for number, each in enumerate(wounded):
        scene = small_picture(each.picture, colour)
        truth = cv2.resize(each.wound.astype(np.float32), scene.odds.shape[::-1], interpolation=cv2.INTER_AREA) > 0.5
        own = largest_outline(truth)
        if own is None:  # too small at this size
            continue
        area = float(each.wound.sum()) * float(np.exp(rng.normal(0, AREA_LOG_SIGMA)))
        for outline in find_outlines(scene):
            scanned.append(outline_features(scene, outline, [own], area))
            usual.append(outline_features(scene, outline, patterns, None))
            reached.append(dice(_filled(outline, truth.shape), truth))
        seen(number + 1, len(wounded))
    ranks = [_ranking(np.array(features), np.array(reached)) for features in (scanned, usual)]
    return ShapeModel(colour, ranks[0], ranks[1], MIN_EXPECTED_DICE, tuple(patterns))


def write_shape_model(file: Path, model: ShapeModel) -> None:
    """As TOML, eight digits a number."""
    lines = [f"trust = {model.trust}"]
    for name, values in (("colour", model.colour), ("rank", model.rank), ("rank_usual", model.rank_usual)):
        lines.append(f"{name} = [{', '.join(f'{value:.8g}' for value in values)}]")
    corners = [str(pattern.reshape(-1).tolist()) for pattern in model.patterns]
    lines.append("patterns = [\n    " + ",\n    ".join(corners) + ",\n]")
    file.write_text("\n".join(lines) + "\n", encoding="utf-8")


def _colours(pictures: Sequence[Labelled], rng: np.random.Generator) -> Array:
    terms, wounds = [], []
    for each in pictures:
        scene = small_picture(each.picture, np.zeros(COLOUR_TERMS))
        wound = cv2.resize(each.wound.astype(np.float32), scene.odds.shape[::-1], interpolation=cv2.INTER_AREA) > 0.5
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


def _ranking(features: Array, reached: Array) -> Array:
    """Ridge regression of Dice on the products of features, whitened for it."""
    terms = products(features)
    middle, spread = terms.mean(0), terms.std(0) + 1e-9
    white = (terms - middle) / spread
    normal = white.T @ white + RANK_RIDGE * np.eye(white.shape[1])
    weights = np.linalg.solve(normal, white.T @ (reached - reached.mean())) / spread
    weights[0] += reached.mean() - middle @ weights  # the first product is one times one
    return np.asarray(weights)


def _usual_outlines(pictures: Sequence[Labelled], rng: np.random.Generator) -> list[Contour]:
    """Outlines of wounds drawn at random, each by a few corners."""
    outlines = []
    for number in rng.permutation(len(pictures)).tolist():
        outline = largest_outline(pictures[number].wound)
        if outline is not None and len(outline) > 4 * PATTERN_CORNERS:
            outlines.append(outline[np.linspace(0, len(outline) - 1, PATTERN_CORNERS).astype(int)])
        if len(outlines) == PATTERN_COUNT:
            break
    return outlines


def _filled(outline: Contour, shape: tuple[int, ...]) -> NDArray[np.bool_]:
    mask = np.zeros(shape, np.uint8)
    cv2.drawContours(mask, [outline], -1, 1, -1)
    return mask > 0
