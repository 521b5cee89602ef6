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
from estimation.median import median
from estimation.rig import Rig
from estimation.se3 import Array

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
    """Ideal pixels (N, 2), depths (N,) mm and Jacobians (N, 2, 6) of surface points (N, 3), each in its camera (N,)."""
    extrinsics = rig.camera_from_base @ base_from_surface  # (C, 4, 4) camera_from_surface
    count, place = len(points), np.ascontiguousarray(points.T)
    # tracks last: rows of N numbers are what numpy is quick at
    parts = extrinsics[:, :3].reshape(-1, 12).T.take(camera, axis=1).reshape(3, 4, count)
    lens = rig.matrices[:, :2].reshape(-1, 6).T.take(camera, axis=1).reshape(2, 3, count)
    rotation, focal, centre = parts[:, :3], lens[[0, 1], [0, 1]], lens[:, 2]
    x, y, depth = np.einsum("ijn,jn->in", rotation, place) + parts[:, 3]
    inverse_depth = 1.0 / np.where(np.abs(depth) < 1e-6, 1e-6, depth)
    tangent = np.stack([x, y]) * inverse_depth
    by_point = (rotation[:2] - tangent[:, None] * rotation[2]) * (focal * inverse_depth)[:, None]  # (2, 3, N)
    jacobian = np.empty((2, 6, count))
    jacobian[:, 3:] = by_point
    for i, (j, k) in enumerate(((1, 2), (2, 0), (0, 1))):  # row @ -hat(p) = cross(p, row)
        jacobian[:, i] = place[j] * by_point[:, k] - place[k] * by_point[:, j]
    pixels = focal * tangent + centre
    return np.ascontiguousarray(pixels.T), depth, np.ascontiguousarray(jacobian.transpose(2, 0, 1))


# What the weights, at a gate of 3, take from the information of Gaussian noise beyond what the estimate itself
# loses (Huber 1981, 4.6, integrated over two dimensions): the weights' mean is 0.72, the estimate is worth 0.89.
EFFICIENCY = 1.235
ARRIVED = 1e-4  # squared sigmas of the pose: a step as small as that changes nothing that is known


def solve_pose(
    rig: Rig,
    camera: Index,
    points: Array,
    pixels: Array,
    sigma: Array,
    start: Array,
    gate: float = 3.0,
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
    pose, unit, precision = start, 1.0, 1 / sigma**2
    predicted, depth, jacobian = project(rig, camera, pose, points)
    residual = predicted - pixels
    common = None if shared is None else _Common(shared, camera)
    weight, moved = np.zeros(len(points)), np.zeros(6)
    information = np.zeros((6, 6))
    for widening in scales:
        for iteration in range(iterations if widening == scales[-1] else 3):
            squared = (residual * residual).sum(1) * precision
            front = depth > 0
            if iteration < 3:
                unit = float(np.sqrt(max(median(squared[front]) / 1.386, 1.0))) if front.any() else 1.0
            weight = np.where(front, (1 + squared / (gate * unit * widening) ** 2) ** -2, 0.0)
            if common is None:
                weighted = (jacobian * (weight * precision)[:, None, None]).reshape(-1, 6)
                information = weighted.T @ jacobian.reshape(-1, 6)
                gradient = weighted.T @ residual.ravel()
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
        present = np.unique(camera)
        if (camera[1:] >= camera[:-1]).all():  # as the matcher gives them: no copies
            bounds = np.searchsorted(camera, [present, present + 1])
            self._mine: list[tuple[int, slice | Index]] = [
                (int(c), slice(a, b)) for c, a, b in zip(present, *bounds, strict=True)
            ]
        else:
            self._mine = [(int(c), np.nonzero(camera == c)[0]) for c in present]
        self._columns = np.zeros((len(camera), 2, 10))  # derivatives by pose, own delay and own shift; residual
        self._columns[:, 0, 7] = self._columns[:, 1, 8] = 1.0
        self._effect, self._eye = np.zeros(3 * self._count), np.eye(3 * self._count)

    def _of(self, camera: int) -> list[int]:
        """Where a camera's own delay and shifts stand among all."""
        return [camera, self._count + camera, 2 * self._count + camera]

    def normal(self, jacobian: Array, residual: Array, weight: Array) -> tuple[Array, Array]:
        """Information (6, 6) and gradient (6,) of the pose. residual: (N, 2) px, whole. weight: (N,) px^-2."""
        n, columns = 3 * self._count, self._columns
        columns[:, :, :6], columns[:, :, 6], columns[:, :, 9] = jacobian, jacobian @ self._twist, residual
        weighted = columns[:, :, :9] * weight[:, None, None]
        whole, cross, own, right = np.zeros((6, 7)), np.zeros((6, n)), np.zeros((n, n)), np.zeros(n)
        for c, mine in self._mine:
            gram = weighted[mine].reshape(-1, 9).T @ columns[mine].reshape(-1, 10)
            whole[:, :6] += gram[:6, :6]
            whole[:, 6] += gram[:6, 9]
            for row, place in enumerate(self._of(c), 6):
                cross[:, place], right[place] = gram[:6, row], gram[row, 9]
                own[place, self._of(c)] = gram[row, 6:9]
        self._whole, self._cross, self._own, self._right = whole, cross, own, right
        return whole[:, :6], whole[:, 6]

    def explained(self, jacobian: Array, anew: bool) -> Array:
        """What of the residuals (N, 2) px is shared, were the pose allowed to follow; anew: of the last `normal`."""
        if anew:
            found = self.found()
            # (information + prior^-1)^-1, also where the prior is singular
            gain = self._prior @ np.linalg.inv(self._eye + found.information @ self._prior)
            self._effect = gain @ found.pull
        delay, right, down = self._effect.reshape(3, -1)
        return np.asarray(
            delay[self._camera, None] * (jacobian @ self._twist) + np.stack([right, down], -1)[self._camera]
        )

    def found(self) -> SharedFit:
        """Of the last `normal` (Schur complement)."""
        information = self._whole[:, :6] + (1e-9 * np.trace(self._whole[:, :6]) + 1e-12) * np.eye(6)
        solved = np.linalg.solve(information, np.c_[self._cross, self._whole[:, 6]])
        own, right = self._own - self._cross.T @ solved[:, :-1], -(self._right - self._cross.T @ solved[:, -1])
        return SharedFit((own + own.T) / 2, right)


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
