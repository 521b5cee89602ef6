"""What the adjustments of calibration share: weights that a blunder cannot pull, and Levenberg's damping."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol, TypeVar

import numpy as np

from estimation.se3 import Array

HUBER = 3.0  # sigmas: of pure noise 0.3 % is touched, so that a covariance needs no correction for it
STEPS, DONE = 40, 1e-7  # most steps; share of the cost that is not worth another one, where a result hangs on it
WORST = 1e8  # damping at which no step helps any more


def huber(squares: Array) -> tuple[Array, Array]:
    """Cost and weight (...) of squared normalised residual lengths (...)."""
    length = np.sqrt(squares)
    out = length > HUBER
    cost = np.where(out, 2 * HUBER * length - HUBER**2, squares)
    return cost, np.where(out, HUBER / np.maximum(length, HUBER), 1.0)


class Step(Protocol):
    """The normal equations at one state."""

    @property
    def cost(self) -> float:
        """Of the residuals, and of what is believed beforehand."""
        ...


State = TypeVar("State")
Normal = TypeVar("Normal", bound=Step)


def minimise(
    state: State,
    normal: Callable[[State], Normal],
    moved: Callable[[State, Normal, float], State | None],
    done: float = DONE,
) -> tuple[State, Normal]:
    """The state of least cost by Levenberg and Marquardt's steps, and its normal equations.

    moved: the state after a damped step, None where the equations cannot be solved. done: share of the cost that is
    not worth another step.
    """
    at, damping = normal(state), 1e-4
    for _ in range(STEPS):
        while damping < WORST:
            tried = moved(state, at, damping)
            there = None if tried is None else normal(tried)
            if tried is not None and there is not None and there.cost < at.cost:
                break
            damping *= 10
        else:
            break
        assert tried is not None and there is not None
        gain, state, at = at.cost - there.cost, tried, there
        damping = max(damping / 10, 1e-9)
        if gain <= done * at.cost:
            break
    return state, at


def damped(matrix: Array, damping: float) -> Array:
    """Matrices (..., n, n) with their diagonals enlarged by the share `damping`."""
    out = np.array(matrix)
    n = np.arange(matrix.shape[-1])
    out[..., n, n] *= 1 + damping
    out[..., n, n] += 1e-12
    return out
