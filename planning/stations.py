"""Where on a curve its timing is decided, and how fast each place may be passed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estimation.se3 import Array
from planning.motion.curve import Curve

SHORTEST_BLEND = 1e-9  # mm: beside a checkpoint where nothing changes there is none
POINTS = 30  # evenly spread grid points of one horizon: some 15 us for each


@dataclass(frozen=True, slots=True, eq=False)
class Stations:
    """Grid points on a stretch of a curve, rising.

    places: (M,) mm. allowed: (M,) mm/s that the stretches and corners on both sides bear. cruise: (M,) mm/s that the
    stretches alone bear. bend: (M,) 1/mm and swing: (M,) rad/mm^2, by which direction and spin change within any corner
    on both sides, at most; spin: (M,) rad/mm, the largest there.
    """

    places: Array
    allowed: Array
    cruise: Array
    bend: Array
    swing: Array
    spin: Array

    @property
    def due(self) -> Array:
        """When each point is reached at the speeds allowed, s after the first (M,): the soonest that can be."""
        pace = self.allowed[:-1] + self.allowed[1:]
        return np.concatenate([[0.0], np.cumsum(2 * np.diff(self.places) / pace)])


def stations_on(curve: Curve, start: float, end: float) -> Stations:
    """Grid points from `start` to `end`, mm: evenly spread, and where there is room the ends of each blend."""
    places = _places(curve, start, end)
    first, last = curve.stretch(places[:-1]), curve.stretch(np.nextafter(places[1:], 0.0))
    before = np.searchsorted(curve.knots + curve.half, places[:-1], "right")  # the first blend not yet passed
    beyond = np.searchsorted(curve.knots - curve.half, places[1:], "left") - 1  # the last one begun
    part = slice(int(min(first[0], before[0])), int(max(last[-1], beyond[-1])) + 2)
    stretches, corners = (first - part.start, last - part.start), (before - part.start, beyond - part.start)
    within = 2 * np.maximum(curve.half[part], SHORTEST_BLEND)
    bend, swing, spin = (np.linalg.norm(of[part], axis=1) for of in (curve.bend, curve.swing, curve.spin))
    of_corners = np.stack([1 / curve.corner[part], bend / within, swing / within], axis=1)
    of_stretches = np.stack([1 / curve.speed[part], spin], axis=1)
    slowest, bend, swing = _at_points(_largest(of_corners, *corners)).T
    cruise, spin = _at_points(_largest(of_stretches, *stretches)).T
    return Stations(places, 1 / np.maximum(cruise, slowest), 1 / cruise, bend, swing, spin)


def _places(curve: Curve, start: float, end: float) -> Array:
    even = np.linspace(start, end, POINTS)
    inside = (curve.knots > start) & (curve.knots < end)
    if inside.sum() > POINTS // 3:
        return even
    knots, half = curve.knots[inside], curve.half[inside]
    points = np.concatenate([even, knots - half, knots + half])
    points = np.sort(points[(points >= start) & (points <= end)])
    points = points[np.concatenate([[True], np.diff(points) > 1e-6])]
    points[-1] = end
    return np.asarray(points)


def _largest(values: Array, first: NDArray[np.intp], last: NDArray[np.intp]) -> Array:
    """The largest (M, D) of values (K, D), none below 0, from `first` to `last` (M,); 0 where there is none."""
    padded = np.concatenate([values, np.zeros((2, values.shape[1]))])
    ends = np.stack([np.minimum(first, len(values)), np.maximum(last, first) + 1], 1).ravel()
    found = np.maximum.reduceat(padded, np.minimum(ends, len(values) + 1))[::2]
    return np.where((last >= first)[:, None], found, 0.0)


def _at_points(between: Array) -> Array:
    """The largest (M, D) on both sides of grid points of (M-1, D) in the intervals between them."""
    return np.concatenate([between[:1], np.maximum(between[:-1], between[1:]), between[-1:]])
