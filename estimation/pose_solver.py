"""The pose of a known map in one frame set: robust multi-camera Gauss-Newton on reprojection errors.

The unknown is the right perturbation of base_from_surface. Weights are Geman-McClure's, which redescend: with 30 % of
the tracks stuck to a static drape, the error was 0.107 mm with Huber's loss and 0.023 mm with a redescending one.

Some errors are shared by all tracks of a camera and do not average out: a late exposure, or a lens that shifts its
image. `SharedErrors` holds their expected size. They are solved for beside the pose (linear mixed-effects model;
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
# What the weights, at that gate, take from the information of Gaussian noise beyond what the estimate itself loses
# (Huber 1981, 4.6, integrated over two dimensions): the weights' mean is 0.72, the estimate is worth 0.89
EFFICIENCY = 1.235
INLIER_WEIGHT = 0.2  # from there on a track agrees with the fit
CONVERGED_CHI2 = 1e-3  # squared sigmas of the pose: a last step as small as that leaves a hundredth of a sigma to go


@dataclass(frozen=True, slots=True, eq=False)
class PointTracks:
    """Points of the surface and where cameras see them: N parallel rows."""

    camera: Index  # (N,) number in the rig
    points: Array  # (N, 3) mm, surface frame
    pixels: Array  # (N, 2) undistorted px
    sigma: Array  # (N,) px, one standard deviation per axis

    @staticmethod
    def of(observations: Observations, points: Array) -> PointTracks:
        """Observations of points (N, 3), one for each row."""
        return PointTracks(observations.camera, points, observations.pixels, observations.sigma)

    def only(self, rows: Mask) -> PointTracks:
        """Those of the rows (N,)."""
        return PointTracks(self.camera[rows], self.points[rows], self.pixels[rows], self.sigma[rows])


@dataclass(frozen=True, slots=True, eq=False)
class SharedErrors:
    """The expected size of the errors that all tracks of one camera share in one frame set."""

    twist: Array  # (6,) rad/s and mm/s of the surface: a delay shows along it
    delay: Array  # (C, C) s^2, covariance of the cameras' delays; may be singular
    shift: Array  # (C,) px^2, variance of an image's shift, per axis

    def covariance(self) -> Array:
        """Of (delays (C,), shifts (C,) right, shifts (C,) down): (3C, 3C)."""
        n = len(self.shift)
        whole = np.zeros((3 * n, 3 * n))
        whole[:n, :n] = self.delay
        whole[np.arange(n, 3 * n), np.arange(n, 3 * n)] = np.tile(self.shift, 2)
        return whole


@dataclass(frozen=True, slots=True, eq=False)
class SharedFit:
    """Normal equations of the shared errors, the pose marginalised: information @ effect = pull."""

    information: Array  # (3C, 3C) of the effect: delays (C,) s, shifts right (C,) px, shifts down (C,) px
    pull: Array  # (3C,)


@dataclass(frozen=True, slots=True, eq=False)
class PoseFit:
    """A pose fitted to N tracks."""

    base_from_surface: Array  # (4, 4)
    information: Array  # (6, 6) of its right perturbation
    residuals: Array  # (N, 2) px, predicted minus observed, without the shared errors
    weights: Array  # (N,) in [0, 1], one for a track that fits
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

    The unit of residuals grows to the tracks' own median, so that tracks worse than they claim are averaged.

    scales: factors of GATE, from coarse to fine.
    prior: (6, 6) information about `start`.
    iterations: at the last scale; three at those before.
    tolerance: rad and mm, largest entry of the last step.
    shared: expected size of the errors that all tracks of a camera share.
    """
    count, none = len(rig), np.zeros((6, 6))
    twist, effects = (none[0], np.zeros((3 * count,) * 2)) if shared is None else (shared.twist, shared.covariance())
    seen = contiguous(tracks.camera, np.int64), contiguous(tracks.points), contiguous(tracks.pixels)
    fixed = rig.camera_from_base, rig.matrices, *seen, contiguous(1 / tracks.sigma**2), contiguous(start)
    how = np.array(scales, float), iterations, tolerance, none if prior is None else contiguous(prior)
    fitted = _gauss_newton(*fixed, *how, shared is not None, contiguous(twist), effects)
    pose, information, residuals, weights, jacobians, unit, grams = fitted
    if shared is None:
        return PoseFit(pose, EFFICIENCY / unit**2 * information, residuals, weights, jacobians, unit)
    own, pull = _shared_equations(grams)
    return PoseFit(pose, information, residuals, weights, jacobians, unit, SharedFit(own, pull.ravel()))


exp_entries = compiled("UniTuple(f8, 12)(f8, f8, f8, f8, f8, f8)")(se3.exp_entries)


@compiled("f8[:,::1](f8[:,::1], f8[:,::1])")
def solved(matrix: Array, right: Array) -> Array:
    """matrix^-1 @ right, (N, N) and (N, K) of few rows, by elimination with pivots; not finite where it is singular."""
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
    """a @ b of few rows and columns, without the library's call."""
    out = np.zeros((a.shape[0], b.shape[1]))
    for i in range(a.shape[0]):
        for k in range(a.shape[1]):
            for j in range(b.shape[1]):
                out[i, j] += a[i, k] * b[k, j]
    return out


@compiled("f8[:,::1](f8[:,::1], f8[:,::1])")
def _stepped(pose: Array, step: Array) -> Array:
    """pose (4, 4) @ exp(-step), of (6, 1)."""
    moved = np.zeros((4, 4))
    entries = exp_entries(-step[0, 0], -step[1, 0], -step[2, 0], -step[3, 0], -step[4, 0], -step[5, 0])
    for i in range(12):
        moved[i // 4, i % 4] = entries[i]
    moved[3, 3] = 1.0
    return product(pose, moved)


@compiled("Tuple((f8[:,::1], f8[:,::1]))(f8[:,:,::1])")
def _shared_equations(grams: Array) -> tuple[Array, Array]:
    """As in `SharedFit`, (3C, 3C) and (3C, 1), of products as `gram_by_camera` has them (Schur complement)."""
    n = len(grams)
    pose, right, cross = np.zeros((6, 6)), np.zeros((3 * n, 1)), np.zeros((6, 3 * n + 1))
    own = np.zeros((3 * n, 3 * n))
    for c in range(n):
        for a in range(6):
            cross[a, 3 * n] += grams[c, a, 9]
            for b in range(6):
                pose[a, b] += grams[c, a, b]
            for k in range(3):
                cross[a, k * n + c] = grams[c, a, 6 + k]
        for k in range(3):
            right[k * n + c, 0] = grams[c, 6 + k, 9]
            for m in range(3):
                own[k * n + c, m * n + c] = grams[c, 6 + k, 6 + m]
    damping = 1e-12
    for a in range(6):
        damping += 1e-9 * pose[a, a]
    for a in range(6):
        pose[a, a] += damping
    taken = product(cross.T.copy(), solved(pose, cross))
    out = np.empty((3 * n, 3 * n))
    for i in range(3 * n):
        right[i, 0] = taken[i, 3 * n] - right[i, 0]
        for j in range(3 * n):
            out[i, j] = (own[i, j] - taken[i, j] + own[j, i] - taken[j, i]) / 2
    return out, right


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
def gram_by_camera(cameras: int, camera: Index, jacobian: Array, residual: Array, weight: Array, twist: Array) -> Array:
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
def shared_residuals(camera: Index, jacobian: Array, twist: Array, effect: Array, whole: Array) -> Array:
    """Residuals (N, 2) px, of the whole ones, with what the cameras' delays and shifts, effect (3, C), make added."""
    residual = np.empty((len(camera), 2))
    for i in range(len(camera)):
        c = camera[i]
        for k in range(2):
            along = 0.0
            for a in range(6):
                along += jacobian[i, k, a] * twist[a]
            residual[i, k] = whole[i, k] + (effect[0, c] * along + effect[1 + k, c])
    return residual


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
            middle = np.sort(squared[depth > 0])[front // 2] / CHI2_MEDIAN
            unit = np.sqrt(max(middle, 1.0))
    weight = np.zeros(len(depth))
    for i in range(len(depth)):
        if depth[i] > 0:
            beside = 1.0 + squared[i] / (gate * unit) ** 2
            weight[i] = 1.0 / (beside * beside)
    return weight, unit


@compiled(
    "Tuple((f8[::1], f8[:,:,::1], f8[:,::1]))(f8[:,:,::1], f8[:,:,::1], i8[::1], f8[:,::1], f8[:,::1], f8[:,::1])"
)
def _reprojected(
    camera_from_base: Array, matrices: Array, camera: Index, points: Array, pixels: Array, pose: Array
) -> tuple[Array, Array, Array]:
    """Depths (N,), Jacobians (N, 2, 6) and residuals (N, 2), px, predicted minus seen, as `project_tracks` has them."""
    from_surface = product(camera_from_base.reshape(-1, 4), pose).reshape(-1, 4, 4)
    left, depth, jacobian = project_tracks(from_surface, matrices, camera, points)
    for i in range(len(left)):
        left[i, 0] -= pixels[i, 0]
        left[i, 1] -= pixels[i, 1]
    return depth, jacobian, left


@compiled("f8[:,::1](f8[:,::1], f8[:,::1], f8[:,::1])")
def _expected_effects(own: Array, pull: Array, effects: Array) -> Array:
    """Effects (3, C) expected by their equations (3C, 3C), (3C, 1) and their covariance (3C, 3C)."""
    weighed = product(own, effects)
    for a in range(len(own)):
        weighed[a, a] += 1.0
    return product(effects, solved(weighed, pull)).reshape(3, len(own) // 3)


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
    """The parts of the `PoseFit` that `solve_pose` finds. effects: (3C, 3C), `SharedErrors.covariance`, if `shared`."""
    count, pose, unit, moved = len(matrices), start, 1.0, np.zeros((6, 1))
    weight, trusted, information = np.zeros(len(points)), np.zeros(len(points)), np.zeros((6, 6))
    grams, effect = np.zeros((count, TRACK_COLUMNS, TRACK_COLUMNS)), np.zeros((3, count))
    depth, jacobian, whole = _reprojected(camera_from_base, matrices, camera, points, pixels, pose)
    residual = whole
    for widening in scales:
        for iteration in range(iterations if widening == scales[-1] else 3):
            # robust weights; the unit of residuals is estimated anew in the first three iterations
            weight, unit = weights_of(residual, precision, depth, GATE * widening, 0.0 if iteration < 3 else unit)
            # normal equations (information, gradient), damped
            clear = EFFICIENCY / unit**2 if shared else 1.0
            for i in range(len(weight)):
                trusted[i] = weight[i] * precision[i] * clear
            grams = gram_by_camera(count, camera, jacobian, whole, trusted, twist)
            information, damped, gradient = np.zeros((6, 6)), prior.copy(), product(prior, moved)
            for a in range(6):
                for c in range(count):
                    gradient[a, 0] += grams[c, a, 9]
                    for b in range(6):
                        information[a, b] += grams[c, a, b]
                        damped[a, b] += grams[c, a, b]
                damped[a, a] += 1e-9 + 1e-9 * information[a, a]
            # Gauss-Newton step, right perturbation
            step, largest, gain = solved(damped, gradient), 0.0, 0.0
            for a in range(6):
                moved[a, 0] -= step[a, 0]
                largest, gain = max(largest, abs(step[a, 0])), gain + step[a, 0] * gradient[a, 0]
            pose = _stepped(pose, step)
            depth, jacobian, whole = _reprojected(camera_from_base, matrices, camera, points, pixels, pose)
            residual = whole
            if shared:
                if iteration < 2:  # the shared part by the last equations, the pose free; effects may be singular
                    effect = _expected_effects(*_shared_equations(grams), effects)
                residual = shared_residuals(camera, jacobian, twist, effect, whole)
            if largest < tolerance or gain < CONVERGED_CHI2:
                break
    return pose, information, residual, weight, jacobian, unit, grams
