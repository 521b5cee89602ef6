"""The picture of the shape: each sample of an image traced to its material point and shaded there."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from estimation import se3
from estimation.rig import pixels_from_points
from estimation.se3 import Array
from hardware.simulator import hits, shading
from hardware.simulator.field import Field, Mask, averaged, enlarged, field, looked_up, painted
from hardware.simulator.hits import Bundle
from hardware.simulator.scene.rays import CELL, SAMPLES, Box, Rays, View
from hardware.simulator.state import SHADOW_STEP, State, turned

GRAZING = -0.03  # of a ray's z: those that sink less never meet the shape
OUTSIDE = -1e5  # a node where nothing is painted
NEARBY = np.float32(1.5)  # mm: a wound's rim or wall between two cells reaches no further
AROUND = np.ones((3, 3), np.uint8)
FRAME = 4.0  # mm between the points that tell which part of an image the shape covers
STRIP = 4  # rows of cells worked on at once: their fields stay in the cache
SMEAR = 1.5  # px between the instants of one exposure that a pixel holds
MOST_INSTANTS = 8  # a sample; at more the picture is one smear anyway
TIMES = np.array([[7, 1], [3, 5]]) / 16  # of the exposure, before and after its middle, for the samples of a pixel
SHARP = 0.25  # px: a smear too short to be seen


@dataclass(frozen=True, slots=True, eq=False)
class SkinPicture:
    """The shape over a box.

    light: (H, W, 4) linear BGR times opacity, and opacity. depth: (2H, 2W) mm of its samples along the optical axis,
    inf where there is no surface; None where there is no nozzle to be hidden.
    """

    box: Box
    light: Field
    depth: Field | None


def skin_picture(state: State, view: View) -> SkinPicture | None:
    """The shape's part of one camera's image, None where it is out of view."""
    box = covered(state, view)
    if box is None:
        return None
    lattice = _lattice(state, view, box)
    light = np.empty((*box.size, 4), np.float32)
    depth = None if state.shadow is None else np.empty((box.size[0] * SAMPLES, box.size[1] * SAMPLES), np.float32)
    for first in range(0, box.size[0] // CELL, STRIP):
        last = min(first + STRIP, box.size[0] // CELL)
        rows = slice(first * CELL * SAMPLES, last * CELL * SAMPLES)
        samples, deep = _strip(state, view, lattice, first, last)
        light[first * CELL : last * CELL] = averaged(samples, ((last - first) * CELL, box.size[1]))
        if depth is not None:
            depth[rows] = deep
    return SkinPicture(box, light, depth)


@dataclass(frozen=True, slots=True, eq=False)
class _Lattice:
    """What varies slowly, (h, w) at the middles of a box's cells, and the box's rays, (H, W).

    start: heights mm. bounds: heights mm that hold those of the rays around. odd: where rays must be searched one by
    one. mirrors: (h, w, 4) slopes that mirror the lamps.
    speed: (h, w, 2) mm/s of material points past the rays. instants: how often a sample is taken before the middle of
    the exposure, and as often after it; 0: in the middle only.
    """

    grid_from_camera: Array
    rays: Rays
    start: Field
    bounds: tuple[Field, Field]
    odd: Mask
    mirrors: Field
    speed: Field
    instants: int

    def spread(self, cells: Field, first: int, last: int) -> Field:
        """A field of the cells at the samples of the cell rows first to last."""
        low, high = max(first - 1, 0), min(last + 1, len(cells))
        times = CELL * SAMPLES
        size = ((high - low) * times, cells.shape[1] * times)
        return enlarged(cells[low:high], size)[(first - low) * times : (last - low) * times]


def _lattice(state: State, view: View, box: Box) -> _Lattice:
    grid_from_camera = se3.inverse(state.base_from_grid) @ view.camera.base_from_camera
    rays = view.rays(box)
    small = (box.size[0] // CELL, box.size[1] // CELL)
    cells = Rays(*(averaged(r, small) for r in rays))
    lines, _ = _bundle(state, grid_from_camera, cells)
    low, high = (np.full(small, v, np.float32) for v in (state.relief.low, state.relief.high))
    start, facing = hits.search(state.relief, lines, low, high, hits.STEPS)
    bounds = field(cv2.erode(start, AROUND)) - NEARBY, field(cv2.dilate(start, AROUND)) + NEARBY
    hard = (facing < hits.FLAT) & hits.near(state.relief, lines, start, CELL * SAMPLES)
    odd = np.asarray(cv2.dilate(hard.astype(np.uint8), AROUND), bool)
    directions = turned(grid_from_camera[:3, :3], *cells)
    mirrors = shading.half_slopes(directions, state.towards)
    speed = _speed(state, directions, lines.u + start * lines.du, lines.v + start * lines.dv, start)
    smear = float(np.abs(speed).max()) * state.instant.exposure / (SAMPLES * view.spacing)  # px
    instants = int(np.clip(np.ceil(smear / SMEAR / (2 * TIMES.size)), 1, MOST_INSTANTS)) if smear > SHARP else 0
    return _Lattice(grid_from_camera, rays, start, bounds, odd, mirrors, speed, instants)


def _strip(state: State, view: View, lattice: _Lattice, first: int, last: int) -> tuple[Field, Field | None]:
    """Light (H, W, 4) and depth (H, W) mm of the samples of cell rows first to last."""
    scene, times = state.scene, CELL * SAMPLES
    rays = Rays(*(r[first * times : last * times] for r in lattice.rays))
    lines, sink = _bundle(state, lattice.grid_from_camera, rays)
    odd = np.repeat(np.repeat(lattice.odd[first:last], times, 0), times, 1)
    bounds = lattice.bounds[0][first:last], lattice.bounds[1][first:last]
    z = hits.meet(state.relief, lines, lattice.spread(lattice.start, first, last), odd, bounds)
    u, v = lines.u + z * lines.du, lines.v + z * lines.dv  # nodes of material points
    passed = None
    if state.shadow is not None:
        skip = np.float32(max(1, round(SHADOW_STEP / scene.shape.step)))
        passed = looked_up(state.shadow, field(u / skip), field(v / skip))
    level = scene.layers.level(view.spacing)
    scale, ox, oy = scene.layers.offsets(level)
    to_texels = np.float32(scene.shape.step * scale)
    tu = u * to_texels + np.float32(ox - scene.shape.size[0] / 2 * scale)
    tv = v * to_texels + np.float32(oy - scene.shape.size[1] / 2 * scale)
    speed = lattice.spread(lattice.speed, first, last) if lattice.instants else None
    colour, relief = _exposed(state, level, tu, tv, speed, lattice.instants)
    light = colour
    if scene.look.lit:
        mirrors = lattice.spread(lattice.mirrors, first, last)
        light = shading.shade(colour, relief, mirrors, passed, state.towards, state.lamps, scene.look.ambient)
    if state.shadow is None:
        return light, None
    deep = (z - np.float32(lattice.grid_from_camera[2, 3])) * sink
    return light, field(np.where(colour[..., 3] > 0.5, deep, np.inf))


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


def _bundle(state: State, grid_from_camera: Array, rays: Rays) -> tuple[Bundle, Field]:
    """Rays as lines over the nodes of material points, and 1 / their z."""
    x, y, z = turned(grid_from_camera[:3, :3], *rays)
    never = z > GRAZING
    sink = field(1 / np.where(never, np.float32(-1), z))
    origin = grid_from_camera[:3, 3]
    shape = state.scene.shape
    lines = []
    for k, side in enumerate((x, y)):
        per_node = np.float32(1 / (state.factors[k] * shape.step))
        slope = field(side * (sink * per_node))
        first = np.float32(origin[k] * per_node + shape.size[k] / 2 / shape.step)
        start = field(first - np.float32(origin[2]) * slope)
        if never.any():
            start[never], slope[never] = OUTSIDE, 0
        lines.append((start, slope))
    return Bundle(lines[0][0], lines[1][0], lines[0][1], lines[1][1]), sink


def _speed(state: State, directions: tuple[Field, Field, Field], u: Field, v: Field, z: Field) -> Field:
    """Speed (h, w, 2) mm/s at which material points pass rays that meet node u, v at height z, as the surface moves."""
    twist = se3.adjoint(se3.inverse(state.scene.shape.surface_from_grid)) @ state.instant.twist
    if not twist.any():
        return np.zeros((*u.shape, 2), np.float32)
    w, t = twist[:3].astype(np.float32), twist[3:].astype(np.float32)
    shape, factors = state.scene.shape, state.factors
    slopes = looked_up(field(cv2.blur(state.relief.slopes, (9, 9))), u, v)
    sx, sy = slopes[..., 0] / (shape.step * factors[0]), slopes[..., 1] / (shape.step * factors[1])
    x = (u * shape.step - shape.size[0] / 2) * factors[0]
    y = (v * shape.step - shape.size[1] / 2) * factors[1]
    vx, vy, vz = t[0] + w[1] * z - w[2] * y, t[1] + w[2] * x - w[0] * z, t[2] + w[0] * y - w[1] * x
    dx, dy, dz = directions
    towards = np.minimum(dz - sx * dx - sy * dy, -0.1)
    along = (vz - sx * vx - sy * vy) / towards
    return field(np.dstack([(along * dx - vx) / factors[0], (along * dy - vy) / factors[1]]))


def _exposed(state: State, level: int, tu: Field, tv: Field, speed: Field | None, instants: int) -> tuple[Field, Field]:
    """Colour and relief (H, W, 4) at texels tu, tv, each sample at its own part of the exposure; speed: mm/s.

    Each sample looks as long before the middle of the exposure as after it, so that a point's picture stays centred.
    """
    layers, exposure = state.scene.layers, state.instant.exposure
    sources = layers.colour[level], layers.relief[level]
    if speed is None:
        colour, relief = (painted(source, tu, tv) for source in sources)
        return colour, relief
    path = speed * np.float32(exposure * layers.offsets(level)[0])
    times = np.tile(TIMES.astype(np.float32), (tu.shape[0] // 2, tu.shape[1] // 2))
    sums = []
    for k in range(instants):
        time = times + np.float32(((k + 0.5) / instants - 0.5) / (2 * TIMES.size))
        du, dv = path[..., 0] * time, path[..., 1] * time
        for u, v in ((tu - du, tv - dv), (tu + du, tv + dv)):
            sums.append([painted(source, u, v) for source in sources])
    colour, relief = (field(np.mean(part, axis=0, dtype=np.float32)) for part in zip(*sums, strict=True))
    return colour, relief
