"""Figures of a segmenter on labelled pictures, and the thresholds that are chosen by them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import product

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize
from scipy.special import expit

from estimation.se3 import Array
from perception.frames import Image
from perception.training.dataset import Labelled
from perception.wound.network import Looks, Settings
from perception.wound.segmentation import (
    Segmenter,
    WoundBand,
    WoundMask,
    band_from_logits,
    dice,
    filled,
    seeded_parts,
    segmentation_from_logits,
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


EDGE_CHOICES = (0.4, 0.45, 0.5, 0.55, 0.6)
SMALLEST_CHOICES = (0.0, 0.05, 0.2)
LOGISTIC_PRIOR = (4.0, 0.25)  # how firmly slope and offset of the confidence are held near one and nothing
TARGET_SILENT_SHARE = 0.952  # of pieces without a wound: what is promised is 0.95
SILENCE_PRICE = 0.5  # of mean Dice that a share of them is worth
MIN_HIT_DICE = 0.3  # Dice from which a mask has found the wound at all

Logits = NDArray[np.float16]  # (H, W)


@dataclass(frozen=True, slots=True, eq=False)
class Unseen:
    """What networks that never saw a picture's group make of it; a piece of healthy skin has no wound."""

    logits: Sequence[Logits]  # (N)
    wounds: Sequence[WoundMask]  # (N), each (H, W)
    fold: NDArray[np.intp]  # (N,)
    piece: NDArray[np.bool_]  # (N,) whether it is a piece of healthy skin, else a whole picture


@dataclass(frozen=True, slots=True, eq=False)
class Judged:
    """How right networks are, and how sure, by settings that were chosen on the other folds."""

    dice: Array  # (N,) of each whole picture
    silent: float  # share of pieces of healthy skin in which nothing is found
    confidence: Array  # (K,) of each mask that is drawn where no confidence is asked for
    right: NDArray[np.bool_]  # (K,) whether there is that wound
    pixel: Array  # (P,) probability of some pixels that may be a wound's
    pixel_wound: NDArray[np.bool_]  # (P,)


@dataclass(frozen=True, slots=True, eq=False)
class _Drawn:
    """The masks that one edge and smallest part draw, no confidence asked for."""

    settings: Settings
    dice: Array  # (N,) 1 where neither has a wound
    level: Array  # (N,) mean logit inside; nan where nothing is drawn


def judge(
    unseen: Unseen, looks: Looks, rng: np.random.Generator, seen: Callable[[int, int], None] = lambda done, of: None
) -> tuple[Settings, Judged]:
    """The settings chosen on all folds, and each fold judged by those chosen on all others; `seen(done, of)` counts the
    settings that were tried."""
    choices, drawn = list(product(EDGE_CHOICES, SMALLEST_CHOICES)), list[_Drawn]()
    for edge, smallest in choices:
        drawn.append(_draw(unseen, Settings(looks=looks, edge=edge, smallest=smallest, trust=0.0)))
        seen(len(drawn), len(choices))
    reached, confidence = np.zeros(len(unseen.fold)), np.full(len(unseen.fold), np.nan)
    hit, quiet = np.zeros(len(unseen.fold), bool), np.zeros(len(unseen.fold), bool)
    empty = np.array([not wound.any() for wound in unseen.wounds])
    for fold in np.unique(unseen.fold):
        chosen, settings = _choose(drawn, unseen, empty, unseen.fold != fold)
        sure, here = expit(settings.slope * chosen.level + settings.offset), unseen.fold == fold
        silent = ~(sure >= settings.trust)  # nan: nothing is drawn
        reached[here] = np.where(silent, empty, chosen.dice)[here]
        confidence[here], quiet[here] = sure[here], silent[here]
        hit[here] = (chosen.dice > MIN_HIT_DICE)[here] & ~empty[here]
    said = np.isfinite(confidence)
    odds, wound, fold = _some_pixels(unseen, rng)
    probability = np.zeros(len(odds))
    for each in np.unique(fold):
        slope, offset = _logistic(odds[fold != each], wound[fold != each])
        probability[fold == each] = expit(slope * odds[fold == each] + offset)
    silent_share = float(quiet[unseen.piece].mean()) if unseen.piece.any() else np.nan
    judged = Judged(reached[~unseen.piece], silent_share, confidence[said], hit[said], probability, wound)
    slope, offset = _logistic(odds, wound)
    settings = _choose(drawn, unseen, empty, np.ones(len(empty), bool))[1]
    spread = _spread(unseen, settings)
    return replace(settings, pixel_slope=slope, pixel_offset=offset, spread=spread), judged


def _draw(unseen: Unseen, settings: Settings) -> _Drawn:
    reached, levels = np.zeros(len(unseen.wounds)), np.full(len(unseen.wounds), np.nan)
    for number, (logits, wound) in enumerate(zip(unseen.logits, unseen.wounds, strict=True)):
        seen = logits.astype(np.float32)
        mask = segmentation_from_logits(seen, settings).mask
        reached[number] = dice(mask, wound)
        levels[number] = seen[mask].mean() if mask.any() else np.nan
    return _Drawn(settings, reached, levels)


def _choose(
    drawn: Sequence[_Drawn], unseen: Unseen, empty: NDArray[np.bool_], of: NDArray[np.bool_]
) -> tuple[_Drawn, Settings]:
    """By the entries in `of`: edge and smallest part by the best mean Dice of wounds, then the logistic of the mean
    logit, and the confidence below which to keep silent."""
    wounded = of & ~empty
    best = max(drawn, key=lambda each: float(each.dice[wounded].mean()) if wounded.any() else 0.0)
    said = of & np.isfinite(best.level)
    right = (best.dice > MIN_HIT_DICE) & ~empty
    slope, offset = _logistic(best.level[said], right[said])
    confidence = expit(slope * best.level + offset)
    trust, most = 0.5, -np.inf
    for level in np.arange(0.02, 0.99, 0.02):
        silent = ~(confidence >= level)
        pieces = of & unseen.piece
        quiet = silent[pieces].mean() if pieces.any() else 1.0
        gain = np.where(silent, empty, best.dice)[of & ~unseen.piece].mean()
        gain -= SILENCE_PRICE * max(0.0, TARGET_SILENT_SHARE - quiet)
        if gain > most + 1e-9:
            trust, most = float(round(level, 2)), gain
    return best, replace(best.settings, slope=slope, offset=offset, trust=trust)


MIN_RESIDUALS = 40  # pictures with an outline that touches its label, below which 95 % of them say nothing
PIXELS_JUDGED = 300  # of each picture, among those below
MIN_JUDGED_LOGIT = -4.0  # 2 %: all others are skin and room, and would flatter any measure


def _spread(unseen: Unseen, settings: Settings) -> float:
    """What 95 % of the labels ask for; the usual one where hardly any was found."""
    whole = zip(unseen.logits, unseen.wounds, unseen.piece.tolist(), strict=True)
    bands = ((band_from_logits(seen.astype(np.float32), settings), wound) for seen, wound, piece in whole if not piece)
    residuals = np.array([each for pair in bands if (each := area_residual(*pair)) is not None])
    asked = conformal_spread(residuals) if len(residuals) >= MIN_RESIDUALS else np.inf
    return asked if np.isfinite(asked) else settings.spread


def _some_pixels(unseen: Unseen, rng: np.random.Generator) -> tuple[Array, NDArray[np.bool_], NDArray[np.intp]]:
    """(P,) logits, whether it is a wound, and folds of pixels of whole pictures alone: near a piece's edge there may be
    a wound."""
    odds, wounds, folds = [np.zeros(0)], [np.zeros(0, bool)], [np.zeros(0, np.intp)]
    for number in np.flatnonzero(~unseen.piece).tolist():
        logits = unseen.logits[number].ravel()
        likely = np.flatnonzero(logits > MIN_JUDGED_LOGIT)
        if len(likely):
            chosen = rng.choice(likely, PIXELS_JUDGED)
            odds.append(logits[chosen].astype(float))
            wounds.append(unseen.wounds[number].ravel()[chosen])
            folds.append(np.full(PIXELS_JUDGED, unseen.fold[number]))
    return np.concatenate(odds), np.concatenate(wounds), np.concatenate(folds)


def area_residual(band: WoundBand, wound: WoundMask) -> float | None:
    """How far the label's area lies from the outline's, in half bands of its logarithm (`WoundBand`).

    None where the outline does not touch the label: what is found elsewhere is no error of an outline.
    """
    label = filled(seeded_parts(wound, band.outline, 0.0)) if band.outline.any() else wound
    if not (label & band.outline).any():
        return None
    with np.errstate(divide="ignore"):
        outline, inner, outer, true = np.log([m.sum() for m in (band.outline, band.inner, band.outer, label)])
    off, half = (true - outline, outer - outline) if true > outline else (outline - true, outline - inner)
    if half > 0:
        return float(off / half)
    return float("inf") if off > 0 else 0.0


def conformal_spread(residuals: Array) -> float:
    """The quantile of residuals (N,) below which a further one lies in 95 of 100 cases (split conformal prediction:
    Angelopoulos and Bates 2021, 2.3)."""
    return float(np.quantile(residuals, min(1.0, 0.95 * (1 + 1 / len(residuals))), method="higher"))


def calibration_error(probability: Array, right: NDArray[np.bool_], bins: int = 10) -> float:
    """Expected calibration error (Guo et al., ICML 2017): mean distance of share and probability, bins of equal width
    weighted by how many fall into them."""
    place = np.minimum((probability * bins).astype(int), bins - 1)
    gaps = [abs(right[place == b].sum() - probability[place == b].sum()) for b in range(bins)]
    return float(np.sum(gaps) / len(probability)) if len(probability) else float("nan")


def _logistic(levels: Array, right: NDArray[np.bool_]) -> tuple[float, float]:
    """Slope and offset of the most likely logistic, held near a slope of one: there are few wrong ones."""

    def cost(weights: Array) -> float:
        exponent = np.where(right, -1, 1) * (weights[0] * levels + weights[1])
        prior = 0.5 * (np.array(LOGISTIC_PRIOR) * (weights - (1.0, 0.0)) ** 2).sum()
        return float(np.logaddexp(0, exponent).sum() + prior)

    slope, offset = minimize(cost, np.array([1.0, 0.0]), method="Nelder-Mead").x
    return float(slope), float(offset)
