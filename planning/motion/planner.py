"""The planner: each tick one command that carries the path along with the surface, or a stop and its reason.

The target of the nozzle is base_from_surface(t) @ surface_from_nozzle(s(t)): the surface as its pose predicts it, the
place s on the path as TOPP-RA times it. Whatever stands in the way (no pose, a pose that is not worth following, a
target out of reach, a failed solve) brakes the arm within its limits and then holds it; when it is gone the nozzle goes
back to the very place where it stopped: nothing is left out and nothing printed twice.

A pose whose state is DEGRADED may be printed on: how well the place under the nozzle is known decides, the warp's own
doubt included. A surface that deforms, but whose warp is known, carries the checkpoints with its tissue.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from estimation import se3
from estimation.pose import SurfacePose
from estimation.se3 import Array
from planning.command import Command, Hold, Move, feed_for
from planning.demand import Demand, demand
from planning.kinematics import SimpleArm, axes_from_nozzle, joints_from_axes, limits_of, nozzle_from_axes
from planning.legs import CORNER, SWERVE, Leg, above, entry, exit_from, straight
from planning.limits import JOINT_MARGIN, MARGIN, Limits
from planning.motion.curve import Curve, curve_through
from planning.motion.follow import LEAD, Follower
from planning.motion.retime import Timing, retime
from planning.path import Path, check_path
from planning.progress import Phase, Progress, check_start
from planning.stations import Stations, stations_on

HORIZON = 1.0  # s of path timed at once: any speed can be stopped in it
RENEW = 0.5  # s of it left when the next is timed, after HORIZON at the latest; it ends at rest, and the surface is
# foreseen for half a second
NOTHING = 1e-3  # mm of a path that are as good as none: along 20 nm, where a stop once left one, there is no timing
PAUSED = "paused"
STALL = 3.0  # ticks without a call after which the arm has come to rest by itself
SENT = 64  # moves that are remembered: a second of them, more than an arm is sent before it is called back
SHARE = 0.98  # of what the guard tolerates of a pose: the planner brakes before the guard would cut


class Planner:
    """Decides each tick where the nozzle goes next; remembers the place on the path and the arm's commanded motion."""

    def __init__(
        self, path: Path, limits: Limits, arm: SimpleArm, tick: float, lag: float = 0.0, start: float = 0.0
    ) -> None:
        """tick: s between calls. lag: s that the arm is later at a command's axes than one tick after the command.

        start: how much of the path is printed already, counted in checkpoints (a Progress's fraction).
        """
        self._path, self._limits, self._arm, self._tick, self._lag = check_path(path), limits, arm, tick, lag
        self._curve = curve_through(path.surface_from_nozzle, path.speed[1:], CORNER, SWERVE)
        self._zone = path.zone
        self._follower = Follower(arm.home, limits, tick)
        self._leg: Leg | None = None
        self._bounds = limits_of(arm, replace(limits, speed=limits.per_tick(tick)))
        self._asked: tuple[Leg | None, Array] = None, np.empty((5, 6))  # a leg and what it asks for at this tick
        start = check_start(path, start)
        self._place = float(np.interp(start, np.arange(len(path)), self._curve.knots))  # mm of it that are printed
        self.horizons = 0  # timed so far
        self._finished = False
        self._before = -np.inf
        self.paused = False  # go up from the surface and stand there, until this is no longer set
        self._goal: Array | None = None  # surface_from_nozzle (4, 4) where it stands in a pause
        self._retreated = False
        self._sent: deque[tuple[Array, float]] = deque(maxlen=SENT)  # where to (3,), mm, and the place printed then

    def __call__(self, pose: SurfacePose | None, now: float) -> Command:
        """The command of the tick at `now`, s: its axes are reached one tick later. pose: the newest there is."""
        if now - self._before > STALL * self._tick:
            self._follower.rest()
        self._before = now
        if self._finished:
            return self._stop(now, "path finished")
        if pose is None:
            return self._stop(now, "no pose yet")
        if reason := self._doubt(pose, now):
            return self._stop(now, reason)
        pose = _late(pose, self._lag)
        if self.paused:
            return self._retreat(pose, now)
        self._resume()
        if reason := self._keep_leg(pose, now):
            return self._stop(now, reason)
        if self._finished:
            return self._stop(now, "path finished")
        return self._follow(pose, now)

    def refused(self, axes: Array) -> None:
        """The last move was not sent: the arm stands at `axes` (6,), and the leg begins anew."""
        self._follower.rest(axes)
        self._leg = None
        self._sent.clear()

    def recalled(self, place: Array, stands: Array) -> None:
        """The arm was stopped at `place` (6,) on its way and stands at `stands` (6,): what was sent beyond is undone.

        The path goes on where the last moves passed `place`.
        """
        if self._sent:
            self._place = min(self._place, passed(self._sent, place[:3]))
        self.refused(stands)

    @property
    def progress(self) -> Progress:
        """How far the print is."""
        phase = Phase.FINISHED if self._finished else Phase.WAITING if self._leg is None else self._leg.phase
        fraction = float(np.interp(self._place, self._curve.knots, np.arange(len(self._path))))
        return Progress(phase, self._checkpoint(), len(self._path), self._place, self._curve.length, fraction)

    # -- whether to move

    def _doubt(self, pose: SurfacePose, now: float) -> str:
        """Why the pose must not be followed, "" if it may."""
        limits, then = self._limits, now + self._tick + self._lag
        if not _finite(pose):
            return "the pose is not finite"
        if not pose.state.measured:
            return f"surface is {pose.state.value}" + (f": {pose.reason}" if pose.reason else "")
        age = now - pose.stamp
        if not 0 <= age <= SHARE * limits.pose_age:
            return f"pose is {age:.3f} s old, limit {limits.pose_age:g} s"
        base_from_nozzle = nozzle_from_axes(self._arm, self._follower.position)
        low, high = self._zone
        place = np.clip((se3.inverse(pose.base_from_surface) @ base_from_nozzle)[:3, 3], low, high)
        turn, speed = pose.twist[:3], pose.twist[3:] + se3.cross(pose.twist[:3], place)
        if np.linalg.norm(speed) > SHARE * limits.surface_speed:
            return f"surface moves at {np.linalg.norm(speed):.1f} mm/s, limit {limits.surface_speed:g} mm/s"
        if np.linalg.norm(turn) > SHARE * limits.surface_turn:
            turn_deg, limit_deg = np.rad2deg(np.linalg.norm(turn)), np.rad2deg(limits.surface_turn)
            return f"surface turns at {turn_deg:.1f} degrees/s, limit {limit_deg:g} degrees/s"
        with np.errstate(invalid="ignore"):  # of a matrix that is no covariance: NaN, which is too much
            error = float(pose.error_ahead(then, place[None])[0])
        if not error <= SHARE * limits.pose_error:
            return f"the place under the nozzle is known to {error:.3f} mm, limit {limits.pose_error:g} mm"
        return ""

    # -- where on which leg

    def _keep_leg(self, pose: SurfacePose, now: float) -> str:
        """See that there is a leg with a timing that lasts; why there is none, "" if there is."""
        leg = self._leg
        if leg is None:
            return self._begin(pose, now)
        self._asked = leg, self._look(pose, leg, now)
        off = float(np.linalg.norm(self._follower.position[:3] - self._asked[1][0, :3]))
        if off > self._limits.on_path and leg.phase is Phase.PRINTING:
            return self._begin(pose, now)
        left = leg.timing.end - now
        if left > RENEW and now < leg.timing.times[0] + HORIZON:
            return ""
        if leg.timing.places[-1] < leg.curve.length or left > RENEW:
            return self._renew(pose, leg, now)
        if leg.phase is Phase.ENTERING:  # the next leg begins where the follower looks: as this one comes to rest
            away = off + leg.curve.length - float(leg.timing.at(np.array([now]))[0])
            over = left <= LEAD and away <= self._limits.on_path
        else:
            over = left <= 0
        return self._next(pose, leg.phase, now) if over else ""

    def _begin(self, pose: SurfacePose, now: float) -> str:
        """Go from where the nozzle is to where the path goes on, or up if it is done."""
        self._leg = None
        nozzle = self._nozzle(pose, now)
        if self._place > self._curve.length - NOTHING:
            self._place = self._curve.length
            return self._start(pose, Phase.LEAVING, exit_from(nozzle), 0.0, now + LEAD)
        goal = self._curve.poses(np.array([self._place]))[0]
        way = entry(nozzle, goal, float(self._path.speed[self._checkpoint()]))
        if way is None:
            return self._next(pose, Phase.ENTERING, now)
        return self._start(pose, Phase.ENTERING, way, 0.0, now + self._tick)  # at once: nothing is printed yet

    def _nozzle(self, pose: SurfacePose, now: float) -> Array:
        """surface_from_nozzle (4, 4) as commanded, on the surface as it is at `now`, s."""
        base_from_nozzle = nozzle_from_axes(self._arm, self._follower.position)
        nozzle = se3.inverse(pose.base_at(np.array([now]))[0]) @ base_from_nozzle
        return nozzle if pose.warp is None else pose.warp.uncarry(nozzle[None])[0]

    def _retreat(self, pose: SurfacePose, now: float) -> Command:
        """In a pause: straight up from where it began, then at rest; what interrupts it is made good."""
        nozzle, leg = self._nozzle(pose, now), self._leg
        if self._goal is None:
            self._goal = above(nozzle)
        if leg is not None and leg.phase is Phase.RETREATING and now >= leg.timing.end:
            self._retreated = leg.timing.places[-1] >= leg.curve.length
            leg = None
        curve = None if self._retreated else straight(nozzle, self._goal)
        if curve is None:
            return self._stop(now, PAUSED)
        begins = leg is None or leg.phase is not Phase.RETREATING
        if begins and (reason := self._start(pose, Phase.RETREATING, curve, 0.0, now + LEAD)):
            return self._stop(now, f"{PAUSED}; {reason}")
        return self._follow(pose, now)

    def _resume(self) -> None:
        """After a pause: the way back to the path begins anew."""
        if self._goal is not None:
            self._goal, self._retreated, self._leg = None, False, None

    def _next(self, pose: SurfacePose, phase: Phase, now: float) -> str:
        """Begin the leg after one of `phase`."""
        if phase is Phase.ENTERING:
            there = -np.inf if self._leg is None else self._leg.timing.end  # within the tick that ends LEAD from now
            begin = max(there, now + LEAD - self._tick)
            return self._start(pose, Phase.PRINTING, self._curve, self._place, begin)
        if phase is Phase.PRINTING:
            self._place = self._curve.length
            return self._begin(pose, now)
        self._finished = True
        return ""

    def _start(self, pose: SurfacePose, phase: Phase, curve: Curve, place: float, begin: float) -> str:
        """Begin a leg from rest at `place`, mm, at `begin`, s; why that cannot be, or "".

        What begins no sooner than where the follower looks, LEAD from now, is followed from its first instant on.
        """
        grid, asked = self._ask(pose, curve, place, begin)
        if reason := self._unreachable(asked.axes[:, :6]):
            self._leg = None
            return reason
        timing = self._timed(grid, asked, 0.0, begin)
        self._leg = None if isinstance(timing, str) else Leg(phase, curve, timing)
        return timing if isinstance(timing, str) else ""

    def _renew(self, pose: SurfacePose, leg: Leg, now: float) -> str:
        """Time the next horizon from where and how fast the old one is; if that fails, the old one ends at rest."""
        place = float(leg.timing.at(np.array([now]))[0])
        timing = self._timed(*self._ask(pose, leg.curve, place, now), leg.timing.speed_at(now), now)
        if isinstance(timing, str):
            return timing if now >= leg.timing.end else ""
        self._leg = replace(leg, timing=timing)
        self._asked = self._leg, self._asked[1]  # for this tick: old and new timing are one at its start
        return ""

    def _ask(self, pose: SurfacePose, curve: Curve, place: float, begin: float) -> tuple[Stations, Demand]:
        """The next horizon from `place`, mm, passed at `begin`, s, and what it asks of the axes."""
        grid = stations_on(curve, place, curve.after(place, HORIZON))
        return grid, demand(self._arm, pose, curve, grid, begin)

    def _timed(self, grid: Stations, asked: Demand, speed: float, begin: float) -> Timing | str:
        self.horizons += 1
        return retime(grid, asked, speed, begin, self._bounds)

    # -- the motion

    def _follow(self, pose: SurfacePose, now: float) -> Command:
        leg = self._leg
        assert leg is not None
        asked, targets = self._asked
        _, reference, before, ahead, after = targets if asked is leg else self._look(pose, leg, now)
        half = self._tick / 2
        if reason := self._unreachable(ahead[None]):
            return self._stop(now, reason)
        start = self._follower.position
        axes = self._follower.aim(ahead, (after - before) / self._tick, (after - 2 * ahead + before) / half**2)
        if isinstance(axes, str):
            return self._stop(now, axes)
        extrude = False
        if leg.phase is Phase.PRINTING and np.linalg.norm(axes[:3] - reference[:3]) <= self._limits.on_path:
            before = self._place
            self._place = max(before, float(leg.timing.at(np.array([now + self._tick]))[0]))
            extrude = bool(self._path.extrude[self._checkpoint()]) and self._place > before
        return self._move(now, start, axes, extrude)

    def _look(self, pose: SurfacePose, leg: Leg, now: float) -> Array:
        """Machine axes (5, 6) that the leg asks for: now, a tick later, and before, at and after LEAD."""
        half = self._tick / 2
        times = now + np.array([0.0, self._tick, LEAD - half, LEAD, LEAD + half])
        surface_from_nozzle = leg.curve.poses(leg.timing.at(times))
        if pose.warp is not None:
            surface_from_nozzle = pose.warp.carry(surface_from_nozzle)
        return axes_from_nozzle(self._arm, pose.base_at(times) @ surface_from_nozzle)

    def _stop(self, now: float, reason: str) -> Command:
        """Brake, and hold once at rest."""
        self._leg = None
        if not self._follower.at_rest:
            start = self._follower.position
            axes = self._follower.brake()
            if not isinstance(axes, str):
                return self._move(now, start, axes, extrude=False, reason=reason)
            self._follower.rest()
        return Hold(now, self._limits.pause, reason)

    def _move(self, now: float, start: Array, axes: Array, extrude: bool, reason: str = "") -> Move:
        feed = min(feed_for(start, axes, self._tick), self._limits.feed)
        self._sent.append((axes[:3], self._place))
        return Move(now, axes, feed, self._checkpoint(), extrude, reason)

    def _checkpoint(self) -> int:
        """The checkpoint that the place on the path leads to."""
        return min(int(np.searchsorted(self._curve.knots, self._place, "left")), len(self._path) - 1)

    def _unreachable(self, axes: Array) -> str:
        """Why the arm must not go to machine axes (M, 6), the first of them that it must not; "" if it may.

        Axes keep MARGIN from their bounds; an arm that stands nearer already must not go nearer still.
        """
        stands = self._follower.position
        low = np.minimum(self._limits.low + MARGIN, stands)
        high = np.maximum(self._limits.high - MARGIN, stands)
        rows, columns = np.nonzero(~((axes >= low) & (axes <= high)))  # NaN is outside
        if len(rows):
            return self._told("XYZABC"[columns[0]], axes[rows[0], columns[0]], low[columns[0]], high[columns[0]])
        if (model := self._arm.jointed) is None:
            return ""
        joints, own = joints_from_axes(model, axes), joints_from_axes(model, stands)
        low, high = np.fmin(model.low + JOINT_MARGIN, own), np.fmax(model.high - JOINT_MARGIN, own)
        rows, columns = np.nonzero(~((joints >= low) & (joints <= high)))
        return (
            self._told(f"J{columns[0] + 1}", joints[rows[0], columns[0]], low[columns[0]], high[columns[0]])
            if len(rows)
            else ""
        )

    def _told(self, axis: str, got: float, low: float, high: float) -> str:
        where = f"checkpoint {self._checkpoint()} is out of reach"
        if not np.isfinite(got):
            return f"{where}: the arm has no such posture"
        unit = "mm" if axis in "XYZ" else "degrees"
        shown = np.array([got, low, high]) if unit == "mm" else np.rad2deg([got, low, high])
        return f"{where}: {axis} = {shown[0]:.1f}, allowed {shown[1]:g} to {shown[2]:g} {unit}"


def passed(sent: Sequence[tuple[Array, float]], where: Array) -> float:
    """The place on the path, mm, at which moves passed `where` (3,), mm: the last such where they did so twice.

    sent: the moves, each where to (3,), mm, and the place on the path there.
    """
    ends, places = np.stack([end for end, _ in sent]), np.array([place for _, place in sent])
    if len(ends) == 1:
        return float(places[0])
    ways = np.diff(ends, axis=0)  # (N - 1, 3)
    squares = np.maximum((ways**2).sum(1), 1e-12)
    shares = np.clip(((where - ends[:-1]) * ways).sum(1) / squares, 0.0, 1.0)
    off = np.linalg.norm(ends[:-1] + shares[:, None] * ways - where, axis=1)
    last = int(np.flatnonzero(off <= off.min() + 1e-6)[-1])
    return float(places[last] + shares[last] * (places[last + 1] - places[last]))


def _late(pose: SurfacePose, lag: float) -> SurfacePose:
    """The pose that an arm late by `lag` s will meet, under the stamp at which it is planned for."""
    return replace(pose.predict(pose.stamp + lag), stamp=pose.stamp) if lag else pose


def _finite(pose: SurfacePose) -> bool:
    arrays = [pose.base_from_surface, pose.covariance, pose.twist, pose.twist_covariance, pose.acceleration_psd]
    if pose.warp is not None:
        arrays += [pose.warp.control, pose.warp.coefficients, pose.warp.covariance, pose.warp.growth]
    if pose.forecast is not None:
        arrays += [pose.forecast.horizons, pose.forecast.increments, pose.forecast.covariances]
    return bool(np.isfinite(pose.stamp) and all(np.isfinite(a).all() for a in arrays))
