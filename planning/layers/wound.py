"""The volume to be printed: between the wound's bed and the healthy skin that is restored over it.

The wound is looked for at every depression of the scan, or is where a person says.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import shapely
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
    gradient,
    height_map,
    interpolate,
    nodes_within,
    upsampled,
)
from planning.layers.outline import (
    MIN_DEPTH,
    MIN_NODES,
    MIN_PIECE,
    MIN_UPWARD,
    RIM_MARGIN,
    SEARCH_STEP,
    SKIN_STEP,
    OutlinedWound,
    ScanColour,
    chosen_place,
    outlined,
    refusal,
    share_cut,
    surround_box,
    with_skin,
    wound_places,
)
from planning.layers.repair import mean_normal

MAX_CUT_SHARE = 0.25  # share of the outline that may lie along the scan's rim, where no skin holds the restored surface
MAX_VOLUME_NODES = 400  # of the skin, of which the volume's deviation is summed


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
    scanned: Mask  # (H, W) where the scan has a triangle
    holes: Mask  # (H, W) where it has none within its rim

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
        axes = axes_along(mean_normal(scan.vertices, scan.triangles, where), np.eye(3)[0])
        first = height_map(scan, se3.make(axes, scan.vertices.mean(axis=0)), SEARCH_STEP)
        places, bulges = wound_places(scan, first, colour)
        place, others = chosen_place(places, number, first, where, flipped, bulges)
    surface_from_plane = _plane_over(place)
    coarse = place.fine
    turn = se3.inverse(surface_from_plane) @ coarse.surface_from_plane
    shape = as_multi(shapely.make_valid(shapely.transform(place.outline, lambda xy: _moved(xy, coarse, turn))))
    fine = height_map(scan, surface_from_plane, step, surround_box(shape))
    if outline is None:
        found = outlined(scan, fine, shape, place.margin < RIM_MARGIN)
        if found is None:
            raise refusal(coarse, float(np.percentile(place.depth, 99)), where, flipped)
    else:
        shape = _given(outline, surface_from_plane, where)
        found = with_skin(scan, fine, shape)
    return _checked_wound(scan, found, outline is not None, others, where)


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


def _moved(xy: Array, first: HeightMap, turn: Array) -> Array:
    """Points (N, 2) of a plane's outline, on the scan, in the plane turned by `turn` (4, 4)."""
    points = np.column_stack([xy, interpolate(first.grid, first.heights, xy)])
    return np.asarray(se3.transform_points(turn, points)[:, :2])


def _plane_over(place: OutlinedWound) -> Array:
    """The plane across the skin over an outline: origin on it over the outline's middle, z its mean normal there."""
    grid = place.fine.grid
    slopes = gradient(grid, place.skin)[nodes_within(grid, place.outline)].mean(axis=0)
    z = np.array([-slopes[0], -slopes[1], 1.0])
    rotation = place.fine.surface_from_plane[:3, :3]
    middle = np.array(place.outline.centroid.coords[0])
    origin = np.array([[*middle, float(interpolate(grid, place.skin, middle[None])[0])]])
    axes = axes_along(rotation @ z / np.linalg.norm(z), np.eye(3)[0])
    return se3.make(axes, se3.transform_points(place.fine.surface_from_plane, origin)[0])


def _place_at(scan: Scan, outline: Array, where: object) -> OutlinedWound:
    """A wound whose outline (N, 3) mm, scan frame, is given, in a plane of its own."""
    middle = outline.mean(axis=0)
    z = np.linalg.svd(outline - middle)[2][2]
    near = np.argsort(np.linalg.norm(scan.vertices - middle, axis=1))[: max(50, len(scan.vertices) // 50)]
    outwards = scan.normals[near].mean(axis=0)
    plane = se3.make(axes_along(z if z @ outwards > 0 else -z, np.eye(3)[0]), middle)
    shape = _given(outline, plane, where)
    fine = height_map(scan, plane, SEARCH_STEP, surround_box(shape))
    if fine.known.sum() < MIN_NODES:
        raise InputError(where, "scan", "hardly any of it at the outline", "an outline in the scan's frame, on it")
    return with_skin(scan, fine, shape)


def _given(outline: Array, surface_from_plane: Array, where: object) -> MultiPolygon:
    flat = se3.transform_points(se3.inverse(surface_from_plane), outline)[:, :2]
    shape = as_multi(shapely.make_valid(shapely.Polygon(flat)), MIN_PIECE)
    if shape.is_empty:
        raise InputError(where, "outline", f"{shape.area:.3g} mm^2", f"{MIN_PIECE:g} mm^2 or more")
    return shape


def _checked_wound(scan: Scan, found: OutlinedWound, given: bool, others: int, where: object) -> WoundVolume:
    fine, shape, skin = found.fine, found.outline, found.skin
    inside = nodes_within(fine.grid, shape)
    known = inside & fine.known
    if known.sum() < 0.5 * inside.sum():
        share = f"{100 * known.sum() / inside.sum():.0f} % of the outline"
        raise InputError(where, "scanned part of the wound", share, "half of it or more: scan it again, or the outline")
    cell, depth = fine.grid.step**2, np.where(fine.known, skin - fine.heights, 0.0)
    cut = share_cut(fine, shape)
    if cut > MAX_CUT_SHARE:
        allowed = f"{100 * MAX_CUT_SHARE:.0f} % or less: scan 20 mm of skin around the wound"
        raise InputError(where, "share of the outline at the scan's own rim", f"{100 * cut:.0f} %", allowed)
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
    own = fine.surface_from_plane, fine.grid, fine.heights, skin, sigma, shape, findings
    return WoundVolume(*own, fine.scanned, fine.closed)


def _deviations(found: OutlinedWound) -> tuple[Array, float]:
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
        notes.append(
            f"{100 * findings.cut:.0f} % of the outline lie at the scan's own rim: no skin holds the surface there"
        )
    if findings.others:
        notes.append(f"{findings.others} further depressions were left alone; give --outline for one of them")
    if findings.noise > 0.2:
        notes.append(f"the scan is noisy: {findings.noise:.2f} mm")
    if findings.scatter > 0.5:
        notes.append(f"the skin around departs from the restored surface by {findings.scatter:.2f} mm")
    return notes
