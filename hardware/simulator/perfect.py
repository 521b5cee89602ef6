"""A tracker that knows the truth: with it, what is left of the error is the loop's and the arm's own."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from estimation.forecast.predictor import Predictor
from estimation.observations import no_observations
from estimation.pose import SurfacePose, TrackState
from estimation.se3 import Array
from hardware.simulator.truth import Truth
from perception.frames import FrameSet
from perception.tracking.step import STAGES, StepReport, trusting_report

SURE = np.diag([1e-12] * 3 + [1e-8] * 3)  # rad^2, mm^2: exact, but no matrix without an inverse


class PerfectTracker:
    """Answers like TrackingStep, without looking at pictures."""

    last: StepReport

    def __init__(self, truth: Truth, offset: Array, exposed: Callable[[int, float], float], cameras: int) -> None:
        """offset: (4, 4) told_base_from_base, what a wrong rig makes of every pose.

        exposed: the true instant, s, of a camera's frame with a stamp, s: clocks that are wrong stay wrong.
        """
        self._predictor = Predictor()
        self._truth, self._offset, self._exposed, self._cameras = truth, offset, exposed, cameras

    def __call__(self, frames: FrameSet) -> SurfacePose:
        """The pose at the mean of the true exposures, under the stamp that the cameras tell."""
        instant = np.array([np.mean([self._exposed(f.camera, f.stamp) for f in frames.frames])])
        pose, twist = self._truth.base_from_surface(instant)[0], self._truth.twist(instant)[0]
        nothing, none = no_observations(frames.stamp), np.zeros(self._cameras, np.int64)
        self.last = trusting_report(nothing, none, np.zeros(len(STAGES)))
        seen = SurfacePose(frames.stamp, self._offset @ pose, SURE, twist, TrackState.TRACKING)
        return replace(seen, forecast=self._predictor.add(seen))

    def idle(self) -> None:
        """There is nothing else to do."""
