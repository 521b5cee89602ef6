"""The sliding window of poses and twists: the only owner of a GTSAM smoother, which it rebuilds when it breaks.

One factor per frame: the Gauss-Newton pose with its information. Measured with 120 landmarks this is as accurate as
keeping every landmark in the window (0.024 mm) at a thirtieth of the time. Between poses stands GTSAM's prior of white
noise on acceleration (`WnoaMotionFactorPose3`; Barfoot 2017, 11.1). The window holds base_from_surface, not its
inverse: its twist is then the surface's own velocity about its own origin, and the prior does not couple turns with the
far-away base.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import gtsam
import numpy as np

from estimation import se3
from estimation.liveliness import Liveliness
from estimation.se3 import Array

LAG = 0.6  # s: longer changed the newest pose by nothing (0.5, 1 s and windows of 5 to 20 agree to 1e-4 mm)
SURPRISE = 4.0  # squared sigmas of an axis, mean: a prior that is off by more gives way to the measurement


@dataclass(frozen=True, slots=True, eq=False)
class Measured:
    """A pose as one frame set gives it. stamp: s. pose: (4, 4). covariance: (6, 6) of its right perturbation."""

    stamp: float
    pose: Array
    covariance: Array


@dataclass(frozen=True, slots=True, eq=False)
class Window:
    """The newest estimate. pose (4, 4), twist (6,), their covariances (6, 6), acceleration_psd (6,)."""

    stamp: float
    pose: Array
    covariance: Array
    twist: Array
    twist_covariance: Array
    acceleration_psd: Array


class Smoother:
    """Fixed-lag smoothing of measured poses; flat in time and memory, and never destroyed for good."""

    def __init__(self) -> None:
        self._last: Measured | None = None
        self._liveliness = Liveliness()
        self._psd = self._liveliness.psd
        self.restarts = 0
        self._clear()

    def _clear(self) -> None:
        parameters = gtsam.ISAM2Params()
        parameters.findUnusedFactorSlots = True
        self._window = gtsam.IncrementalFixedLagSmoother(LAG, parameters)
        self._key = 0
        self._newest: Window | None = None

    @property
    def newest(self) -> Window | None:
        """The last estimate, or None before the first measurement."""
        return self._newest

    def reset(self) -> None:
        """Forget everything, as after an outage longer than the window."""
        self._last = None
        self._liveliness.restart()
        self._clear()

    def add(self, measured: Measured) -> Window:
        """Take one measurement, newer than the ones before, and give the estimate at its stamp."""
        assert np.isfinite(measured.pose).all() and np.isfinite(measured.covariance).all()
        measured = replace(measured, covariance=_proper(measured.covariance))
        before = self._newest
        if before is not None and measured.stamp - before.stamp > LAG:
            self.reset()
        if self._last is not None:
            moved = se3.log(se3.inverse(self._last.pose) @ measured.pose)
            self._liveliness.add(moved, measured.stamp - self._last.stamp, np.diag(measured.covariance))
        self._last, self._psd = measured, self._liveliness.psd
        try:
            self._newest = self._extend(measured)
        except (RuntimeError, IndexError, ValueError):
            self._newest = self._rebuild(measured)
        return self._newest

    def _density(self, measured: Measured) -> Array:
        """Of the acceleration since the last pose, (6,): what the motion was, or more where it now surprises.

        A jerk of the hand loosens the prior at once: where motion is not smooth it must not drag the pose.
        """
        assert self._newest is not None
        psd, dt = self._psd.copy(), measured.stamp - self._newest.stamp
        off = se3.log(se3.inverse(self._newest.pose @ se3.exp(self._newest.twist * dt)) @ measured.pose)
        expected = self._newest.covariance + measured.covariance + dt**2 * self._newest.twist_covariance
        variance = np.diag(expected) + psd * dt**3 / 3
        for group in (slice(0, 3), slice(3, 6)):
            if np.mean(off[group] ** 2 / variance[group]) > SURPRISE:
                psd[group] = np.maximum(psd[group], np.mean(off[group] ** 2) * 3 / dt**3)
        return psd

    def _extend(self, measured: Measured) -> Window:
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        pose, twist = gtsam.symbol("x", self._key), gtsam.symbol("v", self._key)
        start = np.zeros(6)
        if self._newest is None:
            wide = gtsam.noiseModel.Diagonal.Sigmas(np.array([2.0] * 3 + [300.0] * 3))
            graph.add(gtsam.PriorFactorVector(twist, start, wide))
        else:
            start = self._newest.twist
            old_pose, old_twist = gtsam.symbol("x", self._key - 1), gtsam.symbol("v", self._key - 1)
            graph.add(
                gtsam.WnoaMotionFactorPose3(
                    gtsam.StateData(old_pose, old_twist, self._newest.stamp),
                    gtsam.StateData(pose, twist, measured.stamp),
                    self._density(measured),
                )
            )
        noise = gtsam.noiseModel.Gaussian.Covariance(_symmetric(measured.covariance))
        graph.add(gtsam.PriorFactorPose3(pose, gtsam.Pose3(measured.pose), noise))
        values.insert(pose, gtsam.Pose3(measured.pose))
        values.insert(twist, start)
        self._window.update(graph, values, {pose: measured.stamp, twist: measured.stamp})
        estimate = self._window.calculateEstimate()
        self._key += 1
        window = Window(
            measured.stamp,
            np.asarray(estimate.atPose3(pose).matrix()),
            _symmetric(self._window.marginalCovariance(pose)),
            np.asarray(estimate.atVector(twist)),
            _symmetric(self._window.marginalCovariance(twist)),
            self._psd,
        )
        if not all(
            np.isfinite(a).all() for a in (window.pose, window.covariance, window.twist, window.twist_covariance)
        ):
            raise ValueError("the window's estimate is not finite")
        return window

    def _rebuild(self, newest: Measured) -> Window:
        """Start a fresh window from the newest measurement alone: GTSAM's smoother is of no use after it has thrown."""
        self.restarts += 1
        self._clear()
        return self._extend(newest)


def _proper(covariance: Array) -> Array:
    """The covariance with no direction surer than 1e-6 rad or mm: GTSAM accepts a worse one and fails later."""
    values, vectors = np.linalg.eigh(_symmetric(covariance))
    return np.asarray((vectors * np.maximum(values, 1e-12)) @ vectors.T)


def _symmetric(matrix: Array) -> Array:
    return np.asarray((matrix + matrix.T) / 2)
