"""Closed lines printed one by one or joined to a spiral, and the order of runs with the least travel between them.

The order is nearest neighbour first, then 2-opt and Or-opt (thesis 2.1.3). Printing itself takes as long in any order
and direction, so travels and the turns at their ends are what can be saved.

Beads are widened here over gaps as well: in rough or narrow regions, and into corners that the next closed line cannot
reach.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise

import numpy as np
import shapely
from numpy.typing import NDArray
from scipy.ndimage import convolve1d
from shapely.geometry.base import BaseGeometry

from estimation.se3 import Array
from planning.fill.bead import (
    POINT_TOLERANCE,
    SHARP_TURN,
    Bead,
    BeadFit,
    PrintPace,
    Region,
    covered_area,
    difference,
    even_bead,
)

BeadRun = list[Bead]  # beads that follow one another
MAX_IMPROVEMENTS = 300  # improvements: a bound on time, reached by no layer that a wound was seen to need
MIN_TRAVEL_GAIN = 1e-6  # mm: a smaller gain is none
RAMP_LENGTH = 2.2  # spacings along which a line leads over to the next: 24 degrees, no sharp turn
JOIN_DISTANCE = 1.6  # spacings: a line farther from the one outside it is not joined to it
RAMP_POINTS = 6  # points of a ramp
START_CANDIDATES = 12  # where along the innermost line a run may begin
NEIGHBOUR_DISTANCE = 0.8  # spacings from a line's middle to a gap that it can widen into
GAP_SPACING = 0.15  # spacings from point to point along a gap
MAX_WIDENING = 0.5  # spacings by which a line widens at most: a corner of 50 degrees is that deep
DEPTH_SAMPLES = 8  # places across that depth at which the corner is tested for being open
SMOOTHING_ROUNDS = 2  # roundings of width and way, each over two points: else the way turns sharply
MIN_WIDENING = 0.01  # spacings: less is no widening
MIN_DOT_WIDTH = 0.65  # spacings: the way to a narrower gap takes the time in which a line covers ten times as much
DOT_HALF_LENGTH = 0.05  # spacings to either side of a dot's middle: the nozzle hardly moves
MAX_GAP_DEPTH = 0.2  # spacings beyond a bead's edge up to which gaps are looked for
GAP_SAMPLES = 12  # places in that
MIN_GAP = 0.0015  # spacings squared: a smaller gap is none
MAX_DOUBLE = 0.045  # of the area: a tenth under the 5 % that may be laid twice, as it is estimated from the gaps alone
# of area laid twice, in area of gaps; the next one is tried where with this one too much is laid twice
OVERLAP_PRICES = (0.0, 0.25, 0.5, 1.0, 2.0)
SMOOTHING_KERNEL = np.array([1.0, 2.0, 1.0]) / 4  # weights over neighbours: else the way turns sharply


def order_runs(runs: Sequence[BeadRun], start: Array, pace: PrintPace) -> list[Bead]:
    """The beads of all runs, in the order and direction whose travels from `start` (2,) take the least time.

    A travel takes the time of its length and of the turns at its two ends.
    """
    hops = _hops(runs, start, pace)
    tour = _nearest(hops)
    for _ in range(MAX_IMPROVEMENTS if len(runs) > 1 else 0):
        better = _turned(tour, hops)
        better = _moved(tour, hops) if better is None else better
        if better is None:
            break
        tour = better
    return [bead for run, flipped in tour for bead in (_reversed(runs[run]) if flipped else runs[run])]


Tour = NDArray[np.intp]  # (M, 2): number of the run, and 1 where it is printed from its end


def _reversed(run: BeadRun) -> BeadRun:
    return [bead.reversed for bead in reversed(run)]


def _hops(runs: Sequence[BeadRun], start: Array, pace: PrintPace) -> Array:
    """What travels cost, in mm of travel (2M+1, 2M+1): between the ends of runs, 2 i where run i begins and 2 i + 1
    where it ends, and last the start (2,), which has no direction.
    """
    ends, onwards = [], []  # onwards: the way out of a run through this end
    for run in runs:
        for line in (run[0].points[::-1], run[-1].points):
            ends.append(line[-1])
            onwards.append(line[-1] - line[-2])
    place, way = np.array([*ends, start]), np.array([*onwards, (0.0, 0.0)])
    hop = place[None] - place[:, None]  # (from, to, 2)
    far, size = np.hypot(hop[..., 0], hop[..., 1]), np.hypot(way[:, 0], way[:, 1])
    here = far < POINT_TOLERANCE
    turn, straight = pace.turn * pace.travel, np.cos(SHARP_TURN)
    sharp = np.einsum("ijk,ik->ij", hop, way) < straight * far * size[:, None]
    meet = way @ -way.T < straight * size[:, None] * size
    return np.asarray(np.where(here, turn * meet, far + turn * sharp + turn * sharp.T))


def _nearest(hops: Array) -> Tour:
    count, here = len(hops) // 2, len(hops) - 1
    free = np.ones(2 * count, bool)
    tour = []
    for _ in range(count):
        entry = int(np.where(free, hops[here, :-1], np.inf).argmin())
        run, flipped = divmod(entry, 2)
        free[2 * run : 2 * run + 2] = False
        tour.append((run, flipped))
        here = entry ^ 1
    return np.array(tour, np.intp).reshape(-1, 2)


def _ends(tour: Tour, hops: Array) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """At which ends runs of a tour begin (M,), and which the nozzle leaves before the first and after each (M+1,)."""
    entry = 2 * tour[:, 0] + tour[:, 1]
    return entry, np.append(len(hops) - 1, entry ^ 1)


def _turned(tour: Tour, hops: Array) -> Tour | None:
    """The tour with its best stretch printed backwards (2-opt); None where none is better."""
    entry, leave = _ends(tour, hops)
    hop = hops[leave[:-1], entry]
    into = hops[leave[:-1, None], leave[None, 1:]]  # (i, j): from before i to the end of j
    out = np.zeros_like(into)
    out[:, :-1] = hops[entry[:, None], entry[None, 1:]]  # from the start of i to what follows j
    gain = into + out - hop[:, None] - np.append(hop[1:], 0.0)
    gain[np.tri(len(tour), k=-1, dtype=bool)] = 0.0
    i, j = divmod(int(gain.argmin()), len(tour))
    if gain[i, j] > -MIN_TRAVEL_GAIN:
        return None
    better = tour.copy()
    better[i : j + 1] = tour[i : j + 1][::-1]
    better[i : j + 1, 1] ^= 1
    return better


def _moved(tour: Tour, hops: Array) -> Tour | None:
    """The tour with one run moved to its best place, in its better direction (Or-opt); None where none is better."""
    if len(tour) < 3:
        return None
    entry, leave = _ends(tour, hops)
    hop = hops[leave[:-1], entry]
    skip = np.append(hops[leave[:-2], entry[1:]], 0.0)  # from before i to what follows it
    saved = hop + np.append(hop[1:], 0.0) - skip
    best, move = -MIN_TRAVEL_GAIN, None
    for flip in (0, 1):
        first = entry ^ flip
        into = hops[leave[None], first[:, None]]  # (i, place): after `place` runs
        out = np.zeros_like(into)
        out[:, :-1] = hops[entry[None], first[:, None] ^ 1]
        cost = into + out - np.append(hop, 0.0) - saved[:, None]
        i = np.arange(len(tour))
        cost[i, i] = cost[i, i + 1] = 0.0
        at = int(cost.argmin())
        if cost.flat[at] < best:
            best, move = float(cost.flat[at]), (*divmod(at, len(tour) + 1), flip)
    if move is None:
        return None
    run, place, flip = move
    changed = tour[run] ^ [0, flip]
    rest = np.delete(tour, run, axis=0)
    return np.insert(rest, place - (place > run), changed, axis=0)


def nest_rings(levels: list[list[Bead]], spacing: float) -> list[list[Bead]]:
    """Lines of all levels, outermost first, as nests: each line in one the only one inside the line before."""
    open_nests: list[tuple[list[Bead], BaseGeometry]] = []
    done: list[list[Bead]] = []
    for rings in levels:
        outer = np.array([line for _, line in open_nests], dtype=object)
        inside: list[list[Bead]] = [[] for _ in open_nests]
        following = []
        for ring in rings:
            far = shapely.distance(outer, shapely.points(ring.points[0])) if len(outer) else np.empty(0)
            if len(far) and far.min() < JOIN_DISTANCE * spacing:
                inside[int(far.argmin())].append(ring)
            else:
                following.append([ring])
        for (nest, _), within in zip(open_nests, inside, strict=True):
            if len(within) == 1:
                following.append([*nest, within[0]])
            else:
                done.append(nest)
                following += [[ring] for ring in within]
        open_nests = [(nest, shapely.linestrings(nest[-1].points)) for nest in following]
    return done + [nest for nest, _ in open_nests]


def separate_rings(nest: list[Bead], start: Array, seam: float) -> BeadRun:
    """The lines of a nest one by one, outermost first, begun near the side that `start` (2,) points to.

    seam: share of the outermost line by which the run begins later.
    """
    return _begun(nest, _inwards(nest, _seam_place(nest[0], start, seam)))


def spiral_runs(nest: list[Bead], spacing: float, start: Array, seam: float) -> BeadRun:
    """The same lines joined inwards wherever one begins beside the one before."""
    turned = separate_rings(nest, start, seam)
    if any(_far(outer, inner, spacing) for outer, inner in pairwise(turned)):
        turned = _begun(nest, _outwards(nest, _seam_place(nest[0], start, seam), spacing))
    runs: list[list[Bead]] = [[turned[0]]]
    closing: list[Bead] = []  # what the last line of a run lacks beside the ramp that led to it
    for outer, inner in pairwise(turned):
        if _far(outer, inner, spacing):
            runs[-1] += closing
            runs.append([inner])  # not beside one another here
            closing = []
            continue
        ramp = min(RAMP_LENGTH * spacing, inner.length / 4, outer.length / 4)
        runs[-1] += [_ramp(outer, inner, ramp), inner.between(ramp, inner.length)]
        closing = [inner.between(0.0, ramp)]
    runs[-1] += closing
    joined = []
    for run in runs:  # beads that follow one another without a step, as one
        points, width = np.concatenate([b.points for b in run]), np.concatenate([b.width for b in run])
        distinct = np.append(True, np.abs(np.diff(points, axis=0)).max(axis=1) > POINT_TOLERANCE)
        joined.append(Bead(points[distinct], width[distinct]))
    return joined


def _seam_place(ring: Bead, start: Array, seam: float) -> Array:
    """Where on the outermost line the run should begin, (2,)."""
    first = int((ring.points @ start).argmax())
    along = ring.steps[:first].sum() + seam * ring.length
    return ring.at(np.array([along % ring.length]))[0, :2]


def _far(outer: Bead, inner: Bead, spacing: float) -> bool:
    """Whether two lines begin too far apart to be joined there."""
    return math.dist(outer.points[0], inner.points[0]) > JOIN_DISTANCE * spacing


def _inwards(nest: list[Bead], place: Array) -> list[float]:
    """Where along each line it begins, mm: nearest to `place` (2,), or to where the one before begins."""
    arcs = []
    for ring in nest:
        arcs.append(float(shapely.line_locate_point(shapely.linestrings(ring.points), shapely.points(place))))
        place = ring.at(np.array(arcs[-1:]))[0, :2]
    return arcs


def _outwards(nest: list[Bead], seam: Array, spacing: float) -> list[float]:
    """The same, so that each begins beside the one within it, the outermost as near to `seam` (2,) as that allows."""
    inmost = nest[-1]
    place = inmost.at(np.linspace(0, inmost.length, START_CANDIDATES, endpoint=False))[:, :2]
    arcs, far = [], np.zeros(START_CANDIDATES)
    for ring in nest[::-1]:
        arc = shapely.line_locate_point(shapely.linestrings(ring.points), shapely.points(place))
        outer = ring.at(arc)[:, :2]
        far += np.linalg.norm(outer - place, axis=1) > JOIN_DISTANCE * spacing
        place = outer
        arcs.append(arc)
    best = int((np.linalg.norm(place - seam, axis=1) + 1e6 * far).argmin())
    return [float(arc[best]) for arc in arcs[::-1]]


def _begun(nest: list[Bead], arcs: list[float]) -> list[Bead]:
    """The lines begun at these lengths, all in the sense of the first."""
    number = np.repeat(np.arange(len(nest)), [len(ring.points) for ring in nest])
    sense = shapely.is_ccw(shapely.linearrings(np.concatenate([ring.points for ring in nest]), indices=number))
    rings = [ring.turned(arc) for ring, arc in zip(nest, arcs, strict=True)]
    return [ring if way == sense[0] else ring.reversed for ring, way in zip(rings, sense, strict=True)]


def _ramp(outer: Bead, inner: Bead, length: float) -> Bead:
    """From the start of a line over to `length` mm after the start of the one within it."""
    share = np.linspace(0, 1, RAMP_POINTS)[1:, None]
    on_inner = inner.at(share[:, 0] * length)
    beside = outer.between(0.0, min(2 * length, outer.length / 2))
    arc = shapely.line_locate_point(shapely.linestrings(beside.points), shapely.points(on_inner[:, :2]))
    lines = (1 - share) * beside.at(arc) + share * on_inner
    return Bead(lines[:-1, :2], lines[:-1, 2])


def widen_ring(ring: Bead, gaps: NDArray[np.object_], fit: BeadFit) -> Bead:
    """A closed line widened inwards, over what the next level leaves open."""
    spacing, deepest = fit.spacing, min(MAX_WIDENING * fit.spacing, fit.most - fit.spacing)
    line = shapely.linestrings(ring.points)
    shapely.prepare(line)
    near = gaps[shapely.dwithin(line, gaps, NEIGHBOUR_DISTANCE * spacing)]
    if not len(near):
        return ring
    ring = densify(ring, near, spacing)
    inward = -_left(ring.points)  # offsets run clockwise round what they fill
    depths = (np.arange(DEPTH_SAMPLES) + 0.5) * deepest / DEPTH_SAMPLES
    sounded = ring.points[:, None] + inward[:, None] * (ring.width[:, None] / 2 + depths)[..., None]  # (N, S, 2)
    open_there = shapely.contains_xy(prepared_union(near), sounded[..., 0], sounded[..., 1])
    more: Array = open_there.sum(axis=1) * (deepest / DEPTH_SAMPLES)
    more[np.abs(ring.width - spacing) > 1e-9] = 0.0
    more = _smooth_closed(more[:, None], np.ones(len(more)))[:, 0]
    widened = np.asarray(more > MIN_WIDENING * spacing, float)
    points = _smooth_closed(ring.points + inward * (more / 2)[:, None], widened)
    line = shapely.linestrings(np.column_stack([points, ring.width + more]))
    simple = shapely.simplify(line, MIN_WIDENING * spacing, preserve_topology=False)
    lines = shapely.get_coordinates(simple, include_z=True)
    return Bead(lines[:, :2], lines[:, 2])


def prepared_union(shapes: NDArray[np.object_]) -> BaseGeometry:
    """Polygons (G,) as one, prepared for many queries."""
    whole = shapely.multipolygons(shapes)
    shapely.prepare(whole)
    return whole


def _smooth_closed(values: Array, where: Array) -> Array:
    """Values (N, D) along a closed line, smoothed where `where` (N,) is 1."""
    values, weight = values[:-1], where[:-1, None] / 4
    for _ in range(SMOOTHING_ROUNDS):
        wrapped = np.concatenate([values[-1:], values, values[:1]])
        values = values + weight * (wrapped[:-2] - 2 * values + wrapped[2:])
    return np.concatenate([values, values[:1]])


def densify(ring: Bead, near: NDArray[np.object_], spacing: float) -> Bead:
    """The same line with points close together where it passes gaps."""
    along = ring.along
    extra = np.linspace(0, along[-1], int(along[-1] / (GAP_SPACING * spacing)) + 2)[1:-1]
    at = ring.at(extra)
    left, low, right, high = shapely.bounds(near).T[..., None]  # (G, 1) each
    (x, y, _), reach = at.T, NEIGHBOUR_DISTANCE * spacing
    across, upwards = (x > left - reach) & (x < right + reach), (y > low - reach) & (y < high + reach)
    beside = (across & upwards).any(axis=0)
    lines = ring.at(np.unique(np.concatenate([along, extra[beside]])))
    return Bead(lines[:, :2], lines[:, 2])


def dot_beads(gaps: NDArray[np.object_], fit: BeadFit) -> list[Bead]:
    """A short bead in the middle of each gap that is wide enough to be worth one."""
    least = max(fit.one, MIN_DOT_WIDTH * fit.spacing / 2)
    large = gaps[shapely.area(gaps) > np.pi * least**2]
    beads = []
    for circle in [shapely.maximum_inscribed_circle(gap, 0.1 * fit.one) for gap in large]:
        middle, rim = shapely.get_coordinates(circle)
        radius = math.dist(middle, rim)
        if radius >= least:
            half = np.array([DOT_HALF_LENGTH * fit.spacing, 0.0])
            beads.append(even_bead(np.stack([middle - half, middle + half]), min(2 * radius, fit.most)))
    return beads


def fill_gaps(runs: Sequence[BeadRun], region: Region, fit: BeadFit) -> list[BeadRun]:
    """Runs, each bead widened over the gaps that are nearest to it, and dots in those that are wide enough for one.

    What lies open at the contour stays so. Where too much would be laid twice, only over what is mostly gap.
    """
    beads = [bead for run in runs for bead in run]
    covered = covered_area(beads)
    gaps = shapely.get_parts(difference(region, covered))
    gaps = gaps[shapely.area(gaps) > MIN_GAP * fit.spacing**2]
    gaps = gaps[~shapely.intersects(gaps, shapely.boundary(region))]
    if not len(gaps):
        return list(runs)
    lines = np.array([shapely.linestrings(bead.points) for bead in beads], dtype=object)
    nearest = shapely.distance(gaps[:, None], lines[None]).argmin(axis=1)
    reached = covered.area + float(shapely.area(gaps).sum()) + MAX_DOUBLE * region.area
    widened = beads
    for price in OVERLAP_PRICES:
        widened = [_over(bead, gaps[nearest == i], fit, price) for i, bead in enumerate(beads)]
        if sum(bead.area for bead in widened) <= reached:
            break
    better = iter(widened)
    return [[next(better) for _ in run] for run in runs] + [[dot] for dot in dot_beads(gaps, fit)]


def _over(bead: Bead, gaps: NDArray[np.object_], fit: BeadFit, price: float) -> Bead:
    """A bead widened to either side where a gap begins at its edge; its ends stay. price: one of OVERLAP_PRICES."""
    if not len(gaps):
        return bead
    bead = densify(bead, gaps, fit.spacing)
    left, own = _left(bead.points), prepared_union(gaps)
    depths = (np.arange(GAP_SAMPLES) + 0.5) * MAX_GAP_DEPTH * fit.spacing / GAP_SAMPLES
    more = np.stack([_open(bead, side * left, depths, own, price) for side in (1.0, -1.0)])  # (2, N)
    more *= np.minimum(np.maximum(fit.most - bead.width, 0.0) / np.maximum(more.sum(axis=0), 1e-12), 1.0)
    points = bead.points + left * ((more[0] - more[1]) / 2)[:, None]
    return Bead(points, bead.width + more.sum(axis=0))


def _open(bead: Bead, way: Array, depths: Array, gaps: shapely.Geometry, price: float) -> Array:
    """How far (N,), mm, gaps reach from a bead's edge along `way` (N, 2), as far as they are worth their price, evened
    out along the bead."""
    at = bead.points[:, None] + way[:, None] * (bead.width[:, None] / 2 + depths)[..., None]  # (N, S, 2)
    gain = np.cumsum(np.where(shapely.contains_xy(gaps, at[..., 0], at[..., 1]), 1.0, -price), axis=1)
    reach = np.where(gain.max(axis=1) > 0, depths[gain.argmax(axis=1)], 0.0)
    mode = "wrap" if bead.closed else "nearest"
    inner = convolve1d(reach[:-1] if bead.closed else reach, SMOOTHING_KERNEL, mode=mode)
    return np.append(inner, inner[0]) if bead.closed else np.asarray(inner)


def _left(points: Array) -> Array:
    """Unit normals (N, 2) of a line (N, 2), to its left; of a closed one the same at both ends."""
    step = np.diff(points, axis=0)
    step /= np.maximum(np.linalg.norm(step, axis=1), 1e-9)[:, None]
    closed = np.abs(points[0] - points[-1]).max() < 1e-9
    before, after = (step[-1:], step[:1]) if closed else (step[:1], step[-1:])
    along = np.concatenate([before, step]) + np.concatenate([step, after])
    along /= np.maximum(np.linalg.norm(along, axis=1), 1e-9)[:, None]
    return np.stack([-along[:, 1], along[:, 0]], axis=1)
