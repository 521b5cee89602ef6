"""Figures as an aligned table, for a terminal."""

from __future__ import annotations

from collections.abc import Sequence

from hardware.bench.figures import Figure
from hardware.report.summary import figure as digits

HEADER = ("figure", "value", "unit", "target", "", "reference", "note")
RIGHT = HEADER.index("value")  # numbers stand under each other


def table_text(figures: Sequence[Figure]) -> str:
    """The figures, a line each, and a line that counts the missed ones."""
    rows = [HEADER, *map(_row, figures)]
    shown = [i for i in range(len(HEADER)) if any(row[i] for row in rows[1:])]
    widths = {i: max(len(row[i]) for row in rows) for i in shown}
    lines = ["  ".join(_cell(row[i], widths[i], i) for i in shown).rstrip() for row in rows]
    judged = [f for f in figures if f.target is not None]
    missed = sum(f.verdict == "MISSED" for f in judged)
    return "\n".join([*lines, "", f"{len(judged) - missed} of {len(judged)} targets met"])


def _row(figure: Figure) -> tuple[str, ...]:
    target = "" if figure.target is None else str(figure.target)
    return (figure.what, digits(figure.value), figure.unit, target, figure.verdict, figure.reference, figure.note)


def _cell(text: str, width: int, column: int) -> str:
    return text.rjust(width) if column == RIGHT else text.ljust(width)
