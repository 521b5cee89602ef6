"""The guard: the last check of each command, with arithmetic of its own. It refuses and never clamps.

It remembers the last axes that it let through and the last instant with a trusted pose, and decides by itself whether a
pose is trusted. Without one only a stop may follow: no extrusion, and at rest within stop_time and stop_distance.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from estimation import se3
from estimation.pose import SurfacePose
from estimation.se3 import Array
from planning.clearance import TissueGuard
from planning.command import MAX_FLOW, Command, MotionLimits, Move, Refusal, RefusalCode
from planning.kinematics import SimpleArm, joints_from_axes, nozzle_from_axes

AXIS_NAMES = "XYZABC"
LINEAR_AXES = 3  # X Y Z in mm, the others in rad


class Guard:
    """Checks commands in the order in which they are sent."""

    def __init__(
        self,
        limits: MotionLimits,
        arm: SimpleArm,
        tick: float,
        zone: Array | None = None,
        lag: float = 0.0,
        tissue: TissueGuard | None = None,
    ) -> None:
        """lag: s from one tick after a command until the arm is at its axes. tissue: that the tool must stay out of.

        zone: (2, 3) mm, low and high corner of the printed region in the surface frame; None: everywhere. The surface's
        error and speed are taken at the zone's place nearest to the nozzle: far from it, on the way from home, a small
        turn of the surface is no reason to stop.
        """
        self._limits, self._arm, self._tick, self.lag = limits, arm, tick, lag
        self._zone = np.array([[-np.inf] * 3, [np.inf] * 3]) if zone is None else zone
        self._tissue = tissue
        self._axes = arm.home.copy()  # of the last move that was let through
        self._stamp = -math.inf
        self._trusted_at = -math.inf
        self._trusted_axes = self._axes

    @property
    def axes(self) -> Array:
        """Axes (6,), mm and rad, of the last move that was let through."""
        return self._axes

    def stands(self, axes: Array) -> None:
        """Note that the arm is at `axes` (6,), mm and rad: moves beyond were called back."""
        self._axes = axes.copy()

    def __call__(self, command: Command, pose: SurfacePose | None, now: float) -> Command:
        """The command itself, or a Refusal with the limit that it breaks. pose: the newest at `now`, s."""
        distrust = self._distrust(pose, now)
        breach = self._order(command, now)
        if not breach and not distrust:
            self._trusted_at, self._trusted_axes = now, self._axes
        if not breach and isinstance(command, Move):
            breach = self._reach(command) or self._motion(command) or self._joints(command) or self._no_go(command)
            breach = breach or self._material(command)
            breach = breach or (self._stopping(command, distrust) if distrust else self._clearance(command, pose, now))
        if breach:
            return Refusal(now, self._limits.pause, f"refused: {breach.text}", breach.code, breach.got, breach.limit)
        self._stamp = now
        if isinstance(command, Move):
            self._axes = command.axes.copy()
        return command

    def _order(self, command: Command, now: float) -> Breach | None:
        if not math.isfinite(now) or command.stamp != now:
            return Breach(RefusalCode.ORDER, command.stamp, now, f"command of {command.stamp} s at {now} s")
        if now <= self._stamp:
            return Breach(RefusalCode.ORDER, now, self._stamp, f"stamp {now} s is not after {self._stamp} s")
        return None

    def _reach(self, move: Move) -> Breach | None:
        if move.axes.shape != (6,) or not np.isfinite(move.axes).all():
            text = f"axes {move.axes.tolist()} are not 6 finite numbers"
            return Breach(RefusalCode.NOT_FINITE, math.nan, math.nan, text)
        limit = self._limits.feed
        if not 0 < move.feed <= limit:
            text = f"feed {move.feed:g} mm/s, allowed 0 < feed <= {limit:g}"
            code = RefusalCode.FEED if math.isfinite(move.feed) else RefusalCode.NOT_FINITE
            return Breach(code, move.feed, limit if move.feed > 0 else 0.0, text)
        for i, (value, low, high) in enumerate(zip(move.axes, self._limits.low, self._limits.high, strict=True)):
            if not low <= value <= high:
                allowed = f"{_axis_text(i, low)} to {_axis_text(i, high)}"
                text = f"{AXIS_NAMES[i]} = {_axis_text(i, value)}, allowed {allowed}"
                return Breach(RefusalCode.WORKSPACE, value, low if value < low else high, text)
        return None

    def _motion(self, move: Move) -> Breach | None:
        limits, step = self._limits, np.abs(move.axes - self._axes)
        jump = math.hypot(*step[:LINEAR_AXES])
        if jump > limits.jump:
            return Breach(RefusalCode.JUMP, jump, limits.jump, f"jump of {jump:.3f} mm, limit {limits.jump:g} mm")
        if (turn := float(step[LINEAR_AXES:].max())) > limits.turn:
            text = f"turn of {np.rad2deg(turn):.3f} degrees, limit {np.rad2deg(limits.turn):g} degrees"
            return Breach(RefusalCode.TURN, turn, limits.turn, text)
        for i, (speed, limit) in enumerate(zip(step / self._tick, limits.speed, strict=True)):
            if speed > limit:
                text = f"{AXIS_NAMES[i]} at {_axis_text(i, speed)}/s, limit {_axis_text(i, limit)}/s"
                return Breach(RefusalCode.AXIS_SPEED, speed, limit, text)
        return None

    def _joints(self, move: Move) -> Breach | None:
        """Joint limits, of an arm whose A B C are joints; otherwise its controller checks them."""
        if (model := self._arm.jointed) is None:
            return None
        before, after = joints_from_axes(model, np.stack([self._axes, move.axes]))
        if not np.isfinite(after).all():
            return Breach(RefusalCode.POSTURE, math.nan, math.nan, "the arm has no posture for these axes")
        for i, (value, low, high) in enumerate(zip(after, model.low, model.high, strict=True)):
            if not low <= value <= high:
                text = f"J{i + 1} = {_degree_text(value)}, allowed {_degree_text(low)} to {_degree_text(high)}"
                return Breach(RefusalCode.JOINT_RANGE, value, low if value < low else high, text)
        for i, (speed, limit) in enumerate(zip(np.abs(after - before) / self._tick, model.speed, strict=True)):
            if not speed <= limit:
                text = f"J{i + 1} at {_degree_text(speed)}/s, limit {_degree_text(limit)}/s"
                return Breach(RefusalCode.JOINT_SPEED, speed, limit, text)
        return None

    def _no_go(self, move: Move) -> Breach | None:
        """No-go zones on the tip's straight way there; it always begins outside."""
        if not self._limits.zones:
            return None
        start, end = nozzle_from_axes(self._arm, np.stack([self._axes, move.axes]))[:, :3, 3]
        for zone in self._limits.zones:
            if (depth := zone.depth_along(start, end)) > 0:
                return Breach(RefusalCode.NO_GO, depth, 0.0, f"{depth:.3f} mm inside the no-go zone {zone.name!r}")
        return None

    def _clearance(self, move: Move, pose: SurfacePose | None, now: float) -> Breach | None:
        """The tool in the tissue where the move leads, as the trusted pose foretells it; a way out of it is free."""
        if self._tissue is None or pose is None:
            return None
        surface_from_base = se3.inverse(pose.predicted_poses(np.array([now + self._tick + self.lag]))[0])
        place = surface_from_base @ nozzle_from_axes(self._arm, move.axes)
        if self._tissue.clear(place):
            return None
        after, part = self._tissue.room(place)
        if after >= 0 or after > self._tissue.room(surface_from_base @ nozzle_from_axes(self._arm, self._axes))[0]:
            return None
        return Breach(RefusalCode.CLEARANCE, -after, 0.0, f"the {part} would be {-after:.2f} mm in the tissue")

    def _material(self, move: Move) -> Breach | None:
        """What the dispenser is told: a finite flow, at an instant within the tick."""
        if not 0 <= move.flow <= MAX_FLOW:
            text = f"flow of {move.flow:g} mm^3/s, allowed 0 to {MAX_FLOW:g}"
            return Breach(RefusalCode.FLOW, move.flow, MAX_FLOW if move.flow > 0 else 0.0, text)
        if not 0 <= move.flow_after <= self._tick:
            text = f"flow told {move.flow_after:g} s into a tick of {self._tick:g} s"
            return Breach(RefusalCode.FLOW, move.flow_after, self._tick if move.flow_after > 0 else 0.0, text)
        return None

    def _stopping(self, move: Move, distrust: Breach) -> Breach | None:
        limits = self._limits
        if move.extrude or move.flow or move.flow_after:
            return distrust._replace(text=f"extrusion while {distrust.text}")
        if (since := move.stamp - self._trusted_at) > limits.stop_time:
            text = f"still moving after {since:.3f} s, limit {limits.stop_time:g} s, while {distrust.text}"
            return Breach(RefusalCode.WATCHDOG, since, limits.stop_time, text)
        if (distance := math.hypot(*(move.axes - self._trusted_axes)[:LINEAR_AXES])) > limits.stop_distance:
            text = f"stops only after {distance:.2f} mm, limit {limits.stop_distance:g} mm, while {distrust.text}"
            return Breach(RefusalCode.STOP_DISTANCE, distance, limits.stop_distance, text)
        return None

    def _distrust(self, pose: SurfacePose | None, now: float) -> Breach | None:
        """Why the pose is not trusted; None if it is."""
        limits, nothing = self._limits, (math.nan, math.nan)
        if pose is None:
            return Breach(RefusalCode.NO_POSE, *nothing, "there is no pose")
        if not np.isfinite(np.concatenate([np.ravel(a) for a in _numbers(pose)])).all():
            return Breach(RefusalCode.POSE_NOT_FINITE, *nothing, "the pose is not finite")
        if not pose.state.measured:
            return Breach(RefusalCode.TRACK_STATE, *nothing, f"the surface is {pose.state.value}")
        if not 0 <= (age := now - pose.stamp) <= limits.pose_age:
            limit = limits.pose_age if age > 0 else 0.0
            return Breach(RefusalCode.POSE_AGE, age, limit, f"the pose is {age:.3f} s old, limit {limits.pose_age:g} s")
        # the zone's place (3,) nearest to the nozzle, surface frame, mm: its speed, the surface's turn, its error
        nozzle = np.append(nozzle_from_axes(self._arm, self._axes)[:3, 3], 1.0)
        place: Array = np.clip(se3.inverse(pose.base_from_surface)[:3] @ nozzle, *self._zone)
        speed = math.hypot(*(pose.twist[3:] + np.cross(pose.twist[:3], place)))
        if speed > (limit := limits.surface_speed):
            text = f"the surface moves at {speed:.2f} mm/s, limit {limit:g} mm/s"
            return Breach(RefusalCode.SURFACE_SPEED, speed, limit, text)
        if (turn := math.hypot(*pose.twist[:3])) > (limit := limits.surface_turn):
            text = f"the surface turns at {np.rad2deg(turn):.2f} degrees/s, limit {np.rad2deg(limit):g}"
            return Breach(RefusalCode.SURFACE_TURN, turn, limit, text)
        error = _error(pose, place, age + self._tick + self.lag)
        if not error <= (limit := limits.pose_error):
            text = f"the place under the nozzle is known to {error:.3f} mm, limit {limit:g} mm"
            return Breach(RefusalCode.POSE_ERROR, error, limit, text)
        return None


class Breach(NamedTuple):
    """A limit that is broken."""

    code: RefusalCode
    got: float  # as in Refusal
    limit: float  # as in Refusal
    text: str


def _numbers(pose: SurfacePose) -> tuple[Array | float, ...]:
    drift = (pose.twist_covariance, pose.acceleration_psd)
    warp = () if (w := pose.warp) is None else (w.control, w.coefficients, w.covariance, w.growth)
    ahead = () if (f := pose.forecast) is None else (f.horizons, f.increments, f.covariances)
    local = () if (e := pose.local) is None else (e.centres, e.variance, e.growth, e.reach, e.support, e.span)
    return pose.stamp, pose.base_from_surface, pose.covariance, pose.twist, *drift, *warp, *ahead, *local


def _error(pose: SurfacePose, place: Array, ahead: float) -> float:
    """Standard deviation, mm, along its worst direction, of a surface point (3,) `ahead` s after the pose."""
    forecast_s, covariance = 0.0, pose.covariance
    if pose.forecast is not None:
        forecast_s = min(ahead, pose.forecast.end)
        covariance = pose.forecast.covariance(covariance, forecast_s)
    beyond = ahead - forecast_s
    covariance = covariance + beyond**2 * pose.twist_covariance + np.diag(pose.acceleration_psd) * beyond**3 / 3
    jacobian = np.hstack([-se3.hat(place), np.eye(3)])
    spread = jacobian @ covariance @ jacobian.T
    if pose.warp is not None:
        spread = spread + pose.warp.propagate(ahead).displacement_covariance(place[None])[0]
    worst = float(np.linalg.eigvalsh(spread)[-1])
    if (local := pose.local) is not None:
        share = 1 - ((local.centres - place) ** 2).sum(1) / (2 * local.reach) ** 2
        local_variance = float(((local.variance + ahead * local.growth) * np.maximum(share, 0.0)).max(initial=0.0))
        nearest = math.sqrt(float(((local.support - place) ** 2).sum(1).min(initial=math.inf)))
        worst += max(local_variance, local.unsupported * min(max(nearest / local.span - 1.0, 0.0), 1.0))
    return math.sqrt(worst) if worst >= 0 else math.nan


def _axis_text(axis: int, value: float) -> str:
    return f"{value:.3f} mm" if axis < LINEAR_AXES else _degree_text(value)


def _degree_text(value: float) -> str:
    return f"{np.rad2deg(value):.3f} degrees"
