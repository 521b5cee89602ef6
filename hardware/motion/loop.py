"""The clock-driven loop of the motion: the newest pose, MotionStep, the arm, 50 times a second.

It runs in a process of its own (motion_process.py), or under a simulated clock. Between ticks it looks at the line and
at the operator's orders every few milliseconds, so that a stop waits for no tick. A motion is asked only when the arm
can take its frame: what was decided is sent, and planner, guard and arm agree on where the arm is.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Protocol

from estimation.pose import SurfacePose
from estimation.se3 import Array
from hardware.arm.link import Arm
from hardware.arm_recall import Recalled
from hardware.arm_status import ArmState, ArmStatus
from hardware.farewell import farewell
from hardware.lateness import Lateness
from hardware.process.clock import Clock
from hardware.process.ticks import Rhythm
from planning.command import Command, Hold, Move


class Motion(Protocol):
    """What the loop asks of a MotionStep."""

    last: Command

    def __call__(self, pose: SurfacePose | None, now: float) -> bytes:
        """The frame of the tick at `now`, s."""
        ...

    def recalled(self, place: Array, stands: Array) -> None:
        """The arm was stopped at `place` (6,) on its way and stands at `stands` (6,): all sent beyond is undone."""
        ...


class Order(Enum):
    """What an operator may ask of the motion."""

    AT_HOME = "at home"  # the arm stands at home: whoever looks at it says so
    ARM = "arm"  # let it move; it goes back to where the motion left off, if that is near
    HOME = "home"  # arm it, go home, disarm it
    DISARM = "disarm"
    STOP = "stop"
    QUIT = "quit"


@dataclass(frozen=True, slots=True, eq=False)
class Tick:
    """What one tick did.

    stamp: s, for which it was made. frame: the bytes sent, none of a hold by the link. late: s behind its instant.
    recalled: what the motion was told before it of moves that were called back.
    """

    stamp: float
    command: Command
    frame: bytes
    late: float
    status: ArmStatus
    answer: str  # why the last order was not followed, "" if it was
    recalled: Recalled | None = None


def nobody(tick: Tick) -> None:
    """Tell nobody."""


def nothing() -> None:
    """Do nothing."""


class MotionLoop:
    """One motion on one arm. lateness: of its ticks. skipped: ticks that were too late to be made."""

    def __init__(
        self,
        motion: Motion,
        arm: Arm,
        clock: Clock,
        pose: Callable[[], SurfacePose | None],
        orders: Callable[[], Sequence[Order]],
        tell: Callable[[Tick], None] = nobody,
        homed: Callable[[], None] = nothing,
        rhythm: Rhythm | None = None,
    ) -> None:
        """pose: the newest there is. orders: those that have come since the last call. tell: is told of each tick.

        homed: is told when the arm has gone home, so that the motion begins from there. rhythm: of the ticks; without
        one they run freely, the profile's tick and the link's ease apart.
        """
        self.motion, self.arm = motion, arm
        self.lateness = Lateness()
        self.skipped = 0
        self._clock, self._pose, self._orders, self._tell, self._homed = clock, pose, orders, tell, homed
        profile, settings = arm.profile, arm.settings
        self._pause, self._look = profile.limits.pause, settings.poll
        self._rhythm = Rhythm(profile.tick, settings.ease, clock.now()) if rhythm is None else rhythm
        self._given: SurfacePose | None = None  # to the last tick
        self._left_off: Array = profile.arm.home  # where planner and guard take the arm to be
        self._homing = False
        self._answer = ""
        self._quit = False

    def run(self, until: float = float("inf")) -> None:
        """Go on until `until`, s, or until an order ends it; whatever ends it, the arm is stopped."""
        rhythm = self._rhythm
        rhythm.due = self._clock.now()
        try:
            while not self._quit and (now := self._clock.now()) < until:
                self._obey(now)
                self.arm.poll(now)
                pose = self._pose()
                if now >= rhythm.opens(pose is not self._given):
                    self._given = pose
                    self._tick(pose, now, max(now, rhythm.due))
                    self.skipped += rhythm.made(self._clock.now())
                self._clock.wait_until(min(rhythm.due, self._clock.now() + self._look))
        finally:
            farewell(self.arm, "the motion has ended", self._clock, self._look)

    def _obey(self, now: float) -> None:
        for order in self._orders():
            self._answer = self._do(order, now)
        if self._homing and (self.arm.state is not ArmState.ARMED or self.arm.arrived(now)):
            self._homing = False
            if self.arm.state is ArmState.ARMED:
                self._left_off = self.arm.profile.arm.home
                self._homed()
                self.arm.disarm(now)

    def _do(self, order: Order, now: float) -> str:
        """Follow an order; why it cannot be followed, or ""."""
        arm = self.arm
        if order is Order.STOP:
            arm.stop("by the operator", now)
        elif order is Order.DISARM:
            arm.disarm(now)
        elif order is Order.QUIT:
            self._quit = True
        elif order is Order.AT_HOME:
            return arm.stand(arm.profile.arm.home, now)
        elif order is Order.ARM:
            return arm.arm(now, self._left_off)
        elif order is Order.HOME:
            if reason := arm.arm(now) or arm.home(now):
                return reason
            self._homing = True
        return ""

    def _tick(self, pose: SurfacePose | None, now: float, instant: float) -> None:
        """Made at `now`, s, for `instant`, s, which is later where its pose came early."""
        late = max(now - self._rhythm.due, 0.0)
        self.lateness.add(late)
        frame = b""
        if recalled := self.arm.take_up():
            self._left_off = recalled.stands
            self.motion.recalled(recalled.place, recalled.stands)
        if reason := "the arm goes home" if self._homing else self.arm.hold(now):
            command: Command = Hold(instant, self._pause, reason)
        else:
            frame = self.motion(pose, instant)
            command = self.motion.last
            if isinstance(command, Move):
                self._left_off = command.axes
            if reason := self.arm.send(frame, now):
                frame, command = b"", Hold(instant, self._pause, reason)
        self._tell(Tick(instant, command, frame, late, self.arm.status(now), self._answer, recalled))
