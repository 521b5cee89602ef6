"""What all processes of a run do first, and how each learns that the one that conducts the run is gone."""

from __future__ import annotations

import os
import signal
from collections.abc import Sequence
from contextlib import suppress
from multiprocessing.connection import Connection
from pathlib import Path


def settle(name: str, cores: Sequence[int] = (), nice: int = 0) -> None:
    """Be a process group of one's own and leave Ctrl-C and a closed terminal to whoever conducts the run.

    name: by which ps and top show the process. cores: to run on, all without any. nice: to be added to the priority.
    """
    with suppress(OSError):
        Path("/proc/self/comm").write_text(f"sb-{name}", encoding="ascii")
        os.setpgid(0, 0)
    for number in (signal.SIGINT, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    if cores:
        with suppress(OSError, ValueError):
            os.sched_setaffinity(0, cores)
    if nice:
        os.nice(nice)


def gone(lifeline: Connection) -> bool:
    """Whether the other end of a pipe on which nothing is ever said was closed."""
    try:
        return lifeline.poll()
    except OSError:
        return True
