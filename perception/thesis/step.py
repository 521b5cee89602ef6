"""ThesisStep: one frame set in, one surface pose out, by the thesis's estimator; it answers like TrackingStep."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor

import numpy as np

from estimation import se3
from estimation.observations import Observations, no_observations
from estimation.pose import SurfacePose, TrackState, identity_pose
from estimation.rig import Rig
from estimation.se3 import Array
from perception.frames import FrameSet, Image, Roi, region_polygons
from perception.lens import undistort
from perception.thesis.camera import MAX_COAST_S, CameraTrack, Finder, KeyPoints
from perception.tracking.step import STAGES, StepReport, empty_report, report_without_offsets

MIN_AXIS_SHARE = np.cos(np.pi / 4)  # a camera measures along or about what it sees more of than it misses


def assign_axes(rotations: Mapping[int, Array]) -> dict[int, Array]:
    """What each camera's motion in its image is taken for, (6, 3) by camera number.

    rotations: base_from_camera (3, 3) of each camera that sees the surface, the top one first. A row set (6, 3) makes
    of (mm along image x, mm along image y, rad from x towards y) a turn, rad, and a move, mm, [rx ry rz tx ty tz] in
    base axes; what a rig moved is the sum over its cameras. A camera that measures nothing is left out.

    The world's axes are the cameras' own (thesis 4.2). The first camera is the top one and measures both moves in its
    image and the turn about its optical axis z. The bottom one is that which stands across it most nearly, 84 degrees
    in the thesis; its image's direction nearest to z, the image's y there, measures the move along z, and it measures
    the turn about the axis h that it looks along, taken as square to z. The side camera measures the turn about the
    third axis, cross(z, h).

    4.2, 4.6 and Appendix A assign the axes differently. The program's assignment is taken (X, Y and a turn from the
    top, Z and a turn from the bottom camera), which agrees with 4.2; 4.6 gives Y to the bottom camera, and names the
    turn about X twice. The side camera of 4.6 turns for cross(z, h) only where it looks along that more than across:
    at 36 degrees between the two others it does not see that turn at all, but four fifths of the one about z, which
    would be counted again. Then, as in the program, no camera measures it, and it is taken for none.
    """
    top, *others = rotations
    z = rotations[top][:, 2]
    shares = {top: _share(z, rotations[top][:, :2])}
    bottom = min(others, key=lambda c: abs(float(rotations[c][:, 2] @ z)), default=None)
    if bottom is None or abs(float(rotations[bottom][:, 2] @ z)) > MIN_AXIS_SHARE:
        return shares
    h = _unit(rotations[bottom][:, 2] - (rotations[bottom][:, 2] @ z) * z)
    up = _unit(rotations[bottom][:, :2].T @ z)  # (2,) in the bottom camera's image
    shares[bottom] = _share(h, np.outer(z, up))
    third = np.cross(z, h)
    seen = {c: float(rotations[c][:, 2] @ third) for c in others if c != bottom}
    side = max(seen, key=lambda c: abs(seen[c]), default=None)
    if side is not None and abs(seen[side]) >= MIN_AXIS_SHARE:
        shares[side] = _share(np.sign(seen[side]) * third, np.zeros((3, 2)))
    return shares


def _share(axis: Array, moves: Array) -> Array:
    """(6, 3) of the axis (3,) that is turned about and what the image's two axes move along (3, 2)."""
    share = np.zeros((6, 3))
    share[:3, 2], share[3:, :2] = axis, moves
    return share


def _unit(vector: Array) -> Array:
    return np.asarray(vector / np.linalg.norm(vector))


def unmeasured(shares: Mapping[int, Array]) -> str:
    """What no camera measures, in words; '' if nothing."""
    if len(shares) == 1:
        return "no camera stands across the first one: moves along its view, and two turns, are not measured"
    return "" if len(shares) == 3 else "no camera looks along the third axis: turns about it are not measured"


MIN_COVARIANCE = np.diag([1e-12] * 3 + [1e-8] * 3)  # rad^2, mm^2: what is taken for none, with an inverse all the same
CAMERA_FROM_SURFACE_AXES = np.diag([1.0, -1.0, -1.0])  # the top camera from the surface: z out of it, to the camera
FEATURE_SIGMA_PX = 1.0  # px, reported for each feature's place: the thesis states none


class ThesisStep:
    """Follows one surface through frame sets; deterministic, causal.

    Covariances are the thesis's, next to nothing: the filter of 4.4 has one of the velocity and of a prediction, but
    the sum of the measured moves counts as exact, and what no camera measures as still.
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
        if last is not None and frames.stamp <= last.stamp:  # the same instant again
            self.last = empty_report(frames.stamp, len(self.rig), self._spent)
            return last
        images = {f.camera: f.image for f in frames.frames}
        pose = self._begin(frames, images) if last is None else self._follow(last, frames.stamp, images)
        self._spent[STAGES.index("flow")] = self._clock() - start
        used = np.zeros(len(self.rig), np.int64)
        for camera, track in self._tracks.items():
            used[camera] = len(track.pixels)
        self.last = report_without_offsets(self._observations(frames.stamp), used, self._spent)
        return pose

    def idle(self) -> None:
        """There is nothing that no pose waits for."""

    # -- the first frame set

    def _begin(self, frames: FrameSet, images: dict[int, Image]) -> SurfacePose:
        """Where the surface is, and which axis is whose; until that is known, INITIALISING and why."""
        polygons = region_polygons(self.roi, frames, [camera.size for camera in self.rig.cameras])
        if isinstance(polygons, str):
            return identity_pose(frames.stamp, polygons)
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
        towards = rotations[next(iter(rotations))] @ CAMERA_FROM_SURFACE_AXES
        return self._with_covariance(frames.stamp, se3.make(towards, middle))

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
        list(self._each(lambda c: self._tracks[c](stamp, images.get(c)), self._tracks))
        moved = np.sum([share @ self._tracks[c].motion for c, share in self._shares.items()], axis=0)
        more, self._moved = moved - self._moved, moved
        before = last.base_from_surface
        turned = se3.exp_rotation(more[:3]) @ before[:3, :3]  # small: the order of Eq. 5.1-5.3 does not matter
        return self._with_covariance(stamp, se3.make(turned, before[:3, 3] + more[3:]))

    def _with_covariance(self, stamp: float, base_from_surface: Array) -> SurfacePose:
        """The pose with its state, covariance and twist; it is remembered."""
        state, reason = self._state(stamp)
        turned = np.kron(np.eye(2), base_from_surface[:3, :3])  # base axes from surface axes, (6, 6)
        covariance, twist, spread = np.zeros((6, 6)), np.zeros(6), np.zeros((6, 6))
        for camera, share in self._shares.items():
            track, own = self._tracks[camera], turned.T @ share
            covariance += own @ track.covariance @ own.T
            twist += own @ track.velocity.mean
            spread += own @ track.velocity.covariance @ own.T
        covariance = covariance + MIN_COVARIANCE
        self._pose = SurfacePose(stamp, base_from_surface, covariance, twist, state, spread, reason=reason)
        return self._pose

    def _state(self, stamp: float) -> tuple[TrackState, str]:
        names = [self.rig.cameras[c].name for c, track in self._tracks.items() if not track.measured]
        lacking = unmeasured(self._shares)
        if len(names) < len(self._tracks):
            self._seen = stamp
            reasons = ([f"{' and '.join(names)} not measured"] if names else []) + ([lacking] if lacking else [])
            whole = not names and len(self._tracks) > 1
            return TrackState.TRACKING if whole else TrackState.DEGRADED, "; ".join(reasons)
        lost = stamp - self._seen > MAX_COAST_S
        return TrackState.LOST if lost else TrackState.COASTING, "no camera found its features again"

    def _observations(self, stamp: float) -> Observations:
        """The features that were found again; their numbers mean nothing from one frame set to the next."""
        pixels = [track.pixels for track in self._tracks.values()]
        if not pixels:
            return no_observations(stamp)
        camera = np.repeat(list(self._tracks), [len(p) for p in pixels])
        number = np.concatenate([np.arange(len(p)) for p in pixels])
        return Observations(stamp, camera, number, np.concatenate(pixels), np.full(len(camera), FEATURE_SIGMA_PX))
