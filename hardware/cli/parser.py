"""Common code of all commands: parsers, option types, error texts, and the entry of scripts (docs/examples)."""

from __future__ import annotations

import argparse
import math
import re
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

from estimation.errors import InputError, StillbedError
from hardware.process.progress import BAD, Progress, painted

if TYPE_CHECKING:
    from hardware.arm.profile import ArmProfile
    from hardware.process.clock import WallClock

Run = Callable[[argparse.Namespace], int | None]  # a command: its exit code, None for 0
FAULT_TEXT = 'a fault to inject, such as "camera0 stuck at 5s for 2s"; repeatable; see docs/faults.md'
ROI_HELP = "a file with a table [region]: the surface's region in the pictures; see docs/live.md"
MODEL_HELP = "network that segments the wound, as `stillbed train` writes it; default: the shipped one"
FAILED = 1  # exit code of a command whose result is not good enough
WRONG_INPUT = 2  # exit code
INTERRUPTED = 130  # exit code after Ctrl-C
MAX_LISTED = 8  # choices that an error lists
WRONG_CHOICE = re.compile(r"invalid choice: '(.*?)' \(choose from (.*)\)")  # message of argparse
USAGE = re.compile(r"python \S+\.py.*?(?=\s{2,}|$)", re.MULTILINE)  # a line of the docstring


class Parser(argparse.ArgumentParser):
    """Reports a wrong command line in one line, like all wrong input, and refers to --help."""

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        """As its base; an unknown option is reported first, with a similar known option."""
        options, has_remainder = (
            list(self._option_string_actions),
            any(a.nargs == argparse.REMAINDER for a in self._actions),
        )
        for word in () if self._subparsers is not None or has_remainder else args or ():
            name = word.partition("=")[0]
            if word == "--":
                break
            abbreviates = any(each.startswith(name) for each in options)
            if name.startswith("--") and not abbreviates:
                self.error(f"unknown option {name}{suggestion_text(name, options)}")
        return super().parse_known_args(args, namespace)

    def error(self, message: str) -> NoReturn:
        """Print the line, and exit."""
        if (choice := WRONG_CHOICE.search(message)) is not None:
            choices = re.findall(r"'([^']+)'", choice[2]) or choice[2].split(", ")  # newer Pythons do not quote them
            listed = f"; allowed: {', '.join(choices)}" if len(choices) <= MAX_LISTED else ""  # the help lists all
            suggestion = suggestion_text(choice[1], choices)
            message = f"{message[: choice.start()]}{choice[1]!r} is unknown{suggestion}{listed}"
        print(f"{self.prog}: {painted(message, BAD, sys.stderr)}; see {self.prog} --help", file=sys.stderr)
        sys.exit(WRONG_INPUT)


def suggestion_text(word: str, choices: Sequence[str]) -> str:
    """A suggestion for a misspelt word, if one of the choices is similar; else ""."""
    import difflib  # slow import, as inspect and the clock below

    matches = difflib.get_close_matches(word.partition("=")[0], choices, 1)
    return f"; did you mean {matches[0]}?" if matches else ""


class Commands:
    """The sub-commands of a parser."""

    def __init__(self, parser: argparse.ArgumentParser, metavar: str) -> None:
        self._parsers = parser.add_subparsers(metavar=metavar, required=True)

    def add(self, name: str, run: Run | None, summary: str, text: str, *examples: str) -> argparse.ArgumentParser:
        """Add one: its function, its line in the list of commands, its description, and examples."""
        lines = "".join(f"\n  {example}" for example in examples)
        parser = self._parsers.add_parser(
            name,
            help=summary,
            description=text,
            epilog=f"example{'s' if len(examples) > 1 else ''}:{lines}",
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )
        parser.set_defaults(run=run, command=parser.prog)
        return parser


def error_text(error: Exception) -> str:
    """The message of an error (a system error begins with its file), with a suggestion for a misspelt name."""
    from hardware.process.checks import near_file_text

    if isinstance(error, OSError) and error.filename is not None and error.strerror:
        return f"{error.filename}: {error.strerror.lower()}{near_file_text(error.filename)}"
    suggestion = near_file_text(error.got, error.where) if isinstance(error, InputError) else ""
    return f"{error}{suggestion}"


def option_error(option: str, got: object, allowed: str) -> InputError:
    """The error about an option of the command line."""
    return InputError("command line", option, got, allowed)


def damage_code(damage: str) -> int:
    """Print the damage of a recording, if any; the exit code of a command that used it."""
    from hardware.files.session import damage_text

    if text := damage_text(damage):
        print(text)
    return FAILED if damage else 0


def wall_clock() -> WallClock:
    """The machine's clock."""
    from hardware.process.clock import WallClock

    return WallClock()


def progress_bar(what: str, unit: str) -> Progress:
    """Progress by the machine's clock, on stderr."""
    return Progress(what, unit, wall_clock().now)


def arm_profile(path: Path | None) -> ArmProfile:
    """The profile in an arm file, or the default one."""
    from hardware.arm.profile import ArmProfile
    from hardware.files.arm_file import read_arm

    return ArmProfile() if path is None else read_arm(path)


def _number_type(accepts: Callable[[float], bool], allowed: str) -> Callable[[str], float]:
    """An option type: finite numbers for which `accepts` is true. allowed: the condition as a text."""

    def number(text: str) -> float:
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not (math.isfinite(value) and accepts(value)):
            raise argparse.ArgumentTypeError(f"{text!r}, needed is {allowed}")
        return value

    return number


positive = _number_type(lambda value: value > 0, "a number above 0")
not_negative = _number_type(lambda value: value >= 0, "a number, 0 or more")


def add_fault(add: Callable[..., Any], text: str = FAULT_TEXT) -> None:
    """Add the option `--fault` of a simulated or replayed run."""
    add("--fault", action="append", default=[], metavar="FAULT", help=text)


def run_script(main: Callable[..., None], text: str | None, arguments: Sequence[str] | None = None) -> NoReturn:
    """Call `main` with the arguments of the command line, and exit: 0, or 2 for wrong input, reported in one line.

    text: the program's docstring with its usage line: printed for --help; only the usage line if arguments are
    missing, too many, or not a number for a parameter of `main` that is one.
    """
    sys.exit(_run(main, (text or "").strip(), sys.argv[1:] if arguments is None else arguments))


def _run(main: Callable[..., None], text: str, arguments: Sequence[str]) -> int:
    if {"-h", "--help"} & set(arguments):
        print(text)
        return 0
    try:
        values = _read(main, arguments)
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


def _read(main: Callable[..., None], arguments: Sequence[str]) -> list[Any]:
    """The arguments, converted to numbers where main expects them; TypeError or ValueError for wrong arguments."""
    import inspect

    signature = inspect.signature(main)
    signature.bind(*arguments)
    if any(argument.startswith("--") for argument in arguments):
        raise ValueError
    parameters = signature.parameters.values()
    numbers = [isinstance(parameter.default, float) for parameter in parameters]
    return [float(argument) if number else argument for argument, number in zip(arguments, numbers, strict=False)]
