"""`stillbed bench faults`: seeded faults across the scenarios, in virtual time; what came of each.

A run is a print of one scenario with seven faults, one after the other; the last one ends it. `--log` keeps what came
of each and leaves out the runs that are in it already, so that a campaign may be done in parts.
"""

from __future__ import annotations

import argparse
import csv
import math
import sys
import traceback
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import BrokenExecutor, as_completed
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np

from estimation.errors import InputError, StillbedError
from estimation.se3 import Array
from hardware.bench.campaigns.faults import fault_page
from hardware.bench.fault_draw import PLACES, drawn_faults
from hardware.bench.fault_judge import LATE, SLOW, Verdict, judged
from hardware.bench.fault_run import FaultRun, Stage, stage
from hardware.bench.fault_table import kinds_text
from hardware.bench.figures import Figure, at_least, at_most
from hardware.bench.workers import workers
from hardware.process.clock import ProcessorClock, WallClock
from hardware.process.faults import fault_from_text
from hardware.process.progress import Progress
from perception.package_data import shipped_file

SCENARIOS = ("breathing_calm", "breathing_deep", "breathing_irregular", "hand", "shaking_table_0_1_hz", "still")
SHOWN_BY = "of what pictures show, until the exposure of the pose that said so"
COLUMNS = (
    *("seed", "run", "scenario", "over", "spent_s", "fault", "detected_s", "seen_s", "worst_mm"),
    *("silent", "restless", "recovered_s", "operator"),
)


@dataclass(frozen=True, slots=True)
class Row:
    """One fault of a campaign. over: commands of its run that were beyond a limit. spent: s of processor of its run."""

    seed: int
    run: int
    scenario: str
    over: int
    spent: float
    verdict: Verdict


def run(options: argparse.Namespace) -> list[Figure]:
    """Run the campaign, print what came of each kind, and give the figures of all."""
    for name in ("count", "jobs"):
        if getattr(options, name) < 1:
            raise InputError("command line", f"--{name}", getattr(options, name), ">= 1")
    folder = options.scenarios or shipped_file("scenarios", f"{SCENARIOS[0]}.toml").parent
    rows = read_log(options.log, options.seed) if options.log is not None and options.log.exists() else []
    more, broken = _missing(options, folder, {row.run for row in rows})
    rows += more
    verdicts = [row.verdict for row in rows]
    print(kinds_text(verdicts) + "\n")
    if options.out is not None:
        page = options.out / "faults.html"
        page.write_text(fault_page(verdicts), encoding="utf-8")
        print(f"picture: {page}\n")
    return [*figures(rows), Figure("runs that ended in a traceback", broken, "", at_most(0))]


def _missing(options: argparse.Namespace, folder: Path, done: set[int]) -> tuple[list[Row], int]:
    """What came of the runs that are still to be done, and how many ended in a traceback, which is shown."""
    rows: list[Row] = []
    broken, jobs = 0, [k for k in range(-(-options.count // PLACES)) if k not in done]
    with Progress("faults", "runs", WallClock().now) as progress, workers(options.jobs) as pool:
        waiting = {pool.submit(one_run, folder, options.seed, number): number for number in jobs}
        for count, each in enumerate(as_completed(waiting), 1):
            try:
                found = each.result()
            except (StillbedError, BrokenExecutor):
                raise
            except Exception:  # what is looked for: the other runs go on
                broken, found = broken + 1, []
                print(f"run {waiting[each]}:\n{traceback.format_exc()}", file=sys.stderr, flush=True)
            rows += found
            if options.log is not None and found:
                append_log(options.log, found)
            progress(count, len(jobs))
    return rows, broken


def one_run(folder: Path, seed: int, number: int) -> list[Row]:
    """The faults of one run, those that struck a print."""
    scenario = SCENARIOS[number % len(SCENARIOS)]
    faults, clock = drawn_faults(seed, number), ProcessorClock()
    begun = clock.now()
    ran = FaultRun(_stage(folder / f"{scenario}.toml"), faults, 1000 * seed + number)()
    spent = clock.now() - begun
    ends = [*(fault.start for fault in faults[1:]), ran.ended]
    found = [judged(ran, fault, end) for fault, end in zip(faults, ends, strict=True)]
    return [Row(seed, number, scenario, ran.over, spent, verdict) for verdict in found if verdict is not None]


@lru_cache(maxsize=len(SCENARIOS))
def _stage(file: Path) -> Stage:
    return stage(file)


def append_log(file: Path, rows: Iterable[Row]) -> None:
    """Add rows to a log, with its header where it is new."""
    new = not file.exists()
    with file.open("a", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream)
        if new:
            writer.writerow(COLUMNS)
        for row in rows:
            v = row.verdict
            measured = v.detected, v.seen, v.worst, int(v.silent), int(v.restless), v.recovered, int(v.operator)
            writer.writerow([row.seed, row.run, row.scenario, row.over, row.spent, v.fault, *measured])


def read_log(file: Path, seed: int) -> list[Row]:
    """The rows of a campaign with this seed; InputError where the file is none of ours."""
    with file.open(newline="", encoding="utf-8") as stream:
        return list(_rows(file, csv.DictReader(stream), seed))


def _rows(file: Path, table: csv.DictReader[str], seed: int) -> Iterator[Row]:
    if tuple(table.fieldnames or ()) != COLUMNS:
        raise InputError(file, "header", table.fieldnames, ",".join(COLUMNS))
    for each in table:
        try:
            numbers = [float(each[name]) for name in COLUMNS if name not in ("scenario", "fault")]
        except (TypeError, ValueError):
            raise InputError(file, f"line {table.line_num}", each, "numbers") from None
        own, number, over, spent, detected, seen, worst, silent, restless, recovered, operator = numbers
        if own == seed:
            fault = fault_from_text(file, f"line {table.line_num}", each["fault"])
            flags = bool(silent), bool(restless), recovered, bool(operator)
            yield Row(
                int(own), int(number), each["scenario"], int(over), spent, Verdict(fault, detected, seen, worst, *flags)
            )


def figures(rows: Sequence[Row]) -> list[Figure]:
    """The campaign's figures beside their targets."""
    verdicts = [row.verdict for row in rows]
    runs = {row.run: row for row in rows}
    detected, seen, recovered = (
        _known(getattr(v, name) for v in verdicts) for name in ("detected", "seen", "recovered")
    )
    passing = np.array([v.recovered for v in verdicts if not (math.isnan(v.recovered) or v.operator)])
    soon = float((passing <= SLOW + 1e-9).mean()) if len(passing) else math.nan
    spent = sum(row.spent for row in runs.values())
    note = f"of {len(verdicts)} faults in {len(runs)} runs of {len({row.scenario for row in rows})} scenarios"
    each = spent / max(len(verdicts), 1)
    return [
        Figure("silent failures", sum(v.silent for v in verdicts), "", at_most(0), "", note),
        Figure("commands beyond a limit", sum(row.over for row in runs.values()), "", at_most(0)),
        Figure("arms that moved on while held", sum(v.restless for v in verdicts), "", at_most(0)),
        Figure("largest error while extruding", max((v.worst for v in verdicts), default=math.nan), "mm"),
        Figure("said after, 99 %", _share(seen, 99), "ms", at_most(1000 * LATE), "", SHOWN_BY),
        Figure("said within 100 ms", float((seen <= LATE).mean()) if len(seen) else math.nan, "", None, "", SHOWN_BY),
        Figure("known after, median", _share(detected, 50), "ms", None, "", f"{len(detected)} were said"),
        Figure("known after, 99 %", _share(detected, 99), "ms"),
        Figure("recoverable ones recovered within 200 ms", soon, "", at_least(0.99), "", f"of {len(passing)}"),
        Figure("recovered after, 99 %", _share(recovered, 99), "ms"),
        Figure("needed an operator", sum(v.operator for v in verdicts), ""),
        Figure(
            "processor time of a fault", each, "s", None, "", f"10,000 take {10_000 * each / 3600:.1f} h of one core"
        ),
    ]


def _known(values: Iterable[float]) -> Array:
    found = np.array(list(values), float)
    return np.asarray(found[~np.isnan(found)])


def _share(values: Array, share: float) -> float:
    return 1000 * float(np.percentile(values, share, method="higher")) if len(values) else math.nan
