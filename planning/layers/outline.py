"""Places in a scan that may be the wound: an outline and the healthy skin over it, each found by the other, and judged.

A wound is deep, has a steep rim, and the colour of one where the scan has colours. Where no place is clearly the best,
a person is asked.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import shapely
from scipy.ndimage import binary_erosion, distance_transform_edt, label
from scipy.spatial import cKDTree
from shapely import MultiPolygon

from estimation import se3
from estimation.errors import InputError
from estimation.scans.scan import Scan
from estimation.se3 import Array
from planning.layers.grid import (
    Grid,
    HeightMap,
    Mask,
    as_multi,
    axes_along,
    filled,
    height_map,
    interpolate,
    nodes_within,
    positive_region,
    upsampled,
)
from planning.layers.skin import (
    MIN_CELLS,
    USUAL_KERNEL,
    Depression,
    RestoredSkin,
    SkinCells,
    SkinKernel,
    bent_base,
    depressions,
    restored_skin,
    skin_cells,
)

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
    outside = ~shapely.contains_xy(shapely.buffer(outline, margin), points[:, 0], points[:, 1])
    if outside.sum() < MIN_CELLS:
        outside = ~shapely.contains_xy(outline, points[:, 0], points[:, 1])
    around = points[outside] if outside.sum() >= MIN_CELLS else points
    cells = skin_cells(bent_base(around), around)
    gap = float(np.sqrt(outline.area / np.pi)) + margin
    skin, count, scatter = restored_skin(cells, gap, kernel), len(cells.heights), 0.0
    for _ in range(SKIN_ROUNDS):
        deviations = np.abs(cells.heights - skin.at(cells.places))
        scatter = 1.4826 * float(np.median(deviations))
        inlier = deviations < max(SKIN_SIGMAS * scatter, MIN_SKIN_BAND)  # no second wound, fold or hair
        if inlier.sum() == count or inlier.sum() < MIN_CELLS:
            break
        selected = SkinCells(cells.base, cells.places[inlier], cells.heights[inlier], cells.weights[inlier])
        skin, count = restored_skin(selected, gap, skin.kernel), int(inlier.sum())
    return skin, scatter


def _trusted_margin(points: Array, outline: MultiPolygon, skin: RestoredSkin) -> float:
    """How near to the rim, mm, the scan's skin agrees with that restored from beyond RIM_MARGIN."""
    near = shapely.contains_xy(shapely.buffer(outline, RIM_MARGIN + MARGIN_STEP), *points[:, :2].T)
    points = points[near]
    places, heights = skin.base.places(points)
    edges = np.arange(MIN_RIM_MARGIN, RIM_MARGIN, MARGIN_STEP)
    for low in edges[::-1]:
        outer, inner = (shapely.buffer(outline, low + width) for width in (MARGIN_STEP, 0.0))
        strip = shapely.contains_xy(outer, *points[:, :2].T) & ~shapely.contains_xy(inner, *points[:, :2].T)
        if not strip.any():
            continue
        offset = float(np.mean(heights[strip] - skin.at(places[strip])))
        if abs(offset) > MAX_SWELLING + float(np.median(skin.deviation(places[strip]))):
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
    margin, fixed_kernel = MIN_RIM_MARGIN if near else RIM_MARGIN, kernel
    for turn in range(OUTLINE_ROUNDS):
        restored, scatter = skin_around(points, outline, margin, fixed_kernel)
        skin = skin_heights(restored, fine.grid)
        rim = np.column_stack([shapely.get_coordinates(outline), np.zeros(shapely.get_num_coordinates(outline))])
        sigma = float(np.median(restored.deviation(restored.base.places(rim)[0])))
        level, new_outline = _rim_of(fine, np.where(fine.known, skin - fine.heights, -1.0), outline, sigma)
        if new_outline.is_empty:
            return None
        last_outline, outline, fixed_kernel = outline, new_outline, restored.kernel
        same = shapely.intersection(last_outline, outline).area > SAME_SHARE * shapely.union(last_outline, outline).area
        if near is None and (same or turn == OUTLINE_ROUNDS - 2):
            near, same = _trusted_margin(points, outline, restored) < RIM_MARGIN, False
            if not near:
                break
            margin, fixed_kernel = MIN_RIM_MARGIN, kernel
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
    below_rim = (depth > level) & (distance_transform_edt(~core) * fine.grid.step < reach)
    wound = _largest(below_rim, core)
    rise = np.where(wound | (depth <= level), depth - level, -level)
    wider = positive_region(fine.grid, rise, MIN_PIECE, OUTLINE_TOLERANCE)
    opened = as_multi(shapely.buffer(shapely.buffer(wider, -OPENING_RADIUS), OPENING_RADIUS), MIN_PIECE)
    shape = as_multi(shapely.simplify(opened, OUTLINE_TOLERANCE))
    return level, shape if shape.area >= MIN_AREA / 2 else MultiPolygon()


def _largest(nodes: Mask, inside: Mask) -> Mask:
    """The piece (H, W) of the nodes chosen that has most nodes inside; none where it has none."""
    pieces, _ = label(nodes)
    share = np.bincount(pieces[inside], minlength=2)[1:]
    return np.asarray((pieces == int(np.argmax(share)) + 1) & bool(share.any()))


def share_cut(fine: HeightMap, shape: MultiPolygon) -> float:
    """Share of an outline that lies along the scan's own rim."""
    rim = shapely.get_coordinates(shapely.segmentize(shape.boundary, fine.grid.step))
    inner = binary_erosion(fine.known, iterations=max(2, round(1.0 / fine.grid.step)))
    return float(np.mean(interpolate(fine.grid, inner.astype(float), rim) < 0.5))


MAX_PLACES = 6  # depressions that are outlined and judged
NEAR_BONUS = 1.1  # of a rim's steepness, for skin that is held near it: a swollen rim costs a third of it
RIM_INSIDE, RIM_OUTSIDE = 2.0, 1.0  # mm from the outline, between which a wound's wall falls
RIVAL_CLARITY = 0.2  # of the clearest depression's: less clear ones are not looked at
# on bodies without a wound the best place had 4.2 of 24, beside one 13; carved wounds 33 or more, the simulator's 11
MIN_SCORE, SURE_SCORE, RIVAL_SHARE = 4.5, 6.0, 0.4  # of a place; of one that is planned; and of another as likely
INSIDE_OUT_CLARITY = 2.0  # of a bulge that may be a wound from the other side


@dataclass(frozen=True, slots=True, eq=False)
class WoundPlace:
    """A place in a scan that may be the wound."""

    outline: Array  # (N, 3) mm, scan frame, on the scan
    area: float  # mm^2
    depth: float  # mm
    steepness: float  # how much of the depth is reached within RIM_INSIDE + RIM_OUTSIDE mm across its rim
    clarity: float  # of the scan's clearest depression
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

    def __reduce__(self) -> tuple[type[WoundQuestionError], tuple[str, tuple[WoundPlace, ...]]]:  # type: ignore[override]
        """Pickled by its parts."""
        return type(self), (self.where, self.places)


@dataclass(frozen=True, slots=True, eq=False)
class ScanColour:
    """How much a scan is coloured like a wound."""

    points: Array  # (N, 3) mm, scan frame
    shares: Array  # (N,) from 0, skin, to 1, wound; nan where no picture shows it


def wound_places(
    scan: Scan, first: HeightMap, colour: ScanColour | None
) -> tuple[list[tuple[WoundPlace, OutlinedWound]], Sequence[Depression]]:
    """Places that may be the wound, the best first; and the clearest bulges, the clearest first."""
    candidates, bulges = depressions(first.grid, first.heights, first.known, MAX_PLACES)
    rated = [
        place
        for candidate in candidates
        if candidate.clarity > RIVAL_CLARITY * candidates[0].clarity and candidate.depth > MIN_DEPTH / 4
        for place in _judged_depression(scan, first, candidate, colour, candidates[0].clarity)
    ]
    rated.sort(key=lambda pair: -pair[0].score)
    distinct = list[tuple[WoundPlace, OutlinedWound]]()
    for judgement, place in rated:  # two discs may lead to one outline
        middle = judgement.outline.mean(axis=0)
        size = np.sqrt(judgement.area)
        if all(np.linalg.norm(middle - k.outline.mean(axis=0)) > 0.5 * max(size, np.sqrt(k.area)) for k, _ in distinct):
            distinct.append((judgement, place))
    return distinct, bulges


def _judged_depression(
    scan: Scan, first: HeightMap, depression: Depression, colour: ScanColour | None, clarity: float
) -> Sequence[tuple[WoundPlace, OutlinedWound]]:
    """The wound at a depression of the first map, in a plane of its own; none where there is none.

    Where the skin at the rim is not as the skin further out lets expect, either the rim is swollen or the body bends
    too much to tell: of both the one counts by which the rim is steeper, and in doubt the nearer skin.
    """
    z = np.array([-depression.slope[0], -depression.slope[1], 1.0])
    rotation = first.surface_from_plane[:3, :3]
    middle = se3.transform_points(first.surface_from_plane, np.array([depression.middle]))[0]
    plane = se3.make(axes_along(rotation @ z / np.linalg.norm(z), np.eye(3)[0]), middle)
    disc = as_multi(shapely.Point(0.0, 0.0).buffer(1.2 * depression.radius))
    fine = height_map(scan, plane, SEARCH_STEP, surround_box(disc))
    if fine.known.sum() < MIN_NODES:
        return []
    far = outlined(scan, fine, disc, None, USUAL_KERNEL)
    candidates = [far]
    if far is None or far.margin == RIM_MARGIN:
        candidates.append(outlined(scan, fine, disc if far is None else far.outline, True, USUAL_KERNEL))
    rated = [(_judged(place, clarity, colour), place) for place in candidates if place is not None]
    return sorted(rated, key=lambda pair: -pair[0].steepness * (NEAR_BONUS if pair[1].margin < RIM_MARGIN else 1.0))[:1]


def _judged(place: OutlinedWound, clarity: float, colour: ScanColour | None) -> WoundPlace:
    """How much a place is like a wound: deep, steep at its rim, coloured like one."""
    fine, outline = place.fine, place.outline
    depth = place.depth
    inside = nodes_within(fine.grid, outline)
    deep = float(np.percentile(depth[inside], 95))
    rims = [_around(outline, distance) for distance in (-RIM_INSIDE, RIM_OUTSIDE)]
    if len(rims[0]):
        falls = [float(np.median(interpolate(fine.grid, depth, rim))) for rim in rims]
        steepness = min((falls[0] - max(falls[1], 0.0)) / max(deep, 1e-6), 1.0)
    else:
        steepness = 1.0  # narrower than that: all of it is rim
    points = points_on(fine, shapely.get_coordinates(outline.geoms[0].exterior))
    share = float("nan")
    if colour is not None:
        share = _coloured(colour, points_on(fine, fine.grid.nodes[inside]))
    complete = 1 - share_cut(fine, outline)  # what the scan's own rim cuts off is hardly the wound that was scanned
    likeness = 1.0 if np.isnan(share) else 0.1 + share
    score = np.sqrt(outline.area) * deep * max(steepness, 0.02) ** 2 * likeness * complete**2
    return WoundPlace(points, float(outline.area), deep, steepness, clarity, share, float(score))


def _around(outline: MultiPolygon, distance: float) -> Array:
    """Points (N, 2) along an outline moved outwards by `distance` mm."""
    return np.asarray(shapely.get_coordinates(shapely.segmentize(shapely.buffer(outline, distance), 1.0)))


def _coloured(colour: ScanColour, points: Array) -> float:
    """Mean share of wound colour at points (N, 3); nan where none is known."""
    valid = np.isfinite(colour.shares)
    if not valid.any():
        return float("nan")
    _, near = cKDTree(colour.points[valid]).query(points)
    return float(colour.shares[valid][near].mean())


def chosen_place(
    places: list[tuple[WoundPlace, OutlinedWound]], number: int | None, first: HeightMap, where: object, flipped: bool,
    bulges: Sequence[Depression],
) -> tuple[OutlinedWound, int]:  # fmt: skip
    """The place that is clearly the wound, or the one that was named, and how many others there are.

    bulges: of the first map, the clearest first.
    """
    if number is not None:
        if not 1 <= number <= len(places):
            raise InputError(where, "number of the wound", number, f"1 to {len(places)}, the places that may be it")
        return places[number - 1][1], len(places) - 1
    likely = [p for p in places if p[0].score >= MIN_SCORE]
    if not likely or (bulges and bulges[0].clarity > max(p.clarity for p, _ in places)):
        deepest = max((float(np.percentile(p.depth, 99)) for _, p in places), default=0.0)
        raise refusal(first, deepest, where, flipped)
    rivals = [p for p in likely if p[0].score > RIVAL_SHARE * likely[0][0].score]
    if len(rivals) > 1 or likely[0][0].score < SURE_SCORE:
        raise WoundQuestionError(where, [p for p, _ in rivals])
    return likely[0][1], len(likely) - 1


def refusal(first: HeightMap, depth: float, where: object, flipped: bool) -> InputError:
    """That there is no wound, and what may be wrong with the scan. depth: mm, of what is deepest."""
    if first.known.sum() < MIN_NODES:
        width, height = first.grid.step * (np.array(first.grid.shape[::-1]) - 1)
        allowed = "a scan of a wound and the skin about it, in mm: --unit says so where it is in another unit"
        return InputError(where, "scan", f"{width:.3g} x {height:.3g} mm that hardly hang together", allowed)
    got = f"none found: no hollow with a steep rim; the deepest is {max(depth, 0):.2g} mm under the skin around it"
    allowed = f"{MIN_AREA:g} mm^2 deeper than {MIN_DEPTH:g} mm, with a rim; or --outline, or --clicks"
    _, bulges = depressions(first.grid, first.heights, first.known, 1)
    if bulges and bulges[0].depth > MIN_DEPTH and bulges[0].clarity > INSIDE_OUT_CLARITY:
        inside_out = "leave --flip out" if flipped else "if it was scanned inside out, say --flip"
        allowed += f"; it bulges by {bulges[0].depth:.2g} mm: {inside_out}"
    return InputError(where, "wound", got, allowed)
