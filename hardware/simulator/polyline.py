"""Axes that go in straight lines: where they were at which instant, and how fast they went on from there."""

from __future__ import annotations

import numpy as np

from estimation.se3 import Array

AXES = 6


class Polyline:
    """Knots, each an instant, the axes (6,) there and their slope until the next knot; it grows at its end.

    Before the first knot and, where the last slope is zero, after the last one, the axes rest.
    """

    def __init__(self, instant: float, axes: Array) -> None:
        self._knots = np.zeros((64, 1 + 2 * AXES))  # instant, axes, slope
        self._size = 0
        self.append(instant, axes, np.zeros(AXES))

    def __len__(self) -> int:
        return self._size

    @property
    def instants(self) -> Array:
        """Instants (N,) of the knots, s."""
        return self._knots[: self._size, 0]

    @property
    def axes(self) -> Array:
        """Axes (N, 6) at the knots, mm and rad."""
        return self._knots[: self._size, 1 : 1 + AXES]

    @property
    def slopes(self) -> Array:
        """Slopes (N, 6) after the knots, mm/s and rad/s."""
        return self._knots[: self._size, 1 + AXES :]

    def append(self, instant: float, axes: Array, slope: Array) -> None:
        """Go on from `axes` with `slope`; a knot at the instant of the last one takes its place."""
        if self._size and instant == self._knots[self._size - 1, 0]:
            self._size -= 1
        assert not self._size or instant > self._knots[self._size - 1, 0]
        if self._size == len(self._knots):
            self._knots = np.concatenate([self._knots, np.zeros_like(self._knots)])
        knot = self._knots[self._size]
        knot[0], knot[1 : 1 + AXES], knot[1 + AXES :] = instant, axes, slope
        self._size += 1

    def stop(self, instant: float) -> None:
        """Forget what comes after `instant`, and rest there."""
        axes = self.at(np.array([instant]))[0]
        self._size = int(np.searchsorted(self.instants, instant, "right"))
        self.append(instant, axes, np.zeros(AXES))

    def before(self, instants: Array) -> tuple[np.ndarray, Array]:
        """For instants (N,): the knot at or before each, the first where there is none, and s since then."""
        index = np.maximum(np.searchsorted(self.instants, instants, "right") - 1, 0)
        return index, np.maximum(instants - self.instants[index], 0.0)

    def at(self, instants: Array) -> Array:
        """Axes (N, 6) at instants (N,), s."""
        index, since = self.before(instants)
        return np.asarray(self.axes[index] + self.slopes[index] * since[:, None])
