"""What the parsers of all commands share: how they are made, and how they refuse."""

from __future__ import annotations

import argparse
import math
import sys
from typing import Any, NoReturn

Commands = Any  # argparse's own type for this is private
WRONG_INPUT = 2  # exit codes
INTERRUPTED = 130  # what a shell expects after Ctrl-C


class Parser(argparse.ArgumentParser):
    """Tells a wrong command line in one line, as all wrong input is told, and where its options stand."""

    def error(self, message: str) -> NoReturn:
        """Print the line, and exit."""
        print(f"{self.prog}: {message}; see {self.prog} --help", file=sys.stderr)
        sys.exit(WRONG_INPUT)


def add_command(commands: Commands, name: str, summary: str, text: str, *examples: str) -> argparse.ArgumentParser:
    """Add a sub-command: a line for the list of commands, what it does, and how it is called."""
    lines = "".join(f"\n  {example}" for example in examples)
    made: argparse.ArgumentParser = commands.add_parser(
        name,
        help=summary,
        description=text,
        epilog=f"example{'s' if len(examples) > 1 else ''}:{lines}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    return made


def told(error: Exception) -> str:
    """What was wrong; of what the system refuses, the file first, as everywhere."""
    if isinstance(error, OSError) and error.filename is not None and error.strerror:
        return f"{error.filename}: {error.strerror.lower()}"
    return str(error)


def positive(text: str) -> float:
    """A finite number above 0."""
    value = _number(text)
    if not value > 0:
        raise argparse.ArgumentTypeError(f"{text!r}, needed is a number above 0")
    return value


def not_negative(text: str) -> float:
    """A finite number, 0 or more."""
    value = _number(text)
    if not value >= 0:
        raise argparse.ArgumentTypeError(f"{text!r}, needed is a number, 0 or more")
    return value


def _number(text: str) -> float:
    """NaN where it is no finite number."""
    try:
        value = float(text)
    except ValueError:
        return math.nan
    return value if math.isfinite(value) else math.nan
