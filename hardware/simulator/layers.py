"""What is painted on a surface, as pyramids: colour and opacity, slopes, gloss and occlusion."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

Texture = NDArray[np.float32]  # (H, W, 4)
LEVELS = 4
BLOCK = 1 << (LEVELS - 1)  # texels: textures are whole blocks, so that halving them moves nothing


class Layers:
    """Two textures over a rectangle, each with `LEVELS` levels of half the one before.

    colour: (H, W, 4) linear BGR of 0..1, times opacity, and opacity. relief: (H, W, 4) slope along x, along y, gloss
    0..1, occlusion (1: open to the whole room). texel: mm. corner: x, y mm of the rectangle's corner at row 0 and
    column 0, where both are least.
    """

    def __init__(self, colour: Texture, relief: Texture, texel: float, corner: tuple[float, float]) -> None:
        assert colour.shape == relief.shape and not any(n % BLOCK for n in colour.shape[:2])
        self.texel, self.corner = texel, corner
        self.colour, self.relief = _pyramid(colour), _pyramid(relief)

    @property
    def size(self) -> tuple[int, int]:
        """(H, W) texels at the finest level."""
        h, w = self.colour[0].shape[:2]
        return h, w

    def level(self, spacing: float) -> int:
        """The level whose texels are nearest to `spacing` mm."""
        return int(np.clip(np.rint(np.log2(max(spacing, 1e-6) / self.texel)), 0, LEVELS - 1))

    def offsets(self, level: int) -> tuple[float, float, float]:
        """(scale, x, y): texel coordinates at `level` are scale * mm + x or y."""
        scale = 1 / (self.texel * 2**level)
        return scale, -self.corner[0] * scale - 0.5, -self.corner[1] * scale - 0.5

    def refresh(self, x0: int, y0: int, x1: int, y1: int) -> None:
        """Work a change of the finest texels x0..x1, y0..y1 (the last excluded) into the coarser levels."""
        box = (x0 // BLOCK, y0 // BLOCK, -(-x1 // BLOCK), -(-y1 // BLOCK))
        for pyramid in (self.colour, self.relief):
            for k in range(1, LEVELS):
                n = BLOCK >> k
                a, b, c, d = (v * n for v in box)
                fine = pyramid[k - 1][2 * b : 2 * d, 2 * a : 2 * c]
                pyramid[k][b:d, a:c] = cv2.resize(fine, (c - a, d - b), interpolation=cv2.INTER_AREA)


def texels(size: tuple[float, float], texel: float) -> tuple[int, int]:
    """(H, W) whole blocks of texels that cover `size` (x, y) mm."""
    w, h = (int(np.ceil(s / texel / BLOCK - 1e-6)) * BLOCK for s in size)
    return h, w


def linear(display: object) -> Texture:
    """Linear light 0..1 of display values 0..255: the display's value is the square root of the light."""
    return np.asarray((np.asarray(display, np.float32) / 255) ** 2, np.float32)


def _pyramid(texture: Texture) -> list[Texture]:
    levels = [np.ascontiguousarray(texture, np.float32)]
    for _ in range(1, LEVELS):
        h, w = levels[-1].shape[:2]
        levels.append(np.asarray(cv2.resize(levels[-1], (w // 2, h // 2), interpolation=cv2.INTER_AREA), np.float32))
    return levels
