"""The tracking step of a recorded session, with the world's part of it: the scan's file, a process for the map."""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from multiprocessing import get_context

from hardware.session import Session
from perception.tracking import TrackingStep


@contextmanager
def tracker(session: Session, now: Callable[[], float] = lambda: 0.0) -> Iterator[TrackingStep]:
    """TrackingStep for the session; the map is refined in a process of its own, as GTSAM holds the interpreter.

    now: s, only to say how long the stages take. Raises InputError for a scan that cannot be read.
    """
    scan = None
    if session.surface is not None:
        from hardware.mesh_file import read_mesh  # loads open3d, which nothing without a scan may need

        scan = read_mesh(session.surface).scan
    with ProcessPoolExecutor(1, get_context("spawn"), _leave_interrupts) as executor:
        executor.submit(int).result()  # started before the first frame set, not beside it
        yield TrackingStep(session.rig, session.roi, now, executor, scan)


def _leave_interrupts() -> None:
    """Ctrl-C is for the parent, which then ends this process in good order."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
