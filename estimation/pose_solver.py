"""The pose of a known map in one frame set: robust multi-camera Gauss-Newton on reprojection errors.

The unknown is the right perturbation of base_from_surface. Weights are Geman-McClure's, which redescend: with 30 % of
the tracks stuck to a static drape, the error was 0.107 mm with Huber's loss and 0.023 mm with a redescending one.

All tracks of a camera share some errors, which do not average out: the delay of its exposure and the shift of its
image. `SharedErrors` holds their expected size. They are estimated beside the pose (linear mixed-effects model;
Henderson 1975), so that they are not mistaken for outliers and can be learned. They do not change the weights between
cameras: that moved poses farther from the reference of the webcams' recordings.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from estimation import se3
from estimation.observations import Observations
from estimation.rig import Rig
from estimation.runtime import compiled, contiguous
from estimation.se3 import Array, Index, Mask

TRACK_COLUMNS = 10  # of a track's row: six of the pose, its camera's delay and two shifts, its residual
CHI2_MEDIAN = 1.386  # of the squared length of two normal entries, in their variance
GATE = 3.0  # residual in sigmas at which a track's weight has fallen to a quarter
# Factor on the weighted information for Gaussian noise at that gate: the weights' mean is 0.72, the estimate's
# efficiency 0.89 (Huber 1981, 4.6, integrated over two dimensions)
EFFICIENCY = 1.235
INLIER_WEIGHT = 0.2  # least weight of an inlier
CONVERGED_CHI2 = 1e-3  # squared sigmas of the pose: after a last step that small a hundredth of a sigma remains


@dataclass(frozen=True, slots=True, eq=False)
class PointTracks:
    """Points of the surface and their pixels: N parallel rows."""

    camera: Index  # (N,) number in the rig
    points: Array  # (N, 3) mm, surface frame
    pixels: Array  # (N, 2) undistorted px
    sigma: Array  # (N,) px, one standard deviation per axis

    @staticmethod
    def from_observations(observations: Observations, points: Array) -> PointTracks:
        """Tracks of observations with their points (N, 3) mm, surface frame."""
        return PointTracks(observations.camera, points, observations.pixels, observations.sigma)

    def select(self, rows: Mask) -> PointTracks:
        """The tracks of some rows, a mask (N,)."""
        return PointTracks(self.camera[rows], self.points[rows], self.pixels[rows], self.sigma[rows])


@dataclass(frozen=True, slots=True, eq=False)
class SharedErrors:
    """Prior covariance of the errors that all tracks of one camera share in one frame set."""

    twist: Array  # (6,) rad/s and mm/s of the surface, along which a delay moves the image
    delay: Array  # (C, C) s^2, covariance of the cameras' delays; may be singular
    shift: Array  # (C,) px^2, variance of an image's shift, per axis

    def covariance(self) -> Array:
        """Of (delays (C,), shifts (C,) right, shifts (C,) down): (3C, 3C)."""
        count = len(self.shift)
        covariance = np.zeros((3 * count, 3 * count))
        covariance[:count, :count] = self.delay
        covariance[np.arange(count, 3 * count), np.arange(count, 3 * count)] = np.tile(self.shift, 2)
        return covariance


@dataclass(frozen=True, slots=True, eq=False)
class SharedFit:
    """Normal equations of the shared errors, the pose marginalised: information @ errors = pull."""

    information: Array  # (3C, 3C) of the errors: delays (C,) s, shifts right (C,) px, shifts down (C,) px
    pull: Array  # (3C,)


@dataclass(frozen=True, slots=True, eq=False)
class PoseFit:
    """A pose fitted to N tracks."""

    base_from_surface: Array  # (4, 4)
    information: Array  # (6, 6) of its right perturbation
    residuals: Array  # (N, 2) px, predicted minus observed, without the shared errors
    weights: Array  # (N,) in [0, 1], 1 without residual
    jacobians: Array  # (N, 2, 6) px per rad and mm
    scale: float  # robust size of the residuals, in sigmas
    shared: SharedFit | None = None  # only of a fit with shared errors


def project(rig: Rig, camera: Index, base_from_surface: Array, points: Array) -> tuple[Array, Array, Array]:
    """Ideal pixels (N, 2), depths (N,) mm and Jacobians (N, 2, 6) of surface points (N, 3), each in its camera (N,).

    base_from_surface: (4, 4), or (C, 4, 4) where each camera exposes at its own instant.
    """
    camera, points = contiguous(camera, np.int64), contiguous(points)
    return project_tracks(rig.camera_from_base @ base_from_surface, rig.matrices, camera, points)


def solve_pose(
    rig: Rig,
    tracks: PointTracks,
    start: Array,
    *,
    scales: tuple[float, ...] = (1.0,),
    prior: Array | None = None,
    iterations: int = 8,
    tolerance: float = 1e-4,
    shared: SharedErrors | None = None,
) -> PoseFit:
    """Fit base_from_surface to tracks, from `start` (4, 4), by iteratively reweighted Gauss-Newton steps.

    Residuals are scaled by their median, at least 1 sigma, so that tracks with too small sigmas are averaged too.

    scales: factors of GATE, from coarse to fine.
    prior: (6, 6) information about `start`.
    iterations: at the last scale; three at those before.
    tolerance: rad and mm, largest entry of the last step.
    shared: expected size of the errors that all tracks of a camera share.
    """
    count, none = len(rig), np.zeros((6, 6))
    twist, effects = (none[0], np.zeros((3 * count,) * 2)) if shared is None else (shared.twist, shared.covariance())
    observed = contiguous(tracks.camera, np.int64), contiguous(tracks.points), contiguous(tracks.pixels)
    data = rig.camera_from_base, rig.matrices, *observed, contiguous(1 / tracks.sigma**2), contiguous(start)
    settings = np.array(scales, float), iterations, tolerance, none if prior is None else contiguous(prior)
    fitted = _gauss_newton(*data, *settings, shared is not None, contiguous(twist), effects)
    pose, information, residuals, weights, jacobians, scale, grams = fitted
    if shared is None:
        return PoseFit(pose, EFFICIENCY / scale**2 * information, residuals, weights, jacobians, scale)
    shared_information, right_side = _shared_equations(grams)
    shared_fit = SharedFit(shared_information, right_side.ravel())
    return PoseFit(pose, information, residuals, weights, jacobians, scale, shared_fit)


exp_entries = compiled("UniTuple(f8, 12)(f8, f8, f8, f8, f8, f8)")(se3.exp_entries)


@compiled("f8[:,::1](f8[:,::1], f8[:,::1])")
def solve_small(matrix: Array, right: Array) -> Array:
    """matrix^-1 @ right, (N, N) and (N, K) with few rows: Gauss elimination with pivots; not finite if singular."""
    left, out, count = matrix.copy(), right.copy(), len(matrix)
    for k in range(count):
        pivot = k
        for i in range(k + 1, count):
            if abs(left[i, k]) > abs(left[pivot, k]):
                pivot = i
        if pivot != k:
            for j in range(k, count):
                left[k, j], left[pivot, j] = left[pivot, j], left[k, j]
            for j in range(out.shape[1]):
                out[k, j], out[pivot, j] = out[pivot, j], out[k, j]
        for i in range(k + 1, count):
            share = left[i, k] / left[k, k]
            for j in range(k + 1, count):
                left[i, j] -= share * left[k, j]
            for j in range(out.shape[1]):
                out[i, j] -= share * out[k, j]
    for k in range(count - 1, -1, -1):
        for j in range(out.shape[1]):
            for i in range(k + 1, count):
                out[k, j] -= left[k, i] * out[i, j]
            out[k, j] /= left[k, k]
    return out


@compiled("f8[:,::1](f8[:,::1], f8[:,::1])")
def product(a: Array, b: Array) -> Array:
    """a @ b with few rows and columns, without a call of BLAS."""
    out = np.zeros((a.shape[0], b.shape[1]))
    for i in range(a.shape[0]):
        for k in range(a.shape[1]):
            for j in range(b.shape[1]):
                out[i, j] += a[i, k] * b[k, j]
    return out


@compiled("f8[:,::1](f8[:,::1], f8[:,::1])")
def _retract(pose: Array, step: Array) -> Array:
    """pose (4, 4) @ exp(-step), of (6, 1)."""
    exponential = np.zeros((4, 4))
    entries = exp_entries(-step[0, 0], -step[1, 0], -step[2, 0], -step[3, 0], -step[4, 0], -step[5, 0])
    for i in range(12):
        exponential[i // 4, i % 4] = entries[i]
    exponential[3, 3] = 1.0
    return product(pose, exponential)


@compiled("Tuple((f8[:,::1], f8[:,::1]))(f8[:,:,::1])")
def _shared_equations(grams: Array) -> tuple[Array, Array]:
    """`SharedFit`'s equations, (3C, 3C) and (3C, 1), from `camera_grams`: the pose's Schur complement."""
    n = len(grams)
    pose, right_side, cross = np.zeros((6, 6)), np.zeros((3 * n, 1)), np.zeros((6, 3 * n + 1))
    information = np.zeros((3 * n, 3 * n))
    for c in range(n):
        for a in range(6):
            cross[a, 3 * n] += grams[c, a, 9]
            for b in range(6):
                pose[a, b] += grams[c, a, b]
            for k in range(3):
                cross[a, k * n + c] = grams[c, a, 6 + k]
        for k in range(3):
            right_side[k * n + c, 0] = grams[c, 6 + k, 9]
            for m in range(3):
                information[k * n + c, m * n + c] = grams[c, 6 + k, 6 + m]
    damping = 1e-12
    for a in range(6):
        damping += 1e-9 * pose[a, a]
    for a in range(6):
        pose[a, a] += damping
    eliminated = product(cross.T.copy(), solve_small(pose, cross))
    schur = np.empty((3 * n, 3 * n))
    for i in range(3 * n):
        right_side[i, 0] = eliminated[i, 3 * n] - right_side[i, 0]
        for j in range(3 * n):
            schur[i, j] = (information[i, j] - eliminated[i, j] + information[j, i] - eliminated[j, i]) / 2
    return schur, right_side


@compiled("Tuple((f8[:,::1], f8[::1], f8[:,:,::1]))(f8[:,:,::1], f8[:,:,::1], i8[::1], f8[:,::1])")
def project_tracks(
    camera_from_surface: Array, matrices: Array, camera: Index, points: Array
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
def camera_grams(cameras: int, camera: Index, jacobian: Array, residual: Array, weight: Array, twist: Array) -> Array:
    """Weighted products (C, 10, 10) of the columns of each camera's tracks: pose, own delay, own two shifts, residual.

    camera: (N,). jacobian: (N, 2, 6). residual: (N, 2) px. weight: (N,) px^-2. twist: (6,), along which a delay shows.
    """
    grams = np.zeros((cameras, TRACK_COLUMNS, TRACK_COLUMNS))
    row = np.empty(TRACK_COLUMNS)
    for i in range(len(camera)):
        gram = grams[camera[i]]
        for k in range(2):
            along = 0.0
            for a in range(6):
                row[a] = jacobian[i, k, a]
                along += row[a] * twist[a]
            row[6], row[7], row[8], row[9] = along, 1.0 - k, float(k), residual[i, k]
            for a in range(TRACK_COLUMNS):
                scaled = weight[i] * row[a]
                for b in range(a, TRACK_COLUMNS):
                    gram[a, b] += scaled * row[b]
    for c in range(cameras):
        for a in range(TRACK_COLUMNS):
            for b in range(a):
                grams[c, a, b] = grams[c, b, a]
    return grams


@compiled("f8[:,::1](i8[::1], f8[:,:,::1], f8[::1], f8[:,::1], f8[:,::1])")
def shared_residuals(camera: Index, jacobian: Array, twist: Array, effect: Array, pose_residual: Array) -> Array:
    """Residuals (N, 2) px with the cameras' delays and shifts, effect (3, C), added to those of the pose."""
    residual = np.empty((len(camera), 2))
    for i in range(len(camera)):
        c = camera[i]
        for k in range(2):
            along = 0.0
            for a in range(6):
                along += jacobian[i, k, a] * twist[a]
            residual[i, k] = pose_residual[i, k] + (effect[0, c] * along + effect[1 + k, c])
    return residual


@compiled("Tuple((f8[::1], f8))(f8[:,::1], f8[::1], f8[::1], f8, f8)")
def robust_weights(residual: Array, precision: Array, depth: Array, gate: float, scale: float) -> tuple[Array, float]:
    """Geman-McClure's weights (N,), zero behind the camera, and the scale of the residuals, in sigmas.

    residual: (N, 2) px. precision: (N,) px^-2. depth: (N,) mm. gate: scales at which a weight is a quarter. scale: 0
    to estimate it, by the median residual in front of the cameras, at least 1.
    """
    squared = np.empty(len(depth))
    in_front = 0
    for i in range(len(depth)):
        squared[i] = (residual[i, 0] * residual[i, 0] + residual[i, 1] * residual[i, 1]) * precision[i]
        in_front += depth[i] > 0
    if scale == 0.0:
        scale = 1.0
        if in_front > 0:
            median = np.sort(squared[depth > 0])[in_front // 2] / CHI2_MEDIAN
            scale = np.sqrt(max(median, 1.0))
    weight = np.zeros(len(depth))
    for i in range(len(depth)):
        if depth[i] > 0:
            decay = 1.0 + squared[i] / (gate * scale) ** 2
            weight[i] = 1.0 / (decay * decay)
    return weight, scale


@compiled(
    "Tuple((f8[::1], f8[:,:,::1], f8[:,::1]))(f8[:,:,::1], f8[:,:,::1], i8[::1], f8[:,::1], f8[:,::1], f8[:,::1])"
)
def _reproject(
    camera_from_base: Array, matrices: Array, camera: Index, points: Array, pixels: Array, pose: Array
) -> tuple[Array, Array, Array]:
    """Depths (N,) mm, Jacobians (N, 2, 6) and residuals (N, 2) px, predicted minus observed, at a pose (4, 4)."""
    from_surface = product(camera_from_base.reshape(-1, 4), pose).reshape(-1, 4, 4)
    residual, depth, jacobian = project_tracks(from_surface, matrices, camera, points)
    for i in range(len(residual)):
        residual[i, 0] -= pixels[i, 0]
        residual[i, 1] -= pixels[i, 1]
    return depth, jacobian, residual


@compiled("f8[:,::1](f8[:,::1], f8[:,::1], f8[:,::1])")
def _expected_effects(information: Array, right_side: Array, effects: Array) -> Array:
    """Posterior mean (3, C) of the shared errors by their equations (3C, 3C), (3C, 1) and prior covariance (3C, 3C)."""
    system = product(information, effects)
    for a in range(len(information)):
        system[a, a] += 1.0
    return product(effects, solve_small(system, right_side)).reshape(3, len(information) // 3)


@compiled(
    "Tuple((f8[:,::1], f8[:,::1], f8[:,::1], f8[::1], f8[:,:,::1], f8, f8[:,:,::1]))"
    "(f8[:,:,::1], f8[:,:,::1], i8[::1], f8[:,::1], f8[:,::1], f8[::1], f8[:,::1], f8[::1], i8, f8, f8[:,::1], b1,"
    " f8[::1], f8[:,::1])"
)
def _gauss_newton(
    camera_from_base: Array,
    matrices: Array,
    camera: Index,
    points: Array,
    pixels: Array,
    precision: Array,
    start: Array,
    scales: Array,
    iterations: int,
    tolerance: float,
    prior: Array,
    shared: bool,
    twist: Array,
    effects: Array,
) -> tuple[Array, Array, Array, Array, Array, float, Array]:
    """The loop of `solve_pose`, for a `PoseFit`'s parts and grams; effects: (3C, 3C) prior of the shared errors."""
    count, pose, residual_scale, total_step = len(matrices), start, 1.0, np.zeros((6, 1))
    weight, track_information, information = np.zeros(len(points)), np.zeros(len(points)), np.zeros((6, 6))
    grams, effect = np.zeros((count, TRACK_COLUMNS, TRACK_COLUMNS)), np.zeros((3, count))
    depth, jacobian, pose_residual = _reproject(camera_from_base, matrices, camera, points, pixels, pose)
    residual = pose_residual
    for gate_factor in scales:
        for iteration in range(iterations if gate_factor == scales[-1] else 3):
            known_scale = 0.0 if iteration < 3 else residual_scale  # 0: estimated anew
            weight, residual_scale = robust_weights(residual, precision, depth, GATE * gate_factor, known_scale)
            # normal equations (information, gradient), damped
            efficiency = EFFICIENCY / residual_scale**2 if shared else 1.0
            for i in range(len(weight)):
                track_information[i] = weight[i] * precision[i] * efficiency
            grams = camera_grams(count, camera, jacobian, pose_residual, track_information, twist)
            information, damped, gradient = np.zeros((6, 6)), prior.copy(), product(prior, total_step)
            for a in range(6):
                for c in range(count):
                    gradient[a, 0] += grams[c, a, 9]
                    for b in range(6):
                        information[a, b] += grams[c, a, b]
                        damped[a, b] += grams[c, a, b]
                damped[a, a] += 1e-9 + 1e-9 * information[a, a]
            # Gauss-Newton step, right perturbation
            step, largest, gain = solve_small(damped, gradient), 0.0, 0.0
            for a in range(6):
                total_step[a, 0] -= step[a, 0]
                largest, gain = max(largest, abs(step[a, 0])), gain + step[a, 0] * gradient[a, 0]
            pose = _retract(pose, step)
            depth, jacobian, pose_residual = _reproject(camera_from_base, matrices, camera, points, pixels, pose)
            residual = pose_residual
            if shared:
                if iteration < 2:  # shared errors by the last equations, the pose marginalised
                    effect = _expected_effects(*_shared_equations(grams), effects)
                residual = shared_residuals(camera, jacobian, twist, effect, pose_residual)
            if largest < tolerance or gain < CONVERGED_CHI2:
                break
    return pose, information, residual, weight, jacobian, residual_scale, grams
