"""Fields, (H, W) or (H, W, C) float32: sampling, procedural noise, and texture pyramids.

Lengths of noise are in texels. Noise is drawn coarsely where it is smooth, so that a large texture takes milliseconds.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from estimation.se3 import Array

Field = NDArray[np.float32]
Size = tuple[int, int]  # H, W
Mask = NDArray[np.bool_]


def as_field(values: object) -> Field:
    """The values as float32."""
    return np.asarray(values, np.float32)


def sample(source: Field, u: Field, v: Field) -> Field:
    """The source at columns u and rows v (H, W), bilinear, beyond its edge as it is there."""
    return as_field(cv2.remap(source, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE))


def sample_texture(texture: Field, u: Field, v: Field) -> Field:
    """A texture (H, W, 4) at columns u and rows v, bilinear, nothing beyond its edge."""
    return as_field(cv2.remap(texture, u, v, cv2.INTER_LINEAR))  # OpenCV's own border is zero


def upsample(source: Field, size: Size) -> Field:
    """The source at `size` (H, W), bilinear; rim on rim."""
    return as_field(cv2.resize(source, size[::-1], interpolation=cv2.INTER_LINEAR))


def block_mean(source: Field, size: Size) -> Field:
    """The source at `size` (H, W), a whole fraction of its own: the mean of each block."""
    return as_field(cv2.resize(source, size[::-1], interpolation=cv2.INTER_AREA))


def gaussian_blur(source: Field, sigma: float) -> Field:
    """The source under a Gaussian of `sigma` places."""
    return as_field(cv2.GaussianBlur(source, (0, 0), sigma))


def smoothstep(values: Field, low: float, high: float) -> Field:
    """0 up to `low`, 1 from `high`, smooth between (high may be below low)."""
    t = np.clip((values - np.float32(low)) / np.float32(high - low), 0, 1)
    return as_field(t * t * (3 - 2 * t))


def gradient(height: Field, spacing: float) -> tuple[Field, Field]:
    """Slopes along x and y of a height field whose nodes are `spacing` apart."""
    kernel = np.array([[-0.5, 0.0, 0.5]], np.float32) / np.float32(spacing)
    border = cv2.BORDER_REPLICATE
    x = cv2.filter2D(height, cv2.CV_32F, kernel, borderType=border)
    return as_field(x), as_field(cv2.filter2D(height, cv2.CV_32F, kernel.T, borderType=border))


def smooth_noise(shape: Size, scale: float, rng: np.random.Generator) -> Field:
    """Gaussian noise of mean 0 and variance 1 whose hills are about `scale` texels wide."""
    halvings = max(0, int(np.log2(max(scale, 1.0) / 3)))
    coarse = ((shape[0] >> halvings) + 8, (shape[1] >> halvings) + 8)
    drawn = gaussian_blur(rng.standard_normal(coarse, np.float32), max(0.4, 0.4 * scale / (1 << halvings)))
    large = as_field((drawn - drawn.mean()) / drawn.std())
    for _ in range(halvings):
        large = as_field(cv2.pyrUp(large))  # resize by cubics would leave a comb on every slope
    edge = 3 << halvings
    return large[edge : edge + shape[0], edge : edge + shape[1]]


def octave_noise(shape: Size, scale: float, count: int, rng: np.random.Generator, fall: float = 0.6) -> Field:
    """Noise of variance 1 at `count` scales, each half the one before and `fall` as strong."""
    strength = fall ** np.arange(count) / np.linalg.norm(fall ** np.arange(count))
    total = strength[0] * smooth_noise(shape, scale, rng)
    for k in range(1, count):
        total += strength[k] * smooth_noise(shape, scale / 2**k, rng)
    return as_field(total)


def fibre_noise(shape: Size, scale: tuple[float, float], rng: np.random.Generator) -> Field:
    """Noise of variance 1 whose hills are `scale` (along x, along y) texels wide: fibres of one direction."""
    sigma = np.maximum(0.4 * np.array(scale), 0.3)
    drawn = cv2.GaussianBlur(rng.standard_normal(shape, np.float32), (0, 0), sigma[0], sigmaY=sigma[1])
    return as_field((drawn - drawn.mean()) / drawn.std())


def voronoi_cells(shape: Size, pitch: float, rng: np.random.Generator) -> tuple[Field, Field]:
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
    return as_field(edge), as_field(value)


def random_spots(
    shape: Size, pitch: float, radius: tuple[float, float], rng: np.random.Generator, kept: float = 1.0
) -> Field:
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


def draw_lines(shape: Size, lines: list[Array], width: float, soft: float = 0.0) -> Field:
    """Lines 0..1 through points (N, 2) texels each, `width` texels wide (below one: fainter), blurred by `soft`."""
    drawn = np.zeros(shape, np.uint8)
    thick = max(1, round(width))
    for line in lines:
        points = np.rint(line * 16).astype(np.int32)
        cv2.polylines(drawn, [points], False, 255, thick, cv2.LINE_AA, shift=4)
    cover = as_field(drawn) * np.float32(min(1.0, width) / 255)
    return gaussian_blur(cover, soft) if soft else cover


def wandering_line(
    start: Array, angle: float, length: float, bend: float, rng: np.random.Generator, points: int = 12
) -> Array:
    """A line (points, 2) from `start` that turns at random, by `bend` rad (one sigma) over its whole length."""
    walk = np.cumsum(rng.normal(0, bend / np.sqrt(points), points - 1))
    turns = angle + walk + np.linspace(0, rng.normal(0, bend), points - 1)
    steps = np.column_stack([np.cos(turns), np.sin(turns)]) * (length / (points - 1))
    return np.asarray(np.vstack([start, start + np.cumsum(steps, axis=0)]))


Texture = NDArray[np.float32]  # (H, W, 4)
PYRAMID_LEVELS = 4
BLOCK_TEXELS = 1 << (PYRAMID_LEVELS - 1)  # texels: textures are whole blocks, so that halving them moves nothing


class Layers:
    """Two textures over a rectangle, each with `PYRAMID_LEVELS` levels of half the one before."""

    def __init__(self, colour: Texture, relief: Texture, texel: float, corner: tuple[float, float]) -> None:
        assert colour.shape == relief.shape and not any(n % BLOCK_TEXELS for n in colour.shape[:2])
        self.texel = texel  # mm
        self.corner = corner  # x, y mm of the rectangle's corner at row 0 and column 0, where both are least
        self.colour = _pyramid(colour)  # (H, W, 4) linear BGR of 0..1, times opacity, and opacity
        self.relief = _pyramid(relief)  # (H, W, 4) slope along x, along y, gloss 0..1, occlusion (1: open to the room)

    @property
    def size(self) -> tuple[int, int]:
        """(H, W) texels at the finest level."""
        h, w = self.colour[0].shape[:2]
        return h, w

    def level(self, spacing: float) -> int:
        """The level whose texels are nearest to `spacing` mm."""
        return int(np.clip(np.rint(np.log2(max(spacing, 1e-6) / self.texel)), 0, PYRAMID_LEVELS - 1))

    def offsets(self, level: int) -> tuple[float, float, float]:
        """(scale, x, y): texel coordinates at `level` are scale * mm + x or y."""
        scale = 1 / (self.texel * 2**level)
        return scale, -self.corner[0] * scale - 0.5, -self.corner[1] * scale - 0.5

    def refresh(self, x0: int, y0: int, x1: int, y1: int) -> None:
        """Work a change of the finest texels x0..x1, y0..y1 (the last excluded) into the coarser levels."""
        box = (x0 // BLOCK_TEXELS, y0 // BLOCK_TEXELS, -(-x1 // BLOCK_TEXELS), -(-y1 // BLOCK_TEXELS))
        for pyramid in (self.colour, self.relief):
            for k in range(1, PYRAMID_LEVELS):
                n = BLOCK_TEXELS >> k
                a, b, c, d = (v * n for v in box)
                fine = pyramid[k - 1][2 * b : 2 * d, 2 * a : 2 * c]
                pyramid[k][b:d, a:c] = cv2.resize(fine, (c - a, d - b), interpolation=cv2.INTER_AREA)


def linear_light(display: object) -> Texture:
    """Linear light 0..1 of display values 0..255: the display's value is the square root of the light."""
    return np.asarray((np.asarray(display, np.float32) / 255) ** 2, np.float32)


def _pyramid(texture: Texture) -> list[Texture]:
    levels = [np.ascontiguousarray(texture, np.float32)]
    for _ in range(1, PYRAMID_LEVELS):
        h, w = levels[-1].shape[:2]
        levels.append(np.asarray(cv2.resize(levels[-1], (w // 2, h // 2), interpolation=cv2.INTER_AREA), np.float32))
    return levels
