"""Ask the system to let this process run when it wants to; what it grants, it says."""

from __future__ import annotations

import gc
import os

REAL_TIME = 10  # of 1 to 99: above all ordinary work, below the kernel's own
NICE = -10  # before all that asked for nothing


def settle_memory() -> None:
    """Leave what is there by now out of garbage collection: to look through all that is loaded takes 0.1 to 0.3 s."""
    gc.collect()
    gc.freeze()


def ask_for_real_time() -> str:
    """Take the best priority that is granted, and leave what is loaded out of garbage collection; what was granted."""
    settle_memory()
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(REAL_TIME))
        return f"real time, priority {REAL_TIME}"
    except (AttributeError, OSError):
        pass
    return ask_to_go_first()


def ask_to_go_first() -> str:
    """Be served before ordinary processes, which still get their share; what was granted. Children inherit it."""
    try:
        return f"nice {os.nice(NICE)}"
    except OSError:
        return "nothing: an ordinary process"
