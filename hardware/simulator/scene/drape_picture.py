"""The picture of the drape: traced on a coarse lattice of rays, coloured at every pixel.

The loops over rays are compiled.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from estimation import se3
from estimation.runtime import compiled
from estimation.se3 import Array
from hardware.simulator.scene.appearance import (
    AT_REST_BEYOND,
    ATTACHED_WITHIN,
    CLOTH_TEAL,
    DRAPE_STEP,
    DRAPE_TEXEL,
    OPENING_CORNER,
)
from hardware.simulator.scene.fields import Field, as_field, upsample
from hardware.simulator.scene.nozzle import passing_light
from hardware.simulator.scene.ray_kernels import CELL_PX, HALF, NOTHING, ONE, Bytes, height_at
from hardware.simulator.scene.rays import Rays, RenderView
from hardware.simulator.scene.scene import SceneState, transform_fields

DRAPE_LATTICE_PX = CELL_PX  # px between the rays that are traced
DRAPE_ROWS_AT_ONCE = 48  # rows coloured at once: their fields stay in the cache
DEPTH_STEPS = 20
SEARCH_LATTICE_PX = 16  # px between the rays that are searched through all depths
EDGE_DEPTH_STEPS = 8
DEPTH_MARGIN = np.float32(8.0)  # mm of depth by which the cloth between rays reaches beyond them
DEPTH_JUMP = 15.0  # mm by which the depth between two rays differs from the mean of theirs where the cloth hides itself
MAX_DRAPE_HEIGHT = 40.0  # mm above the rest plane: nothing of the cloth is higher
MIN_DRAPE_HEIGHT = -130.0
CLOTH = "Tuple((f4[:,::1], f4[:,::1], f4[::1], f4[::1], f4[:,::1]))"  # the types of a Cloth
Cloth = tuple[Field, Field, Field, Field, Field]  # moving, resting, bend, opening and heights of `_cloth`


@dataclass(frozen=True, slots=True, eq=False)
class DrapePicture:
    """The drape over the whole image."""

    light: Field  # (H, W, 3) linear BGR
    depth: Field  # (h, w) mm along the optical axis, DRAPE_LATTICE_PX apart


def drape_picture(state: SceneState, view: RenderView) -> DrapePicture:
    """The cloth as one camera sees it, the shape taken away."""
    rest_from_camera = se3.inverse(state.scene.base_from_rest) @ view.camera.base_from_camera
    cloth, picture = _cloth(state, view, rest_from_camera), state.scene.sheet.picture
    texels = as_field([1 / DRAPE_TEXEL, *((n - 1) / 2 for n in picture.shape[1::-1])])
    rays, coarse, m = view.coarse(DRAPE_LATTICE_PX), view.coarse(SEARCH_LATTICE_PX), rest_from_camera
    sink = np.minimum(m[2, 0] * coarse.x + m[2, 1] * coarse.y + m[2, 2], -0.15)
    near, far = (as_field((height - m[2, 3]) / sink) for height in (MAX_DRAPE_HEIGHT, MIN_DRAPE_HEIGHT))
    first_depth = np.empty_like(coarse.x)
    _search_cloth(cloth, *coarse, near, far, DEPTH_STEPS, first_depth)
    depth = upsample(first_depth, (rays.x.shape[0], rays.x.shape[1]))
    at = np.empty((2, *depth.shape), np.float32)
    _refine_cloth(cloth, *rays, depth, texels, *at)
    w, h = view.camera.size
    planes = *at, _key_light_share(state, view, rays, depth)
    u, v, share = (np.ascontiguousarray(upsample(plane, view.whole.size)[:h, :w]) for plane in planes)
    if (edges := _edges(depth)).any():
        around = np.ones((5, 5), np.uint8)
        near, far = (as_field(f(depth, around)) for f in (cv2.erode, cv2.dilate))
        bounds = as_field(near - DEPTH_MARGIN), as_field(far + DEPTH_MARGIN)
        _trace_edges(cloth, edges, *rays, *bounds, EDGE_DEPTH_STEPS, texels, u, v)
    light, tint = np.empty((h, w, 3), np.float32), as_field(CLOTH_TEAL * as_field(state.lamps[0].colour))
    border = cv2.BORDER_REFLECT_101
    for first in range(0, h, DRAPE_ROWS_AT_ONCE):
        rows = slice(first, first + DRAPE_ROWS_AT_ONCE)
        texture = as_field(cv2.remap(picture, u[rows], v[rows], cv2.INTER_LINEAR, borderMode=border))
        _light_cloth(texture.reshape(-1), share[rows].reshape(-1), tint, light[rows].reshape(-1))
    return DrapePicture(light, depth)


def _cloth(state: SceneState, view: RenderView, rest_from_camera: Array) -> Cloth:
    """How the cloth lies before a camera: it follows the body near the opening, rests far from it, is mixed between.

    moving, resting: (3, 4) grid_from_camera, mm, and the same of the grid at rest. bend: (4,) by which x and y are
    stretched back; mm by which the middle is lifted, and its exponent a mm^2. opening: (5,) mm, its half sides less its
    corners' radius, that radius, how far outside it the cloth rests; and 1 / (how far it is held - that), 1 / mm.
    heights: (H, W) mm, nodes DRAPE_STEP apart.
    """
    scene, moving = state.scene, se3.inverse(state.base_from_grid) @ view.camera.base_from_camera
    lift = scene.deformation.bulge * state.instant.strain, -1 / (2 * scene.deformation.radius**2)
    half, resting, attached = (0.0, 0.0), -1e6, -1e6 - 1  # without an opening all of it rests
    if scene.sheet.half is not None:
        half, resting, attached = scene.sheet.half, AT_REST_BEYOND, ATTACHED_WITHIN
    opening = half[0] - OPENING_CORNER, half[1] - OPENING_CORNER, OPENING_CORNER, resting, 1 / (attached - resting)
    bend = 1 / state.factors[0], 1 / state.factors[1], *lift
    return as_field(moving[:3]), as_field(rest_from_camera[:3]), as_field(bend), as_field(opening), scene.sheet.heights


def _edges(depth: Field) -> NDArray[np.uint8]:
    """The squares of the lattice (h, w) where the cloth hides itself, and what is between them would draw steps."""
    bend = np.array([[1.0, -2.0, 1.0]], np.float32)
    bending = np.maximum(*(np.abs(cv2.filter2D(depth, -1, k, borderType=cv2.BORDER_REPLICATE)) for k in (bend, bend.T)))
    return np.asarray(cv2.dilate((bending > DEPTH_JUMP).astype(np.uint8), np.ones((3, 3), np.uint8)), np.uint8)


def _key_light_share(state: SceneState, view: RenderView, rays: Rays, depth: Field) -> Field:
    """Share (h, w) of the key lamp's light that passes the nozzle; all of it without one."""
    if state.instant.base_from_nozzle is None:
        return np.ones_like(depth)
    nozzle_from_base = se3.inverse(state.instant.base_from_nozzle)
    nozzle_from_camera = nozzle_from_base @ view.camera.base_from_camera
    points = transform_fields(nozzle_from_camera, rays.x * depth, rays.y * depth, depth)
    return passing_light(points, nozzle_from_base @ state.scene.base_from_rest, state.lamps[0])


Place = tuple[np.float32, np.float32, np.float32]


@compiled(f"UniTuple(f4, 3)({CLOTH}, f4, f4, f4)", inlined=True)
def _above_cloth(cloth: Cloth, x: np.float32, y: np.float32, depth: np.float32) -> Place:
    """How far above the cloth the point at `depth` of a ray (x, y, 1) is, mm, and where on it: x, y mm."""
    moving, resting, bend, opening, heights = cloth
    a, b = x * depth, y * depth
    mx = moving[0, 0] * a + moving[0, 1] * b + moving[0, 2] * depth + moving[0, 3]
    my = moving[1, 0] * a + moving[1, 1] * b + moving[1, 2] * depth + moving[1, 3]
    mz = moving[2, 0] * a + moving[2, 1] * b + moving[2, 2] * depth + moving[2, 3]
    rx = resting[0, 0] * a + resting[0, 1] * b + resting[0, 2] * depth + resting[0, 3]
    ry = resting[1, 0] * a + resting[1, 1] * b + resting[1, 2] * depth + resting[1, 3]
    rz = resting[2, 0] * a + resting[2, 1] * b + resting[2, 2] * depth + resting[2, 3]
    dx, dy = abs(mx) - opening[0], abs(my) - opening[1]
    ex, ey = max(dx, NOTHING), max(dy, NOTHING)
    outside = np.sqrt(ex * ex + ey * ey) + min(max(dx, dy), NOTHING) - opening[2]  # as `opening_distance`
    t = min(max((outside - opening[3]) * opening[4], NOTHING), ONE)
    share = t * t * (np.float32(3) - np.float32(2) * t)
    mx, my = mx * bend[0], my * bend[1]
    if bend[2] != NOTHING:
        mz -= bend[2] * np.exp(bend[3] * (mx * mx + my * my))
    mx, my, mz = rx + share * (mx - rx), ry + share * (my - ry), rz + share * (mz - rz)
    per_mm = np.float32(1 / DRAPE_STEP)
    u = mx * per_mm + HALF * np.float32(heights.shape[1] - 1)
    v = my * per_mm + HALF * np.float32(heights.shape[0] - 1)
    return mz - height_at(heights, u, v), mx, my


@compiled(f"f4({CLOTH}, f4, f4, f4, f4, i8)", inlined=True)
def _first_on_cloth(
    cloth: Cloth, x: np.float32, y: np.float32, near: np.float32, far: np.float32, steps: int
) -> np.float32:
    """Depth mm at which a ray first meets the cloth, by equal steps from near to far; far where it never does."""
    step, last_gap = (far - near) / np.float32(steps), ONE
    for k in range(steps + 1):
        depth = near + step * np.float32(k)
        gap, _, _ = _above_cloth(cloth, x, y, depth)
        if gap <= NOTHING:
            return depth + step * gap / max(last_gap - gap, np.float32(1e-6))
        last_gap = gap
    return far


@compiled(f"UniTuple(f4, 3)({CLOTH}, f4, f4, f4)", inlined=True)
def _on_cloth(cloth: Cloth, x: np.float32, y: np.float32, depth: np.float32) -> Place:
    """The depth of a ray after a round of the secant method, and the cloth's x, y mm there."""
    upper_gap, _, _ = _above_cloth(cloth, x, y, depth + HALF)
    gap, _, _ = _above_cloth(cloth, x, y, depth)
    slope = np.float32(2) * (upper_gap - gap)
    if abs(slope) < np.float32(0.1):
        slope = -HALF
    depth -= min(max(gap / slope, np.float32(-15)), np.float32(15))
    _, cloth_x, cloth_y = _above_cloth(cloth, x, y, depth)
    return depth, cloth_x, cloth_y


@compiled(f"void({CLOTH}, f4[:,::1], f4[:,::1], f4[:,::1], f4[:,::1], i8, f4[:,::1])")
def _search_cloth(cloth: Cloth, x: Field, y: Field, near: Field, far: Field, steps: int, depth: Field) -> None:
    """`_first_on_cloth` of rays (H, W)."""
    for row in range(x.shape[0]):
        for column in range(x.shape[1]):
            rx, ry, low, high = x[row, column], y[row, column], near[row, column], far[row, column]
            depth[row, column] = _first_on_cloth(cloth, rx, ry, low, high, steps)


@compiled(f"void({CLOTH}, f4[:,::1], f4[:,::1], f4[:,::1], f4[::1], f4[:,::1], f4[:,::1])")
def _refine_cloth(cloth: Cloth, x: Field, y: Field, depth: Field, texels: Field, u: Field, v: Field) -> None:
    """Depth (H, W) mm of rays, refined in place, and the columns u and rows v of the cloth's picture there.

    texels: (3,) texels a mm, and the column and row in the middle.
    """
    for row in range(x.shape[0]):
        for column in range(x.shape[1]):
            rx, ry, at = x[row, column], y[row, column], depth[row, column]
            refined, cloth_x, cloth_y = _on_cloth(cloth, rx, ry, at)
            depth[row, column] = refined
            u[row, column], v[row, column] = cloth_x * texels[0] + texels[1], cloth_y * texels[0] + texels[2]


@compiled(f"void({CLOTH}, u1[:,::1], f4[:,::1], f4[:,::1], f4[:,::1], f4[:,::1], i8, f4[::1], f4[:,::1], f4[:,::1])")
def _trace_edges(
    cloth: Cloth,
    edges: Bytes,
    x: Field,
    y: Field,
    near: Field,
    far: Field,
    steps: int,
    texels: Field,
    u: Field,
    v: Field,
) -> None:
    """Trace again, one by one, the pixels of those cells (h, w) in which the cloth hides itself.

    x, y: (h, w) rays; near, far: mm of depth that hold the cloth. u, v: (H, W), as `_refine_cloth` gives them.
    """
    for j, i in np.ndindex(edges.shape):
        if not edges[j, i]:
            continue
        for row in range(j * CELL_PX, min((j + 1) * CELL_PX, u.shape[0])):
            at = (np.float32(row) + HALF) / np.float32(CELL_PX) - HALF
            for column in range(i * CELL_PX, min((i + 1) * CELL_PX, u.shape[1])):
                along = (np.float32(column) + HALF) / np.float32(CELL_PX) - HALF
                rx, ry = height_at(x, along, at), height_at(y, along, at)
                low, high = height_at(near, along, at), height_at(far, along, at)
                depth = _first_on_cloth(cloth, rx, ry, low, high, steps)
                _, cloth_x, cloth_y = _on_cloth(cloth, rx, ry, depth)
                u[row, column], v[row, column] = cloth_x * texels[0] + texels[1], cloth_y * texels[0] + texels[2]


@compiled("void(f4[::1], f4[::1], f4[::1], f4[::1])")
def _light_cloth(texture: Field, share: Field, tint: Field, light: Field) -> None:
    """The cloth's linear BGR (3 N,) of what is painted on it (4 N,): its fourth part, times the share (N,) of the key
    lamp's light and the tint BGR, is added to the others."""
    blue, green, red = tint[0], tint[1], tint[2]
    for k in range(len(share)):
        key = texture[4 * k + 3] * share[k]
        light[3 * k] = texture[4 * k] + key * blue
        light[3 * k + 1] = texture[4 * k + 1] + key * green
        light[3 * k + 2] = texture[4 * k + 2] + key * red
