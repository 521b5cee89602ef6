"""Subjects `fill` and `plan`: beads in contours and random wounds, and a whole plan of a large wound.

`fill`: coverage and time of contours, beside other planners', and of random wounds; a picture of all patterns.
`plan`: from a damaged mesh in memory to the path: time, memory, fit. Each plan has a process of its own. The time is of
the processor, from the mesh's arrays to the path, without imports.
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
import shapely
from shapely import affinity
from shapely.geometry import LineString, MultiPolygon, Polygon
from shapely.geometry.base import BaseGeometry

from estimation.errors import InputError, StillbedError
from estimation.se3 import Array
from hardware.bench.figures import Figure, at_least, at_most, columns, with_progress
from hardware.process.clock import CpuClock, ProcessorClock
from planning.fill import PATTERN_KINDS
from planning.fill.bead import (
    Bead,
    FillCoverage,
    Pattern,
    PrintPace,
    Region,
    areas,
    even_bead,
    fill_coverage,
    only_areas,
    print_cost,
    region_of,
)
from planning.fill.fill import fill

Rng = np.random.Generator
MAX_ROUGHNESS = 0.2  # mm: noise of the points of a contour, as segmentation leaves it
MIN_AREA = 4.0  # mm2: smaller parts and holes are noise of the segmentation


def random_wound(rng: Rng) -> tuple[str, Region]:
    """What kind of wound it is, and its valid region, mm, somewhere near the origin at any rotation."""
    name = str(rng.choice(list(REGION_GENERATORS)))
    region = affinity.rotate(REGION_GENERATORS[name](rng), rng.uniform(0, 360), origin=(0, 0))
    if rng.random() < 0.5:
        region = _rough(region, rng)
    region = affinity.translate(region, *rng.uniform(-50, 50, 2))
    parts = [p for p in areas(only_areas(shapely.make_valid(region, method="structure"))) if p.area > MIN_AREA]
    holes = [[h for h in p.interiors if Polygon(h).area > MIN_AREA] for p in parts]
    return name, MultiPolygon([Polygon(p.exterior, h) for p, h in zip(parts, holes, strict=True)])


def outline(name: str) -> Polygon:
    """One of two fixed outlines: an `oval` with bays, a `bow` with four corners; both with points every millimetre."""
    t = np.linspace(0, 2 * np.pi, 160, endpoint=False)
    if name == "oval":
        r = 14 * (1 + 0.12 * np.cos(2 * t + 0.4) + 0.07 * np.cos(3 * t + 2) + 0.03 * np.cos(5 * t))
        return Polygon(_polar(r, t))
    t = np.linspace(-1.3, 1.3, 60)
    return _band(16, 2.8 + 0.7 * np.sin(3 * t + 1), t)


def _polar(radius: Array, angle: Array) -> Array:
    return np.column_stack([radius * np.cos(angle), radius * np.sin(angle)])


def _band(radius: float, half: Array, angle: Array) -> Polygon:
    """A band along an arc; half: of its width (N,)."""
    outer, inner = (_polar(radius + side * half, angle) for side in (1, -1))
    return Polygon(np.concatenate([outer, inner[::-1]]))


def _round(rng: Rng, radius: tuple[float, float] = (6.0, 18.0), strength: float = 0.25) -> Polygon:
    """A radius with harmonics, each weaker than the one before."""
    angle = np.linspace(0, 2 * np.pi, int(rng.integers(60, 300)), endpoint=False)
    order = np.arange(2, 9)[:, None]
    size = strength * rng.normal(size=order.shape) / order
    wave = (size * np.cos(order * angle + rng.uniform(0, 2 * np.pi, order.shape))).sum(axis=0)
    r = rng.uniform(*radius) * np.maximum(1 + wave, 0.3)
    return Polygon(_polar(r, angle))


def _angular(rng: Rng) -> Polygon:
    """A few straight edges, as of a cut or a flap."""
    angle = np.sort(rng.uniform(0, 2 * np.pi, int(rng.integers(4, 10))))
    r = rng.uniform(6, 18, len(angle))
    return Polygon(_polar(r, angle))


def _bent(rng: Rng) -> Region:
    """A band along an arc, of varying thickness."""
    t = np.linspace(0, 1, 90)
    turn, radius = rng.uniform(0.5, 4.5) * (t - 0.5), rng.uniform(10, 25)
    half = rng.uniform(1.5, 4) * (1 + 0.3 * np.sin(rng.uniform(2, 9) * t + rng.uniform(0, 6)))
    half *= np.sqrt(np.maximum(1 - (2 * t - 1) ** 2, 0.05)) if rng.random() < 0.5 else 1.0
    return _band(radius, half, turn)


def _slit(rng: Rng) -> Polygon:
    """A cut: long, narrow and pointed."""
    t = np.linspace(-1, 1, 60)
    length, half = rng.uniform(8, 25), rng.uniform(1.0, 4.0)
    bow = rng.uniform(-3, 3) * (1 - t**2)
    sides = [np.column_stack([t * length, bow + way * half * (1 - t**2)]) for way in (1, -1)]
    return Polygon(np.concatenate([sides[0], sides[1][-2:0:-1]]))


def _necked(rng: Rng) -> Region:
    """Two wounds that run into each other."""
    apart = rng.uniform(14, 30)
    neck = LineString([(-apart / 2, 0), (apart / 2, rng.uniform(-3, 3))]).buffer(rng.uniform(0.4, 3))
    ends = [affinity.translate(_round(rng, (5.0, 11.0)), s * apart / 2) for s in (-1, 1)]
    return only_areas(shapely.union_all([neck, *ends]))


def _holed(rng: Rng) -> Region:
    """Islands of healthy skin within."""
    whole = _round(rng, (12.0, 20.0))
    holes = [affinity.translate(_round(rng, (1.5, 4.0)), *rng.uniform(-9, 9, 2)) for _ in range(rng.integers(1, 4))]
    return only_areas(shapely.difference(whole, shapely.union_all(holes)))


def _parted(rng: Rng) -> Region:
    """Several wounds beside one another."""
    parts = [affinity.translate(_round(rng, (3.0, 9.0)), *rng.uniform(-20, 20, 2)) for _ in range(rng.integers(2, 6))]
    return only_areas(shapely.union_all(parts))


def _rough(region: Region, rng: Rng) -> Region:
    """The same with noise on every point of its contours."""
    sigma = rng.uniform(0, MAX_ROUGHNESS) / 2

    def ring(line: BaseGeometry) -> Array:
        points = shapely.get_coordinates(line.segmentize(0.5))[:-1]
        return np.asarray(points + rng.normal(0, sigma, points.shape).clip(-2 * sigma, 2 * sigma))

    parts = [Polygon(ring(p.exterior), [ring(h) for h in p.interiors]) for p in areas(region)]
    return only_areas(shapely.union_all([shapely.make_valid(p, method="structure") for p in parts]))


REGION_GENERATORS: dict[str, Callable[[Rng], Region]] = {
    **{"round": _round, "star": lambda rng: _round(rng, (10.0, 18.0), 0.6), "angular": _angular, "bent": _bent},
    **{"slit": _slit, "necked": _necked, "holed": _holed, "parted": _parted},
}

PX_PER_MM, DRAWING_MARGIN, CAPTION_HEIGHT = 9.0, 12.0, 34.0  # px around each drawing; px for two lines under it
DRAWING_COLUMNS = 3
DRAWN_WIDTH, WIDTH_STEP = 0.8, 0.05  # mm, of the beads drawn, and to which widths are rounded


def picture() -> str:
    """An SVG of all patterns in one outline with a hole."""
    region = outline("oval").difference(outline("oval").buffer(-10.5))
    left, low, right, high = region.bounds
    wide, tall = PX_PER_MM * np.array([right - left, high - low]) + 2 * DRAWING_MARGIN + [0.0, CAPTION_HEIGHT]
    parts = []
    for i, kind in enumerate(PATTERN_KINDS):
        beads = fill(region, Pattern(kind, DRAWN_WIDTH), PrintPace())
        coverage, cost = fill_coverage(beads, region), print_cost(beads, PrintPace())
        x, y = wide * (i % DRAWING_COLUMNS), tall * (i // DRAWING_COLUMNS)
        text = f"{100 * coverage.covered:.1f} % covered, {100 * coverage.double:.1f} % twice, {cost.seconds:.1f} s"
        parts.append(
            f'<g transform="translate({x + DRAWING_MARGIN:.0f} {y + DRAWING_MARGIN:.0f})">{_drawn(beads, left, high)}'
            f'<text y="{tall - CAPTION_HEIGHT:.0f}" font-weight="bold">{kind}</text>'
            f'<text y="{tall - CAPTION_HEIGHT + 15:.0f}">{text}</text></g>'
        )
    width, height = DRAWING_COLUMNS * wide, -(-len(PATTERN_KINDS) // DRAWING_COLUMNS) * tall
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width:.0f} {height:.0f}" font-family="sans-serif" '
        f'font-size="12"><rect width="100%" height="100%" fill="#fff"/>{"".join(parts)}</svg>\n'
    )


def _drawn(beads: Sequence[Bead], left: float, high: float) -> str:
    def path(points: Array) -> str:
        x, y = PX_PER_MM * (points[:, 0] - left), PX_PER_MM * (high - points[:, 1])
        return "M" + " ".join(f"{a:.1f} {b:.1f}" for a, b in zip(x, y, strict=True))

    laid = ""
    for bead in beads:  # in stretches of about one width each
        width = np.round((bead.width[1:] + bead.width[:-1]) / 2 / WIDTH_STEP) * WIDTH_STEP
        ends = [0, *(np.flatnonzero(np.diff(width)) + 1).tolist(), len(width)]
        for a, b in pairwise(ends):
            laid += f'<path d="{path(bead.points[a : b + 1])}" stroke-width="{PX_PER_MM * float(width[a]):.1f}"/>'
    middles = "".join(f'<path d="{path(bead.points)}"/>' for bead in beads)
    hops = "".join(f'<path d="{path(np.stack([a.points[-1], b.points[0]]))}"/>' for a, b in pairwise(beads))
    return (
        f'<g fill="none" stroke-linecap="round" stroke-linejoin="round"><g stroke="#e9a5a5">{laid}</g>'
        f'<g stroke="#7a1f2b" stroke-width="1">{middles}</g>'
        f'<g stroke="#2457a6" stroke-width="1" stroke-dasharray="3 3">{hops}</g></g>'
    )


CONTOUR_PATTERN, WOUND_PATTERN = Pattern("best", 0.8), Pattern("best", 0.4)  # mm of a bead
RETRY_ANGLE = 0.7  # rad: by which each tenth wound is turned and filled again, a multiple of no pattern's angle
THESIS_CONTOUR = 3995.5, 3.0  # px2 and px: the largest contour of thesis 5.3, and its lines' spacing
REFERENCE_PLANNERS = {  # what other planners reach at PEER_WIDTH and Pace(): covered %, s
    "blob": "contour-parallel by shapely 99.40 % in 48.3 s, PrusaSlicer concentric 98.82 % in 48.6 s",
    "crescent": "contour-parallel by shapely 97.32 % in 15.0 s, PrusaSlicer concentric 95.37 % in 15.4 s",
}
CONTOUR_TARGETS = {"blob": (99.4, 47.0), "crescent": (98.5, 15.0)}  # covered %, s


def run_fill(options: argparse.Namespace) -> list[Figure]:
    """Figures of the contours, of the random wounds and of time."""
    regions = {path.stem: _contour(path) for path in options.contours}
    regions = regions or {name: outline(name) for name in ("oval", "bow")}
    if options.picture is not None:
        options.picture.write_text(picture(), encoding="utf-8")
    figures = [figure for name, region in regions.items() for figure in _contour_figures(name, region)]
    if options.count:
        figures += _wound_figures(options.count, options.seed)
    return figures + _times()


def _contour(path: Path) -> Region:
    """The region inside a contour of a file with the columns x_mm,y_mm."""
    try:
        points = np.loadtxt(path, delimiter=",", skiprows=1, usecols=(0, 1), ndmin=2)
    except (OSError, ValueError) as error:
        raise InputError(path, "contour", str(error), "a file of lines x_mm,y_mm under a header") from error
    return region_of(points, path)


def _contour_figures(name: str, region: Region) -> list[Figure]:
    beads = fill(region, CONTOUR_PATTERN, PrintPace())
    coverage, cost = fill_coverage(beads, region), print_cost(beads, PrintPace())
    targets = CONTOUR_TARGETS.get(name)
    covered, seconds = (at_least(targets[0]), at_most(targets[1])) if targets else (None, None)
    note = f"{cost.printed:.0f} mm printed, {cost.travelled:.0f} mm travelled, {cost.turns} turns, {len(beads)} beads"
    peers = REFERENCE_PLANNERS.get(name, "")
    return [
        Figure(f"{name}: covered", 100 * coverage.covered, "%", covered, peers),
        Figure(f"{name}: over", 100 * coverage.over, "%", at_most(0.05)),
        Figure(f"{name}: double", 100 * coverage.double, "%", at_most(3.0)),
        Figure(f"{name}: time", cost.seconds, "s", seconds, peers, note),
        Figure(f"{name}: covered by lines of nominal width", 100 * _of_one_width(beads, region), "%"),
    ]


def _of_one_width(beads: Sequence[Bead], region: Region) -> float:
    """The share of a region that beads cover as other planners' are taken: all of one width."""
    return fill_coverage([even_bead(bead.points, CONTOUR_PATTERN.width) for bead in beads], region).covered


def _wound_figures(count: int, seed: int) -> list[Figure]:
    coverages: list[FillCoverage] = []
    crashes, turned, worst = 0, 0.0, ""
    cosine, sine = np.cos(RETRY_ANGLE), np.sin(RETRY_ANGLE)
    rotation = np.array([[cosine, sine], [-sine, cosine]])
    for i in with_progress("random wounds", "wounds", range(count), count):
        kind, region = random_wound(np.random.default_rng([seed, i]))
        try:
            coverage = fill_coverage(fill(region, WOUND_PATTERN, PrintPace()), region)
            if i % 10 == 0:
                again = shapely.transform(region, lambda points: points @ rotation)
                change = coverage.covered - fill_coverage(fill(again, WOUND_PATTERN, PrintPace()), again).covered
                turned = max(turned, abs(change))
        except Exception:  # whatever it is, it is counted
            crashes += 1
            continue
        if not coverages or coverage.covered < min(f.covered for f in coverages):
            worst = f"worst: number {i}, {kind}"
        coverages.append(coverage)
    covered, double, over = (100 * values for values in columns(coverages, "covered", "double", "over"))
    note = f"{count} of seed {seed}, bead {WOUND_PATTERN.width:g} mm"
    return [
        Figure("wounds: crashes", crashes, "", at_most(0), "", note),
        Figure("wounds: covered, least", float(covered.min()), "%", at_least(99.0), "none published", worst),
        Figure("wounds: covered, median", float(np.median(covered)), "%"),
        Figure("wounds: covered below 99 %", float(np.mean(covered < 99) * 100), "%", None, "", "share of the wounds"),
        Figure("wounds: double, most", float(double.max()), "%", at_most(5.0), "none published"),
        Figure("wounds: over, most", float(over.max()), "%"),
        Figure("wounds: covered when turned, change", 100 * turned, "%", at_most(0.2), "", "each tenth, by 40 degrees"),
    ]


def _times() -> list[Figure]:
    area, spacing = THESIS_CONTOUR
    wound = outline("oval")
    large = shapely.transform(wound, lambda points: points * np.sqrt(area / wound.area))
    low, high = np.array(wound.bounds).reshape(2, 2)
    wide = shapely.transform(wound, lambda points: (points - low) * [60.0, 40.0] / (high - low))
    both = _median_ms(lambda: fill(large, Pattern("zigzag", spacing, angle="shorter"), PrintPace()), 200)
    whole = _median_ms(lambda: fill(wide, WOUND_PATTERN, PrintPace()), 5)
    return [
        Figure("two orientations of 4,000 px2", both, "ms", at_most(1.0), "thesis 3 ms", "median of 200, CPU"),
        Figure("layer of 60 x 40 mm, bead 0.4 mm", whole, "ms", at_most(130.0), "", "median of 5, CPU; 15 in 2 s"),
    ]


def _median_ms(work: Callable[[], object], count: int) -> float:
    clock, times = CpuClock(), []
    for _ in range(count):
        start = clock.now()
        work()
        times.append(1e3 * (clock.now() - start))
    return float(np.median(times))


PLAN_WOUND_SIZE, PLAN_WOUND_DEPTH = (60.0, 40.0), 4.0  # mm; with the bed's unevenness 6 mm deep at the deepest
SCAN_SPACING = 1.0  # mm between the vertices of a scan, as handheld scanners give them
PLAN_BEAD = 0.4  # mm
DAMAGED_SHARE = 0.01  # share of the triangles that are turned over, and of those that are missing
PLAN_PATTERNS = ("zigzag", "hybrid", "contour")
LAYER_MODES = ("conformal", "horizontal")  # beside "skin"
PLAN_PROCESS = """
import sys
import numpy
from hardware.process.clock import ProcessorClock
clock = ProcessorClock()
start = clock.now()
import planning.fill.bead, planning.layers.plan, planning.layers.repair, planning.layers.slicing, planning.layers.wound
imports = clock.now() - start
from tests.campaigns.fill import measure_plan
measure_plan(imports, *sys.argv[1:])
"""


@dataclass(frozen=True, slots=True)
class MeasuredPlan:
    """The measurements of one process."""

    imports: float  # s of the processor
    seconds: float  # of the processor
    memory: float  # MB at the peak
    checkpoints: int
    layers: int
    depth: float  # mm
    filled: float  # volume of the beads over that of the wound
    covered: float
    double: float


def run_plan(options: argparse.Namespace) -> list[Figure]:
    """Plans of one wound by pattern and by way of layering."""
    cases = [(pattern, "skin") for pattern in PLAN_PATTERNS] + [("hybrid", mode) for mode in LAYER_MODES]
    return [figure for pattern, mode in cases for figure in _plan_figures(options.body, pattern, mode)]


def _plan_figures(kind: str, pattern: str, mode: str) -> list[Figure]:
    # in a process of its own, where the imports of planning are measured before anything else is loaded
    command = [sys.executable, "-c", PLAN_PROCESS, kind, pattern, mode]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        raise StillbedError(f"planning ended with {done.returncode}: {done.stderr.strip()[-300:]}")
    m, name = MeasuredPlan(**json.loads(done.stdout)), f"{pattern}, layers {mode}"
    note = f"{m.layers} layers, {m.checkpoints} checkpoints, {m.depth:.1f} mm deep; imports {m.imports:.2f} s apart"
    return [
        Figure(f"{name}: time", m.seconds, "s", at_most(2.0), "none", note),
        Figure(f"{name}: memory", m.memory, "MB", at_most(500.0), "none", "the whole process"),
        Figure(f"{name}: covered", 100 * m.covered, "%", at_least(99.0), "97.8 (thesis, one flat contour)"),
        Figure(f"{name}: laid twice", 100 * m.double, "%", at_most(5.0)),
        Figure(f"{name}: ink over the wound's volume", m.filled, "", None, "", "1 fills it exactly"),
    ]


def measure_plan(imports: float, kind: str, pattern: str, mode: str) -> None:
    """Plan once, in this process, and print the measurements. imports: s, that the imports of planning took."""
    from hardware.simulator.scene.shape import Wound, body
    from planning.layers.plan import PlanOrder, figures_of, make_plan, total_of
    from planning.layers.repair import repair_mesh
    from planning.layers.slicing import Tissue
    from planning.layers.wound import find_wound

    clock = ProcessorClock()
    vertices, triangles = body(kind, Wound(PLAN_WOUND_SIZE, PLAN_WOUND_DEPTH), 1).mesh(SCAN_SPACING)
    chance = np.random.default_rng(1).random(len(triangles))  # some triangles are turned over, some are missing
    triangles = np.where((chance < DAMAGED_SHARE)[:, None], triangles[:, ::-1], triangles)
    triangles = triangles[chance < 1 - DAMAGED_SHARE]
    layers = ("hypodermis", None), ("dermis", 1.6), ("epidermis", 0.4)
    tissues = tuple(Tissue(name, thickness, name) for name, thickness in layers)
    order = PlanOrder(tissues, Pattern(pattern, PLAN_BEAD), mode)  # type: ignore[arg-type]
    start = clock.now()
    scan, _ = repair_mesh(vertices, triangles, "scan")
    plan = make_plan(find_wound(scan, 0.6 * PLAN_BEAD, "scan"), order)
    seconds = clock.now() - start
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    total, wound = total_of(figures_of(plan)), plan.wound.findings
    filled, sizes = float(plan.points.volume.sum()) / wound.volume, (len(plan.path), len(plan.layers), wound.depth)
    print(json.dumps(asdict(MeasuredPlan(imports, seconds, memory, *sizes, filled, total.covered, total.double))))
