"""The picture of the nozzle, in front of whatever is behind it."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from estimation import se3
from estimation.rig import pixels_from_points
from estimation.se3 import Array
from hardware.simulator import nozzle_shape
from hardware.simulator.nozzle_shape import PARTS
from hardware.simulator.state import State
from hardware.simulator.view import CELL, SAMPLES, Box, View

NEAR = 30.0  # mm before the lens: nearer, the nozzle is not drawn


def nozzle_box(state: State, view: View) -> Box | None:
    """The part of the image that the nozzle can touch, None where there is none."""
    if state.instant.base_from_nozzle is None:
        return None
    points = se3.transform_points(state.instant.base_from_nozzle, nozzle_shape.outline_points())
    pixels, depth = pixels_from_points(view.camera, points)
    before = depth > NEAR
    if not before.any():
        return None
    return view.clip(pixels[before].min(0) - 2, pixels[before].max(0) + 3)


def nozzle_picture(state: State, view: View, box: Box, behind: NDArray[np.float32]) -> NDArray[np.float32]:
    """Light (H, W, 4) of the nozzle over a box: linear BGR times opacity, and opacity. behind: (2H, 2W) depth mm."""
    assert state.instant.base_from_nozzle is not None
    nozzle_from_camera = se3.inverse(state.instant.base_from_nozzle) @ view.camera.base_from_camera
    coarse = view.coarse(4)
    columns, rows = slice(box.x0 // 4, box.x1 // 4), slice(box.y0 // 4, box.y1 // 4)
    size = (box.size[1] * SAMPLES, box.size[0] * SAMPLES)
    tangents = [_upsampled(c[rows, columns], size) for c in coarse]
    rays = np.stack([*tangents, np.ones_like(tangents[0])], -1).reshape(-1, 3) @ nozzle_from_camera[:3, :3].T
    near = _maybe(nozzle_from_camera[:3, 3], rays)
    seen = nozzle_shape.trace(nozzle_from_camera[:3, 3], rays[near])
    front = seen.depth < behind.reshape(-1)[near]
    out = np.zeros((size[0] * size[1], 4), np.float32)
    picked = np.flatnonzero(near)[front]
    nozzle_from_rest = se3.inverse(state.instant.base_from_nozzle) @ state.scene.base_from_rest
    out[picked, :3] = _shaded(state, seen.normal[front], seen.part[front], rays[picked], nozzle_from_rest)
    out[picked, 3] = 1
    return np.asarray(cv2.resize(out.reshape(size[1], size[0], 4), box.size[::-1], interpolation=cv2.INTER_AREA))


def _upsampled(field: NDArray[np.float32], size: tuple[int, int]) -> NDArray[np.float32]:
    return np.asarray(cv2.resize(field, size, interpolation=cv2.INTER_LINEAR), np.float32)


def _maybe(origin: Array, rays: Array) -> NDArray[np.bool_]:
    """Rays (N,) that pass the axis within the largest radius."""
    cross = np.cross(rays, [0.0, 0.0, 1.0])
    gap = np.abs(cross @ origin) / np.maximum(np.linalg.norm(cross, axis=1), 1e-9)
    return np.asarray(gap <= max(max(p.r0, p.r1) for p in PARTS) + 0.1)


def _shaded(state: State, normal: Array, part: NDArray[np.int64], rays: Array, nozzle_from_rest: Array) -> Array:
    """Linear BGR (N, 3) of the nozzle; metal mirrors a room that is bright above and dark below."""
    colour = np.stack([p.colour for p in PARTS])[part]
    gloss = np.array([p.gloss for p in PARTS])[part][:, None]
    metal = np.array([p.metal for p in PARTS])[part][:, None]
    up = nozzle_from_rest[:3, 2]
    view = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    mirrored = view - 2 * np.einsum("ni,ni->n", view, normal)[:, None] * normal
    height = mirrored @ up
    room = np.clip(0.42 + 0.55 * height + 0.12 * np.sin(9 * height), 0.03, 1.0)[:, None]
    light = state.scene.look.ambient * (0.6 + 0.4 * (normal @ up))[:, None]
    glint = np.zeros_like(light)
    for lamp in state.lamps:
        towards = nozzle_from_rest[:3, :3] @ lamp.towards
        light = light + lamp.strength * np.maximum(normal @ towards, 0)[:, None]
        glint = glint + lamp.strength * np.exp(12 * (mirrored @ towards - 1) / (0.06 + lamp.spread))[:, None]
    rim = 0.04 + 0.5 * (1 - np.abs(np.einsum("ni,ni->n", view, normal))[:, None]) ** 4
    plastic = colour * light + (rim * room + 0.5 * glint) * gloss
    steel = colour * (0.75 * room + 0.25 * light + 0.7 * glint * gloss)
    return np.asarray(np.where(metal, steel, plastic))
