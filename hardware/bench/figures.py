"""Figures beside their targets, as a table and as files, with the machine; and what the subjects share to measure."""

from __future__ import annotations

import argparse
import csv
import json
import math
import os
import platform
import signal
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import TypeVar

import numpy as np

from estimation.errors import InputError
from estimation.se3 import Array
from hardware.process.clock import WallClock
from hardware.process.progress import Progress
from hardware.process.system import SPAWN, code_commit, exit_with_parent

Item = TypeVar("Item")


@dataclass(frozen=True, slots=True)
class Target:
    """What a figure should be: from `low` to `high`, both included, in the figure's unit."""

    low: float = -math.inf
    high: float = math.inf

    def met(self, value: float) -> bool:
        """Whether `value` lies within; what is not a number does not."""
        return self.low <= value <= self.high

    def __str__(self) -> str:
        """The target in words: <= 0.03, >= 0.93 or 0.8 to 1.25."""
        if math.isinf(self.low):
            return f"<= {self.high:g}"
        return f">= {self.low:g}" if math.isinf(self.high) else f"{self.low:g} to {self.high:g}"


def at_most(value: float) -> Target:
    """A target that is better from below."""
    return Target(high=value)


def at_least(value: float) -> Target:
    """A target that is better from above."""
    return Target(low=value)


CONSISTENT_NEES = Target(0.8, 1.25)  # squared error by the stated covariance, per degree of freedom


@dataclass(frozen=True, slots=True)
class Figure:
    """One measured figure."""

    what: str  # unique within a subject
    value: float  # in `unit`; nan where it could not be measured
    unit: str = ""
    target: Target | None = None  # None for a figure that only informs
    reference: str = ""  # what others reach
    note: str = ""  # how it was measured, or why it is missing

    @property
    def verdict(self) -> str:
        """met, MISSED, or nothing without a target."""
        if self.target is None:
            return ""
        return "met" if self.target.met(self.value) else "MISSED"


LIBRARIES = ("stillbed", "numpy", "scipy", "gtsam", "opencv-python-headless", "toppra", "ruckig")


@dataclass(frozen=True, slots=True)
class Machine:
    """What figures were measured on and with."""

    cpu: str
    cores: int  # that this process may use
    system: str
    commit: str  # of the code, with a + where files differ from it, "" if unknown
    versions: dict[str, str]


def this_machine() -> Machine:
    """What this process runs on and with."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    versions = {"python": platform.python_version(), **{name: _version(name) for name in LIBRARIES}}
    return Machine(_cpu(), cores, platform.platform(), code_commit(), versions)


def _cpu() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:  # not Linux
        lines = []
    models = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return models[0] if models else platform.processor() or platform.machine()


def _version(name: str) -> str:
    try:
        return version(name)
    except PackageNotFoundError:
        return ""


FIGURE_COLUMNS = ("what", "value", "unit", "low", "high", "verdict", "reference", "note")


def save(
    folder: Path, subject: str, options: Mapping[str, object], figures: Sequence[Figure], machine: Machine
) -> None:
    """Write figures.json into an existing folder; a number that does not exist is null."""
    from hardware.report.evaluation import finite

    plain = {name: value if isinstance(value, (int, float, bool)) else str(value) for name, value in options.items()}
    table = {"subject": subject, "options": plain, "machine": asdict(machine), "figures": [*map(_row, figures)]}
    (folder / "figures.json").write_text(json.dumps(finite(table), indent=2) + "\n", encoding="utf-8")


def _row(figure: Figure) -> dict[str, object]:
    target = figure.target or Target()  # infinite bounds are written as none
    values = figure.what, figure.value, figure.unit, target.low, target.high, figure.verdict
    return dict(zip(FIGURE_COLUMNS, (*values, figure.reference, figure.note), strict=True))


def read_figures(file: Path) -> list[Figure]:
    """The figures that `save` wrote."""
    figures, absent = [], {"low": -math.inf, "high": math.inf, "value": math.nan}
    for row in json.loads(file.read_text(encoding="utf-8"))["figures"]:
        low, high, value = (none if row[name] is None else row[name] for name, none in absent.items())
        target = Target(low, high) if row["verdict"] else None
        figures.append(Figure(row["what"], value, row["unit"], target, row["reference"], row["note"]))
    return figures


def whole_text(parts: Mapping[str, Sequence[Figure]], machine: Machine) -> str:
    """The figures of several subjects as JSON, one figure a line, so that a new measurement changes only its lines."""
    from hardware.report.evaluation import finite

    subjects = []
    for name, figures in parts.items():
        lines = ",\n".join(json.dumps(finite(_row(figure))) for figure in figures)
        subjects.append(f"{json.dumps(name)}: [\n{lines}\n]")
    whole = ",\n".join(subjects)
    return f'{{"machine": {json.dumps(finite(asdict(machine)))},\n"subjects": {{\n{whole}\n}}}}\n'


TABLE_HEADER = ("figure", "value", "unit", "target", "", "reference", "note")


def table_text(figures: Sequence[Figure]) -> str:
    """The figures, a line each, and a line that counts the missed ones."""
    from hardware.report.evaluation import figure as digits

    rows: list[tuple[str, ...]] = [TABLE_HEADER]
    for f in figures:
        target = "" if f.target is None else str(f.target)
        rows.append((f.what, digits(f.value), f.unit, target, f.verdict, f.reference, f.note))
    used_columns = [i for i in range(len(TABLE_HEADER)) if any(row[i] for row in rows[1:])]
    text = aligned(
        [[row[i] for i in used_columns] for row in rows], [used_columns.index(1)] if 1 in used_columns else []
    )
    verdicts = [figure.verdict for figure in figures if figure.target is not None]
    return f"{text}\n\n{verdicts.count('met')} of {len(verdicts)} targets met"


def aligned(rows: Sequence[Sequence[str]], right: Collection[int]) -> str:
    """Rows of cells as lines; columns whose number is in `right` hold numbers, which stand under each other."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = []
    for row in rows:
        cells = zip(range(len(row)), row, widths, strict=True)
        lines.append("  ".join(c.rjust(width) if i in right else c.ljust(width) for i, c, width in cells).rstrip())
    return "\n".join(lines)


def write_page(out: Path | None, name: str, page: Callable[[], str], what: str) -> None:
    """Make a page, write it into the output folder, if there is one, and say where it is."""
    if out is not None:
        (out / name).write_text(page(), encoding="utf-8")
        print(f"{what}: {out / name}\n")


def append_rows(file: Path, columns: Sequence[str], rows: Iterable[Sequence[object]]) -> None:
    """Add rows to a CSV file, with its header where it is new."""
    new = not file.exists()
    with file.open("a", newline="", encoding="utf-8") as stream:
        csv.writer(stream).writerows([columns, *rows] if new else rows)


def require_positive(options: argparse.Namespace, *names: str) -> None:
    """InputError where an option is less than 1."""
    for name in names:
        if getattr(options, name) < 1:
            raise InputError("command line", f"--{name}", getattr(options, name), ">= 1")


def rms(values: Array) -> float:
    """Root mean square of all values."""
    return float(np.sqrt(np.mean(np.square(values))))


def percentile(values: Array | Sequence[float], share: float) -> float:
    """The value that `share` % of all lie below; nan where there are none."""
    return float(np.percentile(values, share)) if len(values) else math.nan


def milliseconds(seconds: Array | Sequence[float], share: float) -> float:
    """Percentile, ms, of times in s; nan where there are none."""
    return 1000 * percentile(seconds, share)


def columns(records: Iterable[object], *names: str) -> list[Array]:
    """An array (N, ...) for each field that is named, of N records."""
    rows = list(records)
    return [np.array([getattr(row, name) for row in rows], float) for name in names]


def relative_nees(errors: Array, covariance: Array) -> float:
    """Squared error (N,) by a covariance (N, N), per number."""
    return float(errors @ np.linalg.solve(covariance, errors)) / len(errors)


def with_progress(task: str, unit: str, items: Iterable[Item], count: int) -> Iterator[Item]:
    """The items one by one; stderr shows how many of `count` are done."""
    with Progress(task, unit, WallClock().now) as progress:
        for finished, item in enumerate(items, 1):
            yield item
            progress(finished, count)


@contextmanager
def workers(count: int) -> Iterator[ProcessPoolExecutor]:
    """`count` processes that end with whoever started them, however that ends.

    Where the block is left early, what has not begun is left out; Ctrl-C ends what has, too.
    """
    with ProcessPoolExecutor(count, SPAWN, _end_with_parent) as pool:
        try:
            yield pool
        finally:
            pool.shutdown(cancel_futures=True)


def _end_with_parent() -> None:
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    exit_with_parent()


MEMORY_WARM_UP = 120.0  # s, after which memory counts: key frames are full then, and the libraries' heaps
MEMORY_SPAN = 120.0  # s after those, that tell a growth at least
TOO_SHORT = f"runs of {(MEMORY_WARM_UP + MEMORY_SPAN) / 60:g} min and more tell"


def memory_growth(memory: Sequence[tuple[float, dict[str, float]]]) -> dict[str, tuple[float, float]]:
    """By process, from s and MB each: MB an hour by which it grows once it is warm, and MB in the end.

    Of a run too short to tell the growth is NaN: in its first two minutes tracking takes 5 MB more, and the map's
    process 15, which is no leak.
    """
    settled = [each for each in memory if each[0] > memory[0][0] + MEMORY_WARM_UP]
    stamps = np.array([stamp for stamp, _ in settled])
    if len(settled) < 6 or stamps[-1] < stamps[0] + MEMORY_SPAN:
        return {name: (np.nan, megabytes) for name, megabytes in memory[-1][1].items()} if memory else {}
    growth = {}
    for name in settled[-1][1]:
        megabytes = np.array([each.get(name, np.nan) for _, each in settled])
        known = np.isfinite(megabytes)
        slope = np.polyfit(stamps[known] - stamps[0], megabytes[known], 1)[0] if known.sum() > 5 else np.nan
        growth[name] = float(3600 * slope), float(megabytes[-1])
    return growth


def memory_figures(name: str, memory: Sequence[tuple[float, dict[str, float]]]) -> list[Figure]:
    """Growth of all processes together and its parts, by least squares, and their size in the end; of s and MB each."""
    growth = memory_growth(memory)
    slope, size = (sum(each[k] for each in growth.values()) if growth else np.nan for k in (0, 1))
    note, target = TOO_SHORT, None
    if np.isfinite(slope):
        slopes = ", ".join(f"{process} {by:+.1f}" for process, (by, _) in growth.items())
        note, target = f"{slopes}; without the first {MEMORY_WARM_UP / 60:g} min", at_most(5)
    return [
        Figure(f"{name}: memory grows", slope, "MB/h", target, "", note),
        Figure(f"{name}: memory", size, "MB"),
    ]
