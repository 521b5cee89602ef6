"""python -m tests.campaigns NAME: long campaigns that show what the suite can only touch; without a name, a list.

Each draws from a seed what goes wrong, judges what came of it, prints a table of figures beside their targets and, with
-o FOLDER, writes them and a page there.
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # before numpy, as the command line does

import argparse
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path

from estimation.errors import StillbedError
from hardware.bench.subjects import SEED, Subject, Subjects, add_options, number, option, positive
from hardware.cli.main import run_bench

PROGRAM = "python -m tests.campaigns"


def _campaign(name: str, module: str, summary: str) -> Callable[..., tuple[str, Subject]]:
    function = f"tests.campaigns.{module}:run_{name}"
    return lambda *options: (name, Subject(function, partial(add_options, options), summary, PROGRAM))


CAMPAIGNS: Subjects = dict(
    (
        _campaign("faults", "faults", "prints in which everything goes wrong: said, harmless, back soon?")(
            number("--count", 60, None, "faults, of all kinds in turn (default: 60)"),
            number("--seed", 1, None, "of all that chance decides (default: 1)"),
            number("--jobs", 1, None, "processes that share the runs (default: 1)"),
            option("--log", type=Path, metavar="X.csv", help="what came of each fault; runs in it are not repeated"),
            option("--scenarios", type=Path, metavar="FOLDER", help="where the scenarios are (default: the shipped)"),
        ),
        _campaign("fuzz", "fuzz", "every reader of what comes from outside, given what is nearly valid")(
            number("--count", 20_000, None, "inputs, of all readers in equal shares (default: 20000)"),
            number("--seed", 1, None, "of what is made wrong (default: 1)"),
            option("--only", metavar="READER", help="one reader; see the table for their names"),
            number("--jobs", 1, None, "readers at a time, a process each (default: 1)"),
            option(
                "--log",
                type=Path,
                metavar="X.csv",
                help="how far each reader is, and what went wrong; goes on from there",
            ),
        ),
        _campaign("guard", "guard", "random commands on and beside all limits before the guard")(
            number("--commands", 100_000, "N", "random ones (default: 100000)"), SEED
        ),
        _campaign("link", "link", "the arm's line in virtual time with everything going wrong")(
            number("--hours", 1.0, "H", "of virtual time; default 1"),
            number("--baud", 115_200, "B", "of the line"),
            SEED,
        ),
        _campaign("outages", "outages", "cameras covered, dead, frozen, swapped, bumped: lost in silence?")(
            option("--count", type=positive, default=66, help="outages, of all kinds in turn (default: 66)"),
            number("--seed", 0, None, "of scenes, motions and outages (default: 0)"),
            option("--processes", type=positive, default=2, help="that share the scenes (default: 2)"),
        ),
    )
)


def main(words: list[str]) -> int:
    """Run what the words of a command line ask for; the exit code."""
    whole = {"all": False, "quick": False, "out": None, "list": not words}
    chosen = argparse.Namespace(subject=words[0] if words else None, rest=words[1:], **whole)
    try:
        run_bench(chosen, CAMPAIGNS)
    except StillbedError as error:
        print(error, file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
