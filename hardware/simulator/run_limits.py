"""What a run must reach: the [limits] of a scenario, each a figure and a bound, and whether it was met.

    [limits]
    p95_mm = 0.5            # of the position error while extruding; median_mm, rms_mm, p99_mm, max_mm likewise
    normal_p95_mm = 0.3     # of its part along the target's axis
    path_p95_mm = 0.3       # of the distance from the printed line, whenever; path_max_mm likewise
    angle_p95_deg = 2       # between the nozzle's axis and the target's; angle_max_deg likewise
    near = 0.9              # at least; share of the extruding time with an error under 0.5 mm
    duty = 0.8              # at least
    hold_s = 1.0            # the longest
    lag_ms = 20             # whether late or early
    coverage = 0.9          # at least; gaps, overlap and outside at most
    tracking_p95_mm = 0.3   # of the estimated surface, from the start; tracking_rms_mm, tracking_max_mm likewise

All are optional. Those without a unit are shares from 0 to 1.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

from estimation.errors import InputError
from hardware.process import checks
from hardware.report.evaluation import Spread
from hardware.simulator.deposit import DepositFigures
from hardware.simulator.nozzle_error import NozzleFigures


@dataclass(frozen=True, slots=True, eq=False)
class RunFigures:
    """All that can be bounded. tracking: errors of the estimated surface, mm, from the start; None where not known."""

    nozzle: NozzleFigures
    deposit: DepositFigures
    tracking: Spread | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Bound:
    """A figure that a scenario may bound. words: what it is. unit: in which it is given, "" for a share.

    least: whether the bound must be reached; else it must not be passed. of: the figure in that unit.
    """

    words: str
    unit: str
    least: bool
    of: Callable[[RunFigures], float]


def _tracking(part: str) -> Callable[[RunFigures], float]:
    return lambda f: math.nan if f.tracking is None else float(getattr(f.tracking, part))


def _longest_hold(figures: RunFigures) -> float:
    return max((holds.longest for holds in figures.nozzle.holds), default=0.0)


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
    "duty": Bound("duty", "", True, lambda f: f.nozzle.duty),
    "hold_s": Bound("longest hold", "s", False, _longest_hold),
    "lag_ms": Bound("lag", "ms", False, lambda f: 1000 * abs(f.nozzle.lag.seconds)),
    "coverage": Bound("coverage", "", True, lambda f: f.deposit.coverage),
    "gaps": Bound("gaps", "", False, lambda f: f.deposit.gaps),
    "overlap": Bound("overlap", "", False, lambda f: f.deposit.overlap),
    "outside": Bound("material outside", "", False, lambda f: f.deposit.outside),
    "tracking_rms_mm": Bound("tracking error, RMS", "mm", False, _tracking("rmse")),
    "tracking_p95_mm": Bound("tracking error, 95 %", "mm", False, _tracking("p95")),
    "tracking_max_mm": Bound("tracking error, largest", "mm", False, _tracking("max")),
}


@dataclass(frozen=True, slots=True)
class RunLimits:
    """The bounds of one scenario. names: keys of BOUNDS, in the file's order. allowed: one each, in the key's unit."""

    names: tuple[str, ...] = ()
    allowed: tuple[float, ...] = ()


@dataclass(frozen=True, slots=True)
class Verdict:
    """One limit and what came of it. name: key of BOUNDS. reached, allowed: in its unit. A NaN never meets a limit."""

    name: str
    reached: float
    allowed: float
    met: bool

    @property
    def bound(self) -> Bound:
        """What is bounded, and how."""
        return BOUNDS[self.name]


def limits_from_table(where: object, table: checks.Table) -> RunLimits:
    """The limits in a table [limits] of the file `where`; InputError names the key that makes no sense."""
    checks.check_keys(where, "limits.", table, (), BOUNDS)
    allowed = []
    for name, value in table.items():
        number = checks.number(where, f"limits.{name}", value)
        most = math.inf if BOUNDS[name].unit else 1.0
        if not 0 <= number <= most:
            raise InputError(
                where, f"limits.{name}", value, "0 to 1" if most == 1 else f"0 {BOUNDS[name].unit} or more"
            )
        allowed.append(number)
    return RunLimits(tuple(table), tuple(allowed))


def check(limits: RunLimits, figures: RunFigures) -> list[Verdict]:
    """A verdict for each limit, in the order in which they were given."""
    verdicts = []
    for name, allowed in zip(limits.names, limits.allowed, strict=True):
        bound = BOUNDS[name]
        reached = bound.of(figures)
        verdicts.append(Verdict(name, reached, allowed, reached >= allowed if bound.least else reached <= allowed))
    return verdicts
