"""Printed beads on a scene: as ink of a given width, or as gel that has a cross-section, spreads and sags.

Gel: what leaves the needle over 1 mm of its way, A mm^2, lies as a parabola of width w and height k w, so that
A = 2/3 k w^2. k falls from FRESH_ASPECT to that of gel at rest exponentially in time. Both are drawn by the density
3 / (2 pi R^3) sqrt(R^2 - r^2) about the tip, R = w / 2, which swept along a straight way gives just that parabola. So
volume is kept to rounding wherever and however slowly the needle moves, and beads that touch add up.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from hashlib import sha256

import numpy as np
from numpy.typing import ArrayLike

from estimation.se3 import Array
from hardware.simulator.scene.fields import Field, Layers, as_field, gradient, linear_light, sample

GEL_COLOUR = linear_light([128, 184, 232])  # linear BGR of a thick layer
GEL_ABSORBANCE = 1.7  # per mm: a bead 0.4 mm high covers half of what is below
BEAD_HEIGHT_BY_WIDTH = 0.45
GEL_GLOSS = 0.95
FRESH_ASPECT = 0.55  # height by width as it leaves the needle: nearly round, pressed against the surface
MIN_RADIUS, MAX_RADIUS = 0.15, 2.0  # mm of a bead: a hair, and a puddle under a needle that stands
DROP_STEP = 0.08  # mm of way at most from one drop to the next: less than a texel


@dataclass(frozen=True, slots=True)
class Gel:
    """How a material lies."""

    aspect: float = 0.3  # height by width of a bead at rest: it meets the surface at 50 degrees
    sag_time: float = 2.0  # s in which 63 % of the way to it is gone
    gloss: float = GEL_GLOSS  # 0 matt, as behind crossed polarisers, to 1 wet


@dataclass(frozen=True, slots=True, eq=False)
class GelPieces:
    """N straight pieces of the tip's way on which gel left the needle, in order of time."""

    start: Array  # (N, 2) mm, material points
    end: Array  # (N, 2) mm
    volume: Array  # (N,) mm^3
    area: Array  # (N,) mm^2, of the bead's cross-section there


class PrintedBeads:
    """Beads on the layers of a scene. gel: how it lies; None: as ink, which has a look but no height."""

    def __init__(self, layers: Layers, gel: Gel | None = None) -> None:
        self._layers, self.gel = layers, gel
        self._under: tuple[Field, Field] | None = None  # the finest colour and relief as they were
        self._height = np.zeros((0, 0), np.float32)  # mm
        self._fresh = np.zeros((3, 0, 0))  # mm: drops as laid, and the same at rest, both fading; all at rest
        self._box: tuple[int, int, int, int] | None = None  # x0, y0, x1, y1 texels that hold gel
        self._stamp = -math.inf  # s, of the fields
        self.version = 0  # of the heights
        self.laid = b""  # a hash of all that was laid so far, in its order

    def lay(self, xy_start: ArrayLike, xy_end: ArrayLike, width: float) -> None:
        """Lay a bead of `width` mm from one material point (2,) mm to another; off the texture nothing is laid.

        The same bead twice is one bead, and beads that join end to end are one bead.
        """
        layers = self._layers
        self._note(np.asarray([xy_start, xy_end], float), np.array([width]))
        self._begin()
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
        """Let gel leave the needle, and what lies there sag, until `now`, s; off the texture nothing is laid."""
        assert self.gel is not None
        self._note(pieces.start, pieces.end, pieces.volume, pieces.area, np.array([now]))
        self._begin()
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
                self._grow(low, high)
        self._settle()

    def scrape(self) -> None:
        """Take all gel away: the surface is as it was."""
        if self._box is not None:
            x0, y0, x1, y1 = self._box
            self._fresh[:, y0:y1, x0:x1] = 0.0
            self._note()
            self._settle()

    def heights(self, size: tuple[float, float], step: float) -> Field:
        """Heights (H, W) mm of gel on nodes `step` mm apart about the origin, over `size` (x, y) mm; all 0 of ink."""
        scale, ox, oy = self._layers.offsets(0)
        x, y = ((np.arange(round(s / step) + 1) - round(s / step) / 2) * step for s in size)
        if self.gel is None or self._under is None:
            return np.zeros((len(y), len(x)), np.float32)
        u, v = np.meshgrid(x * scale + ox, y * scale + oy)
        return sample(self._height, as_field(u), as_field(v))

    def volume(self) -> float:
        """All gel that lies on the scene, mm^3."""
        return float(self._height.sum(dtype=float)) * self._layers.texel**2

    def _note(self, *laid: Array) -> None:
        self.laid = sha256(b"".join([self.laid, *(np.ascontiguousarray(each).tobytes() for each in laid)])).digest()

    def _begin(self) -> None:
        if self._under is None:
            self._under = self._layers.colour[0].copy(), self._layers.relief[0].copy()
            self._height = np.zeros(self._layers.size, np.float32)
            if self.gel is not None:
                self._fresh = np.zeros((3, *self._layers.size))

    def _grow(self, low: Array, high: Array) -> None:
        box = (*low.tolist(), *high.tolist())
        if self._box is not None:
            box = (*np.minimum(self._box[:2], low).tolist(), *np.maximum(self._box[2:], high).tolist())
        self._box = box[0], box[1], box[2], box[3]

    def _settle(self) -> None:
        if self._box is None:
            return
        x0, y0, x1, y1 = self._box
        fresh = self._fresh[:, y0:y1, x0:x1]
        self._height[y0:y1, x0:x1] = np.maximum(fresh[0] - fresh[1] + fresh[2], 0.0)
        self.version += 1
        self._paint(x0, y0, x1, y1)
        self._layers.refresh(x0, y0, x1, y1)

    def _paint(self, x0: int, y0: int, x1: int, y1: int) -> None:
        assert self._under is not None
        around = self._height[y0 - 1 : y1 + 1, x0 - 1 : x1 + 1]
        sx, sy = (s[1:-1, 1:-1] for s in gradient(np.ascontiguousarray(around), self._layers.texel))
        height = around[1:-1, 1:-1]
        colour, relief = (u[y0:y1, x0:x1] for u in self._under)
        share = (1 - np.exp(-GEL_ABSORBANCE * height))[..., None]
        opacity = colour[..., 3:]
        self._layers.colour[0][y0:y1, x0:x1, :3] = colour[..., :3] * (1 - share) + GEL_COLOUR * opacity * share
        wet = np.clip(height / 0.06, 0, 1)[..., None]
        gloss = np.full_like(height, GEL_GLOSS if self.gel is None else self.gel.gloss)
        over = np.dstack([relief[..., 0] * 0.5 + sx, relief[..., 1] * 0.5 + sy, gloss, relief[..., 3]])
        self._layers.relief[0][y0:y1, x0:x1] = relief * (1 - wet) + over * wet


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
