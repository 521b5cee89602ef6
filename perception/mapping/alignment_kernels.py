"""Compiled loops of patch alignment: interpolation of grey levels on a grid, Gauss-Newton on its shift, and a median.

Grey levels are interpolated in floating point: OpenCV's `remap` rounds positions to 1/32 px and values to whole grey
levels, which the sum over a patch does not average out. The loops release the interpreter's lock.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from estimation.runtime import compiled
from estimation.se3 import Array, Mask
from perception.frames import Image

Float32 = NDArray[np.float32]

PATCH_RADIUS = 7  # samples: 15 x 15 in all
PATCH_SIDE = 2 * PATCH_RADIUS + 1
PATCH_SAMPLES = PATCH_SIDE * PATCH_SIDE
CONVERGED_STEP = 0.03  # samples: a last step; the remaining error is a tenth of it
MAX_UNCHECKED_STEP = 0.3  # samples: the longest step that is taken without evaluation of its end
MAX_STEP = 3.0  # samples
MIN_VARIANCE = 1e-6  # grey levels squared: no contrast at all


@compiled("void(u1[:,::1], f8, f8, f8[:,::1], f8, f4[::1])")
def _sample_clamped(image: Image, x: float, y: float, per_sample: Array, scale: float, levels: Float32) -> None:
    """Grey levels (S,) of the grid about x, y px, bilinear; outside the image its border's."""
    right, low = image.shape[1] - 1, image.shape[0] - 1
    k = 0
    for row in range(-PATCH_RADIUS, PATCH_RADIUS + 1):
        for column in range(-PATCH_RADIUS, PATCH_RADIUS + 1):
            u = min(max(x + scale * (per_sample[0, 0] * column + per_sample[0, 1] * row), 0.0), float(right))
            v = min(max(y + scale * (per_sample[1, 0] * column + per_sample[1, 1] * row), 0.0), float(low))
            i, j = int(u), int(v)
            i1, j1 = min(i + 1, right), min(j + 1, low)
            above = image[j, i] + (u - i) * (float(image[j, i1]) - image[j, i])
            below = image[j1, i] + (u - i) * (float(image[j1, i1]) - image[j1, i])
            levels[k] = above + (v - j) * (below - above)
            k += 1


@compiled("b1(u1[:,::1], f8, f8, f8[:,::1], f8, f4[::1])")
def _sample_inside(image: Image, x: float, y: float, per_sample: Array, scale: float, levels: Float32) -> bool:
    """`_sample_clamped` at half the time where the whole grid is inside the image; whether it is.

    Single precision relative to a whole pixel, and unsigned indices, which numba need not check for a sign.
    """
    right, low = image.shape[1] - 1, image.shape[0] - 1
    across = PATCH_RADIUS * scale * (abs(per_sample[0, 0]) + abs(per_sample[0, 1]))
    along = PATCH_RADIUS * scale * (abs(per_sample[1, 0]) + abs(per_sample[1, 1]))
    if not (x - across >= 0 and x + across < right and y - along >= 0 and y + along < low):
        return False
    du, dv = np.float32(scale * per_sample[0, 0]), np.float32(scale * per_sample[1, 0])
    left, top = int(x - across), int(y - along)
    k = 0
    for row in range(-PATCH_RADIUS, PATCH_RADIUS + 1):
        u0 = np.float32(x - left + scale * (per_sample[0, 1] * row - PATCH_RADIUS * per_sample[0, 0]))
        v0 = np.float32(y - top + scale * (per_sample[1, 1] * row - PATCH_RADIUS * per_sample[1, 0]))
        for column in range(PATCH_SIDE):
            u, v = u0 + du * np.float32(column), v0 + dv * np.float32(column)
            i, j = np.int32(u), np.int32(v)
            a, b = u - np.float32(i), v - np.float32(j)
            m, n = np.uint64(top + j), np.uint64(left + i)
            above, below = np.float32(image[m, n]), np.float32(image[m + np.uint64(1), n])
            above += a * (np.float32(image[m, n + np.uint64(1)]) - above)
            below += a * (np.float32(image[m + np.uint64(1), n + np.uint64(1)]) - below)
            levels[k] = above + b * (below - above)
            k += 1
    return True


@compiled("f8[::1](f4[::1], f4[::1], f4[:,::1])", reordered=True)
def _sums(levels: Float32, picture: Float32, steepest: Float32) -> Array:
    """Sums over a patch of its grey levels, of their squares, and of them times picture (S,) and steepest (2, S).

    Levels count from the middle of their range, so that the sum of squares keeps its precision.
    """
    total, squares = np.float32(0), np.float32(0)
    alike, across, down = np.float32(0), np.float32(0), np.float32(0)
    for k in range(PATCH_SAMPLES):
        level = levels[k] - np.float32(128)
        total += level
        squares += level * level
        alike += level * picture[k]
        across += level * steepest[0, k]
        down += level * steepest[1, k]
    return np.array([total, squares, alike, across, down], np.float64)


@compiled("f4[:,::1](u1[:,::1], f8[:,::1], f8[:,:,::1], f8)")
def sample_grids(image: Image, centre: Array, per_sample: Array, scale: float) -> Float32:
    """Grey levels (N, S) of grids at centres (N, 2) px, per_sample (N, 2, 2) px a step, times `scale`."""
    levels: Float32 = np.empty((len(centre), PATCH_SAMPLES), np.float32)
    for n in range(len(centre)):
        if not _sample_inside(image, centre[n, 0], centre[n, 1], per_sample[n], scale, levels[n]):
            _sample_clamped(image, centre[n, 0], centre[n, 1], per_sample[n], scale, levels[n])
    return levels


@compiled(
    "f8[:,::1](u1[:,::1], f8[:,::1], f8[:,:,::1], b1[::1], f4[:,::1], f4[:,:,::1], f8[:,:,::1], f8[:,::1], f8, f8, i8)"
)
def descend(
    image: Image,
    start: Array,
    per_sample: Array,
    chosen: NDArray[np.bool_],
    picture: Float32,
    steepest: Float32,
    inverse_hessian: Array,
    shift: Array,
    scale: float,
    spacing: float,
    rounds: int,
) -> Array:
    """Gauss-Newton on the shifts (N, 2), samples, in place, of those chosen (N,).

    start: (N, 2) px of this image.
    per_sample: (N, 2, 2) px of the full image per sample. scale: of this image to the full one.
    spacing: samples between neighbours of the grid.

    The steepest descent pictures are invariant to brightness and contrast. Returns (N, 3): score and contrast, grey
    levels, at the last evaluation, and the length of the next step, samples, 0 if converged.
    """
    outcome = np.zeros((len(start), 3))
    levels: Float32 = np.empty(PATCH_SAMPLES, np.float32)
    for n in range(len(start)):
        if not chosen[n]:
            continue
        step = per_sample[n]
        for left in range(rounds - 1, -1, -1):
            x = start[n, 0] + scale * (step[0, 0] * shift[n, 0] + step[0, 1] * shift[n, 1])
            y = start[n, 1] + scale * (step[1, 0] * shift[n, 0] + step[1, 1] * shift[n, 1])
            if not _sample_inside(image, x, y, step, scale * spacing, levels):
                _sample_clamped(image, x, y, step, scale * spacing, levels)
            total, squares, alike, across, down = _sums(levels, picture[n], steepest[n])
            mean = total / PATCH_SAMPLES
            contrast = np.sqrt(max(squares / PATCH_SAMPLES - mean * mean, MIN_VARIANCE))
            outcome[n, 0], outcome[n, 1] = alike / (PATCH_SAMPLES * contrast), contrast
            dx = -(inverse_hessian[n, 0, 0] * across + inverse_hessian[n, 0, 1] * down) / contrast
            dy = -(inverse_hessian[n, 1, 0] * across + inverse_hessian[n, 1, 1] * down) / contrast
            length = np.sqrt(dx * dx + dy * dy)
            outcome[n, 2] = 0.0 if length < CONVERGED_STEP else length
            if left or spacing > 1 or length <= MAX_UNCHECKED_STEP:
                stride = spacing * min(1.0, MAX_STEP / max(length, 1e-9))
                shift[n, 0] += stride * dx
                shift[n, 1] += stride * dy
            if length < CONVERGED_STEP:
                break
    return outcome


@compiled("f8(f8[::1], b1[::1])")
def median_of(values: Array, chosen: Mask) -> float:
    """The upper median of the chosen (N,) values (N,), at least one, by Hoare's selection.

    numpy's sort and partition take seconds to compile.
    """
    selected, count = np.empty(len(values)), 0
    for i in range(len(values)):
        if chosen[i]:
            selected[count] = values[i]
            count += 1
    low, high, middle = 0, count - 1, count // 2
    while low < high:
        pivot, i, j = selected[middle], low, high
        while i <= j:
            while selected[i] < pivot:
                i += 1
            while pivot < selected[j]:
                j -= 1
            if i <= j:
                selected[i], selected[j] = selected[j], selected[i]
                i += 1
                j -= 1
        if j < middle:
            low = i
        if middle < i:
            high = j
    return float(selected[middle])
