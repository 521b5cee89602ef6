"""A process that works for another ends with it, however that one ends."""

from __future__ import annotations

import os
from multiprocessing import parent_process
from multiprocessing.connection import wait
from threading import Thread


def end_with_parent() -> None:
    """From now on this process, which multiprocessing started, ends as soon as the one that started it has ended.

    One that is killed says nothing to a process that waits for work from it.
    """
    parent = parent_process()
    assert parent is not None
    Thread(target=_outlive_nobody, args=(parent.sentinel,), daemon=True).start()


def _outlive_nobody(sentinel: int) -> None:
    wait([sentinel])
    os._exit(1)
