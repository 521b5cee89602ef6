"""The loop of the motion, driven by a clock: 50 times a second the newest pose, the motion's command, the arm.

It runs in a process of its own, or under a simulated clock. Between ticks it polls the arm's line and the operator's
orders every few milliseconds, so that a stop does not wait for the next tick. The motion is called only when the arm
can take a command: every command that is decided is sent, so planner, guard and arm agree on where the arm is.
"""

from __future__ import annotations

import math
from bisect import bisect_left
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Protocol

import numpy as np

from estimation.pose import SurfacePose
from estimation.se3 import Array
from hardware.arm.device import BY_OPERATOR, DONE, ArmState, ArmStatus, LinkCode, Reason
from hardware.arm.jog import RecalledMoves
from hardware.arm.link import Arm, shut_down
from hardware.arm.profile import ArmProfile
from hardware.dispenser.dispenser import Dispenser, Dispensers, DispenserState, close_dispensers
from hardware.process.clock import Clock, Histogram, TickSchedule
from perception.frames import PrintHead
from planning.command import Command, Hold, Move
from planning.kinematics import nozzle_from_axes
from planning.path import Path, PrintPhase


class TickMotion(Protocol):
    """What the loop needs of a motion; `hardware.motion.step` has the usual one."""

    def __call__(self, pose: SurfacePose | None, now: float) -> Command:
        """The command of the tick at `now`, s."""
        ...

    def recalled(self, place: Array, stands: Array) -> None:
        """Go on from `stands` (6,), where the arm stands after a stop at `place` (6,)."""
        ...


class Order(Enum):
    """An operator's order to the motion."""

    AT_HOME = "at home"  # the arm stands at home, as the operator sees
    ARM = "arm"  # enable the arm; it first returns to its last target, if that is near
    HOME = "home"  # arm, go home, disarm
    DISARM = "disarm"
    STOP = "stop"
    QUIT = "quit"


GOING_HOME = Reason("the arm goes home", LinkCode.OWN_MOVE)


@dataclass(frozen=True, slots=True, eq=False)
class Tick:
    """The result of one tick."""

    stamp: float  # s, for which it was made
    command: Command
    frame: bytes  # sent; b"" where the link held the command back
    late: float  # s behind schedule
    status: ArmStatus
    answer: Reason  # why the last order was not followed
    recalled: RecalledMoves | None = None  # moves that were called back before it
    hold: LinkCode | None = None  # why the link held the command back; None where it did not


class MotionLoop:
    """One motion on one arm.

    lateness: of its ticks. skipped: ticks left out, as their time had passed. tick_start: s, start of the last one.
    """

    def __init__(
        self,
        motion: TickMotion,
        arm: Arm,
        clock: Clock,
        pose: Callable[[], SurfacePose | None],
        orders: Callable[[], Sequence[Order]],
        report: Callable[[Tick], None] = lambda tick: None,
        homed: Callable[[], None] = lambda: None,
        schedule: TickSchedule | None = None,
        material: MaterialControl | None = None,
    ) -> None:
        """pose: gives the newest. orders: gives those since the last call. report: called after each tick.

        homed: called when the arm has gone home, so that the motion begins from there. schedule: of the ticks; without
        one they run freely, the profile's tick and the link's ease apart. material: dispensers; None: nothing flows.
        """
        self.motion, self.arm = motion, arm
        self.lateness = Histogram()
        self.skipped, self.tick_start = 0, math.nan
        self._clock, self._pose, self._orders, self._report, self._homed = clock, pose, orders, report, homed
        profile, settings = arm.profile, arm.settings
        self.material = material
        self._hold_time, self._poll_period = profile.limits.pause, settings.poll
        self._schedule = TickSchedule(profile.tick, settings.ease, clock.now()) if schedule is None else schedule
        self._last_pose: SurfacePose | None = None  # of the last tick
        self._last_target: Array = profile.arm.home  # of the last move that was sent
        self._rollback: RecalledMoves | None = None  # state to which planner and guard return: a command was not sent
        self._homing = False
        self._answer = DONE
        self._quit = False

    def run(self, until: float = float("inf")) -> None:
        """Run until `until`, s, or an order to quit; whatever ends it, the arm is stopped."""
        schedule = self._schedule
        schedule.due = self._clock.now()
        try:
            while not self._quit and (now := self._clock.now()) < until:
                self._follow_orders(now)
                self.arm.poll(now)
                self._poll_material(now)
                pose = self._pose()
                if now >= schedule.opens(pose is not self._last_pose):
                    self._last_pose = pose
                    self._tick(pose, now, self._begins(now))
                    self.skipped += schedule.advance(self._clock.now())
                switch = math.inf if self.material is None else self.material.due
                self._clock.wait_until(min(schedule.due, switch, self._clock.now() + self._poll_period))
        finally:
            ended = self._clock.now()
            if self.material is not None:
                self.material.off(ended)
            shut_down(self.arm, "the motion has ended", self._clock, self._poll_period)

    def _poll_material(self, now: float) -> None:
        """Close the dispensers where the arm is not armed, and poll them."""
        if self.material is not None:
            if self.arm.state is not ArmState.ARMED:
                self.material.off(now)
            self.material.poll(now)

    def _follow_orders(self, now: float) -> None:
        for order in self._orders():
            self._answer = self._do(order, now)
        if self._homing and (self.arm.state is not ArmState.ARMED or self.arm.arrived(now)):
            self._homing = False
            if self.arm.state is ArmState.ARMED:
                self._last_target = self.arm.profile.arm.home
                self._homed()
                self.arm.disarm(now)

    def _do(self, order: Order, now: float) -> Reason:
        """Follow an order; why it cannot be followed, or ""."""
        arm = self.arm
        if order is Order.STOP:
            arm.stop(BY_OPERATOR, now)
        elif order is Order.DISARM:
            arm.disarm(now)
        elif order is Order.QUIT:
            self._quit = True
        elif order is Order.AT_HOME:
            return arm.stand(arm.profile.arm.home, now)
        elif order is Order.ARM:
            return arm.arm(now, self._last_target)
        elif order is Order.HOME:
            if reason := arm.arm(now) or arm.home(now):
                return reason
            self._homing = True
        return DONE

    def _begins(self, now: float) -> float:
        """The instant, s, of a tick made at `now`: when its move leaves the arm's queue, or when due, if sooner."""
        queued = now + self.arm.in_flight(now) - self.arm.profile.frame_time
        return max(now, min(self._schedule.due, queued))

    def _tick(self, pose: SurfacePose | None, now: float, instant: float) -> None:
        """Make at `now`, s, the tick for `instant`, s."""
        late, self.tick_start = max(now - self._schedule.due, 0.0), now
        self.lateness.add(late)
        frame = b""
        if recalled := self.arm.take_up() or self._rollback:
            self._rollback = None
            self._last_target = recalled.stands
            self.motion.recalled(recalled.place, recalled.stands)
        if hold := GOING_HOME if self._homing else self.arm.hold(now):
            command: Command = Hold(instant, self._hold_time, str(hold))
        else:
            command = self.motion(pose, instant)
            if hold := self.arm.send(command, now):
                self._rollback = RecalledMoves(self._last_target, self._last_target)
                command = Hold(instant, self._hold_time, str(hold))
            else:
                frame = self.arm.command_frame
                if isinstance(command, Move):
                    self._last_target = command.axes
        if self.material is not None:  # what was not sent is a Hold here
            self.material.follow(command, now)
        self._report(Tick(instant, command, frame, late, self.arm.status(now), self._answer, recalled, hold.code))


@dataclass(frozen=True, slots=True, eq=False)
class RecordedTick:
    """A tick of a live run's motion, recorded for viewers and reports; `LoopRecord` is for a replay."""

    stamp: float  # s
    pose_stamp: float  # s, of the newest pose; NaN: none
    planned: bool  # whether planner and guard were called
    command: Command  # of the loop
    frame: bytes  # of planner's and guard's command
    fraction: float  # place on the path after it, in checkpoints
    phase: PrintPhase
    recalled: Array | None = None  # (2, 6) mm and rad: where the arm rested and stands, where moves were called back


MAX_COMMANDS = 256  # commands, five seconds of them: frames are never that late


class CommandedPose:
    """The print head's pose from the last commands, for the tracker: each is reached a tick and the arm's lag later."""

    def __init__(self, profile: ArmProfile) -> None:
        self._profile = profile
        self._commands: deque[tuple[float, Array, bool]] = deque(maxlen=MAX_COMMANDS)  # when due, axes, extruding

    def add(self, command: Command, now: float) -> None:
        """Enter a command that is sent at `now`, s; in a hold the arm stays at its place."""
        arrival = now + self._profile.tick + self._profile.lag
        if isinstance(command, Move):
            self._commands.append((arrival, command.axes, command.extrude))
        elif self._commands:
            self._commands.append((arrival, self._commands[-1][1], False))

    def at(self, stamp: float) -> PrintHead | None:
        """The print head at `stamp`, s; None before the first move, as the arm's place is unknown."""
        if not self._commands or stamp < self._commands[0][0]:
            return None
        place = min(bisect_left(self._commands, stamp, key=lambda command: command[0]), len(self._commands) - 1)
        (begin, start, _), (end, goal, extrude) = self._commands[max(place - 1, 0)], self._commands[place]
        share = min(1.0, (stamp - begin) / (end - begin)) if end > begin else 1.0
        axes = start + share * (goal - start)
        return PrintHead(np.asarray(nozzle_from_axes(self._profile.arm, axes)), extrude and stamp <= end)


FLOW_STEP = 0.05  # relative change of a metered flow before it is sent again: a line carries few messages a tick
REPEAT_OFF = 0.25  # s between repeated offs while nothing is to flow: one may have been lost on the line


@dataclass(frozen=True, slots=True)
class DispenserRecord:
    """An action of a dispenser, as it is recorded."""

    stamp: float  # s, when its line had accepted it
    name: str
    text: str
    flow: float | None  # mm^3/s commanded from then on; None: unchanged


@dataclass(frozen=True, slots=True)
class MaterialStatus:
    """Whether material can flow, and the commanded flow."""

    text: str  # for a person
    ready: bool
    failed: bool  # and needs the operator


class MaterialControl:
    """The dispensers of a print. reason: why material cannot flow now, "" if it can."""

    def __init__(self, dispensers: Dispensers, path: Path) -> None:
        self._dispensers = dispensers
        self._materials = tuple(map(str, path.material.tolist()))
        self._temperatures = tuple(map(float, path.temperature.tolist()))
        self._extrude = tuple(map(bool, path.extrude.tolist()))
        self._current: Dispenser | None = None  # of the material that is printed now
        self._flow = 0.0  # mm^3/s, commanded
        self._pending: tuple[float, float] | None = None  # s, when a flow is to be commanded, and the flow
        self._last_off = -math.inf  # s, when the last off was sent
        self._refusal = ""
        self._material = ""  # that is printed now or next
        self._celsius: float | None = None  # degrees C, set-point; None: the dispenser has no heater

    @property
    def reason(self) -> str:
        """Why material cannot flow, "" if it can."""
        current = self._current
        if current is None:
            return ""
        status = current.status
        if status.state in (DispenserState.READY, DispenserState.ON):
            return self._refusal
        return f"dispenser {current.profile.name} is {status.state.value}: {status.reason}"

    @property
    def status(self) -> MaterialStatus:
        """For reports."""
        current, reason = self._current, self.reason
        if current is None:
            return MaterialStatus("no material is needed", True, False)
        failed = bool(self._refusal) or current.status.state in (DispenserState.FAILED, DispenserState.CLOSED)
        flow = f"{self._flow:.3g} mm^3/s" if current.profile.metered else "on"
        text = f"{self._material} by {current.profile.name}: {flow if self._flow else 'off'}"
        return MaterialStatus(reason or text, not reason, failed)

    @property
    def due(self) -> float:
        """When the pending switch is due, s; infinite without one."""
        return math.inf if self._pending is None else self._pending[0]

    def begin(self, place: float, now: float) -> None:
        """Prepare the dispenser of the next material after `place`, in checkpoints, and close the others."""
        next_extruding = next((i for i in range(math.floor(place) + 1, len(self._extrude)) if self._extrude[i]), None)
        if next_extruding is None:
            return
        self._refusal, self._material = "", self._materials[next_extruding]
        dispenser = self._dispensers.for_material(self._material)
        if self._current is not dispenser:
            self.off(now)
        self._current = dispenser
        if dispenser is not None:
            heated = dispenser.profile.temperature_range is not None
            self._celsius = self._temperatures[next_extruding] if heated else None
            dispenser.prepare(now, self._celsius)

    def follow(self, command: Command, now: float) -> None:
        """Apply the flow of a command that was sent to the arm; a hold closes."""
        if not isinstance(command, Move):
            self.off(now)
            return
        if command.extrude:
            self._heat(self._temperatures[command.checkpoint], now)
        at = command.stamp + command.flow_after
        self._pending = (at, command.flow) if command.flow or self._flow else None
        self._switch(now)

    def poll(self, now: float) -> None:
        """Switch what is due, repeat offs, and poll the dispensers."""
        self._switch(now)
        if not self._flow and now > self._last_off + REPEAT_OFF and self._current is not None:
            self._close(now)
        self._dispensers.poll(now)
        if self._flow and self._current is not None and self._current.status.state is not DispenserState.ON:
            self._close(now)  # its line was lost: the flow is commanded again once it is ready

    def off(self, now: float) -> None:
        """Close at once; what was pending is dropped."""
        self._pending = None
        if self._flow:
            self._close(now)

    def records(self) -> list[DispenserRecord]:
        """The actions of all dispensers since the last call."""
        events = ((each.profile.name, event) for each in self._dispensers for event in each.events())
        return [DispenserRecord(event.stamp, name, event.text, event.flow) for name, event in events]

    def close(self, clock: Clock) -> list[str]:
        """Close all and release their lines; the reason of each that could not be switched off."""
        self.off(clock.now())
        return close_dispensers(self._dispensers, clock)

    def _heat(self, celsius: float, now: float) -> None:
        """Set the dispenser's temperature, if the path needs another one."""
        if self._current is None or self._celsius is None or celsius == self._celsius:
            return
        self.off(now)
        self._celsius = celsius
        self._refusal = self._current.set_temperature(celsius, now)

    def _switch(self, now: float) -> None:
        if self._pending is None or now < self._pending[0]:
            return
        flow, self._pending = self._pending[1], None
        current = self._current
        if not flow or current is None or self.reason:
            self.off(now)
            return
        low, high = current.profile.flow_range
        flow = min(max(flow, low), high)  # the path's flow is within its range, except where the nozzle is slowed down
        unchanged = self._flow and (not current.profile.metered or abs(flow - self._flow) <= FLOW_STEP * self._flow)
        if unchanged:
            return
        if refusal := current.on(flow, now):
            self._refusal = refusal
            self._close(now)
        else:
            self._flow = flow

    def _close(self, now: float) -> None:
        self._flow, self._last_off = 0.0, now
        self._dispensers.off(now)
