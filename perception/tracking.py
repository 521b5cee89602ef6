"""TrackingStep: one frame set in, one surface pose out; no I/O and no clock of its own."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estimation.observations import Observations
from estimation.pose import SurfacePose
from estimation.rig import Rig
from estimation.se3 import Array
from perception.frames import FrameSet, Roi

STAGES = ("prepare", "flow", "align", "pose", "window")


@dataclass(frozen=True, slots=True, eq=False)
class StepReport:
    """What one step did. used: (C,) tracks per camera that carry the pose. seconds: (len(STAGES),) by `clock`."""

    observations: Observations
    used: NDArray[np.int64]
    seconds: Array


class TrackingStep:
    """Follows one surface through frame sets; deterministic, causal."""

    last: StepReport

    def __init__(self, rig: Rig, roi: Sequence[Roi] = (), clock: Callable[[], float] = lambda: 0.0) -> None:
        raise NotImplementedError

    def __call__(self, frames: FrameSet) -> SurfacePose:
        """The pose at `frames.stamp` from this frame set and the ones before."""
        raise NotImplementedError

    def idle(self) -> None:
        """Work that no pose waits for (map refinement); the caller's loop calls it once a pose is handed over."""
        raise NotImplementedError
