"""Made-up tracking runs with a known truth: what pose files, evaluation and report are tested on."""

from __future__ import annotations

import numpy as np

from estimation import se3
from estimation.observations import Observations
from estimation.pose import SurfacePose, TrackState, Trajectory
from estimation.se3 import Array
from hardware.files.pose_file import PoseTable
from perception.frames import FrameSet
from perception.tracking.step import STAGES as STEP_STAGES
from perception.tracking.step import StepReport

OFFSETS = 0.0143, -0.0091, -0.0052  # s, of the cameras, once they are known
STAGES = ("prepare", "flow", "total")


def breathing(stamps: Array) -> Array:
    """base_from_surface (N, 4, 4): 10 mm and 3 degrees of breathing, 400 mm in front of base."""
    phase = 2 * np.pi * 0.25 * stamps
    sin, cos, none = np.sin(phase), np.cos(phase), 0 * phase
    xi = np.stack([0.05 * sin, 0.02 * cos, none, 0.3 * stamps, none, 5 * sin], -1)
    return se3.make(se3.exp_rotation([0.4, -0.2, 1.0]), [30.0, -20.0, 400.0]) @ se3.exp(xi)


def run(
    count: int = 60,
    sigma: Array | None = None,
    surface_change: Array | None = None,
    states: dict[int, TrackState] | None = None,
    seed: int = 5,
) -> tuple[PoseTable, Trajectory]:
    """A run of `count` frame sets at 30 Hz and its exact truth.

    sigma: (6,) standard deviations of the right perturbation that is added and claimed, zeros by default.
    surface_change: (4, 4) truth_surface_from_estimated_surface. states: by row; the first is INITIALISING otherwise.
    """
    draw = np.random.default_rng(seed)
    stamps = np.arange(count) / 30
    truth = breathing(stamps)
    sigma = np.zeros(6) if sigma is None else sigma
    change = np.eye(4) if surface_change is None else surface_change
    estimate = truth @ change @ se3.exp(draw.normal(size=(count, 6)) * sigma)
    named = {0: TrackState.INITIALISING, **(states or {})}
    seconds = draw.gamma(4.0, 0.001, size=(count, 2))
    table = PoseTable(
        stamps=stamps,
        frames=np.full(count, 3),
        base_from_surface=estimate,
        covariance=np.broadcast_to(np.diag(np.maximum(sigma, 1e-9) ** 2), (count, 6, 6)).copy(),
        twist=draw.normal(size=(count, 6)),
        moving=np.arange(count) % 7 < 3,
        onset=np.where(np.arange(count) < 4, np.nan, stamps - stamps % 0.2),
        moved=np.arange(count) / 8,
        turned=np.arange(count) / 1024,
        deformation=np.zeros(count),
        deformation_sigma=np.zeros(count),
        states=tuple(named.get(i, TrackState.TRACKING) for i in range(count)),
        used=draw.integers(30, 60, size=(count, 3)),
        offsets=np.outer(np.minimum(np.arange(count) / 10, 1.0), OFFSETS),
        offset_sigmas=np.tile(np.array([[0.008], [0.0004]])[np.minimum(np.arange(count), 1)], 3),
        seconds=np.concatenate([seconds, seconds.sum(axis=1, keepdims=True)], axis=1),
        reasons=tuple(f'row {i}, <so> & "so"' for i in range(count)),
        cameras=("left", "top", "right"),
        stages=STAGES,
    )
    return table, Trajectory(stamps, truth, True)


class Replayed:
    """Answers as TrackingStep does, with the poses of a made-up run; `log` tells the order of what was asked."""

    def __init__(self, log: list[str]) -> None:
        self.table, _ = run(20)
        self.log = log
        self.asked = 0
        self.last: StepReport

    def __call__(self, frames: FrameSet) -> SurfacePose:
        i = self.asked
        self.asked += 1
        self.log.append("step")
        nothing = np.empty(0, np.int64)
        observations = Observations(frames.stamp, nothing, nothing, np.empty((0, 2)), np.empty(0))
        t = self.table
        seconds = np.full(len(STEP_STAGES), 0.001)
        self.last = StepReport(observations, t.used[i], seconds, t.offsets[i], t.offset_sigmas[i])
        return SurfacePose(frames.stamp, t.base_from_surface[i], t.covariance[i], t.twist[i], t.states[i])

    def idle(self) -> None:
        self.log.append("idle")
