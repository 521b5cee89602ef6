"""The command line `stillbed`: all commands, and `simulate`, `bench` and `doctor` themselves.

Imports lazily, also the other commands: only the called command's options are loaded.
"""

from __future__ import annotations

import argparse
import os
import signal
import sys
import threading
from collections.abc import Callable, Sequence
from contextlib import nullcontext, suppress
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING

from estimation.errors import StillbedError
from hardware.cli.parser import (
    FAILED,
    INTERRUPTED,
    WRONG_INPUT,
    Commands,
    Parser,
    add_fault,
    error_text,
    option_error,
    wall_clock,
)
from hardware.process.progress import (
    BAD,
    FirstWord,
    cache_folder,
    fill_standard_streams,
    left_files_text,
    painted,
    prepare_out,
    write_error_text,
)

if TYPE_CHECKING:
    from hardware.bench.subjects import Subject, Subjects, Whole
    from hardware.operator.view import CheckVerdict

BENCH_OUT = Path("out/bench")
WRITTEN_OPTIONS = ("out", "record", "log", "link", "gcode")  # output paths


def add_bench(commands: Commands) -> None:
    """Add the sub-command `bench`; the options after the subject are parsed after its module is loaded."""
    parser = commands.add(
        "bench",
        run_bench,
        "measure a part of stillbed; print each figure with its target",
        "Measure a part of stillbed and print each figure with its target and its reference.",
        "stillbed bench latency -o out/latency",
        "stillbed bench --quick",
    )
    add_bench_options(parser)


def add_bench_options(parser: argparse.ArgumentParser) -> None:
    """Add the options: a subject and its options, or all subjects."""
    add = parser.add_argument
    add("--list", action="store_true", help="list the subjects and exit")
    add("--all", action="store_true", help="measure all subjects, in a short form; figures that exist in OUT are kept")
    add("--quick", action="store_true", help="as --all, with fewer subjects: two minutes")
    add("--out", "-o", type=Path, default=BENCH_OUT, help=f"with --all or --quick: output folder; default {BENCH_OUT}")
    add("--against", type=Path, metavar="figures.json", help="with --all or --quick: print figures worse than there")
    add("subject", nargs="?", metavar="SUBJECT", help="subject to measure; see --list")
    add("rest", nargs=argparse.REMAINDER, metavar="...", help="options of the subject; see SUBJECT --help")


def run_bench(arguments: argparse.Namespace, subjects: Subjects | None = None, whole: Whole | None = None) -> None:
    """List the subjects, or measure one or all, print the table and, with a folder, save it there.

    subjects, whole: by default those of `stillbed bench`.
    """
    from hardware.bench.subjects import BENCH_WHOLE, SUBJECTS

    subjects, whole = SUBJECTS if subjects is None else subjects, BENCH_WHOLE if whole is None else whole
    name = arguments.subject
    if arguments.all or arguments.quick:
        from hardware.bench.whole import run_whole

        run_whole(arguments.out, arguments.quick, arguments.against, whole)
    elif arguments.list or name is None:
        width = max(map(len, subjects), default=0)
        print("\n".join(f"{key:<{width}}  {subject.summary}" for key, subject in subjects.items()))
    elif name not in subjects:
        from hardware.process.checks import one_of_text

        raise option_error("SUBJECT", name, one_of_text(name, list(subjects)) + whole.elsewhere)
    else:
        options = subject_parser(name, subjects[name]).parse_args(arguments.rest)
        arguments.out = options.out  # for the message after an interrupt
        _measure_subject(name, subjects[name], options)


def subject_parser(name: str, subject: Subject) -> argparse.ArgumentParser:
    """The parser of one subject: output folder, and its own options."""
    parser = Parser(prog=f"{subject.program} {name}", description=subject.summary)
    parser.add_argument("-o", "--out", type=Path, help="output folder for figures.json, new or empty")
    parser.add_argument("--force", action="store_true", help="write into a folder that is not empty")
    subject.add_options(parser)
    return parser


def _measure_subject(name: str, subject: Subject, options: argparse.Namespace) -> None:
    from hardware.bench.figures import save, table_text, this_machine

    if options.out is not None:
        prepare_out(options.out, options.force)
    machine = this_machine()
    print(f"{machine.cpu}, {machine.cores} cores, commit {machine.commit or 'unknown'}\n", flush=True)
    figures = subject.run(options)
    print(table_text(figures))
    if options.out is not None:
        save(options.out, name, vars(options), figures, machine)


def add_doctor(commands: Commands) -> None:
    """Add the sub-command `doctor`."""
    add = commands.add(
        "doctor",
        _run_doctor,
        "check this machine; say how to repair what fails",
        "Check the processor, memory, disk, priority, libraries, cameras, serial ports and the shipped network.\n"
        "For each: is it sufficient for a live run, and if not, what to do. Moves nothing and writes nothing.\n"
        "Exit code: 1 if a check fails, 0 if there are only warnings.",
        "stillbed doctor",
    ).add_argument
    add("--folder", type=Path, default=Path(), metavar="DIR", help="folder where sessions will be recorded")
    add("--json", action="store_true", help="print JSON")


def _run_doctor(a: argparse.Namespace) -> int:
    import json
    from dataclasses import asdict

    from hardware.cli.doctor import device_checks, extras_check, library_checks, machine_checks
    from hardware.live.checklist import checks_table
    from hardware.operator.view import CheckVerdict

    if not a.folder.is_dir():
        raise option_error("--folder", a.folder, "a folder that exists")
    libraries = [*library_checks(), extras_check()]
    machine = machine_checks(a.folder, wall_clock())
    broken = any(check.verdict is CheckVerdict.FAIL for check in libraries)
    parts = {"machine": machine, "libraries": libraries, "devices": [] if broken else device_checks()}
    verdicts = [check.verdict for part in parts.values() for check in part]
    if a.json:
        print(json.dumps({name: [asdict(check) for check in part] for name, part in parts.items()}, indent=2))
    else:
        print("\n\n".join(f"{name}\n{checks_table(tuple(part), sys.stdout)}" for name, part in parts.items() if part))
        print(f"\n{_verdict_text(verdicts, broken)}")
    return FAILED if CheckVerdict.FAIL in verdicts else 0


def _verdict_text(verdicts: list[CheckVerdict], broken: bool) -> str:
    failed, warned = (sum(v.value == verdict_name for v in verdicts) for verdict_name in ("fail", "warn"))
    if broken:
        return "libraries are missing; devices were not checked. Repair the libraries first, then repeat"
    if failed:
        return f"{failed} failed: stillbed does not work here until this is repaired"
    if warned:
        return f"all requirements are met; {warned} to check before a live run"
    return "all checks passed; next: make demo, or stillbed init FOLDER"


def add_cache(commands: Commands) -> None:
    """Add the sub-command `cache`."""
    add = commands.add(
        "cache",
        _run_cache,
        "list the cache of rendered scenes, or clear it",
        "List the cache: scenes rendered by `stillbed live --simulated`, and pictures rendered by `stillbed\n"
        "simulate`, with the size of each. The key is the content of the scenario's files; a missing scene is\n"
        "rendered again.",
        "stillbed cache",
        "stillbed cache --clear",
    ).add_argument
    add("--clear", action="store_true", help="remove all of them")


def _run_cache(a: argparse.Namespace) -> None:
    from hardware.process.progress import clear_cache, count_text, folder_size, size_text

    cache = cache_folder()
    if a.clear:
        count, size = clear_cache(cache)
        print(f"{count_text(count, 'scene')} removed from {cache}: {size_text(size)}")
        return
    scenes = sorted(folder for folder in cache.glob("*") if (folder / "scenario").is_file())
    for folder in scenes:
        scenario = (folder / "scenario").read_text(encoding="utf-8")
        print(f"{size_text(folder_size(folder)):>9}  {folder.name}: {scenario}")
    print(f"{count_text(len(scenes), 'scene')} in {cache}: {size_text(sum(map(folder_size, scenes)))}")


def main(argv: Sequence[str] | None = None) -> int:
    """Run one sub-command; returns its exit code.

    0, 1 where a simulation misses its limits, 2 for wrong input (one line on stderr), 130 after Ctrl-C.
    """
    fill_standard_streams()
    argv_words = sys.argv[1:] if argv is None else argv
    try:
        commands = parser(argv_words[0] if argv_words else "")
        if "_ARGCOMPLETE" in os.environ:  # completion by a shell
            import argcomplete

            argcomplete.autocomplete(commands)
        arguments = commands.parse_args(argv_words)
        os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # before numpy: threads do not help for small matrices
        with nullcontext() if argv is not None else FirstWord(arguments.command):  # only in a process of its own
            return _run(arguments)
    except KeyboardInterrupt:  # before the command has begun
        print("\nstillbed: interrupted; nothing was written", file=sys.stderr)
        return INTERRUPTED


def _run(arguments: argparse.Namespace) -> int:
    """Run the parsed command; its exit code."""
    from hardware.process.system import state_inputs

    state_inputs(input_files(arguments))
    code: int | None = None
    out = written_path(arguments)
    existed = out is not None and out.exists()
    try:
        if threading.current_thread() is threading.main_thread():  # signals need the main thread
            signal.signal(signal.SIGTERM, signal.default_int_handler)  # ends this process as Ctrl-C does
        code = arguments.run(arguments)
        sys.stdout.flush()
    except BrokenPipeError:  # as after `| head`; the files are written
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    except (StillbedError, OSError) as error:
        nameless = isinstance(error, OSError) and error.filename is None and error.strerror
        message = write_error_text(error, out) if nameless else error_text(error)
        if nameless and out is None and getattr(arguments, "log", None) is not None:
            message = f"{arguments.log}: {message}; its last rows may be missing"
        print(f"stillbed: {painted(message, BAD, sys.stderr)}", file=sys.stderr)
        if out is not None and not existed:
            with suppress(OSError):
                out.rmdir()  # created for nothing; only if empty
        return WRONG_INPUT
    except (KeyboardInterrupt, ImportError) as error:
        if isinstance(error, ImportError) and not isinstance(error.__cause__, KeyboardInterrupt):
            raise  # Ctrl-C while gtsam loads
        print(f"\nstillbed: interrupted; {left_files_text(written_path(arguments))}", file=sys.stderr)
        return INTERRUPTED
    return code or 0


def written_path(arguments: argparse.Namespace) -> Path | None:
    """The output path of the command: folder or file of results, else its recording; None without one."""
    return next((path for name in WRITTEN_OPTIONS[:2] if (path := getattr(arguments, name, None)) is not None), None)


def input_files(arguments: argparse.Namespace) -> list[Path]:
    """Existing files and folders of the command line that are not written to."""
    values = [value for name, value in vars(arguments).items() if name not in WRITTEN_OPTIONS]
    candidates = [each for value in values for each in (value if isinstance(value, list) else [value])]
    return [each for each in candidates if isinstance(each, Path) and each != Path() and each.exists()]


class _Version(argparse.Action):
    """Prints the installed version."""

    def __call__(self, parser: argparse.ArgumentParser, *_: object) -> None:
        from hardware.process.system import stillbed_version

        version = stillbed_version()
        print(f"stillbed {version}" if version else "stillbed, not installed")
        parser.exit()


def add_simulate(commands: Commands) -> None:
    """Add the sub-command `simulate`."""
    from perception import named_path

    add = commands.add(
        "simulate",
        _simulate,
        "print on a simulated wound; measure the nozzle error",
        "Run a scenario in virtual time: a moving wound, its cameras, the tracking and motion code of a live run,\n"
        "and a virtual arm. Every millisecond the nozzle is compared with its true checkpoint.\n"
        "Writes the session (MCAP and folder), tracking/, commands.csv, frames.bin, nozzle.csv, summary.json and\n"
        "report.html. Exit code: 0 if the limits in the scenario are met, 1 if not.",
        "stillbed simulate data/scenarios/breathing_calm.toml -o out/calm",
    ).add_argument
    add("scenario", type=named_path, metavar="SCENARIO.toml", help="scenario; see data/scenarios")
    add("-o", "--out", type=Path, required=True, help="output folder, new or empty")
    add("--trace", type=Path, metavar="FILE", help="recorded motion, TUM or CSV, instead of the scenario's")
    add_fault(add)
    add("--threads", type=int, default=2, metavar="N", help="rendering threads; they do not change the results")
    add("--open", action="store_true", help="open the page of the run in a browser")
    add("--force", action="store_true", help="write into a folder that is not empty")


def _simulate(a: argparse.Namespace) -> int:
    from estimation.runtime import load_scipy
    from hardware.process.checks import read_toml
    from hardware.process.faults import faults_from_texts

    read_toml(a.scenario)  # reports a wrong file before the simulator is loaded
    load_scipy()
    from hardware.simulator.simulate import SimulationOptions, run_simulation

    faults = faults_from_texts("command line", "--fault", a.fault)
    options = SimulationOptions(a.trace, faults, a.threads, a.force, a.open, cache_folder())
    outcome = run_simulation(a.scenario, a.out, options)
    print(outcome.text)
    return 0 if outcome.met else FAILED


def _elsewhere(place: str) -> Callable[[Commands], None]:
    """The function that adds a command, from its module in this folder and its name; imported when called."""

    def add(commands: Commands) -> None:
        module, name = place.split(":")
        getattr(import_module(f"hardware.cli.{module}"), name)(commands)

    return add


COMMANDS = {  # functions that add each
    "simulate": add_simulate,
    "track": _elsewhere("sessions:add_track"),
    "smooth": _elsewhere("sessions:add_smooth"),
    "compare": _elsewhere("sessions:add_compare"),
    "view": _elsewhere("sessions:add_view"),
    "segment": _elsewhere("plan:add_segment"),
    "scan": _elsewhere("plan:add_scan"),
    "plan": _elsewhere("plan:add_plan"),
    "live": _elsewhere("live:add_live"),
    "record": _elsewhere("live:add_record"),
    "trace": _elsewhere("sessions:add_trace"),
    "init": _elsewhere("live:add_init"),
    "replay": _elsewhere("sessions:add_replay"),
    "calibrate": _elsewhere("calibrate:add_calibrate"),
    "reach": _elsewhere("plan:add_reach"),
    "arm": _elsewhere("live:add_arm"),
    "dispenser": _elsewhere("dispenser:add_dispenser"),
    "cameras": _elsewhere("live:add_cameras"),
    "import": _elsewhere("sessions:add_import"),
    "export": _elsewhere("sessions:add_export"),
    "train": _elsewhere("plan:add_train"),
    "bench": add_bench,
    "doctor": add_doctor,
    "cache": add_cache,
}


def parser(command: str = "") -> Parser:
    """The parser of all commands; with the name of a command, only of that command."""
    top = Parser(
        prog="stillbed",
        description="Make a moving wound look like a still print bed.",
        epilog="A SESSION is a folder with rig.toml and frames.csv, or an .mcap file. More: stillbed COMMAND --help",
    )
    top.add_argument("--version", action=_Version, nargs=0, help="print the version and exit")
    commands = Commands(top, "COMMAND")
    for add in (COMMANDS[command],) if command in COMMANDS else COMMANDS.values():
        add(commands)
    return top


if __name__ == "__main__":
    sys.exit(main())
