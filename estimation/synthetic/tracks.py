"""What happens to the tracks of one world over time: which are found, and by how much they are off.

Every frame draws the same amount whatever is seen, so worlds that differ in one condition share all other draws.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from estimation.se3 import Array
from estimation.synthetic.conditions import Conditions

Seen = NDArray[np.bool_]

ASTRAY = 40.0  # px: how far an outlier stands off along an axis, at most


class Errors:
    """Pixel errors (C, N, 2) of all tracks, frame by frame: white noise, what a track drags along, and outliers."""

    def __init__(self, conditions: Conditions, shape: tuple[int, int], rng: np.random.Generator) -> None:
        self._conditions, self._shape, self._rng = conditions, shape, rng
        self._dragged = rng.standard_normal((*shape, 2))

    def __call__(self, dt: float) -> Array:
        """The errors of a frame `dt` s after the one before."""
        c, rng = self._conditions, self._rng
        white, fresh = rng.standard_normal((2, *self._shape, 2))
        keep = np.exp(-dt / c.correlated_seconds) if c.correlated_seconds else 0.0
        self._dragged = keep * self._dragged + np.sqrt(1 - keep**2) * fresh
        error = c.noise * white + c.correlated * self._dragged
        wrong, astray = rng.random(self._shape), rng.uniform(-ASTRAY, ASTRAY, (*self._shape, 2))
        return np.where((wrong < c.outliers)[..., None], astray, error)


class Found:
    """Which tracks (C, N) a matcher finds, frame by frame, of those that are in view."""

    def __init__(self, conditions: Conditions, shape: tuple[int, int], rng: np.random.Generator) -> None:
        self._conditions, self._shape, self._rng = conditions, shape, rng
        views = shape[0] if conditions.views is None else conditions.views
        self._ever = rng.random(shape).argsort(axis=0).argsort(axis=0) < views
        self._dropped = rng.random(shape) < conditions.dropouts

    def __call__(self, stamp: float, dt: float) -> Seen:
        """Those of the frame at `stamp`, s, `dt` s after the one before."""
        c = self._conditions
        draw = self._rng.random(self._shape)
        self._dropped = draw < np.where(self._dropped, *_stay_and_begin(c, dt))
        found = self._ever & ~self._dropped
        for start, end, *camera in c.outages:
            if start <= stamp < end:
                found[camera or slice(None)] = False
        return found


def _stay_and_begin(conditions: Conditions, dt: float) -> tuple[float, float]:
    """Chances of a dropped track to stay so and of another to be dropped, for the share of time that is asked for."""
    share = conditions.dropouts
    if share in (0.0, 1.0):
        return share, share
    end = -np.expm1(-dt / conditions.dropout_seconds)
    return 1 - end, min(end * share / (1 - share), 1.0)


def lives(count: int, seconds: float, life: float, rng: np.random.Generator) -> Array:
    """When (N, 2), s, landmarks are seen from and to: `count` at a time, each for `life` s on average, 0: for ever."""
    if not life:
        return np.tile([-np.inf, np.inf], (count, 1))
    spans = []
    for _ in range(count):
        start = -np.inf
        while start < seconds:
            end = max(start, 0.0) + rng.exponential(life)
            spans.append((start, end))
            start = end
    return np.array(sorted(spans))
