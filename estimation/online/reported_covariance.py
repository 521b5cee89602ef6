"""What is claimed of a pose when it is given out, beside what the estimator reckons with in its own decisions.

Which camera is odd, where a landmark is looked for and what gets into the window is decided by covariances that hold
from the first frame set on, when little is known of the cameras: too wide later on, and decided well by. Claims learn.
What the first pose is off by, and what the window has averaged since, is claimed smaller once the images are known to
rest and the tracks to scatter less; what lasts in the tracks' errors and what patches seen from elsewhere do is added.
After trouble the narrow claim waits until all has been well for a second.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from estimation.averaged import Averaged
from estimation.first_pose import FirstPose
from estimation.fit import Fit
from estimation.observations import Observations
from estimation.online.camera_errors import CameraErrors
from estimation.pose import SurfacePose, TrackState
from estimation.se3 import Array
from estimation.straying import Straying
from estimation.track_noise import TrackNoise

WARY = 1.0  # s without trouble until less is claimed: what slid over the wound is gone by then, and the window is new
MEMORY = 2.0  # s over which it is learned what is usual
FEWER, WORSE = 0.8, 2.0  # times the tracks that usually carry the pose, and their usual variance: something is there


class Claim:
    """The claims of the poses of one map."""

    def __init__(self, cameras: int) -> None:
        self._tracks, self._straying = TrackNoise(cameras), Straying()
        self._first: tuple[FirstPose, Array] | None = None  # and its covariance (6, 6) as it was believed at once
        self._usual = np.zeros(2)  # tracks that carry the pose; their scatter
        self._stamp, self._trouble = -np.inf, -np.inf  # s, of the last pose, and of the last that was not plain
        self._more = np.zeros((6, 6))

    def learn(self, seen: Observations, fit: Fit, cameras: CameraErrors) -> None:
        """Take the residuals of an accepted fit, after the cameras did. seen.sigma: as claimed."""
        assert fit.solution.shared is not None
        self._tracks.learn(seen, fit.solution, seen.sigma)
        self._straying.learn(fit.solution.shared, cameras.shift, self._tracks.lasting * fit.scatter)

    def measured(
        self, pose: SurfacePose, fit: Fit, cameras: CameraErrors, first: Array | None, averaged: Array
    ) -> SurfacePose:
        """The pose of an accepted fit as it is given out.

        first: (6, 6), what was believed of the first pose. averaged: (6, 6), the window's part of `pose.covariance`.
        """
        self._watch(pose, fit)
        if self._first is None and first is not None:
            self._begin(first, fit, cameras)
        late = cameras.beyond(cameras.offset) - cameras.delays.covariance
        strayed = self._straying.variance * fit.bias @ fit.bias.T
        more = self._tracks.lasting * fit.scatter * fit.tracks + strayed + fit.late @ late @ fit.late.T
        self._more = (more + more.T) / 2
        if self._first is None or pose.stamp - self._trouble < WARY:  # the first pose itself is among these
            return widened(pose, self._more)
        known, believed = self._first
        first_less = known.covariance(cameras, self._tracks) - believed
        window_less = Averaged(averaged, fit, cameras.unrest).covariance(self._tracks, cameras.unrest) - averaged
        return widened(pose, self._more + first_less + window_less)

    def missed(self, pose: SurfacePose) -> SurfacePose:
        """A pose that is only predicted, as it is given out."""
        self._trouble = pose.stamp
        return widened(pose, self._more)

    def _begin(self, believed: Array, fit: Fit, cameras: CameraErrors) -> None:
        assert fit.solution.shared is not None
        self._first = FirstPose(believed - fit.smear, fit, cameras), believed
        self._straying.start(fit.solution.shared, cameras.shift)
        self._trouble = fit.stamp

    def _watch(self, pose: SurfacePose, fit: Fit) -> None:
        now = np.array([float(fit.used.sum()), fit.scatter])
        share = min(1.0, (pose.stamp - self._stamp) / MEMORY)
        unlike = now[0] < FEWER * self._usual[0] or now[1] > WORSE * self._usual[1]
        if pose.state is not TrackState.TRACKING or pose.reason or unlike:
            self._trouble = pose.stamp
        self._usual, self._stamp = self._usual + share * (now - self._usual), pose.stamp


def widened(pose: SurfacePose, more: Array) -> SurfacePose:
    """The pose with `more` (6, 6) in all its claims of where it is."""
    ahead = pose.forecast
    if ahead is not None:
        ahead = replace(ahead, covariances=ahead.covariances + more)
    return replace(pose, covariance=pose.covariance + more, forecast=ahead)
