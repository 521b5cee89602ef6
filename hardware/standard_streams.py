"""Standard input, output and errors of a process that was started without them, as services and `>&-` do."""

from __future__ import annotations

import os
import sys

STREAMS = (("stdin", "r"), ("stdout", "w"), ("stderr", "w"))


def fill_standard_streams() -> None:
    """Put the null device where a stream was closed, so that nothing opened later takes its number, here or below."""
    for name, mode in STREAMS:
        if getattr(sys, name) is None:
            file = os.open(os.devnull, os.O_RDONLY if mode == "r" else os.O_WRONLY)
            os.set_inheritable(file, True)
            setattr(sys, name, os.fdopen(file, mode, encoding="utf-8"))
