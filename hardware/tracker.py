"""The tracking step with the world's part of it: the scan's file, and a process for the map."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from contextlib import contextmanager
from multiprocessing import get_context
from pathlib import Path

from estimation.rig import Rig
from estimation.se3 import Array
from hardware.end_with_parent import end_with_parent
from hardware.files.mesh_file import read_mesh
from hardware.held_interrupt import held_interrupt
from perception.frames import Roi
from perception.prefilter import NONE, PREFILTERS
from perception.tool import Tool
from perception.tracking.step import TrackingStep
from perception.tracking.wound_step import WoundFirst

NICE = 10  # by which the process of the map stands back


@contextmanager
def tracker(
    rig: Rig,
    roi: Sequence[Roi],
    surface: Path | None = None,
    now: Callable[[], float] = lambda: 0.0,
    tool: Array | None = None,
    prefilter: str = NONE,
) -> Iterator[TrackingStep | WoundFirst]:
    """TrackingStep for these cameras; the map is refined in a process of its own, as GTSAM holds the interpreter.

    roi: where the surface is at the start; without one the wound is looked for first, by the network that comes along,
    and where it sees none the whole pictures are the surface. surface: the scan's file, mm; InputError where it cannot
    be read. now: s, only to say how long the stages take. tool: (K, 2) mm, profile of what hangs on the arm,
    as `ArmProfile.tool`. prefilter: a key of PREFILTERS.
    """
    scan = None
    if surface is not None:
        scan = read_mesh(surface).scan
    with ProcessPoolExecutor(1, get_context("spawn"), _settle) as executor:
        with held_interrupt():
            first = executor.submit(int)
        first.result()  # started before the first frame set, not beside it

        def made(found: Sequence[Roi]) -> TrackingStep:
            held = None if tool is None else Tool(tool)
            return TrackingStep(rig, found, now, executor, scan, held, PREFILTERS[prefilter])

        if roi:
            yield made(roi)
            return
        from perception.wound.network import WoundNetwork, shipped
        from perception.wound.segmentation import (
            NetworkSegmenter,  # loads onnxruntime, which a known region does not need
        )

        network = WoundNetwork(shipped(), threads=1)  # the other core is the tracker's
        with ThreadPoolExecutor(1) as thread:
            segmenter = NetworkSegmenter(network, network.settings)
            yield WoundFirst(rig, made, segmenter, thread)


def _settle() -> None:
    """Ctrl-C is for the parent, which then ends this process in good order; frames go before the map."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    end_with_parent()
    os.nice(NICE)
