"""The report of a plan: one page without a network, with a view to turn, the figures, and each layer's picture."""

from __future__ import annotations

import base64
import json
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from importlib.resources import files
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimation.se3 import Array
from hardware.page import document, figures_table, row_of_tiles, section, tile
from hardware.plan.layer_picture import len_text
from hardware.process.progress import counted, duration
from planning.layers.figures import LayerFigures, Total, seconds_to
from planning.layers.grid import at
from planning.layers.plan import Plan
from planning.layers.tool import rotations

PAINTS = ((0.16, 0.52, 0.72), (0.87, 0.56, 0.2), (0.33, 0.66, 0.45), (0.55, 0.42, 0.75), (0.8, 0.36, 0.26))  # tissues
SHEET = 120  # nodes along the longer side of the surfaces in the view
STYLE = """
#plan-canvas { width: 100%; height: 560px; display: block; touch-action: none; cursor: grab; border-radius: 8px;
  background: linear-gradient(#eef2f5, #d9e0e6); }
@media (prefers-color-scheme: dark) { #plan-canvas { background: linear-gradient(#2a323b, #171c22); } }
.plan-bar { display: flex; flex-wrap: wrap; gap: 6px 16px; align-items: center; font-size: 13.5px; margin-top: 10px; }
.plan-bar input[type=range] { flex: 1 1 320px; } .plan-bar label { color: var(--soft); white-space: nowrap; }
#plan-words { font-size: 13.5px; color: var(--soft); margin-top: 6px; font-variant-numeric: tabular-nums; }
.plan-bar button { font: inherit; padding: 3px 12px; border-radius: 8px; border: 1px solid var(--grey);
  background: var(--card); color: var(--ink); cursor: pointer; }
.layer-picture svg { width: 100%; height: auto; border-radius: 8px; } .layer-picture { margin-top: 12px; }
.plan-note { border-left: 3px solid var(--amber); padding-left: 12px; margin: 6px 0; }
.sideways { overflow-x: auto; }
.sideways td { white-space: nowrap; padding: 5px 7px; } .sideways th { padding: 4px 7px; }
"""
CONTROLS = """<canvas id="plan-canvas" role="img" aria-label="the beads in three dimensions"></canvas>
<div class="plan-bar"><input id="plan-at" type="range" min="0" value="0" aria-label="printed up to">
<button id="plan-step" type="button">next layer</button><button id="plan-top" type="button">from above</button></div>
<div class="plan-bar"><label><input id="plan-alone" type="checkbox"> this layer alone</label>
<label><input id="plan-travels" type="checkbox"> travels</label>
<label><input id="plan-bed" type="checkbox" checked> wound bed</label>
<label><input id="plan-skin" type="checkbox"> restored skin</label>
<label><input id="plan-tool" type="checkbox" checked> tool</label></div><div id="plan-words"></div>"""
CHOOSER = """<div class="plan-bar"><input id="layer-at" type="range" min="1" max="{count}" value="{count}"
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


@dataclass(frozen=True, slots=True, eq=False)
class Story:
    """What the report tells beside the plan's figures.

    title: what was planned. findings: of the wound, as (what, value). repairs: of the scan, as (what, count). order:
    what was asked for, as (what, value). notes: what somebody should look at.
    """

    title: str
    findings: Sequence[tuple[str, str]]
    repairs: Sequence[tuple[str, int]]
    order: Sequence[tuple[str, str]]
    notes: Sequence[str]


def page_text(plan: Plan, layers: Sequence[LayerFigures], total: Total, story: Story, pictures: Sequence[str]) -> str:
    """The whole page."""
    body = [f"<style>{STYLE}</style>", row_of_tiles(_tiles(layers, total))]
    if story.notes:
        notes = "".join(f'<div class="plan-note">{escape(note)}</div>' for note in story.notes)
        body.append(f"<section><h2>Look at this before printing</h2>{notes}</section>")
    body.append(
        section(
            "The beads",
            "Drag to turn, shift and drag to move, wheel to come nearer. The slider prints as far as it is moved.",
            f'{CONTROLS}<script type="application/json" id="plan-data">{_data(plan)}</script><script>'
            f"{(files('hardware.plan') / 'view.js').read_text(encoding='utf-8')}</script>",
        )
    )
    body.append(section("Layers", LAYER_WORDS, f'<div class="sideways">{_layer_table(layers, total)}</div>'))
    shown = "".join(f'<div class="layer-picture">{picture}</div>' for picture in pictures)
    if pictures:
        unrolled = "" if plan.order.mode == "horizontal" else " They are unrolled to the lengths on the skin."
        words = f"Seen from outside, the scan's x to the right.{unrolled}"
        body.append(section("Each layer", words, CHOOSER.format(count=len(pictures), pictures=shown)))
    body.append(section("The wound", "As found in the scan.", figures_table(("", "value"), story.findings)))
    if story.repairs:
        rows = [(what, str(count)) for what, count in story.repairs]
        body.append(section("The scan", "What was found wrong with it, and put right.", figures_table(("", ""), rows)))
    body.append(section("What was asked for", "All settings, defaults included.", figures_table(("", ""), story.order)))
    lead = _lead(layers, total)
    return document("plan", story.title, lead, body, "mm, s, degrees; 1 mm³ is 1 µl")


LAYER_WORDS = (
    "Covered and twice are shares of the layer's area, each bead taken as wide as it is meant to be; open is what no "
    "bead reaches, and over half a bead and over a bead the parts of that into which a disc so wide would fit."
)


def _lead(layers: Sequence[LayerFigures], total: Total) -> str:
    inks = ", ".join(f"{volume / 1000:.2f} ml of {material_text(name)}" for name, volume in total.volume)
    return (
        f"{counted(len(layers), 'layer')}, {len_text(total.printed)} of bead, {duration(total.seconds)} to print: "
        f"{inks}. {total.covered:.2%} of the layers' area is covered, {total.double:.2%} twice."
    )


def _tiles(layers: Sequence[LayerFigures], total: Total) -> list[str]:
    return [
        tile(f"{100 * total.covered:.2f}", "%", "covered"),
        tile(f"{100 * total.double:.2f}", "%", "laid twice"),
        tile(*_clock(total.seconds), "to print"),
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
    """A material as it is named in a sentence: collagen, material 2."""
    return f"material {name}" if name.isdecimal() else name


def _layer_table(layers: Sequence[LayerFigures], total: Total) -> str:
    head = (
        "layer", "tissue", "material", "area mm²", "covered", "twice", "beside", "open mm²", "over half a bead",
        "over a bead", "runs", "bead", "travel", "time", "ink µl",
    )  # fmt: skip
    rows = [
        (
            str(f.number + 1), f.tissue, f.material, f"{f.area:.0f}", f"{f.coverage.covered:.2%}",
            f"{f.coverage.double:.2%}", f"{f.coverage.over:.2%}", f"{f.gap:.2f}", f"{f.half_gap:.2f}",
            f"{f.bead_gap:.2f}", str(f.beads), len_text(f.printed), len_text(f.travelled), " ".join(_clock(f.seconds)),
            f"{f.volume:.1f}",
        )
        for f in reversed(layers)
    ]  # fmt: skip
    rows.append((
        "all", "", "", f"{total.area:.0f}", f"{total.covered:.2%}", f"{total.double:.2%}", f"{total.over:.2%}",
        f"{total.gap:.2f}", f"{sum(f.half_gap for f in layers):.2f}", f"{total.bead_gap:.2f}",
        str(sum(f.beads for f in layers)), len_text(total.printed), len_text(total.travelled),
        " ".join(_clock(total.seconds)),
        f"{sum(v for _, v in total.volume):.1f}",
    ))  # fmt: skip
    return figures_table(head, rows, last_total=True)


def _data(plan: Plan) -> str:
    """The checkpoints and surfaces for the view, as JSON."""
    points = plan.points
    names = list(dict.fromkeys(layer.slab.tissue.name for layer in plan.stack.layers))
    up = rotations(points.tilt, 0.0)[:, :, 2]
    data: dict[str, Any] = {
        "tip": _base64(points.tip, "<f4"),
        "normal": _base64(np.rint(127 * up), "i1"),
        "width_um": _base64(np.rint(1000 * points.width), "<u2"),
        "layer": _base64(points.layer, "<u2"),
        "extrude": _base64(points.extrude, "u1"),
        "seconds": _base64(seconds_to(points), "<f4"),
        "layers": len(plan.stack.layers),
        "names": [layer.slab.tissue.name for layer in plan.stack.layers],
        "paints": PAINTS,
        "paint_of": [names.index(layer.slab.tissue.name) % len(PAINTS) for layer in plan.stack.layers],
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
    step = float((high - low).max()) / SHEET
    columns, rows = (int(n) for n in (high - low) / step + 1)
    x, y = np.meshgrid(low[0] + step * np.arange(columns), low[1] + step * np.arange(rows))
    values = at(grid, heights, np.column_stack([x.ravel(), y.ravel()]))
    return {
        "x": float(low[0]), "y": float(low[1]), "step": step, "columns": columns, "rows": rows,
        "heights": _base64(values, "<f4"),
    }  # fmt: skip
