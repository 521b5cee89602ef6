"""Reported covariance of a pose: the window's marginal for the noise known now, and what a window cannot average.

The window holds the noise that is new in each frame set, as it was estimated then. The estimator's decisions (which
camera is an outlier, where a landmark is searched, what enters the window) use its marginal unchanged: wide, and safe
for deciding. The reported covariance is the sum of this marginal, rescaled to the noise estimated now, of the newest
pose and of the first one, in which the path is placed, and of all errors that do not average out: late exposures, map
and lenses, the lasting part of the tracks' errors, the drift of the images' shifts.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from estimation.observations import Observations
from estimation.online.camera_errors import CameraErrors
from estimation.online.fit import FitCovariance, FrameFit
from estimation.online.window import WindowEstimate
from estimation.pose import SurfacePose
from estimation.pose_solver import INLIER_WEIGHT, PoseFit, SharedFit
from estimation.se3 import Array, Index

NOISE_MEMORY_SETS = 300.0  # ten seconds, over which the shares of the tracks' noise are learned
PRIOR_TRACKS = 20.0  # tracks as which the initial belief counts: that all of their noise is new
MIN_NEW_SHARE = 0.02  # of the variance: no track errs alike to the last bit
MAX_NEW_GAP_S = 0.2  # what has changed in more need not be new
LASTING_GAP_S = 1.0  # and up to twice that: a breath has gone half its way

# A velocity's variance by white noise on acceleration and noisy positions without end: what the noise adds to it.
# The gains sqrt(2) w and w^2 leave sqrt(2) w^3 r, of which w^3 r / (2 sqrt(2)) is by the noise r (Lyapunov's equation).
NOISE_SHARE_OF_TWIST = 0.25
# What the positions after it change of the velocity, in parts of what the noise and the acceleration have added. Of
# white acceleration 0.58 are seen, of an acceleration that lasts as long as the window's memory all.
NOISE_REVISED, MOTION_REVISED = 1.25, 2 / 3

CLEAR_SHIFT_PX = 0.02  # shifts known better than that show the size of all of them
MIN_LASTING_SHARE = 0.01  # of the variance claimed of tracks: something in them lasts
DRIFT_MEMORY_SETS = 100  # over which the drift of the shifts is averaged


@dataclass(frozen=True, slots=True, eq=False)
class _TrackResiduals:
    """The inliers of one fit."""

    stamp: float  # s
    key: Index  # (N,) of a track in a camera
    value: Array  # (N, 2) residuals in sigmas, as they pull at the pose


class TrackNoise:
    """Which share of the variance of the tracks' noise is new in each frame set, and which lasts.

    The window averages new noise, not lasting errors: where between pixels a landmark lies, from which side its patch
    is seen. The change of a track's residual shows both: new noise from one frame set to the next, lasting errors over
    seconds. What never changes is the map's error, or was in the first pose, too.
    """

    def __init__(self, cameras: int) -> None:
        self._cameras = cameras
        self._past: list[_TrackResiduals] = []  # of some seconds ago, of one, and the last
        # sums of squares per axis: all, new; all, changed in seconds
        self._sums = PRIOR_TRACKS * np.array([1.0, 1.0, 0.0, 0.0])

    @property
    def new(self) -> float:
        """The share that is new in each frame set."""
        return float(np.clip(self._sums[1] / self._sums[0], MIN_NEW_SHARE, 1.0))

    @property
    def lasting(self) -> float:
        """The share that stays from one frame set to the next and changes within seconds."""
        whole, changed = self._sums[2:]
        return float(np.clip(changed / max(whole, PRIOR_TRACKS) - self.new, 0.0, 1.0 - self.new))

    def learn(self, observations: Observations, solution: PoseFit, sigma: Array) -> None:
        """Take the residuals of one fit. sigma: (N,) px as claimed."""
        inlier = solution.weights > INLIER_WEIGHT
        key = observations.track[inlier] * self._cameras + observations.camera[inlier]
        pull = solution.weights[inlier] / (sigma[inlier] * solution.scale)
        now = _TrackResiduals(observations.stamp, key, solution.residuals[inlier] * pull[:, None])
        if not self._past:
            self._past = [now] * 3
            return
        old, middle, last = self._past
        new = _squared_changes(now, last) if now.stamp - last.stamp < MAX_NEW_GAP_S else np.zeros(2)
        self._sums = (1 - 1 / NOISE_MEMORY_SETS) * self._sums + np.r_[new, _squared_changes(now, old)]
        self._past = [middle, now, now] if now.stamp - middle.stamp >= LASTING_GAP_S else [old, middle, now]


def _squared_changes(now: _TrackResiduals, then: _TrackResiduals) -> Array:
    """Sums (2,), an axis, of the squared residuals of tracks that both have, and of half their squared changes."""
    _, rows, before = np.intersect1d(now.key, then.key, assume_unique=True, return_indices=True)
    value = now.value[rows]
    change = value - then.value[before]
    return np.array([(value**2).sum(), (change**2).sum() / 2]) / 2


def rescaling(assumed: Array, current: Array) -> Array:
    """S (6, 6): S @ M @ S.T is the window's marginal M for the `current` noise (6, 6) instead of the `assumed` one.

    In axes in which both noises are independent the marginal is a fixed part of the noise, whatever its size.
    """
    return np.asarray(np.linalg.cholesky(current) @ np.linalg.inv(np.linalg.cholesky(assumed)))


class ImageShiftDrift:
    """Mean squared drift of the images' shifts since the first pose, as patches are seen from other directions.

    Only shifts that a fit shows clearly count. The pose absorbs the others: that is the covariance to be reported.
    """

    def __init__(self) -> None:
        self._start: tuple[Array, Array] | None = None  # shifts (2C,) px, and the information (2C, 2C) of a fit of them
        self.variance = 0.0  # px^2 per axis; zero before there is a first pose
        self._count = 0  # frame sets of which it is the mean

    def start(self, fit: SharedFit, shift: Array) -> None:
        """Remember the shifts (C, 2), px, and how clearly a fit shows them, with the first pose that is given out."""
        self._start = shift.T.ravel(), _shift_information(fit)
        self.variance, self._count = 0.0, 0

    def learn(self, fit: SharedFit, shift: Array, lasting: float) -> None:
        """Take the shifts (C, 2), px, after one more fit.

        lasting: the part of the tracks' stated variance that lasts from one frame set to the next.
        """
        if self._start is None:
            return
        before, start_information = self._start
        information = np.linalg.inv(np.linalg.inv(_shift_information(fit)) + np.linalg.inv(start_information))
        information = information / max(lasting, MIN_LASTING_SHARE)
        self._count = min(self._count + 1, DRIFT_MEMORY_SETS)
        self.variance += (_mean_square(information, shift.T.ravel() - before) - self.variance) / self._count


def _shift_information(fit: SharedFit) -> Array:
    """(2C, 2C) of the shifts: right (C,), then down (C,)."""
    count = len(fit.pull) // 3
    part = fit.information[count:, count:]
    return np.asarray(part + 1e-9 * np.trace(part) * np.eye(len(part)))


def _mean_square(information: Array, shift: Array) -> float:
    """Mean square, px^2, of shifts (2C,), weighted by their information (2C, 2C), less their own error.

    Three cameras show three of six shifts: one sigma of what so few may be off by is added.
    """
    eigenvalues, axes = np.linalg.eigh(information)
    square = (axes.T @ shift) ** 2
    weight = (CLEAR_SHIFT_PX**2 + 1 / eigenvalues) ** -2
    weight = weight / weight.sum()
    return float(weight @ np.maximum(square - 1 / eigenvalues, 0.0) * (1 + (2 * (weight @ weight)) ** 0.5))


class CalibrationError:
    """The pose's error by imperfect lenses: the change of their effect since the map was made through them."""

    def __init__(self) -> None:
        self._first: Array | None = None  # (6, 2C), effect of the images' shifts on the first pose

    def covariance(self, fit: FrameFit, cameras: CameraErrors) -> Array:
        """(6, 6) at an accepted fit."""
        if self._first is None:
            self._first = fit.parts.by_shift
        change = fit.parts.by_shift - self._first
        size = 2 * np.mean(cameras.shift**2)  # px^2: of six shifts of three cameras the pose takes up about half
        return np.asarray(size * change @ change.T)


class ReportedCovariance:
    """The reported covariances of the poses of one map."""

    def __init__(self, cameras: int) -> None:
        self._tracks, self._drift = TrackNoise(cameras), ImageShiftDrift()
        # the first pose given out: the window's marginal, the fit's parts, the clocks' corrections (C,) s, all as then
        self._first: tuple[Array, FitCovariance, Array] | None = None
        self._lasting = np.zeros((6, 6))  # the last pose's lasting errors beyond its own covariance

    def learn(self, observations: Observations, fit: FrameFit, cameras: CameraErrors) -> None:
        """Take the residuals of an accepted fit, after the cameras did. observations.sigma: as claimed."""
        assert fit.solution.shared is not None
        self._tracks.learn(observations, fit.solution, observations.sigma)
        self._drift.learn(fit.solution.shared, cameras.shift, self._tracks.lasting * fit.parts.scatter)

    def measured(
        self, pose: SurfacePose, fit: FrameFit, cameras: CameraErrors, first: Array | None, window: WindowEstimate
    ) -> SurfacePose:
        """The pose of an accepted fit with its reported covariance.

        first: (6, 6) covariance of the first pose as it was believed then, a part of all later ones. window: of whose
        covariance that of `pose` is made.
        """
        parts = fit.parts
        rescaled = rescaling(parts.noise, self._noise(parts, cameras))
        current = self.error(window.covariance, parts, cameras.offset, cameras, rescaled)
        drifted = self._drift.variance * parts.by_shift @ parts.by_shift.T
        self._lasting = self._tracks.lasting * parts.scatter * parts.tracks + drifted
        change = current - window.covariance - parts.smear + drifted
        if self._first is not None and first is not None:
            change += self.error(*self._first, cameras) - first
        elif first is not None:
            assert fit.solution.shared is not None
            self._first = window.covariance, parts, cameras.offset
            self._drift.start(fit.solution.shared, cameras.shift)
        return replace(widened(pose, (change + change.T) / 2), twist_covariance=self._of_twist(window, parts, rescaled))

    def error(
        self,
        marginal: Array,
        parts: FitCovariance,
        offsets: Array,
        cameras: CameraErrors,
        rescaled: Array | None = None,
    ) -> Array:
        """Covariance (6, 6) of a pose, map and lenses apart, by what is known of tracks, images and clocks now.

        marginal: (6, 6), the window's. parts: of the newest of the fits averaged there. offsets: (C,) s, the delays
        that were corrected in them. The error of the first pose is constant; its size is known better with every frame
        set. rescaled: (6, 6), `rescaling` from the assumed to the current noise, if it is computed already.
        """
        rescaled = rescaling(parts.noise, self._noise(parts, cameras)) if rescaled is None else rescaled
        delay = parts.by_delay @ cameras.delay_moments(offsets) @ parts.by_delay.T
        lasting = self._tracks.lasting * parts.scatter * parts.tracks
        return np.asarray(rescaled @ marginal @ rescaled.T + lasting + delay)

    def _noise(self, parts: FitCovariance, cameras: CameraErrors) -> Array:
        """What is new in a frame set (6, 6), as known now."""
        shifted = cameras.shift_variance * parts.by_shift @ parts.by_shift.T
        return np.asarray(self._tracks.new * parts.scatter * parts.tracks + shifted)

    def _of_twist(self, window: WindowEstimate, parts: FitCovariance, rescaled: Array) -> Array:
        """(6, 6) of the window's twist: by noise and late exposures as known now, and by motion as hindsight shows.

        rescaled: as `error` takes it.
        """
        stated = window.twist_covariance
        by_pose = np.sqrt(np.diag(stated) / np.diag(parts.noise))  # 1/s, of the window's noise
        by_noise = rescaled @ stated @ rescaled.T + by_pose[:, None] * parts.smear * by_pose
        by_noise = NOISE_SHARE_OF_TWIST * by_noise
        motion_ratio = window.revision - NOISE_REVISED * np.diag(by_noise) / np.diag(stated)
        by_motion = np.sqrt(np.maximum(motion_ratio, 0.0) / MOTION_REVISED)
        return np.asarray(by_noise + by_motion[:, None] * stated * by_motion)

    def missed(self, pose: SurfacePose) -> SurfacePose:
        """A pose that is only predicted, with its reported covariance."""
        return widened(pose, self._lasting)


def widened(pose: SurfacePose, more: Array) -> SurfacePose:
    """The pose with `more` (6, 6) added to its covariance and to those of its forecast."""
    ahead = pose.forecast
    if ahead is not None:
        ahead = replace(ahead, covariances=ahead.covariances + more)
    return replace(pose, covariance=pose.covariance + more, forecast=ahead)


NO_ALIASES = np.zeros(0)


def alias_message(sizes: Array) -> str:
    """For the operator, where the surface may as well be (K,) mm away; or ''."""
    if not len(sizes):
        return ""
    return f"ambiguous: the surface repeats every {sizes.min():.1f} mm, and nothing tells where on it this is"


def alias_covariance(sizes: Array) -> Array:
    """(6, 6): of a surface that may as well be (K,) mm away; its 95 % radius reaches the farthest."""
    return np.diag([0.0] * 3 + [float(sizes.max()) ** 2 / 4] * 3)
