"""The path, its approach and its exit as curves, the grid points at which they are timed, and axes that follow.

Stretches between checkpoints are straight, corners are parabolic blends (Kunz and Stilman 2012; parabolas also serve
reversals). The first derivative is continuous and never longer than 1, so the speed along the curve bounds the tool's
speed. A cubic spline through sparse checkpoints left the path by 1 mm and ran at 2.7 times the speed limit in corners.

The tool's rotation is blended over the same length: the stretch's own turn, then a parabola times the change of spin.
The change is fixed in the tool's frame when the tool turns about it, so the spin is continuous, exactly.

Six axes follow a target that moves on it, under speed, acceleration and jerk limits: each aims at the state that the
target will have LOOKAHEAD s from now, to reach it then. A time-optimal controller that aims at the present state
chatters between the limits (measured: 0.26 mm rms; this way 0.02 mm). If the quintic from here to there keeps the
limits, it is taken; otherwise the motion of Ruckig (Berscheid and Kroeger 2021), which always keeps them. Ruckig alone
is not enough: with a minimum duration its motions are not unique, and it was measured to send an axis with nothing to
do 0.17 mm away and back at full jerk (0.040 mm rms off a still path; this way 0.004).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from ruckig import ControlInterface, InputParameter, Ruckig, RuckigError, Synchronization, Trajectory

from estimation import se3
from estimation.se3 import Array
from planning.command import MotionLimits
from planning.path import LEVER_ARM, MIN_SPACING, lengths_from, moves_and_turns, way_lengths

LOOKAHEAD = 0.1  # s; half of it doubled the error by chatter, twice of it by errors of the prediction
LIMIT_FRACTION = 0.999  # of each limit, so that rounding never breaks one


class AxisFollower:
    """Commanded position, velocity and acceleration of the axes (6,) each; a call moves them one tick."""

    def __init__(self, axes: Array, limits: MotionLimits, tick: float) -> None:
        self.position, self.velocity, self.acceleration = axes.copy(), np.zeros(6), np.zeros(6)
        self._speed = LIMIT_FRACTION * limits.per_tick(tick)
        self._acceleration, self._jerk = LIMIT_FRACTION * limits.acceleration, LIMIT_FRACTION * limits.jerk
        self._tick, self._ruckig = tick, Ruckig(6, tick)

    @property
    def at_rest(self) -> bool:
        """Whether no axis moves."""
        return not self.velocity.any() and not self.acceleration.any()

    def rest(self, axes: Array | None = None) -> None:
        """Set the motion to rest, at `axes` (6,) if given: the arm was stopped by others."""
        self.position = self.position if axes is None else axes.copy()
        self.velocity, self.acceleration = np.zeros(6), np.zeros(6)

    def aim(self, position: Array, velocity: Array, acceleration: Array) -> Array | str:
        """Move one tick towards the target's state (6,) each, LOOKAHEAD s from now; new axes (6,).

        A target faster than the limits is followed as fast as they allow. A str says why there is no such motion.
        """
        start = np.stack([self.position, self.velocity, self.acceleration])
        controls = _quintic(start, np.stack([position, velocity, acceleration]))
        limits = self._speed, self._acceleration, self._jerk
        within = [(np.abs(c) <= limit).all(axis=0) for c, limit in zip(controls[1:], limits, strict=True)]
        smooth = np.all(within, axis=0)  # (6,) axes whose quintic keeps the limits
        state = np.stack([_bezier(control, self._tick / LOOKAHEAD) for control in controls[:3]])
        if not smooth.all():
            request = self._request()
            request.target_position = position
            request.target_velocity = np.clip(velocity, -LIMIT_FRACTION * self._speed, LIMIT_FRACTION * self._speed)
            request.minimum_duration = LOOKAHEAD
            limited = self._solve(request)
            if isinstance(limited, str):  # the axes cannot share one duration: each as soon as it can
                request.synchronization, request.minimum_duration = Synchronization.No, None
                limited = self._solve(request)
            if isinstance(limited, str):
                return limited
            state = np.where(smooth, state, limited)
        return self._take(state)

    def brake(self) -> Array | str:
        """Move one tick towards rest as fast as the limits allow; new axes (6,), or why there is no such motion."""
        request = self._request()
        request.control_interface = ControlInterface.Velocity
        request.synchronization = Synchronization.No  # together, one brake in 30,000 ticks had no solution
        state = self._solve(request)
        return state if isinstance(state, str) else self._take(state)

    def _request(self) -> InputParameter:
        request = InputParameter(6)
        request.current_position, request.current_velocity = self.position, self.velocity
        request.current_acceleration = self.acceleration
        request.max_velocity, request.max_acceleration, request.max_jerk = self._speed, self._acceleration, self._jerk
        return request

    def _solve(self, request: InputParameter) -> Array | str:
        """Position, velocity and acceleration (3, 6) one tick on."""
        motion = Trajectory(6)  # not Ruckig.update: it keeps its last input, and answers an equal one with nothing
        try:
            self._ruckig.calculate(request, motion)
        except RuckigError as error:
            return f"no motion within the limits: {' '.join(str(error).split())[:80]}"
        state = np.array(motion.at_time(self._tick))
        return state if np.isfinite(state).all() else "no motion within the limits: its solution is not finite"

    def _take(self, state: Array) -> Array:
        self.position, self.velocity, self.acceleration = state
        if np.abs(self.velocity).max() < 1e-9 and np.abs(self.acceleration).max() < 1e-6:
            self.velocity, self.acceleration = np.zeros(6), np.zeros(6)
        return self.position.copy()


def _quintic(start: Array, end: Array) -> tuple[Array, Array, Array, Array]:
    """Bernstein control points (6 to 3, 6) of position, velocity, acceleration, jerk between states LOOKAHEAD s apart.

    start, end: (3, 6). A derivative stays between the least and the greatest of its control points.
    """
    (p0, v0, a0), (p1, v1, a1) = start, end
    fifth, twentieth = LOOKAHEAD / 5, LOOKAHEAD**2 / 20
    first_half = p0, p0 + fifth * v0, p0 + 2 * fifth * v0 + twentieth * a0
    position = np.stack([*first_half, p1 - 2 * fifth * v1 + twentieth * a1, p1 - fifth * v1, p1])
    velocity = 5 / LOOKAHEAD * np.diff(position, axis=0)
    acceleration = 4 / LOOKAHEAD * np.diff(velocity, axis=0)
    return position, velocity, acceleration, np.asarray(3 / LOOKAHEAD * np.diff(acceleration, axis=0))


def _bezier(control: Array, u: float) -> Array:
    """Value (6,) at u in 0..1 of the polynomial with control points (N, 6) (de Casteljau)."""
    while len(control) > 1:
        control = control[:-1] + u * (control[1:] - control[:-1])
    return np.asarray(control[0])


BLEND_TOLERANCE = 1e-9  # mm: this near its ends a blend has begun; its ends are known no better
MIN_HORIZON = 1.0  # mm: long enough to stop from any printing speed
MIN_BLEND = 1e-9  # mm: half length of a blend that is none, where nothing changes at a checkpoint
HORIZON_TIME = 1.0  # s of path timed at once: any speed can be stopped in it
HORIZON_POINTS = 30  # evenly spread grid points of one horizon: some 15 us for each
FEW_KNOTS = 10  # checkpoints in one horizon up to which each has grid points of its own
MAX_MORE_POINTS = 100  # beside the even ones: 1.5 ms, twice a second
SPEED_CHANGE = 0.1  # share of the speed that it changes by at a checkpoint with a grid point of its own
LOOK_ASIDE = 25.0  # mm beside the path: a cartridge is 8 mm in radius, and its picture leans out as it is nearer
APPROACH_HEIGHT = 10.0  # mm above the surface, along the nozzle, on the way to and from the path
APPROACH_SPEED = 20.0  # mm/s on that way, slow enough for a person to step in
DIRECT_DISTANCE = 2.0  # mm: from here the nozzle goes straight to its place, without going up first
CORNER_TOLERANCE = 0.05  # mm by which corners are cut: an eighth of a thin bead
FREE_CORNER_TOLERANCE = 0.5  # mm by which corners are cut where nothing is printed on either side
FREE_CORNER_SHARE = 0.1  # of the shorter of both sides, at most: a lift of 3 mm loses 0.6 of them, cut and follower


@dataclass(frozen=True, slots=True, eq=False)
class PathCurve:
    """A curve through K checkpoints in the surface frame, by length s in mm (turns count too, see path.LEVER_ARM)."""

    knots: Array  # (K,) s of the checkpoints, from 0
    points: Array  # (K, 3) mm
    rotations: Array  # (K, 3, 3) of the nozzle
    direction: Array  # (K-1, 3) of each stretch
    spin: Array  # (K-1, 3) of each stretch, body rad/mm
    bend: Array  # (K, 3) change of direction at each checkpoint
    swing: Array  # (K, 3) change of spin at each checkpoint
    half: Array  # (K,) mm, length of the blend before and after each; 0 where there is none
    bend_rate: Array  # (K, 3) bend / (4 half), 0 where there is no blend
    swing_rate: Array  # (K, 3) swing / (4 half), 0 where there is no blend
    speed: Array  # (K-1,) mm/s allowed on each stretch
    corner: Array  # (K,) mm/s allowed in each blend
    slows: NDArray[np.bool_]  # (K,) whether that is less than on the stretches beside it
    changes: NDArray[np.bool_]  # (K,) whether these differ by more than SPEED_CHANGE
    due: Array  # (K,) s, when each checkpoint is reached at the stretches' speeds

    @property
    def length(self) -> float:
        """mm."""
        return float(self.knots[-1])

    def after(self, s: float, seconds: float) -> float:
        """The place, mm, `seconds` s after s at the speeds allowed: at least MIN_HORIZON on, at most the end."""
        there = float(np.interp(np.interp(s, self.knots, self.due) + seconds, self.due, self.knots))
        return min(max(there, s + MIN_HORIZON), self.length)

    def stretch(self, s: Array) -> NDArray[np.intp]:
        """Number (...) of the stretch that each s (...) lies on; a checkpoint belongs to the stretch after it."""
        return np.asarray(np.searchsorted(self.knots[1:-1], s, "right"))

    def poses(self, s: Array) -> Array:
        """surface_from_nozzle (N, 4, 4) at s (N,), mm."""
        i = self.stretch(s)
        along = (s - self.knots[i])[:, None]
        into, out_of = self._depths(i, s)
        before, after = np.maximum(into, 0.0) ** 2, np.maximum(out_of, 0.0) ** 2
        turns = self.spin[i] * along, after * self.swing_rate[i] + before * self.swing_rate[i + 1]
        rounding = after * self.bend_rate[i] + before * self.bend_rate[i + 1]
        return se3.make(_turned(self.rotations[i], *turns), self.points[i] + self.direction[i] * along + rounding)

    def derivatives(self, s: Array) -> tuple[Array, Array]:
        """First derivative (N, 3) of the position at s (N,), at most 1 long, and second (N, 3), 1/mm.

        Where the second derivative steps, the larger side is given.
        """
        i = self.stretch(s)
        into, out_of = self._depths(i, s)
        before, after = 2 * self.bend_rate[i + 1], 2 * self.bend_rate[i]
        first = self.direction[i] + np.maximum(into, 0.0) * before - np.maximum(out_of, 0.0) * after
        return np.asarray(first), np.asarray((into > -BLEND_TOLERANCE) * before + (out_of > -BLEND_TOLERANCE) * after)

    def _depths(self, i: NDArray[np.intp], s: Array) -> tuple[Array, Array]:
        """How deep s (N,) is in the blend at the end and at the start of its stretch i, mm (N, 1), negative outside."""
        into, out_of = s - self.knots[i + 1] + self.half[i + 1], self.knots[i] + self.half[i] - s
        return into[:, None], out_of[:, None]


def curve_through(surface_from_nozzle: Array, speed: Array, free: NDArray[np.bool_]) -> PathCurve:
    """The curve through poses (K, 4, 4), no two in a row the same.

    speed: (K-1,) mm/s. free: (K-1,) whether nothing is printed on a stretch: corners between two such are cut by more.
    A turn counts as the motion of a point LEVER_ARM beside the tip.
    """
    points, rotations = surface_from_nozzle[:, :3, 3], surface_from_nozzle[:, :3, :3]
    moves, turns = moves_and_turns(surface_from_nozzle)
    length = lengths_from(moves, turns)
    direction, spin = moves / length[:, None], turns / length[:, None]
    bend, swing = np.zeros_like(points), np.zeros_like(points)
    bend[1:-1], swing[1:-1] = np.diff(direction, axis=0), np.diff(spin, axis=0)
    turned = np.maximum(np.linalg.norm(bend, axis=1), LEVER_ARM * np.linalg.norm(swing, axis=1))
    half, tolerance, shortest = np.zeros(len(points)), np.full(len(points), CORNER_TOLERANCE), np.zeros(len(points))
    shortest[1:-1] = np.minimum(length[:-1], length[1:])
    cut = np.clip(FREE_CORNER_SHARE * shortest, CORNER_TOLERANCE, FREE_CORNER_TOLERANCE)
    tolerance[1:-1] = np.where(free[:-1] & free[1:], cut[1:-1], CORNER_TOLERANCE)
    longest = 4 * tolerance[1:-1] / np.maximum(turned[1:-1], 1e-9)  # the curve passes a corner at |bend| * half / 4
    half[1:-1] = np.where(turned[1:-1] > 1e-9, np.minimum(longest, shortest[1:-1] / 2), 0.0)
    knots, due = (np.concatenate([[0.0], np.cumsum(along)]) for along in (length, length / speed))
    # a velocity change in less than LOOKAHEAD cuts the corner by LOOKAHEAD / 8 of it: by `tolerance` once more
    corner = np.where(half > 0, 8 * tolerance / LOOKAHEAD / np.maximum(turned, 1e-9), np.inf)
    quarter = np.where(half > 0, 0.25 / np.where(half > 0, half, 1.0), 0.0)[:, None]
    blends = bend, swing, half, bend * quarter, swing * quarter
    speed = np.asarray(speed, float)
    before, after = np.append(speed[:1], speed), np.append(speed, speed[-1:])
    slows, changes = (
        corner < np.maximum(before, after),
        np.abs(before - after) > SPEED_CHANGE * np.maximum(before, after),
    )
    return PathCurve(knots, points, rotations, direction, spin, *blends, speed, corner, slows, changes, due)


def _turned(rotation: Array, along: Array, within: Array) -> Array:
    """Rotations (N, 3, 3) turned by one body vector (N, 3), rad, and then another; an upright path's cost nothing."""
    if not along.any() and not within.any():
        return rotation
    first, second = se3.exp_rotation(np.stack([along, within]))
    return np.asarray(rotation @ first @ second)


@dataclass(frozen=True, slots=True, eq=False)
class Gridpoints:
    """M grid points on a part of a curve, rising. Each bound is the strictest of both sides of its point."""

    places: Array  # (M,) mm
    allowed: Array  # (M,) mm/s allowed on the stretches and in the corners
    cruise: Array  # (M,) mm/s allowed on the stretches alone
    bend: Array  # (M,) 1/mm, largest change of direction per mm within a corner
    swing: Array  # (M,) rad/mm^2, largest change of spin per mm within a corner
    spin: Array  # (M,) rad/mm, largest spin

    @property
    def due(self) -> Array:
        """Earliest time (M,), s after the first point, at which each is reached: at the speeds allowed."""
        pace = self.allowed[:-1] + self.allowed[1:]
        return np.concatenate([[0.0], np.cumsum(2 * np.diff(self.places) / pace)])


def gridpoints_on(curve: PathCurve, start: float, end: float, horizons: int = 1) -> Gridpoints:
    """Grid points from `start` to `end`, mm: evenly spread, and where there is room the ends of each blend.

    horizons: as many as lie between them.
    """
    places = _places(curve, start, end, horizons)
    first, last = curve.stretch(places[:-1]), curve.stretch(np.nextafter(places[1:], 0.0))
    first_blend = np.searchsorted(curve.knots + curve.half, places[:-1], "right")  # the first blend not yet passed
    last_blend = np.searchsorted(curve.knots - curve.half, places[1:], "left") - 1  # the last one begun
    part = slice(int(min(first[0], first_blend[0])), int(max(last[-1], last_blend[-1])) + 2)
    stretches, corners = (first - part.start, last - part.start), (first_blend - part.start, last_blend - part.start)
    within = 2 * np.maximum(curve.half[part], MIN_BLEND)
    bend, swing, spin = (np.linalg.norm(of[part], axis=1) for of in (curve.bend, curve.swing, curve.spin))
    of_corners = np.stack([1 / curve.corner[part], bend / within, swing / within], axis=1)
    of_stretches = np.stack([1 / curve.speed[part], spin], axis=1)
    slowest, bend, swing = _at_points(_largest(of_corners, *corners)).T
    cruise, spin = _at_points(_largest(of_stretches, *stretches)).T
    return Gridpoints(places, 1 / np.maximum(cruise, slowest), 1 / cruise, bend, swing, spin)


def _places(curve: PathCurve, start: float, end: float, horizons: int) -> Array:
    """Even ones, and where the allowed speed changes: ends of blends, of all or of those that slow, and checkpoints.

    Between two points the slowest place counts. With even points alone a corner 0.1 mm long is passed slowly for 1.3 mm
    on a horizon of 20 mm: dense paths took a third longer.
    """
    inside = slice(int(np.searchsorted(curve.knots, start, "right")), int(np.searchsorted(curve.knots, end, "left")))
    knots, half, slows = curve.knots[inside], curve.half[inside], curve.slows[inside]
    if len(knots) <= horizons * FEW_KNOTS:
        extra = np.concatenate([knots - half, knots + half])
    else:
        extra = np.concatenate([(knots - half)[slows], (knots + half)[slows], knots[curve.changes[inside]]])
    if len(extra) > horizons * MAX_MORE_POINTS:
        return np.linspace(start, end, horizons * (HORIZON_POINTS + MAX_MORE_POINTS))
    points = np.sort(np.concatenate([np.linspace(start, end, horizons * HORIZON_POINTS), extra]))
    points = points[(points >= start) & (points <= end)]
    points = points[np.concatenate([[True], np.diff(points) > 1e-6])]
    points[-1] = end
    return np.asarray(points)


def _largest(values: Array, first: NDArray[np.intp], last: NDArray[np.intp]) -> Array:
    """The largest (M, D) of values (K, D), none below 0, from `first` to `last` (M,); 0 where there is none."""
    padded = np.concatenate([values, np.zeros((2, values.shape[1]))])
    ends = np.stack([np.minimum(first, len(values)), np.maximum(last, first) + 1], 1).ravel()
    largest = np.maximum.reduceat(padded, np.minimum(ends, len(values) + 1))[::2]
    return np.where((last >= first)[:, None], largest, 0.0)


def _at_points(between: Array) -> Array:
    """The largest (M, D) on both sides of grid points of (M-1, D) in the intervals between them."""
    return np.concatenate([between[:1], np.maximum(between[:-1], between[1:]), between[-1:]])


def entry_curve(surface_from_nozzle: Array, goal: Array, speed: float) -> PathCurve | None:
    """From the nozzle (4, 4) up, over and down to `goal` (4, 4), at the end at `speed`, mm/s; None if it is there."""
    outwards, place = goal[:3, 2], surface_from_nozzle[:3, 3]
    lift = max(0.0, float((goal[:3, 3] + APPROACH_HEIGHT * outwards - place) @ outwards))
    lifted = se3.make(surface_from_nozzle[:3, :3], place + lift * outwards)
    above = [se3.make(goal[:3, :3], goal[:3, 3] + h * outwards) for h in (APPROACH_HEIGHT, DIRECT_DISTANCE)]
    near = np.linalg.norm(place - goal[:3, 3]) < DIRECT_DISTANCE
    return _through([surface_from_nozzle, goal] if near else [surface_from_nozzle, lifted, *above, goal], speed)


def point_above(surface_from_nozzle: Array) -> Array:
    """The nozzle (4, 4) straight above where it is now, where it touches nothing."""
    rotation, place = surface_from_nozzle[:3, :3], surface_from_nozzle[:3, 3]
    return se3.make(rotation, place + APPROACH_HEIGHT * rotation[:, 2])


def aside_curve(surface_from_nozzle: Array, goal: Array) -> PathCurve | None:
    """From the nozzle (4, 4) up over what it printed, then to `goal` (4, 4); None if there."""
    rotation, place = surface_from_nozzle[:3, :3], surface_from_nozzle[:3, 3]
    rise = max(0.0, float((goal[:3, 3] - place) @ rotation[:, 2]))
    lifted = se3.make(rotation, place + rise * rotation[:, 2])
    return _through([surface_from_nozzle, lifted, goal], APPROACH_SPEED)


def pose_aside(surface_from_nozzle: Array, zone: Array) -> Array:
    """The nozzle (4, 4) above and beside the path's zone (2, 3), low and high, mm: nothing there is behind the tool.

    It goes along the surface's x, to the side that is nearer: cameras stand on an arc in the plane of y and z.
    """
    above = point_above(surface_from_nozzle)
    low, high = zone[0][0] - LOOK_ASIDE, zone[1][0] + LOOK_ASIDE
    above[0, 3] = low if above[0, 3] - low < high - above[0, 3] else high
    return above


def straight_curve(surface_from_nozzle: Array, goal: Array) -> PathCurve | None:
    """From the nozzle (4, 4) to `goal` (4, 4); None if there."""
    return _through([surface_from_nozzle, goal], APPROACH_SPEED)


def _through(poses: list[Array], last_speed: float) -> PathCurve | None:
    distinct = np.stack(poses)
    distinct = distinct[np.concatenate([way_lengths(distinct) >= MIN_SPACING, [True]])]  # (K, 4, 4): last of a place
    if len(distinct) < 2:
        return None
    speed = np.array([APPROACH_SPEED] * (len(distinct) - 2) + [min(last_speed, APPROACH_SPEED)])
    return curve_through(distinct, speed, np.ones(len(speed), bool))


def place_passed(sent: Sequence[tuple[Array, float]], where: Array) -> float:
    """The place on the path, mm, at which moves passed `where` (3,), mm; the last where they did so twice.

    sent: of each move its goal (3,), mm, and the place on the path there.
    """
    ends, places = np.stack([end for end, _ in sent]), np.array([place for _, place in sent])
    if len(ends) == 1:
        return float(places[0])
    segments = np.diff(ends, axis=0)  # (N - 1, 3)
    squares = np.maximum((segments**2).sum(1), 1e-12)
    shares = np.clip(((where - ends[:-1]) * segments).sum(1) / squares, 0.0, 1.0)
    distances = np.linalg.norm(ends[:-1] + shares[:, None] * segments - where, axis=1)
    last = int(np.flatnonzero(distances <= distances.min() + 1e-6)[-1])
    return float(places[last] + shares[last] * (places[last + 1] - places[last]))
