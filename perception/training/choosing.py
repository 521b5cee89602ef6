"""The settings that go with a network, chosen on pictures that it was not trained on and is not judged by."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from estimation.se3 import Array
from perception.coarse_to_fine import Looks, Network
from perception.dice import dice
from perception.training.dataset import Labelled
from perception.training.judging import bgr
from perception.wound.network import Settings
from perception.wound.segmentation import NetworkSegmenter, judged

EDGES = (0.3, 0.35, 0.4, 0.45, 0.5, 0.55, 0.6)
SMALLEST = (0.0, 0.02, 0.05, 0.1, 0.2)
HELD = (4.0, 0.25)  # how firmly slope and offset of the confidence are held near one and nothing
SILENT = 0.96  # of pictures without a wound: what is promised is 0.95
PRICE = 0.5  # of mean Dice that a share of them is worth
HIT = 0.3  # Dice from which a mask has found the wound at all


def chosen_settings(
    network: Network, pictures: Sequence[Labelled], healthy: Sequence[NDArray[np.uint8]], looks: Looks
) -> Settings:
    """Edge and smallest part by the best mean Dice, then the confidence by what tells wounds from none."""
    anything = Settings(looks=looks, trust=0.0)
    see = NetworkSegmenter(network, anything).logits
    logits = [see(bgr(each.picture)) for each in pictures]
    empty = [see(bgr(each)) for each in healthy]
    best, most = anything, -1.0
    for edge, smallest in product(EDGES, SMALLEST):
        tried = Settings(looks=looks, edge=edge, smallest=smallest, trust=0.0)
        reached = _mean_dice(logits, pictures, tried)
        if reached > most:
            best, most = tried, reached
    return _trusting(best, logits, pictures, empty)


def _mean_dice(logits: Sequence[NDArray[np.float32]], pictures: Sequence[Labelled], settings: Settings) -> float:
    """Over the pictures with a wound."""
    pairs = [(seen, each.wound) for seen, each in zip(logits, pictures, strict=True) if each.wound.any()]
    return float(np.mean([dice(judged(seen, settings).mask, wound) for seen, wound in pairs] or 0.0))


def _trusting(
    settings: Settings,
    logits: Sequence[NDArray[np.float32]],
    pictures: Sequence[Labelled],
    empty: Sequence[NDArray[np.float32]],
) -> Settings:
    """The logistic of the mean logit, and the confidence below which to keep silent."""
    levels, right, gains = [], [], []
    for seen, each in zip(logits, pictures, strict=True):
        found = judged(seen, settings).mask
        if found.any():
            levels.append(float(seen[found].mean()))
            reached = dice(found, each.wound)
            right.append(reached > HIT)
            gains.append(reached - float(not each.wound.any()))
    wrong = [float(seen[found].mean()) for seen in empty if (found := judged(seen, settings).mask).any()]
    slope, offset = _logistic(np.array(levels + wrong), np.array(right + [False] * len(wrong), float))
    confidence = 1 / (1 + np.exp(-(slope * np.array(levels) + offset)))
    false = 1 / (1 + np.exp(-(slope * np.array(wrong) + offset)))
    trust, most = 0.5, -np.inf
    for level in np.arange(0.02, 0.99, 0.02):
        quiet = 1 - (false >= level).sum() / max(1, len(empty))
        gain = float(np.array(gains)[confidence >= level].sum()) / len(pictures) - PRICE * max(0.0, SILENT - quiet)
        if gain > most + 1e-9:
            trust, most = float(round(level, 2)), gain
    return Settings(settings.looks, settings.edge, settings.smallest, trust, slope, offset)


def _logistic(levels: Array, right: Array) -> tuple[float, float]:
    """Slope and offset of the most likely logistic, held near a slope of one: there are few wrong ones."""

    def cost(weights: Array) -> float:
        exponent = np.where(right > 0, -1, 1) * (weights[0] * levels + weights[1])
        return float(np.logaddexp(0, exponent).sum() + 0.5 * (np.array(HELD) * (weights - (1.0, 0.0)) ** 2).sum())

    slope, offset = minimize(cost, np.array([1.0, 0.0]), method="Nelder-Mead").x
    return float(slope), float(offset)
