"""The estimated pose of the surface with velocity, covariance, state and forecast; and trajectories."""

from __future__ import annotations

from bisect import bisect_right
from dataclasses import dataclass, field, replace
from enum import Enum
from functools import lru_cache
from statistics import NormalDist

import numpy as np

from estimation import se3
from estimation.runtime import CubicCurve
from estimation.se3 import Array
from estimation.surface_map import LocalError, Warp

_normal_quantile = lru_cache(maxsize=32)(NormalDist().inv_cdf)

MIN_FORECAST_S = 0.01  # a shorter remainder of a forecast says no more than the velocity


@dataclass(frozen=True, slots=True, eq=False)
class Forecast:
    """The motion ahead of a pose, from its stamp on."""

    horizons: Array  # (H,) s after the pose, rising, above 0
    increments: Array  # (H, 6) tangent vectors: the surface is expected at pose @ exp(increment)
    covariances: Array  # (H, 6, 6) of the right perturbation there, scaled so that 90 % radii hold 0.9 of the errors

    @property
    def end(self) -> float:
        """s after the pose up to which the forecast reaches."""
        return float(self.horizons[-1])

    def at(self, ahead: Array) -> tuple[Array, Array]:
        """Increments (T, 6) and their rates (T, 6) per s, at `ahead` (T,), 0 to `end` s: a cubic through the horizons.

        The curve starts at the pose itself and has continuous acceleration: an arm follows it.
        """
        share, rate = _basis(tuple(self.horizons.tolist()))(ahead)
        return share @ self.increments, rate @ self.increments

    def covariance(self, start: Array, ahead: float) -> Array:
        """Covariance (6, 6) at `ahead`, 0 to `end` s, with `start` (6, 6) at the pose; linear between horizons."""
        times = self.horizons.tolist()
        k = min(bisect_right(times, ahead), len(times) - 1)  # of the horizon after it
        earlier, before = (0.0, start) if k == 0 else (times[k - 1], self.covariances[k - 1])
        u = (ahead - earlier) / (times[k] - earlier)
        return np.asarray((1 - u) * before + u * self.covariances[k])

    def remainder(self, ahead: float) -> Forecast | None:
        """The forecast from `ahead` s on, relative to the predicted pose there; None at its end and beyond."""
        length = self.end - ahead
        if length < MIN_FORECAST_S:
            return None
        steps = length * np.arange(1, len(self.horizons) + 1) / len(self.horizons)
        increment, increments = self.at(np.array([ahead]))[0][0], self.at(ahead + steps)[0]
        covariances = np.stack([self.covariance(self.covariances[0], ahead + s) for s in steps.tolist()])
        return Forecast(steps, se3.log(se3.inverse(se3.exp(increment)) @ se3.exp(increments)), covariances)


@lru_cache(maxsize=8)
def _basis(horizons: tuple[float, ...]) -> CubicCurve:
    """Cubic curves, one for each horizon: 1 there, 0 at the other horizons and at the pose."""
    count = len(horizons)
    return CubicCurve(np.array([0.0, *horizons]), np.concatenate([np.zeros((1, count)), np.eye(count)]))


def body_twist(increment: Array, rate: Array) -> Array:
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


def radius(covariance: Array, share: float | Array = 0.9, offset: Array | None = None) -> Array:
    """Radius (...) of the ball that holds `share` of a normal error with covariance (..., 3, 3).

    share: 0 to 1; for one covariance (1, 3, 3) also (M,), which gives M radii.
    offset: (..., 3) of its mean from the ball's centre; None: about its mean.

    The sum of three weighted squares is taken as one scaled chi-square (Satterthwaite 1946), whose quantile is Wilson
    and Hilferty's (1931): within 2 % of the exact one for every shape of the covariance at 0.9.
    """
    trace = np.maximum(np.trace(covariance, axis1=-2, axis2=-1), 0.0)
    squares = (covariance**2).sum((-2, -1))
    if offset is not None:  # the mean of the squared length, and its variance over 2
        squares = squares + 2 * np.einsum("...i,...ij,...j", offset, covariance, offset)
        trace = trace + (offset**2).sum(-1)
    safe_trace = np.where(trace > 0, trace, 1.0)
    variance = 2 * np.where(trace > 0, squares, 1.0) / (9 * safe_trace**2)
    quantile = (
        np.array(list(map(_normal_quantile, share))) if isinstance(share, np.ndarray) else _normal_quantile(share)
    )
    return np.asarray(np.sqrt(trace) * np.maximum(1 - variance + quantile * np.sqrt(variance), 0.0) ** 1.5)


class TrackState(Enum):
    """Quality of a pose. TRACKING and DEGRADED are measured, the others are not."""

    INITIALISING = "INITIALISING"  # no surface map yet
    TRACKING = "TRACKING"  # two cameras or more agree on enough tracks
    DEGRADED = "DEGRADED"  # measured, with fewer cameras or tracks than TRACKING asks for
    COASTING = "COASTING"  # predicted only
    LOST = "LOST"  # predicted for too long to be of use

    @property
    def measured(self) -> bool:
        """Whether the newest images took part in the pose."""
        return self in (TrackState.TRACKING, TrackState.DEGRADED)


@dataclass(frozen=True, slots=True)
class MotionState:
    """Whether the surface moves: 300 um or 0.1 degree away from where it was at rest (thesis 1.3)."""

    moving: bool = True  # also before the surface was at rest for the first time
    onset: float = float("nan")  # s, stamp of the first pose of the last movement; nan: before the first pose
    distance: float = 0.0  # mm, of the map's middle from its last place of rest, or from the first pose
    angle: float = 0.0  # rad, likewise


@dataclass(frozen=True, slots=True, eq=False)
class SurfacePose:
    """Pose of the surface at one instant."""

    stamp: float  # s, middle of the exposure
    base_from_surface: Array  # (4, 4) mm
    covariance: Array  # (6, 6) of the right perturbation [rx ry rz tx ty tz], rad and mm, surface frame
    twist: Array  # (6,) body velocity, rad/s and mm/s
    state: TrackState
    twist_covariance: Array = field(default_factory=lambda: np.zeros((6, 6)))
    acceleration_psd: Array = field(default_factory=lambda: np.zeros(6))  # (6,) between poses, rad^2/s^3 and mm^2/s^3
    reason: str = ""  # of the state, for the operator
    motion: MotionState = MotionState()
    warp: Warp | None = None  # deformation of the surface; None where it is rigid
    forecast: Forecast | None = None  # learned prediction; None: constant twist
    local: LocalError | None = None  # additional error of single places; None: none

    def __repr__(self) -> str:
        place = " ".join(f"{value:.2f}" for value in self.base_from_surface[:3, 3])
        return f"SurfacePose({self.state.value} at {self.stamp:.3f} s, at {place} mm)"

    @property
    def deformation(self) -> float:
        """Root mean square displacement of the landmarks by the warp, mm."""
        return 0.0 if self.warp is None else self.warp.deformation

    @property
    def finite(self) -> bool:
        """Whether stamp, pose, covariances, warp, forecast and local errors are finite."""
        arrays = [self.base_from_surface, self.covariance, self.twist, self.twist_covariance, self.acceleration_psd]
        if self.warp is not None:
            arrays += [self.warp.control, self.warp.coefficients, self.warp.covariance, self.warp.growth]
        if self.forecast is not None:
            arrays += [self.forecast.horizons, self.forecast.increments, self.forecast.covariances]
        if (local := self.local) is not None:
            arrays += [local.centres, local.variance, local.growth, local.reach, local.support]
        return bool(np.isfinite(self.stamp) and all(np.isfinite(a).all() for a in arrays))

    def predict(self, stamp: float, keep_forecast: bool = True) -> SurfacePose:
        """The pose at `stamp` (s): along the forecast as far as it reaches, then under constant body velocity.

        The covariance is the forecast's, whose 90 % radii are calibrated, or that of white noise on acceleration
        (Barfoot 2017, 11.1): P + dt^2 P_twist + q dt^3 / 3, carried along the geodesic. A stamp before the pose's own
        runs the constant velocity backwards. keep_forecast: whether to keep the remaining forecast, which is slow.
        """
        dt = stamp - self.stamp
        if self.forecast is None or dt <= 0:
            return self._predict_by_twist(stamp)
        if dt > self.forecast.end:
            return self._predict_by_forecast(self.stamp + self.forecast.end, self.forecast, False)._predict_by_twist(
                stamp
            )
        return self._predict_by_forecast(stamp, self.forecast, keep_forecast)

    def predicted_poses(self, stamps: Array) -> Array:
        """base_from_surface (T, 4, 4) at stamps (T,), s: the poses of `predict`, for many stamps at once."""
        ahead = stamps - self.stamp
        if self.forecast is None:
            return np.asarray(self.base_from_surface @ se3.exp(self.twist * ahead[:, None]))
        within = np.clip(ahead, 0.0, self.forecast.end)
        poses = np.asarray(self.base_from_surface @ se3.exp(self.forecast.at(within)[0]))
        if np.array_equal(within, ahead):
            return poses
        end_twist = body_twist(*self.forecast.at(np.array([self.forecast.end])))
        twist = np.where((ahead < 0)[:, None], self.twist, end_twist)
        return np.asarray(poses @ se3.exp(twist * (ahead - within)[:, None]))

    def _predict_by_forecast(self, stamp: float, forecast: Forecast, keep_forecast: bool) -> SurfacePose:
        """The pose at `stamp`, s, within its forecast."""
        ahead = min(stamp - self.stamp, forecast.end)
        increments, rates = forecast.at(np.array([ahead]))
        return replace(
            self,
            stamp=stamp,
            base_from_surface=self.base_from_surface @ se3.exp(increments[0]),
            covariance=forecast.covariance(self.covariance, ahead),
            twist=body_twist(increments[0], rates[0]),
            twist_covariance=self.twist_covariance + np.diag(self.acceleration_psd) * ahead,
            warp=None if self.warp is None else self.warp.propagate(ahead),
            local=None if self.local is None else self.local.propagate(ahead),
            forecast=forecast.remainder(ahead) if keep_forecast else None,
        )

    def _predict_by_twist(self, stamp: float) -> SurfacePose:
        """The pose at `stamp`, s, under constant body velocity."""
        dt = stamp - self.stamp
        step = se3.exp(self.twist * dt)
        transport = se3.adjoint(se3.inverse(step))
        grown = transport @ self.covariance @ transport.T + dt**2 * self.twist_covariance
        grown = grown + np.diag(self.acceleration_psd) * abs(dt) ** 3 / 3
        twist_grown = self.twist_covariance + np.diag(self.acceleration_psd) * abs(dt)
        return replace(
            self,
            stamp=stamp,
            base_from_surface=self.base_from_surface @ step,
            covariance=(grown + grown.T) / 2,
            twist_covariance=twist_grown,
            warp=None if self.warp is None else self.warp.propagate(dt),
            local=None if self.local is None else self.local.propagate(dt),
            forecast=None if dt else self.forecast,
        )

    def error_at(self, points_surface: Array) -> Array:
        """Standard deviation (N,), mm, of the position of points (N, 3), surface frame, along its worst direction."""
        return np.asarray(np.sqrt(np.linalg.eigvalsh(self._position_covariances(points_surface))[:, -1]))

    def predicted_error(self, stamp: float, points_surface: Array) -> Array:
        """`predict(stamp).error_at(points)`, but faster: only the covariances are predicted."""
        dt = stamp - self.stamp
        if self.forecast is None or not 0 < dt <= self.forecast.end:
            return self.predict(stamp).error_at(points_surface)
        covariance = self.forecast.covariance(self.covariance, dt)
        warp = None if self.warp is None else self.warp.propagate(dt)
        local = None if self.local is None else self.local.propagate(dt)
        return replace(self, covariance=covariance, warp=warp, local=local).error_at(points_surface)

    def radius_at(self, points_surface: Array, share: float | Array = 0.9, offsets: Array | None = None) -> Array:
        """Radius (N,), mm, of balls at points (N, 3), surface frame, that hold the true places in `share` of cases.

        share: as in `radius`.
        offsets: (N, 3) mm, of the points from the balls' centres; None: zero.
        """
        return radius(self._position_covariances(points_surface), share, offsets)

    def _position_covariances(self, points_surface: Array) -> Array:
        """Covariances (N, 3, 3), mm^2, of the positions of points (N, 3)."""
        jacobian = se3.point_jacobians(points_surface)
        covariances = np.asarray(jacobian @ self.covariance @ np.swapaxes(jacobian, -1, -2))
        covariances = (
            covariances if self.warp is None else covariances + self.warp.displacement_covariance(points_surface)
        )
        if self.local is not None:
            covariances = covariances + self.local.variance_at(points_surface)[:, None, None] * np.eye(3)
        return np.asarray(covariances)


def identity_pose(stamp: float, reason: str) -> SurfacePose:
    """The pose before the first map: INITIALISING, at the base's origin, with a covariance of half a turn and 1 m."""
    covariance = np.diag([np.pi**2] * 3 + [1e6] * 3)
    return SurfacePose(stamp, np.eye(4), covariance, np.zeros(6), TrackState.INITIALISING, reason=reason)


def position_sigma(covariance: Array) -> float:
    """Standard deviation, mm, of the position along its worst direction; inf where (6, 6) is not finite."""
    block = covariance[3:, 3:]
    return float(np.sqrt(max(np.linalg.eigvalsh(block)[-1], 0.0))) if np.isfinite(block).all() else float("inf")


@dataclass(frozen=True, slots=True, eq=False)
class Trajectory:
    """A recorded motion of the surface: a session's truth or reference, or the poses of a run.

    A truth (`truth.tum`) is a simulator's or an instrument's. A reference (`reference.tum`) is measured and has errors
    of its own, which are not the tracker's.
    """

    stamps: Array  # (N,) s, strictly increasing
    base_from_surface: Array  # (N, 4, 4) mm
    exact: bool  # truth; False: measured reference

    def __repr__(self) -> str:
        seconds = float(self.stamps[-1] - self.stamps[0]) if len(self) else 0.0
        return f"Trajectory({len(self)} poses over {seconds:.1f} s{', exact' if self.exact else ''})"

    def __len__(self) -> int:
        return len(self.stamps)

    def at(self, times: Array) -> Array:
        """base_from_surface (N, 4, 4) mm interpolated at times (N,), s; beyond the ends the first or the last one."""
        after = np.clip(np.searchsorted(self.stamps, times), 1, len(self.stamps) - 1)
        share = (times - self.stamps[after - 1]) / (self.stamps[after] - self.stamps[after - 1])
        poses = self.base_from_surface
        return np.asarray(se3.interpolate(poses[after - 1], poses[after], np.clip(share, 0.0, 1.0)))
