"""The volume to be printed: between the wound's bed and the healthy skin that is interpolated over it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import shapely
from scipy.interpolate import RBFInterpolator
from scipy.ndimage import binary_erosion, distance_transform_edt, label, map_coordinates
from shapely import MultiPolygon

from estimation import se3
from estimation.errors import InputError
from estimation.scans.scan import Scan
from estimation.se3 import Array, Index
from planning.layers.grid import Grid, HeightMap, Mask, as_multi, gradient, height_map, interpolate, positive_region
from planning.layers.repair import mean_normal

SEARCH_STEP = 0.75  # mm between nodes while the wound is looked for
RIM_MARGIN = 5.0  # mm of skin along the rim that is not trusted: it may be swollen or rolled in
SURROUND_WIDTH = 30.0  # mm of skin around the wound that is looked at
# the rim: where the scan is so deep, in parts of the wound's depth, in mm, and in deviations of the noise
RIM_LEVEL_SHARE, MIN_RIM_LEVEL, RIM_NOISE_SIGMAS = 0.05, 0.15, 3.0
MIN_DEPTH, MIN_AREA = 0.4, 10.0  # mm and mm^2: less is a pore or a crease
OUTLINE_TOLERANCE = 0.02  # mm: an outline is moved less by being made simple; a twentieth of a fine bead
MIN_VOLUME_RATIO = 0.25  # a depression whose volume is a smaller part of a bulge's: the scan is inside out
MIN_NODES = 30  # of the coarse map that are surface: of fewer no skin can be told
MIN_PIECE = 1.0  # mm^2: of an outline, and of an island of skin inside it
OPENING_RADIUS = 0.5  # mm: creases narrower than twice that are not part of a wound
OUTLINE_ROUNDS = 3  # of outline and restored skin: each is found by the other
MAX_CUT_SHARE = 0.25  # share of the outline that may lie along the scan's rim, where no skin holds the restored surface
MIN_UPWARD = 0.1  # upward part of a triangle's normal: below, it is an overhang's


@dataclass(frozen=True, slots=True, eq=False)
class WoundVolume:
    """The volume to be filled, over a grid in the plane."""

    surface_from_plane: Array  # (4, 4) mm
    grid: Grid
    bed: Array  # (H, W) mm, heights of the scan, the wound's bed inside
    skin: Array  # (H, W) mm, heights of the skin to be restored
    outline: MultiPolygon  # in the plane, mm; islands of intact skin are its holes
    findings: WoundFindings

    @property
    def depth(self) -> Array:
        """(H, W) mm from the restored skin down to the bed; not positive beside the wound."""
        return np.asarray(self.skin - self.bed)

    @property
    def rim(self) -> Array:
        """Points (N, 3) mm, scan frame, around the largest piece of the outline, on the scan."""
        xy = shapely.get_coordinates(self.outline.geoms[0].exterior)[:-1]
        points = np.column_stack([xy, interpolate(self.grid, self.bed, xy)])
        return se3.transform_points(self.surface_from_plane, points)


@dataclass(frozen=True, slots=True)
class WoundFindings:
    """What the wound is like."""

    given: bool  # whether the outline was given
    area: float  # mm^2
    volume: float  # mm^3
    depth: float  # mm
    level: float  # mm, depth at which the rim was drawn
    noise: float  # mm, of the scan
    smoothing: float  # mm over which the scan was averaged
    scatter: float  # mm, of the skin around about the restored surface
    closed: float  # mm^2 of holes that were closed inside the wound
    hidden: float  # mm^2 of the scan inside the outline that an overhang hides
    cut: float  # share of the outline along the scan's rim
    others: int  # further depressions that were left alone
    notes: tuple[str, ...]  # what somebody should look at


COARSE_STEP = 2.0  # mm between nodes where it is worked out; skin bends over centimetres
MAX_CENTRES = 300  # points it is held by
KERNEL_RADIUS = 12.0  # mm over which a departure from the quadric fades, as the best of 10 to 30 mm on simulated limbs
FIRST_KERNEL_RADIUS = 30.0  # mm, while the wound is not known: too stiff to creep down its walls
NUGGET_VARIANCE = 0.1  # variance of a point by itself over that of the departures
RIM_SEED_SHARE = 0.15  # of the greatest distance from the scan's rim: taken for skin at first
MAX_SKIN_ROUNDS = 10  # at most
SKIN_SIGMAS, MIN_SKIN_BAND = 4.0, 0.3  # skin lies within so many deviations, and mm, of it


def restore_skin(grid: Grid, heights: Array, held: Mask, reach: float = KERNEL_RADIUS) -> Array:
    """Heights (H, W) of healthy skin over the whole grid, from those at the nodes `held`.

    The skin is a quadric and the departure of the skin near by from it (universal kriging, Matheron 1969): the
    departure is a Gaussian process, so the surface meets the skin around the wound and returns to the limb's own
    curvature over its middle. A thin plate instead carries the slope of a swollen rim across the whole wound: on
    simulated limbs its error was twice as large.
    """
    rows, columns = np.nonzero(held)
    chosen = _spread_nodes(rows, columns, held.shape)
    places = np.column_stack([grid.x[columns[chosen]], grid.y[rows[chosen]]])
    middle, size = places.mean(axis=0), float(np.ptp(places, axis=0).max())
    solved = RBFInterpolator(
        (places - middle) / size, heights[rows[chosen], columns[chosen]], smoothing=NUGGET_VARIANCE,
        kernel="gaussian", epsilon=size / reach, degree=2,
    )  # fmt: skip
    nodes = (grid.nodes.reshape(-1, 2) - middle) / size
    return np.asarray(solved(nodes)).reshape(grid.shape)


def _spread_nodes(rows: Index, columns: Index, shape: tuple[int, ...]) -> Index:
    """Numbers of up to MAX_CENTRES nodes, evenly spread: one in each square of a lattice just coarse enough."""
    every = 1
    while True:
        _, first = np.unique(rows // every * shape[1] + columns // every, return_index=True)
        if len(first) <= MAX_CENTRES:
            return np.asarray(first)
        every += 1


def skin_nodes(grid: Grid, heights: Array, valid: Mask) -> tuple[Array, Mask, float]:
    """The healthy surface (H, W) guessed without knowing the wound, the nodes that are skin, and their scatter, mm.

    The skin along the scan's rim is taken for healthy; the surface through it shows what else is.
    """
    inner = distance_transform_edt(np.pad(valid, 1))[1:-1, 1:-1]
    seed = valid & (inner <= max(2.0, RIM_SEED_SHARE * inner.max()))
    held, surface, sigma = seed, heights, 0.0
    for _ in range(MAX_SKIN_ROUNDS):
        surface = restore_skin(grid, heights, held, FIRST_KERNEL_RADIUS)
        off = np.abs(heights - surface)
        sigma = 1.4826 * float(np.median(off[held]))
        now = valid & (off < max(SKIN_SIGMAS * sigma, MIN_SKIN_BAND))
        now |= seed & (off < 3 * max(SKIN_SIGMAS * sigma, MIN_SKIN_BAND))
        if now.sum() < 30 or (now == held).all():
            break
        held = now
    return surface, held, sigma


def upsampled(grid: Grid, coarse: Grid, values: Array) -> Array:
    """Values (h, w) of a coarse grid at the nodes of a fine one (H, W), by cubic splines."""
    ratio = grid.step / coarse.step
    rows, columns = (np.arange(n) * ratio for n in grid.shape)
    return np.asarray(map_coordinates(values, np.meshgrid(rows, columns, indexing="ij"), order=3, mode="nearest"))


def downsampled(grid: Grid, coarse: Grid, values: Array) -> Array:
    """Values (H, W) of a fine grid at the nodes of a coarse one (h, w)."""
    return interpolate(grid, values, coarse.nodes.reshape(-1, 2)).reshape(coarse.shape)


def find_wound(
    scan: Scan, step: float, where: object, outline: Array | None = None, flipped: bool = False
) -> WoundVolume:
    """The wound in a scan, over a grid `step` mm fine. outline: (N, 3) mm, scan frame; None: it is looked for.

    flipped: whether the scan was turned over, as a refusal says then. InputError where there is none, or where the scan
    does not hold it.
    """
    axes = _axes(mean_normal(scan.vertices, scan.triangles, where), np.eye(3)[0])
    first = height_map(scan, se3.make(axes, scan.vertices.mean(axis=0)), SEARCH_STEP)
    if outline is None:
        first_outline, others = _searched(first, where, flipped)
    else:
        first_outline, others = _given(outline, first.surface_from_plane, where), 0
    surface_from_plane = _plane_over(first, first_outline)
    turn = se3.inverse(surface_from_plane) @ first.surface_from_plane
    flat = _moved(shapely.get_coordinates(first_outline), first, turn)
    box = np.array([flat.min(axis=0) - SURROUND_WIDTH, flat.max(axis=0) + SURROUND_WIDTH])
    fine = height_map(scan, surface_from_plane, step, box)
    if outline is None:
        moved = shapely.transform(first_outline, lambda xy: _moved(xy, first, turn))
        shape, skin, scatter, level = _refined(fine, as_multi(shapely.make_valid(moved)), where, flipped)
    else:
        shape = _given(outline, surface_from_plane, where)
        skin, scatter = _skin_beside(fine, shape)
        level = 0.0
    return _checked_wound(scan, fine, shape, skin, scatter, level, outline is not None, others, where)


def _moved(xy: Array, first: HeightMap, turn: Array) -> Array:
    """Points (N, 2) of a plane's outline, on the scan, in the plane turned by `turn` (4, 4)."""
    points = np.column_stack([xy, interpolate(first.grid, first.heights, xy)])
    return np.asarray(se3.transform_points(turn, points)[:, :2])


def _axes(z: Array, x: Array) -> Array:
    """The rotation whose z is `z` and whose x is as near to `x` as that allows."""
    if abs(z @ x) > 0.95:
        x = np.roll(x, 1)
    x = x - (x @ z) * z
    x = x / np.linalg.norm(x)
    return np.column_stack([x, np.cross(z, x), z])


def _plane_over(first: HeightMap, outline: MultiPolygon) -> Array:
    """The plane across the skin over an outline: origin on it over the outline's middle, z its mean normal there."""
    skin, _ = _skin_beside(first, outline)
    slopes = gradient(first.grid, skin)[nodes_within(first.grid, outline)].mean(axis=0)
    z = np.array([-slopes[0], -slopes[1], 1.0])
    rotation = first.surface_from_plane[:3, :3]
    middle = np.array(outline.centroid.coords[0])
    origin = np.array([[*middle, float(interpolate(first.grid, skin, middle[None])[0])]])
    axes = _axes(rotation @ z / np.linalg.norm(z), np.eye(3)[0])
    return se3.make(axes, se3.transform_points(first.surface_from_plane, origin)[0])


def _searched(first: HeightMap, where: object, flipped: bool) -> tuple[MultiPolygon, int]:
    """The largest depression, and how many others there are."""
    coarse = first.grid.coarser(max(COARSE_STEP, first.grid.step))
    known = downsampled(first.grid, coarse, first.known.astype(float)) > 0.99
    if known.sum() < MIN_NODES:
        width, height = first.grid.step * (np.array(first.grid.shape[::-1]) - 1)
        allowed = "a scan of a wound and the skin about it, in mm: --unit says so where it is in another unit"
        raise InputError(where, "scan", f"{width:.3g} x {height:.3g} mm that hardly hang together", allowed)
    surface, _, scatter = skin_nodes(coarse, downsampled(first.grid, coarse, first.heights), known)
    depth = np.where(first.known, upsampled(first.grid, coarse, surface) - first.heights, 0.0)
    level = max(MIN_DEPTH, 4 * scatter)
    pieces, volumes = _depressions(first.grid, depth, level)
    raised = _depressions(first.grid, np.where(first.known, -depth, 0.0), level)[1]
    if not len(volumes) or volumes.max() < MIN_VOLUME_RATIO * raised.max(initial=0.0):
        _refuse(depth[first.known], where, flipped)
    deepest = int(np.argmax(volumes)) + 1
    inside = np.where(pieces == deepest, depth - level, -level)
    outline = positive_region(first.grid, inside, MIN_PIECE, OUTLINE_TOLERANCE)
    return outline, int(np.sum(volumes > 0.1 * volumes.max())) - 1


def _depressions(grid: Grid, depth: Array, level: float) -> tuple[Index, Array]:
    """Pieces (H, W) deeper than `level`, numbered from 1, and the volume (K,) of each; those that are small are 0."""
    pieces, count = label(depth > level)
    if not count:
        return pieces, np.empty(0)
    area = np.bincount(pieces.ravel(), minlength=count + 1)[1:] * grid.step**2
    volume = np.bincount(pieces.ravel(), depth.ravel(), count + 1)[1:] * grid.step**2
    volume = np.where(area >= MIN_AREA, volume, 0.0)
    return pieces, np.asarray(volume[: count if volume.any() else 0])


def _refuse(depth: Array, where: object, flipped: bool) -> None:
    low, high = np.percentile(depth, [1, 99])
    got = f"none found: hardly any of the scan lies deeper than {max(high, 0):.2g} mm under the skin"
    allowed = f"{MIN_AREA:g} mm^2 deeper than {MIN_DEPTH:g} mm, or an outline (--outline)"
    if -low > MIN_DEPTH:
        inside_out = "leave --flip out" if flipped else "if it was scanned inside out, say --flip"
        allowed += f"; it bulges by {-low:.2g} mm: {inside_out}"
    raise InputError(where, "wound", got, allowed)


def _given(outline: Array, surface_from_plane: Array, where: object) -> MultiPolygon:
    flat = se3.transform_points(se3.inverse(surface_from_plane), outline)[:, :2]
    shape = as_multi(shapely.make_valid(shapely.Polygon(flat)), MIN_PIECE)
    if shape.is_empty:
        raise InputError(where, "outline", f"{shape.area:.3g} mm^2", f"{MIN_PIECE:g} mm^2 or more")
    return shape


def nodes_within(grid: Grid, shape: MultiPolygon) -> Mask:
    """(H, W) which nodes lie inside; at least one does."""
    x, y = grid.nodes[..., 0], grid.nodes[..., 1]
    inside = shapely.contains_xy(shape, x, y)
    if not inside.any():
        inside.flat[np.argmin(shapely.distance(shape, shapely.points(x, y)))] = True
    return np.asarray(inside)


def _skin_beside(fine: HeightMap, outline: MultiPolygon) -> tuple[Array, float]:
    """The restored skin (H, W) over an outline, from the skin beyond RIM_MARGIN, and the scatter of that skin."""
    coarse = fine.grid.coarser(max(COARSE_STEP, fine.grid.step))
    heights = downsampled(fine.grid, coarse, fine.heights)
    known = downsampled(fine.grid, coarse, fine.known.astype(float)) > 0.99
    held = known & ~nodes_within(coarse, shapely.buffer(outline, RIM_MARGIN))
    if held.sum() < 12:
        held = known & ~nodes_within(coarse, outline)
    surface = restore_skin(coarse, heights, held)
    off = np.abs(heights - surface)
    scatter = 1.4826 * float(np.median(off[held]))
    good = held & (off < max(4 * scatter, 0.3))  # a second wound, a fold, a hair
    if good.sum() >= 12 and good.sum() < held.sum():
        surface = restore_skin(coarse, heights, good)
    return upsampled(fine.grid, coarse, surface), scatter


def _refined(
    fine: HeightMap, outline: MultiPolygon, where: object, flipped: bool
) -> tuple[MultiPolygon, Array, float, float]:
    """Outline, restored skin, its scatter and the level of the rim, from a first outline."""
    skin, scatter, level = fine.heights, 0.0, MIN_RIM_LEVEL
    for _ in range(OUTLINE_ROUNDS):
        skin, scatter = _skin_beside(fine, outline)
        depth = np.where(fine.known, skin - fine.heights, -1.0)
        inside = nodes_within(fine.grid, outline)
        deep = float(np.percentile(depth[inside], 95))
        level = max(MIN_RIM_LEVEL, RIM_LEVEL_SHARE * deep, RIM_NOISE_SIGMAS * fine.noise)
        pieces, _ = label(depth > level)
        share = np.bincount(pieces[inside], minlength=2)
        if len(share) < 2 or not share[1:].any():
            _refuse(depth[fine.known], where, flipped)
        own = pieces == int(np.argmax(share[1:])) + 1
        rise = np.where(own | ~(depth > level), depth - level, -level)
        wider = positive_region(fine.grid, rise, MIN_PIECE, OUTLINE_TOLERANCE)
        opened = as_multi(shapely.buffer(shapely.buffer(wider, -OPENING_RADIUS), OPENING_RADIUS), MIN_PIECE)
        if opened.is_empty:
            _refuse(depth[fine.known], where, flipped)
        before, outline = outline, as_multi(shapely.simplify(opened, OUTLINE_TOLERANCE))
        if shapely.symmetric_difference(before, outline).area < 0.01 * outline.area:
            break
    return outline, skin, scatter, level


def _checked_wound(
    scan: Scan, fine: HeightMap, shape: MultiPolygon, skin: Array, scatter: float, level: float,
    given: bool, others: int, where: object,
) -> WoundVolume:  # fmt: skip
    inside = nodes_within(fine.grid, shape)
    known = inside & fine.known
    if known.sum() < 0.5 * inside.sum():
        share = f"{known.sum() / inside.sum():.0%} of the outline"
        raise InputError(where, "scanned part of the wound", share, "half of it or more: scan it again, or the outline")
    cell, depth = fine.grid.step**2, np.where(fine.known, skin - fine.heights, 0.0)
    rim = shapely.get_coordinates(shapely.segmentize(shape.boundary, fine.grid.step))
    inner = binary_erosion(fine.known, iterations=max(2, round(1.0 / fine.grid.step)))
    cut = float(np.mean(interpolate(fine.grid, inner.astype(float), rim) < 0.5))
    if cut > MAX_CUT_SHARE:
        allowed = f"{MAX_CUT_SHARE:.0%} or less: scan 20 mm of skin around the wound"
        raise InputError(where, "share of the outline at the scan's own rim", f"{cut:.0%}", allowed)
    findings = WoundFindings(
        given=given, area=float(shape.area), volume=float(np.maximum(depth, 0)[inside].sum() * cell),
        depth=float(depth[inside].max()), level=level, noise=fine.noise, smoothing=fine.smoothing, scatter=scatter,
        closed=float((fine.closed & inside).sum() * cell), hidden=_hidden(scan, fine, shape), cut=cut, others=others,
        notes=(),
    )  # fmt: skip
    if findings.depth < MIN_DEPTH / 2:
        raise InputError(where, "depth inside the outline", f"{findings.depth:.2g} mm", f"{MIN_DEPTH / 2:g} mm or more")
    findings = replace(findings, notes=tuple(_notes(findings)))
    return WoundVolume(fine.surface_from_plane, fine.grid, fine.heights, skin, shape, findings)


def _hidden(scan: Scan, fine: HeightMap, shape: MultiPolygon) -> float:
    """Area, mm^2, of the scan inside the outline that lies under an overhang or faces away."""
    corners = se3.transform_points(se3.inverse(fine.surface_from_plane), scan.vertices)[scan.triangles]
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(cross, axis=1) / 2
    middle = corners.mean(axis=1)
    under = interpolate(fine.grid, fine.heights, middle[:, :2]) - middle[:, 2]
    below = under > 1.0  # mm: more than any wall under smoothing
    away = cross[:, 2] < MIN_UPWARD * 2 * area
    there = shapely.contains_xy(shape, middle[:, 0], middle[:, 1])
    return float(area[there & (below | away)].sum())


def _notes(findings: WoundFindings) -> Sequence[str]:
    """What somebody should look at before printing."""
    notes = []
    if findings.hidden > 0.02 * findings.area:
        notes.append(
            f"{findings.hidden:.0f} mm^2 of the bed lie under overhangs, which a nozzle from above does not reach: "
            "the space under them stays open"
        )
    if findings.closed > 0.02 * findings.area:
        notes.append(f"{findings.closed:.0f} mm^2 of the wound were not scanned and are guessed from around")
    if findings.cut > 0:
        notes.append(f"{findings.cut:.0%} of the outline lie at the scan's own rim: no skin holds the surface there")
    if findings.others:
        notes.append(f"{findings.others} further depressions were left alone; give --outline for one of them")
    if findings.noise > 0.2:
        notes.append(f"the scan is noisy: {findings.noise:.2f} mm")
    if findings.scatter > 0.5:
        notes.append(f"the skin around departs from the restored surface by {findings.scatter:.2f} mm")
    return notes
