"""The loop over all observations of a recording: what each frame set's tracks say, in sums."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from estimation.runtime import compiled
from estimation.se3 import Array

COLUMNS = 11  # of an observation: six of its camera's own pose of the surface, fx fy cx cy, its residual


@compiled(
    "Tuple((f8[:,:,:,::1], f8[:,:,:,:,::1], f8[:,:,::1], f8[:,::1], f8))"
    "(i8[::1], i8[::1], i8[::1], f8[:,::1], f8[::1], f8[:,:,:,::1], f8[:,:,::1], f8[:,::1], f8[::1], f8[:,::1], b1)",
    reordered=True,
)
def frame_sums(
    starts: NDArray[np.int64],
    camera: NDArray[np.int64],
    landmark: NDArray[np.int64],
    pixels: Array,
    precision: Array,
    camera_from_surface: Array,
    matrices: Array,
    points: Array,
    gate: Array,
    moved: Array,
    coupled: bool,
) -> tuple[Array, Array, Array, Array, float]:
    """Sums of the normal equations of F frame sets, robustly weighted (Geman-McClure).

    starts: (F + 1,) into the rest, from 0. camera, landmark: (N,). pixels: (N, 2). precision: (N,) px^-2, of the
    estimate. camera_from_surface: (F, C, 4, 4) at each exposure. matrices: (C, 3, 3). points: (L, 3) mm. gate: (C,)
    squared length of a whitened residual at which a weight is a quarter. moved: (L, 3) mm, a step of the landmarks that
    the residuals are to hold. coupled: whether the products of landmarks with the rest are wanted.

    Returns products (F, C, 11, 11) of the columns; of landmarks with columns (F, L, 3, C, 10), empty where not
    coupled; information (L, 3, 3) and gradient (L, 3) of the landmarks; and the robust cost, half of squared sigmas.
    """
    frames, cameras, count = len(starts) - 1, matrices.shape[0], points.shape[0]
    grams = np.zeros((frames, cameras, COLUMNS, COLUMNS))
    cross = np.zeros((frames if coupled else 0, count, 3, cameras, COLUMNS - 1))
    information, gradient = np.zeros((count, 3, 3)), np.zeros((count, 3))
    row, cost = np.zeros(COLUMNS), 0.0
    rows = np.zeros((2, COLUMNS))
    for f in range(frames):
        for i in range(starts[f], starts[f + 1]):
            c, n = camera[i], landmark[i]
            pose, lens = camera_from_surface[f, c], matrices[c]
            px, py, pz = points[n, 0], points[n, 1], points[n, 2]
            depth = pose[2, 0] * px + pose[2, 1] * py + pose[2, 2] * pz + pose[2, 3]
            if not depth > 1e-6:
                continue
            inverse, square = 1.0 / depth, 0.0
            for k in range(2):
                focal = lens[k, k]
                tangent = (pose[k, 0] * px + pose[k, 1] * py + pose[k, 2] * pz + pose[k, 3]) * inverse
                scale = focal * inverse
                x = (pose[k, 0] - tangent * pose[2, 0]) * scale
                y = (pose[k, 1] - tangent * pose[2, 1]) * scale
                z = (pose[k, 2] - tangent * pose[2, 2]) * scale
                off = focal * tangent + lens[k, 2] - pixels[i, k]
                square += off * off
                rows[k, 0], rows[k, 1], rows[k, 2] = py * z - pz * y, pz * x - px * z, px * y - py * x
                rows[k, 3], rows[k, 4], rows[k, 5] = x, y, z
                for a in range(6, 10):
                    rows[k, a] = 0.0
                rows[k, 6 + k], rows[k, 8 + k] = tangent, 1.0
                rows[k, 10] = off + x * moved[n, 0] + y * moved[n, 1] + z * moved[n, 2]
            beside = 1.0 + precision[i] * square / gate[c]
            cost += 0.5 * precision[i] * square / beside
            weight = precision[i] / (beside * beside)
            gram = grams[f, c]
            for k in range(2):
                for a in range(COLUMNS):
                    row[a] = rows[k, a]
                for a in range(COLUMNS):
                    scaled = weight * row[a]
                    for b in range(a, COLUMNS):
                        gram[a, b] += scaled * row[b]
                for a in range(3):
                    scaled = weight * row[3 + a]
                    gradient[n, a] += scaled * row[10]
                    for b in range(3):
                        information[n, a, b] += scaled * row[3 + b]
                    if coupled:
                        for b in range(COLUMNS - 1):
                            cross[f, n, a, c, b] += scaled * row[b]
        for c in range(cameras):
            for a in range(COLUMNS):
                for b in range(a):
                    grams[f, c, a, b] = grams[f, c, b, a]
    return grams, cross, information, gradient, cost


@compiled(
    "f8[::1](i8[::1], i8[::1], i8[::1], f8[:,::1], f8[::1], f8[:,:,:,::1], f8[:,:,::1], f8[:,::1])", reordered=True
)
def squares(
    starts: NDArray[np.int64],
    camera: NDArray[np.int64],
    landmark: NDArray[np.int64],
    pixels: Array,
    precision: Array,
    camera_from_surface: Array,
    matrices: Array,
    points: Array,
) -> Array:
    """Squared whitened residuals (N,); inf behind a camera. Arguments as `frame_sums` takes them."""
    out = np.empty(len(camera))
    for f in range(len(starts) - 1):
        for i in range(starts[f], starts[f + 1]):
            pose, lens, n = camera_from_surface[f, camera[i]], matrices[camera[i]], landmark[i]
            px, py, pz = points[n, 0], points[n, 1], points[n, 2]
            depth = pose[2, 0] * px + pose[2, 1] * py + pose[2, 2] * pz + pose[2, 3]
            square = 0.0
            for k in range(2):
                along = pose[k, 0] * px + pose[k, 1] * py + pose[k, 2] * pz + pose[k, 3]
                off = lens[k, k] * along / depth + lens[k, 2] - pixels[i, k]
                square += off * off
            out[i] = square * precision[i] if depth > 1e-6 else np.inf
    return out
