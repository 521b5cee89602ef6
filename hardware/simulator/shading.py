"""Light that leaves a surface: skin scatters it, red furthest; a wet film mirrors the lamps."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from estimation.se3 import Array
from hardware.simulator.field import Field, field
from hardware.simulator.lamps import AMBIENT, Lamp

WRAP = (0.10, 0.13, 0.30)  # BGR: how far light creeps round into the shade under the skin, a share of the lamp's
MIRROR = 0.06  # of light that a film of water and serum sends back
FILM = 0.075  # slope, one sigma: how rough the film is
SHEEN = 0.32  # slope, one sigma: how rough dry skin is
DRY_MIRROR = 0.035


def half_slopes(rays: tuple[Field, Field, Field], towards: Array) -> Field:
    """Slopes (H, W, 2 a lamp) of surfaces that mirror each lamp into the eye; rays: their x, y, z, grid frame."""
    x, y, z = rays
    length = np.sqrt(x * x + y * y + z * z)
    out = []
    for lamp in towards.astype(np.float32):
        up = np.maximum(lamp[2] - z / length, 0.05)
        out += [-(lamp[0] - x / length) / up, -(lamp[1] - y / length) / up]
    return np.asarray(np.dstack(out), np.float32)


def shade(
    colour: NDArray[np.float32],
    relief: NDArray[np.float32],
    mirrors: Field,
    passed: Field | None,
    towards: Array,
    lamps: tuple[Lamp, Lamp],
    ambient: float,
) -> NDArray[np.float32]:
    """Light (H, W, 4) and opacity: linear BGR times opacity, of a texture's colour and relief at (H, W) places.

    mirrors: as `half_slopes` gives. passed: (H, W, 2) share of each lamp's light that arrives; None: all of it.
    towards: (2, 3) the lamps in the grid frame. ambient: irradiance of the room.
    """
    across, along, gloss, open_sky = cv2.split(relief)
    *bgr, opacity = cv2.split(colour)
    mirror = cv2.split(mirrors)
    shares = None if passed is None else cv2.split(passed)
    facing = 1 / cv2.sqrt(across * across + along * along + 1)
    room = open_sky * (0.45 + 0.55 * facing) * np.float32(ambient)
    wet, dry = gloss * gloss, np.float32(0.3) + gloss
    lights = [field(room * np.float32(AMBIENT[k])) for k in range(3)]
    glint = 0.06 * wet * room  # the film mirrors the room
    for k, lamp in enumerate(lamps):
        if not lamp.strength:
            continue
        direction = towards[k].astype(np.float32)
        cosine = (direction[2] - direction[0] * across - direction[1] * along) * facing
        arrives = open_sky if shares is None else open_sky * shares[k]
        for c in range(3):
            creep = np.float32(WRAP[c])
            strength = np.float32(lamp.strength * lamp.colour[c] / (1 + WRAP[c]))
            lights[c] += np.maximum(cosine + creep, 0) * (arrives * strength)
        du, dv = across - mirror[2 * k], along - mirror[2 * k + 1]
        square = field(du * du + dv * dv)
        glint += arrives * (_lobe(square, FILM, MIRROR, lamp) * wet + _lobe(square, SHEEN, DRY_MIRROR, lamp) * dry)
    glint *= opacity
    return np.asarray(cv2.merge([*(bgr[c] * lights[c] + glint for c in range(3)), opacity]), np.float32)


def _lobe(square: Field, rough: float, mirror: float, lamp: Lamp) -> Field:
    """Beckmann's lobe over the square of the slope between surface and mirror, widened by the lamp's own size."""
    width = rough**2 + (lamp.spread / 2) ** 2
    return np.asarray(cv2.exp(square * np.float32(-0.5 / width)) * np.float32(lamp.strength * mirror / (4 * width)))
