"""How a scene looks: skin and lamps, light off a surface, printed beads, the surgical drape, the image sensor."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import cv2
import numpy as np
from scipy.ndimage import gaussian_filter

from estimation.rig import Camera
from estimation.se3 import Array
from hardware.process import checks
from hardware.simulator.scene.fields import (
    Field,
    Size,
    Texture,
    as_field,
    draw_lines,
    fibre_noise,
    gaussian_blur,
    gradient,
    linear_light,
    octave_noise,
    sample,
    smoothstep,
    wandering_line,
)
from hardware.simulator.scene.shape import Shape
from perception.frames import Image


@dataclass(frozen=True, slots=True, eq=False)
class Appearance:
    """How a scene looks."""

    texel: float = 0.1  # mm of the texture
    tone: float = 0.2  # 0 fair to 1 dark skin
    wetness: float = 0.6  # 0 dry to 1 dripping
    hair: float = 0.5  # 0 none, 1 an arm's
    drape: bool = True  # round an opening, moving with the skin; else a bare patch before a cloth at rest
    texture: Image | None = None  # (H, W, 3) BGR over the whole shape (row 0 at the least y) instead of skin
    lit: bool = True  # else a texture is imaged as it is
    ambient: float = 0.3  # irradiance of a white surface that faces the room, the key lamp, the fill lamp
    key: float = 0.62
    fill: float = 0.2


@dataclass(frozen=True, slots=True, eq=False)
class Lamp:
    """A lamp far away."""

    towards: Array  # (3,) unit, rest frame (z out of the wound)
    strength: float  # irradiance
    spread: float  # rad, its radius seen from the wound
    colour: tuple[float, float, float]  # BGR


def lamps(look: Appearance) -> tuple[Lamp, Lamp]:
    """The key lamp, warm and to one side, and the fill, cool and broad, on the other."""
    key, fill = (np.array(v) / np.linalg.norm(v) for v in ((-0.62, -0.30, 1.0), (0.75, 0.42, 1.0)))
    return Lamp(key, look.key, 0.075, (0.93, 0.99, 1.04)), Lamp(fill, look.fill, 0.2, (1.08, 1.0, 0.94))


AMBIENT_COLOUR = (1.04, 1.0, 0.98)  # BGR of the room
GRAIN_MARGIN_PX = 256  # by which the stored grain is larger than an image: each image takes another cut of it
MAX_NOISE, MAX_VIGNETTING, MAX_BLUR = 50.0, 2.0, 10.0  # the most of each; more is no camera
ROWS_AT_ONCE = 48  # rows developed at once: they stay in the cache


@dataclass(frozen=True, slots=True)
class Sensor:
    """What a camera does to the light.

    The display's value is the square root of the light, so the light's shot noise is the same everywhere in the image.
    """

    noise: float = 1.5  # grey levels, one sigma
    vignetting: float = 0.8  # 1 is a bare lens's cos^4 law, 0 none
    blur: float = 0.45  # px, one sigma, of lens and colour filter

    def __post_init__(self) -> None:
        for name, most in (("noise", MAX_NOISE), ("vignetting", MAX_VIGNETTING), ("blur", MAX_BLUR)):
            checks.within(0, most)("sensor", name, getattr(self, name))


def vignette(camera: Camera, sensor: Sensor) -> Field:
    """Share of the light (H, W, 3) that reaches each pixel."""
    x = (np.arange(camera.size[0]) - camera.matrix[0, 2]) / camera.matrix[0, 0]
    y = (np.arange(camera.size[1]) - camera.matrix[1, 2]) / camera.matrix[1, 1]
    share = (1 + x**2 + y[:, None] ** 2) ** (-2 * sensor.vignetting)
    return np.ascontiguousarray(np.repeat(share[..., None], 3, 2), np.float32)


def expose(light: Field, sensor: Sensor, fall: Field, gain: float, rng: np.random.Generator) -> Image:
    """The image (H, W, 3) BGR of linear light (H, W, 3); fall: as `vignette` gives.

    The grain is a cut at random from one large field (drawing anew is ten times slower).
    """
    h, w = light.shape[:2]
    y, x = rng.integers(0, GRAIN_MARGIN_PX, 2)
    grain = _grain(h, w)[y : y + h, x : x + w]
    image = np.empty((h, w, 3), np.uint8)
    halo = int(np.ceil(6 * sensor.blur))  # rows that the blur reads beyond its own
    for first in range(0, h, ROWS_AT_ONCE):
        rows, low = slice(first, first + ROWS_AT_ONCE), max(first - halo, 0)
        part = light[low : first + ROWS_AT_ONCE + halo]
        if sensor.blur:
            part = gaussian_blur(part, sensor.blur)
        part = part[first - low : first - low + len(image[rows])]
        display = cv2.sqrt(cv2.multiply(part, fall[rows], scale=gain * 255.0**2))
        image[rows] = cv2.addWeighted(display, 1.0, grain[rows], sensor.noise, 0.0, dtype=cv2.CV_8U)
    return image


@lru_cache(maxsize=4)
def _grain(h: int, w: int) -> Field:
    return np.random.default_rng([31, h, w]).standard_normal((h + GRAIN_MARGIN_PX, w + GRAIN_MARGIN_PX, 3), np.float32)


SCATTER_WRAP = (0.10, 0.13, 0.30)  # BGR, share of the lamp's light: how far it scatters into the shade under the skin
WET_REFLECTANCE = 0.06  # of light that a film of water and serum sends back
WET_ROUGHNESS = 0.075  # slope, one sigma: how rough the film is
DRY_ROUGHNESS = 0.32  # slope, one sigma: how rough dry skin is
DRY_REFLECTANCE = 0.035


def mirror_slopes(rays: tuple[Field, Field, Field], towards: Array) -> Field:
    """Slopes (H, W, 2 a lamp) of surfaces that mirror each lamp into the eye; rays: their x, y, z, grid frame."""
    x, y, z = rays
    length = np.sqrt(x * x + y * y + z * z)
    out = []
    for lamp in towards.astype(np.float32):
        up = np.maximum(lamp[2] - z / length, 0.05)
        out += [-(lamp[0] - x / length) / up, -(lamp[1] - y / length) / up]
    return np.asarray(np.dstack(out), np.float32)


def lamp_table(lamps: tuple[Lamp, Lamp], towards: Array, ambient: float) -> tuple[Field, Field]:
    """(2, 10) the lamps and (7,) the room, as `ray_kernels.shade` takes them; towards: (2, 3), grid frame.

    What a film mirrors is Beckmann's lobe over the square of the slope between surface and mirror, widened by the
    lamp's own size: one of the wet film and one of dry skin.
    """
    rows = []
    for lamp, direction in zip(lamps, towards, strict=True):
        strength = lamp.strength * np.array(lamp.colour) / (1 + np.array(SCATTER_WRAP))
        row = [*direction, *strength]
        for rough, mirror in ((WET_ROUGHNESS, WET_REFLECTANCE), (DRY_ROUGHNESS, DRY_REFLECTANCE)):
            width = rough**2 + (lamp.spread / 2) ** 2
            row += [-0.5 / width, lamp.strength * mirror / (4 * width)]
        rows.append(row)
    return as_field(rows), as_field([*(ambient * c for c in AMBIENT_COLOUR), ambient, *SCATTER_WRAP])


CLOTH_TEAL = linear_light([136, 122, 44])
HEM_TEAL = linear_light([150, 138, 64])


def fold_heights(shape: Size, texel: float, rng: np.random.Generator) -> Field:
    """Heights (H, W) mm of wrinkles, tucks and packing creases about the cloth's mean."""
    height = 4.0 * octave_noise(shape, 110 / texel, 3, rng, 0.5)
    for width, tall, count in ((17.0, 7.0, 10), (9.0, 3.6, 16), (5.0, 1.6, 26)):  # mm
        lines = []
        for _ in range(count):
            start = rng.uniform(-0.05, 1.05, 2) * shape[::-1]
            lines.append(wandering_line(start, rng.uniform(0, 2 * np.pi), rng.uniform(60, 240) / texel, 0.5, rng, 24))
        ridge = draw_lines(shape, lines, 1.0, width / 2.2 / texel)
        height += tall * np.tanh(1.6 * ridge / max(float(np.quantile(ridge, 0.985)), 1e-6))
    for axis, n in ((0, 4), (1, 5)):  # it was packed folded
        place = np.arange(shape[axis], dtype=np.float32) * texel
        pitch = shape[axis] * texel / n
        distance = np.abs(np.mod(place - rng.uniform(0, pitch), pitch) - pitch / 2)
        crease = (1.6 * np.exp(-distance / 2.4)).astype(np.float32)
        height += crease[:, None] if axis == 0 else crease
    return np.asarray(cv2.GaussianBlur(height, (0, 0), 1.2 / texel), np.float32)


def weave_texture(shape: Size, texel: float, rng: np.random.Generator) -> tuple[Field, Field]:
    """Shade (about 1) and height mm (H, W) of the pressed fibres."""
    fibre = np.zeros(shape, np.float32)
    for a, b in ((3.0, 0.5), (0.5, 3.0), (1.2, 1.2)):  # mm
        fibre = fibre + fibre_noise(shape, (a / texel, b / texel), rng)
    shade = 1 + 0.035 * fibre + 0.05 * octave_noise(shape, 30 / texel, 3, rng)
    return np.asarray(shade, np.float32), np.asarray(0.012 * fibre, np.float32)


OPENING_CORNER = 14.0  # mm, radius of the opening's corners


def opening_distance(x: Field, y: Field, half: tuple[float, float], corner: float = OPENING_CORNER) -> Field:
    """Distance mm outside the rounded opening of half sides `half`, negative inside, at material points x, y."""
    dx, dy = np.abs(x) - (half[0] - corner), np.abs(y) - (half[1] - corner)
    outside = np.hypot(np.maximum(dx, 0), np.maximum(dy, 0)) + np.minimum(np.maximum(dx, dy), 0)
    return np.asarray(outside - corner, np.float32)


def cloth_colour(shade: Field, outside: Field) -> Texture:
    """Linear BGR (H, W, 3) of the cloth; the hem round the opening is a second layer, stitched."""
    hem = smoothstep(outside, 7.2, 6.8)
    seam = np.exp(-(((outside - 6.6) / 0.35) ** 2)) * np.float32(0.3)
    picture = CLOTH_TEAL + (0.55 * hem)[..., None] * (HEM_TEAL - CLOTH_TEAL)
    return np.asarray(picture * (shade * (1 - seam))[..., None], np.float32)


DRAPE_STEP = 2.0  # mm between nodes: the cloth is no measure of anything
DRAPE_TEXEL = 0.5  # mm
DRAPE_SPAN = (640.0, 520.0)  # mm, x and y; beyond, the picture is mirrored
TABLE_HEIGHT = -70.0  # mm below the wound's skin
BACKDROP_HEIGHT = -90.0  # mm: where the cloth lies behind a bare patch
STEEPEST_SLOPE, FLATTEST_SLOPE = -0.5, -0.15  # slopes of the tent
CLOTH_THICKNESS = 0.6  # mm
ATTACHED_WITHIN = 12.0  # mm from the opening: up to here it moves with the body
AT_REST_BEYOND = 140.0  # mm from the opening: from here it rests


@dataclass(frozen=True, slots=True, eq=False)
class Drape:
    """The cloth."""

    heights: Field  # (H, W) mm, grid frame, nodes DRAPE_STEP apart
    picture: Texture  # (H, W, 4) linear BGR without the key lamp; what that adds to a white cloth
    half: tuple[float, float] | None  # half sides mm of the opening; None: no opening, it does not move


def node_axes(span: tuple[float, float], step: float) -> tuple[Field, Field]:
    """x, y (H, W) mm of nodes `step` apart about the origin, over `span`."""
    x, y = ((np.arange(round(s / step) + 1, dtype=np.float32) - round(s / step) / 2) * np.float32(step) for s in span)
    return np.meshgrid(x, y)


def cloth_thickness(outside: Field) -> Field:
    """Height mm of a drape laid on the skin, by distance mm outside the opening's edge."""
    return np.asarray(CLOTH_THICKNESS * smoothstep(outside, -0.1, 1.2), np.float32)


def drape_over(shape: Shape, half: tuple[float, float], look: Appearance, rng: np.random.Generator) -> Drape:
    """A drape over the shape with a rounded opening of half sides `half` mm, falling to the table all round."""
    x, y = node_axes(DRAPE_SPAN, DRAPE_STEP)
    reach = np.array(shape.size, np.float32) / 2
    cx, cy = np.clip(x, -reach[0], reach[0]), np.clip(y, -reach[1], reach[1])
    edge = np.stack([cx, cy], -1).reshape(-1, 2)
    sigma = 5 / shape.step
    pad = int(3 * sigma)
    smoothed = gaussian_filter(np.pad(shape.heights, pad, mode="reflect", reflect_type="odd"), sigma)[
        pad:-pad, pad:-pad
    ]
    even = replace(shape, heights=smoothed)  # small unevenness would draw stripes if it went on beyond the edge
    away = np.hypot(x - cx, y - cy)
    ground = even.heights_at(edge).reshape(x.shape).astype(np.float32)
    back = even.heights_at(0.85 * edge).reshape(x.shape).astype(np.float32)
    slope = np.clip((ground - back) / np.maximum(0.15 * np.hypot(cx, cy), 1e-3), STEEPEST_SLOPE, FLATTEST_SLOPE)
    tent = ground + slope * away
    tent = TABLE_HEIGHT + np.logaddexp(0, (tent - TABLE_HEIGHT) / 14).astype(np.float32) * 14
    soft = cv2.GaussianBlur(tent, (0, 0), 9 / DRAPE_STEP)
    tent += smoothstep(away, 0, 25) * (soft - tent)
    outside = opening_distance(x, y, half)
    exact = shape.heights_at(np.stack([x, y], -1).reshape(-1, 2)).reshape(x.shape).astype(np.float32)
    tent += smoothstep(away, 4, 0) * (exact - tent)
    wrinkles = fold_heights(x.shape, DRAPE_STEP, rng) * smoothstep(outside, 6, 55)
    heights = tent + cloth_thickness(outside) + wrinkles - 3 * smoothstep(outside, -4, -16)
    return Drape(np.asarray(heights, np.float32), _lit_texture(heights, look, rng), half)


def backdrop(look: Appearance, rng: np.random.Generator) -> Drape:
    """A cloth at rest behind a bare patch."""
    x, _ = node_axes(DRAPE_SPAN, DRAPE_STEP)
    heights = BACKDROP_HEIGHT + fold_heights(x.shape, DRAPE_STEP, rng)
    return Drape(np.asarray(heights, np.float32), _lit_texture(heights, look, rng), None)


def _lit_texture(heights: Field, look: Appearance, rng: np.random.Generator) -> Texture:
    """The cloth lit by the lamps, which hang over it at rest; that it turns with the body near it is left out."""
    size = (round(DRAPE_SPAN[0] / DRAPE_TEXEL), round(DRAPE_SPAN[1] / DRAPE_TEXEL))
    shade, fibre = weave_texture(size[::-1], DRAPE_TEXEL, rng)
    x, y = ((np.arange(n, dtype=np.float32) + 0.5) * np.float32(DRAPE_TEXEL / DRAPE_STEP) for n in size)
    fine = sample(np.asarray(heights, np.float32), *np.meshgrid(x, y))
    across, along = gradient(gaussian_blur(fine, 0.5 * DRAPE_STEP / DRAPE_TEXEL) + fibre, DRAPE_TEXEL)
    hollow = cv2.resize(cv2.GaussianBlur(heights, (0, 0), 12 / DRAPE_STEP) - heights, size)
    shade *= np.clip(1 - 0.06 * np.clip(hollow, -2, 8), 0.5, 1.0)
    facing = 1 / cv2.sqrt(across * across + along * along + 1)
    key, fill = (
        lamp.strength * np.maximum((d[2] - d[0] * across - d[1] * along) * facing + 0.1, 0) / np.float32(1.1)
        for lamp in lamps(look)
        for d in [lamp.towards.astype(np.float32)]
    )
    room = np.float32(look.ambient) * (0.45 + 0.55 * facing)
    tints = zip(AMBIENT_COLOUR, lamps(look)[1].colour, CLOTH_TEAL, strict=True)
    rest = [shade * (room * np.float32(a) + fill * np.float32(f)) * teal for a, f, teal in tints]
    return np.ascontiguousarray(np.dstack([*rest, shade * key]), np.float32)
