"""What came of faults, kind by kind, as a table for the terminal."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from estimation.se3 import Array
from hardware.bench.fault_judge import SLOW, Verdict
from hardware.process.faults import SPECS

HEADER = (
    *("fault", "count", "silent", "said %", "said ms", "99 %", "known ms", "99 %", "worst mm", "restless"),
    *("back ms", "max", "late", "operator"),
)


def kinds_text(verdicts: Sequence[Verdict]) -> str:
    """A line for each kind and one for all; times are in ms, medians first, `inf` for what never came.

    said, known: as `Verdict.seen` and `Verdict.detected`. late: how many came back after more than `SLOW`.
    """
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
    seen, detected, back = (_known(verdicts, field) for field in ("seen", "detected", "recovered"))
    return (
        name,
        str(len(verdicts)),
        str(sum(v.silent for v in verdicts)),
        f"{100 * len(detected) / len(verdicts):.0f}",
        *_times(seen, 99),
        *_times(detected, 99),
        f"{max(v.worst for v in verdicts):.2f}",
        str(sum(v.restless for v in verdicts)),
        *_times(back, 100),
        str(int((back > SLOW + 1e-9).sum())),
        str(sum(v.operator for v in verdicts)),
    )


def _known(verdicts: Sequence[Verdict], field: str) -> Array:
    values = np.array([getattr(v, field) for v in verdicts], float)
    return np.asarray(values[~np.isnan(values)])


def _times(seconds: Array, share: float) -> tuple[str, str]:
    if not len(seconds):
        return "-", "-"
    return f"{1000 * np.median(seconds):.0f}", f"{1000 * np.percentile(seconds, share, method='higher'):.0f}"
