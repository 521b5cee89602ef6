"""Processes that share the work of a bench, and end with whoever started them, however that ends."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from multiprocessing import get_context, parent_process
from multiprocessing.connection import wait
from threading import Thread


@contextmanager
def workers(count: int) -> Iterator[ProcessPoolExecutor]:
    """`count` processes. Where the block is left early, what has not begun is left out; Ctrl-C ends what has, too."""
    with ProcessPoolExecutor(count, get_context("spawn"), _end_with_the_others) as pool:
        try:
            yield pool
        finally:
            pool.shutdown(cancel_futures=True)


def _end_with_the_others() -> None:
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    Thread(target=_outlive_nobody, daemon=True).start()


def _outlive_nobody() -> None:
    parent = parent_process()
    assert parent is not None
    wait([parent.sentinel])  # one that is killed says nothing to a process that waits for work
    os._exit(1)
