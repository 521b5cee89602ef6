"""Normal equations of a chain of states with a border of shared unknowns, eliminated state by state.

The information of all states is block tridiagonal and every one of them is tied to the same landmarks and cameras. A
Cholesky factorisation from the first state to the last needs of the border only what the state before left (18 rows),
so a recording is taken in stretches that join exactly, in memory that does not grow with the border's. GTSAM
eliminates a graph likewise, but wants a factor for every observation, 5.4 million of them in ten minutes, and a clique
of all landmarks for each pose. Its own factors and optimiser judge the result in `tests/test_smoothing.py`.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import cast

import numpy as np
from scipy.linalg.lapack import dtrtri

from estimation.batch.priors import STATE
from estimation.se3 import Array


class Chain:
    """One factorisation of K states; `take` is called once for each stretch, from first to last."""

    def __init__(self, count: int) -> None:
        self.count, self._done = count, 0
        self._inverse = np.zeros((count, STATE, STATE))  # of the Cholesky factors
        self._links = np.zeros((count, STATE, STATE))  # inverse @ information with the next state
        self._right = np.zeros((count, STATE))
        self._left: Array | None = None  # what the last state takes from the next one's information,
        self._left_border = np.zeros((0, 0))  # and from its border and gradient

    def take(self, information: Array, ties: Array, border: Array, gradient: Array) -> Array:
        """Eliminate the next F states: information (F, 18, 18), ties (F, 18, 18) with the one after each (zero for the
        last of all), border (F, 18, S) and gradient (F, 18). Returns the border's square roots (18 F, S).
        """
        frames, size = len(information), border.shape[2]
        roots = np.empty((frames, STATE, size))
        tall = np.concatenate([ties, border, gradient[..., None]], axis=2)
        if self._left is None:
            self._left, self._left_border = np.zeros((STATE, STATE)), np.zeros((STATE, size + 1))
        for f in range(frames):
            k = self._done + f
            inverse = _inverse_root(information[f] - self._left)
            tall[f, :, STATE:] -= self._left_border
            solved = inverse @ tall[f]
            link = solved[:, :STATE]
            self._inverse[k], self._links[k], roots[f] = inverse, link, solved[:, STATE:-1]
            self._right[k] = solved[:, -1]
            self._left, self._left_border = link.T @ link, link.T @ solved[:, STATE:]
        self._done += frames
        return roots.reshape(frames * STATE, size)

    @property
    def border(self) -> Array:
        """What the states eliminated so far take from the next one's border and gradient, (18, S + 1)."""
        return self._left_border

    def again(self, stretch: tuple[int, int], border: Array, entry: Array) -> Array:
        """Square roots (18 F, S) of a border (F, 18, S) that `take` had before. entry: `border` before it."""
        first, last = stretch
        roots = np.empty_like(border)
        left = entry[:, :-1] if entry.size else np.zeros(border.shape[1:])
        for k in range(first, last):
            roots[k - first] = self._inverse[k] @ (border[k - first] - left)
            left = self._links[k].T @ roots[k - first]
        return roots.reshape((last - first) * STATE, border.shape[2])

    @property
    def right(self) -> Array:
        """(K, 18), the gradient times the Cholesky factors' inverse."""
        return self._right

    def steps(self) -> Array:
        """(K, 18) that bring the states to their optimum, the shared unknowns as in the gradient."""
        out, after = np.empty((self.count, STATE)), np.zeros(STATE)
        for k in range(self.count - 1, -1, -1):
            after = -self._inverse[k].T @ (self._right[k] + self._links[k] @ after)
            out[k] = after
        return out

    def covariances(self) -> tuple[Array, Array]:
        """(K, 18, 18) of the states, and (K - 1, 18, 18) of each with the next, were the shared unknowns known."""
        own, next_ = np.empty((self.count, STATE, STATE)), np.empty((max(self.count - 1, 0), STATE, STATE))
        after = np.zeros((STATE, STATE))
        for k in range(self.count - 1, -1, -1):
            root = self._inverse[k].T
            gain = root @ self._links[k]
            through = gain @ after
            if k < self.count - 1:
                next_[k] = -through
            after = root @ root.T + through @ gain.T
            own[k] = after = (after + after.T) / 2
        return own, next_

    def responses(self, stretch: tuple[int, int], roots: Array, after: Array) -> Iterator[tuple[int, Array]]:
        """How states follow the shared unknowns, (18, S), of first <= k < last, from the last one on backwards.

        roots: (18 F, S) as `take` gave them for this stretch. after: of the state behind it, zero at the end.
        """
        first, last = stretch
        blocks = roots.reshape(last - first, STATE, -1)
        for k in range(last - 1, first - 1, -1):
            after = -self._inverse[k].T @ (blocks[k - first] + self._links[k] @ after)
            yield k, after


def _inverse_root(information: Array) -> Array:
    """Inverse of the Cholesky factor of (18, 18); LinAlgError where that is not positive definite."""
    upper = np.linalg.cholesky(information).T  # LAPACK reads it column by column
    inverse, failed = dtrtri(upper, lower=0)
    assert failed == 0
    return cast(Array, inverse.T)
