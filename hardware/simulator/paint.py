"""Everything that is painted on the shape: skin, wound and the drape's edge, or a given picture."""

from __future__ import annotations

import cv2
import numpy as np

from estimation.errors import InputError
from hardware.simulator import cloth, flesh
from hardware.simulator.bodies import MARGIN
from hardware.simulator.field import Field, Size, blurred, field, gradient, looked_up, ramp
from hardware.simulator.layers import Layers, Texture, linear, texels
from hardware.simulator.look import Look
from hardware.simulator.scene import drape as sheet
from hardware.simulator.scene import textures as skin
from hardware.simulator.scene.shape import Shape

FADE = (5.5, 8.5)  # mm outside the opening: over this the painted drape hands over to the sheet


def relief(shape: Shape, half: tuple[float, float] | None) -> Field:
    """Heights (H, W) mm at the shape's nodes, the drape laid on it outside the opening of half sides `half`."""
    heights = shape.heights.astype(np.float32)
    if half is not None:
        heights += sheet.thickness(cloth.opening(*sheet.axes(shape.size, shape.step), half))
    return heights


def paint(shape: Shape, heights: Field, half: tuple[float, float] | None, look: Look, seed: int) -> Layers:
    """The shape's layers; heights: as `relief` gives."""
    covered, size = _covered(shape, look)
    pad = (size[1] - covered[1]) // 2, (size[0] - covered[0]) // 2
    corner = (-(covered[1] / 2 + pad[0]) * look.texel, -(covered[0] / 2 + pad[1]) * look.texel)
    u, v = _nodes(shape, size, look.texel, corner)
    rng = np.random.default_rng([seed, 22])
    if look.texture is not None:
        coat = _picture(linear(look.texture), size, pad)
    else:
        inside = None if shape.inside is None else looked_up(field(shape.inside), u, v)
        coat = skin.skin(size, look.texel, inside, look.tone, look.hair, rng)
        if inside is not None:
            bed = flesh.flesh(size, look.texel, inside, rng)
            coat = _wet(flesh.lay_in(coat, bed, inside, look.texel, rng), inside, look.wetness)
    open_sky = _occlusion(heights, coat.height, shape.step, look.texel, u, v)
    valid = np.ones(size, np.float32) if shape.valid is None else looked_up(field(shape.valid), u, v)
    opaque = ramp(valid, 0.4, 0.6)
    if half is not None:
        coat, open_sky, opaque = _draped(coat, open_sky, opaque, u, v, shape, half, look.texel, rng)
    sx, sy = gradient(heights, shape.step)
    mx, my = gradient(coat.height, look.texel)
    across, along = looked_up(sx, u, v) + mx, looked_up(sy, u, v) + my
    opaque *= _on(u, heights.shape[1]) * _on(v, heights.shape[0])
    colour = np.dstack([coat.colour * opaque[..., None], opaque])
    return Layers(colour, np.dstack([across, along, coat.gloss, open_sky]).astype(np.float32), look.texel, corner)


def _on(nodes: Field, count: int) -> Field:
    """1 where a texel's middle lies on the shape."""
    return np.asarray((nodes >= 0) & (nodes <= count - 1), np.float32)


def _covered(shape: Shape, look: Look) -> tuple[Size, Size]:
    """Rows and columns of texels that cover the shape, and those in whole blocks."""
    rows, columns = (round(s / look.texel) for s in shape.size[::-1])
    if look.texture is not None:
        got = look.texture.shape[:2]
        if abs(rows - got[0]) > 1 or abs(columns - got[1]) > 1 or look.texture.ndim != 3:
            raise InputError(
                "look", "texture", look.texture.shape, f"({rows}, {columns}, 3): {look.texel:g} mm a texel"
            )
        rows, columns = got
    return (rows, columns), texels((columns * look.texel, rows * look.texel), look.texel)


def _nodes(shape: Shape, size: Size, texel: float, corner: tuple[float, float]) -> tuple[Field, Field]:
    """The texels' middles in nodes of the shape, along x and along y, (H, W) each."""
    rows, columns = shape.heights.shape
    x = (corner[0] + (np.arange(size[1]) + 0.5) * texel) / shape.step + (columns - 1) / 2
    y = (corner[1] + (np.arange(size[0]) + 0.5) * texel) / shape.step + (rows - 1) / 2
    u, v = np.meshgrid(x.astype(np.float32), y.astype(np.float32))
    return u, v


def _picture(colour: Texture, size: Size, pad: tuple[int, int]) -> skin.Coat:
    """The look's own picture, `pad` texels (x, y) from the corner of whole blocks."""
    x, y = pad
    right, bottom = size[1] - x - colour.shape[1], size[0] - y - colour.shape[0]
    whole = field(cv2.copyMakeBorder(colour, y, bottom, x, right, cv2.BORDER_REPLICATE))
    return skin.Coat(whole, np.zeros(size, np.float32), np.zeros(size, np.float32))


def _wet(coat: skin.Coat, inside: Field, wetness: float) -> skin.Coat:
    """The wound as wet as the look says: a film darkens it and fills its finest hollows."""
    film = ramp(inside, -1.5, 0.5) * np.float32(wetness)
    colour = coat.colour * (1 - 0.14 * film)[..., None]
    height = coat.height - 0.35 * film * (coat.height - blurred(coat.height, 3))
    gloss = coat.gloss * (1 - ramp(inside, -1.5, 0.5) + film)
    return skin.Coat(field(colour), field(height), field(gloss))


def _occlusion(heights: Field, fine: Field, step: float, texel: float, u: Field, v: Field) -> Field:
    """How open each texel is to the room (H, W): less in the wound, under its rim and between its grains."""
    large = np.zeros_like(heights)
    for scale, strength in ((1.2, 0.35), (3.5, 0.16), (9.0, 0.05)):  # mm, per mm of depth below the mean around
        large += strength * (blurred(heights, scale / step) - heights)
    small = 3.0 * (blurred(fine, 0.45 / texel) - fine)
    return field(np.clip(1 - looked_up(large, u, v) - small, 0.35, 1.1))


def _draped(
    coat: skin.Coat,
    open_sky: Field,
    opaque: Field,
    u: Field,
    v: Field,
    shape: Shape,
    half: tuple[float, float],
    texel: float,
    rng: np.random.Generator,
) -> tuple[skin.Coat, Field, Field]:
    """The drape's hem over the skin, and its shadow on it."""
    rows, columns = shape.heights.shape
    x = (u - (columns - 1) / 2) * np.float32(shape.step)
    y = (v - (rows - 1) / 2) * np.float32(shape.step)
    outside = cloth.opening(x, y, half)
    cover = ramp(outside, -texel, texel)
    shade, weave = cloth.weave(coat.height.shape, texel, rng)
    colour = coat.colour + cover[..., None] * (cloth.colour(shade, outside) - coat.colour)
    height = coat.height * (1 - cover) + (weave * 0.5) * cover
    gloss = coat.gloss * (1 - cover) + 0.05 * cover
    open_sky = field(open_sky * (1 - 0.4 * np.exp(-np.abs(outside) / 0.9) * (1 - cover)))
    colour = field(colour)
    opaque = np.maximum(opaque, cover) * ramp(outside, FADE[1], FADE[0])
    painted = skin.Coat(colour, field(height), field(gloss))
    return painted, field(open_sky), field(opaque)


def half_opening(shape: Shape) -> tuple[float, float]:
    """Half sides mm of the opening in a drape over the shape."""
    return shape.size[0] / 2 - MARGIN, shape.size[1] / 2 - MARGIN
