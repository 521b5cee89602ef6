"""What a plan says about its wound, its bumps and its arm: for the summary, the report and the command's answer."""

from __future__ import annotations

from typing import Any

import numpy as np

from planning.layers.plan import Plan, PlannedLayer

ASLANT_DEG = 35.0  # off the normal: a bead is then pushed aside by a fifth of its width, as the tip is no point
NOT_ASKED = "no arm was asked, so there is no column feasible; --arm ARM.toml asks one, stillbed reach one later"


def findings_rows(plan: Plan) -> list[tuple[str, str]]:
    """What the wound is like, in words."""
    f = plan.wound.findings
    low_tilt, high_tilt = (np.rad2deg(t.departure) for t in (plan.ground.low, plan.ground.high))
    rows = [
        ("outline", "given" if f.given else f"found: where the scan is {f.level:.2f} mm deep"),
        ("area over which it is open", f"{f.area:.1f} mm²"),
        ("greatest depth under the restored skin", f"{f.depth:.2f} mm"),
        ("volume up to the restored skin", f"{f.volume:.0f} mm³"),
        ("volume of the beads", f"{plan.points.volume.sum():.0f} mm³"),
    ]
    rows += [("bumps of the bed", bumps_text(plan))] if bumpy(plan) else []
    if not f.noise and not f.scatter:
        return rows
    return rows + [
        ("noise of the scan", f"{f.noise:.3f} mm, smoothed over {f.smoothing:.2f} mm"),
        ("skin around off the restored surface", f"{f.scatter:.3f} mm"),
        ("guessed in holes of the scan", f"{f.closed:.1f} mm²"),
        ("hidden under overhangs", f"{f.hidden:.1f} mm²"),
        ("tool off the normal, at worst, first and last layer", f"{low_tilt:.1f}°, {high_tilt:.1f}°"),
    ]


def notes_of(plan: Plan) -> list[str]:
    """What somebody should look at before printing."""
    notes = list(plan.wound.findings.notes)
    if plan.stack.missing:
        notes.append(f"not printed, as the wound is not deep enough: {', '.join(plan.stack.missing)}")
    off_deg = max(np.rad2deg(t.departure) for t in (plan.ground.low, plan.ground.high))
    if off_deg > ASLANT_DEG:
        notes.append(
            f"the tool stands up to {off_deg:.0f} degrees off the normal, as its limits ask for: on the steepest walls"
        )
    empty = sum(not layer.beads for layer in plan.layers)
    if empty:
        notes.append(f"{empty} of {len(plan.layers)} layers have no room for a bead and are left out")
    return notes


def bumpy(plan: Plan) -> list[PlannedLayer]:
    """The layers over which something of the bed stands."""
    return [p for p in plan.layers if not (p.over.is_empty and p.around.is_empty)]


def bump_facts(plan: Plan) -> dict[str, Any]:
    """How bumps were to be passed, and what was met in which layer (counted from 1). mm, mm2."""
    passing, width = plan.order.passing, plan.order.pattern.width
    met = [
        {
            "layer": p.layer.number + 1, "limit_mm": passing.limit(p.layer.height), "over": len(p.over.geoms),
            "over_mm2": p.over.area, "around": len(p.around.geoms), "around_mm2": p.around.area,
            "highest_mm": p.layer.bumps.highest,
        }
        for p in bumpy(plan)
    ]  # fmt: skip
    return {"clearance_mm": passing.clear(width), "layers": met}


def bumps_text(plan: Plan) -> str:
    """Bumps in words: how many layers go over some, and round some."""
    over = [p.layer.number + 1 for p in plan.layers if not p.over.is_empty]
    around = [p.layer.number + 1 for p in plan.layers if not p.around.is_empty]
    said = []
    if over:
        said.append(f"gone over in {_layers_text(over)}")
    if around:
        clear = plan.order.passing.clear(plan.order.pattern.width)
        highest = max(p.layer.bumps.highest for p in plan.layers if not p.around.is_empty)
        said.append(f"gone round with {clear:.2f} mm between in {_layers_text(around)}, up to {highest:.2f} mm over it")
    return "; ".join(said)


def _layers_text(numbers: list[int]) -> str:
    """Layers as people name them: layer 3, layers 2 to 5, layers 1, 4, 6."""
    if len(numbers) == 1:
        return f"layer {numbers[0]}"
    if len(numbers) > 2 and numbers[-1] - numbers[0] + 1 == len(numbers):
        return f"layers {numbers[0]} to {numbers[-1]}"
    return "layers " + ", ".join(str(n) for n in numbers)
