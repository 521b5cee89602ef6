"""States and cameras of a recording, their priors, and the smoothed result, which gives the surface at any instant.

A state is a pose, its body twist and its acceleration: 18 numbers of right perturbations. Between two states stands a
Gaussian process whose third derivative is white noise, in the tangent space of each pose (Tang, Yoon and Barfoot, IEEE
RA-L 4:594, 2019; Barfoot 2017, 11.1 and 3.4). A chest is smoother than white noise on acceleration, the only such prior
that GTSAM ships: at 30 Hz that averages a breathing axis over less than two frame sets, this one over five.

The prior of the cameras' clocks, poses and lenses is their calibration.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from estimation import se3
from estimation.errors import InputError
from estimation.pose import Trajectory
from estimation.rig import Rig
from estimation.se3 import Array, Index, Mask
from estimation.surface_map import SurfaceMap

COMMON_CLOCK_SIGMA_S = 1e-6  # of the clocks' mean, which is the reference, as only differences are observable
LENS_DOF = 4  # fx fy cx cy
STATE_DOF = 18  # of a pose, its twist and its acceleration
TIMES_PER_CHUNK = 4096  # interpolated at once


@dataclass(frozen=True, slots=True)
class CalibrationPrior:
    """Corrections of the cameras by a recording, one sigma each; 0: fixed. Distortion is always fixed."""

    clock: float = 0.02  # s, of a camera's exposure from its stamp: webcams were measured 10 to 60 ms apart
    turn: float = 0.0  # rad, of a camera's pose
    shift: float = 0.0  # mm, of a camera's pose
    focal: float = 0.0  # px
    centre: float = 0.0  # px


REFINED_PRIOR = CalibrationPrior(turn=1e-3, shift=0.3, focal=1.5, centre=1.5)  # errors of a calibration with a board


@dataclass(frozen=True, slots=True, eq=False)
class CorrectedCameras:
    """The parameters of C cameras that a recording may correct."""

    base_from_camera: Array  # (C, 4, 4) mm
    matrices: Array  # (C, 3, 3) px
    offsets: Array  # (C,) s, of the exposures after their stamps

    def __len__(self) -> int:
        return len(self.offsets)

    def retract(self, step: Array) -> CorrectedCameras:
        """The cameras after a step (11 C,): offsets, poses (right perturbations), lenses."""
        count = len(self)
        lens_steps = step[7 * count :].reshape(count, LENS_DOF)
        matrices = self.matrices.copy()
        matrices[:, [0, 1, 0, 1], [0, 1, 2, 2]] += lens_steps
        poses = self.base_from_camera @ se3.exp(step[count : 7 * count].reshape(count, 6))
        return CorrectedCameras(poses, matrices, self.offsets + step[:count])

    def difference(self, before: CorrectedCameras) -> Array:
        """The step (11 C,) from the cameras `before` to these."""
        pose_steps = se3.log(se3.inverse(before.base_from_camera) @ self.base_from_camera)
        lens_steps = (self.matrices - before.matrices)[:, [0, 1, 0, 1], [0, 1, 2, 2]]
        return np.concatenate([self.offsets - before.offsets, pose_steps.ravel(), lens_steps.ravel()])

    def rig(self, rig: Rig) -> Rig:
        """The rig with these corrections."""
        rows = zip(rig.cameras, self.matrices, self.base_from_camera, (float(s) for s in self.offsets), strict=True)
        return Rig(
            tuple(replace(c, matrix=m, base_from_camera=p, clock_offset=c.clock_offset + s) for c, m, p, s in rows)
        )


def cameras_from_rig(rig: Rig) -> CorrectedCameras:
    """The cameras as calibrated, with exposures at their stamps."""
    places = np.stack([camera.base_from_camera for camera in rig.cameras])
    return CorrectedCameras(places, rig.matrices.copy(), np.zeros(len(rig)))


def correction_sigmas(prior: CalibrationPrior, cameras: int) -> Array:
    """Standard deviations (11 C,) of `CorrectedCameras.retract`'s step; 0: fixed."""
    place = [prior.turn] * 3 + [prior.shift] * 3
    lens = [prior.focal] * 2 + [prior.centre] * 2
    return np.array([prior.clock] * cameras + place * cameras + lens * cameras)


def prior_information(sigma: Array, has_tracks: Mask) -> Array:
    """Prior information (11 C, 11 C) of that step; zero for fixed parameters.

    has_tracks: (C,) cameras with tracks. The clocks' reference is their mean: with a blind camera in it, the others
    could drift together.
    """
    precision = np.divide(1.0, sigma**2, out=np.zeros_like(sigma), where=sigma > 0)
    out, cameras = np.diag(precision), len(has_tracks)
    common = np.where(sigma[0] > 0, 1 / (COMMON_CLOCK_SIGMA_S * max(int(has_tracks.sum()), 1)) ** 2, 0.0)
    out[:cameras, :cameras] += common * np.outer(has_tracks, has_tracks)
    return out


@dataclass(frozen=True, slots=True, eq=False)
class States:
    """K states of the surface."""

    poses: Array  # (K, 4, 4) base_from_surface
    twists: Array  # (K, 6) rad/s, mm/s
    accelerations: Array  # (K, 6) rad/s^2, mm/s^2

    def __len__(self) -> int:
        return len(self.poses)

    def __getitem__(self, rows: slice | Index) -> States:
        return States(self.poses[rows], self.twists[rows], self.accelerations[rows])

    def retract(self, step: Array) -> States:
        """The states after a step (K, 18)."""
        return States(self.poses @ se3.exp(step[:, :6]), self.twists + step[:, 6:12], self.accelerations + step[:, 12:])


@dataclass(frozen=True, slots=True, eq=False)
class PriorFactors:
    """The prior between neighbours, linearised: residual + before @ step[k] + after @ step[k + 1]."""

    residual: Array  # (K - 1, 18)
    before: Array  # (K - 1, 18, 18)
    after: Array  # (K - 1, 18, 18)
    spread: Array  # (K - 1, 3, 3) covariance of an axis per unit of density

    def information(self, psd: Array) -> Array:
        """Inverse covariances (K - 1, 18, 18) for densities (K - 1, 6), rad^2/s^5 and mm^2/s^5."""
        inverse = np.linalg.inv(self.spread)  # (K - 1, 3, 3)
        out = np.zeros((len(psd), 3, 6, 3, 6))
        each = np.arange(6)
        out[:, :, each, :, each] = inverse[None] / psd.T[:, :, None, None]  # axes first, by numpy's rule
        return out.reshape(-1, STATE_DOF, STATE_DOF)


def transition(seconds: Array) -> Array:
    """Transition (..., 3, 3) of an axis's position, velocity and acceleration over seconds (...)."""
    t = np.asarray(seconds, float)
    out = np.zeros((*t.shape, 3, 3))
    out[...] = np.eye(3)
    out[..., 0, 1] = out[..., 1, 2] = t
    out[..., 0, 2] = t**2 / 2
    return out


def jerk_covariance(seconds: Array) -> Array:
    """Process noise (..., 3, 3) of an axis over seconds (...), for white jerk of unit density."""
    t = np.asarray(seconds, float)
    out = np.zeros((*t.shape, 3, 3))
    out[..., 0, 0], out[..., 1, 1], out[..., 2, 2] = t**5 / 20, t**3 / 3, t
    out[..., 0, 1] = out[..., 1, 0] = t**4 / 8
    out[..., 0, 2] = out[..., 2, 0] = t**3 / 6
    out[..., 1, 2] = out[..., 2, 1] = t**2 / 2
    return out


def to_tangent_space(before: States, after: States) -> tuple[Array, Array]:
    """Later states (M, 18) in the tangent spaces of the earlier ones, and the increments (M, 6) between the poses."""
    steps = se3.log(se3.inverse(before.poses) @ after.poses)
    inverse_jacobian = np.eye(6) + se3.small_adjoint(steps) / 2
    velocity = (inverse_jacobian @ after.twists[..., None])[..., 0]
    acceleration = (inverse_jacobian @ after.accelerations[..., None])[..., 0]
    return np.concatenate([steps, velocity, acceleration], axis=-1), steps


def prior_factors(states: States, stamps: Array) -> PriorFactors:
    """The prior at `states`, with exact derivatives; stamps: (K,) s."""
    seconds, before, after = np.diff(stamps), states[:-1], states[1:]
    next_state, steps = to_tangent_space(before, after)
    state = np.concatenate([np.zeros_like(steps), before.twists, before.accelerations], axis=-1)
    forward = np.asarray(np.kron(transition(seconds), np.eye(6)), float)
    by_after, by_before = se3.inverse_right_jacobian(steps), -se3.inverse_right_jacobian(-steps)
    inverse_jacobian = np.eye(6) + se3.small_adjoint(steps) / 2
    next_jacobian, jacobian = np.zeros((len(steps), STATE_DOF, STATE_DOF)), -forward
    next_jacobian[:, :6, :6] = by_after
    next_jacobian[:, 6:12, 6:12] = next_jacobian[:, 12:, 12:] = inverse_jacobian
    jacobian[:, :6, :6] = by_before
    for rows, rate in ((slice(6, 12), after.twists), (slice(12, 18), after.accelerations)):
        by_step = -se3.small_adjoint(rate) / 2  # derivative by the increment
        next_jacobian[:, rows, :6], jacobian[:, rows, :6] = by_step @ by_after, by_step @ by_before
    residual = next_state - (forward @ state[..., None])[..., 0]
    return PriorFactors(np.asarray(residual), jacobian, next_jacobian, jerk_covariance(seconds))


@dataclass(frozen=True, slots=True, eq=False)
class SampledStates:
    """Poses and twists of the surface at M times."""

    stamps: Array  # (M,) s
    base_from_surface: Array  # (M, 4, 4) mm
    covariance: Array  # (M, 6, 6) of its right perturbation
    twist: Array  # (M, 6) rad/s and mm/s
    twist_covariance: Array  # (M, 6, 6)


@dataclass(frozen=True, slots=True, eq=False)
class FitStatistics:
    """Residuals and noise of the result."""

    used: Index  # (K, C) inliers
    observed: Index  # (K, C) all tracks
    rms: Array  # (K, C) px, of the inliers; nan without any
    residual_scale: Array  # (C,) size of the residuals in their stated sigmas
    delay_sigma: float  # s, of a camera's delay in one frame set
    shift_sigma: float  # px, of an image's shift in one frame set
    cost: float  # robust, half of squared sigmas
    passes: int  # over all frame sets
    last_step: float  # of cameras and landmarks, in sigmas
    converged: bool  # whether that is small enough


@dataclass(frozen=True, slots=True, eq=False)
class Smoothed:
    """The estimate from a whole recording: K states, L landmarks, C cameras."""

    stamps: Array  # (K,) s
    states: States  # poses base_from_surface, twists and accelerations
    state_covariance: Array  # (K, 18, 18) of the states, by the tracks' noise
    next_covariance: Array  # (K - 1, 18, 18) of each state with the next, likewise
    shared_covariance: Array  # (K, 18, 18) of the states, by the errors of landmarks and cameras
    psd: Array  # (K - 1, 6) density of the jerk, rad^2/s^5 and mm^2/s^5
    map: SurfaceMap  # in the surface frame
    tracks: Index  # (L,) id of each landmark's track
    rig: Rig  # corrected, clock offsets included
    calibrated_rig: Rig  # as given
    offsets: Array  # (C,) s, of the exposures after their stamps, less their mean over cameras with tracks
    offset_covariance: Array  # (C, C) s^2
    statistics: FitStatistics

    def __len__(self) -> int:
        return len(self.stamps)

    @property
    def covariance(self) -> Array:
        """(K, 18, 18) of the states."""
        return self.state_covariance + self.shared_covariance

    @property
    def offset_sigma(self) -> Array:
        """(C,) s, one standard deviation of each offset."""
        return np.asarray(np.sqrt(np.diag(self.offset_covariance)))

    @property
    def trajectory(self) -> Trajectory:
        """The poses at the stamps."""
        return Trajectory(self.stamps, self.states.poses, exact=False)

    @property
    def states_at_stamps(self) -> SampledStates:
        """The states at the stamps."""
        covariance, poses, twists = self.covariance, self.states.poses, self.states.twists
        return SampledStates(self.stamps, poses, covariance[:, :6, :6], twists, covariance[:, 6:12, 6:12])

    def sample_times(self, rate: float) -> Array:
        """Times (M,), s, 1 / rate apart, from the first stamp to before the last one.

        Not `np.arange(first, last, step)`: its step is a difference of two large stamps, so that its last time may lie
        beyond the recording after a few minutes of uptime.
        """
        first, last = self.stamps[[0, -1]]
        times = first + np.arange(np.ceil((last - first) * rate) + 1) / rate
        return np.asarray(times[times < last])

    def at(self, times: Array) -> SampledStates:
        """The states at times (M,), s, within the recording, by the continuous-time prior (Barfoot 2017, 11.3).

        Pose, twist and covariances between two states are those of the Gaussian process given both. The part of the
        covariance by landmarks and cameras is interpolated linearly.
        """
        times = np.asarray(times, float)
        if len(times) and not (self.stamps[0] <= times.min() and times.max() <= self.stamps[-1]):
            span = f"{self.stamps[0]} .. {self.stamps[-1]} s, the recording's own"
            raise InputError("times", "s", f"{times.min()} .. {times.max()}", span)
        parts = [self._interpolate(times[i : i + TIMES_PER_CHUNK]) for i in range(0, len(times), TIMES_PER_CHUNK)]
        names = ("base_from_surface", "covariance", "twist", "twist_covariance")
        return SampledStates(times, *(np.concatenate([getattr(part, name) for part in parts]) for name in names))

    def _interpolate(self, times: Array) -> SampledStates:
        k = np.clip(np.searchsorted(self.stamps, times, side="right") - 1, 0, len(self) - 2)
        elapsed, interval = times - self.stamps[k], self.stamps[k + 1] - self.stamps[k]
        by_before, by_after, conditional = _interpolation_weights(elapsed, interval)
        before, after = self.states[k], self.states[k + 1]
        next_state, steps = to_tangent_space(before, after)
        state = np.concatenate([np.zeros((len(k), 6)), before.twists, before.accelerations], axis=-1)
        state_weight, next_weight = (np.kron(weights, np.eye(6)) for weights in (by_before, by_after))
        interpolated = (state_weight @ state[..., None] + next_weight @ next_state[..., None])[..., 0]
        # (M, 18, 18) derivative of the later state in the earlier one's tangent space
        next_jacobian = np.zeros((len(steps), STATE_DOF, STATE_DOF))
        next_jacobian[:, :6, :6] = se3.inverse_right_jacobian(steps)
        next_jacobian[:, 6:12, 6:12] = next_jacobian[:, 12:, 12:] = np.eye(6) + se3.small_adjoint(steps) / 2
        next_weight = next_weight @ next_jacobian
        cross = state_weight @ self.next_covariance[k] @ np.swapaxes(next_weight, 1, 2)
        covariance = state_weight @ self.state_covariance[k] @ np.swapaxes(state_weight, 1, 2)
        covariance = covariance + cross + np.swapaxes(cross, 1, 2)
        covariance = covariance + next_weight @ self.state_covariance[k + 1] @ np.swapaxes(next_weight, 1, 2)
        noise = np.einsum("mij,ma,ab->miajb", conditional, self.psd[k], np.eye(6)).reshape(-1, STATE_DOF, STATE_DOF)
        right_jacobian = se3.right_jacobian(interpolated[:, :6])
        transposed = np.swapaxes(right_jacobian, 1, 2)
        fraction = (elapsed / interval)[:, None, None]
        shared = (1 - fraction) * self.shared_covariance[k] + fraction * self.shared_covariance[k + 1]
        covariance = covariance + noise
        return SampledStates(
            times,
            before.poses @ se3.exp(interpolated[:, :6]),
            right_jacobian @ covariance[:, :6, :6] @ transposed + shared[:, :6, :6],
            (right_jacobian @ interpolated[:, 6:12, None])[..., 0],
            right_jacobian @ covariance[:, 6:12, 6:12] @ transposed + shared[:, 6:12, 6:12],
        )


def _interpolation_weights(elapsed: Array, interval: Array) -> tuple[Array, Array, Array]:
    """Weights of the states before and after, `elapsed` s of `interval` s, and conditional covariance: (M, 3, 3)."""
    rest = np.swapaxes(transition(interval - elapsed), 1, 2)
    after = jerk_covariance(elapsed) @ rest @ np.linalg.inv(jerk_covariance(interval))
    before = transition(elapsed) - after @ transition(interval)
    return before, after, jerk_covariance(elapsed) - after @ np.swapaxes(rest, 1, 2) @ jerk_covariance(elapsed)
