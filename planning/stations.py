"""Where on a curve its timing is decided, and how fast each place may be passed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estimation.se3 import Array
from planning.curve import Curve

POINTS = 30  # evenly spread grid points of one horizon: toppra takes some 20 us for each


@dataclass(frozen=True, slots=True, eq=False)
class Stations:
    """Grid points on a stretch of a curve, rising.

    places: (M,) mm. allowed: (M,) mm/s that the stretches and corners on both sides bear. cruise: (M,) mm/s that the
    stretches alone bear.
    """

    places: Array
    allowed: Array
    cruise: Array

    @property
    def due(self) -> Array:
        """When each point is reached at the speeds allowed, s after the first (M,): the soonest that can be."""
        pace = self.allowed[:-1] + self.allowed[1:]
        return np.concatenate([[0.0], np.cumsum(2 * np.diff(self.places) / pace)])


def stations_on(curve: Curve, start: float, end: float) -> Stations:
    """Grid points from `start` to `end`, mm: evenly spread, and where there is room bounds and middle of each blend."""
    places = _places(curve, start, end)
    first, last = curve.stretch(places[:-1]), curve.stretch(np.nextafter(places[1:], 0.0))
    between = _least(curve.speed, first, last)
    before = np.searchsorted(curve.knots + curve.half, places[:-1], "right")  # the first blend not yet passed
    beyond = np.searchsorted(curve.knots - curve.half, places[1:], "left") - 1  # the last one begun
    corner = np.where(beyond >= before, _least(curve.corner, before, np.maximum(beyond, before)), np.inf)
    return Stations(places, _at_points(np.minimum(between, corner)), _at_points(between))


def _places(curve: Curve, start: float, end: float) -> Array:
    even = np.linspace(start, end, POINTS)
    inside = (curve.knots > start) & (curve.knots < end)
    if inside.sum() > POINTS // 3:
        return even
    knots, half = curve.knots[inside], curve.half[inside]
    points = np.concatenate([even, knots - half, knots, knots + half])
    points = np.unique(points[(points >= start) & (points <= end)])
    points = points[np.concatenate([[True], np.diff(points) > 1e-6])]
    points[-1] = end
    return np.asarray(points)


def _least(values: Array, first: NDArray[np.intp], last: NDArray[np.intp]) -> Array:
    """The least (M,) of values[first : last + 1] for each pair of (M,); beyond the end of values there is no limit."""
    ends = np.stack([first, last + 1], 1).ravel()
    return np.asarray(np.minimum.reduceat(np.append(values, [np.inf, np.inf]), ends)[::2])


def _at_points(between: Array) -> Array:
    """What (M,) grid points bear where their intervals bear (M-1,)."""
    return np.concatenate([between[:1], np.minimum(between[:-1], between[1:]), between[-1:]])
