"""What all commands share: their parsers, their refusals, and the entry of a script such as those in docs/examples."""

from __future__ import annotations

import argparse
import inspect
import math
import re
import sys
from collections.abc import Callable, Sequence
from typing import Any, NoReturn

from estimation.errors import StillbedError

Commands = Any  # argparse's own type for this is private
WRONG_INPUT = 2  # exit codes
INTERRUPTED = 130  # what a shell expects after Ctrl-C
USAGE = re.compile(r"python \S+\.py.*?(?=\s{2,}|$)", re.MULTILINE)  # a line of the docstring


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


def error_text(error: Exception) -> str:
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


def add_fault(command: argparse.ArgumentParser) -> None:
    """Add the option `--fault` of a simulated or replayed run."""
    command.add_argument(
        "--fault",
        action="append",
        default=[],
        metavar="FAULT",
        help='what goes wrong, such as "camera0 stuck at 5s for 2s"; may be given more than once; see docs/faults.md',
    )


def run_script(main: Callable[..., None], text: str | None, words: Sequence[str] | None = None) -> NoReturn:
    """Call `main` with the words of the command line, and exit: 0, or 2 for wrong input, which is told in one line.

    text: the program's docstring, which shows how it is started: printed for --help; that line alone where words are
    missing, too many, or no number where `main` has one.
    """
    sys.exit(_run(main, (text or "").strip(), sys.argv[1:] if words is None else words))


def _run(main: Callable[..., None], text: str, words: Sequence[str]) -> int:
    if {"-h", "--help"} & set(words):
        print(text)
        return 0
    try:
        values = _read(main, words)
    except (TypeError, ValueError):
        usage = USAGE.search(text)
        print(f"usage: {text if usage is None else usage[0]}", file=sys.stderr)
        return WRONG_INPUT
    try:
        main(*values)
    except (StillbedError, OSError) as error:
        print(error_text(error), file=sys.stderr)
        return WRONG_INPUT
    return 0


def _read(main: Callable[..., None], words: Sequence[str]) -> list[Any]:
    """The words, those that stand for a number as numbers; TypeError or ValueError where they are none of main's."""
    signature = inspect.signature(main)
    signature.bind(*words)
    if any(word.startswith("--") for word in words):
        raise ValueError
    parameters = signature.parameters.values()
    numbers = [isinstance(parameter.default, float) for parameter in parameters]
    return [float(word) if number else word for word, number in zip(words, numbers, strict=False)]
