"""The picture of the shape: each sample of an image traced to its material point and shaded there."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from estimation import se3
from estimation.rig import pixels_from_points
from estimation.se3 import Array
from hardware.simulator import hits, shading
from hardware.simulator.hits import Bundle
from hardware.simulator.noise import Field
from hardware.simulator.state import SHADOW_STEP, State
from hardware.simulator.view import CELL, SAMPLES, Box, Rays, View

GRAZING = -0.03  # of a ray's z: those that sink less never meet the shape
OUTSIDE = -1e5  # a node where nothing is painted
FRAME = 4.0  # mm between the points that tell which part of an image the shape covers
SMEAR = 1.5  # px between the instants of one exposure that a pixel holds
MOST_INSTANTS = 8  # a sample; at more the picture is one smear anyway
TIMES = np.array([[-3, 1], [3, -1]]) / 8  # of the exposure, for the samples (row, column) of a pixel


@dataclass(frozen=True, slots=True, eq=False)
class SkinPicture:
    """light: (H, W, 4) linear BGR times opacity, and opacity, of a box's pixels. depth: (2H, 2W) mm of its samples along
    the optical axis, inf where there is no surface; None unless asked for."""

    box: Box
    light: NDArray[np.float32]
    depth: Field | None


def skin_picture(state: State, view: View) -> SkinPicture | None:
    """The shape's part of one camera's image, None where it is out of view."""
    box = covered(state, view)
    if box is None:
        return None
    scene = state.scene
    grid_from_camera = se3.inverse(state.base_from_grid) @ view.camera.base_from_camera
    rays = view.rays(box)
    small = (box.size[1] // CELL, box.size[0] // CELL)
    cells = Rays(*(cv2.resize(r, small, interpolation=cv2.INTER_AREA) for r in rays))
    lines, sink = _bundle(state, grid_from_camera, rays)
    coarse, _ = _bundle(state, grid_from_camera, cells)
    z = hits.meet(state.relief, lines, coarse, CELL * SAMPLES)
    u, v = lines.u + z * lines.du, lines.v + z * lines.dv  # nodes of material points
    directions = _turned(grid_from_camera[:3, :3], cells)
    mirrors = shading.half_slopes(directions, state.towards)
    if state.instant.strain and scene.deformation.bulge:
        pass
    size = u.shape[::-1]
    mirrors = cv2.resize(mirrors, size, interpolation=cv2.INTER_LINEAR)
    passed = None
    if state.shadow is not None:
        skip = np.float32(max(1, round(SHADOW_STEP / scene.shape.step)))
        passed = cv2.remap(state.shadow, u / skip, v / skip, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    level = scene.layers.level(view.spacing)
    scale, ox, oy = scene.layers.offsets(level)
    to_texels = np.float32(scene.shape.step * scale)
    half = np.array(scene.shape.size) / 2
    tu = u * to_texels + np.float32(ox - half[0] * scale)
    tv = v * to_texels + np.float32(oy - half[1] * scale)
    speed = _speed(state, directions, small, u, v, z) * np.float32(scale)
    colour, relief = _exposed(state, level, tu, tv, speed, view)
    light = shading.shade(colour, relief, mirrors, passed, state.towards, state.lamps, scene.look.ambient)
    light = cv2.resize(light, box.size[::-1], interpolation=cv2.INTER_AREA)
    depth = None
    if state.instant.base_from_nozzle is not None:
        depth = np.where(colour[..., 3] > 0.5, (z - np.float32(grid_from_camera[2, 3])) * sink, np.float32(np.inf))
    return SkinPicture(box, light, depth)


def covered(state: State, view: View) -> Box | None:
    """The part of the image that the shape can touch, None if it is out of view."""
    shape, deformation, strain = state.scene.shape, state.scene.deformation, state.instant.strain
    flat = shape.grid(FRAME)
    points = np.column_stack([flat, shape.heights_at(flat)])
    points = se3.transform_points(state.base_from_grid, points + deformation.displacement(points, strain))
    pixels, depth = pixels_from_points(view.camera, points)
    if (depth < 1).any():
        return None
    return view.clip(pixels.min(0) - 4, pixels.max(0) + 4)


def _turned(rotation: Array, rays: Rays) -> tuple[Field, Field, Field]:
    """Directions x, y, z (H, W) in the grid frame of rays whose z in the camera frame is 1."""
    m = rotation.astype(np.float32)
    x, y, z = (m[i, 0] * rays.x + m[i, 1] * rays.y + m[i, 2] for i in range(3))
    return x, y, z


def _bundle(state: State, grid_from_camera: Array, rays: Rays) -> tuple[Bundle, Field]:
    """Rays as lines over the nodes of material points, and 1 / their z."""
    x, y, z = _turned(grid_from_camera[:3, :3], rays)
    never = z > GRAZING
    sink = 1 / np.where(never, np.float32(-1), z)
    origin = grid_from_camera[:3, 3]
    shape = state.scene.shape
    lines = []
    for k, side in enumerate((x, y)):
        per_node = np.float32(1 / (state.factors[k] * shape.step))
        slope = side * (sink * per_node)
        first = np.float32(origin[k] * per_node + shape.size[k] / 2 / shape.step)
        start = first - np.float32(origin[2]) * slope
        if never.any():
            start[never], slope[never] = OUTSIDE, 0
        lines.append((start, slope))
    return Bundle(lines[0][0], lines[1][0], lines[0][1], lines[1][1]), sink


def _speed(
    state: State, directions: tuple[Field, Field, Field], small: tuple[int, int], u: Field, v: Field, z: Field
) -> NDArray[np.float32]:
    """Speed (h, w, 2) mm/s at which material points pass each cell's ray, as the surface moves."""
    twist = se3.adjoint(se3.inverse(state.scene.shape.surface_from_grid)) @ state.instant.twist
    w, t = twist[:3].astype(np.float32), twist[3:].astype(np.float32)
    if not twist.any():
        return np.zeros((*small[::-1], 2), np.float32)
    u, v, z = (cv2.resize(f, small, interpolation=cv2.INTER_AREA) for f in (u, v, z))
    shape, factors = state.scene.shape, state.factors
    slopes = cv2.remap(cv2.blur(state.relief.slopes, (9, 9)), u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    sx, sy = slopes[..., 0] / (shape.step * factors[0]), slopes[..., 1] / (shape.step * factors[1])
    x = (u * shape.step - shape.size[0] / 2) * factors[0]
    y = (v * shape.step - shape.size[1] / 2) * factors[1]
    vx, vy, vz = t[0] + w[1] * z - w[2] * y, t[1] + w[2] * x - w[0] * z, t[2] + w[0] * y - w[1] * x
    dx, dy, dz = directions
    towards = np.minimum(dz - sx * dx - sy * dy, -0.1)
    along = (vz - sx * vx - sy * vy) / towards
    passing = np.dstack([(along * dx - vx) / factors[0], (along * dy - vy) / factors[1]])
    return np.asarray(passing, np.float32)


def _exposed(
    state: State, level: int, tu: Field, tv: Field, speed: NDArray[np.float32], view: View
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Colour and relief (H, W, 4) at texels tu, tv, each sample at its own part of the exposure; speed: texels/s."""
    layers, exposure = state.scene.layers, state.instant.exposure
    sources = layers.colour[level], layers.relief[level]
    fastest = float(np.abs(speed).max()) * exposure
    if fastest < 1e-3:
        colour, relief = (_looked_up(source, tu, tv) for source in sources)
        return colour, relief
    pixel = SAMPLES * view.spacing * layers.offsets(level)[0]  # texels
    count = int(np.clip(np.ceil(fastest / pixel / SMEAR / 4), 1, MOST_INSTANTS))
    path = cv2.resize(speed * np.float32(exposure), tu.shape[::-1], interpolation=cv2.INTER_LINEAR)
    times = np.tile(TIMES.astype(np.float32), (tu.shape[0] // 2, tu.shape[1] // 2))
    sums = []
    for k in range(count):
        time = times + np.float32(((k + 0.5) / count - 0.5) / 4)
        u, v = tu + path[..., 0] * time, tv + path[..., 1] * time
        sums.append([_looked_up(source, u, v) for source in sources])
    colour, relief = (np.mean(part, axis=0, dtype=np.float32) for part in zip(*sums, strict=True))
    return colour, relief


def _looked_up(texture: NDArray[np.float32], u: Field, v: Field) -> NDArray[np.float32]:
    found = cv2.remap(texture, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=(0, 0, 0, 0))
    return np.asarray(found, np.float32)
