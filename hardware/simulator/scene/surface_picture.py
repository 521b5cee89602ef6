"""The picture of the body's surface, without the nozzle.

Each sample is traced to its material point and shaded there.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from estimation import se3
from estimation.rig import pixels_from_points
from estimation.se3 import Array
from hardware.simulator.scene import ray_kernels
from hardware.simulator.scene.appearance import (
    lamp_table,
    mirror_slopes,
)
from hardware.simulator.scene.fields import Field, as_field, block_mean, sample, sample_texture, upsample
from hardware.simulator.scene.ray_kernels import CELL_PX, CELL_SAMPLES, SAMPLES_PER_PIXEL
from hardware.simulator.scene.rays import ImageBox, Rays, RenderView
from hardware.simulator.scene.scene import SHADOW_STEP, SceneState, rotate_rays

HEIGHT_MARGIN = np.float32(1.5)  # mm: most of a wound's rim or wall between two cells
NEIGHBOURS = np.ones((3, 3), np.uint8)
GRAZING_REACH = np.ones((7, 7), np.uint8)  # about a grazing ray, which may hide the surface
CELL_ROWS_AT_ONCE = 2  # whose fields fit into the cache
COVER_STEP = 4.0  # mm between the points for the shape's box in an image
SMEAR_STEP_PX = 1.5  # px between the instants of an exposure in a pixel
MAX_INSTANTS = 8  # a sample; a longer smear has no detail
SUBPIXEL_TIMES = as_field([[7, 1], [3, 5]]) / 16  # of the exposure, before and after its middle, by sample of a pixel
MIN_SMEAR_PX = 0.25  # px: a shorter smear is not visible


@dataclass(frozen=True, slots=True, eq=False)
class SurfacePicture:
    """The body over a box of the image."""

    box: ImageBox
    light: Field  # (H, W, 4) linear BGR times opacity, and opacity
    depth: Field | None  # (2H, 2W) mm along the optical axis, inf for no surface; None without a nozzle


def surface_picture(state: SceneState, view: RenderView) -> SurfacePicture | None:
    """The shape's part of one camera's image, None where it is out of view."""
    box = surface_box(state, view)
    if box is None:
        return None
    lattice = _lattice(state, view, box)
    light = np.empty((*box.size, 4), np.float32)
    depth = np.empty((0, 0) if state.shadow is None else box.sample_size, np.float32)
    for first in range(0, box.size[0] // CELL_PX, CELL_ROWS_AT_ONCE):
        last = min(first + CELL_ROWS_AT_ONCE, box.size[0] // CELL_PX)
        rows = slice(first * CELL_SAMPLES, last * CELL_SAMPLES)
        _fill_strip(state, view, lattice, first, last, light[first * CELL_PX : last * CELL_PX], depth[rows])
    return SurfacePicture(box, light, None if state.shadow is None else depth)


@dataclass(frozen=True, slots=True, eq=False)
class _Lattice:
    """What varies slowly, (h, w) at the middles of a box's cells, and the box's rays, (H, W)."""

    to_nodes: Field
    rays: Rays
    heights: Field  # heights mm
    search_mask: NDArray[np.uint8]  # of rays to be searched one by one
    mirrors: Field  # (h, w, 4) slopes that mirror the lamps
    path: Field  # (h, w, 2) texels, motion of material points against the rays in the exposure
    instants: int  # samples before the middle of the exposure, and as many after; 0: in the middle only
    lamps: tuple[Field, Field]  # as `lamp_table` gives them

    def spread(self, cells: Field, first: int, last: int) -> Field:
        """A field of the cells at the samples of the cell rows first to last."""
        low, high = max(first - 1, 0), min(last + 1, len(cells))
        size = ((high - low) * CELL_SAMPLES, cells.shape[1] * CELL_SAMPLES)
        return upsample(cells[low:high], size)[(first - low) * CELL_SAMPLES : (last - low) * CELL_SAMPLES]


def _lattice(state: SceneState, view: RenderView, box: ImageBox) -> _Lattice:
    to_nodes, rays = _to_nodes(state, se3.inverse(state.base_from_grid) @ view.camera.base_from_camera), view.rays(box)
    small, relief = (box.size[0] // CELL_PX, box.size[1] // CELL_PX), state.relief
    cells = Rays(*(block_mean(r, small) for r in rays))
    heights, u, v = np.empty((3, *small), np.float32)
    search_mask = np.empty(small, np.uint8)
    bounds = np.float32(relief.low), np.float32(relief.high)
    ray_kernels.search_cells(to_nodes, *cells, relief.height, *bounds, heights, search_mask, u, v)
    directions = rotate_rays(np.asarray(to_nodes[:3], float), *cells)
    speed, exposure = _speed(state, directions, u, v, heights), state.instant.exposure
    smear = float(np.abs(speed).max()) * exposure / (SAMPLES_PER_PIXEL * view.spacing)  # px
    instants = int(np.clip(np.ceil(smear / SMEAR_STEP_PX / (2 * SUBPIXEL_TIMES.size)), 1, MAX_INSTANTS))
    layers = state.scene.layers
    path = speed * np.float32(exposure * layers.offsets(layers.level(view.spacing))[0])
    search_mask = np.asarray(cv2.dilate(search_mask, NEIGHBOURS), np.uint8)
    mirrors = mirror_slopes(directions, state.towards)
    lamps = lamp_table(state.lamps, state.towards, state.scene.look.ambient)
    return _Lattice(to_nodes, rays, heights, search_mask, mirrors, path, instants if smear > MIN_SMEAR_PX else 0, lamps)


def _fill_strip(
    state: SceneState, view: RenderView, lattice: _Lattice, first: int, last: int, light: Field, depth: Field
) -> None:
    """Fill light (H, W, 4) and depth (2H, 2W) of cell rows first to last; depth: empty if not needed."""
    scene = state.scene
    z, rays = _surface_points(state, lattice, first, last)
    level = scene.layers.level(view.spacing)
    scale, ox, oy = scene.layers.offsets(level)
    to_texels = np.float32(scene.shape.step * scale)
    u = rays[0] * to_texels + np.float32(ox - scene.shape.size[0] / 2 * scale)
    v = rays[1] * to_texels + np.float32(oy - scene.shape.size[1] / 2 * scale)
    path = lattice.spread(lattice.path, first, last) if lattice.instants else None
    colour, relief = _exposure_sums(state, level, u, v, path, lattice.instants)
    count = max(1, 2 * lattice.instants)
    if scene.look.lit:
        mirrors = lattice.spread(lattice.mirrors, first, last)
        mirror_values, shares = mirrors.reshape(-1), _lamp_shares(state, rays).reshape(-1)
        ray_kernels.shade(colour.reshape(-1), relief.reshape(-1), mirror_values, shares, count, *lattice.lamps)
    else:
        colour /= count
    light[:] = block_mean(colour, light.shape[:2])
    if len(depth):
        ray_kernels.note_depth(rays, z, lattice.to_nodes[4, 2], colour, depth)


def _lamp_shares(state: SceneState, rays: Field) -> Field:
    """Share of each lamp's light, the first two of (H, W, 4), that passes the nozzle to the rays' ends."""
    if state.shadow is None:
        return np.ones((*rays.shape[1:], 4), np.float32)
    scale = np.float32(1 / max(1, round(SHADOW_STEP / state.scene.shape.step)))
    rows = np.clip([rays[1].min() * scale - 1, rays[1].max() * scale + 2], 0, len(state.shadow)).astype(int)
    if rows[1] > rows[0] and state.shadow[slice(*rows)].min() == 1:
        return np.ones((*rays.shape[1:], 4), np.float32)
    return sample(state.shadow, rays[0] * scale, rays[1] * scale)


def _surface_points(state: SceneState, lattice: _Lattice, first: int, last: int) -> tuple[Field, Field]:
    """Height (H, W) mm of the rays' first hits of the surface, constant beyond its edge, and the rays.

    Newton's method from the cells' heights ends within 1e-4 mm of it; rays that graze the surface, that it hides, or
    for which the method does not converge are searched one by one. rays: (8, H, W), of `ray_kernels.begin_rays`.
    """
    relief, places = state.relief, slice(first * CELL_SAMPLES, last * CELL_SAMPLES)
    x, y = (np.ascontiguousarray(tangents[places]) for tangents in lattice.rays)
    z = lattice.spread(lattice.heights, first, last).copy()
    rays, doubt = np.empty((8, *z.shape), np.float32), np.empty(z.shape, np.uint8)
    ray_kernels.begin_rays(lattice.to_nodes, x, y, z, rays)
    ray_kernels.face_rays(sample(relief.slopes, rays[0], rays[1]), rays, z, doubt)
    for _ in range(1, ray_kernels.NEWTON_ROUNDS):
        ray_kernels.step_rays(sample(relief.height, rays[0], rays[1]), rays, z)
    rest = sample(relief.height, rays[0], rays[1])
    doubtful = ray_kernels.note_doubt(rest, z, lattice.search_mask[first:last], doubt)
    ray_kernels.step_rays(rest, rays, z)
    if doubtful:
        doubt |= np.asarray(cv2.dilate((doubt > 1).astype(np.uint8), GRAZING_REACH), np.uint8)
        above = max(first - 1, 0)
        around, inner = lattice.heights[above : last + 1], slice(first - above, last - above)
        low, high = (np.ascontiguousarray(f(around, NEIGHBOURS)[inner], np.float32) for f in (cv2.erode, cv2.dilate))
        low, high, (height, slopes) = low - HEIGHT_MARGIN, high + HEIGHT_MARGIN, relief[:2]
        ray_kernels.search_doubtful(lattice.to_nodes, x, y, height, slopes, low, high, doubt, z, rays)
    return z, rays


def _to_nodes(state: SceneState, grid_from_camera: Array) -> Field:
    """(5, 3) map from rays to lines over the nodes of material points, for `ray_kernels`."""
    shape, origin = state.scene.shape, grid_from_camera[:3, 3]
    per_mm = [1 / (factor * shape.step) for factor in state.factors]
    lens = [origin[k] * per_mm[k] + shape.size[k] / 2 / shape.step for k in range(2)]
    return as_field([*grid_from_camera[:3, :3], [*per_mm, 1.0], [*lens, origin[2]]])


def surface_box(state: SceneState, view: RenderView) -> ImageBox | None:
    """The part of the image with the shape, None if it is out of view."""
    shape, deformation, strain = state.scene.shape, state.scene.deformation, state.instant.strain
    flat = shape.grid(COVER_STEP)
    points = np.column_stack([flat, shape.heights_at(flat)])
    points = se3.transform_points(state.base_from_grid, points + deformation.displacement(points, strain))
    pixels, depth = pixels_from_points(view.camera, points)
    if (depth < 1).any():
        return None
    return view.clip(pixels.min(0) - 4, pixels.max(0) + 4)


def _speed(state: SceneState, directions: tuple[Field, Field, Field], u: Field, v: Field, z: Field) -> Field:
    """Speed (h, w, 2) mm/s of material points of the moving surface against rays that hit node u, v at height z."""
    twist = se3.adjoint(se3.inverse(state.scene.shape.surface_from_grid)) @ state.instant.twist
    if not twist.any():
        return np.zeros((*u.shape, 2), np.float32)
    w, t = twist[:3].astype(np.float32), twist[3:].astype(np.float32)
    shape, factors = state.scene.shape, state.factors
    slopes = sample(state.relief.smooth_slopes, u, v)
    sx, sy = slopes[..., 0] / (shape.step * factors[0]), slopes[..., 1] / (shape.step * factors[1])
    x = (u * shape.step - shape.size[0] / 2) * factors[0]
    y = (v * shape.step - shape.size[1] / 2) * factors[1]
    vx, vy, vz = t[0] + w[1] * z - w[2] * y, t[1] + w[2] * x - w[0] * z, t[2] + w[0] * y - w[1] * x
    dx, dy, dz = directions
    towards = np.minimum(dz - sx * dx - sy * dy, -0.1)
    along = (vz - sx * vx - sy * vy) / towards
    return as_field(np.dstack([(along * dx - vx) / factors[0], (along * dy - vy) / factors[1]]))


def _exposure_sums(
    state: SceneState, level: int, u: Field, v: Field, path: Field | None, instants: int
) -> tuple[Field, Field]:
    """Colour and relief (H, W, 4) at texels u, v, each sample at its own part of the exposure; sums over all looks.

    Each sample is symmetric about the middle of the exposure, so that a point's picture stays centred.
    """
    sources = state.scene.layers.colour[level], state.scene.layers.relief[level]
    if path is None:
        colour, relief = (sample_texture(source, u, v) for source in sources)
        return colour, relief
    sums: list[Field] = []
    shifted = np.empty((4, *u.shape), np.float32)
    for k in range(instants):
        times = as_field(SUBPIXEL_TIMES + ((k + 0.5) / instants - 0.5) / (2 * SUBPIXEL_TIMES.size))
        ray_kernels.pass_by(u, v, path, times, shifted)
        for places in (shifted[:2], shifted[2:]):
            looks = [sample_texture(source, *places) for source in sources]
            sums = [as_field(cv2.add(a, b, a)) for a, b in zip(sums, looks, strict=True)] if sums else looks
    return sums[0], sums[1]
