"""The warp of soft tissue: the residuals of a rigid fit to the warped map, as a few modes tracked by a Kalman filter.

Modes: a Gaussian process with a bell as covariance, known at a dozen control points, spans the smooth fields. Those
that move or turn the landmarks as a whole are taken out; of the rest the strongest are kept, orthonormal over the
landmarks: the length of a mode vector is the root mean square displacement in mm.

Filter, in information form (Thrun et al. 2005, 3.5), over two vectors of modes: the deformation, which wanders and
slowly decays, and the map's own smooth error, which stays. At the first frame set the deformation is zero: the surface
is as it was mapped. Its liveliness is learned from the residuals, less what chance may add, so that on a rigid surface
the deformation stays exactly zero.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from estimation import se3
from estimation.observations import Observations
from estimation.pose_solver import PoseFit
from estimation.runtime import compiled, contiguous
from estimation.se3 import Array, Index
from estimation.surface_map import SurfaceMap, Warp, bells, farthest_points

CONTROL_POINTS = 12
MODE_COUNT = 24  # of 3 * CONTROL_POINTS - 6: with 15 the error on tissue was twice as large, 30 gained nothing
BELL_OVERLAP = 1.5  # distances of neighbouring control points: bells that overlap this far add up to smooth fields
WELL_KNOWN_MM = 0.1  # better known landmarks all count alike
BELL_JITTER = 1e-6  # of a bell's height: keeps the covariance of near control points invertible

DECAY_S = 30.0  # some breaths, over which a deformation that is no longer seen is forgotten
RIGID_SHARE = 0.05  # of the greatest liveliness: below, it is over
LIVELINESS_MEMORY_S = 1.0  # over which the liveliness is learned
CHANCE_SIGMAS = 4.0  # standard errors that the liveliness must reach, else it is put down to chance
MODE_BIAS_MM = 0.01  # of a mode in one frame set, by patches that are not quite what they were
MAP_MODE_SIGMA_MM = 0.02  # no map is known better at the start, mode by mode
MIN_MODE_LANDMARKS = 12  # with fewer there are no modes


@dataclass(frozen=True, slots=True, eq=False)
class WarpModes:
    """M shapes that a deformation can take: smooth fields about K control points, none of them a rigid motion."""

    control: Array  # (K, 3) mm
    reach: float  # mm, one sigma of a bell
    fields: Array  # (3K, M) coefficients of each mode
    share: Array  # (M,) of the variance of a typical smooth field, sum 1
    landmarks: Array  # (N, 3, M) displacement of each landmark by each mode
    weights: Array  # (N,) how much each landmark counts, sum 1

    def modes_of(self, displacements: Array) -> Array:
        """The modes (M,) mm in displacements (N, 3) mm of the first N landmarks, which hold all that count."""
        count = len(displacements)
        return np.asarray(np.einsum("nim,n,ni->m", self.landmarks[:count], self.weights[:count], displacements))

    def extended(self, points: Array) -> WarpModes:
        """The same modes with further landmarks at `points` (N, 3): they are moved by them, but do not count."""
        further = _displacements(points, self.control, self.reach, self.fields)
        weights = np.concatenate([self.weights, np.zeros(len(points))])
        return replace(self, landmarks=np.concatenate([self.landmarks, further]), weights=weights)

    def warp(self, modes: Array, covariance: Array, liveliness: float) -> Warp:
        """The warp of a mode vector (M,) mm with covariance (M, M), which wanders by `liveliness`, mm^2/s in all."""
        size = float(np.linalg.norm(modes))
        along = modes / size if size else np.zeros(len(modes))
        sigma = float(np.sqrt(max(along @ covariance @ along if size else np.linalg.eigvalsh(covariance)[-1], 0.0)))
        coefficients = (self.fields @ modes).reshape(-1, 3)
        spread = self.fields @ covariance @ self.fields.T
        growth = liveliness * (self.fields * self.share) @ self.fields.T
        return Warp(self.control, coefficients, spread, growth, self.reach, size, sigma)


def modes_from_map(surface_map: SurfaceMap) -> WarpModes:
    """The modes of the surface that a map of twelve landmarks or more shows."""
    points = surface_map.points
    variances = np.diag(surface_map.covariance).reshape(-1, 3).mean(1)
    weights = 1 / np.maximum(variances, WELL_KNOWN_MM**2)
    weights = weights / weights.sum()
    best = points[weights >= np.median(weights)]  # the half that is known best
    first = int(np.argmin(np.linalg.norm(best - weights @ points, axis=1)))
    control = best[farthest_points(best, first, min(CONTROL_POINTS, len(best)))]
    distances = np.linalg.norm(control[:, None] - control, axis=-1) + np.diag(np.full(len(control), np.inf))
    reach = BELL_OVERLAP * float(distances.min(1).mean())
    kernel = bells(control, control, reach) + BELL_JITTER * np.eye(len(control))
    whiten = np.kron(np.linalg.inv(np.linalg.cholesky(kernel)).T, np.eye(3))  # coefficients of unit variance fields
    field = np.kron(bells(points, control, reach), np.eye(3)) @ whiten  # (3N, 3K)
    root = np.sqrt(np.repeat(weights, 3))[:, None]
    lever = se3.point_jacobians(points - weights @ points)
    rigid = (lever.reshape(-1, 6) * root).T @ (field * root)  # (6, 3K)
    non_rigid = np.linalg.svd(rigid)[2][6:].T  # (3K, 3K - 6)
    _, size, modes = np.linalg.svd(field * root @ non_rigid, full_matrices=False)
    fields = whiten @ non_rigid @ (modes[:MODE_COUNT] / size[:MODE_COUNT, None]).T
    landmarks = _displacements(points, control, reach, fields)
    share = size[:MODE_COUNT] ** 2
    return WarpModes(control, reach, fields, share / share.sum(), landmarks, weights)


def _displacements(points: Array, control: Array, reach: float, fields: Array) -> Array:
    """How far (N, 3, M) mm each mode, coefficients (3K, M), moves points (N, 3)."""
    return np.asarray((np.kron(bells(points, control, reach), np.eye(3)) @ fields).reshape(len(points), 3, -1))


class WarpFilter:
    """Follows the deformation of one surface."""

    def __init__(self, surface_map: SurfaceMap) -> None:
        self._points = surface_map.points
        sufficient = len(surface_map) >= 2 * MIN_MODE_LANDMARKS
        self._modes: WarpModes | None = modes_from_map(surface_map) if sufficient else None
        count = 0 if self._modes is None else len(self._modes.share)
        self._state = np.zeros(2 * count)  # deformation, and the map's error
        self._covariance = np.zeros((2 * count, 2 * count))
        if self._modes is not None:
            self._covariance[count:, count:] = _map_mode_covariance(self._modes, surface_map)
        self._stamp: float | None = None
        # liveliness of the last second, mm^2/s, signed, and the variance of one look at it
        self._rate = self._rate_variance = 0.0
        # how fast the square of the deformation grows by itself, mm^2/s; 0 on a rigid surface. A chest rests after each
        # breath and is as lively in the next one: only over some breaths is it forgotten
        self.liveliness = self._liveliest = 0.0
        self.warp: Warp | None = None  # the deformation at the last frame set; None while there is none

    def points(self, surface_map: SurfaceMap) -> Array:
        """The landmarks (N, 3) mm, surface frame, where the deformation puts them."""
        if self.warp is None or self._modes is None:
            return surface_map.points
        return np.asarray(surface_map.points + self._modes.landmarks @ self._state[: len(self._modes.share)])

    def pull(self, track: Index, weight: Array, jacobians: Array) -> Array:
        """Covariance (6, 6) that the deformation's covariance adds to the weighted sum of residuals.

        track: (N,) rows of the map. weight: (N,) px^-2. jacobians: (N, 2, 6) px per rad and mm.
        """
        if self.warp is None or self._modes is None:
            return np.zeros((6, 6))
        count, weighted = len(self._modes.share), jacobians * weight[:, None, None]
        by_modes = jacobians[:, :, 3:] @ self._modes.landmarks[track]  # (N, 2, M)
        sensitivity = np.einsum("nki,nkm->im", weighted, by_modes, optimize=True)
        return np.asarray(sensitivity @ self._covariance[:count, :count] @ sensitivity.T)

    def replace_map(self, surface_map: SurfaceMap, undeformed: bool = False) -> None:
        """Take a refined or longer map: the error or deformation that it has absorbed is subtracted from the state.

        undeformed: whether it shows the undeformed surface: then the whole change was the old map's error.
        """
        if self._modes is not None:
            count, before = len(self._modes.share), len(self._points)
            change = self._modes.modes_of(surface_map.points[:before] - self._points)
            if undeformed:
                # the map's error was `change`; the sum of both vectors was observed, so the rest was deformation
                total = self._state[:count] + self._state[count:]
                spread, prior = _sum_covariance(self._covariance, count), _map_mode_covariance(self._modes, surface_map)
                self._state = np.concatenate([total - change, change])
                self._covariance = np.block([[spread + prior, -prior], [-prior, prior]])
            self._state[count:] -= change
            if len(surface_map) > before:
                self._modes = self._modes.extended(surface_map.points[before:])
        self._points = surface_map.points

    def learn(self, observations: Observations, fit: PoseFit, sigma: Array, twist: Array, skew: float) -> None:
        """Take the residuals of a fit to `points`. sigma: (N,) px.

        twist: (6,). skew: s, by which the cameras' instants may differ: what a late camera explains is no deformation.
        """
        dt = 0.0 if self._stamp is None else observations.stamp - self._stamp
        self._stamp = observations.stamp
        if self._modes is None or dt <= 0:
            return
        information, gradient = _mode_evidence(self._modes, observations, fit, sigma, twist, skew, self._state)
        self._predict(dt, information, gradient)
        # Kalman update by information and gradient on the sum of both vectors, about the predicted one
        count = len(self._modes.share)
        across = self._covariance[:, :count] + self._covariance[:, count:]  # (2M, M)
        gain = across @ np.linalg.inv(np.eye(count) + information @ _sum_covariance(self._covariance, count))
        self._state = self._state + gain @ gradient
        covariance = self._covariance - gain @ information @ across.T
        self._covariance = (covariance + covariance.T) / 2
        if self.liveliness > 0 or self.warp is not None:
            self.warp = self._modes.warp(self._state[:count], self._covariance[:count, :count], self.liveliness)

    def _predict(self, dt: float, information: Array, gradient: Array) -> None:
        """Let the deformation wander for dt s, with the liveliness learned from this frame set too."""
        assert self._modes is not None
        count, share = len(self._modes.share), self._modes.share
        keep = np.concatenate([np.full(count, np.exp(-dt / DECAY_S)), np.ones(count)])
        self._covariance = keep[:, None] * self._covariance * keep
        prior = _sum_covariance(self._covariance, count)
        weighted = share[:, None] * information
        curvature = float(np.einsum("ij,ji->", weighted, weighted))
        expected = float(np.trace(weighted) + np.einsum("ij,ji->", weighted @ prior, information))
        recent = min(1.0, dt / LIVELINESS_MEMORY_S)
        if curvature > 0:
            rate = (float(gradient @ (share * gradient)) - expected) / (curvature * dt)
            self._rate += recent * (rate - self._rate)
            self._rate_variance = recent / (curvature * dt**2)
            significant = self._rate if self._rate > CHANCE_SIGMAS * float(np.sqrt(self._rate_variance)) else 0.0
            current = max(significant, self.liveliness * float(np.exp(-dt / DECAY_S)))
            self._liveliest = max(self._liveliest, current)
            self.liveliness = current if current > RIGID_SHARE * self._liveliest else 0.0
        wander = self.liveliness * dt * share
        self._covariance[:count, :count] += np.diag(wander)
        self._state = keep * self._state


def _map_mode_covariance(modes: WarpModes, surface_map: SurfaceMap) -> Array:
    """Covariance (M, M), mm^2, of the modes in a map's error."""
    entries = 3 * len(modes.weights)
    fields = (modes.landmarks * modes.weights[:, None, None]).reshape(entries, -1)
    joint = fields.T @ surface_map.covariance[:entries, :entries] @ fields
    return np.asarray(joint + MAP_MODE_SIGMA_MM**2 * np.eye(len(modes.share)))


def _sum_covariance(covariance: Array, count: int) -> Array:
    """Covariance (M, M) of the sum of both vectors, from the joint one (2M, 2M)."""
    a, b = covariance[:count], covariance[count:]
    return np.asarray(a[:, :count] + a[:, count:] + b[:, :count] + b[:, count:])


def _mode_evidence(
    modes: WarpModes, observations: Observations, fit: PoseFit, sigma: Array, twist: Array, skew: float, state: Array
) -> tuple[Array, Array]:
    """Information (M, M) and gradient (M,) of both vectors' sum about the predicted one, pose and delays solved for."""
    count, cameras = len(modes.share), int(observations.camera.max()) + 1
    root = np.sqrt(fit.weights) / (sigma * fit.scale)
    row = contiguous(observations.track, np.int64)
    camera = contiguous(observations.camera, np.int64)
    geometry = contiguous(fit.jacobians), contiguous(fit.residuals)
    # the fit's points hold the deformation, but not the map's error
    fields = contiguous(modes.landmarks)
    rows = rows_of_modes(camera, row, *geometry, root, fields, state[count:].copy(), twist)
    normal = rows.T @ rows
    of_modes, nuisance = slice(0, count), slice(count, count + 6 + cameras)
    damped = normal[nuisance, nuisance] + np.diag([1e-9] * 6 + [1 / max(skew, 1e-4) ** 2] * cameras)
    solved = np.linalg.solve(damped, np.concatenate([normal[nuisance, of_modes], normal[nuisance, -1:]], 1))
    information = normal[of_modes, of_modes] - normal[of_modes, nuisance] @ solved[:, :-1]
    gradient = normal[of_modes, -1] - normal[of_modes, nuisance] @ solved[:, -1]
    bias_gain = np.linalg.inv(np.eye(count) + MODE_BIAS_MM**2 * information)
    information = bias_gain @ information
    return np.asarray((information + information.T) / 2), np.asarray(bias_gain @ gradient)


@compiled("f8[:,::1](i8[::1], i8[::1], f8[:,:,::1], f8[:,::1], f8[::1], f8[:,:,::1], f8[::1], f8[::1])")
def rows_of_modes(
    camera: Index, track: Index, jacobian: Array, residual: Array, root: Array, modes: Array, error: Array, twist: Array
) -> Array:
    """Rows (2N, M + 6 + C + 1) of the regression on modes, pose and delays, each times its track's `root` (N,), px^-1.

    modes: (L, 3, M) mm of each landmark, rows `track` (N,). error: (M,), modes that the residuals (N, 2) px hold and
    the points do not. The last column is what is left. The rest as in `camera_grams`.
    """
    cameras = camera.max() + 1
    count = modes.shape[2]
    rows = np.zeros((2 * len(camera), count + 7 + cameras))
    for i in range(len(camera)):
        shapes = modes[track[i]]
        for k in range(2):
            row, along, gap = rows[2 * i + k], 0.0, -residual[i, k]
            for m in range(count):
                shift = 0.0
                for a in range(3):
                    shift += jacobian[i, k, 3 + a] * shapes[a, m]
                row[m] = root[i] * shift
                gap -= shift * error[m]
            for a in range(6):
                row[count + a] = root[i] * jacobian[i, k, a]
                along += jacobian[i, k, a] * twist[a]
            row[count + 6 + camera[i]] = root[i] * along
            row[count + 6 + cameras] = root[i] * gap
    return rows


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
        row, weight = landmark[i], precision[i]
        views[row] += weight > 0
        for k in range(2):
            gap = -residual[i, k]
            square[row] += weight * gap * gap
            for a in range(3):
                scaled = weight * jacobian[i, k, 3 + a]
                right[row, a] += scaled * gap
                for b in range(3):
                    normal[row, a, b] += scaled * jacobian[i, k, 3 + b]
    return normal, right, square, views


@compiled("Tuple((f8[:,:,::1], f8[:,:,::1]))(i8, i8, i8[::1], i8[::1], f8[:,:,::1], f8[::1], f8[::1])")
def pose_pulls(
    cameras: int, landmarks: int, camera: Index, landmark: Index, jacobian: Array, weight: Array, twist: Array
) -> tuple[Array, Array]:
    """How each landmark (6, L, 3), px^-2 per mm, and each camera's delay and shifts (6, 3, C) pull at the pose.

    The pose gives way by its covariance times that. landmark: (N,) below L. The rest as in `camera_grams`.
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


def own_residuals(camera: Index, fit: PoseFit, weights: Array) -> Array:
    """Residuals (N, 2) px that are left when each camera has a pose of its own, to first order.

    weights: (N,) weights of the tracks that determine it. Cameras with fewer than eight keep their residuals.
    """
    residuals = fit.residuals.copy()
    for c in np.unique(camera):
        rows = camera == c
        root = np.sqrt(np.repeat(weights[rows], 2))
        if np.count_nonzero(root) >= 16:
            jacobian, residual = fit.jacobians[rows].reshape(-1, 6), fit.residuals[rows].ravel()
            step = np.linalg.lstsq(jacobian * root[:, None], residual * root, rcond=None)[0]
            residuals[rows] = (residual - jacobian @ step).reshape(-1, 2)
    return residuals


@compiled("f8[::1](f8[:,:,::1], f8[::1])")
def squared_speeds(jacobian: Array, twist: Array) -> Array:
    """Squared velocities (N,), px^2/s^2, of tracks by their Jacobians (N, 2, 6) and a twist (6,)."""
    squares = np.zeros(len(jacobian))
    for i in range(len(jacobian)):
        for k in range(2):
            along = 0.0
            for a in range(6):
                along += jacobian[i, k, a] * twist[a]
            squares[i] += along * along
    return squares


@compiled("Tuple((f8[::1], f8[::1]))(i8, i8[::1], f8[:,::1], f8[::1], f8)")
def camera_medians(cameras: int, camera: Index, residual: Array, sigma: Array, tracks: float) -> tuple[Array, Array]:
    """Upper medians (C,) of each camera's residuals' (N, 2) lengths and sigmas (N,); nan of fewer than `tracks`."""
    lengths, sigmas, columns = np.full(cameras, np.nan), np.full(cameras, np.nan), np.empty((2, len(camera)))
    for c in range(cameras):
        count = 0
        for i in range(len(camera)):
            if camera[i] == c:
                columns[0, count] = np.sqrt(residual[i, 0] * residual[i, 0] + residual[i, 1] * residual[i, 1])
                columns[1, count] = sigma[i]
                count += 1
        if count >= tracks:
            ordered = np.sort(columns[0, :count])  # nan comes last, and leaves nothing known
            lengths[c] = ordered[-1] if np.isnan(ordered[-1]) else ordered[count // 2]
            sigmas[c] = np.sort(columns[1, :count])[count // 2]
    return lengths, sigmas
