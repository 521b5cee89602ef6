"""A regular grid over a plane: interpolation, rasterised triangles, contours, the chart of a surface, a scan's heights.

Contours are found by marching triangles, which have no ambiguous case. The chart is the plane stretched to the length
of the skin, so that beads side by side in it lie side by side on the limb: lengths are summed along x and y from the
middle of the wound. A cylinder along either axis is unrolled exactly; on any other surface areas are right to the
second order of the slope.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import shapely
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import binary_erosion, binary_fill_holes, distance_transform_edt, gaussian_filter, map_coordinates
from shapely import MultiPolygon

from estimation import se3
from estimation.scans.scan import Scan
from estimation.se3 import Array

Index = NDArray[np.int64]
Mask = NDArray[np.bool_]
MAX_CANDIDATES = 2_000_000  # nodes tried against triangles at once: 100 MB
ZERO_BAND = 1e-9  # values nearer to 0 than this are moved off it, so that no crossing falls on a node
NEWTON_STEPS = 8  # of Newton's method, each at least halving the error where the skin slopes by less than 60 degrees
MAX_SLOPE = 1.5  # slope, 56 degrees: of skin; beyond, it is the edge of a scan


@dataclass(frozen=True, slots=True, eq=False)
class Grid:
    """Nodes of a square lattice."""

    step: float  # mm
    origin: Array  # (2,) mm, x and y of node (0, 0)
    shape: tuple[int, int]  # (H, W), rows along y

    @property
    def x(self) -> Array:
        """(W,) mm."""
        return np.asarray(self.origin[0] + self.step * np.arange(self.shape[1]))

    @property
    def y(self) -> Array:
        """(H,) mm."""
        return np.asarray(self.origin[1] + self.step * np.arange(self.shape[0]))

    @property
    def nodes(self) -> Array:
        """(H, W, 2) mm."""
        return np.stack(np.meshgrid(self.x, self.y), axis=-1)

    def coarser(self, step: float) -> Grid:
        """A grid over the same rectangle with nodes at least `step` apart, its last ones inside or on the edge."""
        shape = tuple(int((n - 1) * self.step / step + 1e-9) + 1 for n in self.shape)
        return Grid(step, self.origin, (shape[0], shape[1]))


def grid_over(low: ArrayLike, high: ArrayLike, step: float) -> Grid:
    """The grid from `low` (2,) to at least `high` (2,), mm."""
    low, high = np.asarray(low, float), np.asarray(high, float)
    columns, rows = (int(np.ceil(s / step - 1e-9)) + 1 for s in high - low)
    return Grid(step, low, (rows, columns))


def interpolate(grid: Grid, values: Array, xy: ArrayLike) -> Array:
    """Values (N,) or (N, K) at points (N, 2) mm, bilinear between nodes (H, W) or (H, W, K), beside as at the edge."""
    rows, columns = grid.shape
    u = (np.asarray(xy, float) - grid.origin) / grid.step
    x, y = np.clip(u[:, 0], 0, columns - 1), np.clip(u[:, 1], 0, rows - 1)
    i, j = np.minimum(x.astype(np.int64), columns - 2), np.minimum(y.astype(np.int64), rows - 2)
    s, t = (x - i)[:, None], (y - j)[:, None]
    flat, k = np.asarray(values, float).reshape(rows * columns, -1), j * columns + i

    def mixed(a: Array, b: Array, share: Array) -> Array:  # in place: half the time of a sum of products
        b -= a
        b *= share
        b += a
        return b

    low, high = (mixed(flat.take(k + d, axis=0), flat.take(k + d + 1, axis=0), s) for d in (0, columns))
    return np.asarray(mixed(low, high, t)).reshape(-1, *values.shape[2:])


def gradient(grid: Grid, values: Array) -> Array:
    """Slopes (H, W, 2) along x and y of values (H, W)."""
    along_y, along_x = np.gradient(values, grid.step)
    return np.stack([along_x, along_y], axis=-1)


def smoothed(grid: Grid, values: Array, radius: float, valid: Mask | None = None) -> Array:
    """Values (H, W) averaged by a Gaussian of `radius` mm over the valid nodes; the others are kept as they are."""
    if radius <= 0:
        return values
    sigma = radius / grid.step
    if valid is None or valid.all():
        return np.asarray(gaussian_filter(values, sigma, mode="nearest"))
    weight = gaussian_filter(valid.astype(float), sigma, mode="nearest")
    total = gaussian_filter(np.where(valid, values, 0.0), sigma, mode="nearest")
    return np.where(valid, total / np.maximum(weight, 1e-9), values)


def filled(values: Array, valid: Mask) -> Array:
    """Values (H, W) whose nodes that are not valid carry those of the nearest valid one."""
    nearest = distance_transform_edt(~valid, return_distances=False, return_indices=True)
    return np.asarray(values[tuple(nearest)])


def topmost(points: Array, triangles: Index, grid: Grid) -> Array:
    """Height (H, W) of the topmost of triangles (T, 3) of points (V, 3) over each node; -inf where there is none."""
    heights = np.full(grid.shape[0] * grid.shape[1], -np.inf)
    corners = points[triangles]
    corners = corners[np.isfinite(corners).all(axis=(1, 2))]
    u = (corners[..., :2] - grid.origin) / grid.step  # (T, 3, 2) in nodes
    low = np.maximum(np.ceil(u.min(axis=1) - 1e-9), 0).astype(np.int64)
    high = np.minimum(np.floor(u.max(axis=1) + 1e-9), np.array(grid.shape[::-1]) - 1).astype(np.int64)
    counts = np.prod(np.maximum(high - low + 1, 0), axis=1)
    keep = np.flatnonzero(counts)
    total = np.cumsum(counts[keep])
    cuts = np.searchsorted(total, np.arange(MAX_CANDIDATES, total[-1] if len(total) else 0, MAX_CANDIDATES))
    for part in np.split(keep, cuts):
        _raise(heights, u[part], corners[part, :, 2], low[part], high[part], counts[part], grid.shape[1])
    return heights.reshape(grid.shape)


def _raise(heights: Array, u: Array, z: Array, low: Index, high: Index, counts: Index, columns: int) -> None:
    """Raise `heights` (H * W,) to triangles u (T, 3, 2) in nodes, z (T, 3), in their boxes from low to high (T, 2)."""
    which = np.repeat(np.arange(len(u)), counts)
    k = np.arange(len(which)) - np.repeat(np.cumsum(counts) - counts, counts)
    wide = (high - low)[which, 0] + 1
    x, y = low[which, 0] + k % wide, low[which, 1] + k // wide
    a, b, c = u[:, 0], u[:, 1], u[:, 2]
    det = (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (c[:, 0] - a[:, 0]) * (b[:, 1] - a[:, 1])
    det = np.where(np.abs(det) > 1e-9, det, np.nan)  # upright triangles are seen as lines
    dx, dy = x - a[which, 0], y - a[which, 1]
    s = (dx * (c - a)[which, 1] - dy * (c - a)[which, 0]) / det[which]
    t = (dy * (b - a)[which, 0] - dx * (b - a)[which, 1]) / det[which]
    inside = (s >= -1e-9) & (t >= -1e-9) & (s + t <= 1 + 1e-9)
    w, s, t = which[inside], s[inside], t[inside]
    height = z[w, 0] + s * (z[w, 1] - z[w, 0]) + t * (z[w, 2] - z[w, 0])
    np.maximum.at(heights, y[inside] * columns + x[inside], height)


def positive_region(grid: Grid, values: Array, least: float, slack: float) -> MultiPolygon:
    """Where values (H, W), linear between nodes, are positive, in mm.

    least: mm^2, smaller pieces and holes are left out. slack: mm that the outline may be moved to make it simple.
    """
    rings = [ring for ring in _rings(grid, values) if abs(_area(ring)) >= least]
    if not rings:
        return MultiPolygon()
    closed = [shapely.linestrings(np.concatenate([ring, ring[:1]])) for ring in rings]
    polygons = shapely.build_area(shapely.multilinestrings(closed))
    return as_multi(shapely.make_valid(shapely.simplify(polygons, slack)), least)


def as_multi(shape: shapely.Geometry, least: float = 0.0) -> MultiPolygon:
    """The polygons of any shape that are at least `least` mm^2 large, the largest first."""
    parts = [p for p in shapely.get_parts(shapely.get_parts(shape)) if isinstance(p, shapely.Polygon)]
    parts = [p for p in parts if not p.is_empty and p.area >= least]
    return MultiPolygon(sorted(parts, key=lambda p: (-p.area, p.bounds)))


def _area(ring: Array) -> float:
    x, y = ring.T
    return float(np.sum(x * np.roll(y, -1) - y * np.roll(x, -1)) / 2)


def _rings(grid: Grid, values: Array) -> list[Array]:
    """Closed rings (N, 2), mm, with the positive side on their left."""
    f = np.pad(np.asarray(values, float), 1, constant_values=-1.0)
    f = np.where(np.abs(f) < ZERO_BAND, -ZERO_BAND, f)
    starts, ends = _segments(f)
    columns = f.shape[1]
    order = np.argsort(starts)
    keys = starts[order]  # each edge is left once
    following = np.searchsorted(keys, ends[order])
    places = grid.origin + (_crossings(f, keys, columns) - 1) * grid.step
    return [places[loop] for loop in _loops(following)]


def _segments(f: Array) -> tuple[Index, Index]:
    """Lines across the triangles of the grid: the edges, by number, where each enters and leaves."""
    number = np.arange(f.size).reshape(f.shape)
    inside = f > 0
    mixed = inside[:-1, :-1] != inside[:-1, 1:]
    mixed |= (inside[:-1, :-1] != inside[1:, 1:]) | (inside[:-1, :-1] != inside[1:, :-1])
    a, b, c, d = (n[mixed] for n in (number[:-1, :-1], number[:-1, 1:], number[1:, 1:], number[1:, :-1]))
    corners = np.concatenate([np.column_stack([a, b, c]), np.column_stack([a, c, d])])
    flags = inside.ravel()[corners]
    count = flags.sum(axis=1)
    crossed = (count == 1) | (count == 2)
    corners, flags, count = corners[crossed], flags[crossed], count[crossed]
    odd = np.argmax(flags == (count == 1)[:, None], axis=1)
    rows = np.arange(len(corners))
    p, q, r = (corners[rows, (odd + k) % 3] for k in range(3))
    one, two = _edge(p, q, f.size), _edge(r, p, f.size)
    lone_inside = count == 1
    return np.where(lone_inside, one, two), np.where(lone_inside, two, one)


def _edge(a: Index, b: Index, size: int) -> Index:
    return np.asarray(np.minimum(a, b) * size + np.maximum(a, b))


def _crossings(f: Array, keys: Index, columns: int) -> Array:
    """Points (N, 2), in nodes, where f is zero on edges."""
    low, high = keys // f.size, keys % f.size
    flat = f.ravel()
    t = flat[low] / (flat[low] - flat[high])
    x = low % columns + t * (high % columns - low % columns)
    y = low // columns + t * (high // columns - low // columns)
    return np.column_stack([x, y])


def _loops(following: Index) -> list[Index]:
    """The cycles of a permutation."""
    todo, successors = np.ones(len(following), bool), following.tolist()
    loops = []
    for start in range(len(successors)):
        if not todo[start]:
            continue
        loop, k = list[int](), start
        while todo[k]:
            todo[k] = False
            loop.append(k)
            k = successors[k]
        loops.append(np.array(loop))
    return loops


@dataclass(frozen=True, slots=True, eq=False)
class Chart:
    """A stretched plane."""

    grid: Grid  # in the plane
    places: Array  # (H, W, 2) mm, of each node in the chart
    stretch: Array  # (H, W, 2) chart length over plane length, along x and y
    cosine: Array  # (H, W) plane area over chart area

    def from_plane(self, xy: Array) -> Array:
        """Points (N, 2) in the chart, mm, of points in the plane."""
        return self._beyond(interpolate(self.grid, self.places, xy), xy)

    def to_plane(self, uv: Array) -> Array:
        """Points (N, 2) in the plane, mm, of points in the chart."""
        xy, both = np.array(uv, float), np.concatenate([self.places, self.stretch], axis=-1)
        for _ in range(NEWTON_STEPS):
            there = interpolate(self.grid, both, xy)
            off = uv - self._beyond(there[:, :2], xy)
            xy = xy + off / there[:, 2:]
            if not len(off) or np.abs(off).max() < 1e-6:
                break
        return xy

    def _beyond(self, places: Array, xy: Array) -> Array:
        """The places (N, 2) of points in the plane, which go on evenly beyond the grid."""
        return places + xy - np.clip(xy, self.grid.origin, [self.grid.x[-1], self.grid.y[-1]])


def flat_chart(grid: Grid) -> Chart:
    """The plane itself."""
    return Chart(grid, grid.nodes, np.ones((*grid.shape, 2)), np.ones(grid.shape))


def unroll(grid: Grid, heights: Array) -> Chart:
    """The chart of a surface with heights (H, W) over the plane."""
    slopes = np.clip(gradient(grid, heights), -MAX_SLOPE, MAX_SLOPE)
    stretch = np.sqrt(1 + slopes**2)
    middle = tuple(np.clip(np.rint(-grid.origin / grid.step), 0, np.array(grid.shape[::-1]) - 1).astype(int))
    places = np.stack([_summed(stretch[..., 0], 1), _summed(stretch[..., 1], 0)], axis=-1) * grid.step
    places[..., 0] += grid.x[middle[0]] - places[:, middle[0], 0][:, None]
    places[..., 1] += grid.y[middle[1]] - places[middle[1], :, 1][None, :]
    return Chart(grid, places, stretch, 1 / np.prod(stretch, axis=-1))


def _summed(values: Array, axis: int) -> Array:
    """The trapezoid sums of values (H, W) from the first node on, along an axis."""
    total = np.cumsum(values, axis=axis)
    first = np.take(values, [0], axis=axis)
    return np.asarray(total - values / 2 - first / 2)


MAX_NODES = 400_000  # of a grid: 3 MB a layer
SMOOTHING_PER_NOISE = 8.0  # mm for each mm of noise: leaves a tenth of it on a scan of 0.5 mm between points
MAX_SMOOTHING = 1.0  # mm: more would round the wound's rim away
WALL_SIGMAS = 2.0  # deviations of the noise: heights that scatter by more are a wall and no noise
MIN_NOISE = 0.01  # mm: noise below is not worth smoothing
CLOSING_RADII = (1.0, 2.0, 4.0, 8.0, 16.0, 32.0)  # nodes: how far each round of closing holes looks


@dataclass(frozen=True, slots=True, eq=False)
class HeightMap:
    """Heights of a scan over a plane."""

    surface_from_plane: Array  # (4, 4) mm
    grid: Grid
    heights: Array  # (H, W) mm
    scanned: Mask  # (H, W) where the scan has a triangle
    closed: Mask  # (H, W) where a hole was closed
    noise: float  # mm, standard deviation of the scan
    smoothing: float  # mm over which it was averaged

    @property
    def known(self) -> Mask:
        """Where there is a height to build on."""
        return self.scanned | self.closed


def height_map(scan: Scan, surface_from_plane: Array, step: float, box: Array | None = None) -> HeightMap:
    """The scan's topmost heights over a plane, `step` mm apart or more. box: low and high corner (2, 2), mm."""
    points = se3.transform_points(se3.inverse(surface_from_plane), scan.vertices)
    low, high = points[:, :2].min(axis=0), points[:, :2].max(axis=0)
    if box is not None:
        low, high = np.maximum(low, box[0]), np.minimum(high, box[1])
    step = max(step, float(np.sqrt(np.prod(high - low) / MAX_NODES)))
    grid = grid_over(low, high, step)
    top = topmost(points, scan.triangles, grid)
    scanned = np.isfinite(top)
    closed = np.asarray(binary_fill_holes(scanned)) & ~scanned
    heights = _closed(np.where(scanned, top, 0.0), scanned, closed)
    noise = _noise(grid, heights, scanned)
    radius = min(SMOOTHING_PER_NOISE * noise, MAX_SMOOTHING) if noise > MIN_NOISE else 0.0
    heights = _averaged(grid, heights, radius, scanned | closed, noise)
    return HeightMap(surface_from_plane, grid, heights, scanned, closed, noise, radius)


def _averaged(grid: Grid, heights: Array, radius: float, known: Mask, noise: float) -> Array:
    """Heights (H, W) averaged over `radius` mm where they scatter by no more than the noise (Lee 1980): walls stay."""
    if radius <= 0:
        return heights
    mean = smoothed(grid, heights, radius, known)
    scatter = smoothed(grid, (heights - mean) ** 2, radius, known)
    kept = np.clip(1 - (WALL_SIGMAS * noise) ** 2 / np.maximum(scatter, 1e-12), 0, 1)
    return np.asarray(mean + kept * (heights - mean))


def _closed(heights: Array, scanned: Mask, holes: Mask) -> Array:
    """Heights with holes closed by averages of what is around them, and nodes beyond the rim as the nearest one."""
    heights, known = heights.copy(), scanned.copy()
    for reach in CLOSING_RADII:
        todo = holes & ~known
        if not todo.any():
            break
        weight = gaussian_filter(known.astype(float), reach, truncate=2.0)
        total = gaussian_filter(np.where(known, heights, 0.0), reach, truncate=2.0)
        near = todo & (weight > 0.2)
        heights[near] = total[near] / weight[near]
        known |= near
    return filled(heights, known)


def _noise(grid: Grid, heights: Array, scanned: Mask) -> float:
    """The scatter of heights about their neighbourhood, mm: of the quieter half, which is no wall and no rim."""
    sigma = 1.0 / grid.step
    off = np.abs(heights - gaussian_filter(heights, sigma, mode="nearest"))
    inner = binary_erosion(scanned, iterations=max(1, int(2 * sigma)))
    sample = off[inner] if inner.any() else off[scanned]
    return 1.4826 * float(np.median(sample)) if len(sample) else 0.0


def upsampled(grid: Grid, coarse: Grid, values: Array) -> Array:
    """Values (h, w) of a coarse grid at the nodes of a fine one (H, W), by cubic splines."""
    ratio = grid.step / coarse.step
    rows, columns = (np.arange(n) * ratio for n in grid.shape)
    return np.asarray(map_coordinates(values, np.meshgrid(rows, columns, indexing="ij"), order=3, mode="nearest"))


def axes_along(z: Array, x: Array) -> Array:
    """The rotation whose z is `z` and whose x is as near to `x` as that allows."""
    if abs(z @ x) > 0.95:
        x = np.roll(x, 1)
    x = x - (x @ z) * z
    x = x / np.linalg.norm(x)
    return np.column_stack([x, np.cross(z, x), z])


def nodes_within(grid: Grid, shape: MultiPolygon) -> Mask:
    """(H, W) which nodes lie inside; at least one does."""
    x, y = grid.nodes[..., 0], grid.nodes[..., 1]
    inside = shapely.contains_xy(shape, x, y)
    if not inside.any():
        inside.flat[np.argmin(shapely.distance(shape, shapely.points(x, y)))] = True
    return np.asarray(inside)
