"""All subjects in one go: each in a process of its own, one table, and what has become worse since a saved one."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from estimation.errors import InputError, StillbedError
from hardware.bench.figures import Figure, Target
from hardware.bench.machine import Machine, this_machine
from hardware.bench.saved import saved_figures, whole_table
from hardware.bench.table import table_text
from hardware.bench.whole_page import whole_markdown, whole_page
from hardware.process.checks import why
from hardware.process.clock import WallClock
from hardware.process.progress import duration

WORSE = 1.2  # times farther from good than before: less is what these machines vary by
FIGURES, PAGE, TABLE = "figures.json", "report.html", "table.md"  # of the whole, in its folder
RUN = "import sys; from hardware.cli.main import main; sys.exit(main(sys.argv[1:]))"


@dataclass(frozen=True, slots=True)
class Part:
    """One subject with its options: as a part of the whole, and of the quick look, which it is left out of by None.

    name: in the table and of its folder, where the subject has another part beside it.
    """

    subject: str
    options: tuple[str, ...] = ()
    quick: tuple[str, ...] | None = None
    name: str = ""


WORLDS = "--maps", "seen", "--only"  # of several seeds: the frame's own error is one draw for a whole world
QUICK = *WORLDS, "breathing, clean", "--seeds", "2", "--seconds", "4"
PARTS = (
    Part("estimator", (*WORLDS, "breathing, [cno]*", "--seeds", "6", "--seconds", "4"), QUICK),
    Part("consistency", ("--scenes", "1")),
    Part("estimator", ("--maps", "seen", "--soak", "0.05"), name="memory"),
    Part("prediction", (), ("--seconds", "75")),
    Part("steps", ("--steps", "500", "--hours", "0.2"), None),
    Part("latency", ("--seconds", "4")),
    Part("thesis", ("--seconds", "2")),
    Part("segmentation", ("--rendered", "30"), ("--rendered", "2")),
    Part("plan", (), None),
    Part("fill", ("--count", "60"), ("--count", "3")),
    Part("planner", ("--updates", "20000"), ("--updates", "2000")),
    Part("link", ("--hours", "0.5", "--commands", "20000"), ("--hours", "0.01", "--commands", "500")),
    Part("loop", ("--jobs", "2"), ("--jobs", "2", "--scenario", "breathing_deep")),
    Part("outages", ("--count", "22")),
    Part("faults", ("--count", "42", "--jobs", "2"), None),
    Part("fuzz", ("--count", "10000", "--jobs", "2"), ("--count", "2000", "--jobs", "2")),
    Part("registration", ("--seeds", "1")),
    Part("growth", ("--seconds", "2")),
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class Measured:
    """What one part came to, by its name. trouble: why there are no figures, "" where there are."""

    subject: str
    figures: tuple[Figure, ...]
    trouble: str = ""


def measure_all(out: Path, quick: bool, parts: Sequence[Part] = PARTS) -> list[Measured]:
    """Measure every subject into a folder each of `out`; what stands there of the same commit and options is kept.

    The table is written after each, so that one that is interrupted shows what it came to.
    """
    clock, machine, done = WallClock(), this_machine(), []
    wanted = [(part, part.quick if quick else part.options) for part in parts]
    chosen = [(part.subject, part.name or part.subject, options) for part, options in wanted if options is not None]
    for number, (subject, name, options) in enumerate(chosen, 1):
        begun = clock.now()
        one = _kept(out / name, options, machine) or _measured(out / name, subject, options)
        taken = duration(clock.now() - begun)
        print(f"{number} of {len(chosen)}: {subject} {' '.join(options)}, {taken}\n", flush=True)
        print(one.trouble or table_text(one.figures), end="\n\n", flush=True)
        done.append(one)
        _save(out, done, machine)
    return done


def _save(out: Path, done: Sequence[Measured], machine: Machine) -> None:
    """The table so far: to read back, to look at, and for a document."""
    parts = {one.subject: one.figures for one in done}
    troubles = {one.subject: one.trouble for one in done if one.trouble}
    drawn = {one.subject: sorted((out / one.subject).glob("*.html")) for one in done}
    pages = {name: files[0].relative_to(out).as_posix() for name, files in drawn.items() if files}
    (out / FIGURES).write_text(json.dumps(whole_table(parts, machine), indent=2) + "\n", encoding="utf-8")
    (out / PAGE).write_text(whole_page(parts, troubles, pages, machine), encoding="utf-8")
    (out / TABLE).write_text(whole_markdown(parts, machine), encoding="utf-8")


def _kept(folder: Path, options: Sequence[str], machine: Machine) -> Measured | None:
    """What an earlier run left, if it was of this very code, with these options."""
    asked = folder / "options.json"
    if not asked.is_file() or not (folder / FIGURES).is_file() or machine.commit.endswith("+"):
        return None
    if json.loads(asked.read_text(encoding="utf-8")) != [machine.commit, *options]:
        return None
    return Measured(folder.name, tuple(saved_figures(folder / FIGURES)))


def _measured(folder: Path, subject: str, options: Sequence[str]) -> Measured:
    command = [sys.executable, "-c", RUN, "bench", subject, "-o", str(folder), "--force", *options]
    (folder / FIGURES).unlink(missing_ok=True)
    done = subprocess.run(command, stdout=subprocess.DEVNULL, check=False)  # its progress is shown as it goes
    if done.returncode or not (folder / FIGURES).is_file():
        return Measured(folder.name, (), f"no figures: `stillbed bench {subject} {' '.join(options)}` says why")
    (folder / "options.json").write_text(json.dumps([this_machine().commit, *options]), encoding="utf-8")
    return Measured(folder.name, tuple(saved_figures(folder / FIGURES)))


def summary(done: Sequence[Measured]) -> str:
    """How many targets were met, and the missed ones by name."""
    judged = [(one.subject, f) for one in done for f in one.figures if f.target is not None]
    missed = [f"{subject}: {f.what} {f.value:.4g} {f.unit} ({f.target})" for subject, f in judged if f.verdict != "met"]
    failed = [f"{one.subject}: {one.trouble}" for one in done if one.trouble]
    head = f"{len(judged) - len(missed)} of {len(judged)} targets met"
    return "\n  ".join([head, *missed, *failed])


def regressions(done: Sequence[Measured], file: Path) -> str:
    """What is worse than in a saved table: a target met no more, or a figure WORSE times farther from good."""
    before = read_whole(file)
    rows = []
    for one in done:
        for figure in one.figures:
            then = before.get((one.subject, figure.what))
            if then is not None and _worse(figure, then):
                rows.append(f"{one.subject}: {figure.what} {then:.4g} -> {figure.value:.4g} {figure.unit}")
    head = f"worse than in {file}: {len(rows)}"
    return "\n  ".join([head, *rows])


def read_whole(file: Path) -> dict[tuple[str, str], float]:
    """The values of a saved table, by subject and figure; InputError where it is none."""
    try:
        table: Any = json.loads(file.read_text(encoding="utf-8"))
        subjects = table["subjects"]
        rows = ((name, row["what"], row["value"]) for name, part in subjects.items() for row in part)
        return {(name, what): float(value) for name, what, value in rows if value is not None}
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError(file, "table", why(error), "figures.json as `stillbed bench --all` writes it") from error


def _worse(figure: Figure, before: float) -> bool:
    target = figure.target
    if target is None:
        return False
    if target.met(before) and not target.met(figure.value):
        return True
    return _badness(target, figure.value) > WORSE * _badness(target, before) > 0


def _badness(target: Target, value: float) -> float:
    """How far from good, 1 at the limit: value by limit from above, limit by value from below."""
    if target.high < float("inf") and target.low > -float("inf"):
        middle, half = (target.high + target.low) / 2, (target.high - target.low) / 2
        return abs(value - middle) / half if half else 0.0
    if target.high < float("inf"):
        return value / target.high if target.high else 0.0
    return target.low / value if value else 0.0


def run_whole(out: Path, quick: bool, against: Path | None) -> None:
    """Measure, print, save and compare."""
    if against is not None:
        read_whole(against)  # a wrong file is told before an hour of measuring
    out.mkdir(parents=True, exist_ok=True)
    machine = this_machine()
    print(f"{machine.cpu}, {machine.cores} cores, commit {machine.commit or 'unknown'}\n", flush=True)
    done = measure_all(out, quick)
    print(summary(done))
    if against is not None:
        print(regressions(done, against))
    print(f"\nthe whole table: {out / PAGE}, {out / TABLE} and {out / FIGURES}")
    if any(one.trouble for one in done):
        raise StillbedError("not everything could be measured; what could is kept")
