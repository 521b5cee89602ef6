"""Segmentation beside the tracker: one job at a time, on the newest pictures, never in the way of a pose."""

from __future__ import annotations

from collections.abc import Mapping
from concurrent.futures import Executor

from estimation.deferred import Deferred
from estimation.rig import Rig
from perception.frames import FrameSet, Image
from perception.wound.segmentation import Segmentation, Segmenter
from perception.wound_watch import Sight, WoundWatch

DELAY = 3  # frame sets until a result counts: three cameras take 60 ms of one core, a set comes every 33 ms


class WoundBeside:
    """Looks for the wound at its own pace.

    A result counts a fixed number of frame sets after its pictures, however soon it was ready: a recording gives the
    same every time. Pictures that come while a job is under way are let go; the next job takes the newest.
    """

    def __init__(self, rig: Rig, segmenter: Segmenter, executor: Executor | None = None, delay: int = DELAY) -> None:
        """executor: one thread (onnxruntime lets go of the interpreter); without one the work is done when due."""
        self._segmenter, self._delay = segmenter, delay
        self._watches = [WoundWatch(camera.size) for camera in rig.cameras]
        self._job: Deferred[dict[int, Segmentation]] = Deferred(executor, delay)
        self._stamp = float("nan")

    def __call__(self, frames: FrameSet) -> tuple[float, dict[int, Sight]] | None:
        """Once a frame set: what is due, as the stamp of the pictures and what each camera sees; None: nothing is."""
        found = self._job.poll()
        due = None
        if found is not None:
            due = self._stamp, {camera: self._watches[camera].take(seen) for camera, seen in found.items()}
        if not self._job.busy and frames.frames:
            self._stamp = frames.stamp
            self._job.ask(segmented, self._segmenter, {f.camera: f.image for f in frames.frames})
        return due


def segmented(segmenter: Segmenter, images: Mapping[int, Image]) -> dict[int, Segmentation]:
    """Each camera's picture, segmented one after another."""
    return {camera: segmenter(image) for camera, image in images.items()}
