"""The tracks' part of the normal equations, a stretch of frame sets at a time: each frame set condensed to its state.

A compiled loop sums what a frame set's tracks say of its pose, the landmarks and the cameras, in the columns of each
camera's own pose of the surface. All else is linear in those: a late camera sees the pose carried on along twist and
acceleration; a camera's place moves the surface the other way. Errors that all tracks of one camera share in one frame
set alone (jitter of its exposure, shift of its image) are eliminated at once (Henderson 1975, as in
`estimation/pose_solver.py`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from estimation import se3
from estimation.batch.initialisation import TrackArrays
from estimation.batch.smoothed import STATE_DOF, CorrectedCameras, States
from estimation.pose_solver import EFFICIENCY, GATE
from estimation.runtime import compiled
from estimation.se3 import Array, Index, Mask

# starts (F + 1,) of F frame sets' rows, from 0; then camera (N,), landmark (N,), pixels (N, 2), precision (N,) px^-2
TrackRows = tuple[Index, Index, Index, Array, Array]
TRACK_ROWS_TYPE = "Tuple((i8[::1], i8[::1], i8[::1], f8[:,::1], f8[::1]))"

OBSERVATION_COLUMNS = 11  # of an observation: six of its camera's own pose of the surface, fx fy cx cy, its residual
COMMON_DELAY_SIGMA_S = 1e-4  # s: as the sum of a frame set's delays is held at nothing


@compiled(
    "Tuple((f8[:,:,:,::1], f8[:,:,:,:,::1], f8[:,:,::1], f8[:,::1], f8))"
    f"({TRACK_ROWS_TYPE}, f8[:,:,:,::1], f8[:,:,::1], f8[:,::1], f8[::1], f8[:,::1], b1)",
    reordered=True,
)
def frame_sums(
    tracks: TrackRows,
    camera_from_surface: Array,
    matrices: Array,
    points: Array,
    gate: Array,
    moved: Array,
    coupled: bool,
) -> tuple[Array, Array, Array, Array, float]:
    """Sums of the normal equations of F frame sets, robustly weighted (Geman-McClure).

    tracks: with the precision of the estimate. camera_from_surface: (F, C, 4, 4) at each exposure. matrices: (C, 3, 3).
    points: (L, 3) mm. gate: (C,) squared length of a whitened residual at which a weight is a quarter. moved: (L, 3)
    mm, a step of the landmarks that the residuals are to hold. coupled: whether to give the products of landmarks with
    the rest.

    Returns products (F, C, 11, 11) of the columns; of landmarks with columns (F, L, 3, C, 10), empty where not
    coupled; information (L, 3, 3) and gradient (L, 3) of the landmarks; and the robust cost, half of squared sigmas.
    """
    starts, camera, landmark, pixels, precision = tracks
    frames, cameras, count = len(starts) - 1, matrices.shape[0], points.shape[0]
    grams = np.zeros((frames, cameras, OBSERVATION_COLUMNS, OBSERVATION_COLUMNS))
    cross = np.zeros((frames if coupled else 0, count, 3, cameras, OBSERVATION_COLUMNS - 1))
    information, gradient = np.zeros((count, 3, 3)), np.zeros((count, 3))
    row, cost = np.zeros(OBSERVATION_COLUMNS), 0.0
    rows = np.zeros((2, OBSERVATION_COLUMNS))
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
                for a in range(OBSERVATION_COLUMNS):
                    row[a] = rows[k, a]
                for a in range(OBSERVATION_COLUMNS):
                    scaled = weight * row[a]
                    for b in range(a, OBSERVATION_COLUMNS):
                        gram[a, b] += scaled * row[b]
                for a in range(3):
                    scaled = weight * row[3 + a]
                    gradient[n, a] += scaled * row[10]
                    for b in range(3):
                        information[n, a, b] += scaled * row[3 + b]
                    if coupled:
                        for b in range(OBSERVATION_COLUMNS - 1):
                            cross[f, n, a, c, b] += scaled * row[b]
        for c in range(cameras):
            for a in range(OBSERVATION_COLUMNS):
                for b in range(a):
                    grams[f, c, a, b] = grams[f, c, b, a]
    return grams, cross, information, gradient, cost


@compiled(f"f8[::1]({TRACK_ROWS_TYPE}, f8[:,:,:,::1], f8[:,:,::1], f8[:,::1])", reordered=True)
def squared_residuals(tracks: TrackRows, camera_from_surface: Array, matrices: Array, points: Array) -> Array:
    """Squared whitened residuals (N,); inf behind a camera. Arguments as `frame_sums` takes them."""
    starts, camera, landmark, pixels, precision = tracks
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


@dataclass(frozen=True, slots=True, eq=False)
class NoiseModel:
    """How the tracks err."""

    unit: Array  # (C,) size of the residuals in parts of what is claimed of them
    jitter: float  # s, standard deviation of a camera's delay in one frame set, as in CameraErrors
    unrest: float  # px, standard deviation of an image's shift in one frame set
    gate: float = 1.0  # times the usual gate
    slope: float = 1.0  # of the weighted residuals over their weights, for a step: a redescending loss is flatter

    def own_information(self) -> Array:
        """(3C,) of each frame set's own delays and shifts."""
        n = len(self.unit)
        return np.repeat([self.jitter**-2.0, self.unrest**-2.0], [n, 2 * n])


@dataclass(frozen=True, slots=True, eq=False)
class Estimate:
    """All unknowns."""

    states: States  # K
    cameras: CorrectedCameras  # C
    points: Array  # (L, 3) mm, landmarks in the surface frame

    def moved(self, steps: Array, shared: Array, free: Index) -> Estimate:
        """The same after steps of the states (K, 18) and of the shared unknowns (S,), the `free` cameras' first."""
        corrections = np.zeros(11 * len(self.cameras))
        corrections[free] = shared[: len(free)]
        points = self.points + shared[len(free) :].reshape(-1, 3)
        return Estimate(self.states.moved(steps), self.cameras.moved(corrections), points)


@dataclass(frozen=True, slots=True, eq=False)
class CondensedFrames:
    """F frame sets' normal equations, with S shared unknowns: free corrections of the cameras, then landmarks."""

    information: Array  # (F, 18, 18) of the states
    gradient: Array  # (F, 18)
    cross: Array  # (F, 18, S) of states and shared
    own: Array  # (3C F, S) square roots of what elimination takes from the shared ones' information
    shared: Array  # (S, S) information of the shared unknowns
    pull: Array  # (S,) their gradient
    effects: Array  # (F, 3C) what each camera's tracks share: delays, shifts right, shifts down
    doubts: Array  # (F, 3C) variance of that, were the state known
    follows: Array  # (F, 3C, 18) how it goes with the state
    cost: float  # robust, half of squared sigmas


@dataclass(frozen=True, slots=True, eq=False)
class BatchProblem:
    """What is measured, and what is free."""

    data: TrackArrays
    free: Index  # numbers of the cameras' corrections (11 C,) that are free

    @property
    def landmarks(self) -> int:
        """L."""
        return len(self.data.tracks)

    @property
    def size(self) -> int:
        """S."""
        return len(self.free) + 3 * self.landmarks


def exposed_poses(states: States, cameras: CorrectedCameras) -> tuple[Array, Array]:
    """How far (F, C, 6) the surface moves until each camera exposes; camera_from_surface (F, C, 4, 4) then."""
    late = cameras.offsets[:, None]
    ahead = late * states.twists[:, None] + late**2 / 2 * states.accelerations[:, None]
    there = states.poses[:, None] @ se3.exp(ahead)
    return ahead, np.ascontiguousarray(se3.inverse(cameras.base_from_camera) @ there)


def whitened_squares(data: TrackArrays, estimate: Estimate) -> Array:
    """Squared residuals (N,) of all frame sets in parts of their variance."""
    poses = exposed_poses(estimate.states, estimate.cameras)[1]
    tracks = data.starts, data.camera, data.landmark, data.pixels, data.precision
    return squared_residuals(tracks, poses, estimate.cameras.matrices, estimate.points)


def condense(
    problem: BatchProblem, first: int, last: int, estimate: Estimate, noise: NoiseModel, step: Array | None = None
) -> CondensedFrames:
    """Frame sets first <= k < last.

    step: (S,) of the shared unknowns, where that is known; then the gradient holds it, and `cross`, `own` and `shared`
    are without meaning.
    """
    summed = _sum_frames(problem, first, last, estimate, noise, step)
    return _eliminate_shared(summed, noise, len(estimate.cameras), step is None)


@dataclass(frozen=True, slots=True, eq=False)
class _FrameSums:
    """F frame sets' normal equations before any elimination, in M columns: state, cameras' own, free corrections."""

    whole: Array  # (F, M, M)
    right: Array  # (F, M)
    by_landmark: Array  # (F, 3L, M), without rows where the step is known
    known: Array  # (L, 3, 3) information of the landmarks
    pull: Array  # (L, 3) their gradient
    seeing: Mask  # (F, C) whether a camera has tracks
    cost: float  # robust


def _sum_frames(
    problem: BatchProblem, first: int, last: int, estimate: Estimate, noise: NoiseModel, step: Array | None
) -> _FrameSums:
    data, cameras, free = problem.data, estimate.cameras, problem.free
    n, part = len(cameras), data.rows(first, last)
    mine = estimate.states[first:last]
    # sums over the tracks, in the columns of each camera's own pose
    ahead, camera_from_surface = exposed_poses(mine, cameras)
    camera = data.camera[part]
    worth = EFFICIENCY / noise.unit**2
    moved = np.zeros_like(estimate.points) if step is None else step[len(free) :].reshape(-1, 3)
    starts, precision = data.starts[first : last + 1] - data.starts[first], data.precision[part] * worth[camera]
    grams, products, known, pull, cost = frame_sums(
        (starts, camera, data.landmark[part], data.pixels[part], precision),
        camera_from_surface,
        cameras.matrices,
        estimate.points,
        np.full(n, (GATE * noise.gate) ** 2 * EFFICIENCY),
        np.ascontiguousarray(noise.slope * moved),
        step is None,
    )
    for sums in (grams[..., :10, :10], products, known):
        sums *= noise.slope
    # chain rule: those columns by state, each camera's own errors and free corrections
    columns = _columns(mine, cameras, ahead, camera_from_surface, free)  # (F, C, 10, 18 + 3C + Q)
    if step is not None:
        off = columns[..., STATE_DOF + 3 * n :] @ step[: len(free)]
        grams[..., :10, 10] += (grams[..., :10, :10] @ off[..., None])[..., 0]
    frames, width = len(mine), columns.shape[-1]
    tall = columns.reshape(frames, 10 * n, width)
    weighted = (grams[..., :10, :10] @ columns).reshape(frames, 10 * n, width)
    whole = np.swapaxes(tall, 1, 2) @ weighted  # (F, M, M)
    right = (np.swapaxes(tall, 1, 2) @ np.ascontiguousarray(grams[..., :10, 10]).reshape(frames, -1, 1))[..., 0]
    empty = np.zeros((frames, 0, width))
    by_landmark = products.reshape(frames, -1, 10 * n) @ tall if step is None else empty
    return _FrameSums(whole, right, by_landmark, known, pull, grams[..., 8, 8] > 0, cost)


def _eliminate_shared(summed: _FrameSums, noise: NoiseModel, n: int, coupled: bool) -> CondensedFrames:
    """Eliminate each of the n cameras' own errors (Schur complement). coupled: whether `shared` is wanted."""
    whole, right, by_landmark = summed.whole, summed.right, summed.by_landmark
    frames, width = right.shape
    state, own, rest = slice(0, STATE_DOF), slice(STATE_DOF, STATE_DOF + 3 * n), slice(STATE_DOF + 3 * n, width)
    cross = np.concatenate([whole[:, state, rest], np.swapaxes(by_landmark[..., state], 1, 2)], axis=2)
    own_cross = np.concatenate([whole[:, own, rest], np.swapaxes(by_landmark[..., own], 1, 2)], axis=2)
    root = np.linalg.inv(np.linalg.cholesky(whole[:, own, own] + _own_prior(noise, summed.seeing)))
    by_state, by_shared, by_right = root @ whole[:, own, state], root @ own_cross, root @ right[:, own, None]
    turned, held = np.swapaxes(by_state, 1, 2), np.swapaxes(root, 1, 2)
    shared = np.zeros((by_shared.shape[2],) * 2)
    gradient = np.concatenate([right[:, rest].sum(0), summed.pull.ravel()[: by_landmark.shape[1]]])
    if coupled:
        shared = _shared(whole[:, rest, rest].sum(0), by_landmark[..., rest].sum(0), summed.known)
    return CondensedFrames(
        information=whole[:, state, state] - turned @ by_state,
        gradient=(right[:, state, None] - turned @ by_right)[..., 0],
        cross=cross - turned @ by_shared,
        own=by_shared.reshape(3 * n * frames, len(shared)),
        shared=shared,
        pull=gradient - (np.swapaxes(by_shared, 1, 2) @ by_right)[..., 0].sum(0),
        effects=-(held @ by_right)[..., 0],
        doubts=(root**2).sum(1),
        follows=-(held @ by_state),
        cost=summed.cost,
    )


def _columns(states: States, cameras: CorrectedCameras, ahead: Array, camera_from_surface: Array, free: Index) -> Array:
    """How the ten columns of each camera's sums (F, C, 10, M) move with state, own delay and shifts, corrections."""
    frames, n = len(states), len(cameras)
    late = cameras.offsets[:, None, None]
    carried = se3.right_jacobian(ahead)
    speed = states.twists[:, None] + cameras.offsets[:, None] * states.accelerations[:, None]
    along = (carried @ speed[..., None])[..., 0]  # (F, C, 6)
    each, lens = np.arange(n), np.arange(4)
    out = np.zeros((frames, n, 10, STATE_DOF + 3 * n + 11 * n))
    out[:, :, :6, :6] = se3.adjoint(se3.exp(-ahead))
    out[:, :, :6, 6:12], out[:, :, :6, 12:18] = late * carried, late**2 / 2 * carried
    out[:, each, :6, STATE_DOF + each] = along.swapaxes(0, 1)
    out[:, each, 8, STATE_DOF + n + each] = out[:, each, 9, STATE_DOF + 2 * n + each] = 1.0
    begin = STATE_DOF + 3 * n
    out[:, each, :6, begin + each] = along.swapaxes(0, 1)
    place = -se3.adjoint(se3.inverse(camera_from_surface))
    for c in range(n):
        out[:, c, :6, begin + n + 6 * c : begin + n + 6 * c + 6] = place[:, c]
        out[:, c, 6 + lens, begin + 7 * n + 4 * c + lens] = 1.0
    return np.ascontiguousarray(out[..., np.concatenate([np.arange(begin), begin + free])])


def _own_prior(noise: NoiseModel, seeing: Mask) -> Array:
    """Information (F, 3C, 3C) of what each camera's tracks share. seeing: (F, C).

    The instant of a frame set is the mean of its cameras': what their delays have in common nobody could tell from the
    motion, and a prior that smoothed it away took poses of a waved board farther off.
    """
    frames, n = seeing.shape
    out = np.tile(np.diag(noise.own_information()), (frames, 1, 1))
    both = seeing[:, :, None] & seeing[:, None]
    out[:, :n, :n] += np.where(both, COMMON_DELAY_SIGMA_S**-2.0, 0.0)
    return out


def _shared(corrections: Array, by_landmark: Array, known: Array) -> Array:
    """(S, S) information of the shared unknowns by their own tracks."""
    q, count = len(corrections), len(known)
    out = np.zeros((q + 3 * count, q + 3 * count))
    out[:q, :q], out[q:, :q], out[:q, q:] = corrections, by_landmark, by_landmark.T
    blocks = out[q:, q:].reshape(count, 3, count, 3)
    blocks[np.arange(count), :, np.arange(count)] += known
    return out
