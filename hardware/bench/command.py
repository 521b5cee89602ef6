"""`stillbed bench`: its command line, and one run of a subject."""

from __future__ import annotations

import argparse
from pathlib import Path

from hardware.bench.subjects import SUBJECTS, Subject, Subjects
from hardware.cli.parser import Commands, Parser

WHOLE = Path("out/bench")


def add_bench(commands: Commands) -> None:
    """Add the sub-command `bench`; what follows its subject is read once the subject's module is loaded."""
    command: argparse.ArgumentParser = commands.add_parser(
        "bench",
        help="measure a part, and print each figure beside its target",
        description="Measure a part of stillbed and print each figure beside its target and its reference.",
        epilog="examples:\n  stillbed bench estimator -o out/estimator\n  stillbed bench --quick",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    command.add_argument("--list", action="store_true", help="list the subjects and exit")
    command.add_argument(
        "--all", action="store_true", help="measure all subjects, each in short; what is there is kept"
    )
    command.add_argument("--quick", action="store_true", help="the same of fewer subjects, in two minutes")
    command.add_argument(
        "--out", "-o", type=Path, default=WHOLE, help=f"with --all or --quick: folder; default {WHOLE}"
    )
    command.add_argument(
        "--against", type=Path, metavar="figures.json", help="with --all or --quick: tell what is worse than there"
    )
    command.add_argument("subject", nargs="?", metavar="SUBJECT", help="what to measure; see --list")
    command.add_argument("rest", nargs=argparse.REMAINDER, metavar="...", help="its options; see SUBJECT --help")
    command.set_defaults(run=lambda arguments: run_bench(arguments))


def run_bench(arguments: argparse.Namespace, subjects: Subjects = SUBJECTS) -> None:
    """List the subjects, or measure one or all, print the table and, where a folder was named, save it there."""
    if arguments.all or arguments.quick:
        from hardware.bench.whole import run_whole

        run_whole(arguments.out, arguments.quick, arguments.against)
        return
    if arguments.list or arguments.subject is None:
        print(subjects_text(subjects))
        return
    name, subject = arguments.subject, _chosen(arguments.subject, subjects)
    options = subject_parser(name, subject).parse_args(arguments.rest)
    arguments.out = out = options.out  # told where the run is interrupted
    _measure(name, subject, options, out)


def subjects_text(subjects: Subjects) -> str:
    """The subjects, a line each."""
    width = max(map(len, subjects), default=0)
    return "\n".join(f"{name:<{width}}  {subject.summary}" for name, subject in subjects.items())


def _chosen(name: str, subjects: Subjects) -> Subject:
    from estimation.errors import InputError
    from hardware.process.checks import meant

    if name not in subjects:
        raise InputError("command line", "SUBJECT", name, meant(name, list(subjects)))
    return subjects[name]


def subject_parser(name: str, subject: Subject) -> argparse.ArgumentParser:
    """The options of one subject: where to save, and its own."""
    parser = Parser(prog=f"stillbed bench {name}", description=subject.summary)
    parser.add_argument("-o", "--out", type=Path, help="folder for figures.json and figures.csv, new or empty")
    parser.add_argument("--force", action="store_true", help="write into a folder that is not empty")
    subject.add_options(parser)
    return parser


def _measure(name: str, subject: Subject, options: argparse.Namespace, out: Path | None) -> None:
    from hardware.bench.machine import this_machine
    from hardware.bench.saved import save
    from hardware.bench.table import table_text
    from hardware.out_folder import prepare_out

    if out is not None:
        prepare_out(out, options.force)
    machine = this_machine()
    print(f"{machine.cpu}, {machine.cores} cores, commit {machine.commit or 'unknown'}\n", flush=True)
    figures = subject.run(options)
    print(table_text(figures))
    if out is not None:
        save(out, name, vars(options), figures, machine)
