"""One simulated print and what it came to: everything that the page, the summary and the exit code are made of."""

from __future__ import annotations

from dataclasses import dataclass, field

from hardware.report.evaluation import Evaluation, spread
from hardware.simulator.deposit import DepositMap, deposit_figures, deposit_map
from hardware.simulator.nozzle_error import NozzleErrors, nozzle_errors, nozzle_figures
from hardware.simulator.nozzle_log import NozzleLog
from hardware.simulator.planned_line import PlannedLine, planned_line
from hardware.simulator.run_limits import RunFigures, RunLimits, Verdict, check
from planning.path import Path


@dataclass(frozen=True, slots=True, eq=False)
class NozzleRun:
    """One simulated print. path: in the true surface frame. bead: width, mm. tracking: of the surface, where known.

    complete: whether it ran to its end. pictures: what to show of it, each a name and the bytes of a JPEG or PNG.
    files: what lies beside the page, each a name relative to it and what it holds.
    """

    title: str
    log: NozzleLog
    path: Path
    bead: float
    limits: RunLimits = field(default_factory=RunLimits)
    tracking: Evaluation | None = None
    complete: bool = True
    pictures: tuple[tuple[str, bytes], ...] = ()
    files: tuple[tuple[str, str], ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class NozzleResult:
    """A run with its errors row by row, its figures, the map of its deposit, and a verdict for each limit."""

    run: NozzleRun
    line: PlannedLine
    errors: NozzleErrors
    figures: RunFigures
    deposit: DepositMap
    verdicts: tuple[Verdict, ...]

    @property
    def met(self) -> bool:
        """Whether the run was complete, printed something, and that only where a target was, and met all its limits."""
        printed = self.figures.nozzle.extruding > 0 and self.figures.nozzle.untold == 0
        return self.run.complete and printed and all(verdict.met for verdict in self.verdicts)


def judge(run: NozzleRun) -> NozzleResult:
    """What a run came to."""
    line = planned_line(run.path)
    errors = nozzle_errors(run.log, line)
    deposit = deposit_map(run.log, line, run.bead)
    comparison = None if run.tracking is None else run.tracking.comparison
    tracking = None if comparison is None else spread(comparison.start.translation)
    figures = RunFigures(nozzle_figures(run.log, line, errors), deposit_figures(deposit), tracking)
    return NozzleResult(run, line, errors, figures, deposit, tuple(check(run.limits, figures)))
