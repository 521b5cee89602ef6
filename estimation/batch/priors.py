"""The unknowns of a recording, states and cameras, with their priors.

A state is a pose, its body twist and its acceleration: 18 numbers of right perturbations. Between two states stands a
Gaussian process whose third derivative is white noise, in the tangent space of each pose (Tang, Yoon and Barfoot, IEEE
RA-L 4:594, 2019; Barfoot 2017, 11.1 and 3.4). A chest is far smoother than white noise on acceleration, the only such
prior that GTSAM ships: at 30 Hz that averages a breathing axis over less than two frame sets, this one over five.

The cameras' clocks, places and lenses have their calibration as prior.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from estimation import se3
from estimation.rig import Rig
from estimation.se3 import Array, Index

COMMON_CLOCK_SIGMA_S = 1e-6  # what all clocks have in common cannot be seen; their mean is the reference
LENS_DOF = 4  # fx fy cx cy
STATE_DOF = 18  # of a pose, its twist and its acceleration


@dataclass(frozen=True, slots=True)
class CalibrationPrior:
    """What of the cameras the recording may correct: one standard deviation each, 0 to keep it.

    The distortion is kept always, since observations are undistorted already.
    """

    clock: float = 0.02  # s, of a camera's instant from its stamp: webcams were seen 10 to 60 ms apart
    turn: float = 0.0  # rad, of a camera's place
    shift: float = 0.0  # mm, of a camera's place
    focal: float = 0.0  # px
    centre: float = 0.0  # px


REFINED_PRIOR = CalibrationPrior(turn=1e-3, shift=0.3, focal=1.5, centre=1.5)  # what a calibration with a board leaves


@dataclass(frozen=True, slots=True, eq=False)
class CorrectedCameras:
    """C cameras as far as a recording corrects them."""

    base_from_camera: Array  # (C, 4, 4) mm
    matrices: Array  # (C, 3, 3) px
    offsets: Array  # (C,) s, later than stamped

    def __len__(self) -> int:
        return len(self.offsets)

    def moved(self, step: Array) -> CorrectedCameras:
        """The same after a step (11 C,): offsets, places, lenses."""
        n = len(self)
        lens = step[7 * n :].reshape(n, LENS_DOF)
        matrices = self.matrices.copy()
        matrices[:, [0, 1, 0, 1], [0, 1, 2, 2]] += lens
        places = self.base_from_camera @ se3.exp(step[n : 7 * n].reshape(n, 6))
        return CorrectedCameras(places, matrices, self.offsets + step[:n])

    def since(self, before: CorrectedCameras) -> Array:
        """The step (11 C,) that made these of those `before`."""
        places = se3.log(se3.inverse(before.base_from_camera) @ self.base_from_camera)
        lens = (self.matrices - before.matrices)[:, [0, 1, 0, 1], [0, 1, 2, 2]]
        return np.concatenate([self.offsets - before.offsets, places.ravel(), lens.ravel()])

    def rig(self, rig: Rig) -> Rig:
        """The rig with these corrections."""
        parts = zip(rig.cameras, self.matrices, self.base_from_camera, (float(s) for s in self.offsets), strict=True)
        return Rig(
            tuple(
                replace(camera, matrix=matrix, base_from_camera=place, clock_offset=camera.clock_offset + offset)
                for camera, matrix, place, offset in parts
            )
        )


def cameras_of(rig: Rig) -> CorrectedCameras:
    """The cameras as they were calibrated, each exposed when it is stamped."""
    places = np.stack([camera.base_from_camera for camera in rig.cameras])
    return CorrectedCameras(places, rig.matrices.copy(), np.zeros(len(rig)))


def correction_sigmas(prior: CalibrationPrior, cameras: int) -> Array:
    """(11 C,) standard deviations of `CorrectedCameras.moved`'s step, 0 for what is held."""
    place = [prior.turn] * 3 + [prior.shift] * 3
    lens = [prior.focal] * 2 + [prior.centre] * 2
    return np.array([prior.clock] * cameras + place * cameras + lens * cameras)


def prior_information(sigma: Array, cameras: int) -> Array:
    """(11 C, 11 C) information of that step about the calibration; of what is held, zero."""
    known = np.divide(1.0, sigma**2, out=np.zeros_like(sigma), where=sigma > 0)
    out = np.diag(known)
    out[:cameras, :cameras] += np.where(sigma[0] > 0, 1 / (COMMON_CLOCK_SIGMA_S * cameras) ** 2, 0.0)
    return out


@dataclass(frozen=True, slots=True, eq=False)
class States:
    """K states."""

    poses: Array  # (K, 4, 4) base_from_surface
    twists: Array  # (K, 6) rad/s, mm/s
    accelerations: Array  # (K, 6) rad/s^2, mm/s^2

    def __len__(self) -> int:
        return len(self.poses)

    def __getitem__(self, rows: slice | Index) -> States:
        """Some of them."""
        return States(self.poses[rows], self.twists[rows], self.accelerations[rows])

    def moved(self, step: Array) -> States:
        """The same after a step (K, 18)."""
        return States(self.poses @ se3.exp(step[:, :6]), self.twists + step[:, 6:12], self.accelerations + step[:, 12:])


@dataclass(frozen=True, slots=True, eq=False)
class PriorFactors:
    """The prior between neighbours, linearised: off + before @ step[k] + after @ step[k + 1]."""

    off: Array  # (K - 1, 18)
    before: Array  # (K - 1, 18, 18)
    after: Array  # (K - 1, 18, 18)
    spread: Array  # (K - 1, 3, 3) its covariance, of each axis, per unit of density

    def information(self, psd: Array) -> Array:
        """Inverse covariances (K - 1, 18, 18) for densities (K - 1, 6), rad^2/s^5 and mm^2/s^5."""
        inverse = np.linalg.inv(self.spread)  # (K - 1, 3, 3)
        out = np.zeros((len(psd), 3, 6, 3, 6))
        each = np.arange(6)
        out[:, :, each, :, each] = inverse[None] / psd.T[:, :, None, None]  # axes first, by numpy's rule
        return out.reshape(-1, STATE_DOF, STATE_DOF)


def small_adjoint(xi: Array) -> Array:
    """ad (..., 6, 6) of tangent vectors (..., 6): ad(x) @ y is their Lie bracket."""
    out = np.zeros((*xi.shape, 6))
    out[..., :3, :3] = out[..., 3:, 3:] = se3.hat(xi[..., :3])
    out[..., 3:, :3] = se3.hat(xi[..., 3:])
    return out


def right_jacobian(xi: Array) -> Array:
    """(..., 6, 6): exp(xi + d) = exp(xi) exp(J d), to third order: enough for what a surface moves in a delay."""
    ad = small_adjoint(xi)
    return np.asarray(np.eye(6) - ad / 2 + ad @ ad / 6 - ad @ ad @ ad / 24)


def inverse_right_jacobian(xi: Array) -> Array:
    """(..., 6, 6), the inverse of it, by its Bernoulli series: exact to 1e-7 up to half a radian."""
    ad = small_adjoint(xi)
    square = ad @ ad
    return np.asarray(np.eye(6) + ad / 2 + square / 12 - square @ square / 720 + square @ square @ square / 30240)


def transition(seconds: Array) -> Array:
    """(..., 3, 3) of position, velocity and acceleration of an axis over seconds (...)."""
    t = np.asarray(seconds, float)
    out = np.zeros((*t.shape, 3, 3))
    out[...] = np.eye(3)
    out[..., 0, 1] = out[..., 1, 2] = t
    out[..., 0, 2] = t**2 / 2
    return out


def jerk_covariance(seconds: Array) -> Array:
    """Covariance (..., 3, 3) that a unit density of white jerk adds over seconds (...)."""
    t = np.asarray(seconds, float)
    out = np.zeros((*t.shape, 3, 3))
    out[..., 0, 0], out[..., 1, 1], out[..., 2, 2] = t**5 / 20, t**3 / 3, t
    out[..., 0, 1] = out[..., 1, 0] = t**4 / 8
    out[..., 0, 2] = out[..., 2, 0] = t**3 / 6
    out[..., 1, 2] = out[..., 2, 1] = t**2 / 2
    return out


def in_tangent_space(before: States, after: States) -> tuple[Array, Array]:
    """The later states (M, 18) in the tangent spaces of the earlier ones, and the moves (M, 6) between the poses."""
    moved = se3.log(se3.inverse(before.poses) @ after.poses)
    bent = np.eye(6) + small_adjoint(moved) / 2
    velocity = (bent @ after.twists[..., None])[..., 0]
    acceleration = (bent @ after.accelerations[..., None])[..., 0]
    return np.concatenate([moved, velocity, acceleration], axis=-1), moved


def prior_factors(states: States, stamps: Array) -> PriorFactors:
    """The prior at `states`, with exact derivatives; stamps: (K,) s."""
    seconds = np.diff(stamps)
    ends = slice(None, -1), slice(1, None)
    before, after = (states[end] for end in ends)
    there, moved = in_tangent_space(before, after)
    here = np.concatenate([np.zeros_like(moved), before.twists, before.accelerations], axis=-1)
    forward = np.asarray(np.kron(transition(seconds), np.eye(6)), float)
    by_after, by_before = inverse_right_jacobian(moved), -inverse_right_jacobian(-moved)
    bent = np.eye(6) + small_adjoint(moved) / 2
    later, earlier = np.zeros((len(moved), STATE_DOF, STATE_DOF)), -forward
    later[:, :6, :6], later[:, 6:12, 6:12], later[:, 12:, 12:] = by_after, bent, bent
    earlier[:, :6, :6] = by_before
    for rows, rate in ((slice(6, 12), after.twists), (slice(12, 18), after.accelerations)):
        turned = -small_adjoint(rate) / 2  # of the move
        later[:, rows, :6], earlier[:, rows, :6] = turned @ by_after, turned @ by_before
    off = there - (forward @ here[..., None])[..., 0]
    return PriorFactors(np.asarray(off), earlier, later, jerk_covariance(seconds))
