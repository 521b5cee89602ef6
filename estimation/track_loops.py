"""Projection, and the sums of the normal equations: the two loops over tracks that every fit runs several times."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from estimation.runtime import compiled
from estimation.se3 import Array

MEDIAN = 1.386  # of the squared length of two normal entries, in their variance
SLIGHT = 1e-3  # mm^-2: what is known of a displacement along a line that all cameras look along
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


@compiled("Tuple((f8[::1], f8))(f8[:,::1], f8[::1], f8[::1], f8, f8)")
def weights_of(residual: Array, precision: Array, depth: Array, gate: float, unit: float) -> tuple[Array, float]:
    """Geman-McClure's weights (N,), zero behind the camera, and the unit of residuals, in sigmas, that they hold for.

    residual: (N, 2) px. precision: (N,) px^-2. depth: (N,) mm. gate: units at which a weight is a quarter. unit: 0
    where it is to be found: by the median residual of what is in front, one at least.
    """
    squared = np.empty(len(depth))
    front = 0
    for i in range(len(depth)):
        squared[i] = (residual[i, 0] * residual[i, 0] + residual[i, 1] * residual[i, 1]) * precision[i]
        front += depth[i] > 0
    if unit == 0.0:
        unit = 1.0
        if front > 0:
            middle = np.sort(squared[depth > 0])[front // 2] / MEDIAN
            unit = np.sqrt(max(middle, 1.0))
    weight = np.zeros(len(depth))
    for i in range(len(depth)):
        if depth[i] > 0:
            beside = 1.0 + squared[i] / (gate * unit) ** 2
            weight[i] = 1.0 / (beside * beside)
    return weight, unit


@compiled("f8[:,::1](i8, i8[::1], i8[::1], f8[:,:,::1], f8[:,::1], f8[::1], f8[:,:,::1], f8[::1], f8[::1])")
def rows_of_modes(
    cameras: int,
    camera: NDArray[np.int64],
    landmark: NDArray[np.int64],
    jacobian: Array,
    residual: Array,
    root: Array,
    modes: Array,
    error: Array,
    twist: Array,
) -> Array:
    """Rows (2N, M + 6 + C + 1) of the regression on modes, pose and delays, each times its track's `root` (N,), px^-1.

    modes: (L, 3, M) mm of each landmark, rows `landmark` (N,). error: (M,), modes that the residuals (N, 2) px hold and
    the points do not. The last column is what is left. The rest as in `gram_by_camera`.
    """
    count = modes.shape[2]
    rows = np.zeros((2 * len(camera), count + 7 + cameras))
    for i in range(len(camera)):
        own = modes[landmark[i]]
        for k in range(2):
            row, along, left = rows[2 * i + k], 0.0, -residual[i, k]
            for m in range(count):
                moved = 0.0
                for a in range(3):
                    moved += jacobian[i, k, 3 + a] * own[a, m]
                row[m] = root[i] * moved
                left -= moved * error[m]
            for a in range(6):
                row[count + a] = root[i] * jacobian[i, k, a]
                along += jacobian[i, k, a] * twist[a]
            row[count + 6 + camera[i]] = root[i] * along
            row[count + 6 + cameras] = root[i] * left
    return rows


@compiled("Tuple((f8[:,:,::1], f8[:,::1], f8[::1], i8[::1]))(i8, i8[::1], f8[:,:,::1], f8[:,::1], f8[::1])")
def displacement_sums(
    landmarks: int, landmark: NDArray[np.int64], jacobian: Array, residual: Array, precision: Array
) -> tuple[Array, Array, Array, NDArray[np.int64]]:
    """Normal equations (L, 3, 3) and (L, 3) of each landmark's own displacement in the surface frame, mm.

    Then the weighted square (L,) of its residuals (N, 2) px, predicted minus seen, and how many cameras see it (L,).
    landmark: (N,) below L. precision: (N,) px^-2, 0 for tracks that do not count.
    """
    normal, right = np.zeros((landmarks, 3, 3)), np.zeros((landmarks, 3))
    square, views = np.zeros(landmarks), np.zeros(landmarks, np.int64)
    for i in range(len(landmark)):
        own, weight = landmark[i], precision[i]
        views[own] += weight > 0
        for k in range(2):
            left = -residual[i, k]
            square[own] += weight * left * left
            for a in range(3):
                scaled = weight * jacobian[i, k, 3 + a]
                right[own, a] += scaled * left
                for b in range(3):
                    normal[own, a, b] += scaled * jacobian[i, k, 3 + b]
    return normal, right, square, views


@compiled("f8[:,::1](f8[:,:,::1], f8[:,::1])")
def solutions(normal: Array, right: Array) -> Array:
    """Solutions (N, 3) of positive definite normal equations (N, 3, 3) and (N, 3): Cramer's rule."""
    out = np.empty_like(right)
    for i in range(len(right)):
        m, r = normal[i], right[i]
        p, q, s = m[1, 1] * m[2, 2] - m[1, 2] ** 2, m[0, 2] * m[1, 2] - m[0, 1] * m[2, 2], m[0, 1] * m[1, 2]
        s -= m[0, 2] * m[1, 1]
        t, u, v = m[0, 0] * m[2, 2] - m[0, 2] ** 2, m[0, 1] * m[0, 2] - m[0, 0] * m[1, 2], m[0, 0] * m[1, 1]
        v -= m[0, 1] ** 2
        whole = m[0, 0] * p + m[0, 1] * q + m[0, 2] * s
        out[i, 0] = (p * r[0] + q * r[1] + s * r[2]) / whole
        out[i, 1] = (q * r[0] + t * r[1] + u * r[2]) / whole
        out[i, 2] = (s * r[0] + u * r[1] + v * r[2]) / whole
    return out


@compiled("Tuple((f8[:,::1], f8[::1], f8[::1]))(f8[:,:,::1], f8[:,::1], f8[::1], f8[:,:,::1], f8[:,::1])")
def unusual(
    normal: Array, right: Array, square: Array, usual_normal: Array, usual_right: Array
) -> tuple[Array, Array, Array]:
    """What landmarks' displacements are beside their usual ones, all from `displacement_sums`; usual_normal: definite.

    The right sides (L, 3) without what is usual, the square (L,) of the residuals about that, and how much of it (L,)
    a displacement explains.
    """
    usual = solutions(usual_normal, usual_right)
    plain, about = right.copy(), square.copy()
    for i in range(len(right)):
        for a in range(3):
            for b in range(3):
                plain[i, a] -= normal[i, a, b] * usual[i, b]
            about[i] -= (right[i, a] + plain[i, a]) * usual[i, a]
    ridged = normal.copy()
    for a in range(3):
        ridged[:, a, a] += SLIGHT
    moved = solutions(ridged, plain)
    return plain, about, (moved * plain).sum(1)
