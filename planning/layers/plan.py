"""The whole plan, from a wound to a path: layers, beads, checkpoints, and the figures of each layer."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace

import numpy as np
import shapely
from scipy.ndimage import distance_transform_edt
from shapely import MultiPolygon

from estimation import se3
from estimation.errors import InputError
from estimation.se3 import Array
from planning.clearance import ToolBody
from planning.command import MotionLimits
from planning.fill.bead import Bead, FillCoverage, Pattern, PrintPace, fill_coverage, region_of
from planning.fill.fill import fill, settle_angle
from planning.kinematics import SimpleArm
from planning.layers.checkpoints import (
    BeadPoints,
    Checkpoints,
    CheckpointSettings,
    TipSurface,
    ceiling,
    checkpoints_on,
    curvature,
    path_from,
    tilt_field,
    with_travels,
)
from planning.layers.clearing import LaidTissue, ToolClearance, beads_with_room, travels_with_room
from planning.layers.grid import Chart, as_multi, flat_chart, grid_over, interpolate, nodes_within, unroll
from planning.layers.slicing import BumpPassing, Layer, LayerMode, LayerStack, Tissue, layer_stack
from planning.layers.wound import WoundFindings, WoundVolume
from planning.motion.retime import run_times
from planning.path import Path

Report = Callable[[int, int], None]  # (layers done, layers)
SHARP_TURN_TIME = 0.05  # s for each sharp turn, as other planners' times are counted
# of a closed line's length, from layer to layer: keeps seams apart for the most layers, by the three-distance theorem
SEAM_SHIFT = 0.6180339887498949
TICK = 0.02  # s of an arm of no particular kind
MIN_DISC_AREA = 0.75  # widths squared: a part of less area holds no disc of that width, which has pi / 4 of them
GRID_STEP, GRID_MARGIN = 1.0, 5.0  # mm: a plane needs no fine grid
UNSCANNED_FROM = 1.0  # mm to the nearest scanned place: a hole 2 mm wide, beyond what a lost triangle leaves
MAX_GRID_NODES = 1000.0  # nodes along a side


@dataclass(frozen=True, slots=True)
class PlanOrder:
    """What is to be planned."""

    tissues: tuple[Tissue, ...]
    pattern: Pattern = field(default_factory=Pattern)
    mode: LayerMode = "skin"  # how layers lie
    way: CheckpointSettings = field(default_factory=CheckpointSettings)
    crossed: bool = True  # lines of every second layer across the others'
    passing: BumpPassing = field(default_factory=BumpPassing)  # how bumps of the bed are passed
    tool: ToolBody | None = None  # that must have room


@dataclass(frozen=True, slots=True, eq=False)
class PlannedLayer:
    """One layer as it is printed; regions and beads in the chart, mm."""

    layer: Layer
    region: MultiPolygon
    beads: tuple[Bead, ...]  # in printing order
    over: MultiPolygon  # bumps that it goes over
    around: MultiPolygon  # bumps that it goes round
    left_out: tuple[Array, ...] = ()  # lines (N, 2) of beads over which the tool has no room

    @property
    def coverage(self) -> FillCoverage:
        """How much of the region the beads cover."""
        return fill_coverage(self.beads, self.region)


@dataclass(frozen=True, slots=True, eq=False)
class Plan:
    """A path, and what it was made of."""

    path: Path
    points: Checkpoints  # in the plane's frame
    wound: WoundVolume
    stack: LayerStack
    chart: Chart
    ground: TipSurface
    layers: tuple[PlannedLayer, ...]
    order: PlanOrder
    clearance: ToolClearance | None = None  # None: no tool was given


def make_plan(
    wound: WoundVolume, order: PlanOrder, where: object = "plan", report: Report = lambda done, total: None
) -> Plan:
    """The plan of a wound; InputError where no bead finds room in it."""
    stack = layer_stack(wound, order.tissues, order.mode, order.pattern.width, order.passing)
    chart = flat_chart(wound.grid) if order.mode == "horizontal" else unroll(wound.grid, wound.skin)
    if isinstance(order.pattern.angle, str):  # one for all layers: the best for the largest
        largest = max(stack.layers, key=lambda layer: layer.region.area)
        pattern = settle_angle(_in_chart(largest.region, chart), order.pattern, _pace(largest, order))
        order = replace(order, pattern=pattern)
    planned = []
    for i, layer in enumerate(stack.layers):
        planned.append(_planned_layer(layer, chart, order))
        report(i + 1, len(stack.layers))
    beads = [bead for layer in planned for bead in layer.beads]
    if not beads:
        allowed = f"a wound wider than {order.pattern.width:g} mm, or finer beads"
        raise InputError(where, "beads", "none has room", allowed)
    layer_of = np.repeat([p.layer.number for p in planned], [len(p.beads) for p in planned])
    ground = _tip_surface(wound, stack, chart, order.way)
    runs, printed = checkpoints_on(ground, beads, layer_of, order.way)
    if order.tool is None:
        points, clearance = with_travels(ground, printed, runs, order.way), None
    else:
        laid = LaidTissue(wound, stack, order.tool)
        runs, printed, clearance = beads_with_room(runs, printed, laid, order.way, wound.surface_from_plane)
        if not len(printed.tip):
            worst = max(clearance.left_out, key=lambda left: left.short)
            allowed = f"a longer or thinner needle, or more tilt: the {worst.part} lacks up to {worst.short:.1f} mm"
            raise InputError(where, "beads", "none over which the tool has room", allowed)
        planned = [_without_left_out(layer, runs, printed, clearance) for layer in planned]
        points = travels_with_room(with_travels(ground, printed, runs, order.way), laid)
    path = path_from(points, ground, order.way.tool.spin)
    return Plan(path, points, wound, stack, chart, ground, tuple(planned), order, clearance)


def _without_left_out(
    layer: PlannedLayer, runs: BeadPoints, printed: Checkpoints, clearance: ToolClearance
) -> PlannedLayer:
    """The layer with what is printed of its beads, and the lines of what is not."""
    number = layer.layer.number
    left = tuple(each.line for each in clearance.left_out if each.layer == number)
    if not left:
        return layer
    own = np.flatnonzero(printed.layer == number)
    cuts = np.flatnonzero(np.diff(runs.bead[own])) + 1
    beads = tuple(Bead(runs.points[rows], runs.width[rows]) for rows in np.split(own, cuts) if len(rows))
    return replace(layer, beads=beads, left_out=left)


def _in_chart(shape: MultiPolygon, chart: Chart) -> MultiPolygon:
    return shape if shape.is_empty else as_multi(shapely.make_valid(shapely.transform(shape, chart.from_plane)))


def _pace(layer: Layer, order: PlanOrder) -> PrintPace:
    return PrintPace(layer.slab.tissue.speed, order.way.travel, SHARP_TURN_TIME)


def _planned_layer(layer: Layer, chart: Chart, order: PlanOrder) -> PlannedLayer:
    region = _in_chart(layer.region, chart)
    pattern = replace(order.pattern, seam=(order.pattern.seam + SEAM_SHIFT * layer.number) % 1.0)
    if order.crossed and layer.number % 2 and not isinstance(pattern.angle, str):
        pattern = replace(pattern, angle=pattern.angle + np.pi / 2)
    beads = () if region.is_empty else tuple(fill(region, pattern, _pace(layer, order)))
    return PlannedLayer(layer, region, beads, _in_chart(layer.bumps.over, chart), _in_chart(layer.bumps.around, chart))


def _tip_surface(wound: WoundVolume, stack: LayerStack, chart: Chart, way: CheckpointSettings) -> TipSurface:
    inside = nodes_within(wound.grid, wound.outline)
    ends = [stack.lowest, stack.highest]
    low, high = (tilt_field(wound.grid, end, inside, way.tool) for end in ends)
    curvatures = np.stack([curvature(wound.grid, end, way.spacing / 2) for end in ends], axis=-1)
    return TipSurface(stack, chart, wound.surface_from_plane, low, high, curvatures, ceiling(wound.grid, wound.bed))


@dataclass(frozen=True, slots=True, eq=False)
class Unscanned:
    """Beads over places that the scan does not show."""

    hole: bool  # a hole of the scan; else beyond its rim
    layers: tuple[int, ...]
    length: float  # mm
    place: Array  # (3,) mm, scan frame, in the longest stretch's middle


def unscanned_beads(plan: Plan) -> list[Unscanned]:
    """Beads over what was not scanned within UNSCANNED_FROM, over holes and beyond the rim."""
    wound, points = plan.wound, plan.points
    away = distance_transform_edt(~wound.scanned) * wound.grid.step
    if not (away > UNSCANNED_FROM).any():
        return []
    off = interpolate(wound.grid, away, points.tip[:, :2]) > UNSCANNED_FROM
    inner = interpolate(wound.grid, wound.holes.astype(float), points.tip[:, :2]) > 0.5
    step = np.r_[0.0, np.linalg.norm(np.diff(points.tip, axis=0), axis=1)] * points.extrude
    found = []
    for hole in (True, False):
        over = off & points.extrude & (inner == hole)
        if not over.any():
            continue
        stretch = np.cumsum(np.diff(over, prepend=False) & over) * over
        longest = np.flatnonzero(stretch == np.bincount(stretch, step * over).argmax())
        place = se3.transform_points(wound.surface_from_plane, points.tip[longest[len(longest) // 2]][None])[0]
        layers = tuple(np.unique(points.layer[over]).tolist())
        found.append(Unscanned(hole, layers, float(step[over].sum()), place))
    return found


@dataclass(frozen=True, slots=True, eq=False)
class LayerFigures:
    """The figures of one layer."""

    number: int
    tissue: str
    material: str
    area: float  # mm^2
    beads: int
    checkpoints: int
    printed: float  # mm
    travelled: float  # mm
    seconds: float  # that a run takes over a surface at rest, waits included
    volume: float  # mm^3
    coverage: FillCoverage
    gap: float  # mm^2 of all gaps
    half_gap: float  # mm^2 of gaps wider than half a bead
    bead_gap: float  # mm^2 of gaps wider than a bead


@dataclass(frozen=True, slots=True)
class PlanTotal:
    """All layers together."""

    area: float  # mm^2
    covered: float  # share of the area, as in FillCoverage
    over: float  # the same
    double: float  # the same
    gap: float  # mm^2
    bead_gap: float  # mm^2
    printed: float  # mm
    travelled: float  # mm
    seconds: float
    volume: tuple[tuple[str, float], ...]  # mm^3 by material


def figures_of(
    plan: Plan, report: Report = lambda done, total: None, moments: Array | None = None
) -> list[LayerFigures]:
    """The figures of each layer that has beads. One thread a core: GEOS, which unites the beads, releases the GIL.

    moments: times (N,), s, at which a run is at the path's checkpoints; by default as an arm of no particular kind.
    """
    moments = run_times(plan.path, SimpleArm(), MotionLimits(), TICK) if moments is None else moments
    printed_layers = [layer for layer in plan.layers if layer.beads]
    figures_list = []
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        try:
            for figures in pool.map(lambda layer: _figures(plan, layer, moments), printed_layers):
                figures_list.append(figures)
                report(len(figures_list), len(printed_layers))
        finally:
            pool.shutdown(cancel_futures=True)  # Ctrl-C waits for no layer that has not begun
    return figures_list


def _figures(plan: Plan, layer: PlannedLayer, moments: Array) -> LayerFigures:
    points, number = plan.points, layer.layer.number
    own = points.layer == number
    step = np.r_[0.0, np.linalg.norm(np.diff(points.tip, axis=0), axis=1)]
    seconds = float(np.diff(moments, prepend=0.0)[plan.path.layer == number].sum())
    result, tissue = layer.coverage, layer.layer.slab.tissue
    half, whole = (_wide_area(result.gaps, part * plan.order.pattern.width) for part in (0.5, 1.0))
    return LayerFigures(
        number, tissue.name, tissue.material, float(layer.region.area), len(layer.beads), int(own.sum()),
        float(step[own & points.extrude].sum()), float(step[own & ~points.extrude].sum()), seconds,
        float(points.volume[own].sum()), result, float(result.gaps.area), half, whole,
    )  # fmt: skip


def _wide_area(gaps: shapely.MultiPolygon, width: float) -> float:
    """Area, mm^2, of the parts of gaps into which a disc `width` mm wide fits."""
    parts = shapely.get_parts(gaps)
    large = shapely.multipolygons(parts[shapely.area(parts) > MIN_DISC_AREA * width**2])
    core = shapely.buffer(large, -width / 2)
    return float(shapely.intersection(shapely.buffer(core, width / 2), large).area) if not core.is_empty else 0.0


def total_of(layers: Iterable[LayerFigures]) -> PlanTotal:
    """All layers together."""
    layers = list(layers)
    area = np.array([layer.area for layer in layers])
    volumes: dict[str, float] = {}
    for layer in layers:
        volumes[layer.material] = volumes.get(layer.material, 0.0) + layer.volume

    def mean(values: list[float]) -> float:
        return float(area @ values / area.sum())

    return PlanTotal(
        float(area.sum()), mean([f.coverage.covered for f in layers]), mean([f.coverage.over for f in layers]),
        mean([f.coverage.double for f in layers]), sum(f.gap for f in layers), sum(f.bead_gap for f in layers),
        sum(f.printed for f in layers), sum(f.travelled for f in layers), sum(f.seconds for f in layers),
        tuple(volumes.items()),
    )  # fmt: skip


def flat_wound(contour: Array, thickness: float, where: object) -> WoundVolume:
    """The wound inside a contour (N, 2), mm, with a flat bed at z = 0 and `thickness` mm to be laid on it."""
    outline = MultiPolygon([region_of(contour, where)])
    low, high = np.array(outline.bounds).reshape(2, 2)
    step = max(GRID_STEP, float((high - low).max()) / MAX_GRID_NODES)
    grid = grid_over(low - GRID_MARGIN, high + GRID_MARGIN, step)
    bed = np.zeros(grid.shape)
    area = float(shapely.area(outline))
    findings = WoundFindings(
        given=True, area=area, volume=area * thickness, volume_sigma=0.0, depth=thickness, skin_sigma=0.0, margin=0.0,
        level=0.0, noise=0.0, smoothing=0.0,
        scatter=0.0, closed=0.0, hidden=0.0, cut=0.0, others=0, notes=(),
    )  # fmt: skip
    all_of_it, none = np.ones(grid.shape, bool), np.zeros(grid.shape, bool)
    return WoundVolume(np.eye(4), grid, bed, bed + thickness, np.zeros(grid.shape), outline, findings, all_of_it, none)
