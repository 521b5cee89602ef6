"""What a plan comes to, layer by layer: coverage, lengths, time, volume."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
import shapely

from estimation.se3 import Array
from planning.fill.coverage import Coverage
from planning.fill.pace import SHARP
from planning.layers.checkpoints import Laid
from planning.layers.plan import TURN, Plan, PlannedLayer

DISC = 0.75  # widths squared: a part of less area holds no disc of that width, which has pi / 4 of them


@dataclass(frozen=True, slots=True, eq=False)
class LayerFigures:
    """One layer. area, half_gap, bead_gap, gap: mm^2, of the layer, of gaps that are wider than half a bead and than a
    bead, and of all gaps. printed, travelled: mm. seconds: of printing, travels, turns and waits. volume: mm^3."""

    number: int
    tissue: str
    material: str
    area: float
    beads: int
    checkpoints: int
    printed: float
    travelled: float
    seconds: float
    volume: float
    coverage: Coverage
    gap: float
    half_gap: float
    bead_gap: float


@dataclass(frozen=True, slots=True)
class Total:
    """All layers together. covered, over, double: shares of the area of all layers. volume: mm^3 by material."""

    area: float
    covered: float
    over: float
    double: float
    gap: float
    bead_gap: float
    printed: float
    travelled: float
    seconds: float
    volume: tuple[tuple[str, float], ...]


def seconds_to(points: Laid) -> Array:
    """When each checkpoint is reached (N,), s from the first: ways at their speeds, sharp turns and waits.

    A turn of more than SHARP costs TURN s, as in other planners' figures; what an arm needs is for its planner to say.
    """
    step = np.diff(points.tip, axis=0)
    length = np.linalg.norm(step, axis=1)
    cosine = np.einsum("ni,ni->n", step[:-1], step[1:]) / np.maximum(length[:-1] * length[1:], 1e-12)
    sharp = (cosine < np.cos(SHARP)) & points.extrude[1:-1] & points.extrude[2:]
    taken = np.r_[0.0, length / points.speed[1:]] + points.wait
    taken[1:-1] += TURN * sharp
    return np.asarray(np.cumsum(taken))


def figures_of(plan: Plan, report: Callable[[int, int], None] = lambda done, total: None) -> list[LayerFigures]:
    """The figures of each layer that has beads, of as many at once as there are cores: joining beads is GEOS's work,
    which needs no lock of Python's."""
    moments = seconds_to(plan.points)
    laid = [layer for layer in plan.layers if layer.beads]
    found = []
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        try:
            for figures in pool.map(lambda layer: _figures(plan, layer, moments), laid):
                found.append(figures)
                report(len(found), len(laid))
        finally:
            pool.shutdown(cancel_futures=True)  # Ctrl-C waits for no layer that is not begun
    return found


def _figures(plan: Plan, layer: PlannedLayer, moments: Array) -> LayerFigures:
    points, number = plan.points, layer.layer.number
    own = points.layer == number
    step = np.r_[0.0, np.linalg.norm(np.diff(points.tip, axis=0), axis=1)]
    taken = np.diff(moments, prepend=0.0)
    result, tissue = layer.coverage, layer.layer.slab.tissue
    half, whole = (_wider(result.gaps, part * plan.order.pattern.width) for part in (0.5, 1.0))
    return LayerFigures(
        number, tissue.name, tissue.material, float(layer.region.area), len(layer.beads), int(own.sum()),
        float(step[own & points.extrude].sum()), float(step[own & ~points.extrude].sum()), float(taken[own].sum()),
        float(points.volume[own].sum()), result, float(result.gaps.area), half, whole,
    )  # fmt: skip


def _wider(gaps: shapely.MultiPolygon, width: float) -> float:
    """Area, mm^2, of the parts of gaps into which a disc `width` mm wide fits."""
    parts = shapely.get_parts(gaps)
    large = shapely.multipolygons(parts[shapely.area(parts) > DISC * width**2])
    core = shapely.buffer(large, -width / 2)
    return float(shapely.intersection(shapely.buffer(core, width / 2), large).area) if not core.is_empty else 0.0


def total_of(layers: Iterable[LayerFigures]) -> Total:
    """All layers together."""
    layers = list(layers)
    area = np.array([layer.area for layer in layers])
    volumes: dict[str, float] = {}
    for layer in layers:
        volumes[layer.material] = volumes.get(layer.material, 0.0) + layer.volume

    def mean(values: list[float]) -> float:
        return float(area @ values / area.sum())

    return Total(
        float(area.sum()), mean([f.coverage.covered for f in layers]), mean([f.coverage.over for f in layers]),
        mean([f.coverage.double for f in layers]), sum(f.gap for f in layers), sum(f.bead_gap for f in layers),
        sum(f.printed for f in layers), sum(f.travelled for f in layers), sum(f.seconds for f in layers),
        tuple(volumes.items()),
    )  # fmt: skip
