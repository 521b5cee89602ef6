"""The whole way from a wound to a path: layers, beads in each, checkpoints, and what they come to."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
import shapely
from shapely import MultiPolygon

from estimation.errors import InputError
from planning.fill.bead import Bead
from planning.fill.coverage import Coverage, coverage
from planning.fill.fill import fill, turned
from planning.fill.pace import Pace
from planning.fill.pattern import Pattern
from planning.layers.bumps import Passing
from planning.layers.chart import Chart, flat, unrolled
from planning.layers.checkpoints import Ground, Laid, Way, ceiling, curvature, laid, path_of
from planning.layers.contour import as_multi
from planning.layers.slicing import Layer, Mode, Stack, stack_in
from planning.layers.tissue import Tissue
from planning.layers.tool import tilts
from planning.layers.wound import Wound, nodes_within
from planning.path import Path

Report = Callable[[int, int], None]  # (layers done, layers)
TURN = 0.05  # s for each sharp turn, as other planners' times are counted
GOLDEN = 0.6180339887498949  # of a closed line's length: by so much the seam moves on from layer to layer,
# which puts no two of them near one another for as long as can be (the three-distance theorem)


@dataclass(frozen=True, slots=True)
class Order:
    """What is asked for. mode: how layers lie. crossed: every second layer's lines across the others'. passing: how
    bumps of the bed are passed."""

    tissues: tuple[Tissue, ...]
    pattern: Pattern = field(default_factory=Pattern)
    mode: Mode = "skin"
    way: Way = field(default_factory=Way)
    crossed: bool = True
    passing: Passing = field(default_factory=Passing)


@dataclass(frozen=True, slots=True, eq=False)
class PlannedLayer:
    """One layer as it is printed. region: in the chart, mm. beads: in the chart, mm, in order.

    over, around: bumps in the chart, mm, that it goes over, and that it goes round.
    """

    layer: Layer
    region: MultiPolygon
    beads: tuple[Bead, ...]
    over: MultiPolygon
    around: MultiPolygon

    @property
    def coverage(self) -> Coverage:
        """How much of the region the beads cover."""
        return coverage(self.beads, self.region)


@dataclass(frozen=True, slots=True, eq=False)
class Plan:
    """A path, and what it was made of. points: its checkpoints in the plane's frame."""

    path: Path
    points: Laid
    wound: Wound
    stack: Stack
    chart: Chart
    ground: Ground
    layers: tuple[PlannedLayer, ...]
    order: Order


def make_plan(wound: Wound, order: Order, where: object = "plan", report: Report = lambda done, total: None) -> Plan:
    """The plan of a wound; InputError where no bead finds room in it."""
    stack = stack_in(wound, order.tissues, order.mode, order.pattern.width, order.passing)
    chart = flat(wound.grid) if order.mode == "horizontal" else unrolled(wound.grid, wound.skin)
    order = replace(order, pattern=_turned(stack, chart, order))
    planned = []
    for i, layer in enumerate(stack.layers):
        planned.append(_filled(layer, chart, order))
        report(i + 1, len(stack.layers))
    beads = [bead for layer in planned for bead in layer.beads]
    if not beads:
        raise InputError(
            where, "beads", "none has room", f"a wound wider than {order.pattern.width:g} mm, or finer beads"
        )
    layer_of = np.repeat([p.layer.number for p in planned], [len(p.beads) for p in planned])
    ground = _ground(wound, stack, chart, order.way)
    points = laid(ground, beads, layer_of, order.way)
    path = path_of(points, ground, order.way.tool.spin)
    return Plan(path, points, wound, stack, chart, ground, tuple(planned), order)


def _turned(stack: Stack, chart: Chart, order: Order) -> Pattern:
    """The pattern with the angle of its lines settled: for all layers by the largest."""
    if not isinstance(order.pattern.angle, str):
        return order.pattern
    layer = max(stack.layers, key=lambda layer: layer.region.area)
    return turned(_charted(layer.region, chart), order.pattern, _pace(layer, order))


def _charted(shape: MultiPolygon, chart: Chart) -> MultiPolygon:
    return shape if shape.is_empty else as_multi(shapely.make_valid(shapely.transform(shape, chart.from_plane)))


def _pace(layer: Layer, order: Order) -> Pace:
    return Pace(layer.slab.tissue.speed, order.way.travel, TURN)


def _filled(layer: Layer, chart: Chart, order: Order) -> PlannedLayer:
    region = _charted(layer.region, chart)
    pattern = replace(order.pattern, seam=(order.pattern.seam + GOLDEN * layer.number) % 1.0)
    if order.crossed and layer.number % 2 and not isinstance(pattern.angle, str):
        pattern = replace(pattern, angle=pattern.angle + np.pi / 2)
    beads = () if region.is_empty else tuple(fill(region, pattern, _pace(layer, order)))
    return PlannedLayer(layer, region, beads, _charted(layer.bumps.over, chart), _charted(layer.bumps.around, chart))


def _ground(wound: Wound, stack: Stack, chart: Chart, way: Way) -> Ground:
    inside = nodes_within(wound.grid, wound.outline)
    ends = [stack.lowest, stack.highest]
    low, high = (tilts(wound.grid, end, inside, way.tool) for end in ends)
    bent = np.stack([curvature(wound.grid, end, way.spacing / 2) for end in ends], axis=-1)
    return Ground(stack, chart, wound.surface_from_plane, low, high, bent, ceiling(wound.grid, wound.bed))
