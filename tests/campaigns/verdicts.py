"""What campaigns share whose cases are of several kinds: the table of what came of each, and their logs read back."""

from __future__ import annotations

import csv
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import TypeVar

from estimation.errors import InputError
from hardware.bench.figures import aligned

Verdict = TypeVar("Verdict")


def kind_table(
    header: Sequence[str],
    judged: Iterable[tuple[str, Verdict]],
    row: Callable[[Sequence[Verdict]], Sequence[str]],
    kinds: Iterable[str] = (),
) -> str:
    """A line for each kind that came, and one for all of them.

    header: the first column's is the kind's. judged: kind and verdict of each case. row: the other cells of a group.
    kinds: in the order of the table; those not named follow as they come.
    """
    groups: dict[str, list[Verdict]] = {kind: [] for kind in kinds}
    every = groups.setdefault("all", [])
    for kind, verdict in judged:
        groups.setdefault(kind, []).append(verdict)
        every.append(verdict)
    lines = [(name, *row(group)) for name, group in groups.items() if group and group is not every]
    return aligned([header, *lines, *([("all", *row(every))] if every else [])], range(1, len(header)))


def log_rows(file: Path, columns: Sequence[str]) -> Iterator[tuple[int, dict[str, str]]]:
    """Line number and cells of each row that `append_rows` wrote; InputError where the file has another header."""
    with file.open(newline="", encoding="utf-8") as stream:
        table = csv.DictReader(stream)
        if tuple(table.fieldnames or ()) != tuple(columns):
            raise InputError(file, "header", table.fieldnames, ",".join(columns))
        for row in table:
            yield table.line_num, row
