"""Procedural pictures for the synthetic session: skin with a wound in it, and the cloth around it."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from estimation.se3 import Array
from perception.frames import Image

Picture = NDArray[np.float32]

SKIN = np.array([132, 160, 208], np.float32)  # BGR
FLESH = np.array([52, 44, 148], np.float32)
SLOUGH = np.array([110, 176, 206], np.float32)
CLOTH = np.array([128, 112, 58], np.float32)


def skin(size: tuple[float, float], texel: float, rng: np.random.Generator) -> Image:
    """A patch of skin with a wound at its centre: (H, W, 3) BGR; size: (x, y) mm, texel: mm a pixel.

    Detail at every scale from a third of a millimetre up, so that it can be tracked from near and far.
    """
    shape = (round(size[1] / texel), round(size[0] / texel))
    picture = SKIN + _mottle(shape, texel, rng)[..., None] * np.float32([1.0, 1.0, 0.8])
    picture += _noise(shape, 9.0 / texel, rng)[..., None] * np.float32([-4, -4.5, 2])  # redder and paler regions
    picture -= _spots(shape, texel, rng, spacing=1.3, radius=(0.16, 0.3))[..., None] * np.float32([34, 34, 30])  # pores
    picture -= _spots(shape, texel, rng, spacing=11.0, radius=(0.5, 1.1))[..., None] * np.float32(
        [60, 62, 60]
    )  # freckles
    inside = _wound(shape, texel, rng)  # mm to its edge, positive inside
    halo = np.exp(-np.clip(-inside, 0, None) / 3.0)[..., None]
    picture += halo * np.float32([-22, -32, 4])  # the inflamed rim
    amount = np.clip(inside / 0.9 + 0.5, 0, 1)[..., None]
    picture = picture * (1 - amount) + _wound_bed(shape, texel, rng) * amount
    rim = np.exp(-((inside / 0.6) ** 2)) * np.clip(0.5 + 0.5 * _noise(shape, 4.0 / texel, rng), 0, 1)
    picture *= 1 - 0.3 * rim[..., None]
    return np.clip(np.rint(picture), 0, 255).astype(np.uint8)


def dots(size: tuple[float, float], texel: float, centres: Array, radius: float) -> Image:
    """White Gaussian dots on black, (H, W, 3); centres: (N, 2) mm from the patch's middle, radius: one sigma, mm."""
    h, w = round(size[1] / texel), round(size[0] / texel)
    x = (np.arange(w) + 0.5) * texel - size[0] / 2
    y = (np.arange(h) + 0.5) * texel - size[1] / 2
    wide = np.exp(-(((x - centres[:, :1]) / radius) ** 2) / 2)  # (N, W)
    high = np.exp(-(((y - centres[:, 1:]) / radius) ** 2) / 2)  # (N, H)
    picture = np.rint(255 * np.clip(high.T @ wide, 0, 1)).astype(np.uint8)
    return np.repeat(picture[..., None], 3, axis=2)


def cloth(side: int, rng: np.random.Generator) -> Image:
    """A drape, (side, side, 3) BGR, that repeats without a seam."""
    assert side & (side - 1) == 0, "a power of two, else the noise does not close"
    folds = _noise((side, side), side / 12, rng, wrap=True) * 16
    blotches = _noise((side, side), side / 90, rng, wrap=True) * 7
    weave = _noise((side, side), 1.5, rng, wrap=True) * 7
    picture = CLOTH * (1 + (folds + blotches + weave)[..., None] / 100)
    return np.clip(np.rint(picture), 0, 255).astype(np.uint8)


def _noise(shape: tuple[int, int], scale: float, rng: np.random.Generator, wrap: bool = False) -> Picture:
    """Smooth noise (H, W) of unit variance whose hills are about `scale` px wide."""
    step = 1 << max(0, int(np.log2(max(scale, 2.0) / 2)))  # drawn coarsely, then enlarged
    coarse = (-(-shape[0] // step), -(-shape[1] // step))
    pad = 0 if wrap else 8
    drawn = rng.standard_normal((coarse[0] + 2 * pad, coarse[1] + 2 * pad), dtype=np.float32)
    border = 8 if wrap else 0
    drawn = np.pad(drawn, border, mode="wrap") if wrap else drawn
    smooth = cv2.GaussianBlur(drawn, (0, 0), max(0.45, 0.4 * scale / step))
    edge = border + pad
    large = cv2.resize(smooth, None, fx=step, fy=step, interpolation=cv2.INTER_CUBIC)
    cut = large[edge * step : edge * step + shape[0], edge * step : edge * step + shape[1]]
    return np.asarray((cut - cut.mean()) / cut.std(), np.float32)


def _mottle(shape: tuple[int, int], texel: float, rng: np.random.Generator) -> Picture:
    """Grey-level variation (H, W) of skin, the sum of several scales."""
    out = np.zeros(shape, np.float32)
    for scale, strength in ((0.5, 4.5), (1.0, 5.0), (2.2, 4.5), (5.0, 4.0), (18.0, 5.0)):  # mm, grey levels
        out += strength * _noise(shape, scale / texel, rng)
    lines = np.abs(_noise(shape, 1.6 / texel, rng))  # fine creases where a noise crosses zero
    return np.asarray(out - 9 * np.exp(-((lines / 0.16) ** 2)), np.float32)


def _spots(
    shape: tuple[int, int], texel: float, rng: np.random.Generator, spacing: float, radius: tuple[float, float]
) -> Picture:
    """Soft round spots (H, W), 0 to 1, on a jittered grid; spacing and radius (from, to) in mm."""
    out = np.zeros(shape, np.float32)
    pitch = spacing / texel
    for y in np.arange(0, shape[0], pitch):
        for x in np.arange(0, shape[1], pitch):
            cx, cy = x + rng.uniform(0, pitch), y + rng.uniform(0, pitch)
            sigma, depth = rng.uniform(*radius) / texel, rng.uniform(0.4, 1.0)
            r = int(3 * sigma) + 1
            x0, x1 = max(0, int(cx) - r), min(shape[1], int(cx) + r + 1)
            y0, y1 = max(0, int(cy) - r), min(shape[0], int(cy) + r + 1)
            if x0 < x1 and y0 < y1:
                gx = np.exp(-(((np.arange(x0, x1) - cx) / sigma) ** 2) / 2)
                gy = np.exp(-(((np.arange(y0, y1) - cy) / sigma) ** 2) / 2)
                out[y0:y1, x0:x1] = np.maximum(out[y0:y1, x0:x1], depth * gy[:, None] * gx)
    return out


def _wound(shape: tuple[int, int], texel: float, rng: np.random.Generator) -> Picture:
    """About how far inside the wound's edge each texel is (H, W), mm; an irregular oval of some 26 x 18 mm."""
    y, x = np.mgrid[: shape[0], : shape[1]].astype(np.float32)
    x, y = (x - shape[1] / 2) * texel / 1.2, (y - shape[0] / 2) * texel / 0.85
    angle, edge = np.arctan2(y, x), np.full(shape, 10.5, np.float32)
    for k in range(2, 9):
        edge += rng.normal(0, 1.6 / k) * np.cos(k * angle + rng.uniform(0, 2 * np.pi))
    return np.asarray(edge - np.hypot(x, y) + 0.25 * _noise(shape, 1.5 / texel, rng), np.float32)


def _wound_bed(shape: tuple[int, int], texel: float, rng: np.random.Generator) -> Picture:
    """Red granulation tissue with yellow slough, (H, W, 3) BGR."""
    grain = (
        13 * _noise(shape, 0.8 / texel, rng)
        + 11 * _noise(shape, 2.0 / texel, rng)
        + 6 * _noise(shape, 0.45 / texel, rng)
    )
    bed = FLESH + grain[..., None] * np.float32([0.6, 0.6, 1.1])
    slough = np.clip(0.9 * (_noise(shape, 4.0 / texel, rng) + 0.25 * _noise(shape, 0.8 / texel, rng) - 0.5), 0, 0.75)[
        ..., None
    ]
    bed = bed * (1 - slough) + (SLOUGH + 0.8 * grain[..., None]) * slough
    bright = _spots(shape, texel, rng, spacing=2.0, radius=(0.2, 0.5))[..., None]
    return np.asarray(bed + bright * np.float32([40, 40, 45]), np.float32)
