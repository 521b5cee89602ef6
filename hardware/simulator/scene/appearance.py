"""Printed material: beads of a clear, glossy gel that lie on the wound and stay."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from hardware.simulator.field import Field, gradient
from hardware.simulator.layers import Layers, linear

GEL = linear([128, 184, 232])  # linear BGR of a thick layer
DENSITY = 1.7  # per mm: a bead 0.4 mm high covers half of what is below
FLATNESS = 0.45  # a bead's height by its width
GLOSS = 0.95


class Ink:
    """Beads on the layers of a scene."""

    def __init__(self, layers: Layers) -> None:
        self._layers = layers
        self._under: tuple[Field, Field] | None = None  # the finest colour and relief as they were
        self._height = np.zeros((0, 0), np.float32)  # mm

    def lay(self, xy_start: ArrayLike, xy_end: ArrayLike, width: float) -> None:
        """Lay a bead of `width` mm from one material point (2,) mm to another; off the texture nothing is laid.

        The same bead twice is one bead, and beads that join end to end are one bead.
        """
        layers = self._layers
        if self._under is None:
            self._under = layers.colour[0].copy(), layers.relief[0].copy()
            self._height = np.zeros(layers.size, np.float32)
        scale, ox, oy = layers.offsets(0)
        start, end = (np.asarray(p, float) * scale + (ox, oy) for p in (xy_start, xy_end))
        radius = width / 2 * scale
        low = np.maximum(np.floor(np.minimum(start, end) - radius - 2), 1).astype(int)
        high = np.minimum(np.ceil(np.maximum(start, end) + radius + 3), np.array(layers.size[::-1]) - 1).astype(int)
        if (high <= low).any():
            return
        (x0, y0), (x1, y1) = low, high
        bead = _bead(start - low, end - low, radius, (y1 - y0, x1 - x0)) * np.float32(FLATNESS * width)
        np.maximum(self._height[y0:y1, x0:x1], bead, out=self._height[y0:y1, x0:x1])
        self._paint(x0, y0, x1, y1)
        layers.refresh(x0, y0, x1, y1)

    def _paint(self, x0: int, y0: int, x1: int, y1: int) -> None:
        assert self._under is not None
        around = self._height[y0 - 1 : y1 + 1, x0 - 1 : x1 + 1]
        sx, sy = (s[1:-1, 1:-1] for s in gradient(np.ascontiguousarray(around), self._layers.texel))
        height = around[1:-1, 1:-1]
        colour, relief = (u[y0:y1, x0:x1] for u in self._under)
        share = (1 - np.exp(-DENSITY * height))[..., None]
        opacity = colour[..., 3:]
        self._layers.colour[0][y0:y1, x0:x1, :3] = colour[..., :3] * (1 - share) + GEL * opacity * share
        wet = np.clip(height / 0.06, 0, 1)[..., None]
        over = np.dstack(
            [relief[..., 0] * 0.5 + sx, relief[..., 1] * 0.5 + sy, np.full_like(height, GLOSS), relief[..., 3]]
        )
        self._layers.relief[0][y0:y1, x0:x1] = relief * (1 - wet) + over * wet


def _bead(start: object, end: object, radius: float, size: tuple[int, int]) -> Field:
    """Height 0..1 (H, W) of half an ellipse swept from start to end, in texels."""
    a, b = np.asarray(start, np.float32), np.asarray(end, np.float32)
    y, x = np.mgrid[: size[0], : size[1]].astype(np.float32)
    along = b - a
    share = np.clip(((x - a[0]) * along[0] + (y - a[1]) * along[1]) / max(float(along @ along), 1e-9), 0, 1)
    square = (x - a[0] - share * along[0]) ** 2 + (y - a[1] - share * along[1]) ** 2
    return np.asarray(np.sqrt(np.clip(1 - square / np.float32(radius) ** 2, 0, 1)), np.float32)
