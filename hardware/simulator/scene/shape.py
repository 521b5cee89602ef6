"""The shape of the body: a height field over a plane, its deformation, and parametric bodies with a wound."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import distance_transform_edt

from estimation import se3
from estimation.errors import InputError
from estimation.scans.scan import Scan, cast_rays, face_areas, face_normals, scan_from_triangles
from estimation.se3 import Array
from hardware.process import checks
from hardware.simulator.scene.fields import smooth_noise

NODE_STEP = 0.25  # mm between nodes: a wound's rim rises over 2 mm
MIN_FACING = 0.1  # length of a scan's mean normal by area: a closed body's is 0, without a mean plane
CAST_HEIGHT = 1.0  # mm over the highest point, origin of rays cast down


@dataclass(frozen=True, slots=True, eq=False)
class Shape:
    """Heights over a rectangle, bilinear between nodes: z = Z(x, y) in the grid frame, z out of the surface.

    Material points are (x, y) mm in the grid frame, whose origin is the middle of the rectangle.
    """

    step: float  # mm between nodes
    heights: Array  # (H, W) mm, rows along y
    surface_from_grid: Array = field(default_factory=lambda: np.eye(4))  # (4, 4), the identity but for scans
    inside: Array | None = None  # (H, W) mm into the wound from its edge, negative outside; None: no wound
    valid: NDArray[np.bool_] | None = None  # (H, W) surface or hole; a hole has the height of the nearest node

    @property
    def size(self) -> tuple[float, float]:
        """Sides (x, y) of the rectangle, mm; it reaches from minus half to plus half."""
        rows, columns = self.heights.shape
        return (columns - 1) * self.step, (rows - 1) * self.step

    def heights_at(self, xy: ArrayLike) -> Array:
        """Z (N,) mm at material points (N, 2) mm; constant beyond the rectangle's edge."""
        return _bilinear(self, self.nodes(xy))[0]

    def points(self, xy: ArrayLike) -> Array:
        """Points (N, 3) mm, surface frame, at material points (N, 2) mm."""
        xy = np.asarray(xy, float).reshape(-1, 2)
        return se3.transform_points(self.surface_from_grid, np.column_stack([xy, self.heights_at(xy)]))

    def normals(self, xy: ArrayLike) -> Array:
        """Unit normals (N, 3), surface frame, out of the surface, at material points (N, 2) mm."""
        _, across, along = _bilinear(self, self.nodes(xy))
        up = np.column_stack([-across, -along, np.ones(len(across))])
        return np.asarray(up / np.linalg.norm(up, axis=1, keepdims=True) @ self.surface_from_grid[:3, :3].T)

    def material(self, points_surface: ArrayLike) -> Array:
        """Material points (N, 2) mm straight above or below points (N, 3), surface frame."""
        return np.asarray(se3.transform_points(se3.inverse(self.surface_from_grid), points_surface)[:, :2])

    def covers(self, xy: ArrayLike) -> NDArray[np.bool_]:
        """Whether (N,) material points (N, 2) mm are on the surface: on the rectangle, and in no hole."""
        xy = np.asarray(xy, float).reshape(-1, 2)
        inside = (np.abs(xy) <= np.array(self.size) / 2 + 1e-6).all(axis=1)
        if self.valid is None:
            return np.asarray(inside)
        x, y = np.rint(self.nodes(xy)).astype(int).T
        return np.asarray(inside & self.valid[y, x])

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
            x, y = np.rint(self.nodes(flat)).astype(int).T
            triangles = triangles[self.valid[y, x][triangles].all(1)]
        return self.points(flat), triangles

    def nodes(self, xy: ArrayLike) -> Array:
        """Material points (N, 2) in nodes from the first one, clipped to the rectangle."""
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
    height: Callable[[Array, Array], Array], size: tuple[float, float], step: float = NODE_STEP
) -> Shape:
    """The shape z = height(x, y), mm, over `size` (x, y) mm, rounded up to whole steps; exact at the nodes."""
    columns, rows = (int(np.ceil(s / step - 1e-9)) + 1 for s in size)
    x, y = (np.arange(n) * step - (n - 1) * step / 2 for n in (columns, rows))
    heights = np.asarray(height(*np.meshgrid(x, y)), float)
    return Shape(step, np.broadcast_to(heights, (rows, columns)).copy())


def flat(size: tuple[float, float], step: float = 1.0) -> Shape:
    """A flat rectangle of `size` (x, y) mm."""
    return shape_from_function(lambda x, y: np.zeros_like(x), size, step)


def cylinder(size: tuple[float, float], radius: float, step: float = NODE_STEP) -> Shape:
    """A rectangle of `size` (x, y) mm, as seen from above, bent about its x axis to `radius` mm."""
    return shape_from_function(lambda x, y: np.sqrt(radius**2 - y**2) - radius, size, step)


def shape_from_scan(vertices: ArrayLike, triangles: ArrayLike, step: float = NODE_STEP) -> Shape:
    """The shape of a scan, vertices (V, 3) mm and triangles (T, 3) anticlockwise from outside, in the scan's own frame.

    The grid lies in the mean plane of the triangles (their normals' mean, weighted by area), its origin at their mean.
    Each node has the outermost height, so the surface under an overhang is omitted; nodes over holes and beyond the rim
    are not `valid` and are not drawn. InputError for a closed body.
    """
    scan = scan_from_triangles(vertices, triangles)
    surface_from_grid = _mean_plane(scan)
    vertices_grid = se3.transform_points(se3.inverse(surface_from_grid), scan.vertices)
    half = np.abs(vertices_grid[:, :2]).max(0)
    columns, rows = (int(np.ceil(2 * h / step - 1e-9)) + 1 for h in half)
    x, y = (np.arange(n) * step - (n - 1) * step / 2 for n in (columns, rows))
    nodes = np.stack(np.meshgrid(x, y), -1).reshape(-1, 2)
    above = np.column_stack([nodes, np.full(len(nodes), vertices_grid[:, 2].max() + CAST_HEIGHT)])
    scan_grid = Scan(vertices_grid, scan.triangles, scan.normals)
    hits = cast_rays(scan_grid, above, np.broadcast_to([0.0, 0.0, -1.0], above.shape))
    heights, valid = hits.points[:, 2].reshape(rows, columns), hits.hit.reshape(rows, columns)
    nearest = distance_transform_edt(~valid, return_distances=False, return_indices=True)
    return Shape(step, heights[tuple(nearest)], surface_from_grid, valid=valid)


def _mean_plane(scan: Scan) -> Array:
    """surface_from_grid (4, 4): z along the mean normal, the sides of the least rectangle round the scan along x and y.

    Of the four such axes, x is the one nearest to the scan's own x (to its y where x is along z).
    """
    areas = face_areas(scan)
    z = areas @ face_normals(scan) / areas.sum()
    facing = float(np.linalg.norm(z))
    if facing < MIN_FACING:
        allowed = f"{MIN_FACING:g} or more: a surface seen from one side, no closed body"
        raise InputError("scan", "length of its mean normal", f"{facing:.2g}", allowed)
    z /= facing
    x = np.eye(3)[0 if abs(z[0]) < 0.9 else 1]
    x = x - (x @ z) * z
    x /= np.linalg.norm(x)
    rotation = np.column_stack([x, np.cross(z, x), z])
    flattened = (scan.vertices @ rotation[:, :2]).astype(np.float32)
    turn = np.deg2rad((cv2.minAreaRect(flattened)[2] + 45) % 90 - 45)
    rotation = rotation @ se3.exp_rotation([0.0, 0.0, turn])
    rotated = scan.vertices @ rotation  # grid axes, the scan's origin
    middle = (rotated.min(0) + rotated.max(0)) / 2
    middle[2] = areas @ (scan.corners.mean(1) @ rotation[:, 2]) / areas.sum()
    return se3.make(rotation, rotation @ middle)


STRETCH_RANGE = (-0.3, 0.5)  # beyond, skin tears
MAX_BULGE = 30.0  # mm
BULGE_RADIUS_RANGE = (5.0, 500.0)  # mm


@dataclass(frozen=True, slots=True)
class Deformation:
    """A stretch and a Gaussian bulge out of the surface, in the shape's grid frame, at amount 1."""

    stretch: tuple[float, float] = (0.0, 0.0)  # (x, y), share of each length, about the origin
    bulge: float = 0.0  # mm at the origin
    radius: float = 40.0  # mm, one sigma, in material coordinates

    def __post_init__(self) -> None:
        for value in self.stretch:
            if not STRETCH_RANGE[0] <= value <= STRETCH_RANGE[1]:
                allowed = f"{STRETCH_RANGE[0]} to {STRETCH_RANGE[1]}, a share of length"
                raise InputError("deformation", "stretch", value, allowed)
        checks.within(-MAX_BULGE, MAX_BULGE, "mm")("deformation", "bulge", self.bulge)
        checks.within(*BULGE_RADIUS_RANGE, "mm")("deformation", "radius", self.radius)

    def factors(self, amount: float) -> tuple[float, float]:
        """Factors of lengths along x and y."""
        return 1 + amount * self.stretch[0], 1 + amount * self.stretch[1]

    def lift(self, xy: ArrayLike, amount: float | Array) -> Array:
        """Height of the bulge (N,), mm, at material points (N, 2) mm; amount: one, or (N,)."""
        square = np.einsum("...i,...i->...", np.asarray(xy, float), np.asarray(xy, float))
        return np.asarray(amount * self.bulge * np.exp(-square / (2 * self.radius**2)))

    def displacement(self, points: ArrayLike, amount: float | Array) -> Array:
        """Displacement (N, 3) mm of points (N, 3) mm of the shape at rest, in the grid frame; amount: one, or (N,)."""
        points = np.asarray(points, float)
        along = np.asarray(amount)[..., None] * points[..., :2] * np.array(self.stretch)
        return np.concatenate([along, self.lift(points[..., :2], amount)[..., None]], -1)

    def undo(self, points: ArrayLike, amount: float | Array) -> Array:
        """Places at rest (N, 3) mm of points (N, 3) mm of the deformed shape, grid frame; amount: one, or (N,)."""
        points = np.asarray(points, float)
        flat = points[..., :2] / (1 + np.asarray(amount)[..., None] * np.array(self.stretch))
        return np.concatenate([flat, (points[..., 2] - self.lift(flat, amount))[..., None]], -1)


DRAPE_MARGIN = 9.0  # mm of body under the drape on every side of the opening


@dataclass(frozen=True, slots=True)
class Wound:
    """A wound about the origin."""

    size: tuple[float, float] = (42.0, 31.0)  # (x, y) mm of its irregular outline
    depth: float = 2.4  # mm of its bed below the skin


def forearm(x: Array, y: Array) -> Array:
    """Heights of a cylinder along x that tapers from 50 to 45 mm, its muscle bulging on one side."""
    radius = 47.5 - 0.022 * x
    return np.asarray(_arch(y, radius) + 0.022 * x + 1.1 * np.exp(-(((x + 40) / 35) ** 2) - ((y - 14) / 18) ** 2))


def chest(x: Array, y: Array) -> Array:
    """Heights of a broad, gently vaulted wall with the swell of ribs under it."""
    ribs = 0.35 * np.sin(2 * np.pi * (y + 0.25 * x) / 34.0)
    return np.asarray(_arch(y, 190.0) + _arch(x, 260.0) + ribs)


def foot(x: Array, y: Array) -> Array:
    """Heights of an instep: strongly curved across, hollow along, with a tendon."""
    tendon = 0.9 * np.exp(-(((y - 18 - 0.2 * x) / 4.5) ** 2))
    return np.asarray(_arch(y, 52.0) + 0.0016 * x**2 - 0.05 * x + 0.0005 * x * y + tendon)


BODIES: dict[str, tuple[Callable[[Array, Array], Array], tuple[float, float]]] = {
    "forearm": (forearm, (120.0, 62.0)),
    "chest": (chest, (120.0, 90.0)),
    "foot": (foot, (110.0, 74.0)),
}  # height and opening (x, y) mm of each


def body(kind: str, wound: Wound | None, seed: int, step: float = NODE_STEP) -> Shape:
    """The shape of `kind` (a key of BODIES) with a wound at the origin, where the skin has z = 0."""
    height, opening = BODIES[kind]
    rng = np.random.default_rng([seed, 21])
    bare = shape_from_function(height, (opening[0] + 2 * DRAPE_MARGIN, opening[1] + 2 * DRAPE_MARGIN), step)
    grid = bare.heights.shape
    heights = bare.heights - bare.heights_at([[0.0, 0.0]])
    heights += 0.22 * smooth_noise(grid, 26 / step, rng) + 0.05 * smooth_noise(grid, 7 / step, rng)
    if wound is None:
        return Shape(step, heights)
    inside = wound_distance(grid, step, wound, rng)
    heights += _wound_relief(inside, step, wound, rng)
    return Shape(step, heights, inside=inside)


def with_wound(shape: Shape, wound: Wound, seed: int) -> Shape:
    """The shape with a wound in the textures alone at its middle: a scan has its own relief."""
    inside = wound_distance(shape.heights.shape, shape.step, wound, np.random.default_rng([seed, 21]))
    return Shape(shape.step, shape.heights, shape.surface_from_grid, inside, shape.valid)


def wound_distance(grid: tuple[int, int], step: float, wound: Wound, rng: np.random.Generator) -> Array:
    """Approximate distance inside the wound's edge, (H, W) mm, of each node; an irregular oval of the wound's size."""
    rows, columns = grid
    x, y = np.meshgrid((np.arange(columns) - (columns - 1) / 2) * step, (np.arange(rows) - (rows - 1) / 2) * step)
    half = np.array(wound.size) / 2
    x = x + 0.05 * half[0] * smooth_noise(grid, 9 / step, rng)
    y = y + 0.05 * half[1] * smooth_noise(grid, 9 / step, rng)
    angle, edge = np.arctan2(y / half[1], x / half[0]), np.ones(grid)
    for k in range(2, 8):
        edge += rng.normal(0, 0.13 / k) * np.cos(k * angle + rng.uniform(0, 2 * np.pi))
    radius = np.hypot(x / half[0], y / half[1])
    return np.asarray((edge - radius) * half.min() + 0.12 * smooth_noise(grid, 1.6 / step, rng))


def _wound_relief(inside: Array, step: float, wound: Wound, rng: np.random.Generator) -> Array:
    wall = 0.9 * wound.depth  # mm wide, so that its slope stays below 1
    t = np.clip((inside + 0.25 * wall) / (1.6 * wall), 0, 1)
    depth_share = t * t * (3 - 2 * t)
    bed_noise = 0.22 * smooth_noise(inside.shape, 9 / step, rng) + 0.1 * smooth_noise(inside.shape, 3 / step, rng)
    bed = wound.depth * (0.82 + 0.18 * np.clip(inside / 8, 0, 1) + np.clip(bed_noise, -0.5, 0.5))
    rim = 0.45 * np.exp(-(((inside + 2.2) / 1.9) ** 2))
    return np.asarray(cv2.GaussianBlur(rim - depth_share * bed, (0, 0), 0.35 / step))


def _arch(y: Array, radius: Array | float) -> Array:
    """Heights of a circle's top, continued straight from slope 0.85: steeper parts are not visible."""
    edge = radius * 0.85 / np.hypot(1, 0.85)
    near = np.clip(y, -edge, edge)
    return np.asarray(np.sqrt(radius**2 - near**2) - radius - 0.85 * (np.abs(y) - np.abs(near)))
