"""Places in a scan that may be the wound: depressions, outlined under the skin restored from around, and judged.

A depression is a disc that lies under the quadric through the ring around it, at any place and scale. A quadric is what
skin is like over some centimetres, whatever limb it is on, so the roundness of a body is none. The fits at all places
are sums over discs and rings, which are convolutions of the heights' moments. A wound is deep, has a steep rim, and the
colour of one where the scan has colours. Where no place is clearly the best, a person is asked.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import shapely
from scipy.ndimage import maximum_filter
from scipy.signal import fftconvolve
from scipy.spatial import cKDTree
from shapely import MultiPolygon

from estimation import se3
from estimation.errors import InputError
from estimation.scans.scan import Scan
from estimation.se3 import Array
from planning.layers.grid import Grid, HeightMap, Mask, as_multi, height_map, interpolate
from planning.layers.outline import (
    MIN_AREA,
    MIN_DEPTH,
    MIN_NODES,
    RIM_MARGIN,
    SEARCH_STEP,
    OutlinedWound,
    axes_along,
    nodes_within,
    outlined,
    points_on,
    share_cut,
    surround_box,
)
from planning.layers.skin import USUAL_KERNEL

DISC_RADII = (4.0, 6.0, 9.0, 13.0, 18.0, 25.0, 34.0)  # mm
RING_GAP, RING_SCALE, RING_WIDTH = 1.5, 1.5, 6.0  # mm outside the disc, to so many radii and mm more
DISC_STEP = 1.5  # mm between nodes where they are looked for
MIN_RING_SHARE, MIN_DISC_SHARE = 0.6, 0.5  # of the ring and of the disc that must have been scanned
MIN_UNEVENNESS = 0.15  # mm, of the ring about its quadric: a smoother one is no surer
MAX_CONDITION = 1e9  # of a fit


@dataclass(frozen=True, slots=True)
class Depression:
    """A disc that lies under the skin around it, in the plane of the heights."""

    middle: tuple[float, float, float]  # mm, on the quadric
    slope: tuple[float, float]  # of the quadric there
    radius: float  # mm
    depth: float  # mm, mean of the disc under the quadric, along its normal
    clarity: float  # depth over the unevenness of the ring


def depressions(grid: Grid, heights: Array, known: Mask, most: int) -> Sequence[Depression]:
    """The clearest depressions of heights (H, W) where `known` (H, W), none in another's disc, the clearest first."""
    coarse = grid.coarser(max(DISC_STEP, grid.step))
    nodes = coarse.nodes.reshape(-1, 2)
    values = interpolate(grid, heights, nodes).reshape(coarse.shape)
    valid = interpolate(grid, known.astype(float), nodes).reshape(coarse.shape) > 0.99
    if not valid.any():
        return []
    level = float(values[valid].mean())  # sums of squares keep their digits
    values = np.where(valid, values - level, 0.0)
    found = [each for radius in DISC_RADII for each in _at_scale(coarse, values, valid, radius, level)]
    chosen = list[Depression]()
    for each in sorted(found, key=lambda d: -d.clarity * np.sqrt(d.radius)):
        apart = [np.hypot(each.middle[0] - c.middle[0], each.middle[1] - c.middle[1]) for c in chosen]
        if all(far > max(c.radius, 0.7 * each.radius) for far, c in zip(apart, chosen, strict=True)):
            chosen.append(each)
        if len(chosen) == most:
            break
    return chosen


def _at_scale(grid: Grid, values: Array, valid: Mask, radius: float, level: float) -> Sequence[Depression]:
    """The local best discs of one radius (mm)."""
    reach = RING_SCALE * radius + RING_WIDTH
    half = int(np.ceil(reach / grid.step))
    if 2 * half + 1 > 2 * max(grid.shape):
        return []
    x, y = np.meshgrid(*[np.arange(-half, half + 1) * grid.step / reach] * 2)
    far = np.hypot(x, y) * reach
    ring, disc = ((far >= radius + RING_GAP) & (far <= reach)).astype(float), (far <= radius).astype(float)
    terms = [np.ones_like(x), x, y, x * x, x * y, y * y]
    there = valid.astype(float)
    around = [fftconvolve(there, _mirrored(ring), "same"), fftconvolve(there, _mirrored(disc), "same")]
    enough = (around[0] > MIN_RING_SHARE * ring.sum()) & (around[1] > MIN_DISC_SHARE * disc.sum())
    rows, columns = np.nonzero(enough)
    if not len(rows):
        return []

    def sums(field: Array, weight: Array) -> Array:
        return np.asarray(fftconvolve(field, _mirrored(weight), "same"))[rows, columns]

    normal = np.empty((len(rows), 6, 6))
    for i in range(6):
        for j in range(i, 6):
            normal[:, i, j] = normal[:, j, i] = sums(there, ring * terms[i] * terms[j])
    right = np.stack([sums(values, ring * term) for term in terms], axis=1)
    fit = np.linalg.solve(normal + 1e-9 * np.eye(6), right[..., None])[..., 0]
    spread = np.sqrt(np.maximum(sums(values**2, ring) - np.einsum("ni,ni->n", fit, right), 0) / normal[:, 0, 0])
    inside = np.stack([sums(there, disc * term) for term in terms], axis=1)
    slope = fit[:, 1:3] / reach
    cosine = 1 / np.sqrt(1 + (slope**2).sum(axis=1))
    depth = (np.einsum("ni,ni->n", fit, inside) - sums(values, disc)) / inside[:, 0] * cosine
    clarity = np.full(grid.shape, -np.inf)
    clarity[rows, columns] = depth / (spread * cosine + MIN_UNEVENNESS)
    size = 2 * max(1, round(radius / 2 / grid.step)) + 1
    best = (clarity == maximum_filter(clarity, size=size)) & (clarity > 0)
    return [
        Depression(
            (float(grid.x[columns[k]]), float(grid.y[rows[k]]), float(fit[k, 0] + level)),
            (float(slope[k, 0]), float(slope[k, 1])), radius, float(depth[k]), float(clarity[rows[k], columns[k]]),
        )
        for k in np.flatnonzero(best[rows, columns])
    ]  # fmt: skip


def _mirrored(weight: Array) -> Array:
    """The kernel whose convolution is the correlation with `weight`."""
    return np.asarray(weight[::-1, ::-1])


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


def wound_places(scan: Scan, first: HeightMap, colour: ScanColour | None) -> list[tuple[WoundPlace, OutlinedWound]]:
    """Places that may be the wound, the best first."""
    found = depressions(first.grid, first.heights, first.known, MAX_PLACES)
    judged = [
        place
        for each in found
        if each.clarity > RIVAL_CLARITY * found[0].clarity and each.depth > MIN_DEPTH / 4
        for place in _judged_depression(scan, first, each, colour, found[0].clarity)
    ]
    judged.sort(key=lambda pair: -pair[0].score)
    kept = list[tuple[WoundPlace, OutlinedWound]]()
    for judgement, place in judged:  # two discs may lead to one outline
        middle = judgement.outline.mean(axis=0)
        size = np.sqrt(judgement.area)
        if all(np.linalg.norm(middle - k.outline.mean(axis=0)) > 0.5 * max(size, np.sqrt(k.area)) for k, _ in kept):
            kept.append((judgement, place))
    return kept


def _judged_depression(
    scan: Scan, first: HeightMap, hollow: Depression, colour: ScanColour | None, clarity: float
) -> Sequence[tuple[WoundPlace, OutlinedWound]]:
    """The wound at a depression of the first map, in a plane of its own; none where there is none.

    Where the skin at the rim is not as the skin further out lets expect, either the rim is swollen or the body bends
    too much to tell: of both the one counts by which the rim is steeper, and in doubt the nearer skin.
    """
    z = np.array([-hollow.slope[0], -hollow.slope[1], 1.0])
    rotation = first.surface_from_plane[:3, :3]
    middle = se3.transform_points(first.surface_from_plane, np.array([hollow.middle]))[0]
    plane = se3.make(axes_along(rotation @ z / np.linalg.norm(z), np.eye(3)[0]), middle)
    disc = as_multi(shapely.Point(0.0, 0.0).buffer(1.2 * hollow.radius))
    fine = height_map(scan, plane, SEARCH_STEP, surround_box(disc))
    if fine.known.sum() < MIN_NODES:
        return []
    far = outlined(scan, fine, disc, None, USUAL_KERNEL)
    ways = [far]
    if far is None or far.margin == RIM_MARGIN:
        ways.append(outlined(scan, fine, disc if far is None else far.outline, True, USUAL_KERNEL))
    judged = [(_judged(place, clarity, colour), place) for place in ways if place is not None]
    return sorted(judged, key=lambda pair: -pair[0].steepness * (NEAR_BONUS if pair[1].margin < RIM_MARGIN else 1.0))[
        :1
    ]


def _judged(place: OutlinedWound, clarity: float, colour: ScanColour | None) -> WoundPlace:
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
    points = points_on(fine, shapely.get_coordinates(outline.geoms[0].exterior))
    share = float("nan")
    if colour is not None:
        share = _coloured(colour, points_on(fine, fine.grid.nodes[inside]))
    whole = 1 - share_cut(fine, outline)  # what the scan's own rim cuts off is hardly the wound that was scanned
    likeness = 1.0 if np.isnan(share) else 0.1 + share
    score = np.sqrt(outline.area) * deep * max(steepness, 0.02) ** 2 * likeness * whole**2
    return WoundPlace(points, float(outline.area), deep, steepness, clarity, share, float(score))


def _around(outline: MultiPolygon, away: float) -> Array:
    """Points (N, 2) along an outline moved outwards by `away` mm."""
    return np.asarray(shapely.get_coordinates(shapely.segmentize(shapely.buffer(outline, away), 1.0)))


def _coloured(colour: ScanColour, points: Array) -> float:
    """Mean share of wound colour at points (N, 3); nan where none is known."""
    known = np.isfinite(colour.shares)
    if not known.any():
        return float("nan")
    _, near = cKDTree(colour.points[known]).query(points)
    return float(colour.shares[known][near].mean())


def chosen_place(
    places: list[tuple[WoundPlace, OutlinedWound]], number: int | None, first: HeightMap, where: object, flipped: bool
) -> tuple[OutlinedWound, int]:
    """The place that is clearly the wound, or the one that was named, and how many others there are."""
    if number is not None:
        if not 1 <= number <= len(places):
            raise InputError(where, "number of the wound", number, f"1 to {len(places)}, the places that may be it")
        return places[number - 1][1], len(places) - 1
    likely = [p for p in places if p[0].score >= MIN_SCORE]
    bulge = _clearest_bulge(first)
    if not likely or (bulge is not None and bulge.clarity > max(p.clarity for p, _ in places)):
        deepest = max((float(np.percentile(p.depth, 99)) for _, p in places), default=0.0)
        raise refusal(first, deepest, where, flipped)
    rivals = [p for p in likely if p[0].score > RIVAL_SHARE * likely[0][0].score]
    if len(rivals) > 1 or likely[0][0].score < SURE_SCORE:
        raise WoundQuestionError(where, [p for p, _ in rivals])
    return likely[0][1], len(likely) - 1


def _clearest_bulge(first: HeightMap) -> Depression | None:
    bulges = depressions(first.grid, -first.heights, first.known, 1)
    return bulges[0] if bulges else None


def refusal(first: HeightMap, depth: float, where: object, flipped: bool) -> InputError:
    """That there is no wound, and what may be wrong with the scan. depth: mm, of what is deepest."""
    if first.known.sum() < MIN_NODES:
        width, height = first.grid.step * (np.array(first.grid.shape[::-1]) - 1)
        allowed = "a scan of a wound and the skin about it, in mm: --unit says so where it is in another unit"
        return InputError(where, "scan", f"{width:.3g} x {height:.3g} mm that hardly hang together", allowed)
    got = f"none found: no hollow with a steep rim; the deepest is {max(depth, 0):.2g} mm under the skin around it"
    allowed = f"{MIN_AREA:g} mm^2 deeper than {MIN_DEPTH:g} mm, with a rim; or --outline, or --clicks"
    bulge = _clearest_bulge(first)
    if bulge is not None and bulge.depth > MIN_DEPTH and bulge.clarity > INSIDE_OUT_CLARITY:
        inside_out = "leave --flip out" if flipped else "if it was scanned inside out, say --flip"
        allowed += f"; it bulges by {bulge.depth:.2g} mm: {inside_out}"
    return InputError(where, "wound", got, allowed)
