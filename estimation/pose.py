"""The estimate: where the surface is, how fast it moves, how sure we are, and whether to trust it."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from enum import Enum

import numpy as np

from estimation import se3
from estimation.forecast import Forecast, body_rate, point_covariance, radius
from estimation.se3 import Array
from estimation.warp import Warp


class TrackState(Enum):
    """How much a pose is worth. TRACKING and DEGRADED are measured, the others are not."""

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
class SurfaceMotion:
    """Whether the surface moves: a movement of 300 um or 0.1 degree away from where it was at rest (thesis 1.3).

    moving: also before it has been seen at rest. onset: s, stamp of the first pose of the last movement, NaN where that
    was before the first pose. moved: mm, of the middle of the mapped surface, and turned: rad, since it was last at
    rest, or since the first pose before it ever was.
    """

    moving: bool = True
    onset: float = float("nan")
    moved: float = 0.0
    turned: float = 0.0


@dataclass(frozen=True, slots=True, eq=False)
class SurfacePose:
    """Pose of the surface at one instant.

    stamp: s, middle of the exposure. base_from_surface: (4, 4) mm. covariance: (6, 6) of the right perturbation
    [rx ry rz tx ty tz], rad and mm, in the surface frame. twist: (6,) body velocity, rad/s and mm/s. twist_covariance:
    (6, 6). acceleration_psd: (6,) spectral density of the white-noise acceleration between poses, rad^2/s^3 and
    mm^2/s^3. reason: why the state is what it is, in words for the operator. motion: as last detected. warp: how
    the surface departs from the rigid body that the pose describes; None while it does not.
    forecast: where the surface is expected from the stamp on, if that is known better than by the twist.
    """

    stamp: float
    base_from_surface: Array
    covariance: Array
    twist: Array
    state: TrackState
    twist_covariance: Array = field(default_factory=lambda: np.zeros((6, 6)))
    acceleration_psd: Array = field(default_factory=lambda: np.zeros(6))
    reason: str = ""
    motion: SurfaceMotion = SurfaceMotion()
    warp: Warp | None = None
    forecast: Forecast | None = None

    @property
    def deformation(self) -> float:
        """Root mean square displacement of the landmarks, mm, that no rigid motion explains."""
        return 0.0 if self.warp is None else self.warp.deformation

    def predict(self, stamp: float, onwards: bool = True) -> SurfacePose:
        """The pose at `stamp` (s): along the forecast as far as it reaches, under constant body velocity from there on.

        The covariance is the forecast's, whose 90 % radii are calibrated, or that of white noise on acceleration
        (Barfoot 2017, 11.1): P + dt^2 P_twist + q dt^3 / 3, carried along the geodesic. A stamp before the pose's own
        runs the constant velocity backwards. onwards: whether what is left of the forecast goes along, which costs more
        than all the rest.
        """
        dt = stamp - self.stamp
        if self.forecast is None or dt <= 0:
            return self._drift(stamp)
        if dt > self.forecast.end:
            return self._foreseen(self.stamp + self.forecast.end, self.forecast, onwards=False)._drift(stamp)
        return self._foreseen(stamp, self.forecast, onwards)

    def base_at(self, stamps: Array) -> Array:
        """base_from_surface (T, 4, 4) at stamps (T,), s: the poses of `predict`, for many stamps at once."""
        ahead = stamps - self.stamp
        if self.forecast is None:
            return np.asarray(self.base_from_surface @ se3.exp(self.twist * ahead[:, None]))
        within = np.clip(ahead, 0.0, self.forecast.end)
        foreseen = np.asarray(self.base_from_surface @ se3.exp(self.forecast.at(within)[0]))
        if np.array_equal(within, ahead):
            return foreseen
        beyond = body_rate(*self.forecast.at(np.array([self.forecast.end])))
        speed = np.where((ahead < 0)[:, None], self.twist, beyond)
        return np.asarray(foreseen @ se3.exp(speed * (ahead - within)[:, None]))

    def _foreseen(self, stamp: float, forecast: Forecast, onwards: bool) -> SurfacePose:
        """The pose at `stamp`, s, within its forecast."""
        ahead = min(stamp - self.stamp, forecast.end)
        increments, rates = forecast.at(np.array([ahead]))
        return replace(
            self,
            stamp=stamp,
            base_from_surface=self.base_from_surface @ se3.exp(increments[0]),
            covariance=forecast.covariance(self.covariance, ahead),
            twist=body_rate(increments[0], rates[0]),
            twist_covariance=self.twist_covariance + np.diag(self.acceleration_psd) * ahead,
            warp=None if self.warp is None else self.warp.later(ahead),
            forecast=forecast.after(ahead) if onwards else None,
        )

    def _drift(self, stamp: float) -> SurfacePose:
        """The pose at `stamp`, s, under constant body velocity."""
        dt = stamp - self.stamp
        step = se3.exp(self.twist * dt)
        carry = se3.adjoint(se3.inverse(step))
        grown = (
            carry @ self.covariance @ carry.T
            + dt**2 * self.twist_covariance
            + np.diag(self.acceleration_psd) * abs(dt) ** 3 / 3
        )
        twist_grown = self.twist_covariance + np.diag(self.acceleration_psd) * abs(dt)
        return replace(
            self,
            stamp=stamp,
            base_from_surface=self.base_from_surface @ step,
            covariance=(grown + grown.T) / 2,
            twist_covariance=twist_grown,
            warp=None if self.warp is None else self.warp.later(dt),
            forecast=None if dt else self.forecast,
        )

    def error_at(self, points_surface: Array) -> Array:
        """Standard deviation (N,), mm, of the position of points (N, 3), surface frame, along its worst direction."""
        spread = self._spread(points_surface)
        return np.asarray(np.sqrt(np.linalg.eigvalsh(spread)[:, -1]))

    def error_ahead(self, stamp: float, points_surface: Array) -> Array:
        """What `predict(stamp).error_at(points)` is, without all else that a prediction holds."""
        dt = stamp - self.stamp
        if self.forecast is None or not 0 < dt <= self.forecast.end:
            return self.predict(stamp).error_at(points_surface)
        covariance = self.forecast.covariance(self.covariance, dt)
        warp = None if self.warp is None else self.warp.later(dt)
        return replace(self, covariance=covariance, warp=warp).error_at(points_surface)

    def radius_at(self, points_surface: Array, share: float = 0.9) -> Array:
        """Radius (N,), mm, about points (N, 3), surface frame, that holds their true places in `share` of cases."""
        return radius(self._spread(points_surface), share)

    def _spread(self, points_surface: Array) -> Array:
        """Covariances (N, 3, 3), mm^2, of the positions of points (N, 3)."""
        spread = point_covariance(self.covariance, points_surface)
        return spread if self.warp is None else np.asarray(spread + self.warp.spread(points_surface))


def identity_pose(stamp: float, reason: str) -> SurfacePose:
    """The pose before there is any: INITIALISING, at the base's origin, without any certainty."""
    return SurfacePose(
        stamp, np.eye(4), np.diag([np.pi**2] * 3 + [1e6] * 3), np.zeros(6), TrackState.INITIALISING, reason=reason
    )


def position_sigma(covariance: Array) -> float:
    """Standard deviation, mm, of the position along its worst direction; inf where (6, 6) is not finite."""
    block = covariance[3:, 3:]
    return float(np.sqrt(max(np.linalg.eigvalsh(block)[-1], 0.0))) if np.isfinite(block).all() else float("inf")
