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
from hardware.simulator.nozzle_shape import PARTS, Part, Triple
from hardware.simulator.scene.rays import SAMPLES, Box, View
from hardware.simulator.state import State, turned

NEAR = 30.0  # mm before the lens: nearer, a part is not drawn
LATTICE = 4  # px between the rays that are looked up; straight between them, off by 1e-3 px


def part_boxes(state: State, view: View) -> list[tuple[Part, Box]]:
    """The parts in view and the part of the image that each can touch."""
    if state.instant.base_from_nozzle is None:
        return []
    outlines = np.stack([nozzle_shape.outline(part) for part in PARTS])
    points = se3.transform_points(state.instant.base_from_nozzle, outlines.reshape(-1, 3))
    pixels, depth = pixels_from_points(view.camera, points)
    pixels, depth = pixels.reshape(*outlines.shape[:2], 2), depth.reshape(outlines.shape[:2])
    boxes = (
        view.clip(p.min(0) - 2, p.max(0) + 3) if d.min() > NEAR else None for p, d in zip(pixels, depth, strict=True)
    )
    return [(part, box) for part, box in zip(PARTS, boxes, strict=True) if box is not None]


def whole_box(boxes: list[tuple[Part, Box]]) -> Box:
    """The box that holds all of them."""
    corners = np.array([box for _, box in boxes])
    x0, y0 = (int(v) for v in corners[:, :2].min(0))
    x1, y1 = (int(v) for v in corners[:, 2:].max(0))
    return Box(x0, y0, x1, y1)


def nozzle_picture(state: State, view: View, boxes: list[tuple[Part, Box]], behind: Field) -> NDArray[np.float32]:
    """Light (H, W, 4) of parts in their whole box: linear BGR times opacity, and opacity. behind: (2H, 2W) depth mm."""
    assert state.instant.base_from_nozzle is not None
    box = whole_box(boxes)
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
    for part, inner in boxes:
        at = (
            slice((inner.y0 - box.y0) * SAMPLES, (inner.y1 - box.y0) * SAMPLES),
            slice((inner.x0 - box.x0) * SAMPLES, (inner.x1 - box.x0) * SAMPLES),
        )
        met = nozzle_shape.meet(part, nozzle_from_camera[:3, 3], (rays[0][at], rays[1][at], rays[2][at]))
        nearer = met.depth < depth[at]
        which[at][nearer] = PARTS.index(part)
        for into, new in zip((depth, *normal), met, strict=True):
            np.copyto(into[at], new, where=nearer)
    light = np.zeros((*behind.shape, 4), np.float32)
    seen = which >= 0
    nozzle_from_rest = se3.inverse(state.instant.base_from_nozzle) @ state.scene.base_from_rest
    x, y, z = (n[seen] for n in normal)
    dx, dy, dz = (r[seen] for r in rays)
    light[seen] = _shaded(state, which[seen], (x, y, z), (dx, dy, dz), nozzle_from_rest)
    return np.asarray(cv2.resize(light, box.size[::-1], interpolation=cv2.INTER_AREA), np.float32)


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
