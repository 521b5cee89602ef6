"""The pose of a known map in one frame set: robust multi-camera Gauss-Newton.

Residuals are pixels, the unknown is the right perturbation of base_from_surface. Weights are Geman-McClure's, which
redescend: on 30 % of tracks stuck to a static drape Huber stood at 0.107 mm, a redescending loss at 0.023.

What all tracks of a camera share does not average out over tracks: a camera exposed late, a lens or a grazing view that
shifts its whole image. `Shared` says how large that may be. It is solved for beside the pose (a linear mixed-effects
model; Henderson 1975), so that it is not taken for outliers and can be learned. The pose stays that of all cameras as
they are: which of them is late just now nobody knows, and weights by that model took poses farther from the reference
of the webcams' recordings.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estimation import se3
from estimation.rig import Rig
from estimation.runtime import NEW
from estimation.se3 import Array
from estimation.track_loops import gram_by_camera, project_tracks, shared_residuals, weights_of

Index = NDArray[np.int64]


@dataclass(frozen=True, slots=True, eq=False)
class Shared:
    """What all tracks of one camera may be off by together.

    twist: (6,) rad/s and mm/s, the surface's own: a delay shows along it. delay: (C, C) s^2, covariance of the cameras'
    delays; may be singular. shift: (C,) px^2, variance of an image's shift, per axis.
    """

    twist: Array
    delay: Array
    shift: Array

    def covariance(self) -> Array:
        """Of (delays (C,), shifts (C,) right, shifts (C,) down): (3C, 3C)."""
        n = len(self.shift)
        whole = np.zeros((3 * n, 3 * n))
        whole[:n, :n] = self.delay
        whole[np.arange(n, 3 * n), np.arange(n, 3 * n)] = np.tile(self.shift, 2)
        return whole


@dataclass(frozen=True, slots=True, eq=False)
class SharedFit:
    """What the tracks alone say of what their cameras share: information @ effect = pull, the pose allowed for.

    effect: (3C,) delays (C,) s and shifts (2C,) px: rights, then downs. information: (3C, 3C), pull: (3C,).
    """

    information: Array
    pull: Array


@dataclass(frozen=True, slots=True, eq=False)
class PoseFit:
    """A pose and how the tracks stand to it.

    base_from_surface: (4, 4). information: (6, 6) of its right perturbation. residuals: (N, 2) px, predicted minus
    seen, without what the camera's tracks share. weights: (N,) in [0, 1], one for a track that fits. jacobians:
    (N, 2, 6) px per rad and mm. scale: the residuals' robust size in sigmas. shared: where it was asked for.
    """

    base_from_surface: Array
    information: Array
    residuals: Array
    weights: Array
    jacobians: Array
    scale: float
    shared: SharedFit | None = None


def project(rig: Rig, camera: Index, base_from_surface: Array, points: Array) -> tuple[Array, Array, Array]:
    """Ideal pixels (N, 2), depths (N,) mm and Jacobians (N, 2, 6) of surface points (N, 3), each in its camera (N,).

    base_from_surface: (4, 4), or (C, 4, 4) where each camera exposes at its own instant.
    """
    points = np.require(points, float, NEW)
    return project_tracks(
        rig.camera_from_base @ base_from_surface, rig.matrices, np.require(camera, np.int64, NEW), points
    )


# What the weights, at a gate of 3, take from the information of Gaussian noise beyond what the estimate itself
# loses (Huber 1981, 4.6, integrated over two dimensions): the weights' mean is 0.72, the estimate is worth 0.89.
EFFICIENCY = 1.235
GATE = 3.0  # residual in sigmas at which a track's weight has fallen to a quarter
ARRIVED = 1e-3  # squared sigmas of the pose: a last step as small as that leaves a hundredth of a sigma to go


def solve_pose(
    rig: Rig,
    camera: Index,
    points: Array,
    pixels: Array,
    sigma: Array,
    start: Array,
    gate: float = GATE,
    scales: tuple[float, ...] = (1.0,),
    prior: Array | None = None,
    iterations: int = 8,
    tolerance: float = 1e-4,
    shared: Shared | None = None,
) -> PoseFit:
    """Fit base_from_surface to tracks.

    camera: (N,), points: (N, 3) mm in the surface frame, pixels: (N, 2) undistorted, sigma: (N,) px. gate: residual in
    sigmas at which a track's weight has fallen to a quarter. scales: widenings of the gate, solved one after the other
    from coarse to fine. The unit is also widened to the tracks' own median residual, so that tracks worse than they
    claim are averaged, not played off against each other. prior: (6, 6) information that holds `start`.
    iterations: at the last scale, three at those before. tolerance: rad and mm, the last step's largest entry. shared:
    what each camera's tracks may be off by together.
    """
    pose, unit, precision = start, 1.0, np.require(1 / sigma**2, float, NEW)
    camera, points = np.require(camera, np.int64, NEW), np.require(points, float, NEW)
    predicted, depth, jacobian = project(rig, camera, pose, points)
    residual = predicted - pixels
    common = None if shared is None else _Common(shared, camera)
    weight, moved = np.zeros(len(points)), np.zeros(6)
    information = np.zeros((6, 6))
    for widening in scales:
        for iteration in range(iterations if widening == scales[-1] else 3):
            anew = 0.0 if iteration < 3 else unit
            weight, unit = weights_of(residual, precision, depth, gate * widening, anew)
            if common is None:
                whole = gram_by_camera(len(rig), camera, jacobian, residual, weight * precision, np.zeros(6)).sum(0)
                information, gradient = whole[:6, :6], whole[:6, 9]
            else:
                trusted = weight * precision * (EFFICIENCY / unit**2)
                information, gradient = common.normal(jacobian, predicted - pixels, trusted)
            damped = information + np.diag(1e-9 + 1e-9 * np.diag(information))
            if prior is not None:
                damped = damped + prior
                gradient = gradient + prior @ moved
            step = -np.linalg.solve(damped, gradient)
            pose, moved = pose @ se3.exp(step), moved + step
            predicted, depth, jacobian = project(rig, camera, pose, points)
            residual = predicted - pixels
            if common is not None:
                residual = residual + common.explained(jacobian, anew=iteration < 2)
            if np.abs(step).max() < tolerance or -step @ gradient < ARRIVED:
                break
    if common is None:
        return PoseFit(pose, EFFICIENCY / unit**2 * information, residual, weight, jacobian, unit)
    return PoseFit(pose, information, residual, weight, jacobian, unit, common.found())


class _Common:
    """The normal equations of the pose, and of what each camera's tracks share."""

    def __init__(self, shared: Shared, camera: Index) -> None:
        self._twist, self._prior, self._count = shared.twist, shared.covariance(), len(shared.shift)
        self._camera = camera
        self._effect, self._eye = np.zeros((3, self._count)), np.eye(3 * self._count)

    def normal(self, jacobian: Array, residual: Array, weight: Array) -> tuple[Array, Array]:
        """Information (6, 6) and gradient (6,) of the pose. residual: (N, 2) px, whole. weight: (N,) px^-2."""
        n = self._count
        grams = gram_by_camera(n, self._camera, jacobian, residual, weight, self._twist)
        self._whole = grams[:, :6].sum(0)
        self._cross, self._right = grams[:, :6, 6:9].transpose(1, 2, 0).reshape(6, 3 * n), grams[:, 6:9, 9].T.ravel()
        self._own = np.zeros((3, n, 3, n))
        each = np.arange(n)
        self._own[:, each, :, each] = grams[:, 6:9, 6:9]
        self._found: SharedFit | None = None
        return self._whole[:, :6], self._whole[:, 9]

    def explained(self, jacobian: Array, anew: bool) -> Array:
        """What of the residuals (N, 2) px is shared, were the pose allowed to follow; anew: of the last `normal`."""
        if anew:
            found = self.found()
            # (information + prior^-1)^-1, also where the prior is singular
            gain = self._prior @ np.linalg.inv(self._eye + found.information @ self._prior)
            self._effect = (gain @ found.pull).reshape(3, -1)
        return shared_residuals(self._camera, jacobian, self._twist, self._effect)

    def found(self) -> SharedFit:
        """Of the last `normal` (Schur complement)."""
        if self._found is None:
            self._found = self._find()
        return self._found

    def _find(self) -> SharedFit:
        pose = self._whole[:, :6]
        information = pose + (1e-9 * np.trace(pose) + 1e-12) * np.eye(6)
        solved = np.linalg.solve(information, np.concatenate([self._cross, self._whole[:, 9:]], axis=1))
        own = self._own.reshape(self._cross.shape[1], -1) - self._cross.T @ solved[:, :-1]
        return SharedFit((own + own.T) / 2, -(self._right - self._cross.T @ solved[:, -1]))


def own_residuals(camera: Index, fit: PoseFit, sure: Array) -> Array:
    """Residuals (N, 2) px that are left when each camera may move for itself, to first order.

    sure: (N,) weights of the tracks that say how each camera moves. Cameras with fewer than eight keep theirs whole.
    """
    left = fit.residuals.copy()
    for c in np.unique(camera):
        mine = camera == c
        root = np.sqrt(np.repeat(sure[mine], 2))
        if np.count_nonzero(root) >= 16:
            jacobian, residual = fit.jacobians[mine].reshape(-1, 6), fit.residuals[mine].ravel()
            own = np.linalg.lstsq(jacobian * root[:, None], residual * root, rcond=None)[0]
            left[mine] = (residual - jacobian @ own).reshape(-1, 2)
    return left
