"""What is expected of the surface over the next half second: a curve from the newest pose, and its spread."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from statistics import NormalDist
from typing import TYPE_CHECKING

import numpy as np

from estimation import se3
from estimation.se3 import Array

if TYPE_CHECKING:
    from scipy.interpolate import CubicSpline

SHORT = 0.01  # s: what is left of a forecast that is shorter says no more than the velocity there


@dataclass(frozen=True, slots=True, eq=False)
class Forecast:
    """The motion ahead of a pose, from its stamp on.

    horizons: (H,) s after the pose, rising, above 0. increments: (H, 6) tangent vectors at the pose, so that it is
    expected at pose @ exp(increment). covariances: (H, 6, 6) of the right perturbation there, scaled so that the 90 %
    radius that they claim for points of the surface holds the share of 0.9 of the errors seen.
    """

    horizons: Array
    increments: Array
    covariances: Array

    @property
    def end(self) -> float:
        """s after the pose up to which the forecast reaches."""
        return float(self.horizons[-1])

    def at(self, ahead: Array) -> tuple[Array, Array]:
        """Increments (T, 6) and their rates (T, 6) per s, at `ahead` (T,), 0 to `end` s: a cubic through the horizons.

        The curve starts at the pose itself and has continuous acceleration: an arm follows it.
        """
        curve, slope = _basis(tuple(self.horizons.tolist()))
        return curve(ahead) @ self.increments, slope(ahead) @ self.increments

    def covariance(self, start: Array, ahead: float) -> Array:
        """Covariance (6, 6) at `ahead`, 0 to `end` s, with `start` (6, 6) at the pose; linear between horizons."""
        times = np.concatenate([[0.0], self.horizons])
        k = min(int(np.searchsorted(times, ahead, "right")), len(times) - 1)
        u = (ahead - times[k - 1]) / (times[k] - times[k - 1])
        before = start if k == 1 else self.covariances[k - 2]
        return np.asarray((1 - u) * before + u * self.covariances[k - 1])

    def after(self, ahead: float) -> Forecast | None:
        """What is left of the forecast at `ahead` s, seen from the pose expected there; None from the end on."""
        left = self.end - ahead
        if left < SHORT:
            return None
        steps = left * np.arange(1, len(self.horizons) + 1) / len(self.horizons)
        here, there = self.at(np.array([ahead]))[0][0], self.at(ahead + steps)[0]
        covariances = np.stack([self.covariance(self.covariances[0], ahead + s) for s in steps.tolist()])
        return Forecast(steps, se3.log(se3.inverse(se3.exp(here)) @ se3.exp(there)), covariances)


def prepare(horizons: Array) -> None:
    """Load and make what forecasts over these horizons (H,), s, take: 0.1 to 0.5 s, which the first need not spend."""
    _basis(tuple(horizons.tolist()))


@lru_cache(maxsize=8)
def _basis(horizons: tuple[float, ...]) -> tuple[CubicSpline, CubicSpline]:
    """What each horizon's increment adds along the curve, and to its slope."""
    from scipy.interpolate import CubicSpline  # half a second, which processes that only pass poses on need not spend

    count = len(horizons)
    curve = CubicSpline([0.0, *horizons], np.concatenate([np.zeros((1, count)), np.eye(count)]))
    return curve, curve.derivative()


def body_rate(increment: Array, rate: Array) -> Array:
    """Body velocity (..., 6) where exp(increment) is passed with d increment / dt = rate, both (..., 6).

    The right Jacobian's series (Barfoot 2017, 7.1.5) up to the square of the increment: turns within half a second are
    small, and at half a radian this is within half a percent.
    """
    once = _bracket(increment, rate)
    return np.asarray(rate - once / 2 + _bracket(increment, once) / 6)


def _bracket(a: Array, b: Array) -> Array:
    """The Lie bracket of tangent vectors (..., 6)."""
    turn = se3.cross(a[..., :3], b[..., :3])
    shift = se3.cross(a[..., :3], b[..., 3:]) + se3.cross(a[..., 3:], b[..., :3])
    return np.concatenate([turn, shift], axis=-1)


def radius(covariance: Array, share: float = 0.9) -> Array:
    """Radius (...) of the ball that holds `share` of a normal error with covariance (..., 3, 3) about its mean.

    The sum of three weighted squares is taken as one scaled chi-square (Satterthwaite 1946), whose quantile is Wilson
    and Hilferty's (1931): within 2 % of the exact one for every shape of the covariance at 0.9.
    """
    trace = np.maximum(np.trace(covariance, axis1=-2, axis2=-1), 0.0)
    squares = (covariance**2).sum((-2, -1))
    safe = np.where(trace > 0, trace, 1.0)
    part = 2 * np.where(trace > 0, squares, 1.0) / (9 * safe**2)
    return np.asarray(np.sqrt(trace) * np.maximum(1 - part + _normal_quantile(share) * np.sqrt(part), 0.0) ** 1.5)


def point_covariance(covariance: Array, points: Array) -> Array:
    """Covariances (..., N, 3, 3), mm^2, of points (N, 3), mm, under pose covariances (..., 6, 6)."""
    jacobian = np.concatenate([-se3.hat(points), np.broadcast_to(np.eye(3), (len(points), 3, 3))], -1)
    return np.asarray(jacobian @ covariance[..., None, :, :] @ np.swapaxes(jacobian, -1, -2))


@lru_cache(maxsize=8)
def _normal_quantile(share: float) -> float:
    return NormalDist().inv_cdf(share)
