"""Segmentation by shape (thesis 3.2): the outline in the picture that is most like the scan's.

`plain` is the thesis's own: adaptive threshold, contours, matchShapes. `ShapeSegmenter` keeps the idea and mends what
failed there: outlines come from colour separation at many levels instead of one threshold full of noise, each is judged
by colour and contrast as well as by its Hu moments, and an active contour (GrabCut) settles the chosen one's edge.
"""

from __future__ import annotations

import tomllib
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from estimation.errors import InputError
from estimation.scan import Scan
from estimation.se3 import Array
from perception.frames import Image
from perception.padding import picture_box
from perception.wound.segmentation import Mask, Segmentation, rgb
from perception.wound_candidates import COLOUR_TERMS, FEATURES, Contour, described, outlines, scene_of

BLOCK, OFFSET = 11, 2  # of the adaptive threshold, thesis 3.2
SPECK = 20.0  # px^2: smaller outlines of the threshold are its noise
LAYERS = 10  # of a scan's height, whose topmost gives the outline
GRID = 128  # cells along a scan's longer side
ROUNDS = 2  # of GrabCut
TERMS = (FEATURES + 1) * (FEATURES + 2) // 2


@dataclass(frozen=True, slots=True, eq=False)
class ShapeModel:
    """What was learned from labelled pictures. colour: (COLOUR_TERMS,) log odds of the wound's colours. rank: (TERMS,)
    expected Dice of an outline, by products of what describes it, against a scan's outline and size; rank_usual: the
    same against usual shapes. trust: expected Dice below which there is no wound. patterns: the usual shapes."""

    colour: Array
    rank: Array
    rank_usual: Array
    trust: float
    patterns: tuple[Contour, ...]


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
        scene = scene_of(colour[box], self._model.colour)
        found = outlines(scene)
        mask = np.zeros(image.shape[:2], bool)
        if not found:
            return Segmentation(mask, 0.0, np.nan)
        expected = ranked(np.array([described(scene, each, self._patterns, self._area) for each in found]), self._rank)
        best = int(np.argmax(expected))
        confidence = float(np.clip(expected[best], 0, 1))
        if confidence < self._model.trust:
            return Segmentation(mask, confidence, np.nan)
        small = settled(scene.lab, found[best])
        mask[box] = cv2.resize(small.astype(np.float32), colour[box].shape[1::-1]) > 0.5
        return Segmentation(mask, confidence, np.nan)


def ranked(features: Array, rank: Array) -> Array:
    """(N,) expected Dice of outlines described by (N, FEATURES)."""
    return np.asarray(products(features) @ rank)


def products(features: Array) -> Array:
    """(N, TERMS) all products of two of (N, FEATURES) features and one."""
    full = np.column_stack([np.ones(len(features)), features])
    first, second = np.triu_indices(full.shape[1])
    return np.asarray(full[:, first] * full[:, second])


def settled(lab: NDArray[np.float32], contour: Contour) -> Mask:
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
    seen, state = np.ascontiguousarray(np.clip(lab[part], 0, 255).astype(np.uint8)), np.ascontiguousarray(labels[part])
    cv2.setRNGSeed(0)
    cv2.grabCut(seen, state, (0, 0, 1, 1), np.zeros((1, 65)), np.zeros((1, 65)), ROUNDS, cv2.GC_INIT_WITH_MASK)
    filled[part] = np.isin(state, (cv2.GC_FGD, cv2.GC_PR_FGD))
    return filled > 0


def plain(image: Image, pattern: Contour) -> Mask:
    """(H, W) the thesis's own method: of the contours of an adaptive threshold, the one most like the pattern."""
    grey = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
    kind = cv2.ADAPTIVE_THRESH_GAUSSIAN_C
    threshold = cv2.adaptiveThreshold(grey, 255, kind, cv2.THRESH_BINARY, BLOCK, OFFSET)
    found, _ = cv2.findContours(threshold, cv2.RETR_TREE, cv2.CHAIN_APPROX_SIMPLE)
    mask = np.zeros(grey.shape, np.uint8)
    likely = [c for c in found if cv2.contourArea(c) > SPECK]
    if likely:
        best = min(likely, key=lambda c: cv2.matchShapes(c, pattern, cv2.CONTOURS_MATCH_I1, 0.0))
        cv2.drawContours(mask, [best], -1, 1, -1)
    return mask > 0


def pattern_of(mask: Mask) -> Contour | None:
    """The outline of the largest part of a mask (H, W); None of an empty one."""
    found, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    return np.asarray(max(found, key=cv2.contourArea), np.int32) if found else None


def pattern_of_scan(scan: Scan, layers: int = LAYERS) -> tuple[Contour, float]:
    """The outline of the topmost layer of a scan of the wound itself, seen along z (thesis Fig. 3.7, 3.8), at a scale
    of its own, and its area, mm^2."""
    height = scan.vertices[:, 2]
    top = scan.vertices[height >= height.max() - np.ptp(height) / layers][:, :2]
    cell = max(float(np.ptp(top, axis=0).max()) / GRID, 1e-9)
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
    if colour.shape != (COLOUR_TERMS,) or rank.shape != (TERMS,) or usual.shape != (TERMS,):
        raise InputError(file, "shape model", (colour.shape, rank.shape), f"{COLOUR_TERMS} and {TERMS} numbers")
    if not np.isfinite([*colour, *rank, *usual, trust]).all():
        raise InputError(file, "shape model", "a number that is not finite", "the file that comes with stillbed")
    return ShapeModel(colour, rank, usual, trust, patterns)
