"""The continuous-time prior between poses: white noise on jerk, in the tangent space of each pose.

A state is a pose, its body twist and its acceleration, 18 numbers of right perturbations. Between two of them stands a
Gaussian process whose third derivative is white noise (Tang, Yoon and Barfoot, IEEE RA-L 4:594, 2019; Barfoot 2017,
11.1 and 3.4). A chest is far smoother than white noise on acceleration, the only such prior that GTSAM ships: at 30 Hz
that one averages a breathing axis over less than two frame sets, this one over five.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from estimation import se3
from estimation.se3 import Array

STATE = 18  # of a pose, its twist and its acceleration


@dataclass(frozen=True, slots=True, eq=False)
class States:
    """K states. poses: (K, 4, 4) base_from_surface, twists: (K, 6) rad/s, mm/s, accelerations: (K, 6) a second."""

    poses: Array
    twists: Array
    accelerations: Array

    def __len__(self) -> int:
        return len(self.poses)

    def moved(self, step: Array) -> States:
        """The same after a step (K, 18)."""
        return States(self.poses @ se3.exp(step[:, :6]), self.twists + step[:, 6:12], self.accelerations + step[:, 12:])


@dataclass(frozen=True, slots=True, eq=False)
class Links:
    """The prior between neighbours, linearised: off + before @ step[k] + after @ step[k + 1] of covariance `spread`.

    off: (K - 1, 18). before, after, spread: (K - 1, 18, 18), the last per unit of density: (K - 1, 3, 3), of each axis.
    """

    off: Array
    before: Array
    after: Array
    spread: Array

    def information(self, psd: Array) -> Array:
        """Inverse covariances (K - 1, 18, 18) for densities (K - 1, 6), rad^2/s^5 and mm^2/s^5."""
        inverse = np.linalg.inv(self.spread)  # (K - 1, 3, 3)
        out = np.zeros((len(psd), 3, 6, 3, 6))
        each = np.arange(6)
        out[:, :, each, :, each] = inverse[None] / psd.T[:, :, None, None]  # axes first, by numpy's rule
        return out.reshape(-1, STATE, STATE)


def small_adjoint(xi: Array) -> Array:
    """ad (..., 6, 6) of tangent vectors (..., 6): ad(x) @ y is their Lie bracket."""
    out = np.zeros((*xi.shape, 6))
    out[..., :3, :3] = out[..., 3:, 3:] = se3.hat(xi[..., :3])
    out[..., 3:, :3] = se3.hat(xi[..., 3:])
    return out


def right_jacobian(xi: Array) -> Array:
    """(..., 6, 6): exp(xi + d) = exp(xi) exp(J d), to third order, as small as what a surface moves in a delay."""
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


def drive(seconds: Array) -> Array:
    """Covariance (..., 3, 3) that a unit density of white jerk adds over seconds (...)."""
    t = np.asarray(seconds, float)
    out = np.zeros((*t.shape, 3, 3))
    out[..., 0, 0], out[..., 1, 1], out[..., 2, 2] = t**5 / 20, t**3 / 3, t
    out[..., 0, 1] = out[..., 1, 0] = t**4 / 8
    out[..., 0, 2] = out[..., 2, 0] = t**3 / 6
    out[..., 1, 2] = out[..., 2, 1] = t**2 / 2
    return out


def local(before: States, after: States) -> tuple[Array, Array]:
    """The later states (M, 18) in the tangent spaces of the earlier ones, and the moves (M, 6) between the poses."""
    moved = se3.log(se3.inverse(before.poses) @ after.poses)
    bent = np.eye(6) + small_adjoint(moved) / 2
    velocity = (bent @ after.twists[..., None])[..., 0]
    acceleration = (bent @ after.accelerations[..., None])[..., 0]
    return np.concatenate([moved, velocity, acceleration], axis=-1), moved


def links(states: States, stamps: Array) -> Links:
    """The prior at `states`, with exact derivatives; stamps: (K,) s."""
    seconds = np.diff(stamps)
    ends = slice(None, -1), slice(1, None)
    before, after = (States(states.poses[e], states.twists[e], states.accelerations[e]) for e in ends)
    there, moved = local(before, after)
    here = np.concatenate([np.zeros_like(moved), before.twists, before.accelerations], axis=-1)
    forward = np.asarray(np.kron(transition(seconds), np.eye(6)), float)
    by_after, by_before = inverse_right_jacobian(moved), -inverse_right_jacobian(-moved)
    bent = np.eye(6) + small_adjoint(moved) / 2
    later, earlier = np.zeros((len(moved), STATE, STATE)), -forward
    later[:, :6, :6], later[:, 6:12, 6:12], later[:, 12:, 12:] = by_after, bent, bent
    earlier[:, :6, :6] = by_before
    for rows, rate in ((slice(6, 12), after.twists), (slice(12, 18), after.accelerations)):
        turned = -small_adjoint(rate) / 2  # of the move
        later[:, rows, :6], earlier[:, rows, :6] = turned @ by_after, turned @ by_before
    off = there - (forward @ here[..., None])[..., 0]
    return Links(np.asarray(off), earlier, later, drive(seconds))
