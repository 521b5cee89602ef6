"""The loop of a print: ticks, motion and the arm's link, with one interface, `LoopSource`, for all of its inputs.

A live run, a simulation and a replay have the same loop; they differ by their `LoopSource`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from ctypes import c_double
from dataclasses import dataclass
from typing import Protocol

from estimation.pose import SurfacePose
from hardware.arm.driver import ArmDriver
from hardware.arm.link import DEFAULT_SETTINGS, Arm
from hardware.arm.profile import ArmProfile, LinkSettings
from hardware.motion.loop import MaterialControl, MotionLoop, Order, Tick
from hardware.motion.step import BeginPrint, PauseOrder, PoseHandover, PrintMotion
from hardware.process.clock import Clock, PoseLockedSchedule
from planning.material import FlowShares

LoopOrder = Order | PauseOrder | BeginPrint | FlowShares


class LoopSource(Protocol):
    """The inputs of a print's loop."""

    driver: ArmDriver
    material: MaterialControl | None

    def now(self) -> float:
        """The clock, s."""
        ...

    def wait_until(self, instant: float) -> None:
        """Wait until `instant`, s."""
        ...

    def pose(self) -> PoseHandover | None:
        """The newest pose; the same object until there is a newer one."""
        ...

    def orders(self) -> Sequence[LoopOrder]:
        """The orders since the last call."""
        ...

    def dry(self) -> str:
        """Why material cannot flow now, "" where it can."""
        ...

    def flush(self) -> None:
        """A tick is done, or the loop."""
        ...


@dataclass(frozen=True, slots=True)
class LoopSettings:
    """Settings of a loop."""

    link: LinkSettings = DEFAULT_SETTINGS
    until: float | None = None  # s, when it ends by itself; None: an order ends it


class PrintLoop:
    """The loop of a print on one arm, with any source. loop, motion, arm: its parts."""

    def __init__(
        self,
        source: LoopSource,
        profile: ArmProfile,
        settings: LoopSettings,
        clock: Clock,
        report: Callable[[Tick], None] = lambda tick: None,
        place: c_double | None = None,
    ) -> None:
        """clock: for dispensers only, which are no part of a replay. place: kept up to date, in checkpoints.

        InputError where another program has the arm.
        """
        start, self._source, self._settings, self._report_tick = source.now(), source, settings, report
        self._handover: PoseHandover | None = None
        self.arm = Arm(source.driver, profile, start, settings.link)
        self.ticks = PoseLockedSchedule(profile.tick, settings.link.ease, start)
        material, place = source.material, c_double() if place is None else place
        self.motion = PrintMotion(profile, clock, place, material, lambda: self.arm.lag, source.dry)
        inputs, homed = (self._pose, self._orders), self.motion.homed
        self.loop = MotionLoop(self.motion, self.arm, source, *inputs, self._report, homed, self.ticks, material)

    def run(self) -> None:
        """Run until an order or the settings end it."""
        until = self._settings.until
        try:
            self.loop.run(math.inf if until is None else until)
        finally:
            self._source.flush()

    def _report(self, tick: Tick) -> None:
        self._report_tick(tick)
        self._source.flush()

    def _pose(self) -> SurfacePose | None:
        """The newest pose, by whose arrival the ticks are timed."""
        handover = self._source.pose()
        if handover is not self._handover and handover is not None:
            self.ticks.arrived(handover.sent)
        self._handover = handover
        return None if handover is None else handover.pose

    def _orders(self) -> list[Order]:
        """Follow the orders for the motion; those for the arm are returned."""
        orders: list[Order] = []
        for order in self._source.orders():
            if isinstance(order, Order):
                orders.append(order)
            else:
                if isinstance(order, BeginPrint):
                    self.ticks.tick = order.profile.tick
                self.motion.follow(order)
        return orders
