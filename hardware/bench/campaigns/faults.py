"""`stillbed bench faults`: seeded faults across the scenarios, in virtual time; what came of each.

A run is a print of one scenario with seven faults, one after the other; the last one ends it. `--log` keeps what came
of each and leaves out the runs that are in it already, so that a campaign may be done in parts.
"""

from __future__ import annotations

import argparse
import math
import sys
import traceback
from collections.abc import Iterable, Sequence
from concurrent.futures import BrokenExecutor, as_completed
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise
from pathlib import Path

import numpy as np

from estimation.errors import InputError, StillbedError
from estimation.se3 import Array
from hardware.bench.fault_run import (
    FAULT_FREE_S,
    FAULTS_A_RUN,
    FaultRun,
    FaultRunRecord,
    RowFlags,
    draw_faults,
    nozzle_speeds,
    prepare_scenario,
)
from hardware.bench.figures import (
    Figure,
    aligned,
    append_rows,
    at_least,
    at_most,
    log_rows,
    require_positive,
    with_progress,
    workers,
    write_page,
)
from hardware.process.clock import ProcessorClock
from hardware.process.faults import FAULT_SPECS, Fault, FaultKind, FaultPart, fault_from_text
from hardware.report.page import Plot, document, figures_table, section
from perception.package_data import shipped_file

MAX_ERROR_MM = 1.0  # mm: the largest error that a print may have while it extrudes
USUAL_ERROR_FACTOR = (
    1.5  # times the largest error of the same run before anything went wrong: what a scenario has anyway
)
DETECTION_TIME = 0.1  # s: an error that lasts for less is what detection may take
REST_AFTER_MOVE = 0.25  # s from the last move until the arm must rest: what is queued, its lag, and what an echo takes
STILL_SPEED = 1.0  # mm/s
MIN_HOLD = 0.4  # s of a hold that is looked at
MIN_WATCHED = 1.2  # s after its beginning that must have been watched
MAX_DETECTION, MAX_RECOVERY = 0.1, 0.2  # s: targets of detection, and of going on once the cause is gone
VISIBLE_PARTS = (
    FaultPart.CAMERA,
    FaultPart.SURFACE,
)  # by pictures; the stamp of a pose tells nothing of an arm or a process


@dataclass(frozen=True, slots=True)
class FaultVerdict:
    """What came of one fault; times in s, NaN where there is nothing to tell."""

    fault: Fault
    detected: float  # from its beginning until the motion, or the conducting process, said something
    seen: float  # of what pictures show, until the exposure of the pose that said so; of all else, detected
    worst: float  # mm, the largest error while extruding from then on, 0 where nothing was
    silent: bool  # too far off while extruding, and nobody said anything
    restless: bool  # it held, and the arm moved
    recovered: float  # from the end of the cause until moves go out and nothing is to be said; inf: never
    operator: bool  # whether an operator was needed


def judge_fault(ran: FaultRunRecord, fault: Fault, until: float) -> FaultVerdict | None:
    """The verdict on one fault of a run, `until`, s, the next one begins; None where nothing was printed before it."""
    assert ran.log is not None
    spoken = sorted(ran.words + ran.missed, key=lambda word: word.stamp)
    log, stamps = ran.log, np.array([word.stamp for word in spoken])
    said, moving, own = np.array([(bool(word.said), word.moving, word.own) for word in spoken]).reshape(-1, 3).T
    ready = (stamps >= fault.start - 0.3) & (stamps < fault.start)
    if not ready.any() or not moving[ready].all() or said[ready].any() or ran.ended < fault.start + MIN_WATCHED:
        return None
    error = np.linalg.norm((log.base_from_nozzle - log.base_from_target)[:, :3, 3], axis=1)
    error[~log.extrude] = np.nan
    usual = float(np.nanmax(np.append(error[log.stamps < FAULT_FREE_S], 0.0)))
    during, words = (log.stamps >= fault.start) & (log.stamps < until), (stamps >= fault.start) & (stamps < until)
    first = np.flatnonzero(words & said)
    detected = seen = float(stamps[first[0]] - fault.start) if len(first) else np.nan
    if len(first) and fault.part in VISIBLE_PARTS:
        seen = max(spoken[first[0]].seen - fault.start, 0.0)
    return FaultVerdict(
        fault=fault,
        detected=detected,
        seen=seen,
        worst=float(np.nanmax(np.append(error[during], 0.0))),
        silent=_silent(log.stamps, error, during, stamps[words & said], usual),
        restless=_restless(ran, stamps[words], (moving | own)[words], log.stamps),
        recovered=_recovered(stamps[words], said[words] | ~moving[words], fault),
        operator=any(fault.start <= stamp < until for stamp in ran.stopped),
    )


def _silent(stamps: Array, error: Array, during: RowFlags, said: Array, usual: float) -> bool:
    """Whether the error was too large for longer than DETECTION_TIME, and nothing was said then or just before."""
    wrong = stamps[during & (error > max(MAX_ERROR_MM, USUAL_ERROR_FACTOR * usual))]
    if not len(wrong):
        return False
    breaks = np.flatnonzero(np.diff(wrong) > DETECTION_TIME / 2)
    for stretch in np.split(wrong, breaks + 1):
        near = (said >= stretch[0] - DETECTION_TIME) & (said <= stretch[0] + DETECTION_TIME)
        if stretch[-1] - stretch[0] > DETECTION_TIME and not near.any():
            return True
    return False


def _restless(ran: FaultRunRecord, stamps: Array, moving: RowFlags, rows: Array) -> bool:
    """Whether the arm moved while no move was sent for so long that it must have come to rest."""
    assert ran.log is not None
    speed, edges = nozzle_speeds(ran.log), np.concatenate([stamps[:1], stamps[moving], stamps[-1:]])
    for last, following in pairwise(edges.tolist()):
        if following - last > MIN_HOLD:
            still = (rows > last + REST_AFTER_MOVE) & (rows < following - 0.02)
            if still.any() and speed[still].max() > STILL_SPEED:
                return True
    return False


def _recovered(stamps: Array, disturbed: RowFlags, fault: Fault) -> float:
    """From the end of the cause until the first tick of 0.1 s without a word or a hold."""
    if fault.kind is FaultKind.KILL or not np.isfinite(fault.duration) or fault.part is FaultPart.CLOCK:
        return np.nan
    late = (
        fault.amount if fault.kind is FaultKind.SLOW and fault.part is FaultPart.CAMERA else 0.0
    )  # what is on its way
    after = stamps >= fault.end + late
    quiet = (
        s for s in stamps[after & ~disturbed] if not disturbed[(stamps >= s) & (stamps < s + DETECTION_TIME)].any()
    )
    return max(float(next(quiet, np.inf) - fault.end - late), 0.0)


KIND_HEADER = (
    *("fault", "count", "silent", "said %", "said ms", "99 %", "known ms", "99 %", "worst mm", "restless"),
    *("back ms", "max", "late", "operator"),
)


def fault_table(verdicts: Sequence[FaultVerdict]) -> str:
    """A line for each kind and one for all; times are in ms, medians first, `inf` for what never came.

    said, known: as `Verdict.seen` and `Verdict.detected`. late: how many came back after more than `MAX_RECOVERY`.
    """
    return aligned([KIND_HEADER, *rows_by_kind(verdicts)], range(1, len(KIND_HEADER)))


def rows_by_kind(verdicts: Sequence[FaultVerdict]) -> list[tuple[str, ...]]:
    """The cells of the table but for its header."""
    groups = {f"{part} {kind}": list[FaultVerdict]() for part, kind in FAULT_SPECS}
    for verdict in verdicts:
        groups[_kind(verdict)].append(verdict)
    rows = [_row(name, group) for name, group in groups.items() if group]
    return [*rows, _row("all", verdicts)] if verdicts else rows


def _row(name: str, verdicts: Sequence[FaultVerdict]) -> tuple[str, ...]:
    seen, detected, back = (_finite(verdicts, field) for field in ("seen", "detected", "recovered"))
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
        str(int((back > MAX_RECOVERY + 1e-9).sum())),
        str(sum(v.operator for v in verdicts)),
    )


def _finite(verdicts: Sequence[FaultVerdict], field: str) -> Array:
    values = np.array([getattr(v, field) for v in verdicts], float)
    return np.asarray(values[~np.isnan(values)])


def _times(seconds: Array, share: float) -> tuple[str, str]:
    """Median and percentile, ms, of what is there."""
    return (f"{1000 * np.median(seconds):.0f}", f"{_share(seconds, share):.0f}") if len(seconds) else ("-", "-")


def _share(seconds: Array, share: float) -> float:
    return 1000 * float(np.percentile(seconds, share, method="higher")) if len(seconds) else math.nan


DOT_JITTER = 0.3  # of a kind's row, so that dots do not hide each other


def fault_page(verdicts: Sequence[FaultVerdict]) -> str:
    """The table, and a dot for each fault: said after, error while extruding, back after."""
    lead = f"{sum(v.silent for v in verdicts)} of {len(verdicts)} faults did harm in silence."
    present = [f"{part} {kind}" for part, kind in FAULT_SPECS if f"{part} {kind}" in set(map(_kind, verdicts))]
    explained = "; ".join(f"{i + 1} {name}" for i, name in enumerate(present))
    table = figures_table(KIND_HEADER, rows_by_kind(verdicts), last_total=True)
    said = (
        "Times in ms, median first. said %: share that was told; said ms: until the exposure of the pose that said so, "
        "of what pictures do not show until somebody did; known: until somebody did; worst: the largest error while "
        "extruding; back: until moves went out again; late: those that took more than 200 ms."
    )
    body = [section("What came of each kind", said, table)]
    for title, field, unit, level in (
        ("Said after", "seen", "s", MAX_DETECTION),
        ("Largest error while extruding", "worst", "mm", MAX_ERROR_MM),
        ("Going on again after its end", "recovered", "s", MAX_RECOVERY),
    ):
        values = np.array([getattr(v, field) for v in verdicts])
        plot = _dots(verdicts, present, values, f"{title.lower()}, {unit}", level)
        body.append(section(title, f"A dot for each fault, by kind: {explained}.", plot))
    footer = "A print in virtual time; the operator arms it again where it stops."
    return document("bench", "faults", lead, body, footer)


def _kind(verdict: FaultVerdict) -> str:
    return f"{verdict.fault.part} {verdict.fault.kind}"


def _dots(verdicts: Sequence[FaultVerdict], present: Sequence[str], values: Array, label: str, level: float) -> str:
    """One dot for each fault, kinds side by side; what never came stands at the top."""
    finite = values[np.isfinite(values)]
    top = max(float(finite.max(initial=0.0)), level) * 1.15
    plot = Plot(900, 230, (0.5, len(present) + 0.5), (0.0, top), label=label)
    place = np.array([1.0 + present.index(_kind(v)) for v in verdicts])
    place += np.random.default_rng(0).uniform(-DOT_JITTER, DOT_JITTER, len(place))
    plot.dots(place, np.where(np.isposinf(values), top, np.where(np.isfinite(values), values, np.nan)), "estimate")
    plot.level(level, f"{level:g}", "limit")
    return plot.svg()


SCENARIOS = ("breathing_calm", "breathing_deep", "breathing_irregular", "hand", "shaking_table_0_1_hz", "still")
prepared = lru_cache(maxsize=len(SCENARIOS))(prepare_scenario)
SEEN_NOTE = "of what pictures show, until the exposure of the pose that said so"
FAULT_LOG_COLUMNS = (
    *("seed", "run", "scenario", "over", "spent_s", "fault", "detected_s", "seen_s", "worst_mm"),
    *("silent", "restless", "recovered_s", "operator"),
)


@dataclass(frozen=True, slots=True)
class FaultRow:
    """One fault of a campaign."""

    seed: int
    run: int
    scenario: str
    over: int  # commands of its run that were beyond a limit
    spent: float  # s of processor of its run
    verdict: FaultVerdict


def run_faults(options: argparse.Namespace) -> list[Figure]:
    """Run the campaign, print what came of each kind, and give the figures of all."""
    require_positive(options, "count", "jobs")
    folder = options.scenarios or shipped_file("scenarios", f"{SCENARIOS[0]}.toml").parent
    rows = read_log(options.log, options.seed) if options.log is not None and options.log.exists() else []
    more, broken = _missing(options, folder, {row.run for row in rows})
    rows += more
    verdicts = [row.verdict for row in rows]
    print(fault_table(verdicts) + "\n")
    write_page(options.out, "faults.html", lambda: fault_page(verdicts), "picture")
    return [*fault_figures(rows), Figure("runs that ended in a traceback", broken, "", at_most(0))]


def _missing(options: argparse.Namespace, folder: Path, done: set[int]) -> tuple[list[FaultRow], int]:
    """What came of the runs that are still to be done, and how many ended in a traceback, which is shown."""
    rows: list[FaultRow] = []
    broken, jobs = 0, [k for k in range(-(-options.count // FAULTS_A_RUN)) if k not in done]
    with workers(options.jobs) as pool:
        waiting = {pool.submit(one_run, folder, options.seed, number): number for number in jobs}
        for each in with_progress("faults", "runs", as_completed(waiting), len(jobs)):
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
    return rows, broken


def one_run(folder: Path, seed: int, number: int) -> list[FaultRow]:
    """The faults of one run, those that struck a print."""
    scenario = SCENARIOS[number % len(SCENARIOS)]
    faults, clock = draw_faults(seed, number), ProcessorClock()
    begun = clock.now()
    ran = FaultRun(prepared(folder / f"{scenario}.toml"), faults, 1000 * seed + number)()
    spent = clock.now() - begun
    ends = [*(fault.start for fault in faults[1:]), ran.ended]
    found = [judge_fault(ran, fault, end) for fault, end in zip(faults, ends, strict=True)]
    return [FaultRow(seed, number, scenario, ran.over, spent, verdict) for verdict in found if verdict is not None]


def append_log(file: Path, rows: Iterable[FaultRow]) -> None:
    """Add rows to a log, with its header where it is new."""
    append_rows(file, FAULT_LOG_COLUMNS, map(_log_row, rows))


def _log_row(row: FaultRow) -> list[object]:
    v = row.verdict
    measured = v.detected, v.seen, v.worst, int(v.silent), int(v.restless), v.recovered, int(v.operator)
    return [row.seed, row.run, row.scenario, row.over, row.spent, v.fault, *measured]


def read_log(file: Path, seed: int) -> list[FaultRow]:
    """The rows of a campaign with this seed; InputError where the file is none of ours."""
    rows = []
    for number, each in log_rows(file, FAULT_LOG_COLUMNS):
        try:
            numbers = [float(each[name]) for name in FAULT_LOG_COLUMNS if name not in ("scenario", "fault")]
        except (TypeError, ValueError):
            raise InputError(file, f"line {number}", each, "numbers") from None
        own, run, over, spent, detected, seen, worst, silent, restless, recovered, operator = numbers
        if own == seed:
            fault = fault_from_text(file, f"line {number}", each["fault"])
            came = FaultVerdict(fault, detected, seen, worst, bool(silent), bool(restless), recovered, bool(operator))
            rows.append(FaultRow(int(own), int(run), each["scenario"], int(over), spent, came))
    return rows


def fault_figures(rows: Sequence[FaultRow]) -> list[Figure]:
    """The campaign's figures beside their targets."""
    verdicts = [row.verdict for row in rows]
    runs = {row.run: row for row in rows}
    detected, seen, recovered = (_finite(verdicts, name) for name in ("detected", "seen", "recovered"))
    passing = np.array([v.recovered for v in verdicts if not (math.isnan(v.recovered) or v.operator)])
    soon = float((passing <= MAX_RECOVERY + 1e-9).mean()) if len(passing) else math.nan
    each = sum(row.spent for row in runs.values()) / max(len(verdicts), 1)
    note = f"of {len(verdicts)} faults in {len(runs)} runs of {len({row.scenario for row in rows})} scenarios"
    all_day = f"10,000 take {10_000 * each / 3600:.1f} h of one core"
    return [
        Figure("silent failures", sum(v.silent for v in verdicts), "", at_most(0), "", note),
        Figure("commands beyond a limit", sum(row.over for row in runs.values()), "", at_most(0)),
        Figure("arms that moved on while held", sum(v.restless for v in verdicts), "", at_most(0)),
        Figure("largest error while extruding", max((v.worst for v in verdicts), default=math.nan), "mm"),
        Figure("said after, 99 %", _share(seen, 99), "ms", at_most(1000 * MAX_DETECTION), "", SEEN_NOTE),
        Figure(
            "said within 100 ms",
            float((seen <= MAX_DETECTION).mean()) if len(seen) else math.nan,
            "",
            None,
            "",
            SEEN_NOTE,
        ),
        Figure("known after, median", _share(detected, 50), "ms", None, "", f"{len(detected)} were said"),
        Figure("known after, 99 %", _share(detected, 99), "ms"),
        Figure("recoverable ones recovered within 200 ms", soon, "", at_least(0.99), "", f"of {len(passing)}"),
        Figure("recovered after, 99 %", _share(recovered, 99), "ms"),
        Figure("needed an operator", sum(v.operator for v in verdicts), ""),
        Figure("processor time of a fault", each, "s", None, "", all_day),
    ]
