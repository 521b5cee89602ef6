"""The guard: the last word on each command, by arithmetic of its own. It refuses and never clamps.

It knows the last axes that were let through, and since when no pose was worth following. What a pose must be worth, it
judges itself; without such a pose only a stop may follow: no extrusion, and at rest within stop_time and stop_distance.
"""

from __future__ import annotations

import math

import numpy as np

from estimation import se3
from estimation.pose import SurfacePose
from estimation.se3 import Array
from planning.command import Command, Hold, Move
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

    def __call__(self, command: Command, pose: SurfacePose | None, now: float) -> Command:
        """The command itself, or a hold that says which limit it breaks. pose: the newest at `now`, s."""
        doubt = self._doubt(pose, now)
        reason = self._order(command, now)
        if not reason and not doubt:
            self._trusted_at, self._trusted_axes = now, self._axes
        if not reason and isinstance(command, Move):
            reason = self._reach(command) or self._motion(command) or self._joints(command)
            reason = reason or (self._stopping(command, doubt) if doubt else "")
        if reason:
            return Hold(now, self._limits.pause, f"refused: {reason}")
        self._stamp = now
        if isinstance(command, Move):
            self._axes = command.axes.copy()
        return command

    def _order(self, command: Command, now: float) -> str:
        if not math.isfinite(now) or command.stamp != now:
            return f"command of {command.stamp} s at {now} s"
        if now <= self._stamp:
            return f"stamp {now} s is not after {self._stamp} s"
        return ""

    def _reach(self, move: Move) -> str:
        if move.axes.shape != (6,) or not np.isfinite(move.axes).all():
            return f"axes {move.axes.tolist()} are not 6 finite numbers"
        if not 0 < move.feed <= self._limits.feed:
            return f"feed {move.feed:g} mm/s, allowed 0 < feed <= {self._limits.feed:g}"
        for i, (value, low, high) in enumerate(zip(move.axes, self._limits.low, self._limits.high, strict=True)):
            if not low <= value <= high:
                return f"{AXES[i]} = {_shown(i, value)}, allowed {_shown(i, low)} to {_shown(i, high)}"
        return ""

    def _motion(self, move: Move) -> str:
        limits, step = self._limits, np.abs(move.axes - self._axes)
        jump = math.hypot(*step[:LINEAR])
        if jump > limits.jump:
            return f"jump of {jump:.3f} mm, limit {limits.jump:g} mm"
        if (turn := float(step[LINEAR:].max())) > limits.turn:
            return f"turn of {np.rad2deg(turn):.3f} degrees, limit {np.rad2deg(limits.turn):g} degrees"
        for i, (speed, limit) in enumerate(zip(step / self._tick, limits.speed, strict=True)):
            if speed > limit:
                return f"{AXES[i]} at {_shown(i, speed)}/s, limit {_shown(i, limit)}/s"
        return ""

    def _joints(self, move: Move) -> str:
        """What the joints of an arm that is sent its last three cannot do, "" for one whose controller sees to them."""
        if (model := self._arm.jointed) is None:
            return ""
        before, after = joints_from_axes(model, np.stack([self._axes, move.axes]))
        if not np.isfinite(after).all():
            return "the arm has no posture for these axes"
        for i, (value, low, high) in enumerate(zip(after, model.low, model.high, strict=True)):
            if not low <= value <= high:
                return f"J{i + 1} = {_degrees(value)}, allowed {_degrees(low)} to {_degrees(high)}"
        for i, (speed, limit) in enumerate(zip(np.abs(after - before) / self._tick, model.speed, strict=True)):
            if not speed <= limit:
                return f"J{i + 1} at {_degrees(speed)}/s, limit {_degrees(limit)}/s"
        return ""

    def _stopping(self, move: Move, doubt: str) -> str:
        limits = self._limits
        if move.extrude:
            return f"extrusion while {doubt}"
        if (since := move.stamp - self._trusted_at) > limits.stop_time:
            return f"still moving after {since:.3f} s, limit {limits.stop_time:g} s, while {doubt}"
        if (way := math.hypot(*(move.axes - self._trusted_axes)[:LINEAR])) > limits.stop_distance:
            return f"stops only after {way:.2f} mm, limit {limits.stop_distance:g} mm, while {doubt}"
        return ""

    def _doubt(self, pose: SurfacePose | None, now: float) -> str:
        """What is wrong with the pose, "" if it may be followed."""
        limits = self._limits
        if pose is None:
            return "there is no pose"
        if not np.isfinite(np.concatenate([np.ravel(a) for a in _numbers(pose)])).all():
            return "the pose is not finite"
        if not pose.state.measured:
            return f"the surface is {pose.state.value}"
        if not 0 <= (age := now - pose.stamp) <= limits.pose_age:
            return f"the pose is {age:.3f} s old, limit {limits.pose_age:g} s"
        nozzle = nozzle_from_axes(self._arm, self._axes)[:3, 3]
        place = np.clip(se3.inverse(pose.base_from_surface)[:3] @ np.append(nozzle, 1.0), *self._zone)
        speed = math.hypot(*(pose.twist[3:] + np.cross(pose.twist[:3], place)))
        if speed > limits.surface_speed:
            return f"the surface moves at {speed:.2f} mm/s, limit {limits.surface_speed:g} mm/s"
        if (turn := math.hypot(*pose.twist[:3])) > limits.surface_turn:
            return f"the surface turns at {np.rad2deg(turn):.2f} degrees/s, limit {np.rad2deg(limits.surface_turn):g}"
        error = _error(pose, place, age + self._tick + self._lag)
        if not error <= limits.pose_error:
            return f"the place under the nozzle is known to {error:.3f} mm, limit {limits.pose_error:g} mm"
        return ""


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
