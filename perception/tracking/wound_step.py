"""A tracking step that asks first where the wound is, where nobody has said so."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import Executor

import numpy as np

from estimation.observations import no_observations
from estimation.pose import SurfacePose, identity_pose
from estimation.rig import Rig
from estimation.surface_map import SurfaceMap
from perception.frames import FrameSet, Roi
from perception.tracking.step import STAGES, StepReport, TrackingStep, trusting_report
from perception.wound.segmentation import Segmenter
from perception.wound_beside import WoundBeside
from perception.wound_region import polygon, region
from perception.wound_watch import Sight

LOOKS = 2  # at all cameras, without a wound in two of them, before the whole pictures are taken for the surface
AROUND = 0.6  # of the wound's box on every side: the skin beside it moves with it, and has more to track


class WoundFirst:
    """TrackingStep on the region where a segmenter sees the wound; on whole pictures where it sees none."""

    last: StepReport

    def __init__(
        self,
        rig: Rig,
        made: Callable[[Sequence[Roi]], TrackingStep],
        segmenter: Segmenter,
        executor: Executor | None = None,
    ) -> None:
        """made: the step for a region, or for none. executor: one thread, as `WoundBeside` takes it."""
        self._rig, self._made = rig, made
        self._beside: WoundBeside | None = WoundBeside(rig, segmenter, executor)
        self._step: TrackingStep | None = None
        self._looks = 0

    def __call__(self, frames: FrameSet) -> SurfacePose:
        """The pose at `frames.stamp`; INITIALISING while the wound is looked for."""
        if self._step is None:
            self._step = self._found(frames)
        if self._step is None:
            self.last = trusting_report(
                no_observations(frames.stamp), np.zeros(len(self._rig), np.int64), np.zeros(len(STAGES))
            )
            return identity_pose(frames.stamp, "the wound is being looked for")
        pose = self._step(frames)
        self.last = self._step.last
        return pose

    @property
    def map(self) -> SurfaceMap | None:
        """The map as it is now, in the surface frame; None before there is one."""
        return None if self._step is None else self._step.map

    @property
    def roi(self) -> tuple[Roi, ...]:
        """Where the surface was at the start, none before it was found."""
        return () if self._step is None else self._step.roi

    def idle(self) -> None:
        """Work that no pose waits for."""
        if self._step is not None:
            self._step.idle()

    def _found(self, frames: FrameSet) -> TrackingStep | None:
        assert self._beside is not None
        due = self._beside(frames)
        if due is None:
            return None
        self._looks += 1
        stamp, sights = due
        rois = self._rois(stamp, sights)
        if len([s for s in sights.values() if s.box is not None]) < 2:
            if self._looks < LOOKS:
                return None
            rois = ()
        self._beside = None
        return self._made(rois)

    def _rois(self, stamp: float, sights: dict[int, Sight]) -> tuple[Roi, ...]:
        """Round each camera's wound; the whole picture of a camera that sees none."""
        found = []
        for camera, sight in sights.items():
            size = self._rig.cameras[camera].size
            side = 0 if sight.box is None else max(sight.box[2] - sight.box[0], sight.box[3] - sight.box[1])
            found.append(Roi(camera, stamp, polygon(region(sight.box, None, size, AROUND * side))))
        return tuple(found)
