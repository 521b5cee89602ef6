"""The picture of the cloth: traced on a coarse lattice, coloured at every pixel."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from estimation import se3
from estimation.se3 import Array
from hardware.simulator import cloth, nozzle_shape
from hardware.simulator.field import Field, enlarged, field, looked_up
from hardware.simulator.hits import block
from hardware.simulator.scene import drape as sheet
from hardware.simulator.scene.rays import Rays, View
from hardware.simulator.state import State, moved

LATTICE = 8  # px between the rays that are traced
STEPS = 20
SEARCH = 16  # px between the rays that are searched through all depths
LOCAL_STEPS = 8
NEARBY = np.float32(8.0)  # mm of depth by which the cloth between rays reaches beyond them
JUMP = 15.0  # mm by which the depth between two rays differs from the mean of theirs where the cloth hides itself
STRIP = 48  # rows coloured at once: their fields stay in the cache
HIGHEST = 40.0  # mm above the rest plane: nothing of the cloth is higher
DEEPEST = -130.0


@dataclass(frozen=True, slots=True, eq=False)
class ClothPicture:
    """light: (H, W, 3) linear BGR of the whole image. depth: (h, w) mm along the optical axis, LATTICE px apart."""

    light: Field
    depth: Field


@dataclass(frozen=True, slots=True, eq=False)
class _Eye:
    """A camera's rays in the moving grid frame and in the grid at rest: origin (3,) and rotation (3, 3) of each."""

    state: State
    grid_from_camera: Array
    rest_from_camera: Array

    def material(self, rays: Rays, depth: Field) -> tuple[Field, Field, Field]:
        """Where on the cloth (x, y) and how far above its plane (z), mm, (H, W) each, points at `depth` are.

        The cloth follows the body near the opening and rests far from it; between, it is a mixture of the two.
        """
        x, y, z = moved(self.grid_from_camera, rays.x * depth, rays.y * depth, depth)
        ax, ay, az = moved(self.rest_from_camera, rays.x * depth, rays.y * depth, depth)
        held = self.state.scene.sheet.held(x, y)
        flat = np.stack([x / np.float32(self.state.factors[0]), y / np.float32(self.state.factors[1])], -1)
        z = z - self.state.scene.deformation.lift(flat, self.state.instant.strain).astype(np.float32)
        x, y = flat[..., 0], flat[..., 1]
        return ax + held * (x - ax), ay + held * (y - ay), az + held * (z - az)

    def left(self, rays: Rays, depth: Field) -> tuple[Field, Field, Field]:
        """How far above the cloth points at `depth` are, mm, and where on it."""
        x, y, z = self.material(rays, depth)
        heights = self.state.scene.sheet.heights
        u = x / np.float32(sheet.STEP) + np.float32((heights.shape[1] - 1) / 2)
        v = y / np.float32(sheet.STEP) + np.float32((heights.shape[0] - 1) / 2)
        return z - looked_up(heights, u, v), x, y


def cloth_picture(state: State, view: View) -> ClothPicture:
    """The cloth as one camera sees it, the shape taken away."""
    eye = _Eye(
        state,
        se3.inverse(state.base_from_grid) @ view.camera.base_from_camera,
        se3.inverse(state.scene.base_from_rest) @ view.camera.base_from_camera,
    )
    rays = view.coarse(LATTICE)
    coarse = view.coarse(SEARCH)
    found = _search(eye, coarse, *_bounds(eye, coarse), STEPS)
    depth, x, y = _refined(eye, rays, enlarged(found, (rays.x.shape[0], rays.x.shape[1])))
    passed = _passed(eye, rays, depth)
    w, h = view.camera.size
    planes = [enlarged(plane, (view.whole.y1, view.whole.x1))[:h, :w] for plane in (*_texels(state, x, y), *passed)]
    _edges(eye, rays, depth, planes[0], planes[1])
    light = np.empty((h, w, 3), np.float32)
    for first in range(0, h, STRIP):
        rows = slice(first, first + STRIP)
        _coloured(state, [plane[rows] for plane in planes], light[rows])
    return ClothPicture(light, depth)


def _texels(state: State, x: Field, y: Field) -> tuple[Field, Field]:
    """Columns and rows (H, W) in the cloth's picture, at material x, y mm."""
    rows, columns = state.scene.sheet.picture.shape[:2]
    scale = np.float32(1 / sheet.TEXEL)
    return x * scale + np.float32((columns - 1) / 2), y * scale + np.float32((rows - 1) / 2)


def _bounds(eye: _Eye, rays: Rays) -> tuple[Field, Field]:
    """Depths (H, W) mm between which the cloth lies."""
    m = eye.rest_from_camera
    sink = np.minimum(m[2, 0] * rays.x + m[2, 1] * rays.y + m[2, 2], -0.15)
    return field((HIGHEST - m[2, 3]) / sink), field((DEEPEST - m[2, 3]) / sink)


def _search(eye: _Eye, rays: Rays, near: Field, far: Field, steps: int) -> Field:
    """Depth (H, W) mm at which rays first meet the cloth, by equal steps from near to far; far where they never do."""
    step = (far - near) / np.float32(steps)
    found, above, open_way = far, np.ones_like(near), np.ones(near.shape, bool)
    for k in range(steps + 1):
        depth = near + step * np.float32(k)
        left, _, _ = eye.left(rays, depth)
        new = (left <= 0) & open_way
        found = field(np.where(new, depth + step * left / np.maximum(above - left, 1e-6), found))
        open_way &= ~new
        above = left
    return found


def _refined(eye: _Eye, rays: Rays, depth: Field) -> tuple[Field, Field, Field]:
    """Depth and material x, y (H, W) mm after a round of the secant method."""
    left_last, _, _ = eye.left(rays, depth + np.float32(0.5))
    left, _, _ = eye.left(rays, depth)
    fall = 2 * (left_last - left)
    depth = depth - field(np.clip(left / np.where(np.abs(fall) < 0.1, np.float32(-0.5), fall), -15, 15))
    _, x, y = eye.left(rays, depth)
    return depth, x, y


def _edges(eye: _Eye, rays: Rays, depth: Field, u: Field, v: Field) -> None:
    """Trace again, one by one, the pixels where the cloth hides itself and the lattice would draw steps.

    u, v: (H, W) columns and rows in the cloth's picture, which are put right.
    """
    bend = np.array([[1.0, -2.0, 1.0]], np.float32)
    bent = np.maximum(*(np.abs(cv2.filter2D(depth, -1, k, borderType=cv2.BORDER_REPLICATE)) for k in (bend, bend.T)))
    jump = np.asarray(cv2.dilate((bent > JUMP).astype(np.uint8), np.ones((3, 3), np.uint8)), bool)
    if not jump.any():
        return
    h, w = u.shape
    place = np.nonzero(np.repeat(np.repeat(jump, LATTICE, 0), LATTICE, 1)[:h, :w])
    at = [block(((p + 0.5) / LATTICE - 0.5).astype(np.float32)) for p in place]
    alone = Rays(*(looked_up(r, at[1], at[0]) for r in rays))
    around = np.ones((5, 5), np.uint8)
    near, far = (looked_up(field(f(depth, around)), at[1], at[0]) for f in (cv2.erode, cv2.dilate))
    _, x, y = _refined(eye, alone, _search(eye, alone, near - NEARBY, far + NEARBY, LOCAL_STEPS))
    for into, right in zip((u, v), _texels(eye.state, x, y), strict=True):
        into[place] = right.reshape(-1)[: len(place[0])]


def _passed(eye: _Eye, rays: Rays, depth: Field) -> list[Field]:
    """The share (H, W) of the key lamp's light that passes the nozzle; none where there is no nozzle."""
    state = eye.state
    if state.instant.base_from_nozzle is None:
        return []
    nozzle_from_base = se3.inverse(state.instant.base_from_nozzle)
    nozzle_from_camera = nozzle_from_base @ state.base_from_grid @ eye.grid_from_camera
    points = moved(nozzle_from_camera, rays.x * depth, rays.y * depth, depth)
    nozzle_from_rest = nozzle_from_base @ state.scene.base_from_rest
    return [nozzle_shape.lit(points, nozzle_from_rest, state.lamps[0])]


def _coloured(state: State, planes: list[Field], light: Field) -> None:
    """Fill in linear BGR (H, W, 3) of the cloth; planes: columns, rows, and the share of the key lamp's light there."""
    u, v, *passed = planes
    border = cv2.BORDER_REFLECT_101
    found = field(cv2.remap(state.scene.sheet.picture, u, v, cv2.INTER_LINEAR, borderMode=border))
    if passed:
        found[..., 3] *= passed[0]
    tint = cloth.TEAL * np.array(state.lamps[0].colour, np.float32)
    cv2.transform(found, np.column_stack([np.eye(3, dtype=np.float32), tint]), light)
