"""The tracks' part of the normal equations, a stretch of frame sets at a time: each frame set condensed to its state.

What a frame set's tracks say of its pose, of the landmarks and of the cameras is summed over the tracks by the compiled
loop, in the columns of each camera's own pose of the surface. All else is linear in those: a late camera sees the pose
carried on along twist and acceleration, a camera's place moves the surface the other way.

What all tracks of one camera share in one frame set and in no other, a jitter of its exposure and a shift of its image,
is eliminated on the spot (Henderson 1975, as in `estimation/pose_solver.py`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estimation import se3
from estimation.batch.normal_equations import frame_sums, squares
from estimation.batch.priors import STATE, States, right_jacobian
from estimation.online.pose_solver import EFFICIENCY, GATE
from estimation.se3 import Array
from estimation.smoothing.cameras import Cameras
from estimation.smoothing.packed import Packed

TOGETHER = 1e-4  # s: as the sum of a frame set's delays is held at nothing


@dataclass(frozen=True, slots=True, eq=False)
class Noise:
    """How the tracks err. unit: (C,) residuals in parts of what is claimed. jitter: s, unrest: px, as in CameraErrors,
    standard deviations of what is shared and new in each frame set. gate: times the usual gate. slope: of the weighted
    residuals over what their weights say, where a step is sought: a redescending loss is flatter than its weights.
    """

    unit: Array
    jitter: float
    unrest: float
    gate: float = 1.0
    slope: float = 1.0

    def own_information(self) -> Array:
        """(3C,) of each frame set's own delays and shifts."""
        n = len(self.unit)
        return np.repeat([self.jitter**-2.0, self.unrest**-2.0], [n, 2 * n])


@dataclass(frozen=True, slots=True, eq=False)
class Condensed:
    """F frame sets' normal equations, with S shared unknowns: free corrections of the cameras, then landmarks.

    information: (F, 18, 18) of the states. gradient: (F, 18). cross: (F, 18, S) of states and shared. own: (3C F, S)
    square roots of what elimination takes from the shared ones'. shared: (S, S) and pull: (S,), theirs. effects:
    (F, 3C), what each camera's tracks share, doubts: (F, 3C), its variance were the state known, follows: (F, 3C, 18),
    how it goes with the state. cost: robust.
    """

    information: Array
    gradient: Array
    cross: Array
    own: Array
    shared: Array
    pull: Array
    effects: Array
    doubts: Array
    follows: Array
    cost: float


@dataclass(frozen=True, slots=True, eq=False)
class Problem:
    """What is measured, and which of the cameras' corrections (11 C,) are free, by number."""

    data: Packed
    free: NDArray[np.int64]

    @property
    def landmarks(self) -> int:
        """L."""
        return len(self.data.tracks)

    @property
    def size(self) -> int:
        """S."""
        return len(self.free) + 3 * self.landmarks


def exposed(states: States, cameras: Cameras) -> tuple[Array, Array]:
    """How far (F, C, 6) the surface moves until each camera exposes; camera_from_surface (F, C, 4, 4) then."""
    late = cameras.offsets[:, None]
    ahead = late * states.twists[:, None] + late**2 / 2 * states.accelerations[:, None]
    there = states.poses[:, None] @ se3.exp(ahead)
    return ahead, np.ascontiguousarray(se3.inverse(cameras.base_from_camera) @ there)


def whitened_squares(data: Packed, states: States, cameras: Cameras, points: Array, first: int, last: int) -> Array:
    """Squared residuals (N,) of frame sets first <= k < last in parts of their variance."""
    part = data.between(first, last)
    starts = data.starts[first : last + 1] - data.starts[first]
    part_of = States(*(a[first:last] for a in (states.poses, states.twists, states.accelerations)))
    return squares(
        starts,
        data.camera[part],
        data.landmark[part],
        data.pixels[part],
        data.precision[part],
        exposed(part_of, cameras)[1],
        cameras.matrices,
        points,
    )


def condensed(
    problem: Problem,
    first: int,
    last: int,
    states: States,
    cameras: Cameras,
    points: Array,
    noise: Noise,
    step: Array | None = None,
) -> Condensed:
    """Frame sets first <= k < last. states: all K. points: (L, 3).

    step: (S,) of the shared unknowns, where that is known; then the gradient holds it, and nothing is said of `cross`,
    `own` and `shared`.
    """
    summed = _summed(problem, first, last, states, cameras, points, noise, step)
    return _eliminated(summed, noise, len(cameras), step is None)


@dataclass(frozen=True, slots=True, eq=False)
class _Summed:
    """F frame sets' normal equations, nothing eliminated, in M columns: state, each camera's own, free corrections.

    whole: (F, M, M), right: (F, M). by_landmark: (F, 3L, M), without rows where the step is known. known: (L, 3, 3) and
    pull: (L, 3), the landmarks'. seeing: (F, C), whether a camera has tracks. cost: robust.
    """

    whole: Array
    right: Array
    by_landmark: Array
    known: Array
    pull: Array
    seeing: NDArray[np.bool_]
    cost: float


def _summed(
    problem: Problem,
    first: int,
    last: int,
    states: States,
    cameras: Cameras,
    points: Array,
    noise: Noise,
    step: Array | None,
) -> _Summed:
    """As in `condensed`."""
    data, n, free = problem.data, len(cameras), problem.free
    part = data.between(first, last)
    mine = States(*(a[first:last] for a in (states.poses, states.twists, states.accelerations)))
    ahead, camera_from_surface = exposed(mine, cameras)
    camera = data.camera[part]
    worth = EFFICIENCY / noise.unit**2
    moved = np.zeros_like(points) if step is None else step[len(free) :].reshape(-1, 3)
    grams, products, known, pull, cost = frame_sums(
        data.starts[first : last + 1] - data.starts[first],
        camera,
        data.landmark[part],
        data.pixels[part],
        data.precision[part] * worth[camera],
        camera_from_surface,
        cameras.matrices,
        points,
        np.full(n, (GATE * noise.gate) ** 2 * EFFICIENCY),
        np.ascontiguousarray(noise.slope * moved),
        step is None,
    )
    for sums in (grams[..., :10, :10], products, known):
        sums *= noise.slope
    columns = _columns(mine, cameras, ahead, camera_from_surface, free)  # (F, C, 10, 18 + 3C + Q)
    if step is not None:
        off = columns[..., STATE + 3 * n :] @ step[: len(free)]
        grams[..., :10, 10] += (grams[..., :10, :10] @ off[..., None])[..., 0]
    frames, width = len(mine), columns.shape[-1]
    tall = columns.reshape(frames, 10 * n, width)
    weighted = (grams[..., :10, :10] @ columns).reshape(frames, 10 * n, width)
    whole = np.swapaxes(tall, 1, 2) @ weighted  # (F, M, M)
    right = (np.swapaxes(tall, 1, 2) @ np.ascontiguousarray(grams[..., :10, 10]).reshape(frames, -1, 1))[..., 0]
    empty = np.zeros((frames, 0, width))
    by_landmark = products.reshape(frames, -1, 10 * n) @ tall if step is None else empty
    return _Summed(whole, right, by_landmark, known, pull, grams[..., 8, 8] > 0, cost)


def _eliminated(summed: _Summed, noise: Noise, n: int, coupled: bool) -> Condensed:
    """What is left when each of the n cameras' own unknowns are eliminated. coupled: whether `shared` is wanted."""
    whole, right, by_landmark = summed.whole, summed.right, summed.by_landmark
    frames, width = right.shape
    state, own, rest = slice(0, STATE), slice(STATE, STATE + 3 * n), slice(STATE + 3 * n, width)
    cross = np.concatenate([whole[:, state, rest], np.swapaxes(by_landmark[..., state], 1, 2)], axis=2)
    own_cross = np.concatenate([whole[:, own, rest], np.swapaxes(by_landmark[..., own], 1, 2)], axis=2)
    root = np.linalg.inv(np.linalg.cholesky(whole[:, own, own] + _own_prior(noise, summed.seeing)))
    by_state, by_shared, by_right = root @ whole[:, own, state], root @ own_cross, root @ right[:, own, None]
    turned = np.swapaxes(by_state, 1, 2)
    held = np.swapaxes(root, 1, 2)
    size = by_shared.shape[2]
    shared = np.zeros((size, size))
    gradient = np.concatenate([right[:, rest].sum(0), summed.pull.ravel()[: by_landmark.shape[1]]])
    if coupled:
        shared = _shared(whole[:, rest, rest].sum(0), by_landmark[..., rest].sum(0), summed.known)
    return Condensed(
        whole[:, state, state] - turned @ by_state,
        (right[:, state, None] - turned @ by_right)[..., 0],
        cross - turned @ by_shared,
        by_shared.reshape(3 * n * frames, size),
        shared,
        gradient - (np.swapaxes(by_shared, 1, 2) @ by_right)[..., 0].sum(0),
        -(held @ by_right)[..., 0],
        (root**2).sum(1),
        -(held @ by_state),
        summed.cost,
    )


def _columns(
    states: States, cameras: Cameras, ahead: Array, camera_from_surface: Array, free: NDArray[np.int64]
) -> Array:
    """How the ten columns of each camera's sums (F, C, 10, M) move with state, own delay and shifts, corrections."""
    frames, n = len(states), len(cameras)
    late = cameras.offsets[:, None, None]
    carried = right_jacobian(ahead)
    speed = states.twists[:, None] + cameras.offsets[:, None] * states.accelerations[:, None]
    along = (carried @ speed[..., None])[..., 0]  # (F, C, 6)
    each, lens = np.arange(n), np.arange(4)
    out = np.zeros((frames, n, 10, STATE + 3 * n + 11 * n))
    out[:, :, :6, :6] = se3.adjoint(se3.exp(-ahead))
    out[:, :, :6, 6:12], out[:, :, :6, 12:18] = late * carried, late**2 / 2 * carried
    out[:, each, :6, STATE + each] = along.swapaxes(0, 1)
    out[:, each, 8, STATE + n + each] = out[:, each, 9, STATE + 2 * n + each] = 1.0
    begin = STATE + 3 * n
    out[:, each, :6, begin + each] = along.swapaxes(0, 1)
    place = -se3.adjoint(se3.inverse(camera_from_surface))
    for c in range(n):
        out[:, c, :6, begin + n + 6 * c : begin + n + 6 * c + 6] = place[:, c]
        out[:, c, 6 + lens, begin + 7 * n + 4 * c + lens] = 1.0
    return np.ascontiguousarray(out[..., np.concatenate([np.arange(begin), begin + free])])


def _own_prior(noise: Noise, seeing: NDArray[np.bool_]) -> Array:
    """Information (F, 3C, 3C) of what each camera's tracks share. seeing: (F, C).

    The instant of a frame set is the mean of its cameras': what their delays have in common nobody could tell from the
    motion, and a prior that smoothed it away took poses of a waved board farther off.
    """
    frames, n = seeing.shape
    out = np.tile(np.diag(noise.own_information()), (frames, 1, 1))
    both = seeing[:, :, None] & seeing[:, None]
    out[:, :n, :n] += np.where(both, TOGETHER**-2.0, 0.0)
    return out


def _shared(corrections: Array, by_landmark: Array, known: Array) -> Array:
    """(S, S) information of the shared unknowns by their own tracks."""
    q, count = len(corrections), len(known)
    out = np.zeros((q + 3 * count, q + 3 * count))
    out[:q, :q], out[q:, :q], out[:q, q:] = corrections, by_landmark, by_landmark.T
    blocks = out[q:, q:].reshape(count, 3, count, 3)
    blocks[np.arange(count), :, np.arange(count)] += known
    return out
