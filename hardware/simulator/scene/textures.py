"""What is painted on the body: skin by its pigments, the bed of the wound, the drape's hem, or a given picture."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from estimation.errors import InputError
from hardware.simulator.scene.appearance import (
    Appearance,
    cloth_colour,
    cloth_thickness,
    node_axes,
    opening_distance,
    weave_texture,
)
from hardware.simulator.scene.fields import (
    BLOCK_TEXELS,
    Field,
    Layers,
    Size,
    Texture,
    as_field,
    draw_lines,
    gaussian_blur,
    gradient,
    linear_light,
    octave_noise,
    random_spots,
    sample,
    smooth_noise,
    smoothstep,
    voronoi_cells,
    wandering_line,
)
from hardware.simulator.scene.shape import DRAPE_MARGIN, Shape

SKIN_TONES = np.array(  # display BGR from fair to dark
    [[172, 190, 228], [146, 172, 216], [108, 142, 190], [70, 98, 146], [44, 60, 92]], np.float32
)
BLOOD_ABSORPTION = np.array([0.62, 0.80, 0.13], np.float32)  # what a unit takes from BGR, as an exponent
MELANIN_ABSORPTION = np.array([0.95, 0.70, 0.42], np.float32)
VEIN_ABSORPTION = np.array([0.02, 0.16, 0.34], np.float32)
SCALE_COLOUR = np.array([0.72, 0.82, 0.88], np.float32)  # linear BGR of dry scales and macerated skin


@dataclass(frozen=True, slots=True, eq=False)
class Coat:
    """One painted material."""

    colour: Texture  # (H, W, 3) linear BGR
    height: Field  # (H, W) mm
    gloss: Field  # (H, W) 0..1


def base_colour(tone: float) -> Texture:
    """Linear BGR (3,) of skin of a tone 0..1."""
    place = np.clip(tone, 0, 1) * (len(SKIN_TONES) - 1)
    return linear_light([np.interp(place, np.arange(len(SKIN_TONES)), SKIN_TONES[:, k]) for k in range(3)])


def skin_coat(shape: Size, look: Appearance, inside: Field | None, rng: np.random.Generator) -> Coat:
    """Skin over (H, W) texels; inside: mm into the wound, for the redness round it."""
    texel, tone = look.texel, look.tone
    edges, which = voronoi_cells(shape, 0.95 / texel, rng)
    fine, _ = voronoi_cells(shape, 0.45 / texel, rng)
    uneven = np.clip(0.65 + 0.4 * smooth_noise(shape, 6 / texel, rng), 0.1, 1)
    furrow = np.exp(-((edges * (texel / 0.11)) ** 2)) * uneven
    crease = np.exp(-((fine * (texel / 0.07)) ** 2))
    pores = random_spots(shape, 2.1 / texel, (0.10 / texel, 0.2 / texel), rng, 0.7)
    grain = smooth_noise(shape, max(2.0, 0.22 / texel), rng)
    blood, melanin = _pigments(shape, texel, rng)
    blood += 0.05 * grain + 0.10 * (which - 0.5) + 0.14 * furrow + 0.16 * pores
    melanin += 0.05 * (which - 0.5) + 0.05 * furrow + 0.05 * crease + 0.12 * pores + 0.035 * grain
    if inside is not None:
        away = np.clip(-inside, 0, None)
        patchy = np.clip(1 + 0.45 * octave_noise(shape, 9 / texel, 3, rng), 0.2, 2)
        blood = as_field(blood + (0.62 * np.exp(-away / 4.5) + 0.28 * np.exp(-away / 14)) * patchy)
        pigmented = np.clip(octave_noise(shape, 6 / texel, 3, rng), 0, 2)
        melanin = as_field(melanin + 0.16 * np.exp(-away / 10) * pigmented)
    veins = _veins(shape, texel, rng)
    veil = 1 - 0.6 * tone  # blood shows less through dark skin
    exponent = blood[..., None] * (BLOOD_ABSORPTION * veil) + melanin[..., None] * MELANIN_ABSORPTION
    exponent = exponent + veins[..., None] * (VEIN_ABSORPTION * veil)
    colour = base_colour(tone) * cv2.exp(-exponent)
    scales = smoothstep(octave_noise(shape, 3.0 / texel, 3, rng), 1.5, 2.6) * np.float32(0.14 * (1 - 0.5 * tone))
    colour += scales[..., None] * (0.8 * SCALE_COLOUR - colour)
    height = -0.030 * furrow - 0.009 * crease - 0.035 * pores + 0.010 * grain + 0.02 * scales
    if look.hair > 0:
        colour, height = _hairs(colour, height, inside, look, rng)
    gloss = np.clip(0.22 + 0.05 * smooth_noise(shape, 12 / texel, rng) - 0.10 * furrow, 0.05, 0.5)
    return Coat(np.asarray(colour, np.float32), np.asarray(height, np.float32), np.asarray(gloss, np.float32))


def _pigments(shape: Size, texel: float, rng: np.random.Generator) -> tuple[Field, Field]:
    blood = 0.16 * octave_noise(shape, 24 / texel, 4, rng, 0.75) + 0.07 * octave_noise(shape, 2.4 / texel, 3, rng, 0.8)
    net = np.abs(octave_noise(shape, 11 / texel, 3, rng))  # marbling: paler islands in a bluish red net
    blood += 0.10 * np.exp(-((net / 0.22) ** 2)) * np.clip(0.5 + smooth_noise(shape, 40 / texel, rng), 0, 1.2)
    melanin = 0.07 * octave_noise(shape, 9 / texel, 4, rng, 0.7)
    melanin += 0.42 * random_spots(shape, 7.5 / texel, (0.22 / texel, 0.75 / texel), rng, 0.5)  # freckles
    melanin += 1.3 * random_spots(shape, 42 / texel, (0.5 / texel, 1.0 / texel), rng, 0.35)  # moles
    blood += 0.9 * random_spots(shape, 26 / texel, (0.25 / texel, 0.5 / texel), rng, 0.4)  # cherry spots
    return np.asarray(blood, np.float32), np.asarray(melanin, np.float32)


def _veins(shape: Size, texel: float, rng: np.random.Generator) -> Field:
    out = np.zeros(shape, np.float32)
    for width in (2.2, 1.5, 1.1):
        lines = []
        for _ in range(2):
            start = rng.uniform(0.05, 0.95, 2) * shape[::-1]
            lines.append(wandering_line(start, rng.uniform(-0.5, 0.5), 0.8 * shape[1], 0.9, rng, 24))
        out += 0.55 * draw_lines(shape, lines, width / texel, 0.55 * width / texel)
    return out


def _hairs(
    colour: Texture, height: Field, inside: Field | None, look: Appearance, rng: np.random.Generator
) -> tuple[Texture, Field]:
    """Colour and height with fine dark hairs that lie one way, a follicle at the root of each; none in the wound."""
    shape, texel, lines = height.shape, look.texel, []
    area = shape[0] * shape[1] * texel**2
    for _ in range(int(0.035 * look.hair * area)):
        start = rng.uniform(0, 1, 2) * shape[::-1]
        x, y = start.astype(int)
        if inside is not None and inside[y, x] > -2.5:
            continue
        lines.append(wandering_line(start, 0.5 + rng.normal(0, 0.45), rng.gamma(4, 1.4) / texel, 0.7, rng, 8))
    cover = draw_lines(shape, lines, 0.075 / texel) * 0.62
    roots = draw_lines(shape, [line[:2] for line in lines], 0.2 / texel, 0.1 / texel) * 0.3
    dark = base_colour(min(1.0, look.tone + 0.75)) * np.float32(0.25)
    shade = np.roll(cover, (2, 1), (0, 1)) * 0.25  # a hair's own shadow
    colour = as_field(colour * (1 - (roots + shade)[..., None]))
    return colour + cover[..., None] * (dark - colour), height + 0.02 * cover


GRANULATION_RED = linear_light([38, 34, 158])
GRANULATION_DARK = linear_light([28, 20, 96])
GRANULATION_PINK = linear_light([112, 108, 214])
SLOUGH_YELLOW = linear_light([92, 172, 216])
FIBRIN_CREAM = linear_light([164, 212, 234])
CLOT_BLACK = linear_light([26, 22, 38])
MACERATED_SKIN = linear_light([178, 200, 226])
NEW_SKIN = linear_light([158, 148, 214])


def wound_bed_coat(shape: Size, texel: float, inside: Field, rng: np.random.Generator) -> Coat:
    """The wound's bed over (H, W) texels; inside: mm from its edge, positive within."""
    colour, height = _granulation(shape, texel, rng)
    gloss = np.full(shape, 0.85, np.float32)
    base = octave_noise(shape, 10 / texel, 5, rng, 0.62) + 0.5 * np.exp(-np.clip(inside, 0, None) / 3.0)
    slough = smoothstep(base, 0.45, 1.15) * np.float32(0.92)
    y, x = np.mgrid[: shape[0], : shape[1]].astype(np.float32)
    lean = 0.9 * smooth_noise(shape, 14 / texel, rng)
    along = np.cos(lean) * y - np.sin(lean) * x
    fibres = np.sin(along * (2 * np.pi * texel / 0.9) + 1.6 * octave_noise(shape, 2.5 / texel, 3, rng))
    shade = smoothstep(octave_noise(shape, 2.2 / texel, 3, rng), -1, 1.5)[..., None]
    tissue = SLOUGH_YELLOW + shade * (FIBRIN_CREAM - SLOUGH_YELLOW)
    tissue *= (1 + 0.10 * octave_noise(shape, 0.9 / texel, 2, rng) + 0.16 * fibres)[..., None]
    colour += slough[..., None] * (tissue - colour)
    height = height * (1 - 0.75 * slough) + 0.16 * slough + 0.03 * fibres * slough
    gloss -= 0.25 * slough
    lines = []
    for _ in range(int(0.010 * shape[0] * shape[1] * texel**2)):
        start = rng.uniform(0, 1, 2) * shape[::-1]
        lines.append(wandering_line(start, rng.uniform(0, np.pi), rng.gamma(3, 1.6) / texel, 1.4, rng, 10))
    strands = np.clip(draw_lines(shape, lines, 0.16 / texel, 0.08 / texel), 0, 1) * (0.35 + 0.4 * slough)
    colour += strands[..., None] * (FIBRIN_CREAM - colour)
    height += 0.05 * strands
    clots = np.clip(random_spots(shape, 4.2 / texel, (0.3 / texel, 0.95 / texel), rng, 0.5) * 1.5 - 0.15, 0, 0.9)
    clots *= smoothstep(octave_noise(shape, 9 / texel, 2, rng), -0.6, 0.5)
    colour += clots[..., None] * (0.5 * (CLOT_BLACK + GRANULATION_DARK) - colour)
    height += 0.05 * clots
    shadowed = np.exp(-np.clip(inside, 0, None) / 0.8)  # the bed is darkest under the rim
    colour *= (1 - 0.42 * shadowed * np.clip(0.8 + 0.4 * smooth_noise(shape, 4 / texel, rng), 0, 1.2))[..., None]
    return Coat(np.asarray(colour, np.float32), np.asarray(height, np.float32), as_field(np.clip(gloss, 0, 1)))


def insert_wound_bed(skin: Coat, bed: Coat, inside: Field, texel: float, rng: np.random.Generator) -> Coat:
    """Skin with the bed let into it, and between them new skin, a macerated rim and crusts."""
    shape = inside.shape
    ragged = inside + 0.22 * octave_noise(shape, 1.8 / texel, 3, rng)
    colour = skin.colour.copy()
    pale = np.exp(-(((ragged + 1.5) / 1.15) ** 2)) * np.clip(0.62 + 0.4 * octave_noise(shape, 6 / texel, 2, rng), 0, 1)
    new = np.exp(-(((ragged + 0.35) / 0.5) ** 2)) * np.clip(0.55 + 0.35 * smooth_noise(shape, 5 / texel, rng), 0, 1)
    crust = np.exp(-(((ragged + 0.9) / 1.0) ** 2)) * smoothstep(octave_noise(shape, 3.2 / texel, 3, rng), 0.9, 2.0)
    light = skin.colour.mean() / 0.42  # the rim is as dark as the skin it belongs to
    colour += (0.62 * pale)[..., None] * (MACERATED_SKIN * light - colour)
    colour += (0.8 * new)[..., None] * (NEW_SKIN * light - colour)
    colour += (0.75 * crust)[..., None] * (SLOUGH_YELLOW * 0.55 - colour)
    cover = smoothstep(ragged, -0.18, 0.22)
    colour += cover[..., None] * (bed.colour - colour)
    wet = np.exp(-np.clip(-ragged, 0, None) / 1.2)
    height = skin.height * (1 - cover) * (1 - 0.5 * pale) + bed.height * cover + 0.05 * pale + 0.10 * crust
    gloss = skin.gloss + (bed.gloss - skin.gloss) * np.clip(cover + 0.55 * wet * (1 - cover), 0, 1)
    height = gaussian_blur(as_field(height), 0.6)
    return Coat(np.asarray(colour, np.float32), height, np.asarray(gloss, np.float32))


def _granulation(shape: Size, texel: float, rng: np.random.Generator) -> tuple[Texture, Field]:
    edge, which = voronoi_cells(shape, 1.5 / texel, rng)
    small, what = voronoi_cells(shape, 0.62 / texel, rng)
    dome = np.sqrt(np.clip(edge * texel / 0.62, 0, 1))
    bead = np.sqrt(np.clip(small * texel / 0.27, 0, 1))
    base = octave_noise(shape, 7 / texel, 4, rng, 0.7)
    shade = 0.75 * base + 1.1 * (which - 0.5) + 0.7 * (what - 0.5) + 0.6 * (dome - 0.7) + 0.35 * (bead - 0.7)
    colour = GRANULATION_RED + smoothstep(shade, 0.1, 2.6)[..., None] * (GRANULATION_PINK - GRANULATION_RED)
    colour += smoothstep(shade, -0.2, -1.9)[..., None] * (GRANULATION_DARK - colour)
    points = random_spots(shape, 1.5 / texel, (0.12 / texel, 0.3 / texel), rng, 0.7)
    colour += 0.5 * points[..., None] * (GRANULATION_DARK - colour)  # vessels that end at the surface
    height = 0.17 * dome + 0.06 * bead + 0.05 * base
    return colour, np.asarray(height, np.float32)


DRAPE_FADE = (5.5, 8.5)  # mm outside the opening: over this the painted drape hands over to the sheet


def draped_heights(shape: Shape, half: tuple[float, float] | None) -> Field:
    """Heights (H, W) mm at the shape's nodes, the drape laid on it outside the opening of half sides `half`."""
    heights = shape.heights.astype(np.float32)
    if half is not None:
        heights += cloth_thickness(opening_distance(*node_axes(shape.size, shape.step), half))
    return heights


def paint_layers(shape: Shape, heights: Field, half: tuple[float, float] | None, look: Appearance, seed: int) -> Layers:
    """The shape's layers; heights: as `draped_heights` gives."""
    covered, size = _texture_size(shape, look)
    left, top = (size[1] - covered[1]) // 2, (size[0] - covered[0]) // 2
    corner = (-(covered[1] / 2 + left) * look.texel, -(covered[0] / 2 + top) * look.texel)
    x, y = (c + (np.arange(n) + 0.5) * look.texel for c, n in zip(corner, size[::-1], strict=True))  # texels' middles
    rows, columns = shape.heights.shape
    nodes = x / shape.step + (columns - 1) / 2, y / shape.step + (rows - 1) / 2
    u, v = np.meshgrid(*(axis.astype(np.float32) for axis in nodes))
    rng = np.random.default_rng([seed, 22])
    if look.texture is not None:
        edges = top, size[0] - top - covered[0], left, size[1] - left - covered[1]
        colour = as_field(cv2.copyMakeBorder(linear_light(look.texture), *edges, cv2.BORDER_REPLICATE))
        coat = Coat(colour, np.zeros(size, np.float32), np.zeros(size, np.float32))
    else:
        inside = None if shape.inside is None else sample(as_field(shape.inside), u, v)
        coat = skin_coat(size, look, inside, rng)
        if inside is not None:
            bed = wound_bed_coat(size, look.texel, inside, rng)
            coat = _wetted(insert_wound_bed(coat, bed, inside, look.texel, rng), inside, look.wetness)
    open_sky = _occlusion(heights, coat.height, shape.step, look.texel, u, v)
    valid = np.ones(size, np.float32) if shape.valid is None else sample(as_field(shape.valid), u, v)
    opaque = smoothstep(valid, 0.4, 0.6)
    if half is not None:
        x, y = (u - (columns - 1) / 2) * np.float32(shape.step), (v - (rows - 1) / 2) * np.float32(shape.step)
        coat, open_sky, opaque = _add_drape(coat, open_sky, opaque, opening_distance(x, y, half), look.texel, rng)
    sx, sy = gradient(heights, shape.step)
    mx, my = gradient(coat.height, look.texel)
    across, along = sample(sx, u, v) + mx, sample(sy, u, v) + my
    opaque *= (u >= 0) & (u <= heights.shape[1] - 1) & (v >= 0) & (v <= heights.shape[0] - 1)
    colour = np.dstack([coat.colour * opaque[..., None], opaque])
    return Layers(colour, np.dstack([across, along, coat.gloss, open_sky]).astype(np.float32), look.texel, corner)


def _texture_size(shape: Shape, look: Appearance) -> tuple[Size, Size]:
    """Texels that cover the shape, and the whole blocks of texels that hold them."""
    rows, columns = (round(s / look.texel) for s in shape.size[::-1])
    if look.texture is not None:
        got = look.texture.shape[:2]
        if abs(rows - got[0]) > 1 or abs(columns - got[1]) > 1 or look.texture.ndim != 3:
            allowed = f"({rows}, {columns}, 3): {look.texel:g} mm a texel"
            raise InputError("look", "texture", look.texture.shape, allowed)
        rows, columns = got
    return (rows, columns), (-(-rows // BLOCK_TEXELS) * BLOCK_TEXELS, -(-columns // BLOCK_TEXELS) * BLOCK_TEXELS)


def _wetted(coat: Coat, inside: Field, wetness: float) -> Coat:
    film = smoothstep(inside, -1.5, 0.5) * np.float32(wetness)
    colour = coat.colour * (1 - 0.14 * film)[..., None]
    height = coat.height - 0.35 * film * (coat.height - gaussian_blur(coat.height, 3))
    gloss = coat.gloss * (1 - smoothstep(inside, -1.5, 0.5) + film)
    return Coat(as_field(colour), as_field(height), as_field(gloss))


def _occlusion(heights: Field, fine: Field, step: float, texel: float, u: Field, v: Field) -> Field:
    """How open each texel is to the room (H, W): less in the wound, under its rim and between its grains."""
    large = np.zeros_like(heights)
    for scale, strength in ((1.2, 0.35), (3.5, 0.16), (9.0, 0.05)):  # mm, per mm of depth below the mean around
        large += strength * (gaussian_blur(heights, scale / step) - heights)
    small = 3.0 * (gaussian_blur(fine, 0.45 / texel) - fine)
    return as_field(np.clip(1 - sample(large, u, v) - small, 0.35, 1.1))


def _add_drape(
    coat: Coat, open_sky: Field, opaque: Field, outside: Field, texel: float, rng: np.random.Generator
) -> tuple[Coat, Field, Field]:
    """Coat, openness and opacity with the drape over them; outside: (H, W) mm from its opening."""
    cover = smoothstep(outside, -texel, texel)
    shade, weave = weave_texture(coat.height.shape, texel, rng)
    colour = coat.colour + cover[..., None] * (cloth_colour(shade, outside) - coat.colour)
    height = coat.height * (1 - cover) + (weave * 0.5) * cover
    gloss = coat.gloss * (1 - cover) + 0.05 * cover
    open_sky = as_field(open_sky * (1 - 0.4 * np.exp(-np.abs(outside) / 0.9) * (1 - cover)))
    opaque = np.maximum(opaque, cover) * smoothstep(outside, DRAPE_FADE[1], DRAPE_FADE[0])
    return Coat(as_field(colour), as_field(height), as_field(gloss)), open_sky, as_field(opaque)


def half_opening(shape: Shape) -> tuple[float, float]:
    """Half sides mm of the opening in a drape over the shape."""
    return shape.size[0] / 2 - DRAPE_MARGIN, shape.size[1] / 2 - DRAPE_MARGIN
