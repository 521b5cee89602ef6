"""The poses of the last seconds, and increments between them at any instants."""

from __future__ import annotations

import numpy as np

from estimation import se3
from estimation.runtime import NEW, compiled
from estimation.se3 import Array

FARTHEST = -0.9  # cosine of a turn: beyond, its axis is lost in rounding
APART = 0.01  # s: poses nearer to the one before replace it, so that a faster camera keeps no shorter memory


class History:
    """A window of poses over `span` s, of bounded memory: one pose in each APART s at most."""

    def __init__(self, span: float) -> None:
        self._span = span
        self._room = int(span / APART) + 4
        self._stamps, self._poses = np.zeros(2 * self._room), np.zeros((2 * self._room, 4, 4))
        self._first = self._end = 0

    def clear(self) -> None:
        """Forget all."""
        self._first = self._end = 0

    def add(self, stamp: float, pose: Array) -> None:
        """Take a pose (4, 4) newer than all before."""
        stamps = self._stamps
        if self._end - self._first > 1 and stamp - stamps[self._end - 2] < APART:
            self._end -= 1
        if self._end == 2 * self._room:
            count = self._end - self._first
            stamps[:count], self._poses[:count] = stamps[self._first :].copy(), self._poses[self._first :].copy()
            self._first, self._end = 0, count
        stamps[self._end], self._poses[self._end] = stamp, pose
        self._end += 1
        while self._end - self._first > 2 and stamps[self._first + 1] <= stamp - self._span:
            self._first += 1

    @property
    def reach(self) -> float:
        """s from the oldest pose to the newest."""
        return float(self._stamps[self._end - 1] - self._stamps[self._first]) if self._end > self._first else 0.0

    def carry(self, moved: Array) -> None:
        """Put all poses where they are carried by `moved` (4, 4), in the base frame."""
        own = slice(self._first, self._end)
        self._poses[own] = moved @ self._poses[own]

    @property
    def newest(self) -> Array:
        """The last pose (4, 4); only where there is one."""
        return np.asarray(self._poses[self._end - 1])

    def increments(self, poses: Array, stamps: Array) -> Array:
        """Tangent vectors (N, 6) from poses (N, 4, 4), or one (4, 4) for all, to where the surface was at stamps (N,).

        Between two poses of the window the increment is taken as linear; outside, its end counts.
        """
        own = self._stamps[self._first : self._end]
        after = np.clip(np.searchsorted(own, stamps), 1, len(own) - 1)
        before = after - 1
        share = np.clip((stamps - own[before]) / (own[after] - own[before]), 0.0, 1.0)[:, None]
        ends = self._poses[self._first + np.stack([before, after])]  # (2, N, 4, 4)
        vectors = _moves(np.broadcast_to(poses, (len(stamps), 4, 4)), ends)
        return np.asarray((1 - share) * vectors[0] + share * vectors[1])


def _moves(a: Array, b: Array) -> Array:
    """log(inverse(a) @ b) (2, N, 6) of poses a (N, 4, 4) and b (2, N, 4, 4), compiled for turns below half a turn."""
    vectors, within = _short_moves(np.require(a, float, NEW), np.require(b, float, NEW))
    return vectors if within else np.asarray(se3.log(se3.inverse(a) @ b))


@compiled("Tuple((f8[:,:,::1], b1))(f8[:,:,::1], f8[:,:,:,::1])")
def _short_moves(a: Array, b: Array) -> tuple[Array, bool]:
    """As `_moves`, and whether no turn came near half a turn, where this is not exact."""
    vectors, within = np.empty((2, len(a), 6)), True
    turn, shift = np.empty((3, 3)), np.empty(3)
    for end in range(2):
        for n in range(len(a)):
            here, there = a[n], b[end, n]
            for i in range(3):
                shift[i] = 0.0
                for k in range(3):
                    shift[i] += here[k, i] * (there[k, 3] - here[k, 3])
                for j in range(3):
                    turn[i, j] = here[0, i] * there[0, j] + here[1, i] * there[1, j] + here[2, i] * there[2, j]
            cosine = (turn[0, 0] + turn[1, 1] + turn[2, 2] - 1) / 2
            within = within and cosine >= FARTHEST
            x, y, z = (turn[2, 1] - turn[1, 2]) / 2, (turn[0, 2] - turn[2, 0]) / 2, (turn[1, 0] - turn[0, 1]) / 2
            sine = np.sqrt(x * x + y * y + z * z)
            angle = np.arctan2(sine, cosine)
            stretch = angle / sine if angle >= 1e-4 else 1.0
            small = 1 / 12 + angle**2 / 720
            bend = small if angle < 0.05 else (1 - angle * (1 + cosine) / (2 * sine)) / angle**2
            x, y, z = stretch * x, stretch * y, stretch * z
            u, v, w = y * shift[2] - z * shift[1], z * shift[0] - x * shift[2], x * shift[1] - y * shift[0]
            out = vectors[end, n]
            out[0], out[1], out[2] = x, y, z
            out[3] = shift[0] - u / 2 + bend * (y * w - z * v)
            out[4] = shift[1] - v / 2 + bend * (z * u - x * w)
            out[5] = shift[2] - w / 2 + bend * (x * v - y * u)
    return vectors, within
