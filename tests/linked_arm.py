"""An Arm on a virtual arm in virtual time: what the tests of the link share."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from estimation.se3 import Array
from hardware.arm.link import Arm
from hardware.arm.profile import ArmProfile, LinkSettings
from hardware.arm.s6h4d import S6H4D
from hardware.process.clock import SimClock
from hardware.process.faults import Fault
from hardware.simulator.arm.controller import VirtualArm
from hardware.simulator.arm.settings import ArmSettings
from planning.command import Hold, Move
from tests.faulty_port import FaultyDevice, PortFaults
from tests.virtual_arm import HOME

STEP = 0.001  # s between looks


def moving(axes: Array, feed: float) -> Move:
    """The command to go there; only that counts for a link."""
    return Move(0.0, axes, feed, 0, False)


def waiting(duration: float) -> Hold:
    """The command to wait for so long."""
    return Hold(0.0, duration, "")


@dataclass
class Linked:
    clock: SimClock
    virtual: VirtualArm
    device: FaultyDevice
    arm: Arm
    deepest: float = 0.0  # s in flight by the model
    phase: float = 0.0  # s of the round motion that were sent

    def run(self, seconds: float, each: Callable[[float], None] | None = None, tick: float = 0.02) -> None:
        """Let time pass; `each` is called once a tick."""
        start, ticks = self.clock.now(), 0
        while (now := self.clock.now()) < start + seconds - 1e-9:
            self.arm.poll(now)
            if each is not None and now >= start + ticks * tick - 1e-9:
                each(now)
                ticks += 1
            self.deepest = max(self.deepest, self.arm.in_flight(now))
            self.clock.wait_until(now + STEP)
        self.arm.poll(self.clock.now())
        self.virtual.advance(self.clock.now())

    def follow(self, seconds: float) -> list[str]:
        """Send a round motion for so long, which waits where it may not be sent; what was not sent says why."""
        refused: list[str] = []

        def each(now: float) -> None:
            self.arm.take_up()
            if reason := self.arm.hold(now) or self.send(circle(self.phase + 0.02)):
                refused.append(reason)
            else:
                self.phase += 0.02

        self.run(seconds, each)
        return refused

    @property
    def backlog(self) -> float:
        """Seconds that the arm is behind the model, as its answers say."""
        queue = self.arm._queue
        assert queue is not None
        return self.arm._feedback.backlog(queue, self.clock.now())

    def executed(self) -> Array:
        """Where the virtual arm is now (6,)."""
        self.virtual.advance(self.clock.now())
        return np.asarray(self.virtual.axes_at(np.array([self.clock.now()]))[0])

    def send(self, axes: Array, seconds: float = 0.02) -> str:
        """A move that takes so long from where the arm was last sent."""
        feed = max(float(np.linalg.norm((axes - self.arm.target)[:3])) / seconds, 1.0)
        return self.arm.send(moving(axes, feed), self.clock.now())


def linked(
    settings: ArmSettings | None = None,
    *faults: Fault,
    port: PortFaults | None = None,
    link: LinkSettings | None = None,
    profile: ArmProfile | None = None,
    stand: bool = True,
    begin: Array = HOME,
) -> Linked:
    """stand: the arm was told that it stands at `begin`, as it does, and is armed."""
    clock, profile = SimClock(), ArmProfile() if profile is None else profile
    settings = ArmSettings(servo_lag=0.0) if settings is None else settings
    virtual = VirtualArm(settings, profile.dialect, begin, faults, profile.baud)
    device = FaultyDevice(virtual, clock, profile.baud, port)
    made = Linked(clock, virtual, device, Arm(S6H4D(device, profile), profile, 0.0, link or LinkSettings()))
    if stand:
        assert made.arm.stand(begin, 0.0) == "" and made.arm.arm(0.0) == ""
    return made


def circle(now: float, radius: float = 10.0, period: float = 4.0) -> Array:
    """A round motion that begins at home: 16 mm/s."""
    phase = 2 * np.pi * now / period
    return HOME + np.array([radius * np.sin(phase), radius * (1 - np.cos(phase)), 0, 0, 0, 0.02 * np.sin(phase)])
