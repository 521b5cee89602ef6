"""`python -m tests.campaigns faults`: seeded faults across the scenarios, in virtual time, and a verdict on each.

A run is a print of one scenario with seven faults, one after the other; the last one ends it. `--log` records the
verdicts; runs that are in it already are left out, so that a campaign may be done in parts.
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
from numpy.typing import NDArray

from estimation.errors import InputError, StillbedError
from estimation.se3 import Array
from hardware.bench import figures
from hardware.bench.figures import Figure, at_least, at_most, columns, with_progress, workers
from hardware.bench.loop_run import prepare_scenario
from hardware.process.clock import ProcessorClock
from hardware.process.faults import FAULT_SPECS, Fault, FaultKind, FaultPart, FaultRunner, fault_from_text
from hardware.simulator.deposit import NozzleLog
from perception import shipped_file
from tests.campaigns.verdicts import kind_table, log_rows
from tests.fault_run import FaultRun, FaultRunRecord

RowFlags = NDArray[np.bool_]

FAULT_FREE_S = 3.0  # nothing goes wrong until then
FAULT_SPACING, FAULTS_A_RUN = 2.6, 7  # s from one fault to the next, and faults of a run
MIN_DURATION, MAX_DURATION = 0.15, 1.0  # s: long enough to have an effect, short enough to be over before the next
FAULT_AMOUNTS = {  # of what has one, uniform in the logarithm
    (FaultPart.CAMERA, FaultKind.SLOW): (0.03, 0.3),  # s
    (FaultPart.CAMERA, FaultKind.BUMP): (2.0, 10.0),  # mm: what is less is no harm to three cameras
    (FaultPart.CLOCK, FaultKind.JUMP): (0.05, 5.0),  # s
    (FaultPart.TRACKING, FaultKind.SLOW): (5.0, 60.0),  # %
    (FaultPart.ARM, FaultKind.SLOW): (30.0, 90.0),  # %
    (FaultPart.SURFACE, FaultKind.FAST): (30.0, 200.0),  # mm/s
    (FaultPart.SURFACE, FaultKind.FOLD): (0.5, 5.0),  # mm
    (FaultPart.DISPENSER, FaultKind.CLOG): (20.0, 100.0),  # %
}
CAMPAIGN_KINDS = [key for key, spec in FAULT_SPECS.items() if FaultRunner.SIMULATE in spec.runners]
ENDING_KINDS = [key for key in CAMPAIGN_KINDS if key[1] is FaultKind.KILL]  # after which a run cannot go on
PASSING_KINDS = [key for key in CAMPAIGN_KINDS if key not in ENDING_KINDS]


def draw_faults(seed: int, number: int) -> list[Fault]:
    """The faults of a campaign's run; kinds take turns from run to run."""
    rng = np.random.default_rng([seed, number, 83])
    first = number * (FAULTS_A_RUN - 1)
    keys = [PASSING_KINDS[k % len(PASSING_KINDS)] for k in range(first, first + FAULTS_A_RUN - 1)]
    keys.append(ENDING_KINDS[number % len(ENDING_KINDS)])
    return [_fault(key, FAULT_FREE_S + FAULT_SPACING * place, rng) for place, key in enumerate(keys)]


def _fault(key: tuple[FaultPart, FaultKind], slot: float, rng: np.random.Generator) -> Fault:
    def draw(low: float, high: float) -> float:
        return round(float(np.exp(rng.uniform(np.log(low), np.log(high)))), 3)

    start = round(slot + float(rng.uniform(0.0, 0.4)), 3)
    duration = draw(MIN_DURATION, MAX_DURATION)
    amount = draw(*FAULT_AMOUNTS[key]) if key in FAULT_AMOUNTS else 0.0
    if key == (FaultPart.CLOCK, FaultKind.JUMP):
        amount *= float(rng.choice([-1.0, 1.0]))
    if key[1] is FaultKind.KILL:
        duration = np.inf
    if key in ((FaultPart.ARM, FaultKind.DROP), (FaultPart.ARM, FaultKind.GARBLE)) and rng.random() < 0.5:
        duration = 0.0
    number = int(rng.integers(3)) if key[0] is FaultPart.CAMERA else 0
    return Fault(*key, start, duration, amount, number, int(rng.integers(10**6)))


MAX_ERROR_MM = 1.0  # mm: the largest error that a print may have while it extrudes
USUAL_ERROR_FACTOR = 1.5  # times the run's largest error before its first fault: what the scenario has anyway
DETECTION_TIME = 0.1  # s: an error that lasts for less is what detection may take
REST_AFTER_MOVE = 0.25  # s from the last move until the arm must rest: what is queued, its lag, and what an echo takes
STILL_SPEED = 1.0  # mm/s
MIN_HOLD = 0.4  # s: holds that are shorter are not judged
MIN_WATCHED = 1.2  # s for which the run must have gone on after a fault's beginning
MAX_DETECTION, MAX_RECOVERY = 0.1, 0.2  # s: targets of detection, and of going on once the cause is gone
VISIBLE_PARTS = FaultPart.CAMERA, FaultPart.SURFACE  # by pictures: a pose's stamp dates no fault of arm or process


@dataclass(frozen=True, slots=True)
class FaultVerdict:
    """What one fault led to; times in s, NaN where there is none."""

    fault: Fault
    detected: float  # from its beginning until the motion or the main process reported something
    exposure: float  # of VISIBLE_PARTS, until the exposure of the pose that led to the report; of all else, detected
    worst: float  # mm, the largest error while extruding from then on, 0 where nothing was
    silent: bool  # too large an error while extruding, and no report
    restless: bool  # it held, and the arm moved
    recovered: float  # from the end of the cause until moves go out and nothing is reported; inf: never
    operator: bool  # whether an operator was needed


def judge_fault(run: FaultRunRecord, fault: Fault, until: float) -> FaultVerdict | None:
    """The verdict on one fault of a run, `until`, s, the next one begins; None where nothing was printed before it."""
    assert run.log is not None
    statements = sorted(run.statements + run.timeouts, key=lambda statement: statement.stamp)
    log, stamps = run.log, np.array([statement.stamp for statement in statements])
    report, moving, own = np.array([(bool(s.text), s.moving, s.own) for s in statements]).reshape(-1, 3).T
    ready = (stamps >= fault.start - 0.3) & (stamps < fault.start)
    if not ready.any() or not moving[ready].all() or report[ready].any() or run.end < fault.start + MIN_WATCHED:
        return None
    error = np.linalg.norm((log.base_from_nozzle - log.base_from_target)[:, :3, 3], axis=1)
    error[~log.extrude] = np.nan
    usual = float(np.nanmax(np.append(error[log.stamps < FAULT_FREE_S], 0.0)))
    during, rows = (log.stamps >= fault.start) & (log.stamps < until), (stamps >= fault.start) & (stamps < until)
    first = np.flatnonzero(rows & report)
    detected = exposure = float(stamps[first[0]] - fault.start) if len(first) else np.nan
    if len(first) and fault.part in VISIBLE_PARTS:
        exposure = max(statements[first[0]].pose_stamp - fault.start, 0.0)
    wrong = log.stamps[during & (error > max(MAX_ERROR_MM, USUAL_ERROR_FACTOR * usual))]
    return FaultVerdict(
        fault=fault,
        detected=detected,
        exposure=exposure,
        worst=float(np.nanmax(np.append(error[during], 0.0))),
        silent=_silent(wrong, stamps[rows & report]),
        restless=_restless(log, stamps[rows], (moving | own)[rows]),
        recovered=_recovered(stamps[rows], report[rows] | ~moving[rows], fault),
        operator=any(fault.start <= stamp < until for stamp in (*run.stops, *run.service_times)),
    )


def _silent(wrong: Array, reports: Array) -> bool:
    """Whether errors, at `wrong` s, last for longer than DETECTION_TIME without a report, s, then or just before."""
    if not len(wrong):
        return False
    for stretch in np.split(wrong, np.flatnonzero(np.diff(wrong) > DETECTION_TIME / 2) + 1):
        near = (reports >= stretch[0] - DETECTION_TIME) & (reports <= stretch[0] + DETECTION_TIME)
        if stretch[-1] - stretch[0] > DETECTION_TIME and not near.any():
            return True
    return False


def _restless(log: NozzleLog, stamps: Array, moving: RowFlags) -> bool:
    """Whether the arm moved while no move was sent for so long that it must have come to rest."""
    places = log.base_from_nozzle[:, :3, 3]
    speed = np.zeros(len(log))  # mm/s, over 10 ms
    steps = np.linalg.norm(places[10:] - places[:-10], axis=1)
    speed[10:] = steps / np.maximum(log.stamps[10:] - log.stamps[:-10], 1e-9)
    for last, following in pairwise(np.concatenate([stamps[:1], stamps[moving], stamps[-1:]]).tolist()):
        still = (log.stamps > last + REST_AFTER_MOVE) & (log.stamps < following - 0.02)
        if following - last > MIN_HOLD and still.any() and speed[still].max() > STILL_SPEED:
            return True
    return False


def _recovered(stamps: Array, disturbed: RowFlags, fault: Fault) -> float:
    """From the end of the cause until the first tick of 0.1 s without a report or a hold."""
    if fault.kind is FaultKind.KILL or not np.isfinite(fault.duration) or fault.part is FaultPart.CLOCK:
        return np.nan
    delay = fault.amount if fault.kind is FaultKind.SLOW and fault.part is FaultPart.CAMERA else 0.0  # of frames
    for stamp in stamps[(stamps >= fault.end + delay) & ~disturbed]:
        if not disturbed[(stamps >= stamp) & (stamps < stamp + DETECTION_TIME)].any():
            return max(float(stamp - fault.end - delay), 0.0)
    return np.inf


KINDS = [f"{part} {kind}" for part, kind in FAULT_SPECS]
KIND_HEADER = (
    *("fault", "count", "silent", "said %", "said ms", "99 %", "known ms", "99 %", "worst mm", "restless"),
    *("back ms", "max", "late", "operator"),
)


def fault_table(verdicts: Sequence[FaultVerdict]) -> str:
    """A line for each kind and one for all; times are in ms, medians first, `inf` for what never came.

    said, known: `exposure` and `detected` of the verdicts. late: how many recovered after more than `MAX_RECOVERY`.
    """
    return kind_table(KIND_HEADER, [(f"{v.fault.part} {v.fault.kind}", v) for v in verdicts], _row, KINDS)


def _row(verdicts: Sequence[FaultVerdict]) -> tuple[str, ...]:
    exposure, detected, back = _times_of(verdicts)
    silent, restless, operator = (str(sum(getattr(v, n) for v in verdicts)) for n in ("silent", "restless", "operator"))
    share, worst = f"{100 * len(detected) / len(verdicts):.0f}", f"{max(v.worst for v in verdicts):.2f}"
    late = str(int((back > MAX_RECOVERY + 1e-9).sum()))
    counts = (str(len(verdicts)), silent, share)
    times = (*_times(exposure, 99), *_times(detected, 99), worst, restless, *_times(back, 100))
    return (*counts, *times, late, operator)


def _times_of(verdicts: Sequence[FaultVerdict]) -> list[Array]:
    """exposure, detected and recovered, s, where there is one."""
    return [values[~np.isnan(values)] for values in columns(verdicts, "exposure", "detected", "recovered")]


def _times(seconds: Array, share: float) -> tuple[str, str]:
    """Median and percentile, ms, of what is there."""
    return (f"{1000 * np.median(seconds):.0f}", f"{_share(seconds, share):.0f}") if len(seconds) else ("-", "-")


def _share(seconds: Array, share: float) -> float:
    return 1000 * float(np.percentile(seconds, share, method="higher")) if len(seconds) else math.nan


SCENARIOS = ("breathing_calm", "breathing_deep", "breathing_irregular", "hand", "shaking_table_0_1_hz", "still")
prepared = lru_cache(maxsize=len(SCENARIOS))(prepare_scenario)
MAX_LEFT_OPEN = 0.1  # s: the dispenser's watchdog
NOT_PRINTING = "the last command sent is no move that prints, or the arm is not armed"
LEFT_OPEN = "its line or the motion process was gone: its watchdog closes it"
EXPOSURE_NOTE = "of what pictures show, until the exposure of the pose that said so"
FAULT_LOG_COLUMNS = (
    *("seed", "run", "scenario", "over", "spent_s", "fault", "detected_s", "seen_s", "worst_mm"),
    *("silent", "restless", "recovered_s", "operator", "told_outside_s", "left_open_s"),
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
    told_outside: float = 0.0  # s of its run in which a dispenser was told to be open while no sent move printed
    left_open: float = 0.0  # s for which a dispenser stayed open at most in its run, when nobody could tell it anything


def run_faults(options: argparse.Namespace) -> list[Figure]:
    """Run the campaign, print the table of all kinds, and give the figures of all."""
    figures.require_positive(options, "count", "jobs")
    rows = read_log(options.log, options.seed) if options.log is not None and options.log.exists() else []
    done = {row.run for row in rows}
    broken, jobs = 0, [k for k in range(-(-options.count // FAULTS_A_RUN)) if k not in done]
    with workers(options.jobs) as pool:
        waiting = {pool.submit(one_run, options.seed, number): number for number in jobs}
        for job in with_progress("faults", "runs", as_completed(waiting), len(jobs)):
            try:
                of_run = job.result()
            except (StillbedError, BrokenExecutor):
                raise
            except Exception:  # what the campaign is after: the other runs go on
                broken, of_run = broken + 1, []
                print(f"run {waiting[job]}:\n{traceback.format_exc()}", file=sys.stderr, flush=True)
            rows += of_run
            if options.log is not None and of_run:
                append_log(options.log, of_run)
    print(fault_table([row.verdict for row in rows]) + "\n")
    return [*fault_figures(rows), Figure("runs that ended in a traceback", broken, "", at_most(0))]


def one_run(seed: int, number: int) -> list[FaultRow]:
    """The faults of one run, those that struck a print."""
    scenario = SCENARIOS[number % len(SCENARIOS)]
    faults, clock = draw_faults(seed, number), ProcessorClock()
    start = clock.now()
    run = FaultRun(prepared(shipped_file("scenarios", f"{scenario}.toml")), faults, 1000 * seed + number).record()
    spent = clock.now() - start
    ends = [*(fault.start for fault in faults[1:]), run.end]
    verdicts = [judge_fault(run, fault, end) for fault, end in zip(faults, ends, strict=True)]
    of_run, material = (seed, number, scenario, run.violations, spent), (run.open_outside, run.open_unattended)
    return [FaultRow(*of_run, verdict, *material) for verdict in verdicts if verdict is not None]


def append_log(file: Path, rows: Iterable[FaultRow]) -> None:
    """Add rows to a log, with its header where it is new."""
    cells = []
    for row in rows:
        v = row.verdict
        measured = v.detected, v.exposure, v.worst, int(v.silent), int(v.restless), v.recovered, int(v.operator)
        material = row.told_outside, row.left_open
        cells.append([row.seed, row.run, row.scenario, row.over, row.spent, v.fault, *measured, *material])
    figures.append_rows(file, FAULT_LOG_COLUMNS, cells)


def read_log(file: Path, seed: int) -> list[FaultRow]:
    """The rows of a campaign with this seed; InputError where the file is none of ours."""
    rows = []
    for number, each in log_rows(file, FAULT_LOG_COLUMNS):
        try:
            numbers = [float(each[name]) for name in FAULT_LOG_COLUMNS if name not in ("scenario", "fault")]
        except (TypeError, ValueError):
            raise InputError(file, f"line {number}", each, "numbers") from None
        own, run, over, spent, detected, exposure, worst, silent, restless, recovered, operator, *material = numbers
        if own == seed:
            fault = fault_from_text(file, f"line {number}", each["fault"])
            flags = bool(silent), bool(restless), recovered, bool(operator)
            verdict = FaultVerdict(fault, detected, exposure, worst, *flags)
            rows.append(FaultRow(int(own), int(run), each["scenario"], int(over), spent, verdict, *material))
    return rows


def fault_figures(rows: Sequence[FaultRow]) -> list[Figure]:
    """The campaign's figures beside their targets."""
    verdicts = [row.verdict for row in rows]
    runs = {row.run: row for row in rows}
    exposure, detected, recovered = _times_of(verdicts)
    passing = np.array([v.recovered for v in verdicts if not (math.isnan(v.recovered) or v.operator)])
    soon = float((passing <= MAX_RECOVERY + 1e-9).mean()) if len(passing) else math.nan
    in_time = float((exposure <= MAX_DETECTION).mean()) if len(exposure) else math.nan
    each = sum(row.spent for row in runs.values()) / max(len(verdicts), 1)
    note = f"of {len(verdicts)} faults in {len(runs)} runs of {len({row.scenario for row in rows})} scenarios"
    told, left = (max((getattr(row, n) for row in rows), default=math.nan) for n in ("told_outside", "left_open"))
    all_day = f"10,000 take {10_000 * each / 3600:.1f} h of one core"
    return [
        Figure("silent failures", sum(v.silent for v in verdicts), "", at_most(0), "", note),
        Figure("commands beyond a limit", sum(row.over for row in runs.values()), "", at_most(0)),
        Figure("arms that moved on while held", sum(v.restless for v in verdicts), "", at_most(0)),
        Figure("dispenser told on while not printing, most of a run", 1000 * told, "ms", at_most(0), "", NOT_PRINTING),
        Figure("dispenser left open, longest", 1000 * left, "ms", at_most(1000 * MAX_LEFT_OPEN), "", LEFT_OPEN),
        Figure("largest error while extruding", max((v.worst for v in verdicts), default=math.nan), "mm"),
        Figure("said after, 99 %", _share(exposure, 99), "ms", at_most(1000 * MAX_DETECTION), "", EXPOSURE_NOTE),
        Figure("said within 100 ms", in_time, "", None, "", EXPOSURE_NOTE),
        Figure("known after, median", _share(detected, 50), "ms", None, "", f"{len(detected)} were said"),
        Figure("known after, 99 %", _share(detected, 99), "ms"),
        Figure("recoverable ones recovered within 200 ms", soon, "", at_least(0.99), "", f"of {len(passing)}"),
        Figure("recovered after, 99 %", _share(recovered, 99), "ms"),
        Figure("needed an operator", sum(v.operator for v in verdicts), ""),
        Figure("processor time of a fault", each, "s", None, "", all_day),
    ]
