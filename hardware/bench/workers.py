"""Processes that share the work of a bench, and end with whoever started them, however that ends."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from multiprocessing import get_context

from hardware.end_with_parent import end_with_parent


@contextmanager
def workers(count: int) -> Iterator[ProcessPoolExecutor]:
    """`count` processes. Where the block is left early, what has not begun is left out; Ctrl-C ends what has, too."""
    with ProcessPoolExecutor(count, get_context("spawn"), _settle) as pool:
        try:
            yield pool
        finally:
            pool.shutdown(cancel_futures=True)


def _settle() -> None:
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    end_with_parent()
