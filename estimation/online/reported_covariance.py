"""Reported covariance of a pose: window marginal + map error + calibration error + smear, refined while running.

The estimator's own decisions (which camera is an outlier, where a landmark is searched, what enters the window) use
covariances from the first frame set on, when little is known of the cameras: wide, and good for deciding. The reported
covariance is refined:

- the error of the first pose and the window's marginal shrink once images are known to rest and tracks to scatter less;
- the lasting part of the tracks' errors, and the drift of the images' shifts, are added;
- after trouble the wide covariance is reported again, until a second has passed without any.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from estimation.observations import Observations
from estimation.online.camera_errors import CameraErrors
from estimation.online.fit import FrameFit
from estimation.online.window import WindowEstimate
from estimation.pose import SurfacePose, TrackState
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

CALM_BEFORE_NARROWING_S = 1.0  # without trouble: what slid over the wound is gone by then, and the window is new
USUAL_MEMORY_S = 2.0  # over which it is learned what is usual
FEWER_TRACKS, WORSE_SCATTER = 0.8, 2.0  # times the usual tracks and the usual scatter: something is there


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
        good = solution.weights > INLIER_WEIGHT
        key = observations.track[good] * self._cameras + observations.camera[good]
        pull = solution.weights[good] / (sigma[good] * solution.scale)
        now = _TrackResiduals(observations.stamp, key, solution.residuals[good] * pull[:, None])
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


class WindowNoise:
    """Rescales what the window says of a frame set, when tracks' and images' noise are known better.

    The window uses both noises as assumed at first. In the axes in which the two are independent its marginal is a part
    of the fit's covariance whatever their sizes, so each axis is rescaled by itself.
    """

    def __init__(self, fit: FrameFit, unrest: float) -> None:
        """fit: the newest of those averaged in the window. unrest: px^2, as assumed in it."""
        root = np.linalg.cholesky((fit.parts.noise + fit.parts.noise.T) / 2)
        back = np.linalg.inv(root)
        whitened = back @ fit.parts.tracks @ back.T
        share, axes = np.linalg.eigh((whitened + whitened.T) / 2)
        self._by_tracks = np.clip(share, 0.0, 1.0)  # (6,) of the fit's variance, axis by axis
        self._pose_from_axes, self._whitening = root @ axes, (back, axes)  # (6, 6) each
        self._scatter, self._unrest = fit.parts.scatter, unrest

    def rescaled(self, marginal: Array, tracks: TrackNoise, unrest: float) -> Array:
        """A marginal (6, 6) of the window by what is known of the tracks now, and of the images' unrest, px^2."""
        by_images = (1 - self._by_tracks) * (unrest / self._unrest)
        scaled = self._pose_from_axes * np.sqrt(self._by_tracks * (tracks.new * self._scatter) + by_images)
        back, axes = self._whitening
        inner = axes.T @ back @ marginal @ back.T @ axes
        return np.asarray(scaled @ ((inner + inner.T) / 2) @ scaled.T)


class FrameOriginError:
    """The error of the first pose given out: the path is placed in it, so all later poses share it.

    At that moment the images' unrest and the cameras' delays are hardly known, and assumed large. The error was drawn
    once and stays; its expected size is known better with every frame set.
    """

    def __init__(self, window: Array, fit: FrameFit, cameras: CameraErrors) -> None:
        """window: (6, 6), the window's marginal, with `fit` the newest of the fits averaged there."""
        self._window, self._averaged = window, WindowNoise(fit, cameras.unrest)
        self._tracks = fit.parts.scatter * fit.parts.tracks
        self._late, self._corrected = fit.parts.by_delay, cameras.offset

    def covariance(self, cameras: CameraErrors, tracks: TrackNoise) -> Array:
        """(6, 6) of the error, by what is known of cameras and tracks now."""
        late = self._late @ cameras.beyond(self._corrected) @ self._late.T
        averaged = self._averaged.rescaled(self._window, tracks, cameras.unrest)
        return np.asarray(averaged + tracks.lasting * self._tracks + late)


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

    def learn(self, fit: SharedFit, shift: Array, alike: float) -> None:
        """Take the shifts (C, 2), px, after one more fit.

        alike: the part of the variance claimed of tracks that lasts from one frame set to the next.
        """
        if self._start is None:
            return
        before, then = self._start
        both = np.linalg.inv(np.linalg.inv(_shift_information(fit)) + np.linalg.inv(then))
        both = both / max(alike, MIN_LASTING_SHARE)
        self._count = min(self._count + 1, DRIFT_MEMORY_SETS)
        self.variance += (_mean_square(both, shift.T.ravel() - before) - self.variance) / self._count


def _shift_information(fit: SharedFit) -> Array:
    """(2C, 2C) of the shifts: right (C,), then down (C,)."""
    count = len(fit.pull) // 3
    part = fit.information[count:, count:]
    return np.asarray(part + 1e-9 * np.trace(part) * np.eye(len(part)))


def _mean_square(information: Array, shift: Array) -> float:
    """Mean square, px^2, of shifts (2C,), weighted by their information (2C, 2C), less their own error.

    Three cameras show three of six shifts: one sigma of what so few may be off by is added.
    """
    known, axes = np.linalg.eigh(information)
    square = (axes.T @ shift) ** 2
    weight = (CLEAR_SHIFT_PX**2 + 1 / known) ** -2
    weight = weight / weight.sum()
    return float(weight @ np.maximum(square - 1 / known, 0.0) * (1 + (2 * (weight @ weight)) ** 0.5))


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
        self._first: tuple[FrameOriginError, Array] | None = None  # its covariance (6, 6) as assumed at the start
        self._usual = np.zeros(2)  # tracks that carry the pose; their scatter
        self._stamp, self._trouble = -np.inf, -np.inf  # s, of the last pose, and of the last with trouble
        self._added = np.zeros((6, 6))  # the last pose's lasting errors beyond its own covariance

    def learn(self, observations: Observations, fit: FrameFit, cameras: CameraErrors) -> None:
        """Take the residuals of an accepted fit, after the cameras did. seen.sigma: as claimed."""
        assert fit.solution.shared is not None
        self._tracks.learn(observations, fit.solution, observations.sigma)
        self._drift.learn(fit.solution.shared, cameras.shift, self._tracks.lasting * fit.parts.scatter)

    def measured(
        self, pose: SurfacePose, fit: FrameFit, cameras: CameraErrors, first: Array | None, window: WindowEstimate
    ) -> SurfacePose:
        """The pose of an accepted fit with its reported covariance.

        first: (6, 6) covariance of the first pose as it was assumed then. window: of whose covariance that of `pose`
        is made.
        """
        self._watch(pose, fit)
        if self._first is None and first is not None:
            assert fit.solution.shared is not None
            self._first = FrameOriginError(first - fit.parts.smear, fit, cameras), first
            self._drift.start(fit.solution.shared, cameras.shift)
            self._trouble = fit.stamp
        # added: lasting part of the tracks' errors, drift of the shifts, clock offsets that are not corrected yet
        parts = fit.parts
        late = cameras.beyond(cameras.offset) - cameras.delays.covariance
        drifted = self._drift.variance * parts.by_shift @ parts.by_shift.T
        more = self._tracks.lasting * parts.scatter * parts.tracks + drifted + parts.by_delay @ late @ parts.by_delay.T
        self._added = (more + more.T) / 2
        if self._first is None or pose.stamp - self._trouble < CALM_BEFORE_NARROWING_S:  # or it is the first pose
            return widened(pose, self._added)
        # subtracted: by how much the first pose's error and the window's marginal were assumed too large
        error, assumed = self._first
        first_change = error.covariance(cameras, self._tracks) - assumed
        noise = WindowNoise(fit, cameras.unrest)
        window_change = noise.rescaled(window.covariance, self._tracks, cameras.unrest) - window.covariance
        given = widened(pose, self._added + first_change + window_change)
        by_noise = noise.rescaled(window.twist_covariance, self._tracks, cameras.unrest)
        return replace(given, twist_covariance=_of_twist(window, fit, by_noise))

    def missed(self, pose: SurfacePose) -> SurfacePose:
        """A pose that is only predicted, with its reported covariance."""
        self._trouble = pose.stamp
        return widened(pose, self._added)

    def _watch(self, pose: SurfacePose, fit: FrameFit) -> None:
        """Note trouble: a reason, a state below TRACKING, or fewer or worse tracks than usual."""
        now = np.array([float(fit.used.sum()), fit.parts.scatter])
        share = min(1.0, (pose.stamp - self._stamp) / USUAL_MEMORY_S)
        unlike = now[0] < FEWER_TRACKS * self._usual[0] or now[1] > WORSE_SCATTER * self._usual[1]
        if pose.state is not TrackState.TRACKING or pose.reason or unlike:
            self._trouble = pose.stamp
        self._usual, self._stamp = self._usual + share * (now - self._usual), pose.stamp


def _of_twist(window: WindowEstimate, fit: FrameFit, by_noise: Array) -> Array:
    """(6, 6) of the window's twist: by noise and late exposures, as known now, and by motion, as hindsight shows.

    by_noise: (6, 6), the window's marginal as the noise of tracks and images rescales it.
    """
    claimed = window.twist_covariance
    by_pose = np.sqrt(np.diag(claimed) / np.diag(fit.parts.noise))  # 1/s, of the window's noise
    by_noise = NOISE_SHARE_OF_TWIST * (by_noise + by_pose[:, None] * fit.parts.smear * by_pose)
    moved = window.revision - NOISE_REVISED * np.diag(by_noise) / np.diag(claimed)
    by_motion = np.sqrt(np.maximum(moved, 0.0) / MOTION_REVISED)
    return np.asarray(by_noise + by_motion[:, None] * claimed * by_motion)


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
