"""The picture of the nozzle, in front of whatever is behind it."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from estimation import se3
from estimation.rig import pixels_from_points
from estimation.se3 import Array
from hardware.simulator import nozzle_shape
from hardware.simulator.field import Field
from hardware.simulator.nozzle_shape import PARTS, Triple
from hardware.simulator.state import State, turned
from hardware.simulator.view import SAMPLES, Box, View

NEAR = 30.0  # mm before the lens: nearer, a part is not drawn
LATTICE = 4  # px between the rays that are looked up; straight between them, off by 1e-3 px


def nozzle_box(state: State, view: View) -> Box | None:
    """The part of the image that the nozzle can touch, None where there is none."""
    if state.instant.base_from_nozzle is None:
        return None
    boxes = [box for part in PARTS if (box := _part_box(state.instant.base_from_nozzle, view, part)) is not None]
    if not boxes:
        return None
    corners = np.array(boxes)
    return Box(*(int(v) for v in (*corners[:, :2].min(0), *corners[:, 2:].max(0))))


def nozzle_picture(state: State, view: View, box: Box, behind: Field) -> NDArray[np.float32]:
    """Light (H, W, 4) of the nozzle over a box: linear BGR times opacity, and opacity. behind: (2H, 2W) depth mm."""
    assert state.instant.base_from_nozzle is not None
    nozzle_from_camera = se3.inverse(state.instant.base_from_nozzle) @ view.camera.base_from_camera
    columns, rows = slice(box.x0 // LATTICE, box.x1 // LATTICE), slice(box.y0 // LATTICE, box.y1 // LATTICE)
    size = (box.size[1] * SAMPLES, box.size[0] * SAMPLES)
    across, down = (
        np.asarray(cv2.resize(c[rows, columns], size, interpolation=cv2.INTER_LINEAR), np.float32)
        for c in view.coarse(LATTICE)
    )
    rays = turned(nozzle_from_camera[:3, :3], across, down)
    depth, which = behind.copy(), np.full(behind.shape, -1, np.int8)
    normal = [np.zeros(behind.shape, np.float32) for _ in range(3)]
    for number, part in enumerate(PARTS):
        inner = _part_box(state.instant.base_from_nozzle, view, part)
        if inner is None:
            continue
        at = (
            slice((inner.y0 - box.y0) * SAMPLES, (inner.y1 - box.y0) * SAMPLES),
            slice((inner.x0 - box.x0) * SAMPLES, (inner.x1 - box.x0) * SAMPLES),
        )
        met = nozzle_shape.meet(part, nozzle_from_camera[:3, 3], (rays[0][at], rays[1][at], rays[2][at]))
        nearer = met.depth < depth[at]
        which[at][nearer] = number
        for into, new in zip((depth, *normal), met, strict=True):
            np.copyto(into[at], new, where=nearer)
    light = np.zeros((*behind.shape, 4), np.float32)
    seen = which >= 0
    nozzle_from_rest = se3.inverse(state.instant.base_from_nozzle) @ state.scene.base_from_rest
    x, y, z = (n[seen] for n in normal)
    dx, dy, dz = (r[seen] for r in rays)
    light[seen] = _shaded(state, which[seen], (x, y, z), (dx, dy, dz), nozzle_from_rest)
    return np.asarray(cv2.resize(light, box.size[::-1], interpolation=cv2.INTER_AREA), np.float32)


def _part_box(base_from_nozzle: Array, view: View, part: nozzle_shape.Part) -> Box | None:
    points = se3.transform_points(base_from_nozzle, nozzle_shape.outline(part))
    pixels, depth = pixels_from_points(view.camera, points)
    if depth.min() < NEAR:
        return None
    return view.clip(pixels.min(0) - 2, pixels.max(0) + 3)


def _shaded(
    state: State, part: NDArray[np.int8], normal: Triple, rays: Triple, nozzle_from_rest: Array
) -> NDArray[np.float32]:
    """Linear BGR and opacity (N, 4) of the nozzle; metal mirrors a room that is bright above and dark below."""
    colour = np.stack([p.colour for p in PARTS]).astype(np.float32)[part]
    gloss = np.array([p.gloss for p in PARTS], np.float32)[part]
    metal = np.array([p.metal for p in PARTS])[part]
    length = np.sqrt(rays[0] ** 2 + rays[1] ** 2 + rays[2] ** 2)
    away = _dot(rays, normal) / length  # cosine, negative towards the eye
    mirrored = rays[0] / length - 2 * away * normal[0], rays[1] / length - 2 * away * normal[1]
    gone = rays[2] / length - 2 * away * normal[2]
    reflected = (*mirrored, gone)
    up = nozzle_from_rest[:3, 2]
    height = _dot(reflected, up)
    room = np.clip(0.46 + 0.45 * height + 0.12 * np.sin(9 * height), 0.12, 1.0)
    light = np.float32(state.scene.look.ambient) * (0.6 + 0.4 * _dot(normal, up))
    glint = np.zeros_like(light)
    for lamp in state.lamps:
        towards = nozzle_from_rest[:3, :3] @ lamp.towards
        light = light + np.float32(lamp.strength) * np.maximum(_dot(normal, towards), 0)
        bright = np.exp(np.float32(12 / (0.06 + lamp.spread)) * (_dot(reflected, towards) - 1))
        glint = glint + np.float32(lamp.strength) * bright
    rim = 0.04 + 0.5 * (1 + np.minimum(away, 0)) ** 4
    own = np.where(metal, 0.75 * room + 0.25 * light, light)
    film = np.where(metal, 0.7 * glint * gloss, (rim * room + 0.5 * glint) * gloss)
    tint = np.where(metal[:, None], colour, 1)
    return np.column_stack([colour * own[:, None] + tint * film[:, None], np.ones_like(own)]).astype(np.float32)


def _dot(a: Triple, b: Triple | Array) -> Field:
    x, y, z = (np.asarray(v, np.float32) for v in b)
    return np.asarray(a[0] * x + a[1] * y + a[2] * z, np.float32)
