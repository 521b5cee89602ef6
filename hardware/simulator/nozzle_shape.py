"""The print head: a needle, its hub, a cartridge and its holder, all turned about one axis; and the shadow it casts."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from estimation.se3 import Array
from hardware.simulator.field import Field, field
from hardware.simulator.lamps import Lamp
from hardware.simulator.layers import linear


@dataclass(frozen=True, slots=True, eq=False)
class Part:
    """A frustum from height z0 to z1 mm above the tip, of radius r0 to r1 mm. colour: linear BGR. gloss: 0..1, metal
    mirrors the room in its own colour."""

    z0: float
    z1: float
    r0: float
    r1: float
    colour: Field
    gloss: float
    metal: bool


STEEL, PLASTIC, GEL, LUER, RING, CAP = (
    linear(bgr)
    for bgr in ([176, 178, 180], [190, 198, 198], [136, 176, 204], [62, 92, 196], [104, 106, 110], [150, 112, 62])
)
PARTS = (
    Part(0.0, 2.0, 0.32, 0.42, STEEL, 0.8, True),
    Part(2.0, 12.7, 0.42, 0.42, STEEL, 0.8, True),
    Part(12.7, 13.6, 0.5, 1.5, LUER, 0.5, False),
    Part(13.6, 21.0, 1.5, 2.5, LUER, 0.5, False),
    Part(21.0, 23.0, 3.6, 3.6, LUER, 0.5, False),
    Part(23.0, 27.0, 2.4, 4.6, PLASTIC, 0.6, False),
    Part(27.0, 50.0, 4.6, 4.6, GEL, 0.65, False),
    Part(50.0, 58.0, 4.6, 4.6, PLASTIC, 0.6, False),
    Part(58.0, 76.0, 8.0, 8.0, RING, 0.5, True),
    Part(76.0, 78.0, 8.0, 7.0, RING, 0.5, True),
    Part(78.0, 88.0, 5.6, 5.2, CAP, 0.4, False),
    Part(88.0, 96.0, 2.2, 2.2, STEEL, 0.6, True),
)
LENGTH = PARTS[-1].z1
TURN = np.linspace(0, 2 * np.pi, 17)[:-1]

Triple = tuple[Field, Field, Field]  # x, y, z


class Met(NamedTuple):
    """What rays see of one part, each of their shape. depth: in lengths of the ray, inf: nothing. x, y, z: normal."""

    depth: Field
    x: Field
    y: Field
    z: Field


def outline(part: Part) -> Array:
    """Points (N, 3) mm, nozzle frame, whose pictures hold the part's."""
    rings = ((part.z0, 1.02 * part.r0), (part.z1, 1.02 * part.r1))
    return np.array([[r * np.cos(a), r * np.sin(a), z] for z, r in rings for a in TURN])


def radius_at(z: Field) -> Field:
    """Radius mm at heights z mm, for shadows: steps are bridged."""
    ends = np.interp(z, [p.z0 for p in PARTS] + [LENGTH], [p.r0 for p in PARTS] + [PARTS[-1].r1])
    return field(ends)


def meet(part: Part, origin: Array, rays: Triple) -> Met:
    """Where rays from `origin` (3,), nozzle frame, meet a part: its side or one of its flat ends."""
    ox, oy, oz = (np.float32(v) for v in origin)
    dx, dy, dz = rays
    k = np.float32((part.r1 - part.r0) / (part.z1 - part.z0))
    r = np.float32(part.r0 + k * (oz - part.z0))
    a = dx * dx + dy * dy - (k * k) * dz * dz
    b = dx * ox + dy * oy - (k * r) * dz
    c = ox * ox + oy * oy - r * r
    with np.errstate(invalid="ignore", divide="ignore"):
        depth = (-b - np.sqrt(b * b - a * c)) / a
        z = oz + depth * dz
        depth = field(np.where((depth > 0) & (z >= part.z0) & (z <= part.z1), depth, np.inf))
        x, y = ox + depth * dx, oy + depth * dy
        slant = np.float32(np.hypot(1, k))
        inverse = 1 / (np.hypot(x, y) * slant)
        met = Met(depth, x * inverse, y * inverse, np.full_like(x, -k / slant))
        side, height, radius = (1, part.z1, part.r1) if oz > part.z1 else (-1, part.z0, part.r0)
        if part.z0 <= oz <= part.z1:
            return met
        end = (np.float32(height) - oz) / dz
        x, y = ox + end * dx, oy + end * dy
        hit = (end > 0) & (x * x + y * y <= radius * radius) & (end < depth)
    flat = np.float32(side)
    return Met(
        field(np.where(hit, end, met.depth)),
        field(np.where(hit, 0, met.x)),
        field(np.where(hit, 0, met.y)),
        field(np.where(hit, flat, met.z)),
    )


def lit(points: Triple, nozzle_from_rest: Array, lamp: Lamp) -> Field:
    """Share of the lamp's light that passes the nozzle, at points given by x, y, z (H, W) mm, nozzle frame.

    The lamp is a disc: the shadow's edge softens with the distance between the nozzle and what it falls on.
    """
    x, y, z = points
    lx, ly, lz = (np.float32(v) for v in nozzle_from_rest[:3, :3] @ lamp.towards)
    across = max(float(lx * lx + ly * ly), 1e-4)
    away = field(np.maximum(-(x * lx + y * ly) / np.float32(across), 0))  # mm along the ray to where it passes the axis
    height = field(np.clip(z + away * lz, 0, LENGTH))
    if abs(lz) > 0.2:
        away = field(np.maximum((height - z) / lz, 0))
    gap = np.hypot(x + away * lx, y + away * ly)
    gap = np.hypot(gap, z + away * lz - height)
    soft = np.float32(0.25) + np.float32(lamp.spread) * away
    radius = radius_at(height)
    hidden = np.clip((radius + soft - gap) / (2 * soft), 0, 1) * np.minimum(1, (radius / soft) ** 0.7)
    return field(1 - hidden * hidden * (3 - 2 * hidden))
