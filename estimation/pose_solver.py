"""The pose of a known map in one frame set: robust multi-camera Gauss-Newton on reprojection errors.

The unknown is the right perturbation of base_from_surface. Weights are Geman-McClure's, which redescend: with 30 % of
the tracks stuck to a static drape, the error was 0.107 mm with Huber's loss and 0.023 mm with a redescending one.

Some errors are shared by all tracks of a camera and do not average out: a late exposure, or a lens that shifts its
image. `SharedErrors` holds their expected size. They are solved for beside the pose (linear mixed-effects model;
Henderson 1975), so that they are not mistaken for outliers and can be learned. They do not change the weights between
cameras: that moved poses farther from the reference of the webcams' recordings. What delays do to the pose is taken out
of it afterwards, as far as the cameras' disagreement shows them (`delay_gain`).
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
DELAY_ERROR_PX = 0.05  # half the least sigma of a track
MIN_KNOWN_SHARE = 1e-6  # of the information of the best known effect; less is rounding
CLOCK_SIGMAS = 2.0  # of what is known of a clock: what lies farther off is something else
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
    pose, unit, precision = start, 1.0, contiguous(1 / tracks.sigma**2)
    camera, points = contiguous(tracks.camera, np.int64), contiguous(tracks.points)
    pixels = tracks.pixels
    predicted, depth, jacobian = project(rig, camera, pose, points)
    residual = predicted - pixels
    common = None if shared is None else _SharedErrorSolver(shared, camera)
    weight, moved = np.zeros(len(points)), np.zeros(6)
    information = np.zeros((6, 6))
    for widening in scales:
        for iteration in range(iterations if widening == scales[-1] else 3):
            # robust weights; the unit of residuals is estimated anew in the first three iterations
            weight, unit = weights_of(residual, precision, depth, GATE * widening, 0.0 if iteration < 3 else unit)
            # normal equations (information, gradient), damped
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
            # Gauss-Newton step, right perturbation
            step = -np.linalg.solve(damped, gradient)
            pose, moved = pose @ se3.exp(step), moved + step
            predicted, depth, jacobian = project(rig, camera, pose, points)
            residual = predicted - pixels
            if common is not None:
                residual = residual + common.explained(jacobian, anew=iteration < 2)
            if np.abs(step).max() < tolerance or -step @ gradient < CONVERGED_CHI2:
                break
    if common is None:
        return PoseFit(pose, EFFICIENCY / unit**2 * information, residual, weight, jacobian, unit)
    return PoseFit(pose, information, residual, weight, jacobian, unit, common.fit())


class _SharedErrorSolver:
    """The normal equations of the pose and of the errors that each camera's tracks share."""

    def __init__(self, shared: SharedErrors, camera: Index) -> None:
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
        self._fit: SharedFit | None = None
        return self._whole[:, :6], self._whole[:, 9]

    def explained(self, jacobian: Array, anew: bool) -> Array:
        """The shared part of the residuals (N, 2) px, the pose free; anew: estimated from the last `normal`."""
        if anew:
            fit = self.fit()
            # (information + prior^-1)^-1, also where the prior is singular
            gain = self._prior @ np.linalg.inv(self._eye + fit.information @ self._prior)
            self._effect = (gain @ fit.pull).reshape(3, -1)
        return shared_residuals(self._camera, jacobian, self._twist, self._effect)

    def fit(self) -> SharedFit:
        """Of the last `normal`, with the pose eliminated (Schur complement)."""
        if self._fit is None:
            pose = self._whole[:, :6]
            information = pose + (1e-9 * np.trace(pose) + 1e-12) * np.eye(6)
            solved = np.linalg.solve(information, np.concatenate([self._cross, self._whole[:, 9:]], axis=1))
            own = self._own.reshape(self._cross.shape[1], -1) - self._cross.T @ solved[:, :-1]
            self._fit = SharedFit((own + own.T) / 2, -(self._right - self._cross.T @ solved[:, -1]))
        return self._fit


def delay_gain(solution: PoseFit, shared: SharedErrors, twist_variance: Array) -> Array:
    """(C, 3C), s: the cameras' delays in one frame set, from the pull of `solution.shared` (3C,).

    The best linear prediction (Henderson 1975) from how the cameras disagree, the pose free. Three things reduce it:

    - Chance, as many cameras are triggered together, and whatever makes them disagree in other ways, as lenses do
      (James and Stein 1961, positive part).
    - Delays beyond what is known of the clocks: a surface that bends looks like late cameras, too.
    - What is not linear: a delay acts along the velocity, and where that errs too, the product of both errors must stay
      below DELAY_ERROR_PX. So what is waved by hand at 6 Hz stays as it is fitted.
    """
    count, seen, unknown = len(shared.shift), solution.shared, 0.0
    assert seen is not None
    prior = shared.covariance()
    gain = (prior @ np.linalg.inv(np.eye(3 * count) + seen.information @ prior))[:count]
    if solution.weights.any():
        squares = (solution.jacobians**2 @ twist_variance).sum(1)  # (N,) px^2/s^2
        unknown = float(solution.weights @ squares / solution.weights.sum())
    known = np.diag(shared.delay)
    product = unknown * float(np.mean(known)) / DELAY_ERROR_PX**2
    far = float(np.max((gain @ seen.pull) ** 2 / np.maximum(known, 1e-12))) / CLOCK_SIGMAS**2
    clear = max(0.0, 1 - 1 / max(_delay_clarity(seen, prior, count), 1e-9))
    return np.asarray(gain * (clear / ((1 + product**3) * (1 + far**3))))  # sharp, and yet without a jump of the pose


def _delay_clarity(seen: SharedFit, prior: Array, count: int) -> float:
    """What delays explain of the disagreement of `count` cameras, in parts of what they do not; of each a mean.

    Both in squared sigmas for a degree of freedom, the latter one at least. prior: (3C, 3C).
    """
    own, cross, rest = seen.information[:count], seen.information[:count, count:], seen.information[count:, count:]
    shifts = prior[count:, count:] @ np.linalg.inv(np.eye(2 * count) + rest @ prior[count:, count:])
    information = own[:, :count] - cross @ shifts @ cross.T
    explained, freedom = _squared_sigmas(information, seen.pull[:count] - cross @ shifts @ seen.pull[count:])
    whole, every = _squared_sigmas(seen.information, seen.pull)
    other = max(1.0, (whole - explained) / max(1, every - freedom))
    return explained / max(1, freedom) / other


def _squared_sigmas(information: Array, pull: Array) -> tuple[float, int]:
    """What the effects come to that pull (K,), and how many are known; information (K, K) may be singular."""
    size = 1 / np.sqrt(np.maximum(np.diag(information), 1e-300))
    known, axes = np.linalg.eigh(information * size[:, None] * size)
    sure = known > MIN_KNOWN_SHARE * max(float(known[-1]), 1e-300)
    along = axes[:, sure].T @ (size * pull)
    return float((along**2 / known[sure]).sum()), int(sure.sum())


def own_residuals(camera: Index, fit: PoseFit, sure: Array) -> Array:
    """Residuals (N, 2) px that are left when each camera has a pose of its own, to first order.

    sure: (N,) weights of the tracks that determine it. Cameras with fewer than eight keep their residuals.
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


@compiled("Tuple((f8[:,:,::1], f8[:,:,::1]))(i8, i8, i8[::1], i8[::1], f8[:,:,::1], f8[::1], f8[::1])")
def pose_pulls(
    cameras: int, landmarks: int, camera: Index, landmark: Index, jacobian: Array, weight: Array, twist: Array
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


@compiled("f8[:,::1](i8[::1], f8[:,:,::1], f8[::1], f8[:,::1])")
def shared_residuals(camera: Index, jacobian: Array, twist: Array, effect: Array) -> Array:
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
