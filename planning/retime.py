"""How fast along the curve: TOPP-RA (Pham and Pham 2018) over the next horizon, always ending at rest.

What was measured of toppra 0.6.10 and is kept here: about 20 us a grid point, so the horizon has few; the start speed
is carried at most at 0.999 of a limit, or half of all replans fail; the speed between grid points follows constant
acceleration (ParametrizeConstAccel's rule), not a spline; a solve can end without a result or with an infinite time.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass
from typing import Any

import numpy as np
import toppra
from numpy.typing import NDArray
from toppra import constraint
from toppra.algorithm import TOPPRA
from toppra.interpolator import AbstractGeometricPath

from estimation.se3 import Array
from planning.curve import Curve

logging.getLogger("toppra").setLevel(logging.CRITICAL)  # its failures are handled here, not printed

GRID = 60  # evenly spread grid points of one horizon
CARRIED = 0.999  # of a limit, as start speed


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


def retime(
    curve: Curve, start: float, end: float, speed: float, now: float, turn: Array, limits: tuple[Array, Array]
) -> Timing | str:
    """The fastest timing from `start` to `end`, mm, that begins at `now`, s, with `speed`, mm/s, and ends at rest.

    turn: (3, 3) rotation from the surface to the arm's frame. limits: speed and acceleration (6,) of the six axes in
    it, which the curve alone may use. The speeds of the curve's stretches hold everywhere, not at grid points only.
    A str says why there is none.
    """
    grid = _grid(curve, start, end)
    allowed = _allowed(curve, grid)
    rate, strength = limits
    constraints = [
        constraint.JointVelocityConstraint(np.stack([-rate, rate], 1)),
        constraint.JointAccelerationConstraint(np.stack([-strength, strength], 1)),
        _ToolSpeed(allowed),
    ]
    for constrained in constraints:
        constrained.set_discretization_type(1)  # checked at both ends of each interval
    instance = TOPPRA(constraints, _AxesCurve(curve, turn, grid), gridpoints=grid, solver_wrapper="seidel")
    try:
        _, speeds, _ = instance.compute_parameterization(min(speed, CARRIED * allowed[0]), 0.0)
    except (ValueError, toppra.exceptions.ToppraError) as error:
        return f"no timing from {start:.2f} to {end:.2f} mm: {error}"
    if speeds is None or not np.isfinite(speeds).all():
        return f"no timing from {start:.2f} to {end:.2f} mm at {speed:.2f} mm/s"
    pace = speeds[:-1] + speeds[1:]
    if (pace <= 0).any():
        return f"no timing from {start:.2f} to {end:.2f} mm: it would stand still"
    return Timing(now + np.concatenate([[0.0], np.cumsum(2 * np.diff(grid) / pace)]), grid, np.asarray(speeds))


def _grid(curve: Curve, start: float, end: float) -> Array:
    """Grid points on [start, end], mm: evenly spread, and where there is room the bounds and middle of each blend."""
    even = np.linspace(start, end, GRID)
    inside = (curve.knots > start) & (curve.knots < end)
    if inside.sum() > GRID // 3:
        return even
    knots, half = curve.knots[inside], curve.half[inside]
    points = np.concatenate([even, knots - half, knots, knots + half])
    points = np.unique(points[(points >= start) & (points <= end)])
    apart = np.concatenate([[True], np.diff(points) > 1e-6])
    points = points[apart]
    points[-1] = end
    return np.asarray(points)


def _allowed(curve: Curve, grid: Array) -> Array:
    """Speed (M,), mm/s, that the stretches and corners on both sides of each grid point bear."""
    first, last = curve.stretch(grid[:-1]), curve.stretch(np.nextafter(grid[1:], 0.0))
    between = np.array([curve.speed[a : b + 1].min() for a, b in zip(first, last, strict=True)])
    for knot in range(first[0], last[-1] + 2):
        if np.isfinite(curve.corner[knot]):
            bounds = curve.knots[knot] + curve.half[knot] * np.array([-1.0, 1.0])
            a, b = max(int(np.searchsorted(grid, bounds[0], "right")) - 1, 0), int(np.searchsorted(grid, bounds[1]))
            between[a:b] = np.minimum(between[a:b], curve.corner[knot])
    return np.concatenate([between[:1], np.minimum(between[:-1], between[1:]), between[-1:]])


class _AxesCurve(AbstractGeometricPath):  # type: ignore[misc]
    """A curve as toppra reads it: X Y Z in the arm's frame and three rates of turn."""

    def __init__(self, curve: Curve, turn: Array, grid: Array) -> None:
        self._curve, self._turn, self._interval = curve, turn, grid[[0, -1]]

    @property
    def dof(self) -> int:
        """Six axes."""
        return 6

    @property
    def path_interval(self) -> Array:
        """First and last s (2,), mm."""
        return self._interval

    def __call__(self, path_positions: Array, order: int = 0) -> Array:
        """Derivatives (M, 6) of the given order, 0 to 2, at s (M,)."""
        s = np.atleast_1d(path_positions)
        if order == 0:
            moved, turned = self._curve.poses(s)[:, :3, 3], np.zeros((len(s), 3))
        elif order == 1:
            moved, turned = self._curve.slope(s), self._curve.spin[self._curve.stretch(s)]
        else:
            moved, turned = self._curve.curvature(s), np.zeros((len(s), 3))
        return np.concatenate([moved @ self._turn.T, turned], axis=1)


class _ToolSpeed(constraint.LinearConstraint):  # type: ignore[misc]
    """Speed along the curve at each grid point: exact for the tool, whose way is never longer than the curve's."""

    def __init__(self, allowed: Array) -> None:
        super().__init__()
        self._allowed = allowed
        self._format_string = "tool speed"

    def compute_constraint_params(self, path: object, gridpoints: Array, *_: object, **__: object) -> tuple[Any, ...]:
        """Bounds (M, 2) on the squared speed; no other parameter."""
        return None, None, None, None, None, None, np.stack([np.zeros(len(gridpoints)), self._allowed**2], 1)
