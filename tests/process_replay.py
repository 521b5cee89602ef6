"""`make check`: the reference recordings are replayed, and what comes of them is what it was before.

python -m tests.process_replay             compares; exit code 1 where something changed (`make check`)
python -m tests.process_replay --update    takes what comes of them now as what is to come of them (`make references`)

Both write out/references.html, a picture of each signal that changed, over time, where any did. From tracks on every
byte must be the same on x86-64 processors with AVX2 and FMA, with the libraries of `constraints.txt`; elsewhere, and
from pictures on, what rounding can do is allowed, and that is said.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence

import numpy as np

from hardware.report.page import Plot, document, figures_table, legend, line_key, section, spanning
from hardware.report.report import HALF_CHART_WIDTH
from tests.pinned_arithmetic import ENVIRONMENT, ROOT, made_with, run_pinned, unlike
from tests.reference_cases import CASES, FOLDER, TRACKS, keep, kept, replayed
from tests.reference_signals import DECISION, NEW, STATES, Change, changes, differing

MADE_WITH = FOLDER / "made_with.json"
PAGE = ROOT / "out" / "references.html"
MOST = 30  # signals in the picture of a recording


def main(arguments: Sequence[str]) -> int:
    """Compare or update, in the arithmetic of `tests.pinned_arithmetic`; the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--update", action="store_true", help="what comes of them now is what is to come of them")
    parser.add_argument("--case", choices=CASES, action="append", help="only this recording")
    options = parser.parse_args(arguments)
    chosen = options.case or CASES
    reasons = unlike(json.loads(MADE_WITH.read_text(encoding="utf-8"))) if MADE_WITH.exists() else []
    parts, wrong = [], 0
    for case in chosen:
        before, after = kept(case), replayed(case)
        other = differing(before, after)
        found = changes(before, after) if before else []
        wrong += not passes(case, other, found, reasons)
        print(f"replay of {case:<11}{verdict(case, other, found, reasons)}")
        if other and before:
            parts.append(_part(case, other, found))
        if options.update:
            keep(case, after)
    if options.update:
        MADE_WITH.write_text(json.dumps(made_with(), indent=1) + "\n", encoding="utf-8")
    _write_page(parts)
    if wrong and not options.update:
        print("if that is meant: make references; the picture of what changed is to be looked at in either case")
    return int(wrong > 0 and not options.update)


def passes(case: str, other: dict[str, str], found: Sequence[Change], reasons: Sequence[str]) -> bool:
    """Whether nothing has changed that may not. other: arrays that differ. reasons: why bits may differ here."""
    if not other:
        return True
    if case in TRACKS and not reasons:
        return False
    reshaped = any("became" in how or "there" in how for name, how in other.items() if not name.startswith("track"))
    return not reshaped and all(change.allowed(case) for change in found)


def verdict(case: str, other: dict[str, str], found: Sequence[Change], reasons: Sequence[str]) -> str:
    """What came of a recording, in words."""
    if not other:
        return "the same, byte by byte"
    if all(how == NEW for how in other.values()):
        return "nothing is kept of it yet"
    worst = "; ".join(f"{c.name} by up to {_amount(c)} from {c.first:.3f} s on" for c in found[:MOST] if c.rows)
    rest = "; ".join(f"{name}: {how}" for name, how in other.items())
    said = worst or rest
    if not passes(case, other, found, reasons):
        return f"CHANGED: {said}"
    why = "from pictures on" if case not in TRACKS else "; ".join(reasons)
    return f"the same but for rounding ({why}): {said}"


def _amount(change: Change) -> str:
    lost = "" if change.most else "nothing for something"
    return lost or (f"{change.rows} rows" if change.unit == DECISION else f"{change.most:.2g} {change.unit}")


def _write_page(parts: Sequence[str]) -> None:
    """The picture, or none left where nothing changed."""
    PAGE.unlink(missing_ok=True)
    if parts:
        PAGE.parent.mkdir(exist_ok=True)
        lead = "What comes of the reference recordings now, beside what came of them before."
        footer = "Before: as kept in tests/reference. Times in s of the recording."
        PAGE.write_text(document("process replay", "What has changed", lead, parts, footer), encoding="utf-8")
        print(f"the picture: {PAGE.relative_to(ROOT)}")


def _part(case: str, other: dict[str, str], found: Sequence[Change]) -> str:
    keys = legend([line_key("truth", "before"), line_key("estimate", "now"), line_key("series c3", "change")])
    plots = "".join(_plots(change) for change in found[:MOST])
    table = figures_table(["", "rows that differ"], list(other.items()))
    words = f"{len(found)} signals differ; the right plot of each pair shows by how much, logarithmically."
    if not found:
        return section(case, "No signal that is drawn differs.", table)
    return section(case, words, f'{keys}<div class="two">{plots}</div>{table}')


def _plots(change: Change) -> str:
    span = float(change.stamps[0]), float(change.stamps[-1]) + 1e-9
    unit = "" if change.unit == DECISION else f", {change.unit}"
    known = ", ".join(f"{i} {state.lower()}" for i, state in enumerate(STATES))
    names = f" ({known})" if change.name == "state" else ""
    ends = spanning([change.before, change.after], 0.12, 1e-6)
    both = Plot(HALF_CHART_WIDTH, 150, span, ends, label=change.name + unit + names)
    both.line(change.stamps, change.before, "truth")
    both.line(change.stamps, change.after, "estimate")
    size = change.size
    high = max(change.most * 2, 1e-15)
    apart = Plot(HALF_CHART_WIDTH, 150, span, (high / 1e4, high), log_y=True, label=f"change of {change.name}{unit}")
    apart.line(change.stamps, np.where(size > 0, size, np.nan), "series c3")
    lost = change.stamps[size == float("inf")]
    apart.shade(lost, lost + (span[1] - span[0]) / len(size), "hold", ["one of them says nothing here"] * len(lost))
    return both.svg() + apart.svg()


if __name__ == "__main__":
    import os

    if all(os.environ.get(name) == value for name, value in ENVIRONMENT.items()):
        sys.exit(main(sys.argv[1:]))
    sys.exit(run_pinned("tests.process_replay", sys.argv[1:]))
