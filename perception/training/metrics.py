"""Accuracy of a segmenter on labelled pictures, calibration, and the choice of thresholds."""

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

COVER_MARGIN_SHARE = 0.6  # of the wound's larger side: margin of the cover beyond the wound


def bgr(picture: NDArray[np.uint8]) -> Image:
    """(H, W, 3) RGB as cameras give it."""
    return np.ascontiguousarray(picture[..., ::-1])


def dice_scores(segmenter: Segmenter, pictures: Sequence[Labelled], report: Callable[[int, int], None]) -> Array:
    """(N,) Dice of each picture; an empty label scores 1 with an empty mask and 0 with any other."""
    dices = list[float]()
    for each in pictures:
        dices.append(dice(segmenter(bgr(each.picture)).mask, each.wound))
        report(len(dices), len(pictures))
    return np.array(dices)


def silent_share(segmenter: Segmenter, pictures: Sequence[NDArray[np.uint8]]) -> float:
    """Share of pictures (H, W, 3) RGB without a wound in which none is found; nan without pictures."""
    return float(np.mean([not segmenter(bgr(each)).found for each in pictures] or np.nan))


def dice_before_and_after_cover(
    segmenter: Segmenter, pictures: Sequence[Labelled], rng: np.random.Generator
) -> tuple[float, float]:
    """Mean Dice on the open half of the wound, before the other half is covered and after; pictures with a wound only.

    Both count the open part of the picture only; a mask on the cover itself counts in neither.
    """
    dices = list[tuple[float, float]]()
    for each in pictures:
        if each.wound.any():
            picture, cover = cover_half(each, rng)
            masks = (segmenter(bgr(image)).mask for image in (each.picture, picture))
            before, after = (dice(mask & ~cover, each.wound & ~cover) for mask in masks)
            dices.append((before, after))
    before, after = np.mean(dices or [(np.nan, np.nan)], axis=0).tolist()
    return before, after


def cover_half(labelled: Labelled, rng: np.random.Generator) -> tuple[NDArray[np.uint8], WoundMask]:
    """The picture (H, W, 3) RGB with half of the wound's area behind a plain polygon with a straight edge, and the mask
    (H, W) of that cover."""
    rows, columns = np.nonzero(labelled.wound)
    points = np.column_stack([columns, rows]).astype(float)
    angle = rng.uniform(0, 2 * np.pi)
    along = np.array([np.cos(angle), np.sin(angle)])
    across = np.array([-along[1], along[0]])
    edge = float(np.median(points @ along))
    spans = points @ along, points @ across
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
CONFIDENCE_CHOICES = np.arange(2, 100, 2) / 100
LOGISTIC_PRIOR = (4.0, 0.25)  # precision of the prior of slope and offset: means 1 and 0
TARGET_SILENT_SHARE = 0.952  # of pieces without a wound: what is promised is 0.95
SILENCE_PRICE = 0.5  # of mean Dice that a share of them is worth
MIN_HIT_DICE = 0.3  # Dice from which a mask has found the wound at all

Logits = NDArray[np.float16]  # (H, W)


@dataclass(frozen=True, slots=True, eq=False)
class HeldOutPredictions:
    """Predictions by networks that were not trained on the picture's group; a piece of healthy skin has no wound."""

    logits: Sequence[Logits]  # (N)
    wounds: Sequence[WoundMask]  # (N), each (H, W)
    fold: NDArray[np.intp]  # (N,)
    healthy: NDArray[np.bool_]  # (N,) True: a piece of healthy skin; False: a whole picture

    @property
    def empty(self) -> NDArray[np.bool_]:
        """(N,) whether the label is empty."""
        return np.array([not wound.any() for wound in self.wounds])


@dataclass(frozen=True, slots=True, eq=False)
class FoldEvaluation:
    """Accuracy and calibration of the networks, with settings that were chosen on the other folds."""

    dice: Array  # (N,) of each whole picture
    silent_share: float  # share of pieces of healthy skin in which no wound is found
    confidence: Array  # (K,) of each mask, with no minimum confidence
    correct: NDArray[np.bool_]  # (K,) whether there is that wound
    pixel_probability: Array  # (P,) of some pixels that may be a wound's
    pixel_wound: NDArray[np.bool_]  # (P,)


@dataclass(frozen=True, slots=True, eq=False)
class _SettingsCandidate:
    """The masks by one edge and smallest part, with no minimum confidence."""

    settings: Settings
    dice: Array  # (N,) 1 where neither has a wound
    mean_logit: Array  # (N,) inside the mask; nan where it is empty


def evaluate_folds(
    predictions: HeldOutPredictions,
    looks: Looks,
    rng: np.random.Generator,
    report: Callable[[int, int], None] = lambda done, total: None,
) -> tuple[Settings, FoldEvaluation]:
    """Settings chosen on all folds, and each fold evaluated with those chosen on the others.

    `report(done, total)` counts the settings that were tried.
    """
    choices, candidates = list(product(EDGE_CHOICES, SMALLEST_CHOICES)), list[_SettingsCandidate]()
    for edge, smallest in choices:
        candidates.append(_candidate(predictions, Settings(looks=looks, edge=edge, smallest=smallest, trust=0.0)))
        report(len(candidates), len(choices))
    empty = predictions.empty
    dices, confidence = np.zeros(len(empty)), np.full(len(empty), np.nan)
    silent, correct = np.zeros(len(empty), bool), np.zeros(len(empty), bool)
    for fold in np.unique(predictions.fold):
        test = predictions.fold == fold
        best, settings = _choose(candidates, predictions, ~test)
        confidence[test] = expit(settings.slope * best.mean_logit + settings.offset)[test]
        silent[test] = ~(confidence[test] >= settings.trust)  # nan: no mask
        dices[test] = np.where(silent, empty, best.dice)[test]
        correct[test] = ((best.dice > MIN_HIT_DICE) & ~empty)[test]
    has_mask = np.isfinite(confidence)
    logits, pixel_wound, pixel_fold = _sample_pixels(predictions, rng)
    probability = np.zeros(len(logits))
    for fold in np.unique(pixel_fold):
        test = pixel_fold == fold
        slope, offset = _fit_logistic(logits[~test], pixel_wound[~test])
        probability[test] = expit(slope * logits[test] + offset)
    healthy = predictions.healthy
    silent_share = float(silent[healthy].mean()) if healthy.any() else np.nan
    evaluation = FoldEvaluation(
        dices[~healthy], silent_share, confidence[has_mask], correct[has_mask], probability, pixel_wound
    )
    slope, offset = _fit_logistic(logits, pixel_wound)
    settings = _choose(candidates, predictions, np.ones(len(empty), bool))[1]
    spread = _choose_spread(predictions, settings)
    return replace(settings, pixel_slope=slope, pixel_offset=offset, spread=spread), evaluation


def _candidate(predictions: HeldOutPredictions, settings: Settings) -> _SettingsCandidate:
    dices, mean_logits = np.zeros(len(predictions.wounds)), np.full(len(predictions.wounds), np.nan)
    for number, (half, wound) in enumerate(zip(predictions.logits, predictions.wounds, strict=True)):
        logits = half.astype(np.float32)
        mask = segmentation_from_logits(logits, settings).mask
        dices[number] = dice(mask, wound)
        mean_logits[number] = logits[mask].mean() if mask.any() else np.nan
    return _SettingsCandidate(settings, dices, mean_logits)


def _choose(
    candidates: Sequence[_SettingsCandidate], predictions: HeldOutPredictions, training: NDArray[np.bool_]
) -> tuple[_SettingsCandidate, Settings]:
    """By the entries in `training`: edge and smallest part by the best mean Dice of wounds, then the logistic of the
    mean logit, and the minimum confidence."""
    empty = predictions.empty
    wounded = training & ~empty
    best = max(candidates, key=lambda each: float(each.dice[wounded].mean()) if wounded.any() else 0.0)
    has_mask = training & np.isfinite(best.mean_logit)
    correct = (best.dice > MIN_HIT_DICE) & ~empty
    slope, offset = _fit_logistic(best.mean_logit[has_mask], correct[has_mask])
    silent = ~(expit(slope * best.mean_logit + offset) >= CONFIDENCE_CHOICES[:, None])  # (T, N); nan: no mask
    pieces, whole = training & predictions.healthy, training & ~predictions.healthy
    silent_share = silent[:, pieces].mean(1) if pieces.any() else 1.0
    score = np.where(silent, empty, best.dice)[:, whole].mean(1)
    score = score - SILENCE_PRICE * np.maximum(0.0, TARGET_SILENT_SHARE - silent_share)
    trust = float(CONFIDENCE_CHOICES[np.argmax(score.round(9))])
    return best, replace(best.settings, slope=slope, offset=offset, trust=trust)


MIN_RESIDUALS = 40  # pictures with an outline that touches its label, below which 95 % of them say nothing
SAMPLED_PIXELS = 300  # of each picture, among those below
MIN_SAMPLED_LOGIT = -4.0  # 2 %: all others are skin and room, and would flatter any measure


def _choose_spread(predictions: HeldOutPredictions, settings: Settings) -> float:
    """The factor that 95 % of the labels need; the default where hardly any wound was found."""
    pairs = zip(predictions.logits, predictions.wounds, predictions.healthy.tolist(), strict=True)
    whole = [
        (band_from_logits(logits.astype(np.float32), settings), wound) for logits, wound, piece in pairs if not piece
    ]
    residuals = np.array([each for pair in whole if (each := area_residual(*pair)) is not None])
    spread = conformal_spread(residuals) if len(residuals) >= MIN_RESIDUALS else np.inf
    return spread if np.isfinite(spread) else settings.spread


def _sample_pixels(
    predictions: HeldOutPredictions, rng: np.random.Generator
) -> tuple[Array, NDArray[np.bool_], NDArray[np.intp]]:
    """(P,) logits, labels and folds of pixels of whole pictures: near a piece's edge there may be a wound."""
    logits, wounds, folds = [np.zeros(0)], [np.zeros(0, bool)], [np.zeros(0, np.intp)]
    for number in np.flatnonzero(~predictions.healthy).tolist():
        picture = predictions.logits[number].ravel()
        likely = np.flatnonzero(picture > MIN_SAMPLED_LOGIT)
        if len(likely):
            chosen = rng.choice(likely, SAMPLED_PIXELS)
            logits.append(picture[chosen].astype(float))
            wounds.append(predictions.wounds[number].ravel()[chosen])
            folds.append(np.full(SAMPLED_PIXELS, predictions.fold[number]))
    return np.concatenate(logits), np.concatenate(wounds), np.concatenate(folds)


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


def reliability(probability: Array, correct: NDArray[np.bool_], bins: int = 10) -> tuple[Array, Array, Array]:
    """Mean probability, share that is correct, and count of the bins of equal width that are not empty, (B,) each."""
    weights = (None, probability, correct.astype(float))
    count, said, right = (np.histogram(probability, bins, (0, 1), weights=each)[0] for each in weights)
    used = count > 0
    return said[used] / count[used], right[used] / count[used], count[used]


def calibration_error(probability: Array, correct: NDArray[np.bool_]) -> float:
    """Expected calibration error (Guo et al., ICML 2017): mean distance of probability and share, bins weighted by
    their counts; nan without entries."""
    mean, share, count = reliability(probability, correct)
    return float(np.average(np.abs(share - mean), weights=count)) if len(count) else float("nan")


def _fit_logistic(logits: Array, correct: NDArray[np.bool_]) -> tuple[float, float]:
    """Slope and offset of the most likely logistic, held near a slope of one: there are few wrong ones."""

    def cost(weights: Array) -> float:
        exponent = np.where(correct, -1, 1) * (weights[0] * logits + weights[1])
        prior = 0.5 * (np.array(LOGISTIC_PRIOR) * (weights - (1.0, 0.0)) ** 2).sum()
        return float(np.logaddexp(0, exponent).sum() + prior)

    slope, offset = minimize(cost, np.array([1.0, 0.0]), method="Nelder-Mead").x
    return float(slope), float(offset)
