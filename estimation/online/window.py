"""The sliding window of poses and twists: GTSAM's fixed-lag smoother, rebuilt when it breaks.

Each frame set adds one factor: its Gauss-Newton pose with the information. With 120 landmarks this was measured to be
as accurate as keeping every landmark in the window (0.024 mm), at a thirtieth of the time. Between poses stands GTSAM's
prior of white noise on acceleration (`WnoaMotionFactorPose3`; Barfoot 2017, 11.1), whose density follows the recent
motion axis by axis (`AccelerationPsd`). The window holds base_from_surface, not its inverse: the twist is then the
surface's velocity about its own origin, and the prior does not couple rotations with the far-away base.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, replace

import gtsam
import numpy as np

from estimation import se3
from estimation.runtime import compiled
from estimation.se3 import Array

WINDOW_LAG_S = 0.6  # longer changed the newest pose by nothing (0.5, 1 s, windows of 5 to 20 agree to 1e-4 mm)
GTSAM_ERRORS = RuntimeError, IndexError, ValueError  # what its smoother was seen to throw
MAX_PRIOR_CHI2 = 4.0  # squared sigmas of an axis, mean: a prior that is off by more gives way to the measurement

HINDSIGHT_S = 0.3  # after which a twist is looked at again: half the window, what comes later hardly changes it
REVISION_MEMORY_SETS = 300.0  # ten seconds, over which it is learned how far twists are revised then
PRIOR_REVISION, PRIOR_REVISIONS = 0.75, 7.0  # that of a motion as the prior has it, and for how many twists it counts

GRID_RATIO = 10**0.5  # between densities of the grid: closer ones cannot be told apart in a second
ROTATION_PSD_GRID = 1e-7 * GRID_RATIO ** np.arange(18)  # rad^2/s^3, from a surface at rest to a shaken one
TRANSLATION_PSD_GRID = 1e-2 * GRID_RATIO ** np.arange(18)  # mm^2/s^3
PSD_MEMORY_S = 1.0  # over which a density is judged
STUDENT_DOF = 4.0  # degrees of freedom of Student's t: a single jerk is not a lively motion, ten in a second are
INITIAL_RATE_SIGMA = 100.0  # rad/s and mm/s, standard deviation of a velocity before anything is known of it


class AccelerationPsd:
    """The density of white-noise acceleration that explains the recent motion best, axis by axis.

    A hand waves a thousand times livelier than a chest, and a chest along its normal only; a prior tuned to one drags
    or shakes on the other. So a bank of constant-velocity Kalman filters runs beside the window, one for each density
    of a grid, weighed by how well it predicted the last measurements (multiple-model estimation; Magill 1965).
    """

    def __init__(self) -> None:
        self._grid = np.stack([ROTATION_PSD_GRID] * 3 + [TRANSLATION_PSD_GRID] * 3)  # (6, K)
        self._score = np.zeros_like(self._grid)  # log likelihoods
        self.restart()

    def restart(self) -> None:
        """Begin with an unknown velocity, as after an outage; the densities' scores stay."""
        shape = self._grid.shape
        self._off, self._rate = np.zeros(shape), np.zeros(shape)  # filtered minus last measured pose, and its rate
        self._var, self._cross = np.full(shape, np.inf), np.zeros(shape)
        self._rate_var = np.full(shape, INITIAL_RATE_SIGMA**2)

    @property
    def psd(self) -> Array:
        """(6,) rad^2/s^3 and mm^2/s^3: the mean of the densities under their likelihoods."""
        weight = np.exp(self._score - self._score.max(1, keepdims=True))
        weight = weight / weight.sum(1, keepdims=True)
        return np.asarray((weight * self._grid).sum(1))

    def add(self, change: Array, seconds: float, variance: Array) -> None:
        """Take a measured pose: moved (6,) from the measured pose before it, variance (6,) of the new one."""
        if np.isinf(self._var).any():
            self._var = np.tile(variance[:, None], (1, self._grid.shape[1]))
        filters = self._off, self._rate, self._var, self._cross, self._rate_var
        keep = float(np.exp(-seconds / PSD_MEMORY_S))
        _update_filters(self._grid, self._score, filters, change, variance.copy(), float(seconds), keep)


@compiled("void(f8[:,::1], f8[:,::1], UniTuple(f8[:,::1], 5), f8[::1], f8[::1], f8, f8)")
def _update_filters(
    grid: Array, score: Array, filters: tuple[Array, ...], change: Array, variance: Array, dt: float, keep: float
) -> None:
    """Predict all filters (6, K) by dt, s, score them by the pose that was measured, and update them, in place."""
    off, rate, var, cross, rate_var = filters
    for i in range(grid.shape[0]):
        for k in range(grid.shape[1]):
            q = grid[i, k]
            innovation = off[i, k] + rate[i, k] * dt - change[i]  # predicted minus measured
            predicted = var[i, k] + 2 * dt * cross[i, k] + dt**2 * rate_var[i, k] + q * dt**3 / 3
            predicted_cross = cross[i, k] + dt * rate_var[i, k] + q * dt**2 / 2
            total = predicted + variance[i]
            likelihood = -0.5 * (np.log(total) + (STUDENT_DOF + 1) * np.log1p(innovation**2 / (STUDENT_DOF * total)))
            score[i, k] = keep * score[i, k] + likelihood
            gain, gain_rate = predicted / total, predicted_cross / total
            off[i, k], rate[i, k] = innovation * (1 - gain), rate[i, k] - gain_rate * innovation
            rate_var[i, k] += q * dt - gain_rate * predicted_cross
            var[i, k], cross[i, k] = predicted * (1 - gain), predicted_cross * (1 - gain)


@dataclass(frozen=True, slots=True, eq=False)
class MeasuredPose:
    """A pose as one frame set gives it."""

    stamp: float  # s
    pose: Array  # (4, 4)
    covariance: Array  # (6, 6) of its right perturbation


@dataclass(frozen=True, slots=True, eq=False)
class WindowEstimate:
    """The window's newest state."""

    stamp: float  # s
    pose: Array  # (4, 4)
    covariance: Array  # (6, 6)
    twist: Array  # (6,)
    twist_covariance: Array  # (6, 6)
    acceleration_psd: Array  # (6,)
    revision: Array  # (6,) mean square of what the next frame sets change of a twist, in parts of its variance


class Smoother:
    """Fixed-lag smoothing of measured poses, in constant time and memory; a broken window is rebuilt."""

    def __init__(self) -> None:
        self._last: MeasuredPose | None = None
        self._motion = AccelerationPsd()
        self._psd = self._motion.psd
        self._revised = PRIOR_REVISIONS * np.array([[PRIOR_REVISION] * 6, [1.0] * 6])  # sums: squares, and their count
        self.rebuilds = 0  # after an exception of GTSAM, since the start
        self._clear()

    def _clear(self) -> None:
        parameters = gtsam.ISAM2Params()
        parameters.findUnusedFactorSlots = True
        self._window = gtsam.IncrementalFixedLagSmoother(WINDOW_LAG_S, parameters)
        self._key = 0
        self._unrevised: deque[tuple[int, WindowEstimate]] = deque()  # key and estimate, to be looked at again
        self.newest: WindowEstimate | None = None  # the last estimate; None before the first measurement

    def reset(self) -> None:
        """Forget everything, as after an outage longer than the window."""
        self._last = None
        self._motion.restart()
        self._clear()

    def add(self, measured: MeasuredPose) -> WindowEstimate:
        """Take one measurement, newer than the ones before, and give the estimate at its stamp."""
        assert np.isfinite(measured.pose).all() and np.isfinite(measured.covariance).all()
        # no direction surer than 1e-6 rad or mm: GTSAM accepts a worse covariance and fails later
        values, vectors = np.linalg.eigh(_symmetric(measured.covariance))
        measured = replace(measured, covariance=(vectors * np.maximum(values, 1e-12)) @ vectors.T)
        if self.newest is not None and measured.stamp - self.newest.stamp > WINDOW_LAG_S:
            self.reset()
        if self._last is not None:
            change = se3.log(se3.inverse(self._last.pose) @ measured.pose)
            self._motion.add(change, measured.stamp - self._last.stamp, np.diag(measured.covariance))
        self._last, self._psd = measured, self._motion.psd
        try:
            self.newest = self._extend(measured)
        except GTSAM_ERRORS:
            self.newest = self._rebuild(measured)
        return self.newest

    def _rebuild(self, measured: MeasuredPose) -> WindowEstimate:
        """The estimate by a new window, as GTSAM's smoother cannot be used after it has thrown.

        It begins at the last estimate; where that is what cannot be used, at the measurement, without a velocity.
        """
        self.rebuilds += 1
        last = self.newest
        self._clear()
        if last is not None:
            try:
                self._begin_at(last)
                return self._extend(measured)
            except GTSAM_ERRORS:
                self._clear()
        return self._extend(measured)

    def _begin_at(self, last: WindowEstimate) -> None:
        """Take an estimate as the first pose and twist of an empty window; their correlation is left out."""
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        pose, twist = gtsam.symbol("x", self._key), gtsam.symbol("v", self._key)
        noise = gtsam.noiseModel.Gaussian.Covariance(last.covariance)
        graph.add(gtsam.PriorFactorPose3(pose, gtsam.Pose3(last.pose), noise))
        noise = gtsam.noiseModel.Gaussian.Covariance(last.twist_covariance)
        graph.add(gtsam.PriorFactorVector(twist, last.twist, noise))
        values.insert(pose, gtsam.Pose3(last.pose))
        values.insert(twist, last.twist)
        self._window.update(graph, values, {pose: last.stamp, twist: last.stamp})
        self._key += 1
        self.newest = last

    def _density(self, measured: MeasuredPose) -> Array:
        """Density (6,) of the acceleration since the last pose: the recent motion's, or that of a sudden jerk."""
        assert self.newest is not None
        psd, dt = self._psd.copy(), measured.stamp - self.newest.stamp
        innovation = se3.log(se3.inverse(self.newest.pose @ se3.exp(self.newest.twist * dt)) @ measured.pose)
        expected = self.newest.covariance + measured.covariance + dt**2 * self.newest.twist_covariance
        variance = np.diag(expected) + psd * dt**3 / 3
        for group in (slice(0, 3), slice(3, 6)):
            if np.mean(innovation[group] ** 2 / variance[group]) > MAX_PRIOR_CHI2:
                psd[group] = np.maximum(psd[group], np.mean(innovation[group] ** 2) * 3 / dt**3)
        return psd

    def _extend(self, measured: MeasuredPose) -> WindowEstimate:
        """Add one pose and twist, with the motion prior to those before, and the measurement."""
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        pose, twist = gtsam.symbol("x", self._key), gtsam.symbol("v", self._key)
        initial_twist = np.zeros(6)
        if self.newest is None:
            prior = gtsam.noiseModel.Diagonal.Sigmas(np.array([2.0] * 3 + [300.0] * 3))
            graph.add(gtsam.PriorFactorVector(twist, initial_twist, prior))
        else:
            initial_twist = self.newest.twist
            old_pose, old_twist = gtsam.symbol("x", self._key - 1), gtsam.symbol("v", self._key - 1)
            before = gtsam.StateData(old_pose, old_twist, self.newest.stamp)
            now = gtsam.StateData(pose, twist, measured.stamp)
            graph.add(gtsam.WnoaMotionFactorPose3(before, now, self._density(measured)))
        noise = gtsam.noiseModel.Gaussian.Covariance(_symmetric(measured.covariance))
        graph.add(gtsam.PriorFactorPose3(pose, gtsam.Pose3(measured.pose), noise))
        values.insert(pose, gtsam.Pose3(measured.pose))
        values.insert(twist, initial_twist)
        self._window.update(graph, values, {pose: measured.stamp, twist: measured.stamp})
        self._revise(measured.stamp)
        window = WindowEstimate(
            measured.stamp,
            np.asarray(self._window.calculateEstimatePose3(pose).matrix()),
            _symmetric(self._window.marginalCovariance(pose)),
            np.asarray(self._window.calculateEstimateVector(twist)),
            _symmetric(self._window.marginalCovariance(twist)),
            self._psd,
            self._revised[0] / self._revised[1],
        )
        parts = window.pose, window.covariance, window.twist, window.twist_covariance
        if not all(np.isfinite(part).all() for part in parts):
            raise ValueError("the window's estimate is not finite")
        self._unrevised.append((self._key, window))
        self._key += 1
        return window

    def _revise(self, stamp: float) -> None:
        """Learn from twists that are old enough at `stamp`, s, how far the poses since then have changed them."""
        while self._unrevised and self._unrevised[0][1].stamp <= stamp - HINDSIGHT_S:
            key, then = self._unrevised.popleft()
            if then.stamp < stamp - WINDOW_LAG_S:  # after a gap: it may have left the window
                continue
            change = self._window.calculateEstimateVector(gtsam.symbol("v", key)) - then.twist
            self._revised *= 1 - 1 / REVISION_MEMORY_SETS
            self._revised += [change**2 / np.diag(then.twist_covariance), np.ones(6)]

    @property
    def graph(self) -> str:
        """The factors and variables that the window holds, in Graphviz's language (DOT)."""
        return dot(self._window.getFactors(), dict(self._window.timestamps()))


VARIABLE_NAMES = {"x": "pose", "v": "twist"}
FACTOR_NAMES = {
    "PriorFactorPose3": "tracks of a frame set",
    "WnoaMotionFactorPose3": "white noise on acceleration",
    "PriorFactorVector": "twist before it is seen",
    "LinearContainerFactor": "what has left the window",
}


def dot(factors: gtsam.NonlinearFactorGraph, stamps: Mapping[int, float]) -> str:
    """A factor graph in Graphviz's language: variables as ellipses, factors as boxes. stamps: s, of the variables."""
    lines = ["graph window {"]
    for key, stamp in sorted(stamps.items(), key=lambda item: (item[1], item[0])):
        symbol = gtsam.Symbol(key)
        name = VARIABLE_NAMES[chr(symbol.chr())]
        lines.append(f'  {chr(symbol.chr())}{symbol.index()} [label="{name}\\n{stamp:.3f} s"];')
    for number in range(factors.size()):
        factor = factors.at(number)
        if factor is None:  # an unused slot
            continue
        lines.append(f'  f{number} [shape=box, label="{FACTOR_NAMES[type(factor).__name__]}"];')
        symbols = map(gtsam.Symbol, list(factor.keys()))
        lines += [f"  f{number} -- {chr(symbol.chr())}{symbol.index()};" for symbol in symbols]
    return "\n".join([*lines, "}", ""])


def _symmetric(matrix: Array) -> Array:
    return np.asarray((matrix + matrix.T) / 2)
