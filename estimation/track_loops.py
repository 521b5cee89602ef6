"""Projection, and the sums of the normal equations: the two loops over tracks that every fit runs several times."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from estimation.compiled import compiled
from estimation.se3 import Array

COLUMNS = 10  # of a track's row: six of the pose, its camera's delay and two shifts, its residual


@compiled("Tuple((f8[:,::1], f8[::1], f8[:,:,::1]))(f8[:,:,::1], f8[:,:,::1], i8[::1], f8[:,::1])")
def project_tracks(
    camera_from_surface: Array, matrices: Array, camera: NDArray[np.int64], points: Array
) -> tuple[Array, Array, Array]:
    """Ideal pixels (N, 2), depths (N,) mm and Jacobians (N, 2, 6) by the right perturbation of the pose.

    camera_from_surface: (C, 4, 4). matrices: (C, 3, 3). camera: (N,). points: (N, 3) mm, surface frame.
    """
    count = len(points)
    pixels, depths, jacobians = np.empty((count, 2)), np.empty(count), np.empty((count, 2, 6))
    for i in range(count):
        pose, lens = camera_from_surface[camera[i]], matrices[camera[i]]
        px, py, pz = points[i, 0], points[i, 1], points[i, 2]
        depth = pose[2, 0] * px + pose[2, 1] * py + pose[2, 2] * pz + pose[2, 3]
        inverse = 1.0 / depth if abs(depth) >= 1e-6 else 1e6
        for k in range(2):
            focal = lens[k, k]
            tangent = (pose[k, 0] * px + pose[k, 1] * py + pose[k, 2] * pz + pose[k, 3]) * inverse
            pixels[i, k] = focal * tangent + lens[k, 2]
            scale = focal * inverse
            x = (pose[k, 0] - tangent * pose[2, 0]) * scale
            y = (pose[k, 1] - tangent * pose[2, 1]) * scale
            z = (pose[k, 2] - tangent * pose[2, 2]) * scale
            jacobians[i, k, 0] = py * z - pz * y  # row @ -hat(p) = cross(p, row)
            jacobians[i, k, 1] = pz * x - px * z
            jacobians[i, k, 2] = px * y - py * x
            jacobians[i, k, 3] = x
            jacobians[i, k, 4] = y
            jacobians[i, k, 5] = z
        depths[i] = depth
    return pixels, depths, jacobians


@compiled("f8[:,:,::1](i8, i8[::1], f8[:,:,::1], f8[:,::1], f8[::1], f8[::1])")
def gram_by_camera(
    cameras: int, camera: NDArray[np.int64], jacobian: Array, residual: Array, weight: Array, twist: Array
) -> Array:
    """Weighted products (C, 10, 10) of the columns of each camera's tracks: pose, own delay, own two shifts, residual.

    camera: (N,). jacobian: (N, 2, 6). residual: (N, 2) px. weight: (N,) px^-2. twist: (6,), along which a delay shows.
    """
    grams = np.zeros((cameras, COLUMNS, COLUMNS))
    row = np.empty(COLUMNS)
    for i in range(len(camera)):
        gram = grams[camera[i]]
        for k in range(2):
            along = 0.0
            for a in range(6):
                row[a] = jacobian[i, k, a]
                along += row[a] * twist[a]
            row[6], row[7], row[8], row[9] = along, 1.0 - k, float(k), residual[i, k]
            for a in range(COLUMNS):
                scaled = weight[i] * row[a]
                for b in range(a, COLUMNS):
                    gram[a, b] += scaled * row[b]
    for c in range(cameras):
        for a in range(COLUMNS):
            for b in range(a):
                grams[c, a, b] = grams[c, b, a]
    return grams


@compiled("f8[:,::1](i8[::1], f8[:,:,::1], f8[::1], f8[:,::1])")
def shared_residuals(camera: NDArray[np.int64], jacobian: Array, twist: Array, effect: Array) -> Array:
    """What of the residuals (N, 2) px the cameras' delays and shifts, effect (3, C), make."""
    explained = np.empty((len(camera), 2))
    for i in range(len(camera)):
        c = camera[i]
        for k in range(2):
            along = 0.0
            for a in range(6):
                along += jacobian[i, k, a] * twist[a]
            explained[i, k] = effect[0, c] * along + effect[1 + k, c]
    return explained


@compiled("Tuple((f8[:,:,::1], f8[:,:,::1]))(i8, i8, i8[::1], i8[::1], f8[:,:,::1], f8[::1], f8[::1])")
def pulls(
    cameras: int,
    landmarks: int,
    camera: NDArray[np.int64],
    landmark: NDArray[np.int64],
    jacobian: Array,
    weight: Array,
    twist: Array,
) -> tuple[Array, Array]:
    """How each landmark (6, L, 3), px^-2 per mm, and each camera's delay and shifts (6, 3, C) pull at the pose.

    The pose gives way by its covariance times that. landmark: (N,) below L. The rest as in `gram_by_camera`.
    """
    by_landmark, by_camera = np.zeros((6, landmarks, 3)), np.zeros((6, 3, cameras))
    for i in range(len(camera)):
        for k in range(2):
            row, along = jacobian[i, k], 0.0
            for a in range(6):
                along += row[a] * twist[a]
            for a in range(6):
                weighted = weight[i] * row[a]
                by_camera[a, 0, camera[i]] += weighted * along
                by_camera[a, 1 + k, camera[i]] += weighted
                for b in range(3):
                    by_landmark[a, landmark[i], b] += weighted * row[3 + b]
    return by_landmark, by_camera
