"""Closed lines that lie in one another, joined to one run inwards, or printed one after the other from one side."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
import shapely
from shapely.geometry.base import BaseGeometry

from estimation.se3 import Array
from planning.fill.bead import SAME, Bead
from planning.fill.order import Run

RAMP = 2.2  # spacings along which a line leads over to the next: 24 degrees, no sharp turn
NEAR = 1.6  # spacings: a line farther from the one outside it is not joined to it
STEPS = 6  # points of a ramp
PLACES = 12  # where along the innermost line a run may begin


def nests(levels: list[list[Bead]], spacing: float) -> list[list[Bead]]:
    """Lines of all levels, outermost first, as nests: each line in one the only one inside the line before."""
    open_nests: list[tuple[list[Bead], BaseGeometry]] = []
    done: list[list[Bead]] = []
    for rings in levels:
        lines = [shapely.linestrings(ring.points) for ring in rings]
        outer = np.array([nest[1] for nest in open_nests], dtype=object)
        inside: list[list[int]] = [[] for _ in open_nests]
        alone = []
        for i in range(len(lines)):
            far = shapely.distance(outer, shapely.points(rings[i].points[0])) if len(outer) else np.empty(0)
            if len(far) and far.min() < NEAR * spacing:
                inside[int(far.argmin())].append(i)
            else:
                alone.append(i)
        following = [([rings[i]], lines[i]) for i in alone]
        for nest, within in zip(open_nests, inside, strict=True):
            if len(within) == 1:
                following.append((nest[0] + [rings[within[0]]], lines[within[0]]))
            else:
                done.append(nest[0])
                following += [([rings[i]], lines[i]) for i in within]
        open_nests = following
    return done + [nest for nest, _ in open_nests]


def apart(nest: list[Bead], start: Array, seam: float) -> Run:
    """The lines of a nest one by one, outermost first, begun near the side that `start` (2,) points to.

    seam: share of the outermost line by which the run begins later.
    """
    return _begun(nest, _inwards(nest, _wanted(nest[0], start, seam)))


def wound(nest: list[Bead], spacing: float, start: Array, seam: float) -> Run:
    """The same lines joined inwards wherever one begins beside the one before."""
    turned = apart(nest, start, seam)
    if any(_far(outer, inner, spacing) for outer, inner in pairwise(turned)):
        turned = _begun(nest, _outwards(nest, _wanted(nest[0], start, seam), spacing))
    runs: list[list[Bead]] = [[turned[0]]]
    closing: list[Bead] = []  # what the last line of a run lacks beside the ramp that led to it
    for outer, inner in pairwise(turned):
        if _far(outer, inner, spacing):
            runs[-1] += closing
            runs.append([inner])  # not beside one another here
            closing = []
            continue
        ramp = min(RAMP * spacing, inner.length / 4, outer.length / 4)
        runs[-1] += [_ramp(outer, inner, ramp), inner.between(ramp, inner.length)]
        closing = [inner.between(0.0, ramp)]
    runs[-1] += closing
    return [_chained(run) for run in runs]


def _chained(run: list[Bead]) -> Bead:
    """Beads that follow one another without a step, as one."""
    points, width = np.concatenate([b.points for b in run]), np.concatenate([b.width for b in run])
    kept = np.append(True, np.abs(np.diff(points, axis=0)).max(axis=1) > SAME)
    return Bead(points[kept], width[kept])


def _wanted(ring: Bead, start: Array, seam: float) -> Array:
    first = int((ring.points @ start).argmax())
    along = ring.steps[:first].sum() + seam * ring.length
    return ring.at(np.array([along % ring.length]))[0, :2]


def _far(outer: Bead, inner: Bead, spacing: float) -> bool:
    """Whether two lines begin too far apart to be joined there."""
    return math.dist(outer.points[0], inner.points[0]) > NEAR * spacing


def _inwards(nest: list[Bead], wanted: Array) -> list[float]:
    """Where along each line it begins, mm: nearest to `wanted` (2,), or to where the one before begins."""
    arcs = []
    for ring in nest:
        arcs.append(float(shapely.line_locate_point(shapely.linestrings(ring.points), shapely.points(wanted))))
        wanted = ring.at(np.array(arcs[-1:]))[0, :2]
    return arcs


def _outwards(nest: list[Bead], wanted: Array, spacing: float) -> list[float]:
    """The same, so that each begins beside the one within it, the outermost as near to `wanted` as that allows."""
    inmost = nest[-1]
    place = inmost.at(np.linspace(0, inmost.length, PLACES, endpoint=False))[:, :2]
    arcs, far = [], np.zeros(PLACES)
    for ring in nest[::-1]:
        arc = shapely.line_locate_point(shapely.linestrings(ring.points), shapely.points(place))
        outer = ring.at(arc)[:, :2]
        far += np.linalg.norm(outer - place, axis=1) > NEAR * spacing
        place = outer
        arcs.append(arc)
    best = int((np.linalg.norm(place - wanted, axis=1) + 1e6 * far).argmin())
    return [float(arc[best]) for arc in arcs[::-1]]


def _begun(nest: list[Bead], arcs: list[float]) -> list[Bead]:
    """The lines begun at these lengths, all in the sense of the first."""
    number = np.repeat(np.arange(len(nest)), [len(ring.points) for ring in nest])
    sense = shapely.is_ccw(shapely.linearrings(np.concatenate([ring.points for ring in nest]), indices=number))
    found = [ring.turned(arc) for ring, arc in zip(nest, arcs, strict=True)]
    return [ring if way == sense[0] else ring.reversed for ring, way in zip(found, sense, strict=True)]


def _ramp(outer: Bead, inner: Bead, length: float) -> Bead:
    """From the start of a line over to `length` mm after the start of the one within it."""
    share = np.linspace(0, 1, STEPS)[1:, None]
    on_inner = inner.at(share[:, 0] * length)
    beside = outer.between(0.0, min(2 * length, outer.length / 2))
    arc = shapely.line_locate_point(shapely.linestrings(beside.points), shapely.points(on_inner[:, :2]))
    lines = (1 - share) * beside.at(arc) + share * on_inner
    return Bead(lines[:-1, :2], lines[:-1, 2])
