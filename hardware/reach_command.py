"""`stillbed reach`: its command line; what does the work is loaded when it is asked for."""

from __future__ import annotations

import argparse
from pathlib import Path

from hardware.cli.parser import Commands, add_command, not_negative
from perception.package_data import named_path

UNREACHED = 1  # exit code where a checkpoint cannot be printed


def add_reach(commands: Commands) -> None:
    """Add the sub-command `reach`."""
    command = add_command(
        commands,
        "reach",
        "check, before printing, that an arm can print a path",
        "Check each checkpoint of a path against the arm's joints: reach, ranges, speeds, singularities,\n"
        "on the surface at rest and wherever it moves to. Prints a table; with -o also writes path.csv (the path with\n"
        "the column `feasible`), reach.csv (joints and distances of each checkpoint) and reach.html (pictures).\n"
        "Exit code 0 where all can be printed, 1 where not.",
        "stillbed reach data/paths/wound_raster.csv --arm data/arms/s6h4d.toml --amplitude-mm 10",
    )
    command.add_argument("path", type=named_path, metavar="PATH.csv", help="checkpoints on the surface")
    command.add_argument("--arm", type=named_path, required=True, metavar="ARM.toml", help="with a table [kinematics]")
    command.add_argument(
        "--surface",
        type=_six,
        metavar="X,Y,Z,A,B,C",
        help="the surface at rest in the arm's frame, mm and degrees; default: level, under the default arm's home",
    )
    command.add_argument(
        "--amplitude-mm", type=not_negative, default=0.0, metavar="MM", help="of its motion along its normal"
    )
    command.add_argument(
        "--turn-deg", type=not_negative, default=0.0, metavar="DEG", help="of its motion about x, y and z"
    )
    command.add_argument(
        "--rate-hz", type=not_negative, default=0.25, metavar="HZ", help="of that motion; default 0.25"
    )
    command.add_argument("--spin", action="store_true", help="let the tool spin about its own axis where that helps")
    command.add_argument("-o", "--out", type=Path, metavar="OUT", help="folder to write to, new or empty")
    command.add_argument("--force", action="store_true", help="write into a folder that is not empty")
    command.set_defaults(run=_reach)


def _six(text: str) -> tuple[float, ...]:
    try:
        values = tuple(float(word) for word in text.split(","))
    except ValueError:
        values = ()
    if len(values) != 6:
        raise argparse.ArgumentTypeError(f"{text!r}, needed are 6 numbers: X,Y,Z,A,B,C")
    return values


def _reach(arguments: argparse.Namespace) -> int:
    from hardware.offline.reach import Question, run_reach

    a = arguments
    question = Question(a.surface, a.amplitude_mm, a.turn_deg, a.rate_hz, a.spin)
    answer = run_reach(a.path, a.arm, question, a.out, a.force)
    print(answer.text)
    return 0 if answer.feasible else UNREACHED
