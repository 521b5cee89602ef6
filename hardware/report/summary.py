"""The figures of one run in words, as a text table and as summary.json."""

from __future__ import annotations

import json
import math
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from estimation.pose import TrackState
from hardware.files.pose_file import PoseTable
from hardware.files.session import damage_text
from hardware.report.evaluation import MAX_TRACKING_ERROR_MM, Comparison, Evaluation, PoseErrors, spread


def measured_share(result: Evaluation) -> float:
    """Share of the frame sets that were TRACKING or DEGRADED; 0 where there are none."""
    return sum(share for name, share in result.shares.items() if TrackState(name).measured)


def verdict(result: Evaluation) -> list[str]:
    """The run in a few sentences."""
    counted = int(np.sum(result.table.stamps >= result.since - 1e-6))
    followed = round(measured_share(result) * counted)
    sentences = [f"The surface was followed in {followed} of {counted} frame sets ({percent(measured_share(result))})."]
    if not result.complete:
        sentences.insert(0, "This run was cut short; what follows is about the part that was done.")
    if result.damage:
        sentences.insert(0, damage_text(result.damage))
    if result.comparison is not None:
        sentences += _judgement(result.comparison)
    if len(result.latency.total):
        middle, tail = result.latency.p50[-1], result.latency.p99[-1]
        sentences.append(f"A pose took {middle:.1f} ms (median), {tail:.1f} ms at the 99th percentile.")
    if clocks_learned(result.table):
        sentences.append(_clocks(result.table))
    return sentences


def clocks_learned(table: PoseTable) -> bool:
    """Whether the method learned when the cameras expose."""
    return len(table) > 0 and len(table.cameras) > 1 and bool(np.isfinite(table.offset_sigmas[-1]).all())


def _clocks(table: PoseTable) -> str:
    """What was known at the end of when the cameras expose."""
    offsets, sigmas = 1000 * table.offsets[-1], 1000 * table.offset_sigmas[-1]
    if not offsets.any():
        return f"No camera exposes clearly earlier or later than the others (known to {sigmas.max():.1f} ms)."
    each = [f"{n} {o:+.1f} ± {s:.1f} ms" for n, o, s in zip(table.cameras, offsets, sigmas, strict=True)]
    return f"Against the mean of their clocks the cameras expose at {', '.join(each)}."


def _judgement(comparison: Comparison) -> list[str]:
    error = spread(comparison.start.translation)
    turn = math.degrees(spread(comparison.start.rotation).median)
    against = "exact truth" if comparison.exact else "measured reference"
    sentences = [f"Against the {against} it was off by {figure(error.median)} mm and {figure(turn)}° (median)."]
    many = {0: "No pose was", 1: "One pose was"}.get(len(comparison.off), f"{len(comparison.off)} poses were")
    return [*sentences, f"{many} off by more than {MAX_TRACKING_ERROR_MM:.0f} mm while the state said TRACKING."]


def percent(share: float) -> str:
    """0.965 as 96.5 %, without needless zeros."""
    return f"{100 * share:.1f}".removesuffix(".0") + " %"


def figure(value: float) -> str:
    """Three significant digits, and a dash for what is not known."""
    if not math.isfinite(value):
        return "–"
    return f"{value:.0f}" if abs(value) >= 100 else f"{value:#.3g}" if abs(value) >= 0.001 else f"{value:.4f}"


def as_dict(result: Evaluation) -> dict[str, Any]:
    """The summary as plain values, ready for JSON; a figure that does not exist is None."""
    late = result.latency
    percentiles = zip(late.stages, late.p50, late.p95, late.p99, late.max, strict=True)
    summary: dict[str, Any] = {
        "session": result.title,
        "method": result.method,
        "complete": result.complete,
        "verdict": verdict(result),
        "frame_sets": len(result.table),
        "states_since_s": result.since,
        "states": result.shares,
        "measured_share": measured_share(result),
        "latency_ms": {name: {"p50": a, "p95": b, "p99": c, "max": d} for name, a, b, c, d in percentiles},
        "clocks_ms": None,
        "initialisation_ms": late.initialisation,
        "initialisation_frame_sets": late.initial_sets,
        "errors": None,
    }
    if clocks_learned(table := result.table):
        last = zip(table.cameras, 1000 * table.offsets[-1], 1000 * table.offset_sigmas[-1], strict=True)
        summary["clocks_ms"] = {name: {"offset": offset, "sigma": sigma} for name, offset, sigma in last}
    if (comparison := result.comparison) is not None:
        summary["errors"] = {
            "against": "truth" if comparison.exact else "reference",
            "poses": len(comparison.rows),
            "median_stamp_gap_s": comparison.stamp_gap,
            "off_by_more_than_10_mm_while_tracking": len(comparison.off),
            "start": _errors_dict(comparison.start),
            "aligned": _errors_dict(comparison.aligned),
        }
    cleaned: dict[str, Any] = finite(summary)
    return cleaned


def _errors_dict(errors: PoseErrors) -> dict[str, Any]:
    return {
        "translation_mm": asdict(spread(errors.translation)),
        "rotation_deg": asdict(spread(np.degrees(errors.rotation))),
        "nees_over_6": errors.mean_nees / 6,
        "nees_inside_95": errors.nees_inside,
        "truth_surface_from_estimated_surface": errors.truth_surface_from_estimated_surface.tolist(),
    }


def finite(value: Any) -> Any:
    """The same value with every number that JSON cannot hold as None, and numpy's floats as Python's."""
    if isinstance(value, dict):
        return {key: finite(item) for key, item in value.items()}
    if isinstance(value, list):
        return [finite(item) for item in value]
    if isinstance(value, float):
        return float(value) if math.isfinite(value) else None
    return value


def write_summary(path: Path, result: Evaluation) -> None:
    """Write summary.json."""
    path.write_text(json.dumps(as_dict(result), indent=2) + "\n", encoding="utf-8")


def summary_text(result: Evaluation) -> str:
    """The verdict and the error table, for a terminal."""
    return text_of(as_dict(result))


def text_of(summary: dict[str, Any]) -> str:
    """The same from a summary as `as_dict` gives it; KeyError where a figure is missing."""
    lines = list(summary["verdict"])
    if summary["errors"] is not None:
        lines += ["", f"{'error':<22}{'median':>9}{'RMSE':>9}{'95 %':>9}{'max':>9}"]
        for name, kind in (("from the start", "start"), ("aligned", "aligned")):
            for unit, key in (("mm", "translation_mm"), ("deg", "rotation_deg")):
                figures = summary["errors"][kind][key]
                cells = "".join(f"{figures[part]:>9.3f}" for part in ("median", "rmse", "p95", "max"))
                lines.append(f"{f'{name}, {unit}':<22}{cells}")
    return "\n".join(lines)
