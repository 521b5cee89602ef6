"""Closed lines parallel to the contour, level by level, as wide as the room between their neighbours.

After Kuipers et al. 2020: where the remaining thickness is no multiple of the spacing, two neighbours share it, wider
or narrower than nominal, or a single bead along the medial axis fills it. The line outside a corner widens into what is
left open there.

The medial axis comes from the Voronoi diagram of points along the boundary (Brandt and Algazi 1992), which is the dual
of their Delaunay triangles. Only the part along which the thickness changes slowly is used: every kink and all noise of
a contour adds a branch into its corners.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import shapely
from numpy.typing import NDArray
from scipy.spatial import Delaunay, QhullError, cKDTree
from shapely.geometry.base import BaseGeometry

from estimation.se3 import Array
from planning.fill.bead import Bead, BeadFit, Region, covered_area, difference, even_bead, union_of
from planning.fill.spiral import dot_beads, widen_ring

MAX_RADIUS_SLOPE = 0.38  # mm per mm, of the radius along the axis: cos 67.5 degrees, as Kuipers et al. 2020
MIN_BEAD_LENGTH = 0.1  # spacings: a shorter line is a dot
POINT_SPACING = 0.25  # spacings from point to point
END_CLEARANCE = 0.5  # of the radius at a wide end, by which a bead stays away from the line that turns there
WIDE_END_SHARE = 0.9  # of the widest: an end at least that wide lies before such a turn
AXIS_SMOOTHING = 4  # roundings, each over two points
BOUNDARY_SPACING = 0.25  # spacings from point to point of the boundary whose medial axis is sought
CORNER_RADIUS = 0.15  # spacings: radius of corners, so that none stops the nozzle
OUTER_CORNER_RADIUS = 0.05  # the same at the contour, where no line outside widens into them
MIN_LOOP_AREA = 0.02  # spacings squared: a smaller loop is a dot
SIMPLIFY_TOLERANCE = 0.003  # spacings: to which lines are simplified; offsets of offsets double their points each time
RIM_TOLERANCE = 0.15  # spacings: a line's point nearer to or farther from a disc's rim faces another disc
MIN_OPENING = 0.01  # spacings: a narrower opening between two lines is none
MAX_CORNER_LOSS = 0.003  # of the area: what the corners of the outermost line may lose before it is made narrower
ARC_SEGMENTS = 8  # edges of a quarter circle: off by a thousandth of a bead at most, less than SIMPLIFY_TOLERANCE
MIN_GAP_AREA = 0.04  # spacings squared: of a gap worth filling, as in a corner of 110 degrees


@dataclass(frozen=True, slots=True, eq=False)
class MedialAxis:
    """Inscribed discs and which of them are joined."""

    middles: Array  # (V, 2) mm
    radii: Array  # (V,) mm
    edges: NDArray[np.intp]  # (E, 2) rows of discs


EMPTY_AXIS = MedialAxis(np.empty((0, 2)), np.empty(0), np.empty((0, 2), np.intp))


def medial_axis(region: Region, step: float) -> MedialAxis:
    """The medial axis of a region whose boundary is sampled every `step` mm."""
    rings = shapely.segmentize(shapely.get_rings(shapely.get_parts(region)), step)
    points, ring = shapely.get_coordinates(rings, return_index=True)
    sites = points[np.diff(ring, prepend=-1) == 0]  # a ring repeats its first point
    if len(sites) < 4:
        return EMPTY_AXIS
    shift = sites.mean(axis=0)  # so that squares keep their digits
    sites = sites - shift
    try:
        mesh = Delaunay(sites)
    except QhullError:  # all on one line: nothing inside
        return EMPTY_AXIS
    middles, radii = _circumscribed(sites[mesh.simplices])
    own, beside = np.nonzero(mesh.neighbors > np.arange(len(radii))[:, None])  # each two triangles with an edge, once
    edges = np.stack([own, mesh.neighbors[own, beside]], axis=1)
    ends = sites[mesh.simplices[own[:, None], np.stack([beside - 1, beside - 2], axis=1)]]  # (E, 2, 2), of the edge
    chord = np.hypot(*(ends[:, 0] - ends[:, 1]).T)
    edges = edges[chord / 2 >= np.sqrt(1 - MAX_RADIUS_SLOPE**2) * radii[edges].max(axis=1)]
    middles += shift
    shapely.prepare(region)
    inside = shapely.contains_xy(region, *middles[edges].reshape(-1, 2).T).reshape(-1, 2).all(axis=1)
    used, edges = np.unique(edges[inside], return_inverse=True)
    return MedialAxis(middles[used], radii[used], edges.reshape(-1, 2))


def _circumscribed(corners: Array) -> tuple[Array, Array]:
    """Middles (T, 2) and radii (T,) of the circles through the corners (T, 3, 2) of triangles; inf for flat ones."""
    (bx, by), (cx, cy) = (corners[:, 1:] - corners[:, :1]).transpose(1, 2, 0)
    b, c, det = bx * bx + by * by, cx * cx + cy * cy, 2 * (bx * cy - by * cx)
    with np.errstate(divide="ignore", invalid="ignore"):
        middle = np.stack([(cy * b - by * c) / det, (bx * c - cx * b) / det], axis=1)
    flat = ~np.isfinite(middle).all(axis=1)
    middle[flat] = 0.0
    return corners[:, 0] + middle, np.where(flat, np.inf, np.hypot(*middle.T))


def graph_paths(edges: NDArray[np.intp]) -> list[list[int]]:
    """The edges (E, 2) of a graph as paths between its ends and forks; circles end where they begin."""
    beside: dict[int, list[int]] = {}
    for a, b in np.unique(np.sort(edges[edges[:, 0] != edges[:, 1]], axis=1), axis=0).tolist():
        beside.setdefault(a, []).append(b)
        beside.setdefault(b, []).append(a)
    paths, gone = [], set()
    ends = [v for v, near in beside.items() if len(near) != 2]
    for start in (*ends, *beside):
        for second in beside[start]:
            if (start, second) in gone:
                continue
            path = [start, second]
            gone |= {(start, second), (second, start)}
            while len(beside[path[-1]]) == 2 and path[-1] != start:
                a, b = beside[path[-1]]
                path.append(b if a == path[-2] else a)
                gone |= {(path[-2], path[-1]), (path[-1], path[-2])}
            paths.append(path)
    return paths


def thin_beads(axis: MedialAxis, edge: BaseGeometry, fit: BeadFit, levels: int | None = None) -> list[tuple[int, Bead]]:
    """Beads along the parts of an axis that closed lines at multiples of the spacing leave, each with its level.

    edge: the boundary that the axis belongs to; no bead reaches over it.
    """
    level = fit.level(axis.radii)
    single = (axis.radii - fit.outside(level) < fit.two) & (level >= 0)
    if levels is not None:
        single &= level < levels
    a, b = axis.edges.T
    edges = axis.edges[single[a] & single[b] & (level[a] == level[b])]
    beads = []
    for path in graph_paths(edges):
        points = _smooth(axis.middles[path], fit.spacing)
        if len(points):
            inner = int(level[path[0]])
            radius = shapely.distance(edge, shapely.points(points)) - float(fit.outside(inner))
            bead = _clear(Bead(points, 2 * np.clip(radius, fit.one, fit.two)), fit)
            if bead is not None:
                beads.append((inner, bead))
    return beads


def _clear(bead: Bead, fit: BeadFit) -> Bead | None:
    """What stays of a bead once it keeps clear of the closed lines that turn round where it is widest."""
    wide = bead.width[[0, -1]] > WIDE_END_SHARE * 2 * fit.two
    start, end = np.where(wide, END_CLEARANCE * fit.two, 0.0).tolist()
    if bead.length - start - end < MIN_BEAD_LENGTH * fit.spacing:
        return None
    return bead.between(start, bead.length - end)


def _smooth(points: Array, spacing: float) -> Array:
    """The same line (N, 2) without the Voronoi diagram's jitter; none where it is too short to be one."""
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    if along[-1] < MIN_BEAD_LENGTH * spacing:
        return points[:0]
    at = np.linspace(0, along[-1], max(2, int(np.ceil(along[-1] / (POINT_SPACING * spacing))) + 1))
    line = np.stack([np.interp(at, along, v) for v in points.T], axis=1)
    for _ in range(AXIS_SMOOTHING):
        line[1:-1] = (line[:-2] + 2 * line[1:-1] + line[2:]) / 4
    return line


@dataclass(frozen=True, slots=True, eq=False)
class RingLevel:
    """One level: closed lines, and the single beads that fill what is too narrow for two."""

    rings: list[Bead]
    single: list[Bead]


def ring_levels(region: Region, lost: float, fit: BeadFit, most: int | None = None) -> tuple[list[RingLevel], Region]:
    """Levels of closed lines from the contour inwards, at most so many, and the region that they leave.

    lost: the region's roughness for one spacing.
    """
    # the outermost line is made so narrow that it follows the contour's corners: what they lose when they are rounded
    # grows with the square of the radius
    share = math.sqrt(MAX_CORNER_LOSS / max(lost, MAX_CORNER_LOSS))
    fit = replace(fit, outermost=max(share * fit.spacing, 2 * fit.one))
    axis = medial_axis(region, BOUNDARY_SPACING * fit.spacing)
    thin = thin_beads(axis, shapely.boundary(region), fit, most)
    levels: list[RingLevel] = []
    left = region
    while not left.is_empty and (most is None or len(levels) < most):
        here = fit.at(len(levels))
        spacing = here.spacing
        own = [bead for k, bead in thin if k == len(levels)]
        middle = _middle(left, own, here, (CORNER_RADIUS if levels else OUTER_CORNER_RADIUS) * spacing)
        gaps = _gaps(left, middle, own, spacing)
        own += dot_beads(gaps, here)
        if levels and len(gaps):
            outer, before = levels[-1], fit.at(len(levels) - 1)
            levels[-1] = RingLevel([widen_ring(ring, gaps, before) for ring in outer.rings], outer.single)
        between = _between(axis, float(fit.outside(len(levels))), here)
        rings = shapely.get_rings(shapely.get_parts(middle))
        levels.append(RingLevel([_shared(ring, between, here) for ring in rings], own))
        left = _simple(shapely.buffer(left, -spacing, quad_segs=ARC_SEGMENTS), spacing)
    return levels, left


def _simple(region: Region, spacing: float) -> Region:
    """Without points that offsets of offsets double each time."""
    return shapely.simplify(region, SIMPLIFY_TOLERANCE * spacing, preserve_topology=False)


def _middle(left: Region, single: list[Bead], fit: BeadFit, radius: float) -> Region:
    """What lies inside the middle lines of the next level, corners rounded; tongues for single beads are cut off."""
    spacing = fit.spacing
    middle = shapely.buffer(shapely.buffer(left, -spacing / 2 - radius, quad_segs=ARC_SEGMENTS), radius, quad_segs=4)
    if single:
        lean = max(fit.two - spacing / 2, radius)
        core = shapely.buffer(middle, -lean, quad_segs=ARC_SEGMENTS)
        wide = shapely.buffer(core, lean + MIN_OPENING * spacing, quad_segs=ARC_SEGMENTS)  # edge upon edge is slow
        rest = shapely.get_parts(difference(middle, wide))
        lines = shapely.multilinestrings([shapely.linestrings(bead.points) for bead in single])
        shapely.prepare(lines)
        middle = difference(middle, union_of(rest[shapely.intersects(lines, rest)]))
        middle = shapely.buffer(shapely.buffer(middle, -radius, quad_segs=4), radius, quad_segs=4)
    parts = shapely.get_parts(_simple(middle, spacing))
    return shapely.multipolygons(parts[shapely.area(parts) > MIN_LOOP_AREA * spacing**2])


def _gaps(left: Region, middle: Region, single: list[Bead], spacing: float) -> NDArray[np.object_]:
    """What a level leaves open between the line outside it and its own."""
    reached = shapely.buffer(middle, (0.5 + MIN_OPENING) * spacing, quad_segs=4)
    beyond = MIN_OPENING * spacing * reached.length  # its area beyond that of the beads (Steiner's formula)
    if left.area - reached.area + beyond < MIN_GAP_AREA * spacing**2:
        return np.empty(0, object)
    gaps = _large(difference(left, reached), spacing)
    if not single or not len(gaps):
        return gaps
    lines = np.array([shapely.linestrings(bead.points) for bead in single], dtype=object)
    reach = np.array([bead.width.max() / 2 for bead in single])
    far = shapely.distance(lines[:, None], gaps[None])  # to gaps (S, G)
    own = [bead for bead, near in zip(single, far.min(axis=1) < reach, strict=True) if near]
    return _large(difference(shapely.multipolygons(gaps), covered_area(own, ARC_SEGMENTS)), spacing) if own else gaps


def _large(gaps: BaseGeometry, spacing: float) -> NDArray[np.object_]:
    """The parts of gaps that are worth filling."""
    parts = shapely.get_parts(gaps)
    return np.asarray(parts[shapely.area(parts) > MIN_GAP_AREA * spacing**2])


def _between(axis: MedialAxis, outside: float, fit: BeadFit) -> MedialAxis:
    """The part of an axis that only two lines of a level pass, one on each side; radii less what is outside them."""
    radii = axis.radii - outside
    two = (radii >= fit.two) & (radii < fit.three)
    return MedialAxis(axis.middles[two], radii[two], axis.edges[:0])


def _shared(ring: BaseGeometry, between: MedialAxis, fit: BeadFit) -> Bead:
    """A closed line, moved and widened where only two fit between the lines outside it."""
    spacing = fit.spacing
    points = shapely.get_coordinates(shapely.segmentize(ring, spacing))
    if not len(between.radii):
        return even_bead(points, spacing)
    far, near = cKDTree(between.middles).query(points, distance_upper_bound=0.8 * spacing)
    near[np.isinf(far)] = 0
    beside = np.abs(far + spacing / 2 - between.radii[near]) < RIM_TOLERANCE * spacing
    if not beside.any():
        return even_bead(points, spacing)
    more = np.where(beside, np.minimum(between.radii[near], fit.most) - spacing, 0.0)
    way = (between.middles[near] - points) / np.maximum(far, 1e-9)[:, None]
    points = points + way * (more / 2)[:, None]
    points[-1], more[-1] = points[0], more[0]
    return Bead(points, spacing + more)
