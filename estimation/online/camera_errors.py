"""What whole cameras are off by, learned online: when each really exposes, and where its image really stands.

Webcams run free. Each has an offset from its stamps that hardly changes (10 to 60 ms were seen) and a jitter from frame
to frame. Both show where the surface moves: a late camera sees it displaced along its motion. Lens, extrinsics and
grazing views shift all of a camera's tracks alike, moving or not; a part of that stays, a part varies. What stays is
the state of one Kalman filter, so that a shifted lens is not taken for a late clock; what varies is learned as two
variances. What the cameras' clocks have in common cannot be seen: the reference is their mean. Only the offsets are
corrected: a map is made through the same lenses, so a shift that stays is in it, and taking it out as it becomes known
would carry the pose away from the map (measured: 0.04 mm on a surface at rest, where there was no shift at all).
"""

from __future__ import annotations

import copy
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from estimation.online.pose_solver import Shared, SharedFit
from estimation.se3 import Array


@dataclass(frozen=True, slots=True, eq=False)
class Delays:
    """How much later than stamped the cameras expose. mean: (C,) s. covariance: (C, C) s^2, of one frame set's."""

    mean: Array
    covariance: Array

    @property
    def sigma(self) -> float:
        """One standard deviation, s, of a camera's delay from its mean."""
        return float(np.sqrt(np.mean(np.diag(self.covariance))))


class Variance:
    """The variance of a quantity that is seen through noise of known size, by Fisher scoring.

    A value d known to a variance e is a draw from sigma^2 + e, so sigma^2 is the mean of d^2 - e under the weights
    (sigma^2 + e)^-2. Expectation maximisation was measured to need ten times the frames where single values are
    uncertain. Values that tell nothing count for nothing, and nothing is forgotten over them.
    """

    TRUST, RECENT = 3.0, 100  # values that the first belief is worth; known values over which the rest is forgotten

    def __init__(self, first: float, least: float, clearest: float) -> None:
        """All one standard deviation. first: believed at first. least: the smallest. clearest: never known better."""
        self._unit, self._least, self._clearest = first**2, least**2, clearest**2
        self._weight = self.TRUST  # of all values taken, one known exactly against a variance of `first` weighing 1
        self._sum = self.TRUST * self._unit  # weighted, of d^2 - e

    @property
    def value(self) -> float:
        """The variance: its mean, and a part of what that may be off by."""
        return float(max(self._sum / self._weight, self._least) + 0.5 * (2 / self._weight) ** 0.5 * self._unit)

    def take(self, seen: float, variance: float) -> None:
        """One value, known to a variance."""
        now = self.value
        share = (self._unit / (now + variance)) ** 2
        most = 2 * (self._unit / self._clearest) ** 2
        keep = min(1 - (now / (now + variance)) ** 2 / self.RECENT, most / (self._weight + share))
        self._weight = keep * self._weight + share
        self._sum = keep * self._sum + share * (seen**2 - variance)


class CameraErrors:
    """Offsets and shifts of all cameras, with their joint covariance."""

    OFFSET, SHIFT = 0.01, 0.5  # s and px, one standard deviation at first: webcams, and a usual calibration
    PLAIN, SURE = 2.0, 8.0  # mean squared sigmas: at that, chance explains the offsets, or does not
    # s and px per root second: quartz differs by 50 ppm at most; lenses warm up
    WANDER = 2e-5, 5e-3
    CAREFUL = 3.0  # what is not modelled is alike in frame after frame, so that each tells less of what stays
    CLEAR = 0.8  # of the squared velocity: where more of it is noise, nothing is learned of delays
    FAR = 0.1  # s: a longer delay is a wrong pose

    def __init__(self, cameras: int) -> None:
        self._count = n = cameras
        self._free = np.eye(3 * n)  # takes out what all clocks have in common
        self._free[:n, :n] -= 1 / n
        self._mean = np.zeros(3 * n)  # delays s, shifts right px, shifts down px
        start = np.diag(np.repeat([self.OFFSET**2, self.SHIFT**2, self.SHIFT**2], n))
        self._covariance = self._free @ start @ self._free
        self._offset = np.zeros(n)
        self._delays: Delays | None = None  # as of the last `learn`: asked for many times a frame set
        self._jitter = Variance(0.005, 3e-4, 1e-3)  # s: USB cameras; no stamp is better
        self._unrest = Variance(0.05, 0.005, 0.01)  # px, of a camera's shift from frame to frame

    @property
    def offset(self) -> Array:
        """How much later than stamped each camera exposes (C,), s.

        Many cameras are triggered together, and a correction by what chance made up would only carry the pose about; so
        nothing is corrected until offsets are clearly there.
        """
        return self._offset

    @property
    def offset_sigma(self) -> Array:
        """One standard deviation (C,), s, of each offset."""
        return np.asarray(np.sqrt(np.maximum(np.diag(self._covariance)[: self._count], 0.0)))

    @property
    def shift(self) -> Array:
        """Where each camera's image stands from where it should (C, 2), px; what the pose explains is not in it."""
        return self._mean[self._count :].reshape(2, -1).T.copy()

    @property
    def delays(self) -> Delays:
        """What is expected of the next frame set."""
        if self._delays is None:
            n = self._count
            self._delays = Delays(self.offset, self._covariance[:n, :n] + self._jitter.value * np.eye(n))
        return self._delays

    @property
    def unrest(self) -> float:
        """Variance, px^2 per axis, of an image's shift from frame to frame."""
        return self._unrest.value

    def beyond(self, corrected: Array) -> Array:
        """Second moments (C, C), s^2, of the delays that are left where offsets (C,), s, were corrected by."""
        left = self._mean[: self._count] - corrected
        return np.asarray(self.delays.covariance + np.outer(left, left))

    def shared(self, twist: Array) -> Shared:
        """What the next fit has to reckon with beyond `offset`, at a velocity (6,)."""
        return Shared(twist, self.delays.covariance, np.full(self._count, self.unrest))

    def learn(self, found: SharedFit, seconds: float, clear: float = 1.0) -> None:
        """Take what a fit found, beyond the offsets that it was corrected by, `seconds` after the last one.

        clear: the part of the squared velocity that is not its own noise. Noise in a regressor makes the slope too
        small (errors in variables; Fuller 1987, 1.1), so delays are learned only where there is little of it.
        """
        found = self._beyond_mean(found, clear)
        n, eye = self._count, np.eye(3 * self._count)
        wander = np.repeat(self.WANDER, [n, 2 * n]) ** 2 * seconds
        self._covariance = self._covariance + self._free * wander
        self._learn_variances(found)
        new = np.repeat([self._jitter.value, self._unrest.value], [n, 2 * n])
        blurred = np.linalg.inv(eye + new[:, None] * found.information)  # what is new each time hides what stays
        told = found.information @ blurred / self.CAREFUL
        gain = self._covariance @ np.linalg.inv(eye + told @ self._covariance)
        self._mean = self._free @ (self._mean + gain @ (blurred.T @ found.pull) / self.CAREFUL)
        self._covariance = self._free @ ((gain + gain.T) / 2) @ self._free
        self._offset, self._delays = self._clear_offset(), None

    def _clear_offset(self) -> Array:
        """The offsets (C,), s, as far as chance does not explain them."""
        n = self._count
        mean, known = self._mean[:n], np.linalg.pinv(self._covariance[:n, :n], hermitian=True)
        apart = float(mean @ known @ mean) / max(1, n - 1)
        return mean * min(1.0, max(0.0, (apart - self.PLAIN) / (self.SURE - self.PLAIN)))

    def _beyond_mean(self, found: SharedFit, clear: float) -> SharedFit:
        """What a fit found beyond the shifts known, and of delays only what a clear velocity shows."""
        n, information, pull = self._count, found.information.copy(), found.pull.copy()
        pull -= information[:, n:] @ self._mean[n:] + information[:, :n] @ (self._mean[:n] - self.offset)
        if clear < self.CLEAR:
            information[:n] = information[:, :n] = pull[:n] = 0.0
        return replace(found, information=information, pull=pull)

    def _learn_variances(self, found: SharedFit) -> None:
        n = self._count
        delays, shifts = np.arange(n), np.arange(n, 3 * n)
        new = np.repeat([self._jitter.value, self._unrest.value], [n, 2 * n])
        for part, rest, variance, far in (
            (delays, shifts, self._jitter, self.FAR),
            (shifts, delays, self._unrest, np.inf),
        ):
            values, doubts = self._seen(found, part, rest, new)
            for value, doubt in zip(values, doubts, strict=True):
                if doubt < min(far**2, 1e3 * variance.value):
                    variance.take(float(value), float(doubt))

    def _seen(
        self, found: SharedFit, part: NDArray[np.int64], rest: NDArray[np.int64], new: Array
    ) -> tuple[Array, Array]:
        """Independent combinations (K,) of one part of the errors in this frame set, and their variances (K,)."""
        prior = self._covariance[np.ix_(rest, rest)] + np.diag(new[rest])
        cross = found.information[np.ix_(part, rest)]
        gain = cross @ prior @ np.linalg.inv(np.eye(len(rest)) + found.information[np.ix_(rest, rest)] @ prior)
        told = found.information[np.ix_(part, part)] - gain @ cross.T
        pull = found.pull[part] - gain @ found.pull[rest]
        known, apart = np.linalg.eigh((told + told.T) / 2)
        sure = known > 1e-9 * known[-1]
        known, apart = known[sure], apart[:, sure]
        doubt = np.einsum("ik,ij,jk->k", apart, self._covariance[np.ix_(part, part)], apart)
        return (apart.T @ pull) / known, 1 / known + doubt


class Clocks:
    """What was known of the cameras some seconds ago: as a surface begins to deform, that is taken for late cameras."""

    EVERY = 2.0  # s: a deformation is seen within one

    def __init__(self, cameras: CameraErrors) -> None:
        self._before, self._last, self._stamp = copy.deepcopy(cameras), copy.deepcopy(cameras), -np.inf

    def keep(self, stamp: float, cameras: CameraErrors) -> None:
        """Remember it as it is at `stamp`, s, from time to time."""
        if stamp - self._stamp >= self.EVERY:
            self._before, self._last, self._stamp = self._last, copy.deepcopy(cameras), stamp

    @property
    def before(self) -> CameraErrors:
        """What was known EVERY s ago or earlier."""
        return copy.deepcopy(self._before)
