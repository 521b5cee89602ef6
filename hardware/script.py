"""A program of one's own that is started from a terminal, as those in docs/examples are."""

from __future__ import annotations

import inspect
import re
import sys
from collections.abc import Callable, Sequence
from typing import Any, NoReturn

from estimation.errors import StillbedError
from hardware.cli.parser import WRONG_INPUT, told

USAGE = re.compile(r"python \S+\.py.*?(?=\s{2,}|$)", re.MULTILINE)  # a line of the docstring


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
        given = _read(main, words)
    except (TypeError, ValueError):
        found = USAGE.search(text)
        print(f"usage: {text if found is None else found[0]}", file=sys.stderr)
        return WRONG_INPUT
    try:
        main(*given)
    except (StillbedError, OSError) as error:
        print(told(error), file=sys.stderr)
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
