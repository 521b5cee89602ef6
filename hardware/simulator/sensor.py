"""The image sensor: grain, vignetting, sharpness."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np

from estimation.errors import InputError
from estimation.rig import Camera
from hardware.simulator.field import Field, blurred
from perception.frames import Image

ROOM = 256  # px by which the stored grain is larger than an image, so that each image takes another cut of it
NOISE, VIGNETTING, BLUR = 50.0, 2.0, 10.0  # the most of each; more is no camera
STRIP = 48  # rows developed at once: they stay in the cache


@dataclass(frozen=True, slots=True)
class Sensor:
    """What a camera does to the light.

    noise: grey levels, one sigma. The display's value is the square root of the light, so the light's shot noise is the
    same everywhere in the image. vignetting: 1 is a bare lens's cos^4 law, 0 none. blur: px, one sigma, of lens and
    colour filter.
    """

    noise: float = 1.5
    vignetting: float = 0.8
    blur: float = 0.45

    def __post_init__(self) -> None:
        for name, most in (("noise", NOISE), ("vignetting", VIGNETTING), ("blur", BLUR)):
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
    y, x = rng.integers(0, ROOM, 2)
    grain = _grain(h, w)[y : y + h, x : x + w]
    image = np.empty((h, w, 3), np.uint8)
    halo = int(np.ceil(6 * sensor.blur))  # rows that the blur reads beyond its own
    for first in range(0, h, STRIP):
        rows, low = slice(first, first + STRIP), max(first - halo, 0)
        part = light[low : first + STRIP + halo]
        if sensor.blur:
            part = blurred(part, sensor.blur)
        part = part[first - low : first - low + len(image[rows])]
        display = cv2.sqrt(cv2.multiply(part, fall[rows], scale=gain * 255.0**2))
        image[rows] = cv2.addWeighted(display, 1.0, grain[rows], sensor.noise, 0.0, dtype=cv2.CV_8U)
    return image


@lru_cache(maxsize=4)
def _grain(h: int, w: int) -> Field:
    """White noise of variance 1, (h + ROOM, w + ROOM, 3)."""
    return np.random.default_rng([31, h, w]).standard_normal((h + ROOM, w + ROOM, 3), np.float32)
