"""Procedural fields that skin, flesh and cloth are made of: smooth noise, cells, spots and strokes, all (H, W) float32.

Lengths are in texels. Each field is drawn coarsely where it is smooth, so that a large texture takes milliseconds.
"""

from __future__ import annotations

import cv2
import numpy as np

from estimation.se3 import Array
from hardware.simulator.field import Field, Size, blurred, field


def smooth(shape: Size, scale: float, rng: np.random.Generator) -> Field:
    """Gaussian noise of mean 0 and variance 1 whose hills are about `scale` texels wide."""
    halvings = max(0, int(np.log2(max(scale, 1.0) / 3)))
    coarse = ((shape[0] >> halvings) + 8, (shape[1] >> halvings) + 8)
    drawn = blurred(rng.standard_normal(coarse, np.float32), max(0.4, 0.4 * scale / (1 << halvings)))
    large = field((drawn - drawn.mean()) / drawn.std())
    for _ in range(halvings):
        large = field(cv2.pyrUp(large))  # resize by cubics would leave a comb on every slope
    edge = 3 << halvings
    return large[edge : edge + shape[0], edge : edge + shape[1]]


def octaves(shape: Size, scale: float, count: int, rng: np.random.Generator, fall: float = 0.6) -> Field:
    """Noise of variance 1 at `count` scales, each half the one before and `fall` as strong."""
    strength = fall ** np.arange(count) / np.linalg.norm(fall ** np.arange(count))
    total = strength[0] * smooth(shape, scale, rng)
    for k in range(1, count):
        total += strength[k] * smooth(shape, scale / 2**k, rng)
    return field(total)


def stretched(shape: Size, scale: tuple[float, float], rng: np.random.Generator) -> Field:
    """Noise of variance 1 whose hills are `scale` (along x, along y) texels wide: fibres of one direction."""
    sigma = np.maximum(0.4 * np.array(scale), 0.3)
    drawn = cv2.GaussianBlur(rng.standard_normal(shape, np.float32), (0, 0), sigma[0], sigmaY=sigma[1])
    return field((drawn - drawn.mean()) / drawn.std())


def cells(shape: Size, pitch: float, rng: np.random.Generator) -> tuple[Field, Field]:
    """Voronoi cells about `pitch` texels wide: distance to the edge in texels, and a number 0..1 of each cell."""
    y, x = np.mgrid[-1 : shape[0] / pitch + 1, -1 : shape[1] / pitch + 1]
    sites = (np.stack([y, x], -1) + rng.uniform(0.0, 1.0, (*y.shape, 2))).reshape(-1, 2) * pitch
    sites = np.rint(sites[((sites >= 0) & (sites < np.array(shape) - 1)).all(1)]).astype(int)
    ground = np.ones(shape, np.uint8)
    ground[sites[:, 0], sites[:, 1]] = 0
    _, label = cv2.distanceTransformWithLabels(ground, cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL)
    inner = np.ones(shape, np.uint8)
    inner[:, :-1] &= label[:, :-1] == label[:, 1:]
    inner[:-1] &= label[:-1] == label[1:]
    edge = cv2.distanceTransform(inner, cv2.DIST_L2, 5)
    value = rng.random(int(label.max()) + 1, np.float32)[label]
    return field(edge), field(value)


def spots(shape: Size, pitch: float, radius: tuple[float, float], rng: np.random.Generator, kept: float = 1.0) -> Field:
    """Soft round spots 0..1, one in each square of `pitch` with chance `kept`; radius: (from, to), one sigma."""
    out = np.zeros(shape, np.float32)
    y, x = np.mgrid[0 : shape[0] / pitch, 0 : shape[1] / pitch]
    centres = (np.stack([x, y], -1) + rng.uniform(0, 1, (*x.shape, 2))).reshape(-1, 2) * pitch
    sigma = radius[0] * (radius[1] / radius[0]) ** rng.uniform(0, 1, len(centres))
    depth = rng.uniform(0.35, 1.0, len(centres))
    for (cx, cy), s, d in zip(centres[rng.random(len(centres)) < kept], sigma, depth, strict=False):
        r = int(2.6 * s) + 2
        x0, x1 = max(0, int(cx) - r), min(shape[1], int(cx) + r + 1)
        y0, y1 = max(0, int(cy) - r), min(shape[0], int(cy) + r + 1)
        if x0 < x1 and y0 < y1:
            gx = np.exp(-(((np.arange(x0, x1, dtype=np.float32) - cx) / s) ** 2) / 2)
            gy = np.exp(-(((np.arange(y0, y1, dtype=np.float32) - cy) / s) ** 2) / 2)
            patch = out[y0:y1, x0:x1]
            np.maximum(patch, d * gy[:, None] * gx, out=patch)
    return out


def strokes(shape: Size, lines: list[Array], width: float, soft: float = 0.0) -> Field:
    """Lines 0..1 through points (N, 2) texels each, `width` texels wide (below one: fainter), blurred by `soft`."""
    drawn = np.zeros(shape, np.uint8)
    thick = max(1, round(width))
    for line in lines:
        points = np.rint(line * 16).astype(np.int32)
        cv2.polylines(drawn, [points], False, 255, thick, cv2.LINE_AA, shift=4)
    cover = field(drawn) * np.float32(min(1.0, width) / 255)
    return blurred(cover, soft) if soft else cover


def wander(start: Array, angle: float, length: float, bend: float, rng: np.random.Generator, points: int = 12) -> Array:
    """A line (points, 2) from `start` that turns at random, by `bend` rad (one sigma) over its whole length."""
    turns = (
        angle
        + np.cumsum(rng.normal(0, bend / np.sqrt(points), points - 1))
        + np.linspace(0, rng.normal(0, bend), points - 1)
    )
    steps = np.column_stack([np.cos(turns), np.sin(turns)]) * (length / (points - 1))
    return np.asarray(np.vstack([start, start + np.cumsum(steps, axis=0)]))
