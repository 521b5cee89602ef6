"""How a scene looks: skin and lamps, light that leaves a surface, printed beads, and the image sensor."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from estimation.errors import InputError
from estimation.rig import Camera
from estimation.se3 import Array
from hardware.simulator.scene.fields import Field, Layers, as_field, gaussian_blur, gradient, linear_light
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


def unlit_texture(texture: Image, texel: float = 0.15) -> Appearance:
    """The look of a picture (H, W, 3) BGR that is imaged as it is: no drape, no lamps, no gloss."""
    return Appearance(texel=texel, drape=False, texture=texture, lit=False)


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
            if not 0 <= getattr(self, name) <= most:
                raise InputError("sensor", name, getattr(self, name), f"0 to {most:g}")


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


def surface_light(
    colour: NDArray[np.float32],
    relief: NDArray[np.float32],
    mirrors: Field,
    passed: Field | None,
    towards: Array,
    lamps: tuple[Lamp, Lamp],
    ambient: float,
) -> NDArray[np.float32]:
    """Light (H, W, 4) and opacity: linear BGR times opacity, of a texture's colour and relief at (H, W) places.

    mirrors: as `mirror_slopes` gives. passed: (H, W, 2) share of each lamp's light that arrives; None: all of it.
    towards: (2, 3) the lamps in the grid frame. ambient: irradiance of the room.
    """
    across, along, gloss, open_sky = cv2.split(relief)
    *bgr, opacity = cv2.split(colour)
    mirror = cv2.split(mirrors)
    shares = None if passed is None else cv2.split(passed)
    facing = 1 / cv2.sqrt(across * across + along * along + 1)
    room = open_sky * (0.45 + 0.55 * facing) * np.float32(ambient)
    wet, dry = gloss * gloss, np.float32(0.3) + gloss
    lights = [as_field(room * np.float32(AMBIENT_COLOUR[k])) for k in range(3)]
    glint = 0.06 * wet * room  # the film mirrors the room
    for k, lamp in enumerate(lamps):
        if not lamp.strength:
            continue
        direction = towards[k].astype(np.float32)
        cosine = (direction[2] - direction[0] * across - direction[1] * along) * facing
        arrives = open_sky if shares is None else open_sky * shares[k]
        for c in range(3):
            creep = np.float32(SCATTER_WRAP[c])
            strength = np.float32(lamp.strength * lamp.colour[c] / (1 + SCATTER_WRAP[c]))
            lights[c] += np.maximum(cosine + creep, 0) * (arrives * strength)
        du, dv = across - mirror[2 * k], along - mirror[2 * k + 1]
        square = as_field(du * du + dv * dv)
        film = _beckmann_lobe(square, WET_ROUGHNESS, WET_REFLECTANCE, lamp) * wet
        glint += arrives * (film + _beckmann_lobe(square, DRY_ROUGHNESS, DRY_REFLECTANCE, lamp) * dry)
    glint *= opacity
    return np.asarray(cv2.merge([*(bgr[c] * lights[c] + glint for c in range(3)), opacity]), np.float32)


def _beckmann_lobe(square: Field, rough: float, mirror: float, lamp: Lamp) -> Field:
    """Beckmann's lobe over the square of the slope between surface and mirror, widened by the lamp's own size."""
    width = rough**2 + (lamp.spread / 2) ** 2
    return np.asarray(cv2.exp(square * np.float32(-0.5 / width)) * np.float32(lamp.strength * mirror / (4 * width)))


GEL_COLOUR = linear_light([128, 184, 232])  # linear BGR of a thick layer
GEL_ABSORBANCE = 1.7  # per mm: a bead 0.4 mm high covers half of what is below
BEAD_HEIGHT_BY_WIDTH = 0.45
GEL_GLOSS = 0.95


class PrintedBeads:
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
        bead = _bead_profile(start - low, end - low, radius, (y1 - y0, x1 - x0))
        bead = bead * np.float32(BEAD_HEIGHT_BY_WIDTH * width)
        np.maximum(self._height[y0:y1, x0:x1], bead, out=self._height[y0:y1, x0:x1])
        self._paint(x0, y0, x1, y1)
        layers.refresh(x0, y0, x1, y1)

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
        gloss = np.full_like(height, GEL_GLOSS)
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
