"""The report of a plan: one page that needs no network, with a 3D view, the figures, and an SVG of each layer."""

from __future__ import annotations

import base64
import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from html import escape
from importlib.resources import files
from itertools import pairwise
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from estimation.se3 import Array
from hardware.process.progress import count_text, duration_text
from hardware.report.evaluation import percent
from hardware.report.page import document, figures_table, round_step, row_of_tiles, section, tile
from planning.fill.bead import Bead
from planning.layers.checkpoints import tool_rotations
from planning.layers.grid import interpolate
from planning.layers.plan import LayerFigures, Plan, PlannedLayer, PlanTotal, Unscanned
from planning.layers.wound import WoundFindings

PICTURE_WIDTH, PICTURE_MARGIN, HEAD_HEIGHT, FOOT_HEIGHT = 940.0, 24.0, 34.0, 34.0  # px
MAX_DRAWING_HEIGHT = 900.0  # px of the drawing
WIDTH_STEP = 0.02  # mm: widths nearer than this are drawn alike
PICTURE_STYLE = """
text { font: 13px "Inter", "Segoe UI", "DejaVu Sans", system-ui, sans-serif; fill: #1c2430; }
.soft { fill: #5d6875; } .page { fill: #fbfaf7; }
.region { fill: #f1e4dc; stroke: #b98d78; stroke-width: 1; vector-effect: non-scaling-stroke; }
.bead { fill: none; stroke: #2a6f97; opacity: .55; stroke-linecap: round; stroke-linejoin: round; }
.core { fill: none; stroke: #174a68; stroke-width: .7; vector-effect: non-scaling-stroke; stroke-linejoin: round; }
.travel { fill: none; stroke: #e06c00; stroke-width: 1.8; vector-effect: non-scaling-stroke; stroke-dasharray: 4 3; }
.around { fill: #8a5a3c; stroke: #5b3822; stroke-width: 1; vector-effect: non-scaling-stroke; }
.over { fill: none; stroke: #5b3822; stroke-width: 1.8; vector-effect: non-scaling-stroke; stroke-dasharray: 2 2; }
.left { fill: none; stroke: #fff; stroke-width: 3; vector-effect: non-scaling-stroke; stroke-dasharray: 0 5; }
.gap { fill: #d3232f; } .start { fill: #2f9e5b; stroke: #fff; stroke-width: 1.5; }
.end { fill: #1c2430; stroke: #fff; stroke-width: 1.5; } .bar { stroke: #1c2430; stroke-width: 2; fill: none; }
"""
TISSUE_COLOURS = ((0.16, 0.52, 0.72), (0.87, 0.56, 0.2), (0.33, 0.66, 0.45), (0.55, 0.42, 0.75), (0.8, 0.36, 0.26))
SIGMA_95 = 1.96  # deviations on either side of the mean, in a 95 % interval
SURFACE_NODES = 120  # nodes along the longer side of the surfaces in the view
PAGE_STYLE = """
#plan-canvas { width: 100%; height: 560px; display: block; touch-action: pan-y; cursor: grab; border-radius: 8px;
  background: linear-gradient(#eef2f5, #d9e0e6); }
@media (prefers-color-scheme: dark) { #plan-canvas { background: linear-gradient(#2a323b, #171c22); } }
.plan-bar { display: flex; flex-wrap: wrap; gap: 6px 16px; align-items: center; font-size: 13.5px; margin-top: 10px; }
.plan-bar input[type=range] { flex: 1 1 320px; } .plan-bar label { color: var(--soft); white-space: nowrap; }
#plan-words { font-size: 13.5px; color: var(--soft); margin-top: 6px; font-variant-numeric: tabular-nums; }
#plan-legend span { display: inline-flex; align-items: center; gap: 6px; }
#plan-legend i { width: 18px; height: 8px; border-radius: 4px; }
#plan-legend i.travel { height: 0; border-radius: 0; border-top: 2px dashed #d6006c; }
.plan-bar button { font: inherit; padding: 3px 12px; border-radius: 8px; border: 1px solid var(--grey);
  background: var(--card); color: var(--ink); cursor: pointer; }
.layer-picture svg { width: 100%; min-width: 720px; height: auto; border-radius: 8px; }
.layer-picture { margin-top: 12px; }
.plan-note { border-left: 3px solid var(--amber); padding-left: 12px; margin: 6px 0; }
.sideways { overflow-x: auto; }
.sideways td { white-space: nowrap; padding: 5px 7px; } .sideways th { padding: 4px 7px; }
"""
VIEW_CONTROLS = """<canvas id="plan-canvas" role="img" aria-label="the beads in three dimensions"></canvas>
<div class="plan-bar" id="plan-legend"></div>
<div class="plan-bar"><input id="plan-at" type="range" min="0" value="0" aria-label="printed up to">
<button id="plan-step" type="button">next layer</button><button id="plan-top" type="button">from above</button></div>
<div class="plan-bar"><label><input id="plan-alone" type="checkbox"> this layer alone</label>
<label><input id="plan-travels" type="checkbox" checked> travels</label>
<label><input id="plan-bed" type="checkbox" checked> wound bed</label>
<label><input id="plan-skin" type="checkbox"> restored skin</label>
<label><input id="plan-tool" type="checkbox" checked> tool</label></div><div id="plan-words"></div>"""
LAYER_CHOOSER = """<div class="plan-bar"><input id="layer-at" type="range" min="1" max="{count}" value="{count}"
 aria-label="layer"><span id="layer-words"></span></div>{pictures}
<script>(function () {{
  const pictures = document.querySelectorAll(".layer-picture"), at = document.getElementById("layer-at");
  const words = document.getElementById("layer-words");
  function show() {{
    pictures.forEach((p, k) => {{ p.hidden = k !== at.value - 1; }});
    words.textContent = at.value + " of " + pictures.length;
  }}
  at.addEventListener("input", show); show();
}})();</script>"""
LAYER_TEXT = (
    "Covered, twice: shares of the layer's area, with the planned bead width. Beside: area outside the layer. Open: "
    "area without a bead. Over half a bead, over a bead: the part of the open area where a disc of this width fits."
)


def layer_svg(layer: PlannedLayer, figures: LayerFigures, bounds: tuple[float, float, float, float]) -> str:
    """The picture of a layer. bounds: common to all pictures of a plan, mm in the chart: low x, y, high x, y."""
    low_x, low_y, high_x, high_y = bounds
    width, depth = high_x - low_x, high_y - low_y
    scale = min((PICTURE_WIDTH - 2 * PICTURE_MARGIN) / max(width, 1e-3), MAX_DRAWING_HEIGHT / max(depth, 1e-3))
    height = HEAD_HEIGHT + depth * scale + FOOT_HEIGHT + PICTURE_MARGIN
    offset = (PICTURE_WIDTH - width * scale) / 2
    transform = f"matrix({scale:.5f} 0 0 {-scale:.5f} {offset - low_x * scale:.3f} {HEAD_HEIGHT + high_y * scale:.3f})"
    travels = "".join(_line(np.stack([a.points[-1], b.points[0]])) for a, b in pairwise(layer.beads))
    shapes = [
        f'<path class="region" fill-rule="evenodd" d="{_areas(layer.region)}"/>',
        *_beads(layer.beads),
        f'<path class="gap" fill-rule="evenodd" d="{_areas(figures.coverage.gaps)}"/>',
        *_bumps(layer),
        *(f'<path class="left" stroke-linecap="round" d="{_line(points)}"/>' for points in layer.left_out),
        f'<path class="travel" d="{travels}"/>',
    ]
    ends = np.array([layer.beads[0].points[0], layer.beads[-1].points[-1]])
    ends = ends * [scale, -scale] + [offset - low_x * scale, HEAD_HEIGHT + high_y * scale]
    title = f"Layer {figures.number + 1}: {figures.tissue}, material {figures.material}"
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {PICTURE_WIDTH:g} {height:.0f}" role="img" '
        f'aria-label="{escape(title)}"><style>{PICTURE_STYLE}</style><rect class="page" width="100%" height="100%"/>'
        f'<g transform="{transform}">{"".join(shapes)}</g>'
        f'<rect class="end" x="{ends[1, 0] - 5:.1f}" y="{ends[1, 1] - 5:.1f}" width="10" height="10"/>'
        f'<circle class="start" cx="{ends[0, 0]:.1f}" cy="{ends[0, 1]:.1f}" r="6.5"/>'
        f"{_captions(title, layer, figures, scale, height)}</svg>"
    )


def layer_bounds(layers: Iterable[PlannedLayer]) -> tuple[float, float, float, float]:
    """Low and high corner, mm, of all layers' regions."""
    low_x, low_y, high_x, high_y = shapely.total_bounds([layer.region for layer in layers]).tolist()
    return low_x, low_y, high_x, high_y


def _captions(title: str, layer: PlannedLayer, figures: LayerFigures, scale: float, height: float) -> str:
    facts = (
        f"{percent(figures.coverage.covered, 2)} covered, {percent(figures.coverage.double, 2)} twice, "
        f"{figures.gap:.2f} mm² open · "
        f"{len_text(figures.printed)} of bead in {figures.beads} runs, {len_text(figures.travelled)} of travel"
    )
    bar = round_step(60 / scale)
    baseline = height - 16
    keys = f"{bar:g} mm · beads at their true width · red: open · dashed: travel · green: start · black: end"
    keys += "" if layer.around.is_empty else " · brown: avoided bump"
    keys += " · white: no space for the tool" if layer.left_out else ""
    keys += "" if layer.over.is_empty else " · dotted: bump printed over"
    return (
        f'<text x="{PICTURE_MARGIN}" y="21" font-weight="600">{escape(title)}</text>'
        f'<text class="soft" x="{PICTURE_WIDTH - PICTURE_MARGIN}" y="21" text-anchor="end">{escape(facts)}</text>'
        f'<path class="bar" d="M{PICTURE_MARGIN} {baseline - 4:.1f}v4h{bar * scale:.1f}v-4"/>'
        f'<text class="soft" x="{PICTURE_MARGIN + bar * scale + 10:.1f}" y="{baseline:.1f}">{escape(keys)}</text>'
    )


def len_text(millimetres: float) -> str:
    """A length as a text: 31.4 mm, 2.71 m."""
    return f"{millimetres:.1f} mm" if millimetres < 1000 else f"{millimetres / 1000:.2f} m"


def _areas(shape: shapely.Geometry) -> str:
    rings = shapely.get_rings(shapely.get_parts(shape))
    return "".join(_line(shapely.get_coordinates(ring)) + "Z" for ring in rings)


def _line(points: Array) -> str:
    return "M" + "L".join(f"{x:.3f} {y:.3f}" for x, y in points.tolist())


def _bumps(layer: PlannedLayer) -> list[str]:
    """Avoided bumps as areas, and bumps printed over as outlines on the beads."""
    shapes = {name: shape for name, shape in (("around", layer.around), ("over", layer.over)) if not shape.is_empty}
    return [f'<path class="{name}" fill-rule="evenodd" d="{_areas(shape)}"/>' for name, shape in shapes.items()]


def _beads(beads: tuple[Bead, ...]) -> list[str]:
    """Each bead as strokes of nearly even width, and its middle line."""
    runs, middles = [], []
    for bead in beads:
        middles.append(_line(bead.points))
        wide = np.rint((bead.width[:-1] + bead.width[1:]) / 2 / WIDTH_STEP).astype(int)
        cuts = np.r_[0, np.flatnonzero(np.diff(wide)) + 1, len(wide)]
        strokes = [
            f'<path stroke-width="{bead.width[a : b + 1].mean():.3f}" d="{_line(bead.points[a : b + 1])}"/>'
            for a, b in pairwise(cuts.tolist())
        ]
        runs.append(f'<g class="bead">{"".join(strokes)}</g>')  # as one, so that only other beads show through it
    return [*runs, f'<path class="core" d="{"".join(middles)}"/>']


@dataclass(frozen=True, slots=True, eq=False)
class ReportText:
    """Texts of the report."""

    title: str  # of the plan
    findings: Sequence[tuple[str, str]]  # of the wound: (name, value)
    repairs: Sequence[tuple[str, int]]  # of the scan: (name, count)
    settings: Sequence[tuple[str, str]]  # (name, value)
    notes: Sequence[str]  # to check before printing


def page_text(
    plan: Plan,
    layers: Sequence[LayerFigures],
    total: PlanTotal,
    text: ReportText,
    pictures: Sequence[str],
    moments: Array,
) -> str:
    """The whole page. moments: times (N,), s, at which a run over a surface at rest is at the checkpoints."""
    body = [f"<style>{PAGE_STYLE}</style>", row_of_tiles(_tiles(layers, total))]
    if text.notes:
        notes = "".join(f'<div class="plan-note">{escape(note)}</div>' for note in text.notes)
        body.append(f"<section><h2>Check before printing</h2>{notes}</section>")
    script = (files("hardware.plan") / "view.js").read_text(encoding="utf-8")
    view = f'<script type="application/json" id="plan-data">{_data(plan, moments)}</script><script>{script}</script>'
    help_text = (
        "Drag to rotate, Shift and drag to move, wheel to zoom. Touch: one finger rotates or scrolls the page, "
        "two fingers zoom and tilt. The slider shows the print up to a time, for a surface at rest."
    )
    body.append(section("The beads", help_text, VIEW_CONTROLS + view))
    body.append(section("Layers", LAYER_TEXT, f'<div class="sideways">{_layer_table(layers, total)}</div>'))
    if pictures:
        cards = "".join(f'<div class="layer-picture">{picture}</div>' for picture in pictures)
        unrolled = "" if plan.order.mode == "horizontal" else " Layers are unwrapped: lengths are those on the skin."
        words = f"View from outside, the scan's x to the right.{unrolled}"
        body.append(section("Each layer", words, LAYER_CHOOSER.format(count=len(pictures), pictures=cards)))
    body.append(section("The wound", "Measured in the scan.", figures_table(("", "value"), text.findings)))
    if text.repairs:
        rows = [(what, str(count)) for what, count in text.repairs]
        body.append(section("The scan", "Repaired defects.", figures_table(("", ""), rows)))
    body.append(section("Settings", "All settings, with defaults.", figures_table(("", ""), text.settings)))
    inks = ", ".join(f"{volume / 1000:.2f} ml of {material_text(name)}" for name, volume in total.volume)
    lead = (
        f"{count_text(len(layers), 'layer')}, {len_text(total.printed)} of bead, "
        f"printing time {duration_text(total.seconds)}: {inks}. "
        f"{percent(total.covered, 2)} of the layers' area is covered, {percent(total.double, 2)} twice."
    )
    return document("plan", text.title, lead, body, "mm, s, degrees; 1 mm³ is 1 µl")


def _tiles(layers: Sequence[LayerFigures], total: PlanTotal) -> list[str]:
    return [
        tile(f"{100 * total.covered:.2f}", "%", "covered"),
        tile(f"{100 * total.double:.2f}", "%", "covered twice"),
        tile(*_clock(total.seconds), "printing time"),
        tile(str(len(layers)), "", "layers"),
        tile(f"{sum(v for _, v in total.volume) / 1000:.2f}", "ml", "bio-ink"),
        tile(f"{sum(f.checkpoints for f in layers)}", "", "checkpoints"),
    ]


def _clock(seconds: float) -> tuple[str, str]:
    """A time as figure and unit."""
    whole = round(seconds)
    if whole < 60:
        return str(whole), "s"
    if whole < 3600:
        return f"{whole // 60}:{whole % 60:02d}", "min"
    return f"{whole // 3600}:{whole // 60 % 60:02d}", "h"


def material_text(name: str) -> str:
    """A material in a sentence: collagen, material 2."""
    return f"material {name}" if name.isdecimal() else name


def _layer_table(layers: Sequence[LayerFigures], total: PlanTotal) -> str:
    head = (
        "layer", "tissue", "material", "area mm²", "covered", "twice", "beside", "open mm²", "over half a bead",
        "over a bead", "runs", "bead", "travel", "time", "ink µl",
    )  # fmt: skip
    rows = [
        (
            str(f.number + 1), f.tissue, f.material, f"{f.area:.0f}", percent(f.coverage.covered, 2),
            percent(f.coverage.double, 2), percent(f.coverage.over, 2), f"{f.gap:.2f}", f"{f.half_gap:.2f}",
            f"{f.bead_gap:.2f}", str(f.beads), len_text(f.printed), len_text(f.travelled), " ".join(_clock(f.seconds)),
            f"{f.volume:.1f}",
        )
        for f in reversed(layers)
    ]  # fmt: skip
    rows.append((
        "all", "", "", f"{total.area:.0f}", percent(total.covered, 2), percent(total.double, 2), percent(total.over, 2),
        f"{total.gap:.2f}", f"{sum(f.half_gap for f in layers):.2f}", f"{total.bead_gap:.2f}",
        str(sum(f.beads for f in layers)), len_text(total.printed), len_text(total.travelled),
        " ".join(_clock(total.seconds)),
        f"{sum(v for _, v in total.volume):.1f}",
    ))  # fmt: skip
    return figures_table(head, rows, last_total=True)


def _data(plan: Plan, moments: Array) -> str:
    """The checkpoints, their times (N,), s, and surfaces for the view, as JSON."""
    points = plan.points
    names = list(dict.fromkeys(layer.slab.tissue.name for layer in plan.stack.layers))
    inks = dict((layer.slab.tissue.name, layer.slab.tissue.material) for layer in plan.stack.layers).items()
    up = tool_rotations(points.tilt, 0.0)[:, :, 2]
    data: dict[str, Any] = {
        "tip": _base64(points.tip, "<f4"),
        "normal": _base64(np.rint(127 * up), "i1"),
        "width_um": _base64(np.rint(1000 * points.width), "<u2"),
        "layer": _base64(points.layer, "<u2"),
        "extrude": _base64(points.extrude, "u1"),
        "seconds": _base64(moments, "<f4"),
        "layers": len(plan.stack.layers),
        "names": [layer.slab.tissue.name for layer in plan.stack.layers],
        "paints": TISSUE_COLOURS,
        "legend": [
            [f"{name}: {material_text(material)}", names.index(name) % len(TISSUE_COLOURS)] for name, material in inks
        ],
        "paint_of": [names.index(layer.slab.tissue.name) % len(TISSUE_COLOURS) for layer in plan.stack.layers],
        "low": points.tip.min(axis=0).tolist(),
        "high": points.tip.max(axis=0).tolist(),
        "bed": _sheet(plan, plan.wound.bed),
        "skin": _sheet(plan, plan.wound.skin),
    }
    return json.dumps(data)


def _base64(values: Array | NDArray[Any], kind: str) -> str:
    return base64.b64encode(np.ascontiguousarray(values, dtype=kind).tobytes()).decode("ascii")


def _sheet(plan: Plan, heights: Array) -> dict[str, Any]:
    """Heights (H, W) around the wound, thinned for the view."""
    grid = plan.wound.grid
    low, high = np.array(plan.wound.outline.bounds).reshape(2, 2) + [[-12.0], [12.0]]
    low, high = np.maximum(low, grid.origin), np.minimum(high, [grid.x[-1], grid.y[-1]])
    step = float((high - low).max()) / SURFACE_NODES
    columns, rows = (int(n) for n in (high - low) / step + 1)
    x, y = np.meshgrid(low[0] + step * np.arange(columns), low[1] + step * np.arange(rows))
    values = interpolate(grid, heights, np.column_stack([x.ravel(), y.ravel()]))
    return {
        "x": float(low[0]), "y": float(low[1]), "step": step, "columns": columns, "rows": rows,
        "heights": _base64(values, "<f4"),
    }  # fmt: skip


def layers_text(numbers: list[int]) -> str:
    """Layer numbers as a text: layer 3, layers 2 to 5, layers 1, 4, 6."""
    if len(numbers) == 1:
        return f"layer {numbers[0]}"
    if len(numbers) > 2 and numbers[-1] - numbers[0] + 1 == len(numbers):
        return f"layers {numbers[0]} to {numbers[-1]}"
    return "layers " + ", ".join(str(n) for n in numbers)


def tool_text(plan: Plan) -> str:
    """The clearance between tool and tissue as a text, with tilts and omitted beads."""
    clearance = plan.clearance
    if clearance is None:
        return "clearance not checked without --arm ARM.toml"
    tilts = (
        f", tilted by up to {np.rad2deg(clearance.most):.1f} degrees at {clearance.turned} checkpoints"
        if clearance.turned
        else ""
    )
    text = f"{clearance.margin:.1f} mm or more from the tissue{tilts}"
    if not clearance.left_out:
        return text
    layers = layers_text(sorted({each.layer + 1 for each in clearance.left_out}))
    length, worst = (
        sum(each.length for each in clearance.left_out),
        max(clearance.left_out, key=lambda each: each.short),
    )
    return (
        f"{text}; {len_text(length)} of bead in {layers} omitted, {count_text(len(clearance.left_out), 'piece')}: "
        f"at any allowed tilt the {worst.part} is too near, upright by up to {worst.short:.1f} mm, such as at "
        f"{_place_text(worst.place)}"
    )


def tool_facts(plan: Plan) -> dict[str, Any] | None:
    """The same as numbers; layers counted from 1, mm, degrees, scan frame."""
    if (clearance := plan.clearance) is None:
        return None
    omitted = [
        {
            "layer": each.layer + 1, "length_mm": each.length, "place_mm": each.place.tolist(), "part": each.part,
            "short_mm": each.short,
        }
        for each in clearance.left_out
    ]  # fmt: skip
    max_tilt = float(np.rad2deg(clearance.most))
    return {
        "margin_mm": clearance.margin,
        "turned_checkpoints": clearance.turned,
        "most_deg": max_tilt,
        "left_out": omitted,
    }


def unscanned_text(beads: Unscanned) -> str:
    """A text about beads over places without scan data."""
    where = "over a hole of the scan" if beads.hole else "outside the scan"
    layers = layers_text([number + 1 for number in beads.layers])
    place = _place_text(beads.place)
    return f"{len_text(beads.length)} of bead in {layers} lie {where}, such as at {place}, over an interpolated bed"


def _place_text(place: Array) -> str:
    return "x {:.1f}, y {:.1f}, z {:.1f} mm".format(*place)


def volume_text(findings: WoundFindings) -> str:
    """The volume, with its 95 % interval if the restored skin is uncertain."""
    spread = SIGMA_95 * findings.volume_sigma
    interval = f" (95 %: {max(findings.volume - spread, 0):.0f} to {findings.volume + spread:.0f})" if spread else ""
    return f"{findings.volume:.0f} mm^3{interval}"
