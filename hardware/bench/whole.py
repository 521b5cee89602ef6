"""Commands in processes of their own: all subjects in one go, and a live run as an operator would run it.

All subjects come to one table, a page to look at and Markdown for the documents, and what has become worse since a
saved table. A live run has a terminal, keys, a look at its memory, and an end.
"""

from __future__ import annotations

import json
import os
import pty
import signal
import subprocess
import sys
import threading
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import Any

from estimation.errors import InputError, StillbedError
from hardware.bench.figures import Figure, Machine, Target, read_figures, table_text, this_machine, whole_text
from hardware.process.checks import error_text
from hardware.process.clock import WallClock
from hardware.process.progress import duration_text
from hardware.report.page import document, row_of_tiles, section, tile
from hardware.report.summary import figure as digits

Parts = Mapping[str, Sequence[Figure]]  # by the name of the part
MAX_MISSES_NAMED = 3  # figures of a part that are named where they miss their target; of more, the count is
PART_HEADER = ("figure", "value", "target", "", "reference", "note")


def whole_page(parts: Parts, troubles: Mapping[str, str], pages: Mapping[str, str], machine: Machine) -> str:
    """An HTML page with a card for each part. troubles: why a part has no figures. pages: of parts that drew one."""
    judged, missed, plain = counted(parts)
    counts = [(judged - missed, f"of {judged}", "targets met"), (missed, "", "missed")]
    counts += [(plain, "", "figures without a target"), (len(troubles), "", "parts that could not be measured")]
    tiles = [tile(str(count), unit, caption) for count, unit, caption in counts]
    versions = ", ".join(f"{name} {number}" for name, number in machine.versions.items() if number)
    cards = [
        f'<div id="{escape(_place(name))}">{section(name, troubles.get(name, ""), _body(name, figures, pages))}</div>'
        for name, figures in parts.items()
    ]
    body = [row_of_tiles(tiles), _overview(parts, troubles), *cards]
    made = f"Made by stillbed bench --all with {versions}."
    return document("Bench", "All that is measured", measured_on(machine), body, made)


def counted(parts: Parts) -> tuple[int, int, int]:
    """Figures with a target, those of them that miss it, and figures without one."""
    figures = [figure for part in parts.values() for figure in part]
    verdicts = [figure.verdict for figure in figures]
    return len(figures) - verdicts.count(""), verdicts.count("MISSED"), verdicts.count("")


def measured_on(machine: Machine) -> str:
    """The machine and the commit in words."""
    code = f"commit {machine.commit}" if machine.commit else "an unknown commit"
    return f"{machine.cpu}, {machine.cores} cores, {code}, Python {machine.versions['python']}."


def _overview(parts: Parts, troubles: Mapping[str, str]) -> str:
    """A line for each part: how its figures fare, and which of them miss their target; its name leads to its card."""
    rows = []
    for name, figures in parts.items():
        judged, missed, plain = counted({name: figures})
        what = [escape(figure.what) for figure in figures if figure.verdict == "MISSED"]
        told = "; ".join(what[:MAX_MISSES_NAMED]) + (
            f"; and {len(what) - MAX_MISSES_NAMED} more" if len(what) > MAX_MISSES_NAMED else ""
        )
        link = f'<td><a href="#{escape(_place(name))}">{escape(name)}</a></td>'
        alarm = f'<span class="missed">{missed}</span>' if missed else "0"
        counts = f"<td>{judged - missed}</td><td>{alarm}</td><td>{plain}</td>"
        rows.append(f'<tr>{link}{counts}<td class="words">{escape(troubles.get(name, "")) or told}</td></tr>')
    head = '<th>part</th><th>met</th><th>missed</th><th>without a target</th><th class="words">which miss it</th>'
    table = f"<table><thead><tr>{head}</tr></thead><tbody>{''.join(rows)}</tbody></table>"
    return section("Overview", "How many figures of each part meet their target.", table)


def _place(name: str) -> str:
    """What a part is found by in the page."""
    return f"part-{name.replace(' ', '-')}"


def _body(name: str, figures: Sequence[Figure], pages: Mapping[str, str]) -> str:
    if not figures:
        return ""
    link = f'<p class="note"><a href="{escape(pages[name])}">the pictures</a></p>' if name in pages else ""
    head = "".join(
        f'<th class="words">{cell}</th>' if i > 3 else f"<th>{cell}</th>" for i, cell in enumerate(PART_HEADER)
    )
    rows = "".join(f"<tr>{_cells(figure)}</tr>" for figure in figures)
    return f"<table><thead><tr>{head}</tr></thead><tbody>{rows}</tbody></table>{link}"


def _cells(figure: Figure) -> str:
    what, value, target, verdict, *words = map(escape, _row(figure))
    colour = {"met": ' class="met"', "MISSED": ' class="missed"'}.get(verdict, "")
    numbers = "".join(f'<td class="whole">{cell}</td>' for cell in (value, target))
    said = "".join(f'<td class="words">{cell}</td>' for cell in words)
    return f"<td>{what}</td>{numbers}<td{colour}>{verdict}</td>{said}"


def _row(figure: Figure) -> tuple[str, ...]:
    target = "" if figure.target is None else str(figure.target)
    value = f"{digits(figure.value)} {figure.unit}".rstrip()
    return figure.what, value, target, figure.verdict, figure.reference, figure.note


def whole_markdown(parts: Parts, machine: Machine) -> str:
    """The same as Markdown: what was measured on what, and a table for each part."""
    judged, missed, plain = counted(parts)
    lines = [
        "# All that is measured",
        "",
        f"`stillbed bench --all` (`make bench`) on {measured_on(machine)}",
        f"{judged - missed} of {judged} targets are met; {plain} figures have none.",
    ]
    for name, figures in parts.items():
        lines += ["", f"## {name}", "", _line(PART_HEADER), "|---|---|---|---|---|---|"]
        lines += [_line(_row(figure)) for figure in figures]
    return "\n".join(lines) + "\n"


def _line(cells: Sequence[str]) -> str:
    return f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in cells)} |"


WORSE_FACTOR = 1.2  # times farther from good than before: less is what these machines vary by
FIGURES_FILE, PAGE_FILE, TABLE_FILE = "figures.json", "report.html", "table.md"  # of the whole, in its folder
BENCH_PROCESS = "import sys; from hardware.cli.main import main; sys.exit(main(sys.argv[1:]))"


@dataclass(frozen=True, slots=True)
class BenchPart:
    """One subject as a part of the whole, and of the quick look."""

    subject: str
    options: tuple[str, ...] = ()
    quick: tuple[str, ...] | None = None  # None: left out of the quick look
    name: str = ""  # in the table and of its folder, where the subject has another part beside it


OWN_MAPS = "--maps", "seen", "--only"  # of several seeds: the frame's own error is one draw for a whole world
QUICK_ESTIMATOR = *OWN_MAPS, "breathing, clean", "--seeds", "2", "--seconds", "4"
BENCH_PARTS = (
    BenchPart("estimator", (*OWN_MAPS, "breathing, [cno]*", "--seeds", "6", "--seconds", "4"), QUICK_ESTIMATOR),
    BenchPart("consistency", ("--scenes", "1")),
    BenchPart("estimator", ("--maps", "seen", "--soak", "0.05"), name="memory"),
    BenchPart("prediction", (), ("--seconds", "75")),
    BenchPart("steps", ("--steps", "500", "--hours", "0.2"), None),
    BenchPart("latency", ("--seconds", "4")),
    BenchPart("thesis", ("--seconds", "2")),
    BenchPart("segmentation", ("--rendered", "30"), ("--rendered", "2")),
    BenchPart("plan", (), None),
    BenchPart("fill", ("--count", "60"), ("--count", "3")),
    BenchPart("planner", ("--updates", "20000"), ("--updates", "2000")),
    BenchPart("link", ("--hours", "0.5", "--commands", "20000"), ("--hours", "0.01", "--commands", "500")),
    BenchPart("loop", ("--jobs", "2"), ("--jobs", "2", "--scenario", "breathing_deep")),
    BenchPart("outages", ("--count", "22")),
    BenchPart("faults", ("--count", "42", "--jobs", "2"), None),
    BenchPart("fuzz", ("--count", "10000", "--jobs", "2"), ("--count", "2000", "--jobs", "2")),
    BenchPart("registration", ("--seeds", "1")),
    BenchPart("growth", ("--seconds", "2")),
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class MeasuredPart:
    """What one part came to."""

    subject: str  # its name
    figures: tuple[Figure, ...]
    trouble: str = ""  # why there are no figures, "" where there are


def measure_all(out: Path, quick: bool, parts: Sequence[BenchPart] = BENCH_PARTS) -> list[MeasuredPart]:
    """Measure every subject into a folder each of `out`; what stands there of the same commit and options is kept.

    The table is written after each, so that one that is interrupted shows what it came to.
    """
    clock, machine, done = WallClock(), this_machine(), []
    wanted = [(part, part.quick if quick else part.options) for part in parts]
    chosen = [(part.subject, part.name or part.subject, options) for part, options in wanted if options is not None]
    for number, (subject, name, options) in enumerate(chosen, 1):
        begun = clock.now()
        one = _kept(out / name, options, machine) or _measured(out / name, subject, options)
        taken = duration_text(clock.now() - begun)
        print(f"{number} of {len(chosen)}: {subject} {' '.join(options)}, {taken}\n", flush=True)
        print(one.trouble or table_text(one.figures), end="\n\n", flush=True)
        done.append(one)
        _save(out, done, machine)
    return done


def _save(out: Path, done: Sequence[MeasuredPart], machine: Machine) -> None:
    """The table so far: to read back, to look at, and for a document."""
    parts = {one.subject: one.figures for one in done}
    troubles = {one.subject: one.trouble for one in done if one.trouble}
    drawn = {one.subject: sorted((out / one.subject).glob("*.html")) for one in done}
    pages = {name: files[0].relative_to(out).as_posix() for name, files in drawn.items() if files}
    (out / FIGURES_FILE).write_text(whole_text(parts, machine), encoding="utf-8")
    (out / PAGE_FILE).write_text(whole_page(parts, troubles, pages, machine), encoding="utf-8")
    (out / TABLE_FILE).write_text(whole_markdown(parts, machine), encoding="utf-8")


def _kept(folder: Path, options: Sequence[str], machine: Machine) -> MeasuredPart | None:
    """What an earlier run left, if it was of this very code, with these options."""
    asked = folder / "options.json"
    if not asked.is_file() or not (folder / FIGURES_FILE).is_file() or machine.commit.endswith("+"):
        return None
    if json.loads(asked.read_text(encoding="utf-8")) != [machine.commit, *options]:
        return None
    return MeasuredPart(folder.name, tuple(read_figures(folder / FIGURES_FILE)))


def _measured(folder: Path, subject: str, options: Sequence[str]) -> MeasuredPart:
    command = [sys.executable, "-c", BENCH_PROCESS, "bench", subject, "-o", str(folder), "--force", *options]
    (folder / FIGURES_FILE).unlink(missing_ok=True)
    done = subprocess.run(command, stdout=subprocess.DEVNULL, check=False)  # its progress is shown as it goes
    if done.returncode or not (folder / FIGURES_FILE).is_file():
        return MeasuredPart(folder.name, (), f"no figures: `stillbed bench {subject} {' '.join(options)}` says why")
    (folder / "options.json").write_text(json.dumps([this_machine().commit, *options]), encoding="utf-8")
    return MeasuredPart(folder.name, tuple(read_figures(folder / FIGURES_FILE)))


def summary(done: Sequence[MeasuredPart]) -> str:
    """How many targets were met, and the missed ones by name."""
    judged = [(one.subject, f) for one in done for f in one.figures if f.target is not None]
    missed = [f"{subject}: {f.what} {f.value:.4g} {f.unit} ({f.target})" for subject, f in judged if f.verdict != "met"]
    failed = [f"{one.subject}: {one.trouble}" for one in done if one.trouble]
    return "\n  ".join([f"{len(judged) - len(missed)} of {len(judged)} targets met", *missed, *failed])


def regressions(done: Sequence[MeasuredPart], file: Path) -> str:
    """What is worse than in a saved table: a target met no more, or a figure WORSE_FACTOR times farther from good."""
    before = read_whole(file)
    rows = []
    for one in done:
        for figure in one.figures:
            then = before.get((one.subject, figure.what))
            if then is not None and _worse(figure, then):
                rows.append(f"{one.subject}: {figure.what} {then:.4g} -> {figure.value:.4g} {figure.unit}")
    return "\n  ".join([f"worse than in {file}: {len(rows)}", *rows])


def read_whole(file: Path) -> dict[tuple[str, str], float]:
    """The values of a saved table, by subject and figure; InputError where it is none."""
    try:
        table: Any = json.loads(file.read_text(encoding="utf-8"))
        subjects = table["subjects"]
        rows = ((name, row["what"], row["value"]) for name, part in subjects.items() for row in part)
        return {(name, what): float(value) for name, what, value in rows if value is not None}
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError(
            file, "table", error_text(error), "figures.json as `stillbed bench --all` writes it"
        ) from error


def _worse(figure: Figure, before: float) -> bool:
    target = figure.target
    if target is None or (target.met(before) and not target.met(figure.value)):
        return target is not None
    return _badness(target, figure.value) > WORSE_FACTOR * _badness(target, before) > 0


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
    print(f"\nthe whole table: {out / PAGE_FILE}, {out / TABLE_FILE} and {out / FIGURES_FILE}")
    if any(one.trouble for one in done):
        raise StillbedError("not everything could be measured; what could is kept")


PROCESS_PREFIX = "(sb-"  # of the processes of a run, as the system tells it
MAP_PROCESS = "map"  # the processes of the tracking's own
START_PATIENCE = 300.0  # s in which a run must have begun to print, on a busy machine
LOOK_PERIOD = 0.005  # s


class LiveSession:
    """A run in a process of its own. said: what it told so far. memory: s, and MB by process."""

    def __init__(self, arguments: list[str]) -> None:
        self.said = ""
        self.memory: list[tuple[float, dict[str, float]]] = []
        self._clock = WallClock()
        self.keys, theirs = pty.openpty()
        command = [sys.executable, "-m", "hardware.cli.main", "live", *arguments]
        nothing = subprocess.DEVNULL
        self.process = subprocess.Popen(command, stdin=theirs, stdout=nothing, stderr=subprocess.PIPE, text=True)
        os.close(theirs)
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def wait_for(self, words: str, after: int = 0, patience: float = START_PATIENCE) -> int:
        """Wait until it said so beyond the first `after` characters; where that ended, -1 where it never did."""
        until = self._clock.now() + patience
        while self._clock.now() < until:
            if (place := self.said.find(words, after)) >= 0:
                return place + len(words)
            if self.process.poll() is not None and not self._reader.is_alive() and self.said.find(words, after) < 0:
                return -1
            self._clock.wait_until(self._clock.now() + LOOK_PERIOD)
        return -1

    @property
    def last_words(self) -> str:
        """The last two lines that it said, and how it ended."""
        lines = [line for line in self.said.splitlines() if line.strip()]
        code = self.process.poll()
        return f"{' / '.join(lines[-2:]) or 'nothing said'} ({'still runs' if code is None else f'exit code {code}'})"

    def press(self, key: str) -> None:
        """Press a key."""
        os.write(self.keys, key.encode())

    def children(self) -> dict[str, int]:
        """Its processes by name."""
        named = ((name, pid) for pid, name in _children(self.process.pid) if name.startswith(PROCESS_PREFIX))
        return {name.removeprefix(PROCESS_PREFIX): pid for name, pid in named}

    def weigh(self) -> None:
        """Note how much memory each of its processes but the virtual arm holds that no other has, MB."""
        held: dict[str, float] = {}
        own = {name: pid for name, pid in self.children().items() if name != "arm"}  # which keeps all that it ever did
        of_map = [(MAP_PROCESS, pid) for pid, _ in _children(own.get("tracking", -1))]
        for name, pid in [("run", self.process.pid), *own.items(), *of_map]:
            try:
                resident, shared = Path(f"/proc/{pid}/statm").read_text(encoding="ascii").split()[1:3]
            except (OSError, ValueError):
                continue
            held[name] = held.get(name, 0.0) + (int(resident) - int(shared)) * os.sysconf("SC_PAGE_SIZE") / 1e6
        self.memory.append((self._clock.now(), held))

    def kill(self, name: str) -> float:
        """Kill one of its processes, "run" for the one that conducts; the instant, s, NaN where there is none."""
        pid = self.process.pid if name == "run" else self.children().get(name)
        if pid is None:
            return float("nan")
        now = self._clock.now()
        os.kill(pid, signal.SIGKILL)
        return now

    def end(self, patience: float = START_PATIENCE) -> int | None:
        """Wait for its end; its exit code."""
        try:
            return self.process.wait(patience)
        except subprocess.TimeoutExpired:
            return None

    def close(self) -> None:
        """Leave nothing behind."""
        if self.process.poll() is None:
            self.process.terminate()
            self.end(30.0)
        self.process.kill()
        self.process.wait()
        os.close(self.keys)

    def _read(self) -> None:
        assert self.process.stderr is not None
        for line in self.process.stderr:
            self.said += line


def _children(parent: int) -> list[tuple[int, str]]:
    """The processes that a process has started: each its number and name, which begins with a bracket."""
    found = []
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            text = (folder / "stat").read_text()
        except OSError:
            continue
        name, rest = text[text.find("(") : text.rfind(")")], text[text.rfind(")") + 2 :].split()
        if int(rest[1]) == parent:
            found.append((int(folder.name), name))
    return found
