"""A wound's outline and the healthy skin over it, each found by the other, in a map of heights."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import shapely
from scipy.ndimage import binary_erosion, distance_transform_edt, label, map_coordinates
from shapely import MultiPolygon

from estimation import se3
from estimation.scans.scan import Scan
from estimation.se3 import Array
from planning.layers.grid import Grid, HeightMap, Mask, as_multi, filled, interpolate, positive_region
from planning.layers.skin import MIN_CELLS, RestoredSkin, SkinCells, SkinKernel, bent_base, restored_skin, skin_cells

SEARCH_STEP = 0.75  # mm between nodes while the wound is looked for
SKIN_STEP = 3.0  # mm between nodes where the skin is worked out; it bends over centimetres
SURROUND_WIDTH = 30.0  # mm of skin around the wound that is looked at
# mm of skin along the rim that is not trusted at first, as it may be swollen or rolled in; and the least left out
RIM_MARGIN, MIN_RIM_MARGIN = 7.0, 1.5
MARGIN_STEP = 1.0  # mm of that skin judged at once
MAX_SWELLING = 0.1  # mm, mean of such a strip off the skin restored without it, beside its deviation
SKIN_SIGMAS, MIN_SKIN_BAND = 4.0, 0.3  # skin lies within so many deviations, and mm, of the restored
SKIN_ROUNDS = 3  # of leaving out what does not
# the rim: where the scan is so deep, in parts of the wound's depth, in mm, and in deviations of the noise
RIM_LEVEL_SHARE, MIN_RIM_LEVEL, RIM_NOISE_SIGMAS = 0.05, 0.15, 3.0
MIN_DEPTH, MIN_AREA = 0.4, 10.0  # mm and mm^2: less is a pore or a crease
OUTLINE_TOLERANCE = 0.02  # mm: an outline is moved less by being made simple; a twentieth of a fine bead
MIN_NODES = 150  # of the map that are surface: of fewer no skin can be told
MIN_PIECE = 1.0  # mm^2: of an outline, and of an island of skin inside it
# of the depth: what is deeper is the wound's core; and mm beside it that the wall may take, its depth at least
CORE_SHARE, MIN_WALL_REACH = 0.35, 4.0
OPENING_RADIUS = 0.5  # mm: creases narrower than twice that are not part of a wound
OUTLINE_ROUNDS, SAME_SHARE = 4, 0.99  # of outline and restored skin: each is found by the other; and when it is
MAX_UNDER = 0.3  # mm under the topmost heights: further down it is another shell, or under an overhang
MIN_UPWARD = 0.1  # upward part of a triangle's normal: below, it is an overhang's


def upsampled(grid: Grid, coarse: Grid, values: Array) -> Array:
    """Values (h, w) of a coarse grid at the nodes of a fine one (H, W), by cubic splines."""
    ratio = grid.step / coarse.step
    rows, columns = (np.arange(n) * ratio for n in grid.shape)
    return np.asarray(map_coordinates(values, np.meshgrid(rows, columns, indexing="ij"), order=3, mode="nearest"))


@dataclass(frozen=True, slots=True, eq=False)
class OutlinedWound:
    """A wound in its height map: where it is, and the skin over it."""

    fine: HeightMap
    outline: MultiPolygon  # in the plane, mm
    restored: RestoredSkin
    skin: Array  # (H, W) mm
    margin: float  # mm
    scatter: float  # mm, of the skin around about the restored
    level: float  # mm, depth of the rim

    @property
    def depth(self) -> Array:
        """(H, W) mm, -1 where nothing is known."""
        return np.where(self.fine.known, self.skin - self.fine.heights, -1.0)


def surround_box(shape: MultiPolygon) -> Array:
    """Low and high corner (2, 2), mm, of what is looked at around a shape."""
    low, high = np.array(shape.bounds).reshape(2, 2)
    return np.array([low - SURROUND_WIDTH, high + SURROUND_WIDTH])


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


def points_on(fine: HeightMap, xy: Array) -> Array:
    """Points (N, 3), scan frame, on the scan over points (N, 2) of the plane."""
    points = np.column_stack([xy, interpolate(fine.grid, fine.heights, xy)])
    return se3.transform_points(fine.surface_from_plane, points)


def visible_points(scan: Scan, fine: HeightMap) -> Array:
    """Vertices (P, 3) mm, plane frame, of the scan that are seen from above, within the map."""
    plane_from_surface = se3.inverse(fine.surface_from_plane)
    points = se3.transform_points(plane_from_surface, scan.vertices)
    low, high = fine.grid.origin, np.array([fine.grid.x[-1], fine.grid.y[-1]])
    upward = scan.normals @ plane_from_surface[2, :3]
    near = ((points[:, :2] >= low) & (points[:, :2] <= high)).all(axis=1) & (upward > MIN_UPWARD)
    points, upward = points[near], upward[near]
    under = (interpolate(fine.grid, fine.heights, points[:, :2]) - points[:, 2]) * upward
    return np.asarray(points[under < max(MAX_UNDER, SKIN_SIGMAS * fine.noise)])


def skin_around(
    points: Array, outline: MultiPolygon, margin: float, kernel: SkinKernel | None = None
) -> tuple[RestoredSkin, float]:
    """The skin over an outline, from points (P, 3) of the scan beyond `margin` mm, and their scatter about it."""
    beside = ~shapely.contains_xy(shapely.buffer(outline, margin), points[:, 0], points[:, 1])
    if beside.sum() < MIN_CELLS:
        beside = ~shapely.contains_xy(outline, points[:, 0], points[:, 1])
    around = points[beside] if beside.sum() >= MIN_CELLS else points
    cells = skin_cells(bent_base(around), around)
    gap = float(np.sqrt(outline.area / np.pi)) + margin
    skin, held, scatter = restored_skin(cells, gap, kernel), len(cells.heights), 0.0
    for _ in range(SKIN_ROUNDS):
        off = np.abs(cells.heights - skin.at(cells.places))
        scatter = 1.4826 * float(np.median(off))
        good = off < max(SKIN_SIGMAS * scatter, MIN_SKIN_BAND)  # no second wound, fold or hair
        if good.sum() == held or good.sum() < MIN_CELLS:
            break
        kept = SkinCells(cells.base, cells.places[good], cells.heights[good], cells.weights[good])
        skin, held = restored_skin(kept, gap, skin.kernel), int(good.sum())
    return skin, scatter


def _trusted_margin(points: Array, outline: MultiPolygon, skin: RestoredSkin) -> float:
    """How near to the rim, mm, the scan's skin agrees with that restored from beyond RIM_MARGIN."""
    near = shapely.contains_xy(shapely.buffer(outline, RIM_MARGIN + MARGIN_STEP), *points[:, :2].T)
    points = points[near]
    places, heights = skin.base.places(points)
    edges = np.arange(MIN_RIM_MARGIN, RIM_MARGIN, MARGIN_STEP)
    for low in edges[::-1]:
        outer, inner = (shapely.buffer(outline, low + away) for away in (MARGIN_STEP, 0.0))
        strip = shapely.contains_xy(outer, *points[:, :2].T) & ~shapely.contains_xy(inner, *points[:, :2].T)
        if not strip.any():
            continue
        off = float(np.mean(heights[strip] - skin.at(places[strip])))
        if abs(off) > MAX_SWELLING + float(np.median(skin.deviation(places[strip]))):
            return RIM_MARGIN
    return MIN_RIM_MARGIN


def with_skin(scan: Scan, fine: HeightMap, outline: MultiPolygon) -> OutlinedWound:
    """An outline with the skin over it, held as near to the rim as the skin there is sound."""
    points = visible_points(scan, fine)
    far, _ = skin_around(points, outline, RIM_MARGIN)
    margin = _trusted_margin(points, outline, far)
    restored, scatter = skin_around(points, outline, margin)
    return OutlinedWound(fine, outline, restored, skin_heights(restored, fine.grid), margin, scatter, 0.0)


def skin_heights(restored: RestoredSkin, grid: Grid) -> Array:
    """Heights (H, W) mm of the restored skin over the plane."""
    coarse = grid.coarser(max(SKIN_STEP, grid.step))
    _, heights = restored.over(coarse)
    known = np.isfinite(heights)
    return upsampled(
        grid, coarse, filled(np.where(known, heights, 0.0), known) if known.any() else np.zeros(coarse.shape)
    )


def outlined(
    scan: Scan, fine: HeightMap, outline: MultiPolygon, near: bool | None = None, kernel: SkinKernel | None = None
) -> OutlinedWound | None:
    """Outline and restored skin, each found by the other, from a first outline; None where nothing lies deep there.

    near: whether the skin is sound up to the rim; None: it is tested. kernel: of the skin; by cross-validation without.
    """
    points = visible_points(scan, fine)
    if len(points) < MIN_CELLS:
        return None
    margin, known = MIN_RIM_MARGIN if near else RIM_MARGIN, kernel
    for turn in range(OUTLINE_ROUNDS):
        restored, scatter = skin_around(points, outline, margin, known)
        skin = skin_heights(restored, fine.grid)
        rim = np.column_stack([shapely.get_coordinates(outline), np.zeros(shapely.get_num_coordinates(outline))])
        sigma = float(np.median(restored.deviation(restored.base.places(rim)[0])))
        level, now = _rim_of(fine, np.where(fine.known, skin - fine.heights, -1.0), outline, sigma)
        if now.is_empty:
            return None
        before, outline, known = outline, now, restored.kernel
        same = shapely.intersection(before, outline).area > SAME_SHARE * shapely.union(before, outline).area
        if near is None and (same or turn == OUTLINE_ROUNDS - 2):
            near, same = _trusted_margin(points, outline, restored) < RIM_MARGIN, False
            if not near:
                break
            margin, known = MIN_RIM_MARGIN, kernel
        elif same:
            break
    return OutlinedWound(fine, outline, restored, skin, margin, scatter, level)


def _rim_of(fine: HeightMap, depth: Array, outline: MultiPolygon, sigma: float) -> tuple[float, MultiPolygon]:
    """The level of the rim, mm, and the outline of what is deeper, where `outline` has most of it; or an empty one.

    sigma: mm, deviation of the skin. The rim is sought beside what is a good part as deep as the wound: where the skin
    is restored too high, a hollow beside the wound may lie under it too.
    """
    inside = nodes_within(fine.grid, outline)
    deep = float(np.percentile(depth[inside], 95))
    level = max(MIN_RIM_LEVEL, RIM_LEVEL_SHARE * deep, RIM_NOISE_SIGMAS * fine.noise, sigma)
    core = _largest(depth > max(CORE_SHARE * deep, level), inside)
    if not core.any():
        return level, MultiPolygon()
    reach = max(MIN_WALL_REACH, deep)
    deeper = (depth > level) & (distance_transform_edt(~core) * fine.grid.step < reach)
    own = _largest(deeper, core)
    rise = np.where(own | (depth <= level), depth - level, -level)
    wider = positive_region(fine.grid, rise, MIN_PIECE, OUTLINE_TOLERANCE)
    opened = as_multi(shapely.buffer(shapely.buffer(wider, -OPENING_RADIUS), OPENING_RADIUS), MIN_PIECE)
    shape = as_multi(shapely.simplify(opened, OUTLINE_TOLERANCE))
    return level, shape if shape.area >= MIN_AREA / 2 else MultiPolygon()


def _largest(chosen: Mask, inside: Mask) -> Mask:
    """The piece (H, W) of the nodes chosen that has most nodes inside; none where it has none."""
    pieces, _ = label(chosen)
    share = np.bincount(pieces[inside], minlength=2)[1:]
    return np.asarray((pieces == int(np.argmax(share)) + 1) & bool(share.any()))


def share_cut(fine: HeightMap, shape: MultiPolygon) -> float:
    """Share of an outline that lies along the scan's own rim."""
    rim = shapely.get_coordinates(shapely.segmentize(shape.boundary, fine.grid.step))
    inner = binary_erosion(fine.known, iterations=max(2, round(1.0 / fine.grid.step)))
    return float(np.mean(interpolate(fine.grid, inner.astype(float), rim) < 0.5))
