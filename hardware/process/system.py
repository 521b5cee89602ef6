"""What a process asks of the system: priority, cores, signals, standard streams, and to end with its parent."""

from __future__ import annotations

import gc
import os
import signal
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from multiprocessing import parent_process, resource_tracker
from multiprocessing.connection import Connection, wait
from pathlib import Path
from threading import Thread
from typing import Any


def exit_with_parent() -> None:
    """From now on this process, which multiprocessing started, ends as soon as the one that started it has ended.

    One that is killed says nothing to a process that waits for work from it.
    """
    parent = parent_process()
    assert parent is not None
    sentinel = parent.sentinel

    def exit_after() -> None:
        try:
            wait([sentinel])
        finally:
            os._exit(1)

    Thread(target=exit_after, daemon=True).start()


@contextmanager
def blocked_sigint() -> Iterator[None]:
    """Ctrl-C waits until the block is left; a process that is started in it never sees one."""
    resource_tracker.ensure_running()  # by itself it would start in the block, and let Ctrl-C through again
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


STANDARD_STREAMS = (("stdin", "r"), ("stdout", "w"), ("stderr", "w"))


def fill_standard_streams() -> None:
    """Put the null device where a stream was closed, so that nothing opened later takes its number, here or below."""
    for name, mode in STANDARD_STREAMS:
        if getattr(sys, name) is None:
            file = os.open(os.devnull, os.O_RDONLY if mode == "r" else os.O_WRONLY)
            os.set_inheritable(file, True)
            setattr(sys, name, os.fdopen(file, mode, encoding="utf-8"))


REAL_TIME_PRIORITY = 10  # of 1 to 99: above all ordinary work, below the kernel's own
NICE_LEVEL = -10  # before all that asked for nothing
NO_PRIORITY = "nothing: an ordinary process"  # what is granted where no priority is


def settle_memory() -> None:
    """Leave what is there by now out of garbage collection: to look through all that is loaded takes 0.1 to 0.3 s."""
    gc.collect()
    gc.freeze()


def ask_for_real_time() -> str:
    """Take the best priority that is granted, and leave what is loaded out of garbage collection; what was granted."""
    settle_memory()
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(REAL_TIME_PRIORITY))
        return f"real time, priority {REAL_TIME_PRIORITY}"
    except (AttributeError, OSError):
        pass
    return ask_to_go_first()


def ask_to_go_first() -> str:
    """Be served before ordinary processes, which still get their share; what was granted. Children inherit it."""
    try:
        return f"nice {os.nice(NICE_LEVEL)}"
    except OSError:
        return NO_PRIORITY


def set_up_process(name: str, cores: Sequence[int] = (), nice: int = 0) -> None:
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


def take_messages(connection: Connection) -> tuple[list[Any], bool]:
    """The objects that have come, and whether the other end is closed."""
    messages: list[Any] = []
    try:
        while connection.poll():
            messages.append(connection.recv())
    except (EOFError, OSError):
        return messages, True
    return messages, False


def pipe_closed(lifeline: Connection) -> bool:
    """Whether the other end of a pipe on which nothing is ever said was closed."""
    try:
        return lifeline.poll()
    except OSError:
        return True
