"""`python -m tests.campaigns deceit`: sessions made to fool the tracker, and which of them did."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from concurrent.futures import as_completed

import numpy as np

from estimation.errors import InputError
from hardware.bench.figures import Figure, append_rows, at_most, require_positive, with_progress, workers
from tests.campaigns.deceit.judge import Verdict, run_one
from tests.campaigns.deceit.kinds import NAMES
from tests.campaigns.verdicts import kind_table

SESSIONS_FILE = "sessions.csv"
SESSION_COLUMNS = (
    *("index", "kind", "seed", "what", "decidable", "honest", "wrong", "worst_mm", "claim_mm", "tracking", "first"),
    *("again", "told", "states", "reasons"),
)
KIND_HEADER = "kind", "sessions", "silently wrong", "worst", "its claim", "TRACKING", "again after", "told after"
NO_SUCH_EVENT = -2  # of a verdict's counts: there was nothing to come back from, or to tell


def run_deceit(options: argparse.Namespace) -> list[Figure]:
    """Judge the sessions, print the table of all kinds, and give the figures of all."""
    require_positive(options, "count", "jobs")
    size = options.size[0], options.size[1]
    for kind in options.kind or ():
        if kind not in NAMES:
            raise InputError("command line", "--kind", kind, f"one of {', '.join(NAMES)}")
    indices = [i for i in range(options.count) if options.kind is None or NAMES[i % len(NAMES)] in options.kind]
    verdicts, spent = list[Verdict](), 0.0
    if options.out is not None:
        (options.out / SESSIONS_FILE).unlink(missing_ok=True)
    with workers(options.jobs) as pool:
        jobs = [pool.submit(run_one, options.seed, size, i) for i in options.index or indices]
        for job in with_progress("deceit", "sessions", as_completed(jobs), len(jobs)):
            verdict, seconds = job.result()
            verdicts, spent = [*verdicts, verdict], spent + seconds
            if options.out is not None:
                append_rows(options.out / SESSIONS_FILE, SESSION_COLUMNS, [_session_row(verdict)])
    verdicts.sort(key=lambda verdict: verdict.index)
    print(kind_table(KIND_HEADER, [(_title(v), v) for v in verdicts], _kind_row) + "\n")
    return deceit_figures(verdicts, spent)


def _session_row(verdict: Verdict) -> tuple[object, ...]:
    worst = verdict.worst
    return (
        *(verdict.index, verdict.kind, verdict.seed, verdict.what, int(verdict.decidable), int(verdict.honest)),
        *(verdict.wrong, _text(worst and worst.error, 2), _text(worst and worst.claim, 3), f"{verdict.tracking:.3f}"),
        *(verdict.first, verdict.again, verdict.told, verdict.states, verdict.reasons),
    )


def _title(verdict: Verdict) -> str:
    return verdict.kind.replace("_", " ") + (" (honest)" if verdict.honest else "")


def _kind_row(verdicts: Sequence[Verdict]) -> tuple[str, ...]:
    wrong, open_ = [v for v in verdicts if v.wrong], sum(v.wrong > 0 and not v.decidable for v in verdicts)
    worst = max((v.worst for v in wrong if v.worst), key=lambda judged: judged.error, default=None)
    count = f"{len(wrong)}" + (f" ({open_} of them cannot be decided)" if open_ else "")
    errors = _text(worst and worst.error, 1), _text(worst and worst.claim, 2)
    share = f"{100 * np.mean([v.tracking for v in verdicts]):.0f} %"
    again, told = _range([v.again for v in verdicts]), _range([v.told for v in verdicts])
    return str(len(verdicts)), count, *errors, share, again, told


def _range(counts: Sequence[int]) -> str:
    """Frame sets, from the least to the most, and how many sessions never came to it."""
    counts = [count for count in counts if count != NO_SUCH_EVENT]
    ended = [count for count in counts if count >= 0]
    parts = [f"{min(ended)} to {max(ended)}"] if ended else []
    never = len(counts) - len(ended)
    return ", ".join(parts + ([f"never in {never}"] if never else [])) or "-"


def _text(value: float | None, digits: int) -> str:
    return "-" if value is None or np.isnan(value) else f"{value:.{digits}f}"


def deceit_figures(verdicts: Sequence[Verdict], spent: float) -> list[Figure]:
    """The campaign's figures beside their targets. spent: s, of all sessions."""
    can, others = ([v for v in verdicts if v.decidable is decidable] for decidable in (True, False))
    honest = [100 * v.tracking for v in verdicts if v.honest]
    note, open_ = f"of {len(can)} that can be decided", f"of {len(others)} that no three cameras can decide"
    return [
        Figure("sessions silently wrong", sum(v.wrong > 0 for v in can), "", at_most(0), "", note),
        Figure("others silently wrong", sum(v.wrong > 0 for v in others), "", None, "", open_),
        Figure("honest ones: frame sets TRACKING", float(np.mean(honest or np.nan)), "%", None, "", f"{len(honest)}"),
        Figure("time of a session", spent / max(len(verdicts), 1), "s"),
    ]
