"""The shape of the body: a height field over a plane, exact between its nodes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import distance_transform_edt

from estimation import se3
from estimation.errors import InputError
from estimation.ray_cast import cast
from estimation.scan import Scan, face_areas, face_normals, scan_from_triangles
from estimation.se3 import Array

STEP = 0.25  # mm between nodes: a wound's rim rises over 2 mm
LEAST_FACING = 0.1  # mean of a scan's normals by area: a closed body's is 0, and no plane is its mean plane
FAR = 1e7  # mm: rays from there are parallel to 1e-5 rad over a body, 0.1 um across a scan


@dataclass(frozen=True, slots=True, eq=False)
class Shape:
    """Heights over a rectangle, bilinear between nodes: z = Z(x, y) in the grid frame, z out of the surface.

    Material points are named by (x, y) mm in the grid frame, whose origin is the middle of the rectangle. step: mm
    between nodes. heights: (H, W) mm, rows along y. surface_from_grid: (4, 4), the identity unless the surface frame
    is a scan's own. inside: (H, W) mm into the wound from its edge, negative outside; None: no wound.
    valid: (H, W) whether there is a surface; heights under False are those of the nearest True.
    """

    step: float
    heights: Array
    surface_from_grid: Array = field(default_factory=lambda: np.eye(4))
    inside: Array | None = None
    valid: NDArray[np.bool_] | None = None

    @property
    def size(self) -> tuple[float, float]:
        """Sides (x, y) of the rectangle, mm; it reaches from minus half to plus half."""
        rows, columns = self.heights.shape
        return (columns - 1) * self.step, (rows - 1) * self.step

    def heights_at(self, xy: ArrayLike) -> Array:
        """Z (N,) mm at material points (N, 2) mm; beyond the rectangle as at its edge."""
        return _bilinear(self, self._nodes(xy))[0]

    def points(self, xy: ArrayLike) -> Array:
        """Points (N, 3) mm, surface frame, at material points (N, 2) mm."""
        xy = np.asarray(xy, float).reshape(-1, 2)
        return se3.transform_points(self.surface_from_grid, np.column_stack([xy, self.heights_at(xy)]))

    def normals(self, xy: ArrayLike) -> Array:
        """Unit normals (N, 3), surface frame, out of the surface, at material points (N, 2) mm."""
        _, across, along = _bilinear(self, self._nodes(xy))
        up = np.column_stack([-across, -along, np.ones(len(across))])
        return np.asarray(up / np.linalg.norm(up, axis=1, keepdims=True) @ self.surface_from_grid[:3, :3].T)

    def material(self, points_surface: ArrayLike) -> Array:
        """Material points (N, 2) mm straight above or below points (N, 3), surface frame."""
        return np.asarray(se3.transform_points(se3.inverse(self.surface_from_grid), points_surface)[:, :2])

    def covers(self, xy: ArrayLike) -> NDArray[np.bool_]:
        """Whether (N,) there is a surface at material points (N, 2) mm: on the rectangle, and in no hole."""
        xy = np.asarray(xy, float).reshape(-1, 2)
        on = (np.abs(xy) <= np.array(self.size) / 2 + 1e-6).all(axis=1)
        if self.valid is None:
            return np.asarray(on)
        x, y = np.rint(self._nodes(xy)).astype(int).T
        return np.asarray(on & self.valid[y, x])

    def grid(self, step: float, part: float = 1.0) -> Array:
        """Material points (N, 2) mm, row by row, over the central `part` of the rectangle, about `step` mm apart."""
        x, y = (np.linspace(-0.5, 0.5, max(1, round(part * s / step)) + 1) * part * s for s in self.size)
        return np.stack(np.meshgrid(x, y), -1).reshape(-1, 2)

    def mesh(self, step: float = 1.0) -> tuple[Array, NDArray[np.int64]]:
        """Vertices (V, 3) mm, surface frame, `step` mm apart, and triangles (T, 3), anticlockwise from outside."""
        flat = self.grid(step)
        columns = int(np.flatnonzero(np.diff(flat[:, 1]))[0]) + 1
        corner = np.arange(len(flat)).reshape(-1, columns)
        a, b, c, d = (m.ravel() for m in (corner[:-1, :-1], corner[:-1, 1:], corner[1:, 1:], corner[1:, :-1]))
        triangles = np.concatenate([np.column_stack([a, b, c]), np.column_stack([a, c, d])])
        if self.valid is not None:
            x, y = np.rint(self._nodes(flat)).astype(int).T
            triangles = triangles[self.valid[y, x][triangles].all(1)]
        return self.points(flat), triangles

    def _nodes(self, xy: ArrayLike) -> Array:
        """Material points (N, 2) in nodes from the first one, kept on the rectangle."""
        nodes = np.asarray(xy, float).reshape(-1, 2) / self.step + (np.array(self.heights.shape[::-1]) - 1) / 2
        return np.clip(nodes, 0, np.array(self.heights.shape[::-1]) - 1)


def _bilinear(shape: Shape, nodes: Array) -> tuple[Array, Array, Array]:
    """Height and slopes along x and y, (N,) each, at (N, 2) in nodes."""
    x, y = np.minimum(nodes.astype(int), np.array(shape.heights.shape[::-1]) - 2).T
    u, v = nodes[:, 0] - x, nodes[:, 1] - y
    a, b = shape.heights[y, x], shape.heights[y, x + 1]
    c, d = shape.heights[y + 1, x], shape.heights[y + 1, x + 1]
    top, bottom = a + u * (b - a), c + u * (d - c)
    across = ((b - a) + v * ((d - c) - (b - a))) / shape.step
    return top + v * (bottom - top), across, (bottom - top) / shape.step


def shape_from_function(
    height: Callable[[Array, Array], Array], size: tuple[float, float], step: float = STEP
) -> Shape:
    """The shape z = height(x, y), mm, over `size` (x, y) mm, rounded up to whole steps; the law holds at the nodes."""
    columns, rows = (int(np.ceil(s / step - 1e-9)) + 1 for s in size)
    x, y = (np.arange(n) * step - (n - 1) * step / 2 for n in (columns, rows))
    heights = np.asarray(height(*np.meshgrid(x, y)), float)
    return Shape(step, np.broadcast_to(heights, (rows, columns)).copy())


def flat(size: tuple[float, float], step: float = 1.0) -> Shape:
    """A flat rectangle of `size` (x, y) mm."""
    return shape_from_function(lambda x, y: np.zeros_like(x), size, step)


def cylinder(size: tuple[float, float], radius: float, step: float = STEP) -> Shape:
    """A rectangle of `size` (x, y) mm, as seen from above, bent about its x axis to `radius` mm."""
    return shape_from_function(lambda x, y: np.sqrt(radius**2 - y**2) - radius, size, step)


def shape_from_scan(vertices: ArrayLike, triangles: ArrayLike, step: float = STEP) -> Shape:
    """The shape of a scan, vertices (V, 3) mm and triangles (T, 3) anticlockwise from outside, in the scan's own frame.

    The grid lies in the mean plane of the triangles (their normals' mean, weighted by area), its origin at their mean.
    Each node takes the outermost height above it, so that what an overhang hides is left out; nodes over holes and
    beyond the rim are not `valid` and are not drawn. InputError for a body that is closed: it faces no way.
    """
    scan = scan_from_triangles(vertices, triangles)
    surface_from_grid = _mean_plane(scan)
    seen = se3.transform_points(se3.inverse(surface_from_grid), scan.vertices)
    half = np.abs(seen[:, :2]).max(0)
    columns, rows = (int(np.ceil(2 * h / step - 1e-9)) + 1 for h in half)
    x, y = (np.arange(n) * step - (n - 1) * step / 2 for n in (columns, rows))
    nodes = np.stack(np.meshgrid(x, y), -1).reshape(-1, 2)
    apex = np.array([0.0, 0.0, FAR])
    directions = np.column_stack([nodes, np.full(len(nodes), 0.0)]) - apex
    grid_from_apex = se3.make(np.eye(3), apex)
    local = Scan(seen, scan.triangles, scan.normals)
    hits = cast(local, grid_from_apex, directions / FAR)
    heights = hits.points[:, 2].reshape(rows, columns)
    valid = hits.hit.reshape(rows, columns)
    nearest = distance_transform_edt(~valid, return_distances=False, return_indices=True)
    return Shape(step, heights[tuple(nearest)], surface_from_grid, valid=valid)


def _mean_plane(scan: Scan) -> Array:
    """surface_from_grid (4, 4): z along the mean normal, the sides of the least rectangle round the scan along x and y.

    Of the four ways to lay them, x is the one nearest to the scan's own x (its y where that stands upright).
    """
    areas = face_areas(scan)
    z = areas @ face_normals(scan) / areas.sum()
    facing = float(np.linalg.norm(z))
    if facing < LEAST_FACING:
        allowed = f"{LEAST_FACING:g} or more: a surface seen from one side, no closed body"
        raise InputError("scan", "length of its mean normal", f"{facing:.2g}", allowed)
    z /= facing
    x = np.eye(3)[0 if abs(z[0]) < 0.9 else 1]
    x = x - (x @ z) * z
    x /= np.linalg.norm(x)
    rotation = np.column_stack([x, np.cross(z, x), z])
    flattened = (scan.vertices @ rotation[:, :2]).astype(np.float32)
    turn = np.deg2rad((cv2.minAreaRect(flattened)[2] + 45) % 90 - 45)
    rotation = rotation @ se3.exp_rotation([0.0, 0.0, turn])
    seen = scan.vertices @ rotation  # grid axes, the scan's origin
    middle = (seen.min(0) + seen.max(0)) / 2
    middle[2] = areas @ (scan.corners.mean(1) @ rotation[:, 2]) / areas.sum()
    return se3.make(rotation, rotation @ middle)
