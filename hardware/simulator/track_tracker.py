"""A tracker of tracks that nobody has rendered: landmarks on the true surface, seen as the pictures would show them.

What finds tracks in pictures is left out, and with it nearly all of the time that a simulated second takes; the
estimator is that of a live run. A picture that was repeated is left out by its bits there, so it is here; one that is
black, white, covered or of another camera shows no track; of a damaged one half are left.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from estimation.observations import Observations, no_observations
from estimation.pose import SurfacePose, identity_pose
from estimation.rig import Rig
from estimation.se3 import Array
from estimation.surface_map import SurfaceMap
from estimation.synthetic.calibration import undistorting
from estimation.synthetic.follow import Follower
from estimation.synthetic.look import imaged
from estimation.triangulated import Triangulated
from hardware.simulator.cameras import Fate, Shot
from hardware.simulator.lenses import Lenses
from hardware.simulator.scene.shape import Shape
from hardware.simulator.truth import Truth
from perception.frames import FrameSet
from perception.tracking.step import STAGES, StepReport, trusting_report

COUNT, PATCH = 90, (56.0, 42.0)  # landmarks, and mm of the surface round the wound that they lie in
FOUND, LEFT = 0.85, 0.5  # shares of landmarks that are found in a picture, and of those in a damaged one
SIGMA = 0.3  # px, of a track
STRAY, ASTRAY = 0.02, 30.0  # share of tracks that lie anywhere within so many px
GAINS = 0.2, 4.0  # of a picture that shows anything
LEAST = 30  # tracks to begin with


class TrackTracker:
    """Answers like TrackingStep, without looking at pictures."""

    last: StepReport

    def __init__(
        self, true: Rig, told: Rig, truth: Truth, shape: Shape, taken: Callable[[int, float], Shot], seed: int
    ) -> None:
        """taken: the shot of a camera's frame with a stamp, s."""
        rng = np.random.default_rng([seed, 81])
        places = rng.uniform(-0.5, 0.5, (COUNT, 2)) * np.minimum(PATCH, shape.size)
        self._points, self._normals = shape.points(places), shape.normals(places)
        self._lenses, self._told, self._truth, self._taken = Lenses(undistorting(true).cameras), told, truth, taken
        self._rng, self._cameras = np.random.default_rng([seed, 82]), len(true)
        self._follower: Follower | None = None

    def __call__(self, frames: FrameSet) -> SurfacePose:
        """The pose at `frames.stamp`."""
        seen = self._seen(frames)
        pose = self._pose(seen)
        used = np.bincount(seen.camera, minlength=self._cameras)
        self.last = trusting_report(seen, used, np.zeros(len(STAGES)))
        return pose

    def idle(self) -> None:
        """There is nothing else to do."""

    def _pose(self, seen: Observations) -> SurfacePose:
        if self._follower is not None:
            return self._follower(seen)
        if len(seen) < LEAST:
            return identity_pose(seen.stamp, f"{len(seen)} tracks found, {LEAST} needed")
        known = SurfaceMap(self._points, self._normals, np.zeros((3 * COUNT, 3 * COUNT)))
        place = self._truth.base_from_surface(np.array([seen.stamp]))[0]
        self._follower = Follower(self._told, seen, Triangulated(known, place, np.arange(COUNT)), refine=False)
        assert self._follower.estimator.pose is not None
        return self._follower.estimator.pose

    def _seen(self, frames: FrameSet) -> Observations:
        """The tracks in all frames of a set."""
        found = [self._look(frame.camera, self._taken(frame.camera, frame.stamp)) for frame in frames.frames]
        if not any(len(track) for _, track, _ in found):
            return no_observations(frames.stamp)
        camera = np.concatenate([np.full(len(track), c) for c, track, _ in found])
        track, pixels = np.concatenate([t for _, t, _ in found]), np.concatenate([p for _, _, p in found])
        return Observations(frames.stamp, camera, track, pixels, np.full(len(track), SIGMA))

    def _look(self, camera: int, shot: Shot) -> tuple[int, NDArray[np.int64], Array]:
        """A camera's number, and tracks (N,) with pixels (N, 2) in one picture."""
        rng, instant = self._rng, np.array([shot.exposed])
        chance = rng.random(COUNT)
        other = shot.lens not in (None, camera) or shot.covered is not None  # nothing there looks as it did before
        blind = other or shot.fate is Fate.DUPLICATED or not GAINS[0] <= shot.gain <= GAINS[1]
        amount = np.broadcast_to(self._truth.amount(instant), COUNT)
        points = self._points + self._truth.displacement(self._points, amount) if amount.any() else self._points
        pose = self._truth.base_from_surface(instant)
        pixels, inside = imaged(Rig((self._lenses(shot),)), points, pose, self._normals)
        noisy = pixels[0] + SIGMA * rng.standard_normal((COUNT, 2))
        stray = rng.random(COUNT) < STRAY
        noisy[stray] += rng.uniform(-ASTRAY, ASTRAY, (int(stray.sum()), 2))
        share = 0.0 if blind else FOUND * (LEFT if shot.fate is Fate.GARBLED else 1.0)
        track = np.flatnonzero(inside[0] & (chance < share)).astype(np.int64)
        return camera, track, noisy[track]
