"""The volume to be printed: between the wound's bed and the healthy skin that is to be restored over it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import shapely
from scipy.ndimage import binary_erosion, label
from shapely import MultiPolygon

from estimation import se3
from estimation.errors import InputError
from estimation.scan import Index, Scan
from estimation.se3 import Array
from planning.layers.contour import as_multi, region
from planning.layers.grid import Grid, Mask, at, gradient
from planning.layers.heights import HeightMap, height_map
from planning.layers.repair import mean_normal
from planning.layers.skin import COARSE, downsampled, restored, skin_nodes, upsampled

FIRST_STEP = 0.75  # mm between nodes while the wound is looked for
MARGIN = 5.0  # mm of skin along the rim that is not trusted: it may be swollen or rolled in
SURROUND = 30.0  # mm of skin around the wound that is looked at
LEVEL, LEAST_LEVEL, NOISES = (
    0.05,
    0.15,
    3.0,
)  # the rim: where the scan is so deep, in parts of the wound's depth, in mm,
# and in deviations of the noise
LEAST_DEPTH, LEAST_AREA = 0.4, 10.0  # mm and mm^2: less is a pore or a crease
SLACK = 0.02  # mm: an outline is moved less by being made simple; a twentieth of a fine bead
BULGE = 0.25  # a depression whose volume is a smaller part of a bulge's: the scan is inside out
FEWEST_NODES = 30  # of the coarse map that are surface: of fewer no skin can be told
LEAST_PIECE = 1.0  # mm^2: of an outline, and of an island of skin inside it
OPENING = 0.5  # mm: creases narrower than twice that are not part of a wound
ROUNDS = 3  # of outline and restored skin: each is found by the other
CUT = 0.25  # share of the outline that may lie along the scan's rim, where no skin holds the restored surface
STEEP = 0.1  # upward part of a triangle's normal: below, it is an overhang's


@dataclass(frozen=True, slots=True, eq=False)
class Wound:
    """What is to be filled, over a grid in the plane.

    surface_from_plane: (4, 4) mm. bed, skin: (H, W) mm, heights of the wound as scanned and of the skin to be restored.
    scan: (H, W) mm, all that was scanned, the bed inside. outline: in the plane, mm, islands of intact skin its holes.
    """

    surface_from_plane: Array
    grid: Grid
    bed: Array
    skin: Array
    outline: MultiPolygon
    findings: Findings

    @property
    def depth(self) -> Array:
        """(H, W) mm from the restored skin down to the bed; not positive beside the wound."""
        return np.asarray(self.skin - self.bed)

    @property
    def rim(self) -> Array:
        """Points (N, 3) mm, scan frame, around the largest piece of the outline, on the scan."""
        xy = shapely.get_coordinates(self.outline.geoms[0].exterior)[:-1]
        return se3.transform_points(self.surface_from_plane, np.column_stack([xy, at(self.grid, self.bed, xy)]))


@dataclass(frozen=True, slots=True)
class Findings:
    """What the wound is like. Lengths mm, areas mm^2, volume mm^3.

    given: whether the outline was. level: depth at which the rim was drawn. noise: of the scan; smoothing: mm by which
    it was averaged. scatter: of the skin around about the restored surface. closed: area of holes that were closed
    inside the wound. hidden: area of the scan inside the outline that an overhang hides. cut: share of the outline
    along the scan's rim. others: further depressions that were left alone. notes: what somebody should look at.
    """

    given: bool
    area: float
    volume: float
    depth: float
    level: float
    noise: float
    smoothing: float
    scatter: float
    closed: float
    hidden: float
    cut: float
    others: int
    notes: tuple[str, ...]


def wound_in(scan: Scan, step: float, where: object, outline: Array | None = None, flipped: bool = False) -> Wound:
    """The wound in a scan, over a grid `step` mm fine. outline: (N, 3) mm, scan frame; None: it is looked for.

    flipped: whether the scan was turned over, as a refusal says then. InputError where there is none, or where the scan
    does not hold it.
    """
    first = height_map(scan, _first_plane(scan, where), FIRST_STEP)
    if outline is None:
        found, others = _searched(first, where, flipped)
    else:
        found, others = _given(outline, first.surface_from_plane, where), 0
    surface_from_plane = _plane_over(first, found)
    turn = se3.inverse(surface_from_plane) @ first.surface_from_plane
    corners = shapely.get_coordinates(found)
    corners = np.column_stack([corners, at(first.grid, first.heights, corners)])
    seen = se3.transform_points(turn, corners)[:, :2]
    box = np.array([seen.min(axis=0) - SURROUND, seen.max(axis=0) + SURROUND])
    fine = height_map(scan, surface_from_plane, step, box)
    if outline is None:
        moved = shapely.transform(found, lambda xy: _moved(xy, first, turn))
        shape, skin, scatter, level = _refined(fine, as_multi(shapely.make_valid(moved)), where, flipped)
    else:
        shape = _given(outline, surface_from_plane, where)
        skin, scatter = _skin_beside(fine, shape)
        level = 0.0
    return _judged(scan, fine, shape, skin, scatter, level, outline is not None, others, where)


def _moved(xy: Array, first: HeightMap, turn: Array) -> Array:
    return np.asarray(se3.transform_points(turn, np.column_stack([xy, at(first.grid, first.heights, xy)]))[:, :2])


def _first_plane(scan: Scan, where: object) -> Array:
    z = mean_normal(scan, where)
    return se3.make(_axes(z, np.eye(3)[0]), scan.vertices.mean(axis=0))


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
    origin = np.array([[*middle, float(at(first.grid, skin, middle[None])[0])]])
    axes = _axes(rotation @ z / np.linalg.norm(z), np.eye(3)[0])
    return se3.make(axes, se3.transform_points(first.surface_from_plane, origin)[0])


def _searched(first: HeightMap, where: object, flipped: bool) -> tuple[MultiPolygon, int]:
    """The largest depression, and how many others there are."""
    coarse = first.grid.coarser(max(COARSE, first.grid.step))
    known = downsampled(first.grid, coarse, first.known.astype(float)) > 0.99
    if known.sum() < FEWEST_NODES:
        width, height = first.grid.step * (np.array(first.grid.shape[::-1]) - 1)
        allowed = "a scan of a wound and the skin about it, in mm: --unit says so where it is in another unit"
        raise InputError(where, "scan", f"{width:.3g} x {height:.3g} mm that hardly hang together", allowed)
    surface, _, scatter = skin_nodes(coarse, downsampled(first.grid, coarse, first.heights), known)
    depth = np.where(first.known, upsampled(first.grid, coarse, surface) - first.heights, 0.0)
    level = max(LEAST_DEPTH, 4 * scatter)
    pieces, volumes = _depressions(first.grid, depth, level)
    raised = _depressions(first.grid, np.where(first.known, -depth, 0.0), level)[1]
    if not len(volumes) or volumes.max() < BULGE * raised.max(initial=0.0):
        _refuse(depth[first.known], where, flipped)
    deepest = int(np.argmax(volumes)) + 1
    found = region(first.grid, np.where(pieces == deepest, depth - level, -level), LEAST_PIECE, SLACK)
    return found, int(np.sum(volumes > 0.1 * volumes.max())) - 1


def _depressions(grid: Grid, depth: Array, level: float) -> tuple[Index, Array]:
    """Pieces (H, W) deeper than `level`, numbered from 1, and the volume (K,) of each; those that are small are 0."""
    labelled: tuple[Index, int] = label(depth > level)
    pieces, count = labelled
    if not count:
        return pieces, np.empty(0)
    area = np.bincount(pieces.ravel(), minlength=count + 1)[1:] * grid.step**2
    volume = np.bincount(pieces.ravel(), depth.ravel(), count + 1)[1:] * grid.step**2
    volume = np.where(area >= LEAST_AREA, volume, 0.0)
    return pieces, np.asarray(volume[: count if volume.any() else 0])


def _refuse(depth: Array, where: object, flipped: bool) -> None:
    low, high = np.percentile(depth, [1, 99])
    got = f"none found: hardly any of the scan lies deeper than {max(high, 0):.2g} mm under the skin"
    allowed = f"{LEAST_AREA:g} mm^2 deeper than {LEAST_DEPTH:g} mm, or an outline (--outline)"
    if -low > LEAST_DEPTH:
        inside_out = "leave --flip out" if flipped else "if it was scanned inside out, say --flip"
        allowed += f"; it bulges by {-low:.2g} mm: {inside_out}"
    raise InputError(where, "wound", got, allowed)


def _given(outline: Array, surface_from_plane: Array, where: object) -> MultiPolygon:
    flat = se3.transform_points(se3.inverse(surface_from_plane), outline)[:, :2]
    shape = as_multi(shapely.make_valid(shapely.Polygon(flat)), LEAST_PIECE)
    if shape.is_empty:
        raise InputError(where, "outline", f"{shape.area:.3g} mm^2", f"{LEAST_PIECE:g} mm^2 or more")
    return shape


def nodes_within(grid: Grid, shape: MultiPolygon) -> Mask:
    """(H, W) which nodes lie inside; at least one does."""
    x, y = grid.nodes[..., 0], grid.nodes[..., 1]
    inside = shapely.contains_xy(shape, x, y)
    if not inside.any():
        inside.flat[np.argmin(shapely.distance(shape, shapely.points(x, y)))] = True
    return np.asarray(inside)


def _skin_beside(fine: HeightMap, outline: MultiPolygon) -> tuple[Array, float]:
    """The restored skin (H, W) over an outline, from the skin further off than MARGIN, and the latter's scatter."""
    coarse = fine.grid.coarser(max(COARSE, fine.grid.step))
    heights = downsampled(fine.grid, coarse, fine.heights)
    known = downsampled(fine.grid, coarse, fine.known.astype(float)) > 0.99
    held = known & ~nodes_within(coarse, shapely.buffer(outline, MARGIN))
    if held.sum() < 12:
        held = known & ~nodes_within(coarse, outline)
    surface = restored(coarse, heights, held)
    off = np.abs(heights - surface)
    scatter = 1.4826 * float(np.median(off[held]))
    good = held & (off < max(4 * scatter, 0.3))  # a second wound, a fold, a hair
    if good.sum() >= 12 and good.sum() < held.sum():
        surface = restored(coarse, heights, good)
    return upsampled(fine.grid, coarse, surface), scatter


def _refined(
    fine: HeightMap, found: MultiPolygon, where: object, flipped: bool
) -> tuple[MultiPolygon, Array, float, float]:
    """Outline, restored skin, its scatter and the level of the rim."""
    skin, scatter, level = fine.heights, 0.0, LEAST_LEVEL
    for _ in range(ROUNDS):
        skin, scatter = _skin_beside(fine, found)
        depth = np.where(fine.known, skin - fine.heights, -1.0)
        inside = nodes_within(fine.grid, found)
        level = max(LEAST_LEVEL, LEVEL * float(np.percentile(depth[inside], 95)), NOISES * fine.noise)
        pieces, _ = label(depth > level)
        share = np.bincount(pieces[inside], minlength=2)
        if len(share) < 2 or not share[1:].any():
            _refuse(depth[fine.known], where, flipped)
        own = pieces == int(np.argmax(share[1:])) + 1
        wider = region(fine.grid, np.where(own | ~(depth > level), depth - level, -level), LEAST_PIECE, SLACK)
        opened = as_multi(shapely.buffer(shapely.buffer(wider, -OPENING), OPENING), LEAST_PIECE)
        if opened.is_empty:
            _refuse(depth[fine.known], where, flipped)
        before, found = found, as_multi(shapely.simplify(opened, SLACK))
        if shapely.symmetric_difference(before, found).area < 0.01 * found.area:
            break
    return found, skin, scatter, level


def _judged(
    scan: Scan, fine: HeightMap, shape: MultiPolygon, skin: Array, scatter: float, level: float,
    given: bool, others: int, where: object,
) -> Wound:  # fmt: skip
    inside = nodes_within(fine.grid, shape)
    known = inside & fine.known
    if known.sum() < 0.5 * inside.sum():
        share = f"{known.sum() / inside.sum():.0%} of the outline"
        raise InputError(where, "scanned part of the wound", share, "half of it or more: scan it again, or the outline")
    cell, depth = fine.grid.step**2, np.where(fine.known, skin - fine.heights, 0.0)
    rim = shapely.get_coordinates(shapely.segmentize(shape.boundary, fine.grid.step))
    inner = binary_erosion(fine.known, iterations=max(2, round(1.0 / fine.grid.step)))
    cut = float(np.mean(at(fine.grid, inner.astype(float), rim) < 0.5))
    if cut > CUT:
        allowed = f"{CUT:.0%} or less: scan 20 mm of skin around the wound"
        raise InputError(where, "share of the outline at the scan's own rim", f"{cut:.0%}", allowed)
    findings = Findings(
        given=given, area=float(shape.area), volume=float(np.maximum(depth, 0)[inside].sum() * cell),
        depth=float(depth[inside].max()), level=level, noise=fine.noise, smoothing=fine.smoothing, scatter=scatter,
        closed=float((fine.closed & inside).sum() * cell), hidden=_hidden(scan, fine, shape), cut=cut, others=others,
        notes=(),
    )  # fmt: skip
    if findings.depth < LEAST_DEPTH / 2:
        raise InputError(
            where, "depth inside the outline", f"{findings.depth:.2g} mm", f"{LEAST_DEPTH / 2:g} mm or more"
        )
    findings = replace(findings, notes=tuple(_notes(findings)))
    return Wound(fine.surface_from_plane, fine.grid, fine.heights, skin, shape, findings)


def _hidden(scan: Scan, fine: HeightMap, shape: MultiPolygon) -> float:
    """Area, mm^2, of the scan inside the outline that lies under an overhang or faces away."""
    corners = se3.transform_points(se3.inverse(fine.surface_from_plane), scan.vertices)[scan.triangles]
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(cross, axis=1) / 2
    middle = corners.mean(axis=1)
    below = at(fine.grid, fine.heights, middle[:, :2]) - middle[:, 2] > 1.0  # mm: more than any wall under smoothing
    away = cross[:, 2] < STEEP * 2 * area
    there = shapely.contains_xy(shape, middle[:, 0], middle[:, 1])
    return float(area[there & (below | away)].sum())


def _notes(findings: Findings) -> Sequence[str]:
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
