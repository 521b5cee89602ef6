"""The poses of the last seconds, and increments between them at any instants."""

from __future__ import annotations

import numpy as np

from estimation import se3
from estimation.se3 import Array

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
    """log(inverse(a) @ b) (..., 6), in a third of the general function's time for turns below half a turn."""
    back = np.swapaxes(a[:, :3, :3], -1, -2)
    turn = back @ b[..., :3, :3]
    shift = (back @ (b[..., :3, 3] - a[:, :3, 3])[..., None])[..., 0]
    cosine = (turn[..., 0, 0] + turn[..., 1, 1] + turn[..., 2, 2] - 1) / 2
    if cosine.min() < -0.9:
        return se3.log(se3.make(turn, shift))
    axis = (turn[..., _OVER, _UNDER] - turn[..., _UNDER, _OVER]) / 2
    sine = np.sqrt((axis**2).sum(-1))
    angle = np.arctan2(sine, cosine)
    near = angle < 1e-4
    safe = np.where(near, 1.0, sine)
    stretch = np.where(near, 1.0, angle / safe)
    left = (1 - angle * (1 + cosine) / (2 * safe)) / np.where(near, 1.0, angle) ** 2
    bend = np.where(angle < 0.05, 1 / 12 + angle**2 / 720, left)
    vector = stretch[..., None] * axis
    across = _cross(vector, shift)
    return np.concatenate([vector, shift - across / 2 + bend[..., None] * _cross(vector, across)], axis=-1)


_NEXT, _LAST = np.array([1, 2, 0]), np.array([2, 0, 1])
_OVER, _UNDER = _LAST, _NEXT  # of a skew matrix: rows and columns of its vector


def _cross(a: Array, b: Array) -> Array:
    return np.asarray(a[..., _NEXT] * b[..., _LAST] - a[..., _LAST] * b[..., _NEXT])
