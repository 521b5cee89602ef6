"""The pictures of the body's surface and of the drape round it, before the nozzle is drawn over them.

Each sample of the surface is traced to its material point and shaded there. The drape is traced on a coarse lattice of
rays and coloured at every pixel.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from estimation import se3
from estimation.rig import pixels_from_points
from estimation.se3 import Array
from hardware.simulator.scene.appearance import CLOTH_TEAL, DRAPE_STEP, DRAPE_TEXEL, mirror_slopes, surface_light
from hardware.simulator.scene.fields import Field, Mask, as_field, block_mean, sample, sample_texture, upsample
from hardware.simulator.scene.rays import (
    CELL_PX,
    GRAZING_FACING,
    SAMPLES_PER_PIXEL,
    SEARCH_STEPS,
    ImageBox,
    RayLines,
    Rays,
    RenderView,
    as_block,
    first_hit,
    near_field,
    search_down,
)
from hardware.simulator.scene.scene import SHADOW_STEP, SceneState, passing_light, rotate_rays, transform_fields

GRAZING_Z = -0.03  # of a ray's z: those that sink less never meet the shape
OFF_GRID = -1e5  # a node where nothing is painted
HEIGHT_MARGIN = np.float32(1.5)  # mm: a wound's rim or wall between two cells reaches no further
NEIGHBOURS = np.ones((3, 3), np.uint8)
COVER_STEP = 4.0  # mm between the points that tell which part of an image the shape covers
CELL_ROWS_AT_ONCE = 4  # rows of cells worked on at once: their fields stay in the cache
SMEAR_STEP_PX = 1.5  # px between the instants of one exposure that a pixel holds
MAX_INSTANTS = 8  # a sample; at more the picture is one smear anyway
SUBPIXEL_TIMES = np.array([[7, 1], [3, 5]]) / 16  # of the exposure, before and after its middle, by sample of a pixel
MIN_SMEAR_PX = 0.25  # px: a smear too short to be seen


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
    depth = None if state.shadow is None else np.empty([n * SAMPLES_PER_PIXEL for n in box.size], np.float32)
    for first in range(0, box.size[0] // CELL_PX, CELL_ROWS_AT_ONCE):
        last = min(first + CELL_ROWS_AT_ONCE, box.size[0] // CELL_PX)
        rows = slice(first * CELL_PX * SAMPLES_PER_PIXEL, last * CELL_PX * SAMPLES_PER_PIXEL)
        samples, deep = _strip(state, view, lattice, first, last)
        light[first * CELL_PX : last * CELL_PX] = block_mean(samples, ((last - first) * CELL_PX, box.size[1]))
        if depth is not None:
            depth[rows] = deep
    return SurfacePicture(box, light, depth)


@dataclass(frozen=True, slots=True, eq=False)
class _Lattice:
    """What varies slowly, (h, w) at the middles of a box's cells, and the box's rays, (H, W)."""

    grid_from_camera: Array
    rays: Rays
    start: Field  # heights mm
    bounds: tuple[Field, Field]  # heights mm that hold those of the rays around
    odd: Mask  # where rays must be searched one by one
    mirrors: Field  # (h, w, 4) slopes that mirror the lamps
    speed: Field  # (h, w, 2) mm/s of material points past the rays
    instants: int  # samples before the middle of the exposure, and as many after; 0: in the middle only

    def spread(self, cells: Field, first: int, last: int) -> Field:
        """A field of the cells at the samples of the cell rows first to last."""
        low, high = max(first - 1, 0), min(last + 1, len(cells))
        times = CELL_PX * SAMPLES_PER_PIXEL
        size = ((high - low) * times, cells.shape[1] * times)
        return upsample(cells[low:high], size)[(first - low) * times : (last - low) * times]


def _lattice(state: SceneState, view: RenderView, box: ImageBox) -> _Lattice:
    grid_from_camera = se3.inverse(state.base_from_grid) @ view.camera.base_from_camera
    rays = view.rays(box)
    small = (box.size[0] // CELL_PX, box.size[1] // CELL_PX)
    cells = Rays(*(block_mean(r, small) for r in rays))
    lines, _ = _ray_lines(state, grid_from_camera, cells)
    low, high = (np.full(small, v, np.float32) for v in (state.relief.low, state.relief.high))
    start, facing = search_down(state.relief, lines, low, high, SEARCH_STEPS)
    lowest, highest = cv2.erode(start, NEIGHBOURS), cv2.dilate(start, NEIGHBOURS)
    bounds = as_field(lowest) - HEIGHT_MARGIN, as_field(highest) + HEIGHT_MARGIN
    hard = (facing < GRAZING_FACING) & near_field(state.relief, lines, start, CELL_PX * SAMPLES_PER_PIXEL)
    odd = np.asarray(cv2.dilate(hard.astype(np.uint8), NEIGHBOURS), bool)
    directions = rotate_rays(grid_from_camera[:3, :3], *cells)
    mirrors = mirror_slopes(directions, state.towards)
    speed = _speed(state, directions, *lines.nodes(start), start)
    smear = float(np.abs(speed).max()) * state.instant.exposure / (SAMPLES_PER_PIXEL * view.spacing)  # px
    instants = int(np.clip(np.ceil(smear / SMEAR_STEP_PX / (2 * SUBPIXEL_TIMES.size)), 1, MAX_INSTANTS))
    instants = instants if smear > MIN_SMEAR_PX else 0
    return _Lattice(grid_from_camera, rays, start, bounds, odd, mirrors, speed, instants)


def _strip(state: SceneState, view: RenderView, lattice: _Lattice, first: int, last: int) -> tuple[Field, Field | None]:
    scene, times = state.scene, CELL_PX * SAMPLES_PER_PIXEL
    rays = Rays(*(r[first * times : last * times] for r in lattice.rays))
    lines, sink = _ray_lines(state, lattice.grid_from_camera, rays)
    odd = np.repeat(np.repeat(lattice.odd[first:last], times, 0), times, 1)
    bounds = lattice.bounds[0][first:last], lattice.bounds[1][first:last]
    z = first_hit(state.relief, lines, lattice.spread(lattice.start, first, last), odd, bounds)
    u, v = lines.nodes(z)  # nodes of material points
    passed = None
    if state.shadow is not None:
        skip = np.float32(max(1, round(SHADOW_STEP / scene.shape.step)))
        passed = sample(state.shadow, as_field(u / skip), as_field(v / skip))
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
        light = surface_light(colour, relief, mirrors, passed, state.towards, state.lamps, scene.look.ambient)
    if state.shadow is None:
        return light, None
    deep = (z - np.float32(lattice.grid_from_camera[2, 3])) * sink
    return light, as_field(np.where(colour[..., 3] > 0.5, deep, np.inf))


def surface_box(state: SceneState, view: RenderView) -> ImageBox | None:
    """The part of the image that the shape can touch, None if it is out of view."""
    shape, deformation, strain = state.scene.shape, state.scene.deformation, state.instant.strain
    flat = shape.grid(COVER_STEP)
    points = np.column_stack([flat, shape.heights_at(flat)])
    points = se3.transform_points(state.base_from_grid, points + deformation.displacement(points, strain))
    pixels, depth = pixels_from_points(view.camera, points)
    if (depth < 1).any():
        return None
    return view.clip(pixels.min(0) - 4, pixels.max(0) + 4)


def _ray_lines(state: SceneState, grid_from_camera: Array, rays: Rays) -> tuple[RayLines, Field]:
    """Rays as lines over the nodes of material points, and 1 / their z."""
    x, y, z = rotate_rays(grid_from_camera[:3, :3], *rays)
    never = z > GRAZING_Z
    sink = as_field(1 / np.where(never, np.float32(-1), z))
    origin = grid_from_camera[:3, 3]
    shape = state.scene.shape
    lines = []
    for k, side in enumerate((x, y)):
        per_node = np.float32(1 / (state.factors[k] * shape.step))
        slope = as_field(side * (sink * per_node))
        first = np.float32(origin[k] * per_node + shape.size[k] / 2 / shape.step)
        start = as_field(first - np.float32(origin[2]) * slope)
        if never.any():
            start[never], slope[never] = OFF_GRID, 0
        lines.append((start, slope))
    return RayLines(lines[0][0], lines[1][0], lines[0][1], lines[1][1]), sink


def _speed(state: SceneState, directions: tuple[Field, Field, Field], u: Field, v: Field, z: Field) -> Field:
    """Speed (h, w, 2) mm/s at which material points pass rays that meet node u, v at height z, as the surface moves."""
    twist = se3.adjoint(se3.inverse(state.scene.shape.surface_from_grid)) @ state.instant.twist
    if not twist.any():
        return np.zeros((*u.shape, 2), np.float32)
    w, t = twist[:3].astype(np.float32), twist[3:].astype(np.float32)
    shape, factors = state.scene.shape, state.factors
    slopes = sample(as_field(cv2.blur(state.relief.slopes, (9, 9))), u, v)
    sx, sy = slopes[..., 0] / (shape.step * factors[0]), slopes[..., 1] / (shape.step * factors[1])
    x = (u * shape.step - shape.size[0] / 2) * factors[0]
    y = (v * shape.step - shape.size[1] / 2) * factors[1]
    vx, vy, vz = t[0] + w[1] * z - w[2] * y, t[1] + w[2] * x - w[0] * z, t[2] + w[0] * y - w[1] * x
    dx, dy, dz = directions
    towards = np.minimum(dz - sx * dx - sy * dy, -0.1)
    along = (vz - sx * vx - sy * vy) / towards
    return as_field(np.dstack([(along * dx - vx) / factors[0], (along * dy - vy) / factors[1]]))


def _exposed(
    state: SceneState, level: int, tu: Field, tv: Field, speed: Field | None, instants: int
) -> tuple[Field, Field]:
    """Colour and relief (H, W, 4) at texels tu, tv, each sample at its own part of the exposure; speed: mm/s.

    Each sample looks as long before the middle of the exposure as after it, so that a point's picture stays centred.
    """
    layers, exposure = state.scene.layers, state.instant.exposure
    sources = layers.colour[level], layers.relief[level]
    if speed is None:
        colour, relief = (sample_texture(source, tu, tv) for source in sources)
        return colour, relief
    path = speed * np.float32(exposure * layers.offsets(level)[0])
    times = np.tile(SUBPIXEL_TIMES.astype(np.float32), (tu.shape[0] // 2, tu.shape[1] // 2))
    sums = []
    for k in range(instants):
        time = times + np.float32(((k + 0.5) / instants - 0.5) / (2 * SUBPIXEL_TIMES.size))
        du, dv = path[..., 0] * time, path[..., 1] * time
        for u, v in ((tu - du, tv - dv), (tu + du, tv + dv)):
            sums.append([sample_texture(source, u, v) for source in sources])
    colour, relief = (as_field(np.mean(part, axis=0, dtype=np.float32)) for part in zip(*sums, strict=True))
    return colour, relief


DRAPE_LATTICE_PX = 8  # px between the rays that are traced
DEPTH_STEPS = 20
SEARCH_LATTICE_PX = 16  # px between the rays that are searched through all depths
EDGE_DEPTH_STEPS = 8
DEPTH_MARGIN = np.float32(8.0)  # mm of depth by which the cloth between rays reaches beyond them
DEPTH_JUMP = 15.0  # mm by which the depth between two rays differs from the mean of theirs where the cloth hides itself
DRAPE_ROWS_AT_ONCE = 48  # rows coloured at once: their fields stay in the cache
MAX_DRAPE_HEIGHT = 40.0  # mm above the rest plane: nothing of the cloth is higher
MIN_DRAPE_HEIGHT = -130.0


@dataclass(frozen=True, slots=True, eq=False)
class DrapePicture:
    """The drape over the whole image."""

    light: Field  # (H, W, 3) linear BGR
    depth: Field  # (h, w) mm along the optical axis, DRAPE_LATTICE_PX apart


@dataclass(frozen=True, slots=True, eq=False)
class _DrapeRays:
    """A camera's rays in the moving grid frame and in the grid at rest: origin (3,) and rotation (3, 3) of each."""

    state: SceneState
    grid_from_camera: Array
    rest_from_camera: Array

    def material(self, rays: Rays, depth: Field) -> tuple[Field, Field, Field]:
        """Where on the cloth (x, y) and how far above its plane (z), mm, (H, W) each, points at `depth` are.

        The cloth follows the body near the opening and rests far from it; between, it is a mixture of the two.
        """
        x, y, z = transform_fields(self.grid_from_camera, rays.x * depth, rays.y * depth, depth)
        ax, ay, az = transform_fields(self.rest_from_camera, rays.x * depth, rays.y * depth, depth)
        held = self.state.scene.sheet.held(x, y)
        flat = np.stack([x / np.float32(self.state.factors[0]), y / np.float32(self.state.factors[1])], -1)
        z = z - self.state.scene.deformation.lift(flat, self.state.instant.strain).astype(np.float32)
        x, y = flat[..., 0], flat[..., 1]
        return ax + held * (x - ax), ay + held * (y - ay), az + held * (z - az)

    def left(self, rays: Rays, depth: Field) -> tuple[Field, Field, Field]:
        """How far above the cloth points at `depth` are, mm, and where on it."""
        x, y, z = self.material(rays, depth)
        heights = self.state.scene.sheet.heights
        u = x / np.float32(DRAPE_STEP) + np.float32((heights.shape[1] - 1) / 2)
        v = y / np.float32(DRAPE_STEP) + np.float32((heights.shape[0] - 1) / 2)
        return z - sample(heights, u, v), x, y


def drape_picture(state: SceneState, view: RenderView) -> DrapePicture:
    """The cloth as one camera sees it, the shape taken away."""
    frames = state.base_from_grid, state.scene.base_from_rest
    lens_rays = _DrapeRays(state, *(se3.inverse(each) @ view.camera.base_from_camera for each in frames))
    rays, coarse, m = view.coarse(DRAPE_LATTICE_PX), view.coarse(SEARCH_LATTICE_PX), lens_rays.rest_from_camera
    sink = np.minimum(m[2, 0] * coarse.x + m[2, 1] * coarse.y + m[2, 2], -0.15)
    near, far = (as_field((height - m[2, 3]) / sink) for height in (MAX_DRAPE_HEIGHT, MIN_DRAPE_HEIGHT))
    first_depth = _search(lens_rays, coarse, near, far, DEPTH_STEPS)
    depth, x, y = _refined(lens_rays, rays, upsample(first_depth, (rays.x.shape[0], rays.x.shape[1])))
    w, h = view.camera.size
    u, v = (upsample(plane, view.whole.size)[:h, :w] for plane in _texels(state, x, y))
    key_share = _key_light_share(lens_rays, rays, depth)
    if key_share is not None:
        key_share = upsample(key_share, view.whole.size)[:h, :w]
    _edges(lens_rays, rays, depth, u, v)
    light, tint = np.empty((h, w, 3), np.float32), CLOTH_TEAL * np.array(state.lamps[0].colour, np.float32)
    bgr_from_texture, border = np.column_stack([np.eye(3, dtype=np.float32), tint]), cv2.BORDER_REFLECT_101
    picture = state.scene.sheet.picture
    for first in range(0, h, DRAPE_ROWS_AT_ONCE):
        rows = slice(first, first + DRAPE_ROWS_AT_ONCE)
        texture = as_field(cv2.remap(picture, u[rows], v[rows], cv2.INTER_LINEAR, borderMode=border))
        if key_share is not None:
            texture[..., 3] *= key_share[rows]
        cv2.transform(texture, bgr_from_texture, light[rows])
    return DrapePicture(light, depth)


def _texels(state: SceneState, x: Field, y: Field) -> tuple[Field, Field]:
    rows, columns = state.scene.sheet.picture.shape[:2]
    scale = np.float32(1 / DRAPE_TEXEL)
    return x * scale + np.float32((columns - 1) / 2), y * scale + np.float32((rows - 1) / 2)


def _search(eye: _DrapeRays, rays: Rays, near: Field, far: Field, steps: int) -> Field:
    """Depth (H, W) mm at which rays first meet the cloth, by equal steps from near to far; far where they never do."""
    step = (far - near) / np.float32(steps)
    result, above, open_way = far, np.ones_like(near), np.ones(near.shape, bool)
    for k in range(steps + 1):
        depth = near + step * np.float32(k)
        left, _, _ = eye.left(rays, depth)
        new = (left <= 0) & open_way
        result = as_field(np.where(new, depth + step * left / np.maximum(above - left, 1e-6), result))
        open_way &= ~new
        above = left
    return result


def _refined(eye: _DrapeRays, rays: Rays, depth: Field) -> tuple[Field, Field, Field]:
    """Depth and material x, y (H, W) mm after a round of the secant method."""
    left_last, _, _ = eye.left(rays, depth + np.float32(0.5))
    left, _, _ = eye.left(rays, depth)
    fall = 2 * (left_last - left)
    depth = depth - as_field(np.clip(left / np.where(np.abs(fall) < 0.1, np.float32(-0.5), fall), -15, 15))
    _, x, y = eye.left(rays, depth)
    return depth, x, y


def _edges(eye: _DrapeRays, rays: Rays, depth: Field, u: Field, v: Field) -> None:
    """Trace again, one by one, the pixels where the cloth hides itself and the lattice would draw steps.

    u, v: (H, W) columns and rows in the cloth's picture, which are put right.
    """
    bend = np.array([[1.0, -2.0, 1.0]], np.float32)
    bent = np.maximum(*(np.abs(cv2.filter2D(depth, -1, k, borderType=cv2.BORDER_REPLICATE)) for k in (bend, bend.T)))
    jump = np.asarray(cv2.dilate((bent > DEPTH_JUMP).astype(np.uint8), np.ones((3, 3), np.uint8)), bool)
    if not jump.any():
        return
    h, w = u.shape
    place = np.nonzero(np.repeat(np.repeat(jump, DRAPE_LATTICE_PX, 0), DRAPE_LATTICE_PX, 1)[:h, :w])
    at = [as_block(((p + 0.5) / DRAPE_LATTICE_PX - 0.5).astype(np.float32)) for p in place]
    alone = Rays(*(sample(r, at[1], at[0]) for r in rays))
    around = np.ones((5, 5), np.uint8)
    near, far = (sample(as_field(f(depth, around)), at[1], at[0]) for f in (cv2.erode, cv2.dilate))
    _, x, y = _refined(eye, alone, _search(eye, alone, near - DEPTH_MARGIN, far + DEPTH_MARGIN, EDGE_DEPTH_STEPS))
    for into, right in zip((u, v), _texels(eye.state, x, y), strict=True):
        into[place] = right.reshape(-1)[: len(place[0])]


def _key_light_share(eye: _DrapeRays, rays: Rays, depth: Field) -> Field | None:
    """Share of the key lamp's light that passes the nozzle; None without one."""
    state = eye.state
    if state.instant.base_from_nozzle is None:
        return None
    nozzle_from_base = se3.inverse(state.instant.base_from_nozzle)
    nozzle_from_camera = nozzle_from_base @ state.base_from_grid @ eye.grid_from_camera
    points = transform_fields(nozzle_from_camera, rays.x * depth, rays.y * depth, depth)
    return passing_light(points, nozzle_from_base @ state.scene.base_from_rest, state.lamps[0])
