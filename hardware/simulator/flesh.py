"""The bed of a wound: granulation, slough, fibrin, clots, and the pale wet rim of the skin round it."""

from __future__ import annotations

import numpy as np

from hardware.simulator.field import Field, Size, blurred, field, ramp
from hardware.simulator.layers import Texture, linear
from hardware.simulator.scene.fields import cells, octaves, smooth, spots, strokes, wander
from hardware.simulator.scene.textures import Coat

RED = linear([38, 34, 158])
DEEP = linear([28, 20, 96])
PINK = linear([112, 108, 214])
YELLOW = linear([92, 172, 216])
CREAM = linear([164, 212, 234])
BLACK = linear([26, 22, 38])
MACERATED = linear([178, 200, 226])
NEW_SKIN = linear([158, 148, 214])


def flesh(shape: Size, texel: float, inside: Field, rng: np.random.Generator) -> Coat:
    """The wound's bed over (H, W) texels; inside: mm from its edge, positive within."""
    colour, height = _granulation(shape, texel, rng)
    gloss = np.full(shape, 0.85, np.float32)
    slough = _slough(shape, texel, inside, rng)
    fibres = _fibres(shape, texel, rng)
    tissue = YELLOW + ramp(octaves(shape, 2.2 / texel, 3, rng), -1, 1.5)[..., None] * (CREAM - YELLOW)
    tissue *= (1 + 0.10 * octaves(shape, 0.9 / texel, 2, rng) + 0.16 * fibres)[..., None]
    colour += slough[..., None] * (tissue - colour)
    height = height * (1 - 0.75 * slough) + 0.16 * slough + 0.03 * fibres * slough
    gloss -= 0.25 * slough
    strands = np.clip(_strands(shape, texel, rng), 0, 1) * (0.35 + 0.4 * slough)
    colour += strands[..., None] * (CREAM - colour)
    height += 0.05 * strands
    clots = np.clip(spots(shape, 4.2 / texel, (0.3 / texel, 0.95 / texel), rng, 0.5) * 1.5 - 0.15, 0, 0.9)
    clots *= ramp(octaves(shape, 9 / texel, 2, rng), -0.6, 0.5)
    colour += clots[..., None] * (0.5 * (BLACK + DEEP) - colour)
    height += 0.05 * clots
    shadowed = np.exp(-np.clip(inside, 0, None) / 0.8)  # the bed is darkest under the rim
    colour *= (1 - 0.42 * shadowed * np.clip(0.8 + 0.4 * smooth(shape, 4 / texel, rng), 0, 1.2))[..., None]
    return Coat(np.asarray(colour, np.float32), np.asarray(height, np.float32), field(np.clip(gloss, 0, 1)))


def lay_in(skin: Coat, bed: Coat, inside: Field, texel: float, rng: np.random.Generator) -> Coat:
    """Skin with the bed let into it, and between them new skin, a macerated rim and crusts."""
    shape = inside.shape
    ragged = inside + 0.22 * octaves(shape, 1.8 / texel, 3, rng)
    colour = skin.colour.copy()
    pale = np.exp(-(((ragged + 1.5) / 1.15) ** 2)) * np.clip(0.62 + 0.4 * octaves(shape, 6 / texel, 2, rng), 0, 1)
    new = np.exp(-(((ragged + 0.35) / 0.5) ** 2)) * np.clip(0.55 + 0.35 * smooth(shape, 5 / texel, rng), 0, 1)
    crust = np.exp(-(((ragged + 0.9) / 1.0) ** 2)) * ramp(octaves(shape, 3.2 / texel, 3, rng), 0.9, 2.0)
    light = skin.colour.mean() / 0.42  # the rim is as dark as the skin it belongs to
    for amount, tint in (
        (0.62 * pale, MACERATED * light),
        (0.8 * new, NEW_SKIN * light),
        (0.75 * crust, YELLOW * 0.55),
    ):
        colour += amount[..., None] * (tint - colour)
    cover = ramp(ragged, -0.18, 0.22)
    colour += cover[..., None] * (bed.colour - colour)
    wet = np.exp(-np.clip(-ragged, 0, None) / 1.2)
    height = skin.height * (1 - cover) * (1 - 0.5 * pale) + bed.height * cover + 0.05 * pale + 0.10 * crust
    gloss = skin.gloss + (bed.gloss - skin.gloss) * np.clip(cover + 0.55 * wet * (1 - cover), 0, 1)
    height = blurred(field(height), 0.6)
    return Coat(np.asarray(colour, np.float32), height, np.asarray(gloss, np.float32))


def _granulation(shape: Size, texel: float, rng: np.random.Generator) -> tuple[Texture, Field]:
    """Cobbled red tissue: colour (H, W, 3) and height (H, W) mm."""
    edge, which = cells(shape, 1.5 / texel, rng)
    small, what = cells(shape, 0.62 / texel, rng)
    dome = np.sqrt(np.clip(edge * texel / 0.62, 0, 1))
    bead = np.sqrt(np.clip(small * texel / 0.27, 0, 1))
    field = octaves(shape, 7 / texel, 4, rng, 0.7)
    shade = 0.75 * field + 1.1 * (which - 0.5) + 0.7 * (what - 0.5) + 0.6 * (dome - 0.7) + 0.35 * (bead - 0.7)
    colour = RED + ramp(shade, 0.1, 2.6)[..., None] * (PINK - RED)
    colour += ramp(shade, -0.2, -1.9)[..., None] * (DEEP - colour)
    points = spots(shape, 1.5 / texel, (0.12 / texel, 0.3 / texel), rng, 0.7)
    colour += 0.5 * points[..., None] * (DEEP - colour)  # vessels that end at the surface
    height = 0.17 * dome + 0.06 * bead + 0.05 * field
    return colour, np.asarray(height, np.float32)


def _slough(shape: Size, texel: float, inside: Field, rng: np.random.Generator) -> Field:
    """How much dead yellow tissue covers the bed (H, W), in clumps, more of it near the edge."""
    field = octaves(shape, 10 / texel, 5, rng, 0.62) + 0.5 * np.exp(-np.clip(inside, 0, None) / 3.0)
    return ramp(field, 0.45, 1.15) * np.float32(0.92)


def _fibres(shape: Size, texel: float, rng: np.random.Generator) -> Field:
    """Threads of about unit variance (H, W) that follow a wandering direction."""
    y, x = np.mgrid[: shape[0], : shape[1]].astype(np.float32)
    lean = 0.9 * smooth(shape, 14 / texel, rng)
    along = np.cos(lean) * y - np.sin(lean) * x
    wave = along * (2 * np.pi * texel / 0.9) + 1.6 * octaves(shape, 2.5 / texel, 3, rng)
    return np.asarray(np.sin(wave), np.float32)


def _strands(shape: Size, texel: float, rng: np.random.Generator) -> Field:
    """Fibrin: thin pale strands that cross the bed, 0..1 (H, W)."""
    lines = []
    for _ in range(int(0.010 * shape[0] * shape[1] * texel**2)):
        start = rng.uniform(0, 1, 2) * shape[::-1]
        lines.append(wander(start, rng.uniform(0, np.pi), rng.gamma(3, 1.6) / texel, 1.4, rng, 10))
    return strokes(shape, lines, 0.16 / texel, 0.08 / texel)
