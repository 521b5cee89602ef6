"""Commands in separate processes: all subjects in sequence, and a live run controlled as by an operator.

All subjects give one table as JSON, an HTML page, Markdown for the documents, and a list of figures worse than in a
saved table. A live run gets a terminal and keys; its memory is measured.
"""

from __future__ import annotations

import json
import math
import os
import pty
import signal
import subprocess
import sys
import threading
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from html import escape
from pathlib import Path

from estimation.errors import InputError, StillbedError
from hardware.bench.figures import Figure, Machine, Target, read_figures, table_text, this_machine, whole_text
from hardware.bench.subjects import BENCH, BenchPart, Whole
from hardware.process.checks import error_text
from hardware.process.clock import WallClock
from hardware.process.progress import duration_text
from hardware.report.evaluation import figure as digits
from hardware.report.page import document, row_of_tiles, section, tile

Parts = Mapping[str, Sequence[Figure]]  # by the name of the part
MAX_MISSES_NAMED = 3  # figures of a part that miss their target and are named; the others are counted
PART_HEADER = ("figure", "value", "target", "", "reference", "note")
COLOURS = {"met": ' class="met"', "MISSED": ' class="missed"'}  # by verdict


def whole_page(
    command: str, parts: Parts, troubles: Mapping[str, str], pages: Mapping[str, str], machine: Machine
) -> str:
    """An HTML page with a card for each part. troubles: why a part has no figures. pages: of parts that drew one."""
    with_target, missed, plain = target_counts(parts)
    counts = [(with_target - missed, f"of {with_target}", "targets met"), (missed, "", "missed")]
    counts += [(plain, "", "figures without a target"), (len(troubles), "", "parts that could not be measured")]
    tiles = [tile(str(count), unit, caption) for count, unit, caption in counts]
    versions = ", ".join(f"{name} {number}" for name, number in machine.versions.items() if number)
    cards = [
        f'<div id="{escape(_place(name))}">{section(name, troubles.get(name, ""), _body(name, figures, pages))}</div>'
        for name, figures in parts.items()
    ]
    body = [row_of_tiles(tiles), _overview(parts, troubles), *cards]
    footer = f"Made by {command} with {versions}."
    return document("Bench", "All that is measured", measured_on(machine), body, footer)


def target_counts(parts: Parts) -> tuple[int, int, int]:
    """Figures with a target, those of them that miss it, and figures without one."""
    figures = [figure for part in parts.values() for figure in part]
    verdicts = [figure.verdict for figure in figures]
    return len(figures) - verdicts.count(""), verdicts.count("MISSED"), verdicts.count("")


def measured_on(machine: Machine) -> str:
    """The machine and the commit in words."""
    code = f"commit {machine.commit}" if machine.commit else "an unknown commit"
    return f"{machine.cpu}, {machine.cores} cores, {code}, Python {machine.versions['python']}."


def _overview(parts: Parts, troubles: Mapping[str, str]) -> str:
    """A line for each part: how many targets it meets, and which it misses; its name leads to its card."""
    rows = []
    for name, figures in parts.items():
        with_target, missed, plain = target_counts({name: figures})
        what = [escape(figure.what) for figure in figures if figure.verdict == "MISSED"]
        hidden_count = [f"and {len(what) - MAX_MISSES_NAMED} more"] if len(what) > MAX_MISSES_NAMED else []
        misses = "; ".join([*what[:MAX_MISSES_NAMED], *hidden_count])
        link = f'<td><a href="#{escape(_place(name))}">{escape(name)}</a></td>'
        alarm = f'<span class="missed">{missed}</span>' if missed else "0"
        counts = f"<td>{with_target - missed}</td><td>{alarm}</td><td>{plain}</td>"
        rows.append(f'<tr>{link}{counts}<td class="words">{escape(troubles.get(name, "")) or misses}</td></tr>')
    head = '<th>part</th><th>met</th><th>missed</th><th>without a target</th><th class="words">which miss it</th>'
    table = f"<table><thead><tr>{head}</tr></thead><tbody>{''.join(rows)}</tbody></table>"
    return section("Overview", "How many figures of each part meet their target.", table)


def _place(name: str) -> str:
    """Anchor of a part in the page."""
    return f"part-{name.replace(' ', '-')}"


def _body(name: str, figures: Sequence[Figure], pages: Mapping[str, str]) -> str:
    if not figures:
        return ""
    link = f'<p class="note"><a href="{escape(pages[name])}">the pictures</a></p>' if name in pages else ""
    words = ' class="words"'
    head = "".join(f"<th{words if i > 3 else ''}>{cell}</th>" for i, cell in enumerate(PART_HEADER))
    rows = []
    for what, value, target, verdict, reference, note in (map(escape, _row(figure)) for figure in figures):
        numbers = f'<td class="whole">{value}</td><td class="whole">{target}</td>'
        cells = f"<td>{what}</td>{numbers}<td{COLOURS.get(verdict, '')}>{verdict}</td>"
        rows.append(f"<tr>{cells}<td{words}>{reference}</td><td{words}>{note}</td></tr>")
    return f"<table><thead><tr>{head}</tr></thead><tbody>{''.join(rows)}</tbody></table>{link}"


def _row(figure: Figure) -> tuple[str, ...]:
    target = "" if figure.target is None else str(figure.target)
    value = f"{digits(figure.value)} {figure.unit}".rstrip()
    return figure.what, value, target, figure.verdict, figure.reference, figure.note


def whole_markdown(command: str, parts: Parts, machine: Machine) -> str:
    """The same as Markdown: the machine, and a table for each part."""
    with_target, missed, plain = target_counts(parts)
    lines = [
        "# All that is measured",
        "",
        f"`{command}` on {measured_on(machine)}",
        f"{with_target - missed} of {with_target} targets are met; {plain} figures have none.",
    ]
    for name, figures in parts.items():
        lines += ["", f"## {name}", "", _line(PART_HEADER), "|---|---|---|---|---|---|"]
        lines += [_line(_row(figure)) for figure in figures]
    return "\n".join(lines) + "\n"


def _line(cells: Sequence[str]) -> str:
    return f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in cells)} |"


WORSE_FACTOR = 1.2  # of badness against before: less is the machines' own variation
FIGURES_FILE, PAGE_FILE, TABLE_FILE = "figures.json", "report.html", "table.md"  # of the whole, in its folder


@dataclass(frozen=True, slots=True)
class MeasuredPart:
    """The result of one part."""

    subject: str  # its name
    figures: tuple[Figure, ...]
    trouble: str = ""  # why there are no figures, "" where there are


def measure_all(out: Path, quick: bool, whole: Whole) -> list[MeasuredPart]:
    """Measure every part into a folder each of `out`; figures there of the same commit and options are reused.

    The table is written after each, so that an interrupted run leaves what it has measured.
    """
    clock, machine, measured = WallClock(), this_machine(), list[MeasuredPart]()
    candidates = [(part, part.quick if quick else part.options) for part in whole.parts]
    chosen = [(bench_part, options) for bench_part, options in candidates if options is not None]
    for number, (bench_part, options) in enumerate(chosen, 1):
        start, folder = clock.now(), out / (bench_part.name or bench_part.subject)
        part = _earlier(folder, options, machine) or _measured(folder, bench_part, options)
        duration = duration_text(clock.now() - start)
        print(f"{number} of {len(chosen)}: {bench_part.subject} {' '.join(options)}, {duration}\n", flush=True)
        print(part.trouble or table_text(part.figures), end="\n\n", flush=True)
        measured.append(part)
        figures = {part.subject: part.figures for part in measured}
        troubles = {part.subject: part.trouble for part in measured if part.trouble}
        page_files = {part.subject: sorted((out / part.subject).glob("*.html")) for part in measured}
        pages = {name: files[0].relative_to(out).as_posix() for name, files in page_files.items() if files}
        (out / FIGURES_FILE).write_text(whole_text(figures, machine), encoding="utf-8")
        (out / PAGE_FILE).write_text(whole_page(whole.command, figures, troubles, pages, machine), encoding="utf-8")
        (out / TABLE_FILE).write_text(whole_markdown(whole.command, figures, machine), encoding="utf-8")
    return measured


def _earlier(folder: Path, options: Sequence[str], machine: Machine) -> MeasuredPart | None:
    """The figures of an earlier run, if it was of this very code, with these options."""
    file = folder / "options.json"
    if not file.is_file() or not (folder / FIGURES_FILE).is_file() or machine.commit.endswith("+"):
        return None
    if json.loads(file.read_text(encoding="utf-8")) != [machine.commit, *options]:
        return None
    return MeasuredPart(folder.name, tuple(read_figures(folder / FIGURES_FILE)))


def _measured(folder: Path, part: BenchPart, options: Sequence[str]) -> MeasuredPart:
    program = ["-m", "hardware.cli.main", "bench"] if part.program == BENCH else part.program.split()[1:]
    command = [sys.executable, *program, part.subject, "-o", str(folder), "--force", *options]
    (folder / FIGURES_FILE).unlink(missing_ok=True)
    process = subprocess.run(command, stdout=subprocess.DEVNULL, check=False)  # its progress is shown as it goes
    if process.returncode or not (folder / FIGURES_FILE).is_file():
        return MeasuredPart(
            folder.name, (), f"no figures: `{part.program} {part.subject} {' '.join(options)}` says why"
        )
    (folder / "options.json").write_text(json.dumps([this_machine().commit, *options]), encoding="utf-8")
    return MeasuredPart(folder.name, tuple(read_figures(folder / FIGURES_FILE)))


def summary(measured: Sequence[MeasuredPart]) -> str:
    """How many targets were met, and the missed ones by name."""
    judged = [(part.subject, f) for part in measured for f in part.figures if f.target is not None]
    missed = [f"{subject}: {f.what} {f.value:.4g} {f.unit} ({f.target})" for subject, f in judged if f.verdict != "met"]
    failed = [f"{part.subject}: {part.trouble}" for part in measured if part.trouble]
    return "\n  ".join([f"{len(judged) - len(missed)} of {len(judged)} targets met", *missed, *failed])


def regressions(measured: Sequence[MeasuredPart], file: Path) -> str:
    """Figures worse than in a saved table: a target no longer met, or badness larger by WORSE_FACTOR."""
    before, rows = read_whole(file), []
    for name, figure in ((part.subject, figure) for part in measured for figure in part.figures):
        earlier = before.get((name, figure.what))
        if earlier is not None and _worse(figure, earlier):
            rows.append(f"{name}: {figure.what} {earlier:.4g} -> {figure.value:.4g} {figure.unit}")
    return "\n  ".join([f"worse than in {file}: {len(rows)}", *rows])


def read_whole(file: Path) -> dict[tuple[str, str], float]:
    """The values of a saved table, by subject and figure; InputError where it is none."""
    try:
        subjects = json.loads(file.read_text(encoding="utf-8"))["subjects"]
        rows = ((name, row["what"], row["value"]) for name, part in subjects.items() for row in part)
        return {(name, what): float(value) for name, what, value in rows if value is not None}
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        allowed = f"{FIGURES_FILE} as `{BENCH} --all` writes it"
        raise InputError(file, "table", error_text(error), allowed) from error


def _worse(figure: Figure, before: float) -> bool:
    target = figure.target
    if target is None or (target.met(before) and not target.met(figure.value)):
        return target is not None
    return _badness(target, figure.value) > WORSE_FACTOR * _badness(target, before) > 0


def _badness(target: Target, value: float) -> float:
    """Badness, 1 at the limit: value by limit for a maximum, limit by value for a minimum."""
    low, high = target.low, target.high
    part, whole = (low, value) if math.isinf(high) else (value, high)
    if not math.isinf(low) and not math.isinf(high):
        part, whole = abs(value - (high + low) / 2), (high - low) / 2
    return part / whole if whole else 0.0


def run_whole(out: Path, quick: bool, against: Path | None, whole: Whole) -> None:
    """Measure, print, save and compare."""
    if against is not None:
        read_whole(against)  # a wrong file is reported before an hour of measuring
    out.mkdir(parents=True, exist_ok=True)
    machine = this_machine()
    print(f"{machine.cpu}, {machine.cores} cores, commit {machine.commit or 'unknown'}\n", flush=True)
    measured = measure_all(out, quick, whole)
    print(summary(measured))
    if against is not None:
        print(regressions(measured, against))
    print(f"\nthe whole table: {out / PAGE_FILE}, {out / TABLE_FILE} and {out / FIGURES_FILE}")
    if any(part.trouble for part in measured):
        raise StillbedError("not everything could be measured; what could is kept")


PROCESS_PREFIX = "(sb-"  # of the names of a run's processes in /proc
MAP_PROCESS = "map"  # name of the tracking's own processes
START_TIMEOUT = 300.0  # s until a run prints, on a busy machine
POLL_INTERVAL = 0.005  # s


class LiveSession:
    """A run in a separate process.

    output: all so far.
    memory: of each measurement, instant, s, and MB by process.
    """

    def __init__(self, arguments: list[str]) -> None:
        self.output = ""
        self.memory: list[tuple[float, dict[str, float]]] = []
        self._clock = WallClock()
        self.keys, theirs = pty.openpty()
        command = [sys.executable, "-m", "hardware.cli.main", "live", *arguments]
        nothing = subprocess.DEVNULL
        self.process = subprocess.Popen(command, stdin=theirs, stdout=nothing, stderr=subprocess.PIPE, text=True)
        os.close(theirs)
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def wait_for(self, text: str, after: int = 0, timeout: float = START_TIMEOUT) -> int:
        """Wait for a text beyond the first `after` characters of the output; position of its end, -1 if absent."""
        until = self._clock.now() + timeout
        while self._clock.now() < until:
            if (place := self.output.find(text, after)) >= 0:
                return place + len(text)
            if self.process.poll() is not None and not self._reader.is_alive() and self.output.find(text, after) < 0:
                return -1
            self._clock.wait_until(self._clock.now() + POLL_INTERVAL)
        return -1

    @property
    def last_lines(self) -> str:
        """The last two lines of the output, and how the run ended."""
        lines = [line for line in self.output.splitlines() if line.strip()]
        code = self.process.poll()
        return f"{' / '.join(lines[-2:]) or 'nothing said'} ({'still runs' if code is None else f'exit code {code}'})"

    def press(self, key: str) -> None:
        """Press a key."""
        os.write(self.keys, key.encode())

    def children(self) -> dict[str, int]:
        """Its processes by name."""
        named = ((name, pid) for pid, name in _children(self.process.pid) if name.startswith(PROCESS_PREFIX))
        return {name.removeprefix(PROCESS_PREFIX): pid for name, pid in named}

    def measure_memory(self) -> None:
        """Store the unshared memory, MB, of each of its processes but the virtual arm, which stores all its motion."""
        private: dict[str, float] = {}
        processes = {name: pid for name, pid in self.children().items() if name != "arm"}
        map_processes = [(MAP_PROCESS, pid) for pid, _ in _children(processes.get("tracking", -1))]
        for name, pid in [("run", self.process.pid), *processes.items(), *map_processes]:
            try:
                resident, shared = Path(f"/proc/{pid}/statm").read_text(encoding="ascii").split()[1:3]
            except (OSError, ValueError):
                continue
            private[name] = private.get(name, 0.0) + (int(resident) - int(shared)) * os.sysconf("SC_PAGE_SIZE") / 1e6
        self.memory.append((self._clock.now(), private))

    def kill(self, name: str) -> float:
        """Kill one of its processes, "run" for the main process; the instant, s, NaN where there is none."""
        pid = self.process.pid if name == "run" else self.children().get(name)
        if pid is None:
            return float("nan")
        now = self._clock.now()
        os.kill(pid, signal.SIGKILL)
        return now

    def end(self, timeout: float = START_TIMEOUT) -> None:
        """Wait for its end."""
        with suppress(subprocess.TimeoutExpired):
            self.process.wait(timeout)

    def close(self) -> None:
        """End what still runs."""
        if self.process.poll() is None:
            self.process.terminate()
            self.end(30.0)
        self.process.kill()
        self.process.wait()
        os.close(self.keys)

    def _read(self) -> None:
        assert self.process.stderr is not None
        for line in self.process.stderr:
            self.output += line


def _children(parent: int) -> list[tuple[int, str]]:
    """Number and name, which begins with a bracket, of a process's children."""
    children = []
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            text = (folder / "stat").read_text()
        except OSError:
            continue
        name, rest = text[text.find("(") : text.rfind(")")], text[text.rfind(")") + 2 :].split()
        if int(rest[1]) == parent:
            children.append((int(folder.name), name))
    return children
