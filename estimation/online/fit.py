"""The fit to one frame set: its pose, the parts of its covariance, and whether it counts as a measurement."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from estimation import se3
from estimation.observations import Observations
from estimation.online.deformation import WarpFilter
from estimation.pose import SurfacePose
from estimation.pose_solver import EFFICIENCY, GATE, PoseFit, SharedErrors, delay_gain, pose_pulls, project
from estimation.rig import Rig
from estimation.runtime import compiled, median
from estimation.se3 import Array, Index, Mask
from estimation.surface_map import SurfaceMap

PRIOR_RESIDUALS = 20.0  # for which the stated sigmas count when the scatter is estimated
MIN_WEIGHT_SLOPE = 0.1  # of the weights' sum: with less of it most tracks are outliers, and the rest tells nothing
DISPLACEMENT_FLOOR = 1e-3  # mm^-2: prior of a displacement along a line that all cameras look along
UNCERTAIN_MM = 0.3  # along some direction: landmarks of two cameras are better known, those of one alone are not


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
    carried: Array  # (4, 4) base_from_surface by the carriers alone
    own: Array  # (4, 4) base_from_surface by `cameras` alone
    noise: tuple[float, float]  # px, one sigma, of what both poses do to their own pictures: carriers', own
    inlier: Mask  # (N,) tracks of `cameras` that agree with the own pose
    united: bool = True  # whether the carriers agree among themselves as they usually do
    jumped: bool = False  # whether the own pose alone contradicts the motion until now

    @property
    def difference(self) -> Array:
        """(6,) the tangent vector from the carried pose to the own one."""
        return se3.log(se3.inverse(self.carried) @ self.own)


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
    allowed: Array  # (C,) px, one sigma of that
    outliers: frozenset[int] = frozenset()  # cameras that were left out
    lit: Mask | None = None  # (N,) outliers whose grain is where the pose puts it: a shadow's edge has bent the track
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
    """No measurement of what was `seen` by a rig of so many cameras: the pose stays `start` (4, 4)."""
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
        allowed=unknown,
        outliers=outliers,
    )


class MapError:
    """A map's joint covariance: as it reaches the pose, and as it widens the sigmas of single tracks.

    The whole is megabytes, and reading it every frame took longer than the fit. The landmarks in use change slowly, so
    a block of theirs is kept.
    """

    MAX_BLOCK_RATIO = 1.5  # times the landmarks in use, that the block may hold before it is cut anew

    def __init__(self, surface_map: SurfaceMap) -> None:
        count = len(surface_map)
        self._whole = surface_map.covariance.reshape(count, 3, count, 3)
        self._position = np.full(count, -1)  # of each landmark in the block
        self._block = np.zeros((0, 0))
        own = np.einsum("ninj->nij", self._whole)
        self._uncertain = np.linalg.eigvalsh(own)[:, -1] > UNCERTAIN_MM**2
        self._own = np.where(self._uncertain[:, None, None], own, 0.0)

    def reaching_pose(self, rows: Index, pull: Array) -> Array:
        """Covariance (6, 6) of the sum of the landmarks' pulls (6, K, 3), of rows (K,), ascending."""
        if (self._position[rows] < 0).any() or len(self._block) > 3 * self.MAX_BLOCK_RATIO * len(rows):
            held = np.union1d(rows, np.flatnonzero(self._position >= 0))
            held = held if len(held) < self.MAX_BLOCK_RATIO * len(rows) else rows
            self._position[:] = -1
            self._position[held] = np.arange(len(held))
            self._block = self._whole[held][:, :, held].reshape(3 * len(held), -1)
        spread = np.zeros((6, len(self._block) // 3, 3))
        spread[:, self._position[rows]] = pull
        flat = spread.reshape(6, -1)
        return np.asarray(flat @ self._block @ flat.T)

    def widened(self, sigma: Array, track: Index, jacobians: Array) -> Array:
        """Sigmas (N,) px of tracks with the error of their own landmark, where that is UNCERTAIN_MM or more.

        A landmark that one camera alone has seen lies exactly on that camera's ray, and anywhere along it. In that
        camera it counts in full, in another next to nothing until it is known better. track: (N,) rows of the map.
        jacobians: (N, 2, 6) px by the pose.
        """
        rows = np.flatnonzero(self._uncertain[track])
        if not len(rows):
            return sigma
        by_point, wide = jacobians[rows, :, 3:], sigma.copy()
        square = np.einsum("mki,mij,mkj->m", by_point, self._own[track[rows]], by_point) / 2  # of one axis
        wide[rows] = np.sqrt(sigma[rows] ** 2 + square)
        return wide


def residual_scatter(observations: Observations, solution: PoseFit) -> float:
    """Variance of the tracks over their stated variance, estimated from the residuals of one fit.

    The variance of the estimating equations over their slope (Huber 1981, 6.8), relative to its value for normal errors
    of the stated size, which counts as PRIOR_RESIDUALS. Tracks of clean pictures are two or three times better than
    stated. Where some are worse without being outliers, the weights alone would show too little of it.
    """
    root = observations.sigma * solution.scale
    square = (solution.residuals**2).sum(1) / root**2
    used = solution.weights > 0
    weight = (1 + square[used] / GATE**2) ** -2
    freedom = weight.sum() * 2 - 6
    if freedom <= 0:
        return 1.0
    slope = float(np.mean(weight * (1 - 2 * square[used] / (GATE**2 + square[used]))))
    if slope <= MIN_WEIGHT_SLOPE:
        return 1.0
    pull = float(np.mean(weight**2 * square[used])) / 2 * (2 * weight.sum() / freedom)
    ratio = EFFICIENCY * float(weight.mean()) * pull / slope**2
    return float((PRIOR_RESIDUALS + freedom * ratio) / (PRIOR_RESIDUALS + freedom))


def fit_covariance(
    observations: Observations,
    solution: PoseFit,
    shared: SharedErrors,
    map_error: MapError,
    warp: WarpFilter,
    twist_variance: Array,
) -> FitCovariance:
    """The covariance of a pose that was fitted to what was `seen`, by its parts.

    The pose is the fitted one without what the cameras' delays in this frame set did to it, as far as their tracks show
    these delays (`delay_gain`). twist_variance: (6,) of `shared.twist`.
    """
    information = solution.information + 1e-9 * np.eye(6) * np.trace(solution.information)
    noise = np.linalg.pinv(information, hermitian=True)
    weight = EFFICIENCY * solution.weights / (observations.sigma * solution.scale) ** 2
    rows, landmark = np.unique(observations.track, return_inverse=True)
    cameras = len(shared.shift)
    camera = np.ascontiguousarray(observations.camera)
    by_landmark, by_camera = pose_pulls(cameras, len(rows), camera, landmark, solution.jacobians, weight, shared.twist)
    weighted = solution.jacobians * weight[:, None, None]
    lasting = map_error.reaching_pose(rows, by_landmark)
    lasting = noise @ (lasting + warp.pull(observations.track, weighted, solution.jacobians[:, :, 3:])) @ noise
    # the pose by each delay, shift right and shift down; what a correction by the seen delays leaves of that, and adds
    effects, seen = noise @ by_camera.reshape(6, -1), solution.shared
    assert seen is not None
    gain = effects[:, :cameras] @ delay_gain(solution, shared, twist_variance)
    effects, tracks = effects - gain @ seen.information, noise + gain @ seen.information @ gain.T
    by_delay = effects[:, :cameras]
    by_shift = effects[:, cameras:].reshape(6, 2, -1).swapaxes(1, 2).reshape(6, -1)
    new = tracks + (by_shift * np.repeat(shared.shift, 2)) @ by_shift.T
    smear, scatter = by_delay @ shared.delay @ by_delay.T, residual_scatter(observations, solution)
    return FitCovariance(new, smear, lasting, scatter, tracks, by_delay, by_shift, -gain @ seen.pull)


@compiled("Tuple((f8[:,:,::1], f8[:,::1], f8[::1], i8[::1]))(i8, i8[::1], f8[:,:,::1], f8[:,::1], f8[::1])")
def displacement_sums(
    landmarks: int, landmark: Index, jacobian: Array, residual: Array, precision: Array
) -> tuple[Array, Array, Array, Index]:
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
def solve_symmetric3(normal: Array, right: Array) -> Array:
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
def unusual_displacements(
    normal: Array, right: Array, square: Array, usual_normal: Array, usual_right: Array
) -> tuple[Array, Array, Array]:
    """What landmarks' displacements are beside their usual ones, all from `displacement_sums`; usual_normal: definite.

    The right sides (L, 3) without what is usual, the square (L,) of the residuals about that, and how much of it (L,)
    a displacement explains.
    """
    usual = solve_symmetric3(usual_normal, usual_right)
    plain, about = right.copy(), square.copy()
    for i in range(len(right)):
        for a in range(3):
            for b in range(3):
                plain[i, a] -= normal[i, a, b] * usual[i, b]
            about[i] -= (right[i, a] + plain[i, a]) * usual[i, a]
    ridged = normal.copy()
    for a in range(3):
        ridged[:, a, a] += DISPLACEMENT_FLOOR
    moved = solve_symmetric3(ridged, plain)
    return plain, about, (moved * plain).sum(1)


@compiled("Tuple((b1[:,::1], b1[:,::1]))(i8, i8, i8[::1], i8[::1], f8[:,:,::1], f8[:,::1], b1[::1], f8)")
def landmark_sights(
    cameras: int,
    landmarks: int,
    camera: Index,
    track: Index,
    jacobian: Array,
    residual: Array,
    agrees: Mask,
    near: float,
) -> tuple[Mask, Mask]:
    """Which landmarks each camera (C, L) has found where the pose puts them, and has found at all.

    camera, track: (N,). jacobian: (N, 2, 6). residual: (N, 2) px. agrees: (N,). near: mm from the place, at which a
    landmark is there though it does not agree.
    """
    found, seen = np.zeros((cameras, landmarks), np.bool_), np.zeros((cameras, landmarks), np.bool_)
    for i in range(len(camera)):
        away, by_point = 0.0, 0.0
        for k in range(2):
            away += residual[i, k] * residual[i, k]
            for b in range(3):
                by_point += jacobian[i, k, 3 + b] * jacobian[i, k, 3 + b]
        seen[camera[i], track[i]] = True
        found[camera[i], track[i]] = agrees[i] or 2 * away < near * near * by_point
    return found, seen


PICTURE_DOF = 4  # of a camera's picture: shift right and down, px; roll, rad; scale
MIN_CAMERA_TRACKS = 8  # of a camera, to estimate its four numbers
OUTLIER_PX = 6.0  # px beside the median of its camera at which a track counts for nothing


@dataclass(frozen=True, slots=True, eq=False)
class CameraEquations:
    """The normal equations of one camera's N tracks in one frame set, by its own four numbers and by the pose."""

    own: Array  # (4, 4) information of the numbers
    pull: Array  # (4,)
    pose: Array  # (6, 6) information of the pose
    pulled: Array  # (6,)
    cross: Array  # (4, 6)
    slopes: Array  # (N, 2, 4) px by the numbers

    def without(self, numbers: Array) -> CameraEquations:
        """The same with these numbers (4,) subtracted from the residuals."""
        return replace(self, pull=self.pull - self.own @ numbers, pulled=self.pulled - numbers @ self.cross)

    def moved(self, numbers: Array) -> float:
        """Root mean square, px, by which these numbers (4,) move its tracks."""
        return float(np.sqrt(np.mean(((self.slopes @ numbers) ** 2).sum(-1))))


def camera_equations(
    rig: Rig, observations: Observations, points: Array, exposed: Array, jacobians: Array
) -> dict[int, CameraEquations]:
    """The equations of each camera with enough tracks, by camera number."""
    parts: dict[int, CameraEquations] = {}
    for camera in range(len(rig)):
        mine = np.flatnonzero(observations.camera == camera)
        if len(mine) < MIN_CAMERA_TRACKS:
            continue
        pixels = observations.pixels[mine]
        left = pixels - project(rig, observations.camera[mine], exposed[camera], points[mine])[0]
        middle = np.array([median(left[:, 0]), median(left[:, 1])])
        beside = ((left - middle) ** 2).sum(1) / OUTLIER_PX**2
        weights = np.repeat((np.maximum(1 - beside, 0.0) / np.maximum(observations.sigma[mine], 0.1)) ** 2, 2)[:, None]
        rows, slopes = jacobians[mine].reshape(-1, 6), _picture_jacobian(rig, camera, pixels)
        flat, gap = slopes.reshape(-1, PICTURE_DOF), left.ravel()
        posed, own = (rows * weights).T, (flat * weights).T
        parts[camera] = CameraEquations(own @ flat, own @ gap, posed @ rows, posed @ gap, own @ rows, slopes)
    return parts


def _picture_jacobian(rig: Rig, camera: int, pixels: Array) -> Array:
    """(N, 2, 4), how pixels (N, 2) move with shift (2), roll and scale about the camera's axis."""
    across, down = (pixels - rig.matrices[camera][:2, 2]).T
    zero, one = np.zeros_like(across), np.ones_like(across)
    return np.stack([np.stack([one, zero, -down, across], -1), np.stack([zero, one, across, down], -1)], 1)


def motion_sigmas(fit: PoseFit, expected: SurfacePose) -> float:
    """By how many sigmas a pose differs from the one expected by the motion, at least one."""
    off = se3.log(se3.inverse(expected.base_from_surface) @ fit.base_from_surface)
    damped = fit.information + (1e-9 * np.trace(fit.information) + 1e-12) * np.eye(6)  # without information: one
    spread = expected.covariance + np.linalg.inv(damped)
    return max(1.0, float(np.sqrt(off @ np.linalg.solve(spread, off) / 6)))


def picture_noise(fit: PoseFit, rows: Mask) -> float:
    """Root mean square, px, one sigma, by which a pose's noise moves the tracks `rows` (N,)."""
    damped = fit.information + (1e-9 * np.trace(fit.information) + 1e-12) * np.eye(6)
    jacobians = fit.jacobians[rows]
    return float(np.sqrt(np.einsum("nki,nki->", jacobians @ np.linalg.inv(damped), jacobians) / len(jacobians)))


def camera_numbers(cameras: Mask) -> frozenset[int]:
    """The numbers of the chosen ones of cameras (C,)."""
    return frozenset(np.flatnonzero(cameras).tolist())
