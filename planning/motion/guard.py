"""The guard: the last word on each command, by arithmetic of its own. It refuses and never clamps.

It knows the last axes that were let through, and since when no pose was worth following. What a pose must be worth, it
judges itself; without such a pose only a stop may follow: no extrusion, and at rest within stop_time and stop_distance.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from estimation import se3
from estimation.pose import SurfacePose
from estimation.se3 import Array
from planning.command import Code, Command, Move, Refusal
from planning.kinematics import SimpleArm, joints_from_axes, nozzle_from_axes
from planning.limits import Limits

AXES = "XYZABC"
LINEAR = 3  # X Y Z are mm, the rest rad


class Guard:
    """Checks commands in the order in which they are sent."""

    def __init__(
        self, limits: Limits, arm: SimpleArm, tick: float, zone: Array | None = None, lag: float = 0.0
    ) -> None:
        """lag: s that the arm is later at a command's axes than one tick after the command.

        zone: (2, 3) mm, low and high corner in the surface frame of where is printed; without it, everywhere. How well
        the surface is known and how fast it moves counts at the place of the zone that is nearest the nozzle: far from
        it, on the way from home, a small turn of the surface is no reason to stop.
        """
        self._limits, self._arm, self._tick, self._lag = limits, arm, tick, lag
        self._zone = np.array([[-np.inf] * 3, [np.inf] * 3]) if zone is None else zone
        self._axes = arm.home.copy()  # the last let through
        self._stamp = -math.inf
        self._trusted_at = -math.inf
        self._trusted_axes = self._axes

    @property
    def axes(self) -> Array:
        """Where the arm was last sent (6,), mm and rad."""
        return self._axes

    def stands(self, axes: Array) -> None:
        """The arm stands at `axes` (6,), mm and rad: what was let through beyond was called back."""
        self._axes = axes.copy()

    def __call__(self, command: Command, pose: SurfacePose | None, now: float) -> Command:
        """The command itself, or a Refusal that says which limit it breaks. pose: the newest at `now`, s."""
        doubt = self._doubt(pose, now)
        breach = self._order(command, now)
        if not breach and not doubt:
            self._trusted_at, self._trusted_axes = now, self._axes
        if not breach and isinstance(command, Move):
            breach = self._reach(command) or self._motion(command) or self._joints(command) or self._no_go(command)
            breach = breach or (self._stopping(command, doubt) if doubt else None)
        if breach:
            return Refusal(now, self._limits.pause, f"refused: {breach.words}", breach.code, breach.got, breach.limit)
        self._stamp = now
        if isinstance(command, Move):
            self._axes = command.axes.copy()
        return command

    def _order(self, command: Command, now: float) -> Breach | None:
        if not math.isfinite(now) or command.stamp != now:
            return Breach(Code.ORDER, command.stamp, now, f"command of {command.stamp} s at {now} s")
        if now <= self._stamp:
            return Breach(Code.ORDER, now, self._stamp, f"stamp {now} s is not after {self._stamp} s")
        return None

    def _reach(self, move: Move) -> Breach | None:
        if move.axes.shape != (6,) or not np.isfinite(move.axes).all():
            words = f"axes {move.axes.tolist()} are not 6 finite numbers"
            return Breach(Code.NOT_FINITE, math.nan, math.nan, words)
        limit = self._limits.feed
        if not 0 < move.feed <= limit:
            words = f"feed {move.feed:g} mm/s, allowed 0 < feed <= {limit:g}"
            code = Code.FEED if math.isfinite(move.feed) else Code.NOT_FINITE
            return Breach(code, move.feed, limit if move.feed > 0 else 0.0, words)
        for i, (value, low, high) in enumerate(zip(move.axes, self._limits.low, self._limits.high, strict=True)):
            if not low <= value <= high:
                words = f"{AXES[i]} = {_shown(i, value)}, allowed {_shown(i, low)} to {_shown(i, high)}"
                return Breach(Code.WORKSPACE, value, low if value < low else high, words)
        return None

    def _motion(self, move: Move) -> Breach | None:
        limits, step = self._limits, np.abs(move.axes - self._axes)
        jump = math.hypot(*step[:LINEAR])
        if jump > limits.jump:
            return Breach(Code.JUMP, jump, limits.jump, f"jump of {jump:.3f} mm, limit {limits.jump:g} mm")
        if (turn := float(step[LINEAR:].max())) > limits.turn:
            words = f"turn of {np.rad2deg(turn):.3f} degrees, limit {np.rad2deg(limits.turn):g} degrees"
            return Breach(Code.TURN, turn, limits.turn, words)
        for i, (speed, limit) in enumerate(zip(step / self._tick, limits.speed, strict=True)):
            if speed > limit:
                words = f"{AXES[i]} at {_shown(i, speed)}/s, limit {_shown(i, limit)}/s"
                return Breach(Code.AXIS_SPEED, speed, limit, words)
        return None

    def _joints(self, move: Move) -> Breach | None:
        """What the joints of an arm that is sent its last three cannot do; the other kind's controller sees to them."""
        if (model := self._arm.jointed) is None:
            return None
        before, after = joints_from_axes(model, np.stack([self._axes, move.axes]))
        if not np.isfinite(after).all():
            return Breach(Code.POSTURE, math.nan, math.nan, "the arm has no posture for these axes")
        for i, (value, low, high) in enumerate(zip(after, model.low, model.high, strict=True)):
            if not low <= value <= high:
                words = f"J{i + 1} = {_degrees(value)}, allowed {_degrees(low)} to {_degrees(high)}"
                return Breach(Code.JOINT_RANGE, value, low if value < low else high, words)
        for i, (speed, limit) in enumerate(zip(np.abs(after - before) / self._tick, model.speed, strict=True)):
            if not speed <= limit:
                words = f"J{i + 1} at {_degrees(speed)}/s, limit {_degrees(limit)}/s"
                return Breach(Code.JOINT_SPEED, speed, limit, words)
        return None

    def _no_go(self, move: Move) -> Breach | None:
        """Whether the tip's straight way there touches a zone; it always begins outside."""
        if not self._limits.zones:
            return None
        start, end = nozzle_from_axes(self._arm, np.stack([self._axes, move.axes]))[:, :3, 3]
        for zone in self._limits.zones:
            if (depth := zone.met(start, end)) > 0:
                return Breach(Code.NO_GO, depth, 0.0, f"{depth:.3f} mm inside the no-go zone {zone.name!r}")
        return None

    def _stopping(self, move: Move, doubt: Breach) -> Breach | None:
        limits = self._limits
        if move.extrude:
            return doubt._replace(words=f"extrusion while {doubt.words}")
        if (since := move.stamp - self._trusted_at) > limits.stop_time:
            words = f"still moving after {since:.3f} s, limit {limits.stop_time:g} s, while {doubt.words}"
            return Breach(Code.WATCHDOG, since, limits.stop_time, words)
        if (way := math.hypot(*(move.axes - self._trusted_axes)[:LINEAR])) > limits.stop_distance:
            words = f"stops only after {way:.2f} mm, limit {limits.stop_distance:g} mm, while {doubt.words}"
            return Breach(Code.STOP_DISTANCE, way, limits.stop_distance, words)
        return None

    def _doubt(self, pose: SurfacePose | None, now: float) -> Breach | None:
        """What is wrong with the pose, None if it may be followed."""
        limits, nothing = self._limits, (math.nan, math.nan)
        if pose is None:
            return Breach(Code.NO_POSE, *nothing, "there is no pose")
        if not np.isfinite(np.concatenate([np.ravel(a) for a in _numbers(pose)])).all():
            return Breach(Code.POSE_NOT_FINITE, *nothing, "the pose is not finite")
        if not pose.state.measured:
            return Breach(Code.TRACK_STATE, *nothing, f"the surface is {pose.state.value}")
        if not 0 <= (age := now - pose.stamp) <= limits.pose_age:
            limit = limits.pose_age if age > 0 else 0.0
            return Breach(Code.POSE_AGE, age, limit, f"the pose is {age:.3f} s old, limit {limits.pose_age:g} s")
        place = self._place(pose)
        return self._fast(pose, place) or self._unsure(pose, place, age)

    def _fast(self, pose: SurfacePose, place: Array) -> Breach | None:
        limits = self._limits
        speed = math.hypot(*(pose.twist[3:] + np.cross(pose.twist[:3], place)))
        if speed > (limit := limits.surface_speed):
            words = f"the surface moves at {speed:.2f} mm/s, limit {limit:g} mm/s"
            return Breach(Code.SURFACE_SPEED, speed, limit, words)
        if (turn := math.hypot(*pose.twist[:3])) > (limit := limits.surface_turn):
            words = f"the surface turns at {np.rad2deg(turn):.2f} degrees/s, limit {np.rad2deg(limit):g}"
            return Breach(Code.SURFACE_TURN, turn, limit, words)
        return None

    def _unsure(self, pose: SurfacePose, place: Array, age: float) -> Breach | None:
        error, limit = _error(pose, place, age + self._tick + self._lag), self._limits.pose_error
        if error <= limit:
            return None
        words = f"the place under the nozzle is known to {error:.3f} mm, limit {limit:g} mm"
        return Breach(Code.POSE_ERROR, error, limit, words)

    def _place(self, pose: SurfacePose) -> Array:
        """The place of the zone that is nearest the nozzle (3,), in the surface frame, mm."""
        nozzle = nozzle_from_axes(self._arm, self._axes)[:3, 3]
        place: Array = np.clip(se3.inverse(pose.base_from_surface)[:3] @ np.append(nozzle, 1.0), *self._zone)
        return place


class Breach(NamedTuple):
    """A limit that is broken. got, limit: as `Refusal` has them. words: for a person."""

    code: Code
    got: float
    limit: float
    words: str


def _numbers(pose: SurfacePose) -> tuple[Array | float, ...]:
    drift = (pose.twist_covariance, pose.acceleration_psd)
    warp = () if pose.warp is None else (pose.warp.coefficients, pose.warp.covariance, pose.warp.growth)
    ahead = () if (f := pose.forecast) is None else (f.horizons, f.increments, f.covariances)
    return pose.stamp, pose.base_from_surface, pose.covariance, pose.twist, *drift, *warp, *ahead


def _error(pose: SurfacePose, place: Array, ahead: float) -> float:
    """Standard deviation, mm, of a point (3,) on the surface `ahead` s after the pose, along its worst direction."""
    known, covariance = 0.0, pose.covariance
    if pose.forecast is not None:
        known = min(ahead, pose.forecast.end)
        covariance = pose.forecast.covariance(covariance, known)
    beyond = ahead - known
    covariance = covariance + beyond**2 * pose.twist_covariance + np.diag(pose.acceleration_psd) * beyond**3 / 3
    jacobian = np.hstack([-se3.hat(place), np.eye(3)])
    spread = jacobian @ covariance @ jacobian.T
    if pose.warp is not None:
        spread = spread + pose.warp.later(ahead).spread(place[None])[0]
    worst = float(np.linalg.eigvalsh(spread)[-1])
    return math.sqrt(worst) if worst >= 0 else math.nan


def _shown(axis: int, value: float) -> str:
    return f"{value:.3f} mm" if axis < LINEAR else _degrees(value)


def _degrees(value: float) -> str:
    return f"{np.rad2deg(value):.3f} degrees"
