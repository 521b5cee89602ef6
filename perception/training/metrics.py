"""Learns what `perception.wound.shape_matching` needs from labelled pictures; numpy alone, minutes, no network."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from estimation.se3 import Array
from perception.dice import dice
from perception.training.dataset import Labelled
from perception.wound.shape_matching import ShapeModel, pattern_of, products
from perception.wound_candidates import COLOUR_TERMS, Contour, colour_terms, described, outlines, scene_of

WOUND_PIXELS, OTHER_PIXELS = 60, 120  # of each picture: pixels beside each other tell little more
NEWTON = 25  # steps of the logistic regression
RIDGE = 30.0  # of the ranking, against 210 terms
PATTERNS = 8
CORNERS = 24  # of a stored pattern
KNOWN = 0.2  # how well a scan and the camera's distance tell the area in px, deviation of its logarithm
UNLIKELY = 0.4  # expected Dice below which no outline is worth giving out


def fit_shapes(pictures: Sequence[Labelled], seed: int, seen: Callable[[int, int], None]) -> ShapeModel:
    """The model of these pictures; `seen(done, of)` after each. Outlines are ranked against their own wound's shape and
    size, as a scan gives them, and against the usual shapes."""
    rng = np.random.default_rng(seed)
    wounded = [each for each in pictures if each.wound.any()]
    colour = _colours(wounded, rng)
    patterns = _usual(wounded, rng)
    scanned: list[Array] = []
    usual: list[Array] = []
    reached: list[float] = []
    for number, each in enumerate(wounded):
        scene = scene_of(each.picture, colour)
        truth = cv2.resize(each.wound.astype(np.float32), scene.odds.shape[::-1], interpolation=cv2.INTER_AREA) > 0.5
        own = pattern_of(truth)
        if own is None:  # too small at this size
            continue
        area = float(each.wound.sum()) * float(np.exp(rng.normal(0, KNOWN)))
        for outline in outlines(scene):
            scanned.append(described(scene, outline, [own], area))
            usual.append(described(scene, outline, patterns, None))
            reached.append(dice(_filled(outline, truth.shape), truth))
        seen(number + 1, len(wounded))
    ranks = [_ranking(np.array(features), np.array(reached)) for features in (scanned, usual)]
    return ShapeModel(colour, ranks[0], ranks[1], UNLIKELY, tuple(patterns))


def write_shape_model(file: Path, model: ShapeModel) -> None:
    """As TOML, eight digits a number."""
    lines = [f"trust = {model.trust}"]
    for name, values in (("colour", model.colour), ("rank", model.rank), ("rank_usual", model.rank_usual)):
        lines.append(f"{name} = [{', '.join(f'{value:.8g}' for value in values)}]")
    corners = [str(pattern.reshape(-1).tolist()) for pattern in model.patterns]
    lines.append("patterns = [\n    " + ",\n    ".join(corners) + ",\n]")
    file.write_text("\n".join(lines) + "\n", encoding="utf-8")


def _colours(pictures: Sequence[Labelled], rng: np.random.Generator) -> Array:
    """Logistic regression of wound against everything else over pixels drawn from each picture."""
    terms, wounds = [], []
    for each in pictures:
        scene = scene_of(each.picture, np.zeros(COLOUR_TERMS))
        wound = cv2.resize(each.wound.astype(np.float32), scene.odds.shape[::-1], interpolation=cv2.INTER_AREA) > 0.5
        flat = colour_terms(scene.lab).reshape(-1, COLOUR_TERMS)
        for is_wound, count in ((True, WOUND_PIXELS), (False, OTHER_PIXELS)):
            places = np.flatnonzero(wound.ravel() == is_wound)
            if len(places):
                terms.append(flat[rng.choice(places, count)].astype(float))
                wounds.append(np.full(count, float(is_wound)))
    return _logistic(np.concatenate(terms), np.concatenate(wounds))


def _logistic(terms: Array, outcomes: Array) -> Array:
    weights = np.zeros(terms.shape[1])
    for _ in range(NEWTON):
        expected = 1 / (1 + np.exp(-terms @ weights))
        curvature = (terms * (expected * (1 - expected))[:, None]).T @ terms + 0.1 * np.eye(len(weights))
        weights = weights + np.linalg.solve(curvature, terms.T @ (outcomes - expected) - 0.1 * weights)
    return weights


def _ranking(features: Array, reached: Array) -> Array:
    """Ridge regression of Dice on the products of features, whitened for it."""
    terms = products(features)
    middle, spread = terms.mean(0), terms.std(0) + 1e-9
    white = (terms - middle) / spread
    weights = np.linalg.solve(white.T @ white + RIDGE * np.eye(white.shape[1]), white.T @ (reached - reached.mean()))
    weights = weights / spread
    weights[0] += reached.mean() - middle @ weights  # the first product is one times one
    return np.asarray(weights)


def _usual(pictures: Sequence[Labelled], rng: np.random.Generator) -> list[Contour]:
    """Outlines of wounds drawn at random, each by a few corners."""
    found = []
    for number in rng.permutation(len(pictures)).tolist():
        outline = pattern_of(pictures[number].wound)
        if outline is not None and len(outline) > 4 * CORNERS:
            found.append(outline[np.linspace(0, len(outline) - 1, CORNERS).astype(int)])
        if len(found) == PATTERNS:
            break
    return found


def _filled(outline: Contour, shape: tuple[int, ...]) -> NDArray[np.bool_]:
    mask = np.zeros(shape, np.uint8)
    cv2.drawContours(mask, [outline], -1, 1, -1)
    return mask > 0
