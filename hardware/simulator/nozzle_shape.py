"""The print head: a needle, its hub, a cartridge and its holder, all turned about one axis; and the shadow it casts."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from estimation.se3 import Array
from hardware.simulator.lamps import Lamp
from hardware.simulator.layers import linear
from hardware.simulator.noise import Field


class Part(NamedTuple):
    """A frustum from height z0 to z1 mm above the tip, of radius r0 to r1 mm. colour: linear BGR. gloss: 0..1, metal
    mirrors the room in its own colour."""

    z0: float
    z1: float
    r0: float
    r1: float
    colour: Array
    gloss: float
    metal: bool


STEEL, PLASTIC, GEL, CAP, HOLDER = (
    linear(bgr) for bgr in ([176, 178, 180], [196, 202, 200], [128, 172, 206], [96, 78, 52], [112, 114, 118])
)
PARTS = (
    Part(0.0, 3.0, 0.33, 0.45, STEEL, 0.8, True),
    Part(3.0, 13.0, 0.45, 0.45, STEEL, 0.8, True),
    Part(13.0, 14.5, 0.45, 2.1, CAP, 0.5, False),
    Part(14.5, 24.0, 2.1, 3.4, CAP, 0.5, False),
    Part(24.0, 26.0, 4.4, 4.4, CAP, 0.5, False),
    Part(26.0, 31.0, 3.6, 8.0, PLASTIC, 0.6, False),
    Part(31.0, 58.0, 8.0, 8.0, GEL, 0.65, False),
    Part(58.0, 62.0, 8.6, 8.6, PLASTIC, 0.6, False),
    Part(62.0, 96.0, 13.0, 13.0, HOLDER, 0.5, True),
)
LENGTH = PARTS[-1].z1


def outline_points() -> Array:
    """Points (N, 3) mm, nozzle frame, whose pictures hold the whole nozzle's."""
    around = np.linspace(0, 2 * np.pi, 13)[:-1]
    rings = [(z, 1.05 * r) for p in PARTS for z, r in ((p.z0, p.r0), (p.z1, p.r1))]
    return np.array([[r * np.cos(a), r * np.sin(a), z] for z, r in rings for a in around])


def radius_at(z: Field) -> Field:
    """Radius mm at heights z mm, for shadows: steps are bridged."""
    return np.interp(z, [p.z0 for p in PARTS] + [LENGTH], [p.r0 for p in PARTS] + [PARTS[-1].r1]).astype(np.float32)


class Seen(NamedTuple):
    """What rays see of the nozzle, (N,) each. depth: in lengths of the ray, inf: nothing. part: its number in PARTS."""

    depth: Field
    part: np.ndarray[tuple[int], np.dtype[np.int64]]
    normal: Array  # (N, 3), nozzle frame


def trace(origin: Array, rays: Array) -> Seen:
    """What rays (N, 3) from `origin` (3,), nozzle frame, see of the nozzle."""
    depth = np.full(len(rays), np.inf)
    which = np.zeros(len(rays), np.int64)
    normal = np.zeros_like(rays)
    for number, part in enumerate(PARTS):
        for t, out in (_side(part, origin, rays), _disc(part.z0, part.r0, -1, origin, rays), _disc(part.z1, part.r1, 1, origin, rays)):
            nearer = t < depth
            depth[nearer], which[nearer], normal[nearer] = t[nearer], number, out[nearer]
    return Seen(depth.astype(np.float32), which, normal)


def _side(part: Part, origin: Array, rays: Array) -> tuple[Array, Array]:
    """Depth (N,), inf for a miss, and normals (N, 3) where rays meet a frustum's side."""
    k = (part.r1 - part.r0) / (part.z1 - part.z0)
    r = part.r0 + k * (origin[2] - part.z0)
    a = rays[:, 0] ** 2 + rays[:, 1] ** 2 - (k * rays[:, 2]) ** 2
    b = rays[:, 0] * origin[0] + rays[:, 1] * origin[1] - k * rays[:, 2] * r
    c = origin[0] ** 2 + origin[1] ** 2 - r**2
    with np.errstate(invalid="ignore", divide="ignore"):
        t = (-b - np.sqrt(b * b - a * c)) / a
        z = origin[2] + t * rays[:, 2]
        t = np.where((t > 0) & (z >= part.z0) & (z <= part.z1), t, np.inf)
    at = origin[:2] + np.where(np.isfinite(t), t, 0)[:, None] * rays[:, :2]
    out = np.column_stack([at / np.maximum(np.linalg.norm(at, axis=1, keepdims=True), 1e-9), np.full(len(rays), -k)])
    return t, out / np.hypot(1, k)


def _disc(z: float, radius: float, side: int, origin: Array, rays: Array) -> tuple[Array, Array]:
    """The same for a flat end at height z that faces up (1) or down (-1)."""
    with np.errstate(invalid="ignore", divide="ignore"):
        t = (z - origin[2]) / rays[:, 2]
        at = origin[:2] + t[:, None] * rays[:, :2]
        hit = (t > 0) & (rays[:, 2] * side < 0) & ((at**2).sum(1) <= radius**2)
    return np.where(hit, t, np.inf), np.broadcast_to(np.array([0.0, 0.0, side]), rays.shape)


def lit(points: tuple[Field, Field, Field], nozzle_from_rest: Array, lamp: Lamp) -> Field:
    """Share of the lamp's light that passes the nozzle, at points given by x, y, z (H, W) mm, nozzle frame.

    The lamp is a disc: the shadow's edge softens with the distance between the nozzle and what it falls on.
    """
    x, y, z = points
    lx, ly, lz = (np.float32(v) for v in nozzle_from_rest[:3, :3] @ lamp.towards)
    across = max(float(lx * lx + ly * ly), 1e-4)
    away = np.maximum(-(x * lx + y * ly) / np.float32(across), 0)  # mm along the ray to where it passes the axis
    height = np.clip(z + away * lz, 0, LENGTH)
    away = np.maximum((height - z) / lz, 0) if abs(lz) > 0.2 else away
    gap = np.hypot(x + away * lx, y + away * ly)
    gap = np.hypot(gap, z + away * lz - height)
    soft = np.float32(0.25) + np.float32(lamp.spread) * away
    radius = radius_at(height)
    hidden = np.clip((radius + soft - gap) / (2 * soft), 0, 1) * np.minimum(1, (radius / soft) ** 0.7)
    return np.asarray(1 - hidden * hidden * (3 - 2 * hidden), np.float32)
