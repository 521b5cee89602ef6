"""ThesisStep: one frame set in, one surface pose out, by the thesis's estimator; answers like TrackingStep."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import Executor

import numpy as np

from estimation import se3
from estimation.observations import Observations, no_observations
from estimation.pose import SurfacePose, TrackState, identity_pose
from estimation.rig import Rig
from estimation.se3 import Array
from perception.frames import FrameSet, Image, Roi
from perception.lens import undistort
from perception.thesis.axes import assign_axes, unmeasured
from perception.thesis.camera import LONGEST, CameraTrack
from perception.thesis.features import KeyPoints
from perception.thesis.pairs import Finder
from perception.tracking.step import STAGES, StepReport, trusting_report

LEAST_VARIANCE = np.diag([1e-12] * 3 + [1e-8] * 3)  # rad^2, mm^2: what is taken for none, with an inverse all the same
OUTWARD = np.diag([1.0, -1.0, -1.0])  # the top camera from the surface: z out of it, to the camera
PIXEL = 1.0  # px, told of each feature's place: the thesis states none


class ThesisStep:
    """Follows one surface through frame sets; deterministic, causal.

    Covariances are what the thesis claims, next to nothing: the filter of 4.4 knows how sure it is of a velocity and of
    a prediction, but the sum of the measured moves is taken for exact, and what no camera measures for still.
    """

    last: StepReport

    def __init__(
        self,
        rig: Rig,
        roi: Sequence[Roi] = (),
        clock: Callable[[], float] = lambda: 0.0,
        executor: Executor | None = None,
        finder: Callable[[], Finder] = KeyPoints,
    ) -> None:
        """Ready for the first frame set.

        roi: where the surface is when it first comes into view; a camera without one takes no part, unless all have
        none and the whole images are taken. clock: only to fill `StepReport.seconds`. executor: of threads, one for
        each camera (thesis Fig. 3.2); without one the cameras take turns. finder: makes each camera's way of finding
        features again, KeyPoints (4.6's core algorithm) or Corners.
        """
        self.rig, self.roi = rig, tuple(roi)
        self._clock, self._finder = clock, finder
        self._each = map if executor is None else executor.map
        self._tracks: dict[int, CameraTrack] = {}
        self._shares: dict[int, Array] = {}  # (6, 3) by camera: base axes, mm and rad, from its motion in px and rad
        self._moved = np.zeros(6)  # by all cameras, [rx ry rz tx ty tz] in base axes, already in the pose
        self._pose: SurfacePose | None = None
        self._seen = -np.inf  # s, when the surface was last measured

    def __call__(self, frames: FrameSet) -> SurfacePose:
        """The pose at `frames.stamp` from this frame set and the ones before."""
        self._spent, start = np.zeros(len(STAGES)), self._clock()
        last = self._pose
        if last is not None and frames.stamp <= last.stamp:  # the same instant again tells nothing new
            self.last = trusting_report(no_observations(frames.stamp), np.zeros(len(self.rig), np.int64), self._spent)
            return last
        images = {f.camera: f.image for f in frames.frames}
        pose = self._begin(frames, images) if last is None else self._follow(last, frames.stamp, images)
        self._spent[STAGES.index("flow")] = self._clock() - start
        used = np.zeros(len(self.rig), np.int64)
        for camera, track in self._tracks.items():
            used[camera] = len(track.pixels)
        self.last = trusting_report(self._observations(frames.stamp), used, self._spent)
        return pose

    def idle(self) -> None:
        """There is nothing that no pose waits for."""

    # -- the first frame set

    def _begin(self, frames: FrameSet, images: dict[int, Image]) -> SurfacePose:
        """Where the surface is, and which axis is whose; until that is known, INITIALISING and why."""
        start = max((r.stamp for r in self.roi), default=-np.inf)
        if frames.stamp < start - 0.1:
            return identity_pose(frames.stamp, f"waiting for the region of interest at {start:.3f} s")
        polygons = {c: p for c, p in self._polygons().items() if c in images}
        if len(polygons) < 2:
            return identity_pose(frames.stamp, "fewer than two cameras show the surface")
        middle = self._middle(polygons)
        tracks = {c: CameraTrack(self.rig.cameras[c], self._finder()) for c in polygons}
        scales = {c: track.view.scale(middle) for c, track in tracks.items()}
        if any(scale.min() <= 0 for scale in scales.values()):
            return identity_pose(frames.stamp, "the middles of the regions are not of one place before the cameras")
        rotations = {c: self.rig.cameras[c].base_from_camera[:3, :3] for c in polygons}
        shares = assign_axes(rotations)
        self._tracks = {c: tracks[c] for c in shares}
        self._shares = {c: share * np.append(scales[c], 1.0) for c, share in shares.items()}
        for camera, track in self._tracks.items():
            track.begin(frames.stamp, images[camera], polygons[camera])
        towards = rotations[next(iter(rotations))] @ OUTWARD
        return self._taken(frames.stamp, se3.make(towards, middle))

    def _polygons(self) -> dict[int, Array]:
        """The region (N, 2) px in each camera that has one, in the rig's order."""
        if not self.roi:
            corners = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], float)
            return {c: corners * camera.size for c, camera in enumerate(self.rig.cameras)}
        return {r.camera: r.polygon for r in sorted(self.roi, key=lambda r: r.camera)}

    def _middle(self, polygons: dict[int, Array]) -> Array:
        """The point (3,) mm, base frame, nearest to the rays through the middles of the regions: the surface's origin.

        Thesis Eq. 4.6 takes a pixel to the world at a fixed Z, and lets two cameras fix each other's; with all
        cameras calibrated that is the nearest point to their rays.
        """
        normal, right = np.zeros((3, 3)), np.zeros(3)
        for number, polygon in polygons.items():
            camera = self.rig.cameras[number]
            pixel = undistort(camera, (polygon.min(0) + polygon.max(0))[None] / 2)[0]
            ray = camera.base_from_camera[:3, :3] @ np.linalg.solve(camera.matrix, np.append(pixel, 1.0))
            across = np.eye(3) - np.outer(ray, ray) / (ray @ ray)
            normal += across
            right += across @ camera.base_from_camera[:3, 3]
        return np.asarray(np.linalg.solve(normal, right), float)

    # -- every frame set after it

    def _follow(self, last: SurfacePose, stamp: float, images: dict[int, Image]) -> SurfacePose:
        """Each camera's motion, and the pose moved and turned by what that is beyond the last."""
        list(self._each(lambda c: self._tracks[c](stamp, images.get(c)), self._tracks))
        moved = np.sum([share @ self._tracks[c].motion for c, share in self._shares.items()], axis=0)
        more, self._moved = moved - self._moved, moved
        before = last.base_from_surface
        turned = se3.exp_rotation(more[:3]) @ before[:3, :3]  # small: the order of Eq. 5.1-5.3 does not matter
        return self._taken(stamp, se3.make(turned, before[:3, 3] + more[3:]))

    def _taken(self, stamp: float, base_from_surface: Array) -> SurfacePose:
        """The pose with all that is claimed of it, remembered."""
        state, reason = self._state(stamp)
        turned = np.kron(np.eye(2), base_from_surface[:3, :3])  # base axes from surface axes, (6, 6)
        covariance, twist, spread = np.zeros((6, 6)), np.zeros(6), np.zeros((6, 6))
        for camera, share in self._shares.items():
            track, own = self._tracks[camera], turned.T @ share
            covariance += own @ track.covariance @ own.T
            twist += own @ track.velocity.mean
            spread += own @ track.velocity.covariance @ own.T
        self._pose = SurfacePose(
            stamp, base_from_surface, covariance + LEAST_VARIANCE, twist, state, spread, reason=reason
        )
        return self._pose

    def _state(self, stamp: float) -> tuple[TrackState, str]:
        names = [self.rig.cameras[c].name for c, track in self._tracks.items() if not track.measured]
        lacking = unmeasured(self._shares)
        if len(names) < len(self._tracks):
            self._seen = stamp
            reasons = ([f"{' and '.join(names)} not measured"] if names else []) + ([lacking] if lacking else [])
            whole = not names and len(self._tracks) > 1
            return TrackState.TRACKING if whole else TrackState.DEGRADED, "; ".join(reasons)
        lost = stamp - self._seen > LONGEST
        return TrackState.LOST if lost else TrackState.COASTING, "no camera found its features again"

    def _observations(self, stamp: float) -> Observations:
        """The features that were found again; their numbers mean nothing from one frame set to the next."""
        pixels = [track.pixels for track in self._tracks.values()]
        if not pixels:
            return no_observations(stamp)
        camera = np.repeat(list(self._tracks), [len(p) for p in pixels])
        number = np.concatenate([np.arange(len(p)) for p in pixels])
        return Observations(stamp, camera, number, np.concatenate(pixels), np.full(len(camera), PIXEL))
