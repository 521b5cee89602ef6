"""A simulated print in words, as plain values for summary.json, and as a table for the terminal."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from hardware.report.evaluation import Spread
from hardware.report.summary import figure, finite, percent, spread_dict
from hardware.simulator.nozzle_error import NEAR
from hardware.simulator.nozzle_run import NozzleResult
from hardware.simulator.run_limits import Verdict

PARTS = ("median", "rmse", "p95", "p99", "max")
HEADS = ("median", "RMS", "95 %", "99 %", "max")


def rows_of_errors(result: NozzleResult) -> list[tuple[str, str, Spread, float]]:
    """The table of errors: words, key in the summary, spread, and what a value in it is multiplied by for display."""
    f = result.figures.nozzle
    return [
        ("position, mm", "position_mm", f.position, 1.0),
        ("along the path, mm", "along_mm", f.along, 1.0),
        ("across the path, mm", "across_mm", f.across, 1.0),
        ("along the normal, mm", "normal_mm", f.normal, 1.0),
        ("off the printed line, mm", "path_mm", f.path, 1.0),
        ("angle, °", "angle_deg", f.angle, math.degrees(1.0)),
    ]


def nozzle_verdict(result: NozzleResult) -> list[str]:
    """The run in a few sentences."""
    f, deposit = result.figures.nozzle, result.figures.deposit
    sentences = [] if result.run.complete else ["This run was cut short; what follows is about the part that was done."]
    if not math.isfinite(f.position.p95):
        return [*sentences, "Nothing was printed, so there is no error to tell.", *_limits_in_words(result)]
    sentences.append(
        f"While it printed, the nozzle was {figure(f.position.rmse)} mm from its place (RMS), 95 % of the time within "
        f"{figure(f.position.p95)} mm and never more than {figure(f.position.max)} mm away."
    )
    sentences.append(f"It printed for {share(f.duty)} of the time it had{'' if f.finished else ' and did not finish'}.")
    if math.isfinite(deposit.coverage):
        sentences.append(f"{share(deposit.coverage)} of the planned area got its material.")
    if f.untold > 0:
        sentences.append(f"For {f.untold:.3f} s material left the nozzle where nothing was due.")
    return sentences + _limits_in_words(result)


def _limits_in_words(result: NozzleResult) -> list[str]:
    missed = [verdict for verdict in result.verdicts if not verdict.met]
    if not result.verdicts:
        return ["The scenario sets no limits."]
    if not missed:
        return [f"All {len(result.verdicts)} limits were met." if len(result.verdicts) > 1 else "Its limit was met."]
    told = "; ".join(f"{v.bound.words} {reached_in_words(v)}, {allowed_in_words(v)}" for v in missed)
    return [f"{len(missed)} of {len(result.verdicts)} limits missed: {told}."]


def share(value: float) -> str:
    """A share in percent, a dash for one that is not known."""
    return percent(value) if math.isfinite(value) else "–"


def reached_in_words(verdict: Verdict) -> str:
    """What was reached, with its unit."""
    return with_unit(verdict.reached, verdict.bound.unit)


def allowed_in_words(verdict: Verdict) -> str:
    """The bound, with its unit and its side."""
    number = percent(verdict.allowed) if not verdict.bound.unit else f"{verdict.allowed:g} {verdict.bound.unit}"
    return f"{'at least' if verdict.bound.least else 'at most'} {number}"


def with_unit(value: float, unit: str) -> str:
    """A figure with its unit; a share, which has none, in percent."""
    return f"{figure(value)} {unit}" if unit else share(value)


def nozzle_dict(result: NozzleResult) -> dict[str, Any]:
    """The run as plain values, ready for JSON; a figure that does not exist is None."""
    f, deposit = result.figures.nozzle, result.figures.deposit
    summary = {
        "run": result.run.title,
        "complete": result.run.complete,
        "met": result.met,
        "verdict": nozzle_verdict(result),
        "limits": [
            {"name": v.name, "reached": v.reached, "allowed": v.allowed, "met": bool(v.met)} for v in result.verdicts
        ],
        "errors": {key: _scaled(spread, scale) for _, key, spread, scale in rows_of_errors(result)},
        "offset_mm": f.offset.tolist(),
        "near_mm": NEAR,
        "near": f.near,
        "extruding_s": f.extruding,
        "extruding_without_target_s": f.untold,
        "printing_s": f.printing,
        "duty": f.duty,
        "finished": f.finished,
        "lag_ms": 1000 * f.lag.seconds,
        "holds": [
            {"reason": h.reason, "count": h.count, "total_s": h.seconds, "longest_s": h.longest, "first_s": h.first}
            for h in f.holds
        ],
        "deposit": {
            "bead_mm": result.run.bead,
            "layers": len(result.deposit.layers),
            "planned_mm2": deposit.area,
            "coverage": deposit.coverage,
            "gaps": deposit.gaps,
            "overlap": deposit.overlap,
            "outside": deposit.outside,
            "material": deposit.material,
        },
        "tracking_mm": None if result.figures.tracking is None else spread_dict(result.figures.tracking),
    }
    cleaned: dict[str, Any] = finite(summary)
    return cleaned


def _scaled(spread: Spread, scale: float) -> dict[str, float]:
    return {name: value * scale for name, value in spread_dict(spread).items()}


def nozzle_text(summary: dict[str, Any]) -> str:
    """The verdict and the tables, for a terminal, from a summary as `nozzle_dict` gives it."""
    lines = [*summary["verdict"], "", f"{'error while printing':<26}" + "".join(f"{head:>9}" for head in HEADS)]
    for key, figures in summary["errors"].items():
        name, _, unit = key.rpartition("_")
        lines.append(f"{f'{name}, {unit}':<26}" + "".join(f"{_number(figures[part]):>9}" for part in PARTS))
    deposit = summary["deposit"]
    lag = summary["lag_ms"]
    parts = [("duty", summary["duty"]), *((name, deposit[name]) for name in ("coverage", "gaps", "overlap", "outside"))]
    told = [f"{name} {share(np.nan if value is None else value)}" for name, value in parts]
    lines += ["", ", ".join([*told, f"lag {'–' if lag is None else f'{lag:.1f}'} ms"])]
    for hold in summary["holds"]:
        lines.append(f"held {hold['count']} x, {hold['total_s']:.2f} s in all: {hold['reason']}")
    for limit in summary["limits"]:
        word = "met   " if limit["met"] else "MISSED"
        lines.append(f"{word}  {limit['name']:<18}{_number(limit['reached']):>9}  allowed {limit['allowed']:g}")
    return "\n".join(lines)


def _number(value: float | None) -> str:
    return "–" if value is None else f"{value:.3f}"
