"""A page of a campaign of faults: what came of each kind, and its spread over all of them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from estimation.se3 import Array
from hardware.bench.fault_judge import LATE, SLOW, WRONG, Verdict
from hardware.bench.fault_table import HEADER, rows_by_kind
from hardware.page import document, figures_table, section
from hardware.process.faults import SPECS
from hardware.report.page import Plot

WIDTH, HEIGHT = 900, 230  # px
JITTER = 0.3  # of a kind's row, so that dots do not hide each other


def fault_page(verdicts: Sequence[Verdict]) -> str:
    """The table, and a dot for each fault: said after, error while extruding, back after."""
    silent = sum(v.silent for v in verdicts)
    lead = f"{silent} of {len(verdicts)} faults did harm in silence."
    names = [f"{part} {kind}" for part, kind in SPECS]
    present = [name for name in names if any(_kind(v) == name for v in verdicts)]
    explained = "; ".join(f"{i + 1} {name}" for i, name in enumerate(present))
    table = figures_table(HEADER, rows_by_kind(verdicts), last_total=True)
    said = (
        "Times in ms, median first. said %: share that was told; said ms: until the exposure of the pose that said so, "
        "of what pictures do not show until somebody did; known: until somebody did; worst: the largest error while "
        "extruding; back: until moves went out again; late: those that took more than 200 ms."
    )
    body = [section("What came of each kind", said, table)]
    for title, field, unit, level in (
        ("Said after", "seen", "s", LATE),
        ("Largest error while extruding", "worst", "mm", WRONG),
        ("Going on again after its end", "recovered", "s", SLOW),
    ):
        values = np.array([getattr(v, field) for v in verdicts])
        plot = _dots(verdicts, present, values, f"{title.lower()}, {unit}", level)
        body.append(section(title, f"A dot for each fault, by kind: {explained}.", plot))
    return document(
        "bench", "faults", lead, body, "A print in virtual time; the operator arms it again where it stops."
    )


def _kind(verdict: Verdict) -> str:
    return f"{verdict.fault.part} {verdict.fault.kind}"


def _dots(verdicts: Sequence[Verdict], present: Sequence[str], values: Array, label: str, level: float) -> str:
    """One dot for each fault, kinds side by side; what never came stands at the top."""
    finite = values[np.isfinite(values)]
    top = max(float(finite.max(initial=0.0)), level) * 1.15
    plot = Plot(WIDTH, HEIGHT, (0.5, len(present) + 0.5), (0.0, top), label=label)
    place = np.array([1.0 + present.index(_kind(v)) for v in verdicts])
    place += np.random.default_rng(0).uniform(-JITTER, JITTER, len(place))
    plot.dots(place, np.where(np.isposinf(values), top, np.where(np.isfinite(values), values, np.nan)), "estimate")
    plot.level(level, f"{level:g}", "limit")
    return plot.svg()
