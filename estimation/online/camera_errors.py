"""Errors of whole cameras, learned online: when each really exposes, and by how much its image is shifted.

Webcams run free. Each has an offset from its stamps that hardly changes (10 to 60 ms were seen), and a jitter from
frame to frame. Both show where the surface moves: a late camera sees it displaced along its motion. Lens, extrinsics
and grazing views shift all of a camera's tracks alike, moving or not; a part of the shift stays, a part varies.

One Kalman filter holds what stays, offsets and shifts together, so that a shifted lens is not taken for a late clock.
What varies is learned as two variances. A delay common to all cameras cannot be seen: the reference is their mean.
Only the offsets are corrected. The map is made through the same lenses, so a shift that stays is in the map too, and
correcting it would carry the pose away from the map (measured: 0.04 mm on a surface at rest that had no shift at all).
"""

from __future__ import annotations

import copy
from dataclasses import dataclass

import numpy as np

from estimation.pose_solver import SharedErrors, SharedFit
from estimation.se3 import Array, Index


@dataclass(frozen=True, slots=True, eq=False)
class Delays:
    """How much later than stamped the C cameras expose."""

    mean: Array  # (C,) s
    covariance: Array  # (C, C) s^2, of one frame set's

    @property
    def sigma(self) -> float:
        """One standard deviation, s, of a camera's delay from its mean."""
        return float(np.sqrt(np.mean(np.diag(self.covariance))))


class VarianceEstimate:
    """The variance of a quantity that is seen through noise of known size, by Fisher scoring.

    A value d known to a variance e is a draw from sigma^2 + e, so sigma^2 is the mean of d^2 - e under the weights
    (sigma^2 + e)^-2. Expectation maximisation needed ten times the frames where single values are uncertain. Values
    without information do not count, and nothing is forgotten over them.
    """

    PRIOR_VALUES, RECENT = 3.0, 100  # values that the initial belief is worth; known values over which it is forgotten

    def __init__(self, first: float, least: float, clearest: float) -> None:
        """All one sigma: first, the initial belief; least, the smallest; clearest, no value is known better."""
        self._unit, self._least, self._clearest = first**2, least**2, clearest**2
        self._weight = self.PRIOR_VALUES  # one value known exactly, against a variance of `first`, weighs 1
        self._sum = self.PRIOR_VALUES * self._unit  # weighted, of d^2 - e

    @property
    def value(self) -> float:
        """The variance: its mean, and a part of what that may be off by."""
        return float(max(self._sum / self._weight, self._least) + 0.5 * (2 / self._weight) ** 0.5 * self._unit)

    def take(self, value: float, variance: float) -> None:
        """One value, known to a variance."""
        now = self.value
        share = (self._unit / (now + variance)) ** 2
        most = 2 * (self._unit / self._clearest) ** 2
        keep = min(1 - (now / (now + variance)) ** 2 / self.RECENT, most / (self._weight + share))
        self._weight = keep * self._weight + share
        self._sum = keep * self._sum + share * (value**2 - variance)


class CameraErrors:
    """Offsets and shifts of all cameras, with their joint covariance."""

    INITIAL_OFFSET_S, INITIAL_SHIFT_PX = 0.01, 0.5  # one sigma: webcams, and a usual calibration
    CHANCE_CHI2, CERTAIN_CHI2 = 2.0, 8.0  # mean squared sigmas at which chance explains the offsets, or does not
    DRIFT_RATE = 2e-5, 5e-3  # s and px per root second: quartz differs by 50 ppm at most; lenses warm up
    INFORMATION_DIVISOR = 3.0  # unmodelled errors repeat from frame to frame: each fit counts so much less
    MIN_SIGNAL_SHARE = 0.8  # of the squared velocity: where more of it is noise, nothing is learned of delays
    MAX_DELAY = 0.1  # s: a longer one is a wrong pose

    def __init__(self, cameras: int) -> None:
        self._count = n = cameras
        self._free = np.eye(3 * n)  # takes out what all clocks have in common
        self._free[:n, :n] -= 1 / n
        self._mean = np.zeros(3 * n)  # delays s, shifts right px, shifts down px
        start = np.diag(np.repeat([self.INITIAL_OFFSET_S**2, self.INITIAL_SHIFT_PX**2, self.INITIAL_SHIFT_PX**2], n))
        self._covariance = self._free @ start @ self._free
        # (C,) s, how much later than stamped each camera exposes; zero until offsets are clear: many cameras are
        # triggered together, and a correction by chance would only move the pose about
        self.offset = np.zeros(n)
        self._jitter = VarianceEstimate(0.005, 3e-4, 1e-3)  # s: USB cameras; no stamp is better
        self._unrest = VarianceEstimate(0.05, 0.005, 0.01)  # px, of a camera's shift from frame to frame
        self.delays = self._expected_delays()  # of the next frame set

    @property
    def offset_sigma(self) -> Array:
        """One standard deviation (C,), s, of each offset."""
        return np.asarray(np.sqrt(np.maximum(np.diag(self._covariance)[: self._count], 0.0)))

    @property
    def shift(self) -> Array:
        """Shift of each camera's image from where it should be (C, 2), px, without what the pose explains."""
        return self._mean[self._count :].reshape(2, -1).T.copy()

    def _expected_delays(self) -> Delays:
        n = self._count
        return Delays(self.offset, self._covariance[:n, :n] + self._jitter.value * np.eye(n))

    @property
    def unrest(self) -> float:
        """Variance, px^2 per axis, of an image's shift from frame to frame."""
        return self._unrest.value

    def beyond(self, corrected: Array) -> Array:
        """Second moments (C, C), s^2, of the delays that are left after a correction by offsets (C,), s."""
        left = self._mean[: self._count] - corrected
        return np.asarray(self.delays.covariance + np.outer(left, left))

    def shared(self, twist: Array) -> SharedErrors:
        """Shared errors that the next fit has to expect beyond `offset`, at a velocity (6,)."""
        return SharedErrors(twist, self.delays.covariance, np.full(self._count, self.unrest))

    def learn(self, fit: SharedFit, seconds: float, signal_share: float = 1.0) -> None:
        """Take a fit's shared errors, beyond the offsets that it was corrected by, `seconds` after the last one.

        signal_share: the part of the squared velocity that is not its own noise. Noise in a regressor makes the slope
        too small (errors in variables; Fuller 1987, 1.1), so delays are learned only where there is little of it.
        """
        n, eye = self._count, np.eye(3 * self._count)
        # about the known shifts and offsets; without information on delays where the velocity is not clear
        information, pull = fit.information.copy(), fit.pull.copy()
        pull -= information[:, n:] @ self._mean[n:] + information[:, :n] @ (self._mean[:n] - self.offset)
        if signal_share < self.MIN_SIGNAL_SHARE:
            information[:n] = information[:, :n] = pull[:n] = 0.0
        fit = SharedFit(information, pull)
        drift = np.repeat(self.DRIFT_RATE, [n, 2 * n]) ** 2 * seconds
        self._covariance = self._covariance + self._free * drift
        self._learn_variances(fit)
        # Kalman update in information form; the jitter and unrest of this frame set blur what stays
        new = np.repeat([self._jitter.value, self._unrest.value], [n, 2 * n])
        blurred = np.linalg.inv(eye + new[:, None] * fit.information)
        information = fit.information @ blurred / self.INFORMATION_DIVISOR
        gain = self._covariance @ np.linalg.inv(eye + information @ self._covariance)
        self._mean = self._free @ (self._mean + gain @ (blurred.T @ fit.pull) / self.INFORMATION_DIVISOR)
        self._covariance = self._free @ ((gain + gain.T) / 2) @ self._free
        # the offsets as far as chance does not explain them
        mean, known = self._mean[:n], np.linalg.pinv(self._covariance[:n, :n], hermitian=True)
        apart = float(mean @ known @ mean) / max(1, n - 1)
        self.offset = mean * min(1.0, max(0.0, (apart - self.CHANCE_CHI2) / (self.CERTAIN_CHI2 - self.CHANCE_CHI2)))
        self.delays = self._expected_delays()

    def _learn_variances(self, fit: SharedFit) -> None:
        n = self._count
        delays, shifts = np.arange(n), np.arange(n, 3 * n)
        new = np.repeat([self._jitter.value, self._unrest.value], [n, 2 * n])
        for part, rest, variance, far in (
            (delays, shifts, self._jitter, self.MAX_DELAY),
            (shifts, delays, self._unrest, np.inf),
        ):
            for value, doubt in zip(*self._independent(fit, part, rest, new), strict=True):
                if doubt < min(far**2, 1e3 * variance.value):
                    variance.take(float(value), float(doubt))

    def _independent(self, fit: SharedFit, part: Index, rest: Index, new: Array) -> tuple[Array, Array]:
        """Independent combinations (K,) of one part of the errors in this frame set, and their variances (K,)."""
        # the rest of the errors is marginalised
        prior = self._covariance[np.ix_(rest, rest)] + np.diag(new[rest])
        cross = fit.information[np.ix_(part, rest)]
        gain = cross @ prior @ np.linalg.inv(np.eye(len(rest)) + fit.information[np.ix_(rest, rest)] @ prior)
        information = fit.information[np.ix_(part, part)] - gain @ cross.T
        pull = fit.pull[part] - gain @ fit.pull[rest]
        # along the eigenvectors that are determined
        known, apart = np.linalg.eigh((information + information.T) / 2)
        sure = known > 1e-9 * known[-1]
        known, apart = known[sure], apart[:, sure]
        doubt = np.einsum("ik,ij,jk->k", apart, self._covariance[np.ix_(part, part)], apart)
        return (apart.T @ pull) / known, 1 / known + doubt


class CameraErrorHistory:
    """Camera errors as known some seconds ago: a deformation that begins is first taken for late cameras."""

    INTERVAL_S = 2.0  # a deformation is seen within one

    def __init__(self, cameras: CameraErrors) -> None:
        self._before, self._last, self._stamp = copy.deepcopy(cameras), copy.deepcopy(cameras), -np.inf

    def keep(self, stamp: float, cameras: CameraErrors) -> None:
        """Take the errors as known at `stamp`, s, every INTERVAL_S."""
        if stamp - self._stamp >= self.INTERVAL_S:
            self._before, self._last, self._stamp = self._last, copy.deepcopy(cameras), stamp

    @property
    def before(self) -> CameraErrors:
        """As known INTERVAL_S ago or earlier."""
        return copy.deepcopy(self._before)
