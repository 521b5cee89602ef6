"""How far the shifts of the cameras' images have strayed since the first pose: patches that are seen from elsewhere."""

from __future__ import annotations

import numpy as np

from estimation.online.pose_solver import SharedFit
from estimation.se3 import Array

CLEARLY = 0.02  # px: shifts known better than that tell how large all of them are
LEAST_ALIKE = 0.01  # of the variance claimed of tracks: something in them lasts
RECENT = 100  # frame sets over which it is averaged how far shifts have strayed


class Straying:
    """The mean square of how shifts differ from those at the start, from the ones that a fit shows clearly.

    The others the pose takes up: that is what is claimed of it.
    """

    def __init__(self) -> None:
        self._start: tuple[Array, Array] | None = None  # shifts (2C,) px, and the information (2C, 2C) of a fit of them
        self._variance, self._since = 0.0, 0  # px^2; frame sets of which it is the mean

    @property
    def variance(self) -> float:
        """px^2 per axis; zero before there is a first pose."""
        return self._variance

    def start(self, found: SharedFit, shift: Array) -> None:
        """Remember the shifts (C, 2), px, and how clearly a fit shows them, with the first pose that is given out."""
        self._start = _in_turn(shift), _told(found)
        self._variance, self._since = 0.0, 0

    def learn(self, found: SharedFit, shift: Array, alike: float) -> None:
        """Take the shifts (C, 2), px, after one more fit.

        alike: the part of the variance claimed of tracks that lasts from one frame set to the next.
        """
        if self._start is None:
            return
        before, then = self._start
        both = np.linalg.inv(np.linalg.inv(_told(found)) + np.linalg.inv(then)) / max(alike, LEAST_ALIKE)
        self._since = min(self._since + 1, RECENT)
        self._variance += (_size(both, _in_turn(shift) - before) - self._variance) / self._since


def _in_turn(shift: Array) -> Array:
    """Shifts (C, 2) as (2C,): rights, then downs."""
    return np.asarray(shift.T.ravel())


def _told(found: SharedFit) -> Array:
    count = len(found.pull) // 3
    told = found.information[count:, count:]
    return np.asarray(told + 1e-9 * np.trace(told) * np.eye(len(told)))


def _size(told: Array, shift: Array) -> float:
    """Mean square, px^2, of shifts (2C,), from directions that information (2C, 2C) tells, less its own error.

    Three cameras show three of six: what so few may be off by, one sigma, is added.
    """
    known, axes = np.linalg.eigh(told)
    seen = (axes.T @ shift) ** 2
    weight = (CLEARLY**2 + 1 / known) ** -2
    weight = weight / weight.sum()
    return float(weight @ np.maximum(seen - 1 / known, 0.0) * (1 + (2 * (weight @ weight)) ** 0.5))
