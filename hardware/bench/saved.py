"""Figures as files: figures.json with the machine, figures.csv with a line each; and figures.json back."""

from __future__ import annotations

import csv
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from hardware.bench.figures import Figure, Target
from hardware.bench.machine import Machine
from hardware.report.summary import finite

COLUMNS = ("what", "value", "unit", "low", "high", "verdict", "reference", "note")


def save(
    folder: Path, subject: str, options: Mapping[str, object], figures: Sequence[Figure], machine: Machine
) -> None:
    """Write figures.json and figures.csv into an existing folder; a number that does not exist is null, or empty."""
    rows = [_row(figure) for figure in figures]
    whole = {
        "subject": subject,
        "options": {
            name: value if isinstance(value, (int, float, bool)) else str(value) for name, value in options.items()
        },
        "machine": asdict(machine),
        "figures": rows,
    }
    (folder / "figures.json").write_text(json.dumps(finite(whole), indent=2) + "\n", encoding="utf-8")
    with (folder / "figures.csv").open("w", newline="", encoding="utf-8") as stream:
        writer = csv.DictWriter(stream, COLUMNS)
        writer.writeheader()
        writer.writerows(finite(rows))


def _row(figure: Figure) -> dict[str, object]:
    low, high = (None, None) if figure.target is None else (figure.target.low, figure.target.high)
    values = (figure.what, figure.value, figure.unit, low, high, figure.verdict, figure.reference, figure.note)
    return dict(zip(COLUMNS, values, strict=True))


def saved_figures(file: Path) -> list[Figure]:
    """The figures that `save` wrote."""
    rows = json.loads(file.read_text(encoding="utf-8"))["figures"]
    return [_figure(row) for row in rows]


def whole_table(parts: Mapping[str, Sequence[Figure]], machine: Machine) -> dict[str, object]:
    """The figures of several subjects, ready for JSON."""
    subjects = {name: [_row(figure) for figure in figures] for name, figures in parts.items()}
    table: dict[str, object] = finite({"machine": asdict(machine), "subjects": subjects})
    return table


def _figure(row: Mapping[str, Any]) -> Figure:
    low, high = row["low"], row["high"]
    target = None
    if row["verdict"]:
        target = Target(-math.inf if low is None else low, math.inf if high is None else high)
    value = math.nan if row["value"] is None else row["value"]
    return Figure(row["what"], value, row["unit"], target, row["reference"], row["note"])
