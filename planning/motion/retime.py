"""The timing along a curve: TOPP-RA (Pham and Pham 2018) over the next horizon, always ending at rest.

The axis limits hold for path and surface together: at each grid point the surface's predicted motion is subtracted
from them, the path gets what is left. Corners lie between grid points, too: each is passed so slowly that no axis
changes its speed within it faster than what is left allows, or by more in one tick than straight back would. The speed
changes by no more than the cruising speed in RISE_TIME, because the follower's limited jerk rounds off what is faster:
without that, a start at 5 mm/s was measured to cost 40 um along the path.

Measured with toppra 0.6.10: its passes take 20 us a grid point, its programs 4; the start speed must stay at 0.999 of a
limit or less, or half of all replans fail; the speed between grid points follows constant acceleration (the rule of
ParametrizeConstAccel), not a spline; a solve can end without a result or with an infinite time. It is exact to a fixed
1e-8 of any unit: in mm, 3 of 600 random paths had no result; in units of the horizon's length, none.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimation import se3
from estimation.pose import SurfacePose, TrackState
from estimation.runtime import stub_modules
from estimation.se3 import Array
from planning.command import MotionLimits
from planning.kinematics import SimpleArm, axis_limits, limited_axes, max_axis_change, nozzle_from_axes
from planning.material import material_plan
from planning.motion.curve import HORIZON_TIME, Gridpoints, PathCurve, curve_through, gridpoints_on
from planning.path import Path

# a second, for plots, other curves and another solver, for which nobody asks
with stub_modules("matplotlib", "matplotlib.pyplot", "scipy.interpolate", "toppra.solverwrapper.ecos_solverwrapper"):
    from toppra import constraint
    from toppra.constants import MAX_TRIES, SMALL, TINY
    from toppra.constraint.linear_constraint import canlinear_colloc_to_interpolate
    from toppra.interpolator import AbstractGeometricPath
    from toppra.solverwrapper import seidelWrapper

DIFFERENCE_STEP = 0.05  # mm along the path between differences: what a slow tool moves in one tick
DIFFERENCE_TIME = 0.02  # s between differences: one tick
FILTER_RADIUS = 3  # grid points to each side, of a horizon's 30: a place may be passed later than at its earliest
START_SPEED_FRACTION = 0.999  # of a limit, as start speed
RISE_TIME = 0.1  # s from rest to cruising speed: a start then costs 3 um along the path, with half of it 9
LIMIT_SHARE = 0.8  # of the axis limits, for path and surface together; the rest corrects what was not predicted
PATH_SPEED_SHARE, PATH_ACCELERATION_SHARE = 0.5, 0.2  # of the axis limits, for the path at most: jerk allows no more
MIN_PATH_SHARE = 0.02  # of the axis limits, for the path however the surface moves: slow, but never stuck
FASTEST_OBJECTIVE = np.array([1e-9, -1.0])  # toppra's: greatest squared speed, then the least acceleration
PASSING_HORIZONS = 20  # looked at in one go where the whole path is timed
BRAKING_FRACTION = 0.9  # of the allowed change of speed, by which a speed that is too high is reduced


@dataclass(frozen=True, slots=True, eq=False)
class AxisDerivatives:
    """The D limited axes (`limited_axes`; mm, rad) at M grid points of a curve on a moving surface."""

    axes: Array  # (M, D) when each point is passed at its earliest
    first: Array  # (M, D) derivative per mm; beside a corner the largest of both sides
    second: Array  # (M, D) second derivative per mm
    bend: Array  # (M, D) largest change of `first` per mm within a corner beside the point
    swerve: Array  # (M, D) largest change of `first` over such a corner
    speed: Array  # (M, D) per s, largest of the surface's predicted motion alone around the point
    acceleration: Array  # (M, D) per s^2, the same


def axis_derivatives(
    arm: SimpleArm, pose: SurfacePose, curve: PathCurve, grid: Gridpoints, begin: float
) -> AxisDerivatives:
    """The derivatives where the surface moves as `pose` predicts and the grid is entered at `begin`, s.

    X Y Z follow from the curve's own derivatives, blends included, the other axes from differences.
    """
    places, times = grid.places, begin + grid.due
    count = len(places)
    nozzle = curve.poses(np.concatenate([places - DIFFERENCE_STEP, places, places + DIFFERENCE_STEP]))
    if pose.warp is not None:
        nozzle = pose.warp.apply_to_poses(nozzle)
    base = pose.predicted_poses(np.concatenate([times - DIFFERENCE_TIME, times, times + DIFFERENCE_TIME]))
    nozzle, base = nozzle.reshape(3, count, 4, 4), base.reshape(3, count, 4, 4)
    now = base[1]
    # by place on the surface at rest, and by time at a fixed place: (2, 3, M, D)
    axes = limited_axes(arm, np.stack([now @ nozzle, base @ nozzle[1]])).reshape(2, 3, count, -1)
    first, second = _differences(axes[0], DIFFERENCE_STEP)
    turn = arm.arm_from_base[:3, :3] @ now[:, :3, :3]
    along = turn @ np.stack(curve.derivatives(places), axis=-1)
    first[:, :3], second[:, :3] = along[..., 0], along[..., 1]
    surface = _largest_near(np.abs(np.stack(_differences(axes[1], DIFFERENCE_TIME))))
    by_move, by_turn = max_axis_change(arm, axes[0, 1])
    bend = by_move * grid.bend[:, None] + by_turn * grid.swing[:, None]
    largest = by_move + by_turn * grid.spin[:, None]
    first = np.where(bend > 0, np.copysign(np.maximum(np.abs(first), largest), first), first)
    return AxisDerivatives(axes[0, 1], first, second, bend, 2 * largest, *surface)


def _largest_near(values: Array) -> Array:
    """The largest of (K, M, D) values within FILTER_RADIUS grid points of each (scipy.ndimage loads for 0.15 s)."""
    out = values.copy()
    for k in range(1, FILTER_RADIUS + 1):
        np.maximum(out[:, k:], values[:, :-k], out=out[:, k:])
        np.maximum(out[:, :-k], values[:, k:], out=out[:, :-k])
    return out


def _differences(values: Array, step: float) -> tuple[Array, Array]:
    """First and second derivative (M, D) of values (3, M, D) `step` apart."""
    before, middle, after = values
    return (after - before) / (2 * step), (after - 2 * middle + before) / step**2


@dataclass(frozen=True, slots=True, eq=False)
class Timing:
    """s over time on one horizon."""

    times: Array  # (M,) s
    places: Array  # (M,) mm
    speeds: Array  # (M,) mm/s, the last 0

    @property
    def end(self) -> float:
        """The instant, s, at which it comes to rest."""
        return float(self.times[-1])

    def at(self, t: Array) -> Array:
        """Places (N,), mm, at instants (N,), s; before the start and after the end it rests."""
        i, dt, rate = self._interval(np.clip(t, self.times[0], self.times[-1]))
        return np.asarray(self.places[i] + dt * (self.speeds[i] + 0.5 * dt * rate))

    def speed_at(self, t: float) -> float:
        """Speed, mm/s, at the instant t, s; 0 outside."""
        if not self.times[0] <= t <= self.times[-1]:
            return 0.0
        i, dt, rate = self._interval(np.array([t]))
        return float((self.speeds[i] + dt * rate)[0])

    def _interval(self, t: Array) -> tuple[NDArray[np.intp], Array, Array]:
        """The interval (N,) of instants (N,), the time since its start, s, and the change of speed in it, mm/s^2."""
        i = np.clip(np.searchsorted(self.times, t, "right") - 1, 0, len(self.times) - 2)
        rate = (self.speeds[i + 1] - self.speeds[i]) / (self.times[i + 1] - self.times[i])
        return i, t - self.times[i], rate


def retime(
    grid: Gridpoints, derivatives: AxisDerivatives, speed: float, begin: float, limits: tuple[Array, Array]
) -> Timing | str:
    """The fastest timing along the grid that begins at `begin`, s, with `speed`, mm/s, and ends at rest.

    limits: speed and acceleration (D,) of the limited axes. The grid's speed bounds hold everywhere, not only at its
    points. A start speed above limits that have shrunk is reduced to them as fast as the grid's `cruise` allows.
    A str says why there is no timing.
    """
    initial = min(speed, START_SPEED_FRACTION * float(grid.allowed[0]))
    change = grid.cruise / RISE_TIME
    available = _path_share(limits[1], derivatives.acceleration, PATH_ACCELERATION_SHARE)
    axes = _axis_speed(derivatives, _path_share(limits[0], derivatives.speed, PATH_SPEED_SHARE), available)
    # the bounds fall below the start speed no faster than the allowed change of speed
    fall = 2 * BRAKING_FRACTION * float(change.min()) * (grid.places - grid.places[0])
    braking = np.sqrt(np.maximum(initial**2 - fall, 0.0))
    bounds = np.minimum(grid.allowed, np.maximum(axes, braking / START_SPEED_FRACTION))
    start, end = grid.places[[0, -1]]
    unit = end - start
    constraints = [_Speed(bounds / unit, change / unit), *_acceleration(derivatives, available, bounds, change, unit)]
    speeds = _solve(constraints, (grid.places - start) / unit, initial / unit)
    if speeds is None or not np.isfinite(speeds).all():
        return f"no timing from {start:.2f} to {end:.2f} mm at {speed:.2f} mm/s"
    pace = unit * (speeds[:-1] + speeds[1:])
    if (pace <= 0).any():
        return f"no timing from {start:.2f} to {end:.2f} mm: it would stand still"
    times = begin + np.concatenate([[0.0], np.cumsum(2 * np.diff(grid.places) / pace)])
    return Timing(times, grid.places, np.asarray(unit * speeds))


def run_times(path: Path, arm: SimpleArm, limits: MotionLimits, tick: float) -> Array:
    """Times (N,), s, at which a run over a surface at rest is at the checkpoints; the first, 0, is where it begins.

    Waits are in it; the way there, and the time in which somebody puts another material in, are not.
    """
    curve = curve_through(path.surface_from_nozzle, path.speed[1:], ~path.extrude[1:])
    times = passing_times(curve, arm, axis_limits(arm, replace(limits, speed=limits.per_tick(tick))))
    for rest in material_plan(path, curve.knots).rests:
        times[rest.checkpoint :] += rest.wait
    return times


def passing_times(curve: PathCurve, arm: SimpleArm, limits: tuple[Array, Array]) -> Array:
    """Times (K,), s from the start at rest, at which the checkpoints are passed where the surface is at rest.

    limits: as `retime` takes them. The whole curve under its rules, the middle of it where the arm is at home, but for
    the acceleration that a curve takes at a steady speed outside its corners. Joints count only where they reach.
    `python -m tests.campaigns planner` says how far off it is.
    """
    at_home = nozzle_from_axes(arm, arm.home) @ se3.inverse(curve.poses(np.array([curve.length / 2]))[0])
    pose = SurfacePose(0.0, at_home, np.eye(6), np.zeros(6), TrackState.TRACKING)  # how well it is known does not count
    parts = []  # places, mm, the greatest speed at each, and its greatest change
    begin = 0.0
    while begin < curve.length:
        end = curve.after(begin, PASSING_HORIZONS * HORIZON_TIME)
        due = float(np.diff(np.interp([begin, end], curve.knots, curve.due))[0])
        grid = gridpoints_on(curve, begin, end, math.ceil(due / HORIZON_TIME))
        derivatives = axis_derivatives(arm, pose, curve, grid, 0.0)
        available = _path_share(limits[1], derivatives.acceleration, PATH_ACCELERATION_SHARE)
        speed = _axis_speed(derivatives, _path_share(limits[0], derivatives.speed, PATH_SPEED_SHARE), available)
        rate = (available / np.maximum(np.abs(derivatives.first), 1e-12)).min(axis=1)
        parts.append(np.stack([grid.places, np.fmin(grid.allowed, speed), np.fmin(grid.cruise / RISE_TIME, rate)]))
        begin = end
    places, fastest, rate = np.concatenate(parts, axis=1)
    lengths = np.diff(places)
    squared, gains = (fastest**2).tolist(), (2 * np.minimum(rate[:-1], rate[1:]) * lengths).tolist()
    squared[0] = squared[-1] = 0.0
    for i, gain in enumerate(gains):
        squared[i + 1] = min(squared[i + 1], squared[i] + gain)
    for i in reversed(range(len(gains))):
        squared[i] = min(squared[i], squared[i + 1] + gains[i])
    speeds = np.sqrt(squared)
    pace = np.maximum(speeds[:-1] + speeds[1:], 1e-9)
    times = np.concatenate([[0.0], np.cumsum(2 * lengths / pace)])
    return np.asarray(np.interp(curve.knots, places, times))


def _path_share(limit: Array, by_surface: Array, share: float) -> Array:
    """What the surface, which takes (M, D) of limits (D,), leaves to the path: (M, D), at most `share` of each."""
    return np.clip(LIMIT_SHARE * limit - by_surface, MIN_PATH_SHARE * limit, share * limit)


def _axis_speed(derivatives: AxisDerivatives, speed: Array, acceleration: Array) -> Array:
    """Speed (M,), mm/s, at which no axis exceeds the path's share (M, D) of the limits, on straights and in corners."""
    straight = speed / np.maximum(np.abs(derivatives.first), 1e-12)
    within, at_once = (acceleration / np.maximum(change, 1e-12) for change in (derivatives.bend, derivatives.swerve))
    return np.asarray(np.minimum(straight, np.maximum(np.sqrt(within), DIFFERENCE_TIME * at_once)).min(axis=1))


def _acceleration(
    derivatives: AxisDerivatives, limit: Array, speed: Array, change: Array, unit: float
) -> list[_Acceleration]:
    """The acceleration constraint on the axes that can reach their bound, lengths in `unit` mm; [] where none can.

    An axis that cannot reach it at the greatest speed and change of speed only costs time.
    """
    first, second = derivatives.first / limit, derivatives.second / limit
    reached = ~((np.abs(first) * change.max() + np.abs(second) * speed[:, None] ** 2).max(axis=0) <= 1)  # NaN is
    return [_Acceleration(first[:, reached] * unit, second[:, reached] * unit**2)] if reached.any() else []


def _solve(constraints: list[constraint.LinearConstraint], places: Array, start: float) -> Array | None:
    """The fastest speeds (M,) along places (M,), 0 to 1, from `start` to rest; None where there are none.

    The two passes of TOPP-RA with toppra's linear program at each point and its guards against rounding, in plain
    floats: toppra's own loops take three times as long. Rest is controllable everywhere, since at rest no limit is
    near; so the lower end of the controllable set is 0 and is not solved for.
    """
    steps = np.diff(places)
    if not (steps > 0).all():
        return None
    program = seidelWrapper(constraints, _Way(places), places, solve_lp1d=True).solve_stagewise_optim
    greatest = np.zeros(len(places)).tolist()  # backward pass: squared speed from which the end can be reached
    for i in reversed(range(len(places) - 1)):
        greatest[i] = program(i, None, FASTEST_OBJECTIVE, math.nan, math.nan, 0.0, greatest[i + 1])[1]
        if math.isnan(greatest[i]):
            return None
    squared = [start**2]  # forward pass: the greatest squared speed within those bounds
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
        next_squared = squared[i] + 2 * step * rate
        squared.append(min(greatest[i + 1], max(next_squared - TINY, 0.9999 * next_squared, 0.0)))
    return np.sqrt(squared)


class _Way(AbstractGeometricPath):  # type: ignore[misc]
    """The part of a path that toppra needs where the constraints know the rest."""

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
    """Bounds on the speed along the curve and on its change; exact for the tool, whose way is never longer."""

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
    """|q' u + q'' x| <= 1 of each axis, (M, D) relative to the path's share of its limit at each grid point."""

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
        terms = self._first, self._second, none, rows, ends, None, None, gridpoints
        return tuple(canlinear_colloc_to_interpolate(*terms, identical=True))
