"""How fast along the curve: TOPP-RA (Pham and Pham 2018) over the next horizon, always ending at rest.

The limits of the axes hold for path and surface together: what the surface's predicted motion takes of them at each
grid point is not the path's to use. Corners lie between grid points, too: each is passed so slowly that no axis changes
its speed within it faster than what is left allows, or that the way straight back would not within a tick. Speed
changes by no more than the cruising speed in RISE, as the follower, whose jerk is limited, rounds off what is faster: a
start at 5 mm/s was measured to cost 40 um along the path without that.

What was measured of toppra 0.6.10 and is kept here: its passes take 20 us a grid point, its programs 4; the start speed
is carried at most at 0.999 of a limit, or half of all replans fail; the speed between grid points follows constant
acceleration (ParametrizeConstAccel's rule), not a spline; a solve can end without a result or with an infinite time. It
is exact to a fixed 1e-8 of whatever unit: in mm, 3 in 600 random paths had no result; in the horizon's length, none.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from toppra import constraint
from toppra.constants import MAX_TRIES, SMALL, TINY
from toppra.constraint.linear_constraint import canlinear_colloc_to_interpolate
from toppra.interpolator import AbstractGeometricPath
from toppra.solverwrapper import seidelWrapper

from estimation.se3 import Array
from planning.demand import PAUSE, Demand
from planning.stations import Stations

CARRIED = 0.999  # of a limit, as start speed
RISE = 0.1  # s from rest to cruising speed: with it a start costs 3 um, with half of it 9
TOTAL = 0.8  # of the axes' limits, for path and surface together; the rest makes good what was not foreseen
PATH_SPEED, PATH_ACCELERATION = 0.5, 0.2  # of the axes' limits, for the path at most: jerk bears no more
LEAST = 0.02  # of the axes' limits, for the path however the surface moves: slow, and never stuck
FASTEST = np.array([1e-9, -1.0])  # toppra's objective: the greatest squared speed, and of its accelerations the least
BRAKED = 0.9  # of the change of speed that is allowed, where a speed carried over is brought down


@dataclass(frozen=True, slots=True, eq=False)
class Timing:
    """s over time on one horizon. times: (M,) s. places: (M,) mm. speeds: (M,) mm/s, the last 0."""

    times: Array
    places: Array
    speeds: Array

    @property
    def end(self) -> float:
        """The instant, s, at which it comes to rest."""
        return float(self.times[-1])

    def at(self, t: Array) -> Array:
        """Places (N,), mm, at instants (N,), s; before the start and after the end it rests."""
        t = np.clip(t, self.times[0], self.times[-1])
        i = self._interval(t)
        dt = t - self.times[i]
        return np.asarray(self.places[i] + dt * (self.speeds[i] + 0.5 * dt * self._rate(i)))

    def speed_at(self, t: float) -> float:
        """Speed, mm/s, at the instant t, s; 0 outside."""
        if not self.times[0] <= t <= self.times[-1]:
            return 0.0
        i = self._interval(np.array([t]))
        return float((self.speeds[i] + (t - self.times[i]) * self._rate(i))[0])

    def _interval(self, t: Array) -> NDArray[np.intp]:
        return np.clip(np.searchsorted(self.times, t, "right") - 1, 0, len(self.times) - 2)

    def _rate(self, i: NDArray[np.intp]) -> Array:
        return np.asarray((self.speeds[i + 1] - self.speeds[i]) / (self.times[i + 1] - self.times[i]))


def retime(grid: Stations, asked: Demand, speed: float, begin: float, limits: tuple[Array, Array]) -> Timing | str:
    """The fastest timing along the grid that begins at `begin`, s, with `speed`, mm/s, and ends at rest.

    limits: speed and acceleration (D,) of what `asked` is about. The grid's speeds hold everywhere, not at its points
    only. A speed too high for limits that have shrunk since is brought down to them as the grid's `cruise` lets it.
    A str says why there is no timing.
    """
    carried = min(speed, CARRIED * float(grid.allowed[0]))
    change = grid.cruise / RISE
    left = _left(limits[1], asked.acceleration, PATH_ACCELERATION)
    axes = _borne(asked, _left(limits[0], asked.speed, PATH_SPEED), left)
    bounds = _speeds(grid, axes, carried, float(change.min()))
    start, end = grid.places[[0, -1]]
    unit = end - start
    constraints = [_Speed(bounds / unit, change / unit), *_acceleration(asked, left, bounds, change, unit)]
    speeds = _solved(constraints, (grid.places - start) / unit, carried / unit)
    if speeds is None or not np.isfinite(speeds).all():
        return f"no timing from {start:.2f} to {end:.2f} mm at {speed:.2f} mm/s"
    pace = unit * (speeds[:-1] + speeds[1:])
    if (pace <= 0).any():
        return f"no timing from {start:.2f} to {end:.2f} mm: it would stand still"
    times = begin + np.concatenate([[0.0], np.cumsum(2 * np.diff(grid.places) / pace)])
    return Timing(times, grid.places, np.asarray(unit * speeds))


def _left(limit: Array, taken: Array, most: float) -> Array:
    """What (M, D) the surface, which takes (M, D) of limits (D,), leaves to the path; `most` of the limits at most."""
    return np.clip(TOTAL * limit - taken, LEAST * limit, most * limit)


def _borne(asked: Demand, speed: Array, acceleration: Array) -> Array:
    """Speed (M,), mm/s, at which no axis exceeds what is left to the path (M, D), on straights and in corners."""
    straight = speed / np.maximum(np.abs(asked.first), 1e-12)
    within, at_once = acceleration / np.maximum(asked.bend, 1e-12), acceleration / np.maximum(asked.swerve, 1e-12)
    return np.asarray(np.minimum(straight, np.maximum(np.sqrt(within), PAUSE * at_once)).min(axis=1))


def _speeds(grid: Stations, axes: Array, carried: float, change: float) -> Array:
    """Speed (M,), mm/s, that tool and axes bear; from `carried` down no faster than by `change`, mm/s^2."""
    braking = np.sqrt(np.maximum(carried**2 - 2 * BRAKED * change * (grid.places - grid.places[0]), 0.0))
    return np.asarray(np.minimum(grid.allowed, np.maximum(axes, braking / CARRIED)))


def _acceleration(asked: Demand, left: Array, speed: Array, change: Array, unit: float) -> list[_Acceleration]:
    """The constraint on the axes that can reach what is left to them, lengths in `unit` mm; none, if none can.

    An axis that cannot at the greatest speed and change of speed does not alter the solution, only its cost.
    """
    first, second = asked.first / left, asked.second / left
    reached = ~((np.abs(first) * change.max() + np.abs(second) * speed[:, None] ** 2).max(axis=0) <= 1)  # NaN is
    return [_Acceleration(first[:, reached] * unit, second[:, reached] * unit**2)] if reached.any() else []


def _solved(constraints: list[constraint.LinearConstraint], places: Array, start: float) -> Array | None:
    """The fastest speeds (M,) along places (M,), 0 to 1, from `start` to rest; None where there are none.

    The two passes of TOPP-RA and toppra's program at each point, with its care for rounding, in plain floats: its own
    loops take three times as long. Rest is always controllable, as at rest no limit is near: the least speed from which
    the end can be reached is 0 everywhere, and is not solved for.
    """
    steps = np.diff(places)
    if not (steps > 0).all():
        return None
    program = seidelWrapper(constraints, _Way(places), places, solve_lp1d=True).solve_stagewise_optim
    greatest = np.zeros(len(places)).tolist()  # squared speed from which the end can be reached
    for i in reversed(range(len(places) - 1)):
        greatest[i] = program(i, None, FASTEST, math.nan, math.nan, 0.0, greatest[i + 1])[1]
        if math.isnan(greatest[i]):
            return None
    squared = [start**2]
    if not squared[0] <= greatest[0] + SMALL:
        return None
    objectives = np.stack([-2 * steps, -np.ones_like(steps)], 1)
    for i, step in enumerate(steps.tolist()):
        for _ in range(MAX_TRIES + 1):
            rate = program(i, None, objectives[i], squared[i], squared[i], 0.0, greatest[i + 1])[0]
            if not math.isnan(rate):
                break
            squared[i] = max(squared[i] - TINY, 0.999 * squared[i])
        else:
            return None
        there = squared[i] + 2 * step * rate
        squared.append(min(greatest[i + 1], max(there - TINY, 0.9999 * there, 0.0)))
    return np.sqrt(squared)


class _Way(AbstractGeometricPath):  # type: ignore[misc]
    """What toppra asks of a path when the constraints know the rest."""

    def __init__(self, places: Array) -> None:
        self._interval = places[[0, -1]]

    @property
    def dof(self) -> int:
        """One: the length."""
        return 1

    @property
    def path_interval(self) -> Array:
        """First and last s (2,), mm."""
        return self._interval


class _Speed(constraint.LinearConstraint):  # type: ignore[misc]
    """Speed along the curve at each grid point, and how fast that may change.

    It is exact for the tool, whose way is never longer than the curve's.
    """

    def __init__(self, allowed: Array, change: Array) -> None:
        super().__init__()
        self.set_discretization_type(1)  # checked at both ends of each interval
        self._allowed, self._change = allowed, change
        self._format_string = "speed"

    def compute_constraint_params(self, path: object, gridpoints: Array, *_: object, **__: object) -> tuple[Any, ...]:
        """Bounds (M, 2) on the acceleration and on the squared speed; no other parameter."""
        squared = np.stack([np.zeros(len(gridpoints)), self._allowed**2], 1)
        return None, None, None, None, None, np.stack([-self._change, self._change], 1), squared


class _Acceleration(constraint.LinearConstraint):  # type: ignore[misc]
    """|q' u + q'' x| of each axis, (M, D) as a share of what is left to the path at each grid point, is at most 1."""

    def __init__(self, first: Array, second: Array) -> None:
        super().__init__()
        self.set_discretization_type(1)
        self.identical = True
        self._first, self._second = first, second
        self._format_string = "acceleration"

    def compute_constraint_params(self, path: object, gridpoints: Array, *_: object, **__: object) -> tuple[Any, ...]:
        """a, b, c (M, 2 D), F and g of F (a u + b x + c) <= g; no bounds."""
        none, one = np.zeros_like(self._first), np.eye(self._first.shape[1])
        rows, ends = np.concatenate([one, -one]), np.ones(2 * len(one))
        made = canlinear_colloc_to_interpolate(
            self._first, self._second, none, rows, ends, None, None, gridpoints, identical=True
        )
        return tuple(made)
