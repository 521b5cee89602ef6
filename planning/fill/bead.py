"""Beads, extruded runs in the plane, and the regions that they fill: patterns, widths, time, and how far they cover.

A region is read from a contour and checked.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Literal, TypeAlias

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely.geometry import MultiPolygon, Polygon
from shapely.geometry.base import BaseGeometry

from estimation.errors import InputError
from estimation.se3 import Array
from planning.fill import PATTERN_KINDS, PatternKind

POINT_TOLERANCE = 1e-9  # mm: two points nearer are one
TWO_BEADS_FROM = 0.625  # spacings: radius from which two beads are laid: one would be a quarter wider than nominal
SHARP_TURN = np.deg2rad(30.0)  # a turn beyond costs time; as the other planners' figures were counted


@dataclass(frozen=True, slots=True, eq=False)
class Bead:
    """One run of the nozzle without a stop of the flow."""

    points: Array  # (N, 2) mm, N >= 2; a closed run repeats its first point
    width: Array  # (N,) mm of the line at each point, linear between them

    @property
    def closed(self) -> bool:
        """Whether it ends where it began."""
        return len(self.points) > 3 and bool(np.abs(self.points[0] - self.points[-1]).max() < POINT_TOLERANCE)

    @property
    def steps(self) -> Array:
        """Lengths (N-1,) mm from point to point."""
        x, y = (self.points[1:] - self.points[:-1]).T
        return np.asarray(np.sqrt(x * x + y * y))

    @property
    def length(self) -> float:
        """The whole length, mm."""
        return float(self.steps.sum())

    @property
    def area(self) -> float:
        """Area of its material, mm2: length times width."""
        return float(self.steps @ (self.width[:-1] + self.width[1:]) / 2)

    @property
    def reversed(self) -> Bead:
        """The same bead from its other end."""
        return Bead(self.points[::-1], self.width[::-1])

    @property
    def along(self) -> Array:
        """Length (N,) mm from the start to each point."""
        return np.concatenate([[0.0], np.cumsum(self.steps)])

    def at(self, along: Array) -> Array:
        """x, y and width (M, 3) at lengths (M,) mm from the start; its ends beyond them."""
        length = self.along
        return np.stack([np.interp(along, length, values) for values in (*self.points.T, self.width)], axis=1)

    def between(self, start: float, end: float) -> Bead:
        """The stretch from one length to another, mm from the start."""
        length = self.along
        a, b = np.searchsorted(length, [start + POINT_TOLERANCE, end - POINT_TOLERANCE])
        ends = self.at(np.array([start, end]))
        lines = np.concatenate([ends[:1], np.column_stack([self.points[a:b], self.width[a:b]]), ends[1:]])
        return Bead(lines[:, :2], lines[:, 2])

    def turned(self, start: float) -> Bead:
        """A closed bead that begins and ends at `start` mm from its start instead."""
        length = self.along
        if start < POINT_TOLERANCE or start > length[-1] - POINT_TOLERANCE:
            return self
        a, b = np.searchsorted(length, [start - POINT_TOLERANCE, start + POINT_TOLERANCE])
        here, lines = self.at(np.array([start])), np.column_stack([self.points, self.width])
        lines = np.concatenate([here, lines[b:], lines[1:a], here])
        return Bead(lines[:, :2], lines[:, 2])


def even_bead(points: Array, width: float) -> Bead:
    """A bead of one width, mm, through points (N, 2)."""
    return Bead(points, np.full(len(points), width))


@dataclass(frozen=True, slots=True)
class Pattern:
    """How a region is filled.

    angle: rad from the x axis, of the lines of zigzag, raster and hybrid; "shorter" takes the shorter of horizontal and
    vertical (thesis 5.3), "fastest" the fastest of `angles` many. seam: where on a closed line printing begins, counted
    along it from the point farthest in `start`; a different one in each layer keeps seams from lying on one another.
    """

    kind: PatternKind = "best"  # see docs/patterns.md
    width: float = 0.4  # mm of a nominal bead
    overlap: float = 0.0  # share of the width by which neighbours overlap
    inset: float = 0.0  # mm left free along the contour
    angle: float | Literal["shorter", "fastest"] = "fastest"
    angles: int = 12
    rims: int = 1  # closed lines around the lines of hybrid
    narrowest: float = 0.5  # of the width, that the nozzle can lay
    widest: float = 1.75  # of the width, that the nozzle can lay
    start: tuple[float, float] = (-1.0, 1.0)  # direction of the side to begin at; here top left where y points up
    seam: float = 0.0  # 0 to 1

    def __post_init__(self) -> None:
        _require(self.kind in PATTERN_KINDS, "kind", self.kind, " | ".join(PATTERN_KINDS))
        _require(0.01 <= self.width <= 20, "width", self.width, "0.01 to 20 mm")
        _require(0 <= self.overlap <= 0.9, "overlap", self.overlap, "0 to 0.9 of the width")
        _require(0 <= self.inset <= 100, "inset", self.inset, "0 to 100 mm")
        worded = self.angle in ("shorter", "fastest")
        _require(worded or math.isfinite(float(self.angle)), "angle", self.angle, "rad, shorter or fastest")
        _require(1 <= self.angles <= 360, "angles", self.angles, "1 to 360")
        _require(0 <= self.rims <= 100, "rims", self.rims, "0 to 100")
        _require(0.1 <= self.narrowest <= 1, "narrowest", self.narrowest, "0.1 to 1")
        _require(1 <= self.widest <= 4, "widest", self.widest, "1 to 4")
        _require(0 < math.hypot(*self.start) < math.inf, "start", self.start, "a direction")
        _require(0 <= self.seam <= 1, "seam", self.seam, "0 to 1")

    @property
    def spacing(self) -> float:
        """From line to line, mm."""
        return self.width * (1 - self.overlap)


def _require(fine: bool, what: str, got: object, allowed: str) -> None:
    if not fine:
        raise InputError("pattern", what, got, allowed)


@dataclass(frozen=True, slots=True)
class BeadFit:
    """How many beads fit into a place, and how wide they may be."""

    spacing: float  # mm, of closed lines
    one: float  # mm, radius from which one bead fits
    two: float  # mm, radius from which two fit
    most: float  # mm, greatest width of a bead
    outermost: float  # mm, spacing of the outermost closed lines alone

    @property
    def three(self) -> float:
        """Radius, mm, from which a third bead fits between two: two share less."""
        return self.spacing + self.one

    def at(self, level: int) -> BeadFit:
        """What fits at a level of closed lines, 0 the outermost."""
        return self if level else replace(self, spacing=self.outermost)

    def outside(self, level: NDArray[np.intp] | int) -> Array:
        """How thick, mm, all levels outside this one are together."""
        return np.where(np.asarray(level) > 0, self.outermost + self.spacing * (np.asarray(level) - 1), 0.0)

    def level(self, radius: Array) -> NDArray[np.intp]:
        """The level of the innermost lines where discs have this radius; -1 where not even one bead fits."""
        further = np.floor((radius - self.outermost - self.one) / self.spacing).astype(int) + 1
        return np.where(radius < self.one, -1, np.maximum(further, 0))


def bead_fit(pattern: Pattern) -> BeadFit:
    """The fit of a pattern's nozzle; overlap brings neighbours closer, the nozzle does not lay less."""
    s = pattern.spacing
    return BeadFit(s, pattern.narrowest * s / 2, min(TWO_BEADS_FROM, pattern.widest / 2) * s, pattern.widest * s, s)


@dataclass(frozen=True, slots=True)
class PrintPace:
    """Speeds by which the time of a print is counted."""

    printing: float = 20.0  # mm/s
    travel: float = 60.0  # mm/s
    turn: float = 0.05  # s for each turn of more than SHARP_TURN


@dataclass(frozen=True, slots=True)
class PrintCost:
    """The cost of a list of beads."""

    printed: float  # mm
    travelled: float  # mm
    turns: int  # of more than SHARP_TURN, within beads and where travels begin and end
    seconds: float


def print_cost(beads: Sequence[Bead], pace: PrintPace) -> PrintCost:
    """Length, travel, turns and time of beads printed in this order."""
    printed = sum(bead.length for bead in beads)
    travelled = travel_length(beads)
    way = np.concatenate([np.empty((0, 2)), *(bead.points for bead in beads)])
    distinct = np.ones(len(way), bool)
    distinct[1:] = np.abs(np.diff(way, axis=0)).max(axis=1) > POINT_TOLERANCE
    turns = int((turn_angles(way[distinct]) > SHARP_TURN).sum())
    seconds = printed / pace.printing + travelled / pace.travel + turns * pace.turn
    return PrintCost(printed, travelled, turns, seconds)


def travel_length(beads: Sequence[Bead]) -> float:
    """Length mm of the way from the end of each bead to the start of the next."""
    return sum(math.dist(a.points[-1], b.points[0]) for a, b in pairwise(beads))


def turn_angles(points: Array) -> Array:
    """Turn angles (N-2,), rad, 0 to pi, at the inner points of a line (N, 2)."""
    x, y = (points[1:] - points[:-1]).T
    cross, dot = x[:-1] * y[1:] - y[:-1] * x[1:], x[:-1] * x[1:] + y[:-1] * y[1:]
    return np.asarray(np.abs(np.arctan2(cross, dot)))


ROUNDING_GRID = 1e-6  # mm to which corners are rounded where exact arithmetic finds no answer

Region: TypeAlias = Polygon | MultiPolygon

# steps buffered at once: of a long spiral, which touches itself all along, GEOS makes invalid areas
MAX_BUFFERED_STEPS = 32


def region_of(contour: Array, where: object = "contour") -> Polygon:
    """The region inside a contour (N, 2), mm; InputError says where it crosses itself."""
    if contour.ndim != 2 or contour.shape[1] != 2 or len(contour) < 3:
        raise InputError(where, "shape", contour.shape, "(N, 2) with N >= 3")
    if not np.isfinite(contour).all():
        raise InputError(where, "point", contour[~np.isfinite(contour).all(axis=1)][0], "finite numbers")
    region = Polygon(contour)
    check_region(region, where)
    return region


def check_region(region: Region, where: object = "region") -> Region:
    """The region itself if its contours cross neither themselves nor one another; InputError says where they do."""
    if not isinstance(region, Polygon | MultiPolygon):
        raise InputError(where, "kind", type(region).__name__, "Polygon or MultiPolygon")
    if not np.isfinite(shapely.get_coordinates(region)).all():
        raise InputError(where, "points", "not finite", "finite numbers")
    if not region.is_valid:
        raise InputError(where, "contour", shapely.is_valid_reason(region), "contours that do not cross, x y in mm")
    return region


def without_bumps(region: Region, bumps: Region, clearance: float) -> Region:
    """The region without bumps that are too high to go over, and without `clearance` mm around them (thesis 5.2)."""
    return only_areas(shapely.difference(region, shapely.buffer(bumps, clearance)))


def roughness(region: Region, width: float) -> float:
    """Share of the area that a disc `width` mm wide does not reach: corners, and what is narrower."""
    radius = width / 2
    return 1 - float(shapely.buffer(shapely.buffer(region, -radius), radius).area / region.area)


def only_areas(shape: BaseGeometry) -> Region:
    """The areas of whatever a shapely operation returned; lines and points have none."""
    return MultiPolygon(areas(shape))


def areas(shape: BaseGeometry) -> list[Polygon]:
    """The non-empty polygons of a shape, one by one."""
    parts = shapely.get_parts(shapely.get_parts(shape))
    return [part for part in parts if isinstance(part, Polygon) and not part.is_empty]


def difference(a: BaseGeometry, b: BaseGeometry) -> BaseGeometry:
    """What lies in a and not in b, also where simplified outlines cross themselves by a micrometre."""
    try:
        return shapely.difference(a, b)
    except shapely.GEOSException:
        return shapely.difference(shapely.buffer(a, 0), shapely.buffer(b, 0), grid_size=ROUNDING_GRID)


def union_of(shapes: Sequence[BaseGeometry]) -> BaseGeometry:
    """What lies in any of the shapes, also where exact arithmetic finds no answer."""
    try:
        return shapely.union_all(shapes)
    except shapely.GEOSException:
        return shapely.union_all(shapely.buffer(shapes, 0), grid_size=ROUNDING_GRID)


@dataclass(frozen=True, slots=True, eq=False)
class FillCoverage:
    """How beads cover a region, as shares of its area."""

    covered: float  # by the union of the beads
    over: float  # of the union, outside the region
    double: float  # material (length times width) beyond the union
    gaps: MultiPolygon  # what stays open


def fill_coverage(beads: Sequence[Bead], region: Region) -> FillCoverage:
    """Coverage of a region by beads, each point of them a disc of the local width, as dispensed by a round nozzle."""
    if region.area == 0:
        return FillCoverage(1.0, 0.0, 0.0, MultiPolygon())
    union = covered_area(beads)
    material = sum(bead.area for bead in beads)
    gaps = only_areas(difference(region, union))
    over, area = difference(union, region).area, region.area
    double = max(material - union.area, 0.0)  # the round ends of short beads cover more than length times width
    return FillCoverage((union.area - over) / area, over / area, double / area, gaps)


def covered_area(beads: Sequence[Bead], arc: int = 16) -> BaseGeometry:
    """The area that beads cover. arc: edges that each quarter of a disc is drawn with."""
    return union_of([shape for bead in beads for shape in _shapes(bead, arc)])


def _shapes(bead: Bead, arc: int) -> list[BaseGeometry]:
    """Areas that together are a bead's: stretches of one width as a whole, and each step on which the width changes."""
    change = np.abs(np.diff(bead.width)) > 1e-9
    ends = np.concatenate([[0], np.flatnonzero(np.diff(change)) + 1, [len(change)]])
    shapes: list[BaseGeometry] = []
    for a, b in pairwise(ends.tolist()):
        if change[a]:
            shapes += _tapered(bead.points[a : b + 1], bead.width[a : b + 1], arc)
        else:
            cuts = [*range(a, b, MAX_BUFFERED_STEPS), b]
            lines = [shapely.linestrings(bead.points[i : j + 1]) for i, j in pairwise(cuts)]
            shapes += shapely.buffer(lines, bead.width[a] / 2, quad_segs=arc).tolist()
    return shapes


def _tapered(points: Array, width: Array, arc: int) -> list[BaseGeometry]:
    step = np.diff(points, axis=0)
    side = np.stack([-step[:, 1], step[:, 0]], axis=1)
    side /= 2 * np.maximum(np.linalg.norm(step, axis=1), 1e-12)[:, None]
    a, b = side * width[:-1, None], side * width[1:, None]
    corners = np.stack([points[:-1] + a, points[:-1] - a, points[1:] - b, points[1:] + b], axis=1)
    return [*shapely.polygons(corners), *shapely.buffer(shapely.points(points), width / 2, quad_segs=arc)]
