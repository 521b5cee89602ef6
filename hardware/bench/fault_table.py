"""What came of faults, kind by kind, as a table for the terminal."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from estimation.se3 import Array
from hardware.bench.fault_judge import Verdict
from hardware.faults import SPECS

HEADER = ("fault", "count", "silent", "said", "known ms", "max", "worst mm", "restless", "back ms", "max", "operator")


def kinds_text(verdicts: Sequence[Verdict]) -> str:
    """A line for each kind and one for all; times are median and largest, in ms, `inf` for what never came."""
    rows = [HEADER, *rows_by_kind(verdicts)]
    widths = [max(len(row[i]) for row in rows) for i in range(len(HEADER))]
    return "\n".join(
        "  ".join(c.ljust(w) if i == 0 else c.rjust(w) for i, (c, w) in enumerate(zip(row, widths, strict=True)))
        for row in rows
    )


def rows_by_kind(verdicts: Sequence[Verdict]) -> list[tuple[str, ...]]:
    """The cells of the table but for its header."""
    groups = {
        f"{part} {kind}": [v for v in verdicts if (v.fault.part, v.fault.kind) == (part, kind)] for part, kind in SPECS
    }
    rows = [_row(name, mine) for name, mine in groups.items() if mine]
    return [*rows, _row("all", verdicts)] if verdicts else rows


def _row(name: str, verdicts: Sequence[Verdict]) -> tuple[str, ...]:
    detected, back = (np.array([getattr(v, field) for v in verdicts]) for field in ("detected", "recovered"))
    return (
        name,
        str(len(verdicts)),
        str(sum(v.silent for v in verdicts)),
        f"{100 * (~np.isnan(detected)).mean():.0f} %",
        *_times(detected),
        f"{max(v.worst for v in verdicts):.2f}",
        str(sum(v.restless for v in verdicts)),
        *_times(back),
        str(sum(v.operator for v in verdicts)),
    )


def _times(seconds: Array) -> tuple[str, str]:
    known = seconds[~np.isnan(seconds)]
    return ("-", "-") if not len(known) else (f"{1000 * np.median(known):.0f}", f"{1000 * known.max():.0f}")
