"""Ctrl-C while a process starts that leaves Ctrl-C to its parent: it has yet to load what would ignore it."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from multiprocessing import resource_tracker


@contextmanager
def held_interrupt() -> Iterator[None]:
    """Ctrl-C waits until the block is left; a process that is started in it never sees one."""
    resource_tracker.ensure_running()  # by itself it would start in the block, and let Ctrl-C through again
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
