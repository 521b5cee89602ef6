"""Fields, (H, W) or (H, W, C) float32: sampling, procedural noise, and texture pyramids.

Lengths of noise are in texels. Noise is drawn coarsely where it is smooth, so that a large texture takes milliseconds.

Printed beads on a scene: as ink of a given width, or as gel that has a cross-section, spreads and sags.

Gel: the volume per mm of the needle's path, A mm^2, has the cross-section of a parabola of width w and height k w, so
A = 2/3 k w^2. k falls from FRESH_ASPECT to that of gel at rest exponentially in time. Both are drawn by the density
3 / (2 pi R^3) sqrt(R^2 - r^2) about the tip, R = w / 2, which integrates to that parabola along a straight path. So
volume is exact to rounding at any speed of the needle, and overlapping beads add up.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from hashlib import sha256

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from estimation.se3 import Array

Field = NDArray[np.float32]
Size = tuple[int, int]  # H, W
Mask = NDArray[np.bool_]


def as_field(values: object) -> Field:
    """The values as float32."""
    return np.asarray(values, np.float32)


def sample(source: Field, u: Field, v: Field) -> Field:
    """The source at columns u and rows v (H, W), bilinear, constant beyond its edge."""
    return as_field(cv2.remap(source, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE))


def sample_texture(texture: Field, u: Field, v: Field) -> Field:
    """A texture (H, W, 4) at columns u and rows v, bilinear, zero beyond its edge."""
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
    noise = gaussian_blur(rng.standard_normal(coarse, np.float32), max(0.4, 0.4 * scale / (1 << halvings)))
    large = as_field((noise - noise.mean()) / noise.std())
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
    noise = cv2.GaussianBlur(rng.standard_normal(shape, np.float32), (0, 0), sigma[0], sigmaY=sigma[1])
    return as_field((noise - noise.mean()) / noise.std())


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
    spots = np.zeros(shape, np.float32)
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
            patch = spots[y0:y1, x0:x1]
            np.maximum(patch, d * gy[:, None] * gx, out=patch)
    return spots


def draw_lines(shape: Size, lines: list[Array], width: float, soft: float = 0.0) -> Field:
    """Lines 0..1 through points (N, 2) texels each, `width` texels wide (below one: fainter), blurred by `soft`."""
    mask = np.zeros(shape, np.uint8)
    thickness = max(1, round(width))
    for line in lines:
        points = np.rint(line * 16).astype(np.int32)
        cv2.polylines(mask, [points], False, 255, thickness, cv2.LINE_AA, shift=4)
    cover = as_field(mask) * np.float32(min(1.0, width) / 255)
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
BLOCK_TEXELS = 1 << (PYRAMID_LEVELS - 1)  # textures are whole blocks, so that halving them shifts nothing


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
        """Update the coarser levels from the finest texels x0..x1, y0..y1 (the last excluded)."""
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


GEL_COLOUR = linear_light([128, 184, 232])  # linear BGR of a thick layer
GEL_ABSORBANCE = 1.7  # per mm: a bead 0.4 mm high covers half of what is below
BEAD_HEIGHT_BY_WIDTH = 0.45
GEL_GLOSS = 0.95
FRESH_ASPECT = 0.55  # height by width as it leaves the needle: nearly round, pressed against the surface
MIN_RADIUS, MAX_RADIUS = 0.15, 2.0  # mm of a bead: a hair, and a puddle under a needle at rest
DROP_STEP = 0.08  # mm between drops at most: less than a texel


@dataclass(frozen=True, slots=True)
class Gel:
    """The shape and look of printed gel."""

    aspect: float = 0.3  # height by width of a bead at rest: it meets the surface at 50 degrees
    sag_time: float = 2.0  # s, time constant of its approach
    gloss: float = GEL_GLOSS  # 0 matt, as behind crossed polarisers, to 1 wet


@dataclass(frozen=True, slots=True, eq=False)
class GelPieces:
    """N straight pieces of the tip's path with gel, in order of time."""

    start: Array  # (N, 2) mm, material points
    end: Array  # (N, 2) mm
    volume: Array  # (N,) mm^3
    area: Array  # (N,) mm^2, of the bead's cross-section there


class PrintedBeads:
    """Beads on the layers of a scene. gel: its settings; None: ink, which has a look but no height."""

    def __init__(self, layers: Layers, gel: Gel | None = None) -> None:
        self._layers, self.gel = layers, gel
        self._bare_layers: tuple[Field, Field] | None = None  # the finest colour and relief without beads
        self._height = np.zeros((0, 0), np.float32)  # mm
        self._fresh = np.zeros((3, 0, 0))  # mm: fresh drops, and the same at rest, both decaying; all at rest
        self._box: tuple[int, int, int, int] | None = None  # x0, y0, x1, y1 texels with gel
        self._stamp = -math.inf  # s, of the fields
        self.version = 0  # of the heights
        self.bead_hash = b""  # of all beads so far, in their order

    def lay(self, xy_start: ArrayLike, xy_end: ArrayLike, width: float) -> None:
        """Lay a bead of `width` mm from one material point (2,) mm to another; none off the texture.

        The same bead twice is one bead, and beads that join end to end are one bead.
        """
        layers = self._layers
        self._update_hash(np.asarray([xy_start, xy_end], float), np.array([width]))
        self._allocate()
        scale, ox, oy = layers.offsets(0)
        start, end = (np.asarray(p, float) * scale + (ox, oy) for p in (xy_start, xy_end))
        radius = width / 2 * scale
        low = np.maximum(np.floor(np.minimum(start, end) - radius - 2), 1).astype(int)
        high = np.minimum(np.ceil(np.maximum(start, end) + radius + 3), np.array(layers.size[::-1]) - 1).astype(int)
        if (high <= low).any():
            return
        (x0, y0), (x1, y1) = low, high
        bead = _bead_profile(start - low, end - low, radius, (y1 - y0, x1 - x0))
        bead = bead * np.float32(BEAD_HEIGHT_BY_WIDTH * width)
        np.maximum(self._height[y0:y1, x0:x1], bead, out=self._height[y0:y1, x0:x1])
        self._paint(x0, y0, x1, y1)
        layers.refresh(x0, y0, x1, y1)

    def flow(self, pieces: GelPieces, now: float) -> None:
        """Add gel from the needle, and let printed gel sag, until `now`, s; none off the texture."""
        assert self.gel is not None
        self._update_hash(pieces.start, pieces.end, pieces.volume, pieces.area, np.array([now]))
        self._allocate()
        fade = math.exp(-(now - self._stamp) / self.gel.sag_time) if math.isfinite(self._stamp) else 0.0
        self._stamp = now
        if self._box is not None:
            x0, y0, x1, y1 = self._box
            self._fresh[:2, y0:y1, x0:x1] *= fade
        scale, ox, oy = self._layers.offsets(0)
        texel, (rows, columns) = self._layers.texel, self._layers.size
        for start, end, volume, area in zip(pieces.start, pieces.end, pieces.volume, pieces.area, strict=True):
            if not volume > 0:
                continue
            count = max(1, math.ceil(float(np.linalg.norm(end - start)) / DROP_STEP))
            share = (np.arange(count)[:, None] + 0.5) / count
            places = (start + share * (end - start)) * scale + (ox, oy)
            for layers, aspect in (((0,), FRESH_ASPECT), ((1, 2), self.gel.aspect)):
                radius = min(max(math.sqrt(1.5 * area / aspect) / 2, MIN_RADIUS), MAX_RADIUS) / texel
                low = np.floor(places.min(0) - radius).astype(int)
                high = np.ceil(places.max(0) + radius).astype(int) + 1
                if (low < 2).any() or high[0] > columns - 2 or high[1] > rows - 2:
                    continue
                drop = _drops(places - low, radius, (high[1] - low[1], high[0] - low[0]))
                drop *= volume / texel**2
                for k in layers:
                    self._fresh[k, low[1] : high[1], low[0] : high[0]] += drop
                self._extend_box(low, high)
        self._update_heights()

    def scrape(self) -> None:
        """Remove all gel."""
        if self._box is not None:
            x0, y0, x1, y1 = self._box
            self._fresh[:, y0:y1, x0:x1] = 0.0
            self._update_hash()
            self._update_heights()

    def heights(self, size: tuple[float, float], step: float) -> Field:
        """Heights (H, W) mm of gel on nodes `step` mm apart about the origin, over `size` (x, y) mm; all 0 of ink."""
        scale, ox, oy = self._layers.offsets(0)
        x, y = ((np.arange(round(s / step) + 1) - round(s / step) / 2) * step for s in size)
        if self.gel is None or self._bare_layers is None:
            return np.zeros((len(y), len(x)), np.float32)
        u, v = np.meshgrid(x * scale + ox, y * scale + oy)
        return sample(self._height, as_field(u), as_field(v))

    def volume(self) -> float:
        """Volume of all gel on the scene, mm^3."""
        return float(self._height.sum(dtype=float)) * self._layers.texel**2

    def _update_hash(self, *data: Array) -> None:
        self.bead_hash = sha256(b"".join([self.bead_hash, *(np.ascontiguousarray(a).tobytes() for a in data)])).digest()

    def _allocate(self) -> None:
        if self._bare_layers is None:
            self._bare_layers = self._layers.colour[0].copy(), self._layers.relief[0].copy()
            self._height = np.zeros(self._layers.size, np.float32)
            if self.gel is not None:
                self._fresh = np.zeros((3, *self._layers.size))

    def _extend_box(self, low: Array, high: Array) -> None:
        box = (*low.tolist(), *high.tolist())
        if self._box is not None:
            box = (*np.minimum(self._box[:2], low).tolist(), *np.maximum(self._box[2:], high).tolist())
        self._box = box[0], box[1], box[2], box[3]

    def _update_heights(self) -> None:
        if self._box is None:
            return
        x0, y0, x1, y1 = self._box
        fresh = self._fresh[:, y0:y1, x0:x1]
        self._height[y0:y1, x0:x1] = np.maximum(fresh[0] - fresh[1] + fresh[2], 0.0)
        self.version += 1
        self._paint(x0, y0, x1, y1)
        self._layers.refresh(x0, y0, x1, y1)

    def _paint(self, x0: int, y0: int, x1: int, y1: int) -> None:
        assert self._bare_layers is not None
        heights = self._height[y0 - 1 : y1 + 1, x0 - 1 : x1 + 1]
        sx, sy = (s[1:-1, 1:-1] for s in gradient(np.ascontiguousarray(heights), self._layers.texel))
        height = heights[1:-1, 1:-1]
        colour, relief = (u[y0:y1, x0:x1] for u in self._bare_layers)
        share = (1 - np.exp(-GEL_ABSORBANCE * height))[..., None]
        opacity = colour[..., 3:]
        self._layers.colour[0][y0:y1, x0:x1, :3] = colour[..., :3] * (1 - share) + GEL_COLOUR * opacity * share
        coverage = np.clip(height / 0.06, 0, 1)[..., None]
        gloss = np.full_like(height, GEL_GLOSS if self.gel is None else self.gel.gloss)
        bead = np.dstack([relief[..., 0] * 0.5 + sx, relief[..., 1] * 0.5 + sy, gloss, relief[..., 3]])
        self._layers.relief[0][y0:y1, x0:x1] = relief * (1 - coverage) + bead * coverage


def _bead_profile(start: object, end: object, radius: float, size: tuple[int, int]) -> Field:
    """Height 0..1 (H, W) of half an ellipse swept from start to end, in texels."""
    a, b = np.asarray(start, np.float32), np.asarray(end, np.float32)
    y, x = np.mgrid[: size[0], : size[1]].astype(np.float32)
    along = b - a
    share = np.clip(((x - a[0]) * along[0] + (y - a[1]) * along[1]) / max(float(along @ along), 1e-9), 0, 1)
    square = (x - a[0] - share * along[0]) ** 2 + (y - a[1] - share * along[1]) ** 2
    return np.asarray(np.sqrt(np.clip(1 - square / np.float32(radius) ** 2, 0, 1)), np.float32)


def _drops(places: Array, radius: float, size: tuple[int, int]) -> Array:
    """Weights (H, W), whose sum is 1, of hemispheres of `radius` about places (N, 2), all in texels."""
    y, x = np.mgrid[: size[0], : size[1]]
    square = (x[..., None] - places[:, 0]) ** 2 + (y[..., None] - places[:, 1]) ** 2
    weights = np.sqrt(np.maximum(radius**2 - square, 0.0)).sum(axis=-1)
    return np.asarray(weights / weights.sum())
