"""What campaigns share whose cases are of several kinds: the table of what came of each."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import TypeVar

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
