"""The ways to track that can be chosen by name; each one's libraries are loaded when it is."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from estimation.rig import Rig
    from estimation.se3 import Array
    from hardware.offline.track import Step
    from perception.frames import Roi

MAP, THESIS, THESIS_FLOW = "map", "thesis", "thesis-flow"
METHODS = {
    MAP: "the pose from all cameras against a map of the surface",
    THESIS: "the thesis's estimator: SIFT and FLANN, median displacement, an axis a camera",
    THESIS_FLOW: "the same with Shi-Tomasi corners and optical flow",
}


@contextmanager
def step_by(
    method: str,
    rig: Rig,
    roi: Sequence[Roi],
    surface: Path | None = None,
    now: Callable[[], float] = lambda: 0.0,
    tool: Array | None = None,
    prefilter: str = "none",
) -> Iterator[Step]:
    """A tracking step of a method, a key of METHODS, for these cameras.

    roi, surface, now, tool, prefilter: as `tracker` takes them; the thesis's methods make no use of scan and tool, and
    have the bilateral filter in them.
    """
    if method == MAP:
        from hardware.tracker import tracker

        with tracker(rig, roi, surface, now, tool, prefilter) as step:
            yield step
        return
    from perception.thesis.features import KeyPoints
    from perception.thesis.flow import Corners
    from perception.thesis.step import ThesisStep

    with ThreadPoolExecutor(len(rig)) as threads:
        yield ThesisStep(rig, roi, now, threads, KeyPoints if method == THESIS else Corners)
