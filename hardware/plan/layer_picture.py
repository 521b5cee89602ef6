"""One layer of a plan as an SVG picture: beads at their true width, what stays open red, travels thin, start marked."""

from __future__ import annotations

from collections.abc import Iterable
from html import escape
from itertools import pairwise

import numpy as np
import shapely

from estimation.se3 import Array
from hardware.report.page import round_step
from planning.fill.bead import Bead
from planning.layers.figures import LayerFigures
from planning.layers.plan import PlannedLayer

WIDTH, MARGIN, HEAD, FOOT = 940.0, 24.0, 34.0, 34.0  # px
TALLEST = 900.0  # px of the drawing
STEP = 0.02  # mm: widths nearer than this are drawn alike
STYLE = """
text { font: 13px "Inter", "Segoe UI", "DejaVu Sans", system-ui, sans-serif; fill: #1c2430; }
.soft { fill: #5d6875; } .page { fill: #fbfaf7; }
.region { fill: #f1e4dc; stroke: #b98d78; stroke-width: 1; vector-effect: non-scaling-stroke; }
.bead { fill: none; stroke: #2a6f97; opacity: .55; stroke-linecap: round; stroke-linejoin: round; }
.core { fill: none; stroke: #174a68; stroke-width: .7; vector-effect: non-scaling-stroke; stroke-linejoin: round; }
.travel { fill: none; stroke: #e06c00; stroke-width: 1.8; vector-effect: non-scaling-stroke; stroke-dasharray: 4 3; }
.around { fill: #8a5a3c; stroke: #5b3822; stroke-width: 1; vector-effect: non-scaling-stroke; }
.over { fill: none; stroke: #5b3822; stroke-width: 1.8; vector-effect: non-scaling-stroke; stroke-dasharray: 2 2; }
.gap { fill: #d3232f; } .start { fill: #2f9e5b; stroke: #fff; stroke-width: 1.5; }
.end { fill: #1c2430; stroke: #fff; stroke-width: 1.5; } .bar { stroke: #1c2430; stroke-width: 2; fill: none; }
"""


def layer_svg(layer: PlannedLayer, figures: LayerFigures, bounds: tuple[float, float, float, float]) -> str:
    """The picture of a layer. bounds: of what all pictures of a plan show, mm in the chart, low x, low y, high x, y."""
    low_x, low_y, high_x, high_y = bounds
    scale = min((WIDTH - 2 * MARGIN) / max(high_x - low_x, 1e-3), TALLEST / max(high_y - low_y, 1e-3))
    height = HEAD + (high_y - low_y) * scale + FOOT + MARGIN
    left = (WIDTH - (high_x - low_x) * scale) / 2
    turn = f"matrix({scale:.5f} 0 0 {-scale:.5f} {left - low_x * scale:.3f} {HEAD + high_y * scale:.3f})"
    drawn = [
        f'<path class="region" fill-rule="evenodd" d="{_areas(layer.region)}"/>',
        *_beads(layer.beads),
        f'<path class="gap" fill-rule="evenodd" d="{_areas(figures.coverage.gaps)}"/>',
        *_bumps(layer),
        f'<path class="travel" d="{_travels(layer.beads)}"/>',
    ]
    ends = np.array([layer.beads[0].points[0], layer.beads[-1].points[-1]])
    ends = ends * [scale, -scale] + [left - low_x * scale, HEAD + high_y * scale]
    title = f"Layer {figures.number + 1}: {figures.tissue}, material {figures.material}"
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH:g} {height:.0f}" role="img" '
        f'aria-label="{escape(title)}"><style>{STYLE}</style><rect class="page" width="100%" height="100%"/>'
        f'<g transform="{turn}">{"".join(drawn)}</g>'
        f'<rect class="end" x="{ends[1, 0] - 5:.1f}" y="{ends[1, 1] - 5:.1f}" width="10" height="10"/>'
        f'<circle class="start" cx="{ends[0, 0]:.1f}" cy="{ends[0, 1]:.1f}" r="6.5"/>'
        f"{_captions(title, layer, figures, scale, height)}</svg>"
    )


def bounds_of(layers: Iterable[PlannedLayer]) -> tuple[float, float, float, float]:
    """Low and high corner, mm, of all layers' regions."""
    boxes = np.array([layer.region.bounds for layer in layers if not layer.region.is_empty])
    low_x, low_y = boxes[:, :2].min(axis=0)
    high_x, high_y = boxes[:, 2:].max(axis=0)
    return float(low_x), float(low_y), float(high_x), float(high_y)


def _captions(title: str, layer: PlannedLayer, figures: LayerFigures, scale: float, height: float) -> str:
    facts = (
        f"{figures.coverage.covered:.2%} covered, {figures.coverage.double:.2%} twice, {figures.gap:.2f} mm² open · "
        f"{len_text(figures.printed)} of bead in {figures.beads} runs, {len_text(figures.travelled)} of travel"
    )
    bar = round_step(60 / scale)
    at = height - 16
    keys = f"{bar:g} mm · beads at their true width · red: open · dashed: travel · green: start · black: end"
    keys += "" if layer.around.is_empty else " · brown: bump, gone round"
    keys += "" if layer.over.is_empty else " · dotted: bump, gone over"
    return (
        f'<text x="{MARGIN}" y="21" font-weight="600">{escape(title)}</text>'
        f'<text class="soft" x="{WIDTH - MARGIN}" y="21" text-anchor="end">{escape(facts)}</text>'
        f'<path class="bar" d="M{MARGIN} {at - 4:.1f}v4h{bar * scale:.1f}v-4"/>'
        f'<text class="soft" x="{MARGIN + bar * scale + 10:.1f}" y="{at:.1f}">{escape(keys)}</text>'
    )


def len_text(millimetres: float) -> str:
    """A length as people say it: 31.4 mm, 2.71 m."""
    return f"{millimetres:.1f} mm" if millimetres < 1000 else f"{millimetres / 1000:.2f} m"


def _areas(shape: shapely.Geometry) -> str:
    rings = shapely.get_rings(shapely.get_parts(shape))
    return "".join(_line(shapely.get_coordinates(ring)) + "Z" for ring in rings)


def _line(points: Array) -> str:
    return "M" + "L".join(f"{x:.3f} {y:.3f}" for x, y in points.tolist())


def _bumps(layer: PlannedLayer) -> list[str]:
    """Bumps that are gone round, as areas, and those that are gone over, as outlines on the beads."""
    shapes = {"around": layer.around, "over": layer.over}
    return [
        f'<path class="{name}" fill-rule="evenodd" d="{_areas(shape)}"/>'
        for name, shape in shapes.items()
        if not shape.is_empty
    ]


def _travels(beads: tuple[Bead, ...]) -> str:
    return "".join(_line(np.stack([a.points[-1], b.points[0]])) for a, b in pairwise(beads))


def _beads(beads: tuple[Bead, ...]) -> list[str]:
    """Each bead as strokes of nearly even width, and its middle line."""
    runs, middles = [], []
    for bead in beads:
        middles.append(_line(bead.points))
        wide = np.rint((bead.width[:-1] + bead.width[1:]) / 2 / STEP).astype(int)
        cuts = np.r_[0, np.flatnonzero(np.diff(wide)) + 1, len(wide)]
        strokes = [
            f'<path stroke-width="{bead.width[a : b + 1].mean():.3f}" d="{_line(bead.points[a : b + 1])}"/>'
            for a, b in pairwise(cuts.tolist())
        ]
        runs.append(f'<g class="bead">{"".join(strokes)}</g>')  # as one, so that only other beads show through it
    return [*runs, f'<path class="core" d="{"".join(middles)}"/>']
