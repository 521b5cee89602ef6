"""The Kalman filter of thesis 4.4, and the velocity that it follows there."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from estimation.se3 import Array

ACCELERATION = np.array([500.0, 500.0, 2.5])  # px/s^2 and rad/s^2: 50 px/s, or 15 deg/s, within a tenth of a second
MOVE = np.array([0.15, 0.15, 5e-3])  # px and rad, of one measured move: some twenty matches, each to half a px
UNKNOWN = np.array([300.0, 300.0, 1.5])  # px/s and rad/s, of a surface just found: any that could be printed on


@dataclass(frozen=True, slots=True, eq=False)
class Belief:
    """A state (n,) as it is believed and its covariance (n, n): X and P of the thesis."""

    mean: Array
    covariance: Array


def predict(belief: Belief, transition: Array, noise: Array) -> Belief:
    """The state one step later, thesis Eq. 4.12-4.13. transition: A (n, n). noise: Q (n, n).

    The term B U is left out: nothing that drives a wound is known.
    """
    return Belief(transition @ belief.mean, transition @ belief.covariance @ transition.T + noise)


def update(belief: Belief, measured: Array, observation: Array, noise: Array) -> Belief:
    """The state after a measurement (m,), thesis Eq. 4.14-4.18. observation: H (m, n). noise: R (m, m)."""
    residual = measured - observation @ belief.mean  # Eq. 4.14
    spread = observation @ belief.covariance @ observation.T + noise  # Eq. 4.15
    gain = np.linalg.solve(spread, observation @ belief.covariance).T  # Eq. 4.16; S and P are symmetric
    return Belief(belief.mean + gain @ residual, belief.covariance - gain @ spread @ gain.T)  # Eq. 4.17, 4.18


def velocity_at_rest() -> Belief:
    """What is believed of the image velocity (3,), px/s, px/s, rad/s, of a surface just found."""
    return Belief(np.zeros(3), np.diag(UNKNOWN**2))


def velocity_later(belief: Belief, dt: float) -> Belief:
    """The velocity `dt` s later: the same, less surely."""
    return predict(belief, np.eye(3), np.diag((ACCELERATION * dt) ** 2))


def velocity_seen(belief: Belief, move: Array, dt: float) -> Belief:
    """The velocity after a move (3,) px, px, rad was measured over `dt` s.

    Thesis 4.4: the median displacement gives the velocity between the frames, which is the filter's observation and
    corrects its predictions. The thesis gives no matrices; here H = I, and R is that of a move divided by its time.
    """
    return update(velocity_later(belief, dt), move / dt, np.eye(3), np.diag((MOVE / dt) ** 2))
