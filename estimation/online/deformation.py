"""The warp of the newest frame set, from what a rigid fit to the warped map leaves over.

A Kalman filter in information form (Thrun et al. 2005, 3.5) over two vectors of modes: the deformation, which wanders
and slowly decays, and beside it what the map's own smooth error adds, which stays. At the first frame set the
deformation is zero: the surface is as it was mapped. How lively it wanders is learned from the residuals, and what
chance may add does not count, so that on a rigid surface the deformation stays exactly zero.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from estimation.observations import Observations
from estimation.online.pose_solver import PoseFit
from estimation.runtime import NEW
from estimation.se3 import Array
from estimation.surface_map import SurfaceMap
from estimation.track_loops import rows_of_modes
from estimation.warp import Warp
from estimation.warp_modes import WarpModes, modes_from_map

DECAY = 30.0  # s: some breaths; a deformation that nobody sees any more is forgotten over them
ASLEEP = 0.05  # of the greatest liveliness: then it is over
MEMORY = 1.0  # s: over which the liveliness is learned
CHANCE = 4.0  # standard errors that the liveliness must reach, else it is put down to chance
BIAS = 0.01  # mm: of a mode in one frame set, by patches that are not quite what they were
MAP_SIGMA = 0.02  # mm: no map is known better at the start, mode by mode
LEAST = 12  # landmarks: with fewer there are no modes


class WarpFilter:
    """Follows the deformation of one surface."""

    def __init__(self, surface_map: SurfaceMap) -> None:
        self._points = surface_map.points
        self._modes: WarpModes | None = modes_from_map(surface_map) if len(surface_map) >= 2 * LEAST else None
        count = 0 if self._modes is None else len(self._modes.share)
        self._state = np.zeros(2 * count)  # deformation, and the map's error
        self._covariance = np.zeros((2 * count, 2 * count))
        if self._modes is not None:
            self._covariance[count:, count:] = _of_map(self._modes, surface_map)
        self._stamp: float | None = None
        self._seen, self._doubt = 0.0, 0.0  # liveliness, mm^2/s, signed, and the variance of one look at it
        self._liveliness = self._liveliest = 0.0
        self._warp: Warp | None = None

    @property
    def warp(self) -> Warp | None:
        """The deformation at the last frame set; None while there is none."""
        return self._warp

    @property
    def liveliness(self) -> float:
        """How fast the square of the deformation grows by itself, mm^2/s; 0 on a rigid surface.

        A chest rests after each breath and is as lively in the next one: only over some breaths is it forgotten.
        """
        return self._liveliness

    @property
    def _clear(self) -> float:
        """The liveliness of the last second, 0 where chance explains it."""
        return self._seen if self._seen > CHANCE * float(np.sqrt(self._doubt)) else 0.0

    def points(self, surface_map: SurfaceMap) -> Array:
        """The landmarks (N, 3) mm, surface frame, where the deformation puts them."""
        if self._warp is None or self._modes is None:
            return surface_map.points
        return np.asarray(surface_map.points + self._modes.landmarks @ self._state[: len(self._modes.share)])

    def pull(self, track: NDArray[np.int64], weighted: Array, by_point: Array) -> Array:
        """Covariance (6, 6) of the weighted sum of residuals that the deformation's own doubt makes.

        track: (N,) rows of the map. weighted: (N, 2, 6) Jacobians times weights. by_point: (N, 2, 3) px per mm.
        """
        if self._warp is None or self._modes is None:
            return np.zeros((6, 6))
        count = len(self._modes.share)
        moved = by_point @ self._modes.landmarks[track]  # (N, 2, M)
        sensitivity = np.einsum("nki,nkm->im", weighted, moved, optimize=True)
        return np.asarray(sensitivity @ self._covariance[:count, :count] @ sensitivity.T)

    def replace_map(self, surface_map: SurfaceMap, right: bool = False) -> None:
        """A refined or longer map: what it has taken in of the map's error, or of the deformation, is no error now.

        right: whether it is known to be that of the undeformed surface: then what the other was off by was no
        deformation.
        """
        if self._modes is not None:
            count, before = len(self._modes.share), len(self._points)
            change = self._modes.modes_of(surface_map.points[:before] - self._points)
            if right:
                self._map_told(change, _of_map(self._modes, surface_map))
            self._state[count:] -= change
            if len(surface_map) > before:
                self._modes = self._modes.extended(surface_map.points[before:])
        self._points = surface_map.points

    def _map_told(self, error: Array, doubt: Array) -> None:
        """The map's error was `error` (M,), and what is left of it is known to `doubt` (M, M).

        The sum of both vectors is what was seen, so the rest of it was deformation.
        """
        count = len(error)
        total, spread = self._state[:count] + self._state[count:], _sum(self._covariance, count)
        self._state = np.concatenate([total - error, error])
        self._covariance = np.block([[spread + doubt, -doubt], [-doubt, doubt]])

    def learn(self, observations: Observations, fit: PoseFit, sigma: Array, twist: Array, skew: float) -> None:
        """Take the residuals of a fit to `points`. sigma: (N,) px.

        twist: (6,) and skew: s, what the cameras' instants may differ by: as with the pose, no deformation is seen in
        what a late camera explains.
        """
        dt = 0.0 if self._stamp is None else observations.stamp - self._stamp
        self._stamp = observations.stamp
        if self._modes is None or dt <= 0:
            return
        information, gradient = _seen(self._modes, observations, fit, sigma, twist, skew, self._state)
        self._predict(dt, information, gradient)
        self._update(information, gradient)
        count = len(self._modes.share)
        if self.liveliness > 0 or self._warp is not None:
            self._warp = self._modes.warp(self._state[:count], self._covariance[:count, :count], self.liveliness)

    def _predict(self, dt: float, information: Array, gradient: Array) -> None:
        """Let the deformation wander for dt s, as lively as it is seen to."""
        assert self._modes is not None
        count, share = len(self._modes.share), self._modes.share
        keep = np.concatenate([np.full(count, np.exp(-dt / DECAY)), np.ones(count)])
        self._covariance = keep[:, None] * self._covariance * keep
        prior = _sum(self._covariance, count)
        told = share[:, None] * information
        looks = float(np.einsum("ij,ji->", told, told))
        expected = float(np.trace(told) + np.einsum("ij,ji->", told @ prior, information))
        recent = min(1.0, dt / MEMORY)
        if looks > 0:
            seen = (float(gradient @ (share * gradient)) - expected) / (looks * dt)
            self._seen += recent * (seen - self._seen)
            self._doubt = recent / (looks * dt**2)
            now = max(self._clear, self._liveliness * float(np.exp(-dt / DECAY)))
            self._liveliest = max(self._liveliest, now)
            self._liveliness = now if now > ASLEEP * self._liveliest else 0.0
        wander = self.liveliness * dt * share
        self._covariance[:count, :count] += np.diag(wander)
        self._state = keep * self._state

    def _update(self, information: Array, gradient: Array) -> None:
        """Take what the frame set says of the sum of both vectors: information (M, M) and gradient (M,) of the miss."""
        count = len(information)
        across = self._covariance[:, :count] + self._covariance[:, count:]  # (2M, M)
        gain = across @ np.linalg.inv(np.eye(count) + information @ _sum(self._covariance, count))
        self._state = self._state + gain @ gradient
        covariance = self._covariance - gain @ information @ across.T
        self._covariance = (covariance + covariance.T) / 2


def _of_map(modes: WarpModes, surface_map: SurfaceMap) -> Array:
    """Covariance (M, M), mm^2, of the modes in a map's error."""
    known = 3 * len(modes.weights)
    fields = (modes.landmarks * modes.weights[:, None, None]).reshape(known, -1)
    return np.asarray(
        fields.T @ surface_map.covariance[:known, :known] @ fields + MAP_SIGMA**2 * np.eye(len(modes.share))
    )


def _sum(covariance: Array, count: int) -> Array:
    """Covariance (M, M) of the sum of both vectors, from the joint one (2M, 2M)."""
    a, b = covariance[:count], covariance[count:]
    return np.asarray(a[:, :count] + a[:, count:] + b[:, :count] + b[:, count:])


def _seen(
    modes: WarpModes, observations: Observations, fit: PoseFit, sigma: Array, twist: Array, skew: float, state: Array
) -> tuple[Array, Array]:
    """Information (M, M) and gradient (M,) of both vectors' sum about the predicted one, pose and delays solved for."""
    count, cameras = len(modes.share), int(observations.camera.max()) + 1
    root = np.sqrt(fit.weights) / (sigma * fit.scale)
    row, camera = np.require(observations.track, np.int64, NEW), np.require(observations.camera, np.int64, NEW)
    seen = np.require(fit.jacobians, float, NEW), np.require(fit.residuals, float, NEW)
    # the fit's points hold the deformation, but not the map's error
    landmarks = np.require(modes.landmarks, float, NEW)
    whole = rows_of_modes(cameras, camera, row, *seen, root, landmarks, state[count:].copy(), twist)
    normal = whole.T @ whole
    own, other = slice(0, count), slice(count, count + 6 + cameras)
    held = normal[other, other] + np.diag([1e-9] * 6 + [1 / max(skew, 1e-4) ** 2] * cameras)
    solved = np.linalg.solve(held, np.concatenate([normal[other, own], normal[other, -1:]], 1))
    information = normal[own, own] - normal[own, other] @ solved[:, :-1]
    gradient = normal[own, -1] - normal[own, other] @ solved[:, -1]
    dull = np.linalg.inv(np.eye(count) + BIAS**2 * information)
    information = dull @ information
    return np.asarray((information + information.T) / 2), np.asarray(dull @ gradient)


def landmarks(surface_map: SurfaceMap, warp: WarpFilter | None) -> Array:
    """Points (N, 3), mm, of a map in the surface frame, as a warp has moved them; without one, as they were mapped."""
    return surface_map.points if warp is None else warp.points(surface_map)
