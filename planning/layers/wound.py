"""The volume to be printed: between the wound's bed and the healthy skin that is restored over it.

The wound is looked for at every depression of the scan: each is outlined where it lies under the skin that is restored
from around it, and judged by its depth, its steep rim, and its colour where the scan has one. Where no place is
clearly the best, nothing is planned: a person is asked.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import shapely
from scipy.ndimage import binary_erosion, label, map_coordinates
from scipy.spatial import cKDTree
from shapely import MultiPolygon

from estimation import se3
from estimation.errors import InputError
from estimation.scans.scan import Scan
from estimation.se3 import Array, Index
from planning.layers.depressions import Depression, depressions
from planning.layers.grid import Grid, HeightMap, Mask, as_multi, filled, height_map, interpolate, positive_region
from planning.layers.repair import mean_normal
from planning.layers.skin import MIN_CELLS, USUAL_KERNEL, RestoredSkin, SkinCells, SkinKernel, bent_base, restored_skin, skin_cells

SEARCH_STEP = 0.75  # mm between nodes while the wound is looked for
SKIN_STEP = 3.0  # mm between nodes where the skin is worked out; it bends over centimetres
SURROUND_WIDTH = 30.0  # mm of skin around the wound that is looked at
# mm of skin along the rim that is not trusted at first, as it may be swollen or rolled in; and the least that is left out
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
OPENING_RADIUS = 0.5  # mm: creases narrower than twice that are not part of a wound
OUTLINE_ROUNDS, SAME_SHARE = 4, 0.99  # of outline and restored skin: each is found by the other; and when it is
MAX_CUT_SHARE = 0.25  # share of the outline that may lie along the scan's rim, where no skin holds the restored surface
MIN_UPWARD = 0.1  # upward part of a triangle's normal: below, it is an overhang's
MAX_PLACES = 6  # depressions that are outlined and judged
RIM_INSIDE, RIM_OUTSIDE = 2.0, 1.0  # mm from the outline, between which a wound's wall falls
MAX_VOLUME_NODES = 400  # of the skin, of which the volume's deviation is summed
RIVAL_CLARITY = 0.15  # of the clearest depression's: less clear ones are not looked at
MIN_SCORE, SURE_SCORE, RIVAL_SHARE = 4.5, 6.0, 0.4
INSIDE_OUT_CLARITY = 3.0  # of a bulge that would be a wound from the other side
SIGMA_95 = 1.96  # deviations on either side of the mean, in a 95 % interval


@dataclass(frozen=True, slots=True, eq=False)
class WoundVolume:
    """The volume to be filled, over a grid in the plane."""

    surface_from_plane: Array  # (4, 4) mm
    grid: Grid
    bed: Array  # (H, W) mm, heights of the scan, the wound's bed inside
    skin: Array  # (H, W) mm, heights of the skin to be restored
    sigma: Array  # (H, W) mm, their standard deviation
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
    volume_sigma: float  # mm^3, standard deviation of the volume: what the skin's place leaves open
    depth: float  # mm
    skin_sigma: float  # mm, greatest standard deviation of the restored skin
    margin: float  # mm of skin along the rim that was left out, as it is swollen or too near
    level: float  # mm, depth at which the rim was drawn
    noise: float  # mm, of the scan
    smoothing: float  # mm over which the scan was averaged
    scatter: float  # mm, of the skin around about the restored surface
    closed: float  # mm^2 of holes that were closed inside the wound
    hidden: float  # mm^2 of the scan inside the outline that an overhang hides
    cut: float  # share of the outline along the scan's rim
    others: int  # further depressions that were left alone
    notes: tuple[str, ...]  # what somebody should look at


@dataclass(frozen=True, slots=True, eq=False)
class WoundPlace:
    """A place in a scan that may be the wound."""

    outline: Array  # (N, 3) mm, scan frame, on the scan
    area: float  # mm^2
    depth: float  # mm
    steepness: float  # how much of the depth is reached within RIM_INSIDE + RIM_OUTSIDE mm across its rim
    colour: float  # share of it that is coloured as a wound; nan without colours
    score: float  # by which places are compared


class WoundQuestionError(InputError):
    """Which of several places is the wound, a person has to say."""

    def __init__(self, where: object, places: Sequence[WoundPlace]) -> None:
        got = f"{len(places)} places that may be it" if len(places) > 1 else "one place that may be it, not clearly"
        named = (f"{i}: {p.area:.0f} mm^2, {p.depth:.1f} mm deep" for i, p in enumerate(places, 1))
        allowed = f"--wound NUMBER, --clicks or --outline say which ({'; '.join(named)})"
        super().__init__(where, "wound", got, allowed)
        self.places = tuple(places)


@dataclass(frozen=True, slots=True, eq=False)
class ScanColour:
    """How much a scan is coloured like a wound."""

    points: Array  # (N, 3) mm, scan frame
    shares: Array  # (N,) from 0, skin, to 1, wound; nan where no picture shows it


def upsampled(grid: Grid, coarse: Grid, values: Array) -> Array:
    """Values (h, w) of a coarse grid at the nodes of a fine one (H, W), by cubic splines."""
    ratio = grid.step / coarse.step
    rows, columns = (np.arange(n) * ratio for n in grid.shape)
    return np.asarray(map_coordinates(values, np.meshgrid(rows, columns, indexing="ij"), order=3, mode="nearest"))


@dataclass(frozen=True, slots=True, eq=False)
class _Outlined:
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


def find_wound(
    scan: Scan, step: float, where: object, outline: Array | None = None, flipped: bool = False, *,
    clicks: Array | None = None, number: int | None = None, colour: ScanColour | None = None,
) -> WoundVolume:  # fmt: skip
    """The wound in a scan, over a grid `step` mm fine.

    outline: (N, 3) mm, scan frame; clicks: (3 or more, 3) mm, on its rim; number: of the places that a question has
    shown, from 1; without any of them it is looked for. flipped: whether the scan was turned over, as a refusal says
    then. InputError where there is none, or where the scan does not hold it; WoundQuestionError where it is not clear
    which place it is.
    """
    others = 0
    if outline is not None or clicks is not None:
        drawn = _ring_through(clicks) if outline is None else outline
        place = _place_at(scan, drawn, where)
    else:
        axes = _axes(mean_normal(scan.vertices, scan.triangles, where), np.eye(3)[0])
        first = height_map(scan, se3.make(axes, scan.vertices.mean(axis=0)), SEARCH_STEP)
        places = _places(scan, first, colour)
        place, others = _chosen(places, number, first, where, flipped)
    surface_from_plane = _plane_over(place)
    coarse = place.fine
    turn = se3.inverse(surface_from_plane) @ coarse.surface_from_plane
    shape = as_multi(shapely.make_valid(shapely.transform(place.outline, lambda xy: _moved(xy, coarse, turn))))
    fine = height_map(scan, surface_from_plane, step, _box(shape))
    if outline is None:
        found = _outlined(scan, fine, shape)
        if found is None:
            raise _refusal(coarse, place.depth, where, flipped)
    else:
        shape = _given(outline, surface_from_plane, where)
        found = _with_skin(scan, fine, shape)
    return _checked_wound(scan, found, outline is not None, others, where)


def _box(shape: MultiPolygon) -> Array:
    """Low and high corner (2, 2), mm, of what is looked at around a shape."""
    low, high = np.array(shape.bounds).reshape(2, 2)
    return np.array([low - SURROUND_WIDTH, high + SURROUND_WIDTH])


def _ring_through(clicks: Array | None) -> Array:
    """Points (N, 3) around the circle that lies best through points (3 or more, 3) of a rim."""
    assert clicks is not None
    middle = clicks.mean(axis=0)
    axes = np.linalg.svd(clicks - middle)[2][:2]
    x, y = (clicks - middle) @ axes[0], (clicks - middle) @ axes[1]
    a, b, c = np.linalg.lstsq(np.column_stack([2 * x, 2 * y, np.ones(len(x))]), x * x + y * y, rcond=None)[0]
    angle = np.linspace(0, 2 * np.pi, 60, endpoint=False)
    flat = np.column_stack([np.cos(angle), np.sin(angle)]) * np.sqrt(c + a * a + b * b) + [a, b]
    return np.asarray(middle + flat @ axes)


def _places(scan: Scan, first: HeightMap, colour: ScanColour | None) -> list[tuple[WoundPlace, _Outlined]]:
    """Places that may be the wound, the best first."""
    found = depressions(first.grid, first.heights, first.known, MAX_PLACES)
    judged = []
    for each in found:
        if each.clarity > RIVAL_CLARITY * found[0].clarity and each.depth > MIN_DEPTH / 4:
            place = _outlined_depression(scan, first, each)
            if place is not None:
                judged.append((_judged(place, colour), place))
    judged.sort(key=lambda pair: -pair[0].score)
    kept = list[tuple[WoundPlace, _Outlined]]()
    for judgement, place in judged:  # two discs may lead to one outline
        middle = judgement.outline.mean(axis=0)
        size = np.sqrt(judgement.area)
        if all(np.linalg.norm(middle - k.outline.mean(axis=0)) > 0.5 * max(size, np.sqrt(k.area)) for k, _ in kept):
            kept.append((judgement, place))
    return kept


def _outlined_depression(scan: Scan, first: HeightMap, hollow: Depression) -> _Outlined | None:
    """The wound at a depression of the first map, in a plane of its own; None where there is none."""
    z = np.array([-hollow.slope[0], -hollow.slope[1], 1.0])
    rotation = first.surface_from_plane[:3, :3]
    middle = se3.transform_points(first.surface_from_plane, np.array([hollow.middle]))[0]
    plane = se3.make(_axes(rotation @ z / np.linalg.norm(z), np.eye(3)[0]), middle)
    disc = as_multi(shapely.Point(0.0, 0.0).buffer(1.2 * hollow.radius))
    fine = height_map(scan, plane, SEARCH_STEP, _box(disc))
    return _outlined(scan, fine, disc, USUAL_KERNEL) if fine.known.sum() > MIN_NODES else None


def _judged(place: _Outlined, colour: ScanColour | None) -> WoundPlace:
    """How much a place is like a wound: deep, steep at its rim, coloured like one."""
    fine, outline = place.fine, place.outline
    depth = place.depth
    inside = nodes_within(fine.grid, outline)
    deep = float(np.percentile(depth[inside], 95))
    rims = [_around(outline, away) for away in (-RIM_INSIDE, RIM_OUTSIDE)]
    if len(rims[0]):
        falls = [float(np.median(interpolate(fine.grid, depth, rim))) for rim in rims]
        steepness = min((falls[0] - max(falls[1], 0.0)) / max(deep, 1e-6), 1.0)
    else:
        steepness = 1.0  # narrower than that: all of it is rim
    points = _on(fine, shapely.get_coordinates(outline.geoms[0].exterior))
    share = float("nan")
    if colour is not None:
        share = _coloured(colour, _on(fine, fine.grid.nodes[inside]))
    score = np.sqrt(outline.area) * deep * max(steepness, 0.02) ** 2 * (1.0 if np.isnan(share) else 0.1 + share)
    return WoundPlace(points, float(outline.area), deep, steepness, share, float(score))


def _around(outline: MultiPolygon, away: float) -> Array:
    """Points (N, 2) along an outline moved outwards by `away` mm."""
    return np.asarray(shapely.get_coordinates(shapely.segmentize(shapely.buffer(outline, away), 1.0)))


def _on(fine: HeightMap, xy: Array) -> Array:
    """Points (N, 3), scan frame, on the scan over points (N, 2) of the plane."""
    points = np.column_stack([xy, interpolate(fine.grid, fine.heights, xy)])
    return se3.transform_points(fine.surface_from_plane, points)


def _coloured(colour: ScanColour, points: Array) -> float:
    """Mean share of wound colour at points (N, 3); nan where none is known."""
    known = np.isfinite(colour.shares)
    if not known.any():
        return float("nan")
    _, near = cKDTree(colour.points[known]).query(points)
    return float(colour.shares[known][near].mean())


def _chosen(
    places: list[tuple[WoundPlace, _Outlined]], number: int | None, first: HeightMap, where: object, flipped: bool
) -> tuple[_Outlined, int]:
    """The place that is clearly the wound, or the one that was named, and how many others there are."""
    if number is not None:
        if not 1 <= number <= len(places):
            raise InputError(where, "number of the wound", number, f"1 to {len(places)}, the places that may be it")
        return places[number - 1][1], len(places) - 1
    likely = [p for p in places if p[0].score >= MIN_SCORE]
    if not likely:
        _, deepest = max(places, key=lambda p: p[0].depth, default=(None, None))
        raise _refusal(first, np.zeros(1) if deepest is None else deepest.depth, where, flipped)
    rivals = [p for p in likely if p[0].score > RIVAL_SHARE * likely[0][0].score]
    if len(rivals) > 1 or likely[0][0].score < SURE_SCORE:
        raise WoundQuestionError(where, [p for p, _ in rivals])
    return likely[0][1], len(likely) - 1


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


def _plane_over(place: _Outlined) -> Array:
    """The plane across the skin over an outline: origin on it over the outline's middle, z its mean normal there."""
    grid = place.fine.grid
    steep_y, steep_x = np.gradient(place.skin, grid.step)
    inside = nodes_within(grid, place.outline)
    z = np.array([-steep_x[inside].mean(), -steep_y[inside].mean(), 1.0])
    rotation = place.fine.surface_from_plane[:3, :3]
    middle = np.array(place.outline.centroid.coords[0])
    origin = np.array([[*middle, float(interpolate(grid, place.skin, middle[None])[0])]])
    axes = _axes(rotation @ z / np.linalg.norm(z), np.eye(3)[0])
    return se3.make(axes, se3.transform_points(place.fine.surface_from_plane, origin)[0])


def _place_at(scan: Scan, outline: Array, where: object) -> _Outlined:
    """A wound whose outline (N, 3) mm, scan frame, is given, in a plane of its own."""
    middle = outline.mean(axis=0)
    z = np.linalg.svd(outline - middle)[2][2]
    near = np.argsort(np.linalg.norm(scan.vertices - middle, axis=1))[: max(50, len(scan.vertices) // 50)]
    outwards = scan.normals[near].mean(axis=0)
    plane = se3.make(_axes(z if z @ outwards > 0 else -z, np.eye(3)[0]), middle)
    shape = _given(outline, plane, where)
    fine = height_map(scan, plane, SEARCH_STEP, _box(shape))
    if fine.known.sum() < MIN_NODES:
        raise InputError(where, "scan", "hardly any of it at the outline", "an outline in the scan's frame, on it")
    return _with_skin(scan, fine, shape)


def _refusal(first: HeightMap, depth: Array, where: object, flipped: bool) -> InputError:
    """That there is no wound, and what may be wrong with the scan."""
    if first.known.sum() < MIN_NODES:
        width, height = first.grid.step * (np.array(first.grid.shape[::-1]) - 1)
        allowed = "a scan of a wound and the skin about it, in mm: --unit says so where it is in another unit"
        return InputError(where, "scan", f"{width:.3g} x {height:.3g} mm that hardly hang together", allowed)
    high = float(np.percentile(depth, 99))
    got = f"none found: hardly any of the scan lies deeper than {max(high, 0):.2g} mm under the skin"
    allowed = f"{MIN_AREA:g} mm^2 deeper than {MIN_DEPTH:g} mm, with a rim; or an outline (--outline), or three clicks"
    bulges = depressions(first.grid, -first.heights, first.known, 1)
    if bulges and bulges[0].depth > MIN_DEPTH and bulges[0].clarity > INSIDE_OUT_CLARITY:
        inside_out = "leave --flip out" if flipped else "if it was scanned inside out, say --flip"
        allowed += f"; it bulges by {bulges[0].depth:.2g} mm: {inside_out}"
    return InputError(where, "wound", got, allowed)


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


def _skin_points(scan: Scan, fine: HeightMap) -> Array:
    """Vertices (P, 3) mm, plane frame, of the scan that are seen from above, within the map."""
    plane_from_surface = se3.inverse(fine.surface_from_plane)
    points = se3.transform_points(plane_from_surface, scan.vertices)
    low, high = fine.grid.origin, np.array([fine.grid.x[-1], fine.grid.y[-1]])
    upward = scan.normals @ plane_from_surface[2, :3]
    near = ((points[:, :2] >= low) & (points[:, :2] <= high)).all(axis=1) & (upward > MIN_UPWARD)
    points, upward = points[near], upward[near]
    under = (interpolate(fine.grid, fine.heights, points[:, :2]) - points[:, 2]) * upward
    return np.asarray(points[under < max(1.0, SKIN_SIGMAS * fine.noise)])


def _restored(
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


def _with_skin(scan: Scan, fine: HeightMap, outline: MultiPolygon) -> _Outlined:
    """An outline with the skin over it, held as near to the rim as the skin there is sound."""
    points = _skin_points(scan, fine)
    far, _ = _restored(points, outline, RIM_MARGIN)
    margin = _trusted_margin(points, outline, far)
    restored, scatter = _restored(points, outline, margin)
    return _Outlined(fine, outline, restored, _heights_over(restored, fine.grid), margin, scatter, 0.0)


def _heights_over(restored: RestoredSkin, grid: Grid) -> Array:
    """Heights (H, W) mm of the restored skin over the plane."""
    coarse = grid.coarser(max(SKIN_STEP, grid.step))
    _, heights = restored.over(coarse)
    known = np.isfinite(heights)
    return upsampled(grid, coarse, filled(np.where(known, heights, 0.0), known) if known.any() else np.zeros(coarse.shape))


def _outlined(scan: Scan, fine: HeightMap, outline: MultiPolygon, kernel: SkinKernel | None = None) -> _Outlined | None:
    """Outline and restored skin, each found by the other, from a first outline; None where nothing lies deep there.

    kernel: of the skin; by cross-validation without.
    """
    points = _skin_points(scan, fine)
    if len(points) < MIN_CELLS:
        return None
    margin, known = RIM_MARGIN, kernel
    for turn in range(OUTLINE_ROUNDS):
        restored, scatter = _restored(points, outline, margin, known)
        skin = _heights_over(restored, fine.grid)
        level, now = _rim_of(fine, np.where(fine.known, skin - fine.heights, -1.0), outline)
        if now.is_empty:
            return None
        before, outline, known = outline, now, restored.kernel
        same = shapely.intersection(before, outline).area > SAME_SHARE * shapely.union(before, outline).area
        if turn and margin < RIM_MARGIN and same:
            break
        if same or turn == OUTLINE_ROUNDS - 2:
            closer = _trusted_margin(points, outline, restored)
            if closer == margin and same:
                break
            margin, known = closer, kernel
    return _Outlined(fine, outline, restored, skin, margin, scatter, level)


def _rim_of(fine: HeightMap, depth: Array, outline: MultiPolygon) -> tuple[float, MultiPolygon]:
    """The level of the rim, mm, and the outline of what lies deeper, where `outline` has most of it; or an empty one."""
    inside = nodes_within(fine.grid, outline)
    deep = float(np.percentile(depth[inside], 95))
    level = max(MIN_RIM_LEVEL, RIM_LEVEL_SHARE * deep, RIM_NOISE_SIGMAS * fine.noise)
    pieces, _ = label(depth > level)
    share = np.bincount(pieces[inside], minlength=2)
    if not share[1:].any():
        return level, MultiPolygon()
    own = pieces == int(np.argmax(share[1:])) + 1
    rise = np.where(own | ~(depth > level), depth - level, -level)
    wider = positive_region(fine.grid, rise, MIN_PIECE, OUTLINE_TOLERANCE)
    opened = as_multi(shapely.buffer(shapely.buffer(wider, -OPENING_RADIUS), OPENING_RADIUS), MIN_PIECE)
    shape = as_multi(shapely.simplify(opened, OUTLINE_TOLERANCE))
    return level, shape if shape.area >= MIN_AREA / 2 else MultiPolygon()


def _checked_wound(scan: Scan, found: _Outlined, given: bool, others: int, where: object) -> WoundVolume:
    fine, shape, skin = found.fine, found.outline, found.skin
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
    sigma, volume_sigma = _deviations(found)
    findings = WoundFindings(
        given=given, area=float(shape.area), volume=float(np.maximum(depth, 0)[inside].sum() * cell),
        volume_sigma=volume_sigma, skin_sigma=float(sigma[inside].max()), margin=found.margin,
        depth=float(depth[inside].max()), level=found.level, noise=fine.noise, smoothing=fine.smoothing,
        scatter=found.scatter,
        closed=float((fine.closed & inside).sum() * cell), hidden=_hidden(scan, fine, shape), cut=cut, others=others,
        notes=(),
    )  # fmt: skip
    if findings.depth < MIN_DEPTH / 2:
        raise InputError(where, "depth inside the outline", f"{findings.depth:.2g} mm", f"{MIN_DEPTH / 2:g} mm or more")
    findings = replace(findings, notes=tuple(_notes(findings)))
    return WoundVolume(fine.surface_from_plane, fine.grid, fine.heights, skin, sigma, shape, findings)


def _deviations(found: _Outlined) -> tuple[Array, float]:
    """Standard deviations of the skin's heights (H, W), mm, and of the volume under it, mm^3."""
    grid = found.fine.grid
    coarse = grid.coarser(max(SKIN_STEP, grid.step))
    places, heights = found.restored.over(coarse)
    known = np.isfinite(heights)
    sigma = np.full(coarse.shape, np.nan)
    sigma[known] = found.restored.deviation(places[known])
    inside = known & nodes_within(coarse, found.outline)
    every = places[inside][:: max(1, int(inside.sum()) // MAX_VOLUME_NODES)]
    mean_sigma = float(np.sqrt(max(found.restored.covariance(every).mean(), 0.0))) if len(every) else float("nan")
    return upsampled(grid, coarse, filled(sigma, known)), mean_sigma * float(found.outline.area)


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
