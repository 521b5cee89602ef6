"""A surgical drape: its colour, its weave, and the folds it was packed and laid in."""

from __future__ import annotations

import cv2
import numpy as np

from hardware.simulator.field import Field, Size, ramp
from hardware.simulator.layers import Texture, linear
from hardware.simulator.scene.fields import octaves, stretched, strokes, wander

TEAL = linear([136, 122, 44])
HEM = linear([150, 138, 64])


def folds(shape: Size, texel: float, rng: np.random.Generator) -> Field:
    """Heights (H, W) mm of wrinkles, tucks and packing creases about the cloth's mean."""
    height = 4.0 * octaves(shape, 110 / texel, 3, rng, 0.5)
    for width, tall, count in ((17.0, 7.0, 10), (9.0, 3.6, 16), (5.0, 1.6, 26)):  # mm
        lines = []
        for _ in range(count):
            start = rng.uniform(-0.05, 1.05, 2) * shape[::-1]
            lines.append(wander(start, rng.uniform(0, 2 * np.pi), rng.uniform(60, 240) / texel, 0.5, rng, 24))
        ridge = strokes(shape, lines, 1.0, width / 2.2 / texel)
        height += tall * np.tanh(1.6 * ridge / max(float(np.quantile(ridge, 0.985)), 1e-6))
    for axis, n in ((0, 4), (1, 5)):  # it was packed folded
        place = np.arange(shape[axis], dtype=np.float32) * texel
        pitch = shape[axis] * texel / n
        distance = np.abs(np.mod(place - rng.uniform(0, pitch), pitch) - pitch / 2)
        crease = (1.6 * np.exp(-distance / 2.4)).astype(np.float32)
        height += crease[:, None] if axis == 0 else crease
    return np.asarray(cv2.GaussianBlur(height, (0, 0), 1.2 / texel), np.float32)


def weave(shape: Size, texel: float, rng: np.random.Generator) -> tuple[Field, Field]:
    """Shade (about 1) and height mm (H, W) of the pressed fibres."""
    fibre = sum(
        (stretched(shape, (a / texel, b / texel), rng) for a, b in ((3.0, 0.5), (0.5, 3.0), (1.2, 1.2))),
        start=np.zeros(shape, np.float32),
    )
    blotch = octaves(shape, 30 / texel, 3, rng)
    shade = 1 + 0.035 * fibre + 0.05 * blotch
    return np.asarray(shade, np.float32), np.asarray(0.012 * fibre, np.float32)


def opening(x: Field, y: Field, half: tuple[float, float], corner: float = 14.0) -> Field:
    """Distance mm outside the rounded opening of half sides `half`, negative inside, at material points x, y."""
    dx, dy = np.abs(x) - (half[0] - corner), np.abs(y) - (half[1] - corner)
    outside = np.hypot(np.maximum(dx, 0), np.maximum(dy, 0)) + np.minimum(np.maximum(dx, dy), 0)
    return np.asarray(outside - corner, np.float32)


def colour(shade: Field, outside: Field) -> Texture:
    """Linear BGR (H, W, 3) of the cloth; the hem round the opening is a second layer, stitched."""
    hem = ramp(outside, 7.2, 6.8)
    seam = np.exp(-(((outside - 6.6) / 0.35) ** 2)) * np.float32(0.3)
    picture = TEAL + (0.55 * hem)[..., None] * (HEM - TEAL)
    return np.asarray(picture * (shade * (1 - seam))[..., None], np.float32)
