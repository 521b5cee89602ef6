"""The cloth beyond the skin: a height field that follows the body near the opening and rests on the table far away."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from scipy.ndimage import gaussian_filter

from hardware.simulator import cloth
from hardware.simulator.field import Field, gradient, ramp
from hardware.simulator.lamps import AMBIENT, lamps
from hardware.simulator.layers import Texture
from hardware.simulator.look import Look
from hardware.simulator.scene.shape import Shape

STEP = 2.0  # mm between nodes: the cloth is no measure of anything
TEXEL = 0.5  # mm
SPAN = (640.0, 520.0)  # mm, x and y; beyond, the picture is mirrored
TABLE = -70.0  # mm below the wound's skin
ALONE = -90.0  # mm: where the cloth lies behind a bare patch
STEEPEST, FLATTEST = -0.5, -0.15  # slopes of the tent
THICKNESS = 0.6  # mm
HELD, FREE = 12.0, 140.0  # mm from the opening: up to here it moves with the body, from here it rests


@dataclass(frozen=True, slots=True, eq=False)
class Sheet:
    """A cloth. heights: (H, W) mm, grid frame, nodes STEP apart. picture: (H, W, 4) linear BGR without the
    key lamp, and what the key lamp adds to a white cloth.

    half: half sides mm of the opening; None: no opening, the cloth does not move.
    """

    heights: Field
    picture: Texture
    half: tuple[float, float] | None

    def held(self, x: Field, y: Field) -> Field:
        """How much of the body's motion the cloth takes over at x, y mm: 1 near the opening, 0 far away."""
        if self.half is None:
            return np.zeros_like(x)
        return ramp(cloth.opening(x, y, self.half), FREE, HELD)


def axes(span: tuple[float, float], step: float) -> tuple[Field, Field]:
    """x, y (H, W) mm of nodes `step` apart about the origin, over `span`."""
    x, y = ((np.arange(round(s / step) + 1, dtype=np.float32) - round(s / step) / 2) * np.float32(step) for s in span)
    return np.meshgrid(x, y)


def thickness(outside: Field) -> Field:
    """Height mm of a drape laid on the skin, by distance mm outside the opening's edge."""
    return np.asarray(THICKNESS * ramp(outside, -0.1, 1.2), np.float32)


def draped(shape: Shape, half: tuple[float, float], look: Look, rng: np.random.Generator) -> Sheet:
    """A drape over the shape with a rounded opening of half sides `half` mm, falling to the table all round."""
    x, y = axes(SPAN, STEP)
    reach = np.array(shape.size, np.float32) / 2
    cx, cy = np.clip(x, -reach[0], reach[0]), np.clip(y, -reach[1], reach[1])
    edge = np.stack([cx, cy], -1).reshape(-1, 2)
    even = _evened(shape)
    away = np.hypot(x - cx, y - cy)
    ground = even.heights_at(edge).reshape(x.shape).astype(np.float32)
    back = even.heights_at(0.85 * edge).reshape(x.shape).astype(np.float32)
    slope = np.clip((ground - back) / np.maximum(0.15 * np.hypot(cx, cy), 1e-3), STEEPEST, FLATTEST)
    tent = ground + slope * away
    tent = TABLE + np.logaddexp(0, (tent - TABLE) / 14).astype(np.float32) * 14
    soft = cv2.GaussianBlur(tent, (0, 0), 9 / STEP)
    tent += ramp(away, 0, 25) * (soft - tent)
    outside = cloth.opening(x, y, half)
    exact = shape.heights_at(np.stack([x, y], -1).reshape(-1, 2)).reshape(x.shape).astype(np.float32)
    tent += ramp(away, 4, 0) * (exact - tent)
    wrinkles = cloth.folds(x.shape, STEP, rng) * ramp(outside, 6, 55)
    heights = tent + thickness(outside) + wrinkles - 3 * ramp(outside, -4, -16)
    return Sheet(np.asarray(heights, np.float32), _picture(heights, look, rng), half)


def _evened(shape: Shape) -> Shape:
    """The shape without its small unevenness, which would draw stripes if it went on beyond the edge."""
    sigma = 5 / shape.step
    pad = int(3 * sigma)
    wide = np.pad(shape.heights, pad, mode="reflect", reflect_type="odd")
    return replace(shape, heights=gaussian_filter(wide, sigma)[pad:-pad, pad:-pad])


def bare(look: Look, rng: np.random.Generator) -> Sheet:
    """A cloth at rest behind a bare patch."""
    x, _ = axes(SPAN, STEP)
    heights = ALONE + cloth.folds(x.shape, STEP, rng)
    return Sheet(np.asarray(heights, np.float32), _picture(heights, look, rng), None)


def _picture(heights: Field, look: Look, rng: np.random.Generator) -> Texture:
    """The cloth lit by the lamps, which hang over it at rest; that it turns with the body near it is left out."""
    size = (round(SPAN[0] / TEXEL), round(SPAN[1] / TEXEL))
    shade, fibre = cloth.weave(size[::-1], TEXEL, rng)
    across, along = gradient(_enlarged(np.asarray(heights, np.float32), size) + fibre, TEXEL)
    hollow = cv2.resize(cv2.GaussianBlur(heights, (0, 0), 12 / STEP) - heights, size)
    shade *= np.clip(1 - 0.06 * np.clip(hollow, -2, 8), 0.5, 1.0)
    facing = 1 / cv2.sqrt(across * across + along * along + 1)
    key, fill = (
        lamp.strength * np.maximum((d[2] - d[0] * across - d[1] * along) * facing + 0.1, 0) / np.float32(1.1)
        for lamp in lamps(look)
        for d in [lamp.towards.astype(np.float32)]
    )
    room = np.float32(look.ambient) * (0.45 + 0.55 * facing)
    tints = zip(AMBIENT, lamps(look)[1].colour, cloth.TEAL, strict=True)
    rest = [shade * (room * np.float32(a) + fill * np.float32(f)) * teal for a, f, teal in tints]
    return np.ascontiguousarray(np.dstack([*rest, shade * key]), np.float32)


def _enlarged(heights: Field, size: tuple[int, int]) -> Field:
    """Heights at the texels' middles (nodes lie on the rim of the span, texels within)."""
    x, y = ((np.arange(n, dtype=np.float32) + 0.5) * np.float32(TEXEL / STEP) for n in size)
    u, v = np.meshgrid(x, y)
    large = cv2.remap(heights, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(cv2.GaussianBlur(large, (0, 0), 0.5 * STEP / TEXEL), np.float32)
