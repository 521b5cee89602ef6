"""The fit to one frame set: its pose, the parts of its covariance, and whether it counts as a measurement."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from estimation import se3
from estimation.observations import Observations
from estimation.online.deformation import WarpFilter, pose_pulls
from estimation.pose import SurfacePose
from estimation.pose_solver import EFFICIENCY, GATE, PoseFit, SharedErrors, product, project, solve_small
from estimation.rig import Rig
from estimation.runtime import compiled, contiguous, median
from estimation.se3 import Array, Index, Mask
from estimation.surface_map import MapError

PRIOR_RESIDUALS = 20.0  # for which the stated sigmas count when the scatter is estimated
DELAY_ERROR_PX = 0.05  # half the least sigma of a track
MIN_EIGENVALUE_SHARE = 1e-6  # of the information of the best known effect; less is rounding
CLOCK_SIGMAS = 2.0  # of what is known of a clock: what lies farther off is something else
MIN_WEIGHT_SLOPE = 0.1  # of the weights' sum: with less of it most tracks are outliers, and the rest tells nothing
DISPLACEMENT_FLOOR = 1e-3  # mm^-2: prior of a displacement along a line that all cameras look along


@dataclass(frozen=True, slots=True, eq=False)
class FitCovariance:
    """The parts of a fit's covariance, all of the right perturbation, and the sensitivities they follow from."""

    noise: Array  # (6, 6), new in every frame set: tracks and shifts of whole images
    smear: Array  # (6, 6), new in every frame set: late exposures of a moving surface
    lasting: Array  # (6, 6), the same for many frame sets: errors of map and deformation
    scatter: float  # variance of the tracks over their stated variance
    tracks: Array  # (6, 6), the tracks' part of `noise`, by their stated sigmas
    by_delay: Array  # (6, C), change of the pose by a second's delay of each camera
    by_shift: Array  # (6, 2C), change of the pose by a pixel's shift of each image: right and down of camera 0, 1, ...
    step: Array = field(default_factory=lambda: np.zeros(6))  # (6,) from the fitted pose to the one that all this is of


@dataclass(frozen=True, slots=True, eq=False)
class RivalPose:
    """Where cameras that do not carry the pose see the surface, against those that do."""

    cameras: frozenset[int]  # that agree among themselves
    carriers: frozenset[int]  # that carry the pose
    carrier_pose: Array  # (4, 4) base_from_surface by the carriers alone
    own_pose: Array  # (4, 4) base_from_surface by `cameras` alone
    noise: tuple[float, float]  # px, one sigma, of what both poses do to their own pictures: carriers', own
    inlier: Mask  # (N,) tracks of `cameras` that agree with the own pose
    carriers_agree: bool = True  # whether the carriers agree among themselves as they usually do
    off_motion: bool = False  # whether the own pose alone contradicts the motion until now

    @property
    def difference(self) -> Array:
        """(6,) the tangent vector from the carried pose to the own one."""
        return se3.log(se3.inverse(self.carrier_pose) @ self.own_pose)


@dataclass(frozen=True, slots=True, eq=False)
class FrameFit:
    """A fit to one frame set of C cameras, and whether it is a measurement."""

    stamp: float  # s
    solution: PoseFit
    parts: FitCovariance
    twist: Array  # (6,) velocity by which the cameras' instants were brought together
    twist_variance: Array  # (6,)
    inlier: Mask  # (N,) tracks
    used: Index  # (C,) inliers
    reason: str  # why it is no measurement, or ''
    offsets: Array  # (C,) px by which each camera stands off the pose, nan where it does not see the surface
    offset_sigma: Array  # (C,) px, one sigma of that
    outliers: frozenset[int] = frozenset()  # cameras that were left out
    shadowed: Mask | None = None  # (N,) outliers whose texture is where the pose puts it: a shadow's edge moved them
    rivals: tuple[RivalPose, ...] = ()  # what cameras that are left out, or look bumped, say against it

    @property
    def measured(self) -> bool:
        """Whether the fit may enter the window."""
        return not self.reason

    @property
    def followed(self) -> Mask:
        """(N,) tracks that agree with the pose or, where cameras contradict it, with the pose of their own."""
        return np.asarray(np.logical_or.reduce([self.inlier, *(rival.inlier for rival in self.rivals)]))

    @property
    def covariance(self) -> Array:
        """(6, 6), of all that is new in this frame set."""
        return self.parts.noise + self.parts.smear

    @property
    def signal_share(self) -> float:
        """The part, 0 to 1, of the squared velocity in the images that is not the velocity's own noise."""
        weighted = self.solution.jacobians * np.sqrt(self.solution.weights)[:, None, None]
        noise = float((weighted**2).sum((0, 1)) @ self.twist_variance)
        whole = float(((weighted @ self.twist) ** 2).sum())
        return max(0.0, 1 - noise / whole) if whole > 0 else 0.0


def failed_fit(
    observations: Observations, start: Array, cameras: int, reason: str, outliers: frozenset[int]
) -> FrameFit:
    """No measurement by `observations` of a rig of so many cameras: the pose stays `start` (4, 4)."""
    count, zero, unknown = len(observations), np.zeros((6, 6)), np.full(cameras, np.nan)
    by_delay, by_shift = np.zeros((6, cameras)), np.zeros((6, 2 * cameras))
    return FrameFit(
        stamp=observations.stamp,
        solution=PoseFit(start, zero, np.zeros((count, 2)), np.zeros(count), np.zeros((count, 2, 6)), 1.0),
        parts=FitCovariance(np.full((6, 6), np.inf), zero, zero, 1.0, zero, by_delay, by_shift),
        twist=np.zeros(6),
        twist_variance=np.zeros(6),
        inlier=np.zeros(count, bool),
        used=np.zeros(cameras, np.int64),
        reason=reason,
        offsets=unknown,
        offset_sigma=unknown,
        outliers=outliers,
    )


def delay_gain(solution: PoseFit, shared: SharedErrors, twist_variance: Array) -> Array:
    """(C, 3C), s: the cameras' delays in one frame set, from the pull of `solution.shared` (3C,).

    The best linear prediction (Henderson 1975) from how the cameras disagree, the pose free. Three things reduce it:

    - Chance, as many cameras are triggered together, and whatever makes them disagree in other ways, as lenses do
      (James and Stein 1961, positive part).
    - Delays beyond what is known of the clocks: a surface that bends looks like late cameras, too.
    - What is not linear: a delay acts along the velocity, and where that errs too, the product of both errors must stay
      below DELAY_ERROR_PX. So what is waved by hand at 6 Hz stays as it is fitted.
    """
    fit, variances = solution.shared, np.diag(shared.delay)
    assert fit is not None
    prior, information, pull = shared.covariance(), contiguous(fit.information), contiguous(fit.pull[:, None])
    speed = mean_square_along(contiguous(solution.jacobians), contiguous(solution.weights), contiguous(twist_variance))
    gain, clarity = _gain_and_clarity(prior, information, pull)
    product_px = speed * float(np.mean(variances)) / DELAY_ERROR_PX**2
    outside = float(np.max((gain @ fit.pull) ** 2 / np.maximum(variances, 1e-12))) / CLOCK_SIGMAS**2
    clear = max(0.0, 1 - 1 / max(clarity, 1e-9))
    return np.asarray(gain * (clear / ((1 + product_px**3) * (1 + outside**3))))  # sharp, without a jump of the pose


@compiled("f8(f8[:,:,::1], f8[::1], f8[::1])")
def mean_square_along(jacobian: Array, weight: Array, square: Array) -> float:
    """Weighted mean, px^2, by which a pose's entries of mean squares (6,) move tracks of jacobian (N, 2, 6)."""
    total, weights = 0.0, 0.0
    for i in range(len(weight)):
        variance = 0.0
        for k in range(2):
            for a in range(6):
                variance += jacobian[i, k, a] ** 2 * square[a]
        total, weights = total + weight[i] * variance, weights + weight[i]
    return total / weights if weights > 0 else 0.0


@compiled("Tuple((f8, i8))(f8[:,::1], f8[:,::1])")
def _squared_sigmas(information: Array, pull: Array) -> tuple[float, int]:
    """Squared sigmas of the effects that pull (K, 1), and their rank; information (K, K) may be singular."""
    count = len(pull)
    scaled, size = np.empty_like(information), np.empty(count)
    for i in range(count):
        size[i] = 1 / np.sqrt(max(information[i, i], 1e-300))
    for i in range(count):
        for j in range(count):
            scaled[i, j] = information[i, j] * size[i] * size[j]
    eigenvalues, axes = np.linalg.eigh(scaled)
    squares, rank = 0.0, 0
    for k in range(count):
        if eigenvalues[k] > MIN_EIGENVALUE_SHARE * max(eigenvalues[-1], 1e-300):
            along = 0.0
            for i in range(count):
                along += axes[i, k] * size[i] * pull[i, 0]
            squares, rank = squares + along * along / eigenvalues[k], rank + 1
    return squares, rank


@compiled("f8[:,::1](f8[:,::1], f8[:,::1])")
def _gain(prior: Array, information: Array) -> Array:
    """prior @ (1 + information @ prior)^-1 of symmetric (K, K), whatever of them is singular."""
    system = product(prior, information)  # transposed
    for i in range(len(prior)):
        system[i, i] += 1.0
    return solve_small(system, prior)


@compiled("Tuple((f8[:,::1], f8))(f8[:,::1], f8[:,::1], f8[:,::1])")
def _gain_and_clarity(prior: Array, information: Array, pull: Array) -> tuple[Array, float]:
    """The prediction's gain (C, 3C), and how clearly delays explain that the cameras disagree (an F ratio).

    Squared sigmas per degree of freedom that delays explain, over those that they do not explain (one at least).
    prior: (3C, 3C) of the effects. information, pull: as in `SharedFit`.
    """
    count = len(prior) // 3
    cross = information[:count, count:].copy()
    shifts = product(cross, _gain(prior[count:, count:].copy(), information[count:, count:].copy()))
    delay_information, delay_pull = product(shifts, cross.T.copy()), product(shifts, pull[count:])
    for i in range(count):
        delay_pull[i, 0] = pull[i, 0] - delay_pull[i, 0]
        for j in range(count):
            delay_information[i, j] = information[i, j] - delay_information[i, j]
    explained, delay_rank = _squared_sigmas(delay_information, delay_pull)
    total, total_rank = _squared_sigmas(information, pull)
    unexplained = max(1.0, (total - explained) / max(1, total_rank - delay_rank))
    return _gain(prior, information)[:count].copy(), explained / max(1, delay_rank) / unexplained


def residual_scatter(observations: Observations, solution: PoseFit) -> float:
    """Variance of the tracks over their stated variance, estimated from the residuals of one fit.

    The variance of the estimating equations over their slope (Huber 1981, 6.8), relative to its value for normal errors
    of the stated size, which counts as PRIOR_RESIDUALS. Tracks of clean pictures are two or three times better than
    stated. Where some are worse without being outliers, the weights alone would show too little of it.
    """
    parts = contiguous(solution.residuals), contiguous(solution.weights), contiguous(observations.sigma)
    return _scatter(*parts, float(solution.scale))


@compiled("f8(f8[:,::1], f8[::1], f8[::1], f8)")
def _scatter(residual: Array, weights: Array, sigma: Array, scale: float) -> float:
    """`residual_scatter` of residuals (N, 2), weights (N,) and stated sigmas (N,) px."""
    count, total, slope, pull = 0, 0.0, 0.0, 0.0
    for i in range(len(weights)):
        if weights[i] > 0:
            root = sigma[i] * scale
            square = (residual[i, 0] ** 2 + residual[i, 1] ** 2) / (root * root)
            weight = 1 / (1 + square / GATE**2) ** 2
            slope += weight * (1 - 2 * square / (GATE**2 + square))
            pull += weight * weight * square
            count, total = count + 1, total + weight
    freedom = total * 2 - 6
    if freedom <= 0 or slope <= MIN_WEIGHT_SLOPE * count:
        return 1.0
    pull = pull / count / 2 * (2 * total / freedom)
    ratio = EFFICIENCY * (total / count) * pull / (slope / count) ** 2
    return (PRIOR_RESIDUALS + freedom * ratio) / (PRIOR_RESIDUALS + freedom)


def fit_covariance(
    observations: Observations,
    solution: PoseFit,
    shared: SharedErrors,
    map_error: MapError,
    warp: WarpFilter,
    twist_variance: Array,
) -> FitCovariance:
    """The parts of the covariance of a pose fitted to `observations`.

    The pose is the fitted one without what the cameras' delays in this frame set did to it, as far as their tracks show
    these delays (`delay_gain`). twist_variance: (6,) of `shared.twist`.
    """
    noise = _inverse(contiguous(solution.information), 1e-9, 0.0)
    weight = EFFICIENCY * solution.weights / (observations.sigma * solution.scale) ** 2
    mapped = np.zeros(observations.track.max(initial=0) + 1, np.int64)
    mapped[observations.track] = 1
    rows, landmark = np.flatnonzero(mapped), (np.cumsum(mapped) - 1)[observations.track]
    cameras, camera = len(shared.shift), contiguous(observations.camera, np.int64)
    by_landmark, by_camera = pose_pulls(cameras, len(rows), camera, landmark, solution.jacobians, weight, shared.twist)
    lasting = map_error.pose_covariance(rows, by_landmark)
    lasting = noise @ (lasting + warp.pull(observations.track, weight, solution.jacobians)) @ noise
    # the pose by each delay, shift right and shift down; what a correction by the seen delays leaves of that, and adds
    effects, shared_fit = noise @ by_camera.reshape(6, -1), solution.shared
    assert shared_fit is not None
    gain = effects[:, :cameras] @ delay_gain(solution, shared, twist_variance)
    effects, tracks = effects - gain @ shared_fit.information, noise + gain @ shared_fit.information @ gain.T
    by_delay = effects[:, :cameras]
    by_shift = effects[:, cameras:].reshape(6, 2, -1).swapaxes(1, 2).reshape(6, -1)
    noise_and_shift = tracks + (by_shift * np.repeat(shared.shift, 2)) @ by_shift.T
    smear, scatter = by_delay @ shared.delay @ by_delay.T, residual_scatter(observations, solution)
    return FitCovariance(noise_and_shift, smear, lasting, scatter, tracks, by_delay, by_shift, -gain @ shared_fit.pull)


@compiled("f8[:,::1](f8[:,:,::1], f8[:,::1])")
def solve_symmetric3(normal: Array, right: Array) -> Array:
    """Solutions (N, 3) of positive definite normal equations (N, 3, 3) and (N, 3): Cramer's rule."""
    out = np.empty_like(right)
    for i in range(len(right)):
        m, r = normal[i], right[i]
        p, q, s = m[1, 1] * m[2, 2] - m[1, 2] ** 2, m[0, 2] * m[1, 2] - m[0, 1] * m[2, 2], m[0, 1] * m[1, 2]
        s -= m[0, 2] * m[1, 1]
        t, u, v = m[0, 0] * m[2, 2] - m[0, 2] ** 2, m[0, 1] * m[0, 2] - m[0, 0] * m[1, 2], m[0, 0] * m[1, 1]
        v -= m[0, 1] ** 2
        determinant = m[0, 0] * p + m[0, 1] * q + m[0, 2] * s
        out[i, 0] = (p * r[0] + q * r[1] + s * r[2]) / determinant
        out[i, 1] = (q * r[0] + t * r[1] + u * r[2]) / determinant
        out[i, 2] = (s * r[0] + u * r[1] + v * r[2]) / determinant
    return out


@compiled("Tuple((f8[:,::1], f8[::1], f8[::1]))(f8[:,:,::1], f8[:,::1], f8[::1], f8[:,:,::1], f8[:,::1])")
def unusual_displacements(
    normal: Array, right: Array, square: Array, usual_normal: Array, usual_right: Array
) -> tuple[Array, Array, Array]:
    """Landmarks' displacements relative to their usual ones, all from `displacement_sums`; usual_normal: definite.

    Returns right sides (L, 3) less the usual ones, squares (L,) of the residuals about the usual displacement, and the
    part of them (L,) that a displacement explains.
    """
    usual, ridged = solve_symmetric3(usual_normal, usual_right), normal.copy()
    excess, excess_square, explained = right.copy(), square.copy(), np.zeros(len(right))
    for i in range(len(right)):
        for a in range(3):
            for b in range(3):
                excess[i, a] -= normal[i, a, b] * usual[i, b]
            excess_square[i] -= (right[i, a] + excess[i, a]) * usual[i, a]
            ridged[i, a, a] += DISPLACEMENT_FLOOR
    shift = solve_symmetric3(ridged, excess)
    for i in range(len(right)):
        explained[i] = shift[i, 0] * excess[i, 0] + shift[i, 1] * excess[i, 1] + shift[i, 2] * excess[i, 2]
    return excess, excess_square, explained


PICTURE_DOF = 4  # of a camera's picture: shift right and down, px; roll, rad; scale
MIN_CAMERA_TRACKS = 8  # of a camera, to estimate its four numbers
OUTLIER_PX = 6.0  # px beside the median of its camera at which a track counts for nothing


@dataclass(frozen=True, slots=True, eq=False)
class CameraEquations:
    """The normal equations of one camera's N tracks in one frame set, by its own four numbers and by the pose."""

    information: Array  # (4, 4) information of the numbers
    pull: Array  # (4,)
    pose_information: Array  # (6, 6) information of the pose
    pose_pull: Array  # (6,)
    cross: Array  # (4, 6)
    jacobian: Array  # (N, 2, 4) px by the numbers

    def without(self, values: Array) -> CameraEquations:
        """The same with these values (4,) of the numbers subtracted from the residuals."""
        return replace(self, pull=self.pull - self.information @ values, pose_pull=self.pose_pull - values @ self.cross)

    def moved(self, numbers: Array) -> float:
        """Root mean square, px, by which these numbers (4,) move its tracks."""
        return float(np.sqrt(np.mean(((self.jacobian @ numbers) ** 2).sum(-1))))


def camera_equations(
    rig: Rig, observations: Observations, points: Array, exposed: Array, jacobians: Array
) -> dict[int, CameraEquations]:
    """The equations of each camera with enough tracks, by camera number."""
    parts: dict[int, CameraEquations] = {}
    for camera in range(len(rig)):
        tracks = np.flatnonzero(observations.camera == camera)
        if len(tracks) < MIN_CAMERA_TRACKS:
            continue
        pixels = observations.pixels[tracks]
        residuals = pixels - project(rig, observations.camera[tracks], exposed[camera], points[tracks])[0]
        centre = np.array([median(residuals[:, 0]), median(residuals[:, 1])])
        robust = np.maximum(1 - ((residuals - centre) ** 2).sum(1) / OUTLIER_PX**2, 0.0)
        weights = np.repeat((robust / np.maximum(observations.sigma[tracks], 0.1)) ** 2, 2)[:, None]
        rows, slopes = jacobians[tracks].reshape(-1, 6), _picture_jacobian(rig, camera, pixels)
        flat, gap = slopes.reshape(-1, PICTURE_DOF), residuals.ravel()
        pose, own = (rows * weights).T, (flat * weights).T
        parts[camera] = CameraEquations(own @ flat, own @ gap, pose @ rows, pose @ gap, own @ rows, slopes)
    return parts


def _picture_jacobian(rig: Rig, camera: int, pixels: Array) -> Array:
    """(N, 2, 4), how pixels (N, 2) move with shift (2), roll and scale about the camera's axis."""
    across, down = (pixels - rig.matrices[camera][:2, 2]).T
    zero, one = np.zeros_like(across), np.ones_like(across)
    return np.stack([np.stack([one, zero, -down, across], -1), np.stack([zero, one, across, down], -1)], 1)


def motion_sigmas(fit: PoseFit, expected: SurfacePose) -> float:
    """By how many sigmas a pose differs from the one expected by the motion, at least one."""
    difference = se3.log(se3.inverse(expected.base_from_surface) @ fit.base_from_surface)
    spread = expected.covariance + _inverse(contiguous(fit.information), 1e-9, 1e-12)  # without information: one
    return max(1.0, float(np.sqrt(difference @ solve_small(spread, difference[:, None])[:, 0] / 6)))


def picture_noise(fit: PoseFit, rows: Mask) -> float:
    """Root mean square, px, one sigma, by which a pose's noise moves the tracks `rows` (N,)."""
    spread, jacobians = _inverse(contiguous(fit.information), 1e-9, 1e-12), fit.jacobians[rows]
    return float(np.sqrt(np.einsum("nki,nki->", jacobians @ spread, jacobians) / len(jacobians)))


@compiled("f8[:,::1](f8[:,::1], f8, f8)")
def _inverse(information: Array, share: float, floor: float) -> Array:
    """Covariance (N, N) of an information with that share of its trace, and `floor`, added; zero of none at all."""
    damped, eye, damping = information.copy(), np.zeros_like(information), floor
    for i in range(len(damped)):
        damping += share * information[i, i]
    if damping == 0.0:
        return eye
    for i in range(len(damped)):
        damped[i, i] += damping
        eye[i, i] = 1.0
    out = solve_small(damped, eye)
    for i in range(len(damped)):
        for j in range(i):
            out[i, j] = out[j, i] = (out[i, j] + out[j, i]) / 2
    return out


def camera_numbers(cameras: Mask) -> frozenset[int]:
    """The numbers of the chosen ones of cameras (C,)."""
    return frozenset(np.flatnonzero(cameras).tolist())
