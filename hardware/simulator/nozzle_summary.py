"""The result of a simulated print: verdicts on its limits, its summary as text, JSON and table.

A scenario's table [limits] has keys of BOUNDS, all optional. Those without a unit are shares from 0 to 1.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from estimation.pose import TrackState
from hardware.process import checks
from hardware.process.progress import count_text
from hardware.recording.messages import message_from_look
from hardware.report.evaluation import INCOMPLETE_TEXT, Evaluation, Spread, figure, finite, percent, spread
from hardware.simulator.deposit import (
    DepositFigures,
    DepositMap,
    NozzleLog,
    PlannedLine,
    deposit_figures,
    deposit_map,
    planned_line,
)
from hardware.simulator.nozzle_error import (
    NEAR_ERROR,
    MaterialFigures,
    NozzleFigures,
    RowErrors,
    material_figures,
    nozzle_errors,
    nozzle_figures,
)
from planning.laid_beads import Look
from planning.path import Path


@dataclass(frozen=True, slots=True, eq=False)
class RunFigures:
    """All figures that can be bounded."""

    nozzle: NozzleFigures
    deposit: DepositFigures
    material: MaterialFigures
    tracking: Spread | None = None  # errors of the estimated surface, mm, from the start; None where unknown


@dataclass(frozen=True, slots=True, eq=False)
class Bound:
    """A figure that a scenario may bound."""

    label: str
    unit: str  # "" for a share
    minimum: bool  # whether the bound is a minimum; else it is a maximum
    value_of: Callable[[RunFigures], float]  # the figure in that unit


def _tracking(part: str) -> Callable[[RunFigures], float]:
    return lambda f: math.nan if f.tracking is None else float(getattr(f.tracking, part))


BOUNDS = {  # key in [limits]: with its unit
    "rms_mm": Bound("position error, RMS", "mm", False, lambda f: f.nozzle.position.rmse),
    "median_mm": Bound("position error, median", "mm", False, lambda f: f.nozzle.position.median),
    "p95_mm": Bound("position error, 95 %", "mm", False, lambda f: f.nozzle.position.p95),
    "p99_mm": Bound("position error, 99 %", "mm", False, lambda f: f.nozzle.position.p99),
    "max_mm": Bound("position error, largest", "mm", False, lambda f: f.nozzle.position.max),
    "normal_p95_mm": Bound("error along the normal, 95 %", "mm", False, lambda f: f.nozzle.normal.p95),
    "path_p95_mm": Bound("distance from the path, 95 %", "mm", False, lambda f: f.nozzle.path.p95),
    "path_max_mm": Bound("distance from the path, largest", "mm", False, lambda f: f.nozzle.path.max),
    "angle_p95_deg": Bound("angle, 95 %", "°", False, lambda f: math.degrees(f.nozzle.angle.p95)),
    "angle_max_deg": Bound("angle, largest", "°", False, lambda f: math.degrees(f.nozzle.angle.max)),
    "near": Bound("extruding time within 0.5 mm", "", True, lambda f: f.nozzle.near),
    "duty": Bound("duty cycle", "", True, lambda f: f.nozzle.duty),
    "hold_s": Bound("longest hold", "s", False, lambda f: max((h.longest for h in f.nozzle.holds), default=0.0)),
    "lag_ms": Bound("lag", "ms", False, lambda f: 1000 * abs(f.nozzle.lag.seconds)),
    "coverage": Bound("coverage", "", True, lambda f: f.deposit.coverage),
    "gaps": Bound("gaps", "", False, lambda f: f.deposit.gaps),
    "overlap": Bound("overlap", "", False, lambda f: f.deposit.overlap),
    "outside": Bound("material outside", "", False, lambda f: f.deposit.outside),
    "bead_begin_p95_mm": Bound("error of bead starts, 95 %", "mm", False, lambda f: f.material.beginnings.size.p95),
    "bead_stop_p95_mm": Bound("error of bead ends, 95 %", "mm", False, lambda f: f.material.ends.size.p95),
    "told_outside_ms": Bound(
        "commanded open outside of printing", "ms", False, lambda f: 1000 * f.material.open_outside
    ),
    "tracking_rms_mm": Bound("tracking error, RMS", "mm", False, _tracking("rmse")),
    "tracking_p95_mm": Bound("tracking error, 95 %", "mm", False, _tracking("p95")),
    "tracking_max_mm": Bound("tracking error, largest", "mm", False, _tracking("max")),
}


RunLimits = dict[str, float]  # the bounds of one scenario by their key in BOUNDS, each in the key's unit


@dataclass(frozen=True, slots=True)
class LimitVerdict:
    """One limit, the run's value, and whether it meets it. A NaN never does."""

    name: str  # key of BOUNDS
    value: float  # in its unit
    limit: float  # in its unit
    met: bool

    @property
    def bound(self) -> Bound:
        """The bounded figure."""
        return BOUNDS[self.name]

    @property
    def value_text(self) -> str:
        """The value with its unit; a share, which has none, in percent."""
        return f"{figure(self.value)} {self.bound.unit}" if self.bound.unit else share(self.value)

    @property
    def limit_text(self) -> str:
        """The bound, with its unit and its side."""
        number = f"{self.limit:g} {self.bound.unit}" if self.bound.unit else percent(self.limit)
        return f"{'at least' if self.bound.minimum else 'at most'} {number}"


def limits_from_table(where: object, table: checks.Table) -> RunLimits:
    """The limits in a table [limits] of the file `where`; InputError names the key that makes no sense."""
    keys: checks.Keys = {
        name: (name, checks.within(0, math.inf if each.unit else 1.0, each.unit)) for name, each in BOUNDS.items()
    }
    return checks.record_from_table(where, "limits.", table, dict, keys)


def check_limits(limits: RunLimits, figures: RunFigures) -> list[LimitVerdict]:
    """A verdict for each limit, in their order."""
    verdicts = []
    for name, limit in limits.items():
        value = BOUNDS[name].value_of(figures)
        met = value >= limit if BOUNDS[name].minimum else value <= limit
        verdicts.append(LimitVerdict(name, value, limit, met))
    return verdicts


@dataclass(frozen=True, slots=True, eq=False)
class NozzleRun:
    """One simulated print."""

    title: str
    log: NozzleLog
    path: Path  # in the true surface frame
    bead: float  # width, mm
    limits: RunLimits = field(default_factory=dict)
    open_outside: float = math.nan  # s in which a dispenser was commanded open while no move printed
    tracking: Evaluation | None = None  # of the surface, where known
    complete: bool = True  # whether it ran to its end
    pictures: tuple[tuple[str, bytes], ...] = ()  # of the cameras: name, and bytes of a JPEG or PNG
    files: tuple[tuple[str, str], ...] = ()  # beside the page: relative name, and content
    looks: tuple[Look, ...] = ()  # at the printed material


@dataclass(frozen=True, slots=True, eq=False)
class NozzleResult:
    """A run with its errors row by row, its figures, the map of its deposit, and a verdict for each limit."""

    run: NozzleRun
    line: PlannedLine
    errors: RowErrors
    figures: RunFigures
    deposit: DepositMap
    verdicts: tuple[LimitVerdict, ...]

    @property
    def met(self) -> bool:
        """Whether the run was complete, printed, printed only where a target was due, and met all its limits."""
        printed = self.figures.nozzle.extruding > 0 and self.figures.nozzle.without_target == 0
        return self.run.complete and printed and all(verdict.met for verdict in self.verdicts)


def evaluate_run(run: NozzleRun) -> NozzleResult:
    """The result of a run."""
    line = planned_line(run.path)
    errors = nozzle_errors(run.log, line)
    deposit = deposit_map(run.log, line, run.bead)
    comparison = None if run.tracking is None else run.tracking.comparison
    tracking = None if comparison is None else spread(comparison.start.translation)
    material = material_figures(run.log, line, errors, run.bead, run.open_outside)
    figures = RunFigures(nozzle_figures(run.log, line, errors), deposit_figures(deposit), material, tracking)
    return NozzleResult(run, line, errors, figures, deposit, tuple(check_limits(run.limits, figures)))


SPREAD_COLUMNS = {"median": "median", "rmse": "RMS", "p95": "95 %", "p99": "99 %", "max": "max"}  # field, heading


def rows_of_errors(result: NozzleResult) -> list[tuple[str, str, Spread, float]]:
    """The table of errors: label, key in the summary, spread, and factor of its values for display."""
    f = result.figures.nozzle
    return [
        ("position, mm", "position_mm", f.position, 1.0),
        ("along the path, mm", "along_mm", f.along, 1.0),
        ("across the path, mm", "across_mm", f.across, 1.0),
        ("along the normal, mm", "normal_mm", f.normal, 1.0),
        ("distance from the printed line, mm", "path_mm", f.path, 1.0),
        ("angle, °", "angle_deg", f.angle, math.degrees(1.0)),
    ]


def nozzle_verdict(result: NozzleResult) -> list[str]:
    """The run in a few sentences."""
    f, deposit = result.figures.nozzle, result.figures.deposit
    sentences = [] if result.run.complete else [INCOMPLETE_TEXT]
    if not math.isfinite(f.position.p95):
        return [*sentences, f"Nothing was printed{_why_nothing(result.run.tracking)}.", *_limit_sentences(result)]
    sentences.append(
        f"Nozzle error while printing: {figure(f.position.rmse)} mm RMS, {figure(f.position.p95)} mm at 95 %, "
        f"{figure(f.position.max)} mm largest."
    )
    sentences.append(f"Duty cycle: {share(f.duty)}{'' if f.finished else '; the path was not finished'}.")
    if math.isfinite(deposit.coverage):
        sentences.append(f"Coverage: {share(deposit.coverage)} of the planned area.")
    material = result.figures.material
    if material.open_outside > 0:
        sentences.append(
            f"A dispenser was commanded open for {1000 * material.open_outside:.0f} ms outside of printing."
        )
    if f.without_target > 0:
        sentences.append(f"Material left the nozzle for {f.without_target:.3f} s outside of the planned beads.")
    return sentences + _limit_sentences(result)


def _why_nothing(tracking: Evaluation | None) -> str:
    """Why a run printed nothing, where no pose allowed the path to be placed; else that there is no error."""
    poses = Counter() if tracking is None else Counter(zip(tracking.table.states, tracking.table.reasons, strict=True))
    if not poses or any(state is TrackState.TRACKING for state, _ in poses):
        return ": there is no nozzle error"
    ((state, reason), count), *_ = poses.most_common(1)
    why = f" ({reason})" if reason else ""
    return f": the path was not placed, as no pose was TRACKING; {count} of {poses.total()} were {state.value}{why}"


def _limit_sentences(result: NozzleResult) -> list[str]:
    missed = [verdict for verdict in result.verdicts if not verdict.met]
    if not result.verdicts:
        return ["The scenario sets no limits."]
    if not missed:
        return [f"All {len(result.verdicts)} limits were met." if len(result.verdicts) > 1 else "The limit was met."]
    details = "; ".join(f"{v.bound.label} {v.value_text}, {v.limit_text}" for v in missed)
    return [f"{len(missed)} of {len(result.verdicts)} limits missed: {details}."]


def share(value: float) -> str:
    """A share in percent, a dash for an unknown one."""
    return percent(value) if math.isfinite(value) else "–"


def nozzle_dict(result: NozzleResult) -> dict[str, Any]:
    """The run as plain values, ready for JSON; a figure that does not exist is None."""
    f, deposit = result.figures.nozzle, result.figures.deposit
    summary = {
        "run": result.run.title,
        "complete": result.run.complete,
        "met": result.met,
        "verdict": nozzle_verdict(result),
        "limits": [
            {"name": v.name, "reached": v.value, "allowed": v.limit, "met": bool(v.met)} for v in result.verdicts
        ],
        "errors": {
            key: {name: value * scale for name, value in asdict(spread).items()}
            for _, key, spread, scale in rows_of_errors(result)
        },
        "offset_mm": f.offset.tolist(),
        "near_mm": NEAR_ERROR,
        "near": f.near,
        "extruding_s": f.extruding,
        "extruding_without_target_s": f.without_target,
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
            **{name: getattr(deposit, name) for name in ("coverage", "gaps", "overlap", "outside", "material")},
        },
        "material": _material_dict(result.figures.material),
        "looks": [message_from_look(look) for look in result.run.looks],
        "tracking_mm": None if result.figures.tracking is None else asdict(result.figures.tracking),
    }
    cleaned: dict[str, Any] = finite(summary)
    return cleaned


def _material_dict(material: MaterialFigures) -> dict[str, Any]:
    ends = {"begin": material.beginnings, "stop": material.ends}
    return {
        **{
            name: {
                "count": len(each.error),
                "missing": int(np.isnan(each.error).sum()),
                "median_mm": each.median,
                "p95_mm": each.size.p95,
                "max_mm": each.size.max,
                "excess_mean_mm3": float(each.excess.mean()) if len(each.excess) else math.nan,
                "excess_max_mm3": each.blob,
            }
            for name, each in ends.items()
        },
        "laid_mm3": material.volume,
        "planned_mm3": material.planned_volume,
        "ooze_mm3": material.ooze,
        "flowing_while_not_printing_ms": 1000 * material.flow_outside,
        "told_while_not_printing_ms": 1000 * material.open_outside,
    }


def nozzle_text(summary: dict[str, Any]) -> str:
    """The verdict and the tables, for a terminal, from a summary as `nozzle_dict` gives it."""
    heads = "".join(f"{head:>9}" for head in SPREAD_COLUMNS.values())
    lines = [*summary["verdict"], "", f"{'error while printing':<26}{heads}"]
    for key, figures in summary["errors"].items():
        name, _, unit = key.rpartition("_")
        lines.append(f"{f'{name}, {unit}':<26}" + "".join(f"{_number(figures[part]):>9}" for part in SPREAD_COLUMNS))
    deposit, lag = summary["deposit"], summary["lag_ms"]
    parts = [
        ("duty cycle", summary["duty"]),
        *((name, deposit[name]) for name in ("coverage", "gaps", "overlap", "outside")),
    ]
    shares = [f"{name} {share(np.nan if value is None else value)}" for name, value in parts]
    lines += ["", ", ".join([*shares, f"lag {'–' if lag is None else f'{lag:.1f}'} ms"])]
    for name, end in ((name, summary["material"][name]) for name in ("begin", "stop")):
        if end["count"]:
            off = f"error {_number(end['median_mm'])} mm (median), {_number(end['p95_mm'])} mm (95 %)"
            lines.append(f"{name} of beads: {end['count']}, {off}; largest excess {_number(end['excess_max_mm3'])} mm3")
    lines += [f"inspection at {look['stamp']:.1f} s: {look['text']}" for look in summary["looks"]]
    for hold in summary["holds"]:
        lines.append(f"{count_text(hold['count'], 'hold')}, {hold['total_s']:.2f} s: {hold['reason']}")
    for limit in summary["limits"]:
        word = "met   " if limit["met"] else "MISSED"
        lines.append(f"{word}  {limit['name']:<18}{_number(limit['reached']):>9}  allowed {limit['allowed']:g}")
    return "\n".join(lines)


def _number(value: float | None) -> str:
    return "–" if value is None else f"{value:.3f}"
