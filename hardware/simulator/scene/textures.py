"""Skin, painted by its pigments: melanin and blood take light away, furrows and pores give it relief."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from hardware.simulator.field import Field, Size, field, ramp
from hardware.simulator.layers import Texture, linear
from hardware.simulator.scene.fields import cells, octaves, smooth, spots, strokes, wander

TONES = np.array(  # display BGR from fair to dark
    [[172, 190, 228], [146, 172, 216], [108, 142, 190], [70, 98, 146], [44, 60, 92]], np.float32
)
BLOOD = np.array([0.62, 0.80, 0.13], np.float32)  # what a unit takes from BGR, as an exponent
MELANIN = np.array([0.95, 0.70, 0.42], np.float32)
VENOUS = np.array([0.02, 0.16, 0.34], np.float32)
SCALE = np.array([0.72, 0.82, 0.88], np.float32)  # linear BGR of dry scales and macerated skin


@dataclass(frozen=True, slots=True, eq=False)
class Coat:
    """One painted material, (H, W) each: colour (H, W, 3) linear BGR, height mm, gloss 0..1."""

    colour: Texture
    height: Field
    gloss: Field


def base_colour(tone: float) -> Texture:
    """Linear BGR (3,) of skin of a tone 0..1."""
    place = np.clip(tone, 0, 1) * (len(TONES) - 1)
    return linear([np.interp(place, np.arange(len(TONES)), TONES[:, k]) for k in range(3)])


def skin(shape: Size, texel: float, inside: Field | None, tone: float, hair: float, rng: np.random.Generator) -> Coat:
    """Skin over (H, W) texels; inside: mm into the wound, for the redness round it."""
    edges, which = cells(shape, 0.95 / texel, rng)
    fine, _ = cells(shape, 0.45 / texel, rng)
    furrow = np.exp(-((edges * (texel / 0.11)) ** 2)) * np.clip(0.65 + 0.4 * smooth(shape, 6 / texel, rng), 0.1, 1)
    crease = np.exp(-((fine * (texel / 0.07)) ** 2))
    pores = spots(shape, 2.1 / texel, (0.10 / texel, 0.2 / texel), rng, 0.7)
    grain = smooth(shape, max(2.0, 0.22 / texel), rng)
    blood, melanin = _pigments(shape, texel, rng)
    blood += 0.05 * grain + 0.10 * (which - 0.5) + 0.14 * furrow + 0.16 * pores
    melanin += 0.05 * (which - 0.5) + 0.05 * furrow + 0.05 * crease + 0.12 * pores + 0.035 * grain
    if inside is not None:
        blood, melanin = _round_wound(shape, texel, inside, blood, melanin, rng)
    veins = _veins(shape, texel, rng)
    veil = 1 - 0.6 * tone  # blood shows less through dark skin
    exponent = blood[..., None] * (BLOOD * veil) + melanin[..., None] * MELANIN + veins[..., None] * (VENOUS * veil)
    colour = base_colour(tone) * cv2.exp(-exponent)
    scales = ramp(octaves(shape, 3.0 / texel, 3, rng), 1.5, 2.6) * np.float32(0.14 * (1 - 0.5 * tone))
    colour += scales[..., None] * (0.8 * SCALE - colour)
    height = -0.030 * furrow - 0.009 * crease - 0.035 * pores + 0.010 * grain + 0.02 * scales
    if hair > 0:
        colour, height = _hairs(shape, texel, tone, hair, colour, height, inside, rng)
    gloss = np.clip(0.22 + 0.05 * smooth(shape, 12 / texel, rng) - 0.10 * furrow, 0.05, 0.5)
    return Coat(np.asarray(colour, np.float32), np.asarray(height, np.float32), np.asarray(gloss, np.float32))


def _pigments(shape: Size, texel: float, rng: np.random.Generator) -> tuple[Field, Field]:
    """Blood and melanin (H, W) in excess of the mean, of intact skin."""
    blood = 0.16 * octaves(shape, 24 / texel, 4, rng, 0.75) + 0.07 * octaves(shape, 2.4 / texel, 3, rng, 0.8)
    net = np.abs(octaves(shape, 11 / texel, 3, rng))  # marbling: paler islands in a bluish red net
    blood += 0.10 * np.exp(-((net / 0.22) ** 2)) * np.clip(0.5 + smooth(shape, 40 / texel, rng), 0, 1.2)
    melanin = 0.07 * octaves(shape, 9 / texel, 4, rng, 0.7)
    melanin += 0.42 * spots(shape, 7.5 / texel, (0.22 / texel, 0.75 / texel), rng, 0.5)  # freckles
    melanin += 1.3 * spots(shape, 42 / texel, (0.5 / texel, 1.0 / texel), rng, 0.35)  # moles
    blood += 0.9 * spots(shape, 26 / texel, (0.25 / texel, 0.5 / texel), rng, 0.4)  # cherry spots
    return np.asarray(blood, np.float32), np.asarray(melanin, np.float32)


def _round_wound(
    shape: Size, texel: float, inside: Field, blood: Field, melanin: Field, rng: np.random.Generator
) -> tuple[Field, Field]:
    """Inflamed near the wound, uneven; stained further out."""
    away = np.clip(-inside, 0, None)
    patchy = np.clip(1 + 0.45 * octaves(shape, 9 / texel, 3, rng), 0.2, 2)
    blood += (0.62 * np.exp(-away / 4.5) + 0.28 * np.exp(-away / 14)) * patchy
    melanin += 0.16 * np.exp(-away / 10) * np.clip(octaves(shape, 6 / texel, 3, rng), 0, 2)
    return np.asarray(blood, np.float32), np.asarray(melanin, np.float32)


def _veins(shape: Size, texel: float, rng: np.random.Generator) -> Field:
    """Bluish vessels under the skin (H, W), 0..1."""
    out = np.zeros(shape, np.float32)
    for width in (2.2, 1.5, 1.1):
        lines = []
        for _ in range(2):
            start = rng.uniform(0.05, 0.95, 2) * shape[::-1]
            lines.append(wander(start, rng.uniform(-0.5, 0.5), 0.8 * shape[1], 0.9, rng, 24))
        out += 0.55 * strokes(shape, lines, width / texel, 0.55 * width / texel)
    return out


def _hairs(
    shape: Size,
    texel: float,
    tone: float,
    hair: float,
    colour: Texture,
    height: Field,
    inside: Field | None,
    rng: np.random.Generator,
) -> tuple[Texture, Field]:
    """Fine dark hairs that lie one way, with a follicle at the root of each; none in the wound."""
    area = shape[0] * shape[1] * texel**2
    lines = []
    for _ in range(int(0.035 * hair * area)):
        start = rng.uniform(0, 1, 2) * shape[::-1]
        x, y = start.astype(int)
        if inside is not None and inside[y, x] > -2.5:
            continue
        lines.append(wander(start, 0.5 + rng.normal(0, 0.45), rng.gamma(4, 1.4) / texel, 0.7, rng, 8))
    cover = strokes(shape, lines, 0.075 / texel) * 0.62
    roots = strokes(shape, [line[:2] for line in lines], 0.2 / texel, 0.1 / texel) * 0.3
    dark = base_colour(min(1.0, tone + 0.75)) * np.float32(0.25)
    shade = np.roll(cover, (2, 1), (0, 1)) * 0.25  # a hair's own shadow
    colour = field(colour * (1 - (roots + shade)[..., None]))
    return colour + cover[..., None] * (dark - colour), height + 0.02 * cover
