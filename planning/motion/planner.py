"""The planner: each tick one command that moves the path along with the surface, or a stop and its reason.

The nozzle's target is base_from_surface(t) @ surface_from_nozzle(s(t)): the surface as its pose predicts it, the place
s on the path as TOPP-RA times it. No pose, a pose that must not be followed, a target out of reach or a failed solve
brakes the arm within its limits and holds it. It goes on where it stopped: nothing is left out or printed twice.

Printing goes on with a DEGRADED pose: what decides is the covariance of the place under the nozzle, the warp's
included. Where the surface deforms and its warp is known, the warp moves the checkpoints with the tissue.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from estimation import se3
from estimation.pose import SurfacePose
from estimation.se3 import Array
from planning.command import (
    AXIS_MARGIN,
    JOINT_MARGIN,
    LOOKS,
    Command,
    Hold,
    HoldReason,
    MotionLimits,
    Move,
    RefusalCode,
    feed_for,
)
from planning.kinematics import SimpleArm, axes_from_nozzle, axis_limits, joints_from_axes, nozzle_from_axes
from planning.material import FlowCommands, FlowOrder, Outlets, RestsAhead, material_plan
from planning.motion.curve import (
    HORIZON_TIME,
    LOOKAHEAD,
    AxisFollower,
    Gridpoints,
    PathCurve,
    aside_curve,
    curve_through,
    entry_curve,
    gridpoints_on,
    place_passed,
    point_above,
    pose_aside,
    straight_curve,
)
from planning.motion.retime import AxisDerivatives, Timing, axis_derivatives, retime
from planning.path import LOOK, Path, PrintPhase, PrintProgress, check_path, check_start

RENEW_BEFORE_END = 0.5  # s left of a horizon when the next is timed: the surface is predicted for half a second
PATH_END_TOLERANCE = 1e-3  # mm of a path that count as none: along 20 nm, as a stop once left, no timing exists
PAUSED, RESTS = "paused", "rests for wait_s"
STALL_TICKS = 3.0  # ticks without a call after which the arm has come to rest by itself
MAX_SENT_MOVES = 64  # a second of them, more than an arm is sent before they are called back
POSE_LIMIT_FRACTION = 0.98  # of the guard's limits for a pose: the planner brakes before the guard would refuse


@dataclass(frozen=True, slots=True, eq=False)
class Segment:
    """A part of the print (approach, path, retreat or exit): its curve in the surface frame and its timing."""

    phase: PrintPhase
    curve: PathCurve
    timing: Timing


class Planner:
    """Decides each tick where the nozzle goes next; keeps the place on the path and the arm's commanded motion."""

    def __init__(
        self,
        path: Path,
        limits: MotionLimits,
        arm: SimpleArm,
        tick: float,
        lag: float = 0.0,
        start: float = 0.0,
        outlets: Outlets | None = None,
    ) -> None:
        """tick: s between calls. lag: s from one tick after a command until the arm is at its axes.

        start: how much of the path is printed already, in checkpoints (PrintProgress.fraction). outlets: of materials;
        one that is not among them leaves at once.
        """
        self._path, self._limits, self._arm, self._tick, self.lag = check_path(path), limits, arm, tick, lag
        self._curve = curve_through(path.surface_from_nozzle, path.speed[1:], ~path.extrude[1:])
        self._zone = path.zone
        self._follower = AxisFollower(arm.home, limits, tick)
        self._segment: Segment | None = None
        self._bounds = axis_limits(arm, replace(limits, speed=limits.per_tick(tick)))
        self._targets: tuple[Segment | None, Array] = None, np.empty((5, 6))  # this tick's: a segment and its axes
        start = check_start(path, start)
        self._place = float(np.interp(start, np.arange(len(path)), self._curve.knots))  # mm of it that are printed
        self._material = material_plan(path, self._curve.knots)
        self._rests = RestsAhead(self._material, self._place)
        self.flow = FlowCommands(self._material, outlets or {}, lag, tick)
        self.horizons = 0  # timed so far
        self._finished, self._last_call = False, -np.inf
        self.paused = self.aside = False  # go up and stand there; for a look, beside all that is printed
        self._pause_pose: Array | None = None  # surface_from_nozzle (4, 4) where it stands in a pause
        self._retreated = self._stands_aside = False
        self._sent: deque[tuple[Array, float]] = deque(maxlen=MAX_SENT_MOVES)  # goal (3,), mm, and the place then

    def __call__(self, pose: SurfacePose | None, now: float) -> Command:
        """The command of the tick at `now`, s: its axes are reached one tick later. pose: the newest, if any."""
        if now - self._last_call > STALL_TICKS * self._tick:
            self._follower.rest()
        self._last_call = now
        if self._finished:
            return self._stop(now, "path finished")
        if pose is None:
            return self._stop(now, HoldReason("no pose yet", RefusalCode.NO_POSE))
        if reason := self._pose_fault(pose, now):
            return self._stop(now, reason)
        self.flow.lag = self.lag  # which whoever has learned it sets
        if self.lag:  # as the arm, late by the lag, will meet it, under its own stamp
            pose = replace(pose.predict(pose.stamp + self.lag), stamp=pose.stamp)
        if self.paused or self._rests.wanted:
            return self._retreat(pose, now)
        if self._pause_pose is not None:  # after a pause the way back to the path begins anew
            self._pause_pose, self._retreated, self._segment, self._stands_aside = None, False, None, False
        if reason := self._keep_segment(pose, now):
            return self._stop(now, reason)
        return self._stop(now, "path finished") if self._finished else self._follow(pose, now)

    def refused(self, axes: Array) -> None:
        """Note that the last move was not sent: the arm is at `axes` (6,), and the segment begins anew."""
        self._follower.rest(axes)
        self._segment = None
        self.flow.closed()
        self._sent.clear()

    def material_in(self) -> None:
        """Note that the material that was wanted is in; another nozzle goes from above to where the path goes on."""
        rest = self._rests.next
        if rest is None or not self._rests.wanted:
            return
        before, after = (self.flow.outlet(self._material.materials[rest.checkpoint - k]) for k in (1, 0))
        if before.offset != after.offset:
            self._place = float(self._curve.knots[rest.checkpoint])
        self._rests.passed()

    def recalled(self, place: Array, stands: Array) -> None:
        """Note that moves were called back: the arm stopped at `place` (6,) on its way and is at `stands` (6,).

        The path goes on where the last moves passed `place`.
        """
        if self._sent:
            self._place = min(self._place, place_passed(self._sent, place[:3]))
        self.refused(stands)

    @property
    def progress(self) -> PrintProgress:
        """How far the print is."""
        phase = PrintPhase.WAITING if self._segment is None else self._segment.phase
        phase = PrintPhase.FINISHED if self._finished else phase
        fraction = float(np.interp(self._place, self._curve.knots, np.arange(len(self._path))))
        wanted, count = LOOK if self.paused and self.aside else self._rests.wanted, len(self._path)
        return PrintProgress(phase, self._checkpoint(), count, self._place, self._curve.length, fraction, wanted)

    # -- whether to move

    def _pose_fault(self, pose: SurfacePose, now: float) -> str:
        """Why the pose must not be followed, "" if it may."""
        limits, then = self._limits, now + self._tick + self.lag
        if not pose.finite:
            return HoldReason("the pose is not finite", RefusalCode.POSE_NOT_FINITE)
        if not pose.state.measured:
            text = f"surface is {pose.state.value}" + (f": {pose.reason}" if pose.reason else "")
            return HoldReason(text, RefusalCode.TRACK_STATE)
        age = now - pose.stamp
        if not 0 <= age <= POSE_LIMIT_FRACTION * limits.pose_age:
            text = f"pose is {age:.3f} s old, limit {limits.pose_age:g} s"
            return HoldReason(text, RefusalCode.POSE_AGE, age, limits.pose_age)
        base_from_nozzle = nozzle_from_axes(self._arm, self._follower.position)
        low, high = self._zone
        place = np.clip((se3.inverse(pose.base_from_surface) @ base_from_nozzle)[:3, 3], low, high)
        speed = float(np.linalg.norm(pose.twist[3:] + se3.cross(pose.twist[:3], place)))
        if speed > POSE_LIMIT_FRACTION * (limit := limits.surface_speed):
            text = f"surface moves at {speed:.1f} mm/s, limit {limit:g} mm/s"
            return HoldReason(text, RefusalCode.SURFACE_SPEED, speed, limit)
        if (turn := float(np.linalg.norm(pose.twist[:3]))) > POSE_LIMIT_FRACTION * (limit := limits.surface_turn):
            text = f"surface turns at {np.rad2deg(turn):.1f} degrees/s, limit {np.rad2deg(limit):g} degrees/s"
            return HoldReason(text, RefusalCode.SURFACE_TURN, turn, limit)
        with np.errstate(invalid="ignore"):  # of a matrix that is no covariance: NaN, which is too much
            error = float(pose.predicted_error(then, place[None])[0])
        if not error <= POSE_LIMIT_FRACTION * limits.pose_error:
            text = f"the place under the nozzle is known to {error:.3f} mm, limit {limits.pose_error:g} mm"
            return HoldReason(text, RefusalCode.POSE_ERROR, error, limits.pose_error)
        return ""

    # -- which segment, and where on it

    def _keep_segment(self, pose: SurfacePose, now: float) -> str:
        """Ensure that there is a segment whose timing lasts; why there is none, or ""."""
        segment = self._segment
        if segment is None:
            return self._begin(pose, now)
        self._targets = segment, self._segment_axes(pose, segment, now)
        deviation = float(np.linalg.norm(self._follower.position[:3] - self._targets[1][0, :3]))
        if deviation > self._limits.on_path and segment.phase is PrintPhase.PRINTING:
            return self._begin(pose, now)
        remaining = segment.timing.end - now
        if remaining > RENEW_BEFORE_END and now < segment.timing.times[0] + HORIZON_TIME:
            return ""
        if segment.timing.places[-1] < self._end_of(segment) or remaining > RENEW_BEFORE_END:
            return self._renew(pose, segment, now)
        if segment.phase is PrintPhase.ENTERING:  # the next begins LOOKAHEAD from now, as this one comes to rest
            distance = deviation + segment.curve.length - float(segment.timing.at(np.array([now]))[0])
            over = remaining <= LOOKAHEAD and distance <= self._limits.on_path
        else:
            over = remaining <= 0
        return self._next(pose, segment.phase, now) if over else ""

    def _begin(self, pose: SurfacePose, now: float) -> str:
        """Begin the segment from where the nozzle is to where the path goes on, or up if it is done."""
        self._segment = None
        nozzle = self._nozzle(pose, now)
        if self._place > self._rests.end - PATH_END_TOLERANCE:
            self._place = self._rests.end
        if self._place >= self._curve.length:
            up = straight_curve(nozzle, point_above(nozzle))
            assert up is not None
            return self._start(pose, PrintPhase.LEAVING, up, 0.0, now + LOOKAHEAD)
        goal = self._curve.poses(np.array([self._place]))[0]
        way = entry_curve(nozzle, goal, float(self._path.speed[self._checkpoint()]))
        if way is None:
            return self._next(pose, PrintPhase.ENTERING, now)
        return self._start(pose, PrintPhase.ENTERING, way, 0.0, now + self._tick)  # at once: nothing is printed yet

    def _nozzle(self, pose: SurfacePose, now: float) -> Array:
        """surface_from_nozzle (4, 4) as commanded, on the surface as it is at `now`, s."""
        base_from_nozzle = nozzle_from_axes(self._arm, self._follower.position)
        nozzle = se3.inverse(pose.predicted_poses(np.array([now]))[0]) @ base_from_nozzle
        return nozzle if pose.warp is None else pose.warp.undo_on_poses(nozzle[None])[0]

    def _retreat(self, pose: SurfacePose, now: float) -> Command:
        """In a pause: up from where it began, for a look aside too, then at rest; what was interrupted is resumed."""
        nozzle, segment, for_look = self._nozzle(pose, now), self._segment, self.progress.wanted == LOOK
        waiting = LOOKS if for_look else f"material {self._rests.wanted} is to be put in"
        waiting = PAUSED if self.paused and not self.aside else waiting
        if self._pause_pose is None or (for_look and not self._stands_aside):
            self._pause_pose = pose_aside(nozzle, self._zone) if for_look else point_above(nozzle)
            segment, self._retreated, self._stands_aside = None, False, for_look
        if segment is not None and segment.phase is PrintPhase.RETREATING and now >= segment.timing.end:
            self._retreated, segment = bool(segment.timing.places[-1] >= segment.curve.length), None
        curve_to = aside_curve if self._stands_aside else straight_curve
        curve = None if self._retreated else curve_to(nozzle, self._pause_pose)
        if curve is None:
            return self._stop(now, waiting)
        begins = segment is None or segment.phase is not PrintPhase.RETREATING
        if begins and (reason := self._start(pose, PrintPhase.RETREATING, curve, 0.0, now + LOOKAHEAD)):
            return self._stop(now, f"{waiting}; {reason}")
        return self._follow(pose, now)

    def _next(self, pose: SurfacePose, phase: PrintPhase, now: float) -> str:
        """Begin the segment after one of `phase`; why that cannot be, or ""."""
        if phase is PrintPhase.PRINTING:
            self._place = self._rests.end
            if self._rests.next is None:
                return self._begin(pose, now)
        if phase in (PrintPhase.ENTERING, PrintPhase.PRINTING):
            if self._rests.left(self._place, now) > 0 or self._rests.wanted:
                return "" if self._segment else RESTS
            if self._rests.end <= self._place:
                self._rests.passed()
            entered = -np.inf if self._segment is None else self._segment.timing.end
            begin = max(entered, now + LOOKAHEAD - self._tick)  # within the tick that ends LOOKAHEAD from now
            self.flow.begun = max(begin, now + self._tick + self.flow.lead_on(self._place))
            return self._start(pose, PrintPhase.PRINTING, self._curve, self._place, self.flow.begun)
        self._finished = True
        return ""

    def _end_of(self, segment: Segment) -> float:
        """The place, mm, at which a segment comes to rest."""
        return self._rests.end if segment.phase is PrintPhase.PRINTING else segment.curve.length

    def _start(self, pose: SurfacePose, phase: PrintPhase, curve: PathCurve, place: float, begin: float) -> str:
        """Begin a segment from rest at `place`, mm, at `begin`, s; why that cannot be, or "".

        The follower aims LOOKAHEAD from now: a segment that begins no sooner is followed from its first instant on.
        """
        grid, derivatives = self._horizon(pose, curve, place, begin)
        if reason := self._unreachable(derivatives.axes[:, :6]):
            self._segment = None
            return reason
        self.horizons += 1
        timing = retime(grid, derivatives, 0.0, begin, self._bounds)
        self._segment = None if isinstance(timing, str) else Segment(phase, curve, timing)
        return timing if isinstance(timing, str) else ""

    def _renew(self, pose: SurfacePose, segment: Segment, now: float) -> str:
        """Time the next horizon from the present place and speed; if that fails, the old one ends at rest."""
        place = float(segment.timing.at(np.array([now]))[0])
        grid, derivatives = self._horizon(pose, segment.curve, place, now)
        self.horizons += 1
        timing = retime(grid, derivatives, segment.timing.speed_at(now), now, self._bounds)
        if isinstance(timing, str):
            return timing if now >= segment.timing.end else ""
        self._segment = replace(segment, timing=timing)
        self._targets = self._segment, self._targets[1]  # for this tick: both timings agree at its start
        return ""

    def _horizon(
        self, pose: SurfacePose, curve: PathCurve, place: float, begin: float
    ) -> tuple[Gridpoints, AxisDerivatives]:
        """The next horizon's grid points from `place`, mm, passed at `begin`, s, and the axes' derivatives there."""
        end = self._rests.end if curve is self._curve else curve.length
        grid = gridpoints_on(curve, place, min(curve.after(place, HORIZON_TIME), end))
        return grid, axis_derivatives(self._arm, pose, curve, grid, begin)

    # -- the motion

    def _follow(self, pose: SurfacePose, now: float) -> Command:
        segment = self._segment
        assert segment is not None
        owner, targets = self._targets
        _, reference, before, ahead, after = targets if owner is segment else self._segment_axes(pose, segment, now)
        half = self._tick / 2
        if reason := self._unreachable(ahead[None]):
            return self._stop(now, reason)
        start = self._follower.position
        axes = self._follower.aim(ahead, (after - before) / self._tick, (after - 2 * ahead + before) / half**2)
        if isinstance(axes, str):
            return self._stop(now, axes)
        extrude, order, reason = False, None, ""
        if segment.phase is PrintPhase.PRINTING and np.linalg.norm(axes[:3] - reference[:3]) <= self._limits.on_path:
            before = self._place
            self._place = max(before, float(segment.timing.at(np.array([now + self._tick]))[0]))
            extrude = bool(self._path.extrude[self._checkpoint()]) and self._place > before
            order = self.flow(segment.timing, before, self._rests.end, now)
        if now >= segment.timing.end and (wait := self._rests.left(self._place, now)) > 0:
            reason = f"{RESTS}: {wait:.1f} s left"
        return self._move(now, start, axes, extrude, reason, order)

    def _segment_axes(self, pose: SurfacePose, segment: Segment, now: float) -> Array:
        """Machine axes (5, 6) on the segment: now, a tick later, and half a tick before, at and after LOOKAHEAD."""
        half = self._tick / 2
        times = now + np.array([0.0, self._tick, LOOKAHEAD - half, LOOKAHEAD, LOOKAHEAD + half])
        surface_from_nozzle = segment.curve.poses(segment.timing.at(times))
        if pose.warp is not None:
            surface_from_nozzle = pose.warp.apply_to_poses(surface_from_nozzle)
        return axes_from_nozzle(self._arm, pose.predicted_poses(times) @ surface_from_nozzle)

    def _stop(self, now: float, reason: str) -> Command:
        """Brake, and hold once at rest."""
        self._segment = None
        if not self._follower.at_rest:
            start = self._follower.position
            axes = self._follower.brake()
            if not isinstance(axes, str):
                return self._move(now, start, axes, extrude=False, reason=reason)
            self._follower.rest()
        self.flow.closed()
        return Hold(now, self._limits.pause, reason)

    def _move(
        self, now: float, start: Array, axes: Array, extrude: bool, reason: str = "", order: FlowOrder | None = None
    ) -> Move:
        """order: to the dispenser; None: off at once."""
        feed = min(feed_for(start, axes, self._tick), self._limits.feed)
        self._sent.append((axes[:3], self._place))
        return Move(now, axes, feed, self._checkpoint(), extrude, reason, *(order or self.flow.closed()))

    def _checkpoint(self) -> int:
        """The checkpoint that the place on the path leads to."""
        return min(int(np.searchsorted(self._curve.knots, self._place, "left")), len(self._path) - 1)

    def _unreachable(self, axes: Array) -> str:
        """Why the arm must not go to machine axes (M, 6), of the first such row; "" if it may.

        Axes keep AXIS_MARGIN from their bounds; an arm that stands nearer already must not go nearer still.
        """
        current = self._follower.position
        low = np.minimum(self._limits.low + AXIS_MARGIN, current)
        high = np.maximum(self._limits.high - AXIS_MARGIN, current)
        reason = self._outside("XYZABC", axes, low, high)
        if reason or (model := self._arm.jointed) is None:
            return reason
        joints, joints_now = joints_from_axes(model, axes), joints_from_axes(model, current)
        low, high = np.fmin(model.low + JOINT_MARGIN, joints_now), np.fmax(model.high - JOINT_MARGIN, joints_now)
        return self._outside([f"J{i + 1}" for i in range(6)], joints, low, high)

    def _outside(self, names: Sequence[str], values: Array, lows: Array, highs: Array) -> str:
        """The first of values (M, 6) that is not between bounds (6,), in words; "" if there is none."""
        rows, columns = np.nonzero(~((values >= lows) & (values <= highs)))  # NaN is outside
        if not len(rows):
            return ""
        i = columns[0]
        axis, value, low, high = names[i], values[rows[0], i], lows[i], highs[i]
        where = f"checkpoint {self._checkpoint()} is out of reach"
        if not np.isfinite(value):
            return f"{where}: {self._arm.beyond}"
        unit = "mm" if axis in "XYZ" else "degrees"
        value, low, high = (value, low, high) if unit == "mm" else np.rad2deg([value, low, high])
        return f"{where}: {axis} = {value:.1f}, allowed {low:g} to {high:g} {unit}"
