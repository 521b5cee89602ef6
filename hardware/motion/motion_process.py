"""The body of the motion process: opens the arm, builds the motion, and loops until it is told to end.

Imports nothing that holds Python's lock for long: no gtsam, cv2 or onnxruntime. It is to be started by `spawn`,
as a forked child would have loaded all that its parent has.
"""

from __future__ import annotations

import signal
from collections import deque
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from types import FrameType

from estimation.pose import SurfacePose
from hardware.arm.link import Arm
from hardware.arm.port import Device
from hardware.arm.profile import ArmProfile
from hardware.arm_status import ArmEvent
from hardware.link_settings import LinkSettings
from hardware.motion.loop import MotionLoop, Order, Tick
from hardware.motion.step import MotionStep
from hardware.priority import ask_for_real_time
from hardware.process.clock import WallClock
from hardware.process.shared_latest import Newest
from planning.path import Path

EVENTS = 50  # of the last ones that a report holds


@dataclass(frozen=True, slots=True, eq=False)
class MotionPlan:
    """What is to be printed, and on which arm. url: of its port, for pyserial. real_time: ask for that priority."""

    path: Path
    profile: ArmProfile
    url: str
    settings: LinkSettings = field(default_factory=LinkSettings)
    real_time: bool = True


@dataclass(frozen=True, slots=True, eq=False)
class MotionReport:
    """What the motion process says after each tick.

    checkpoint, of `total`. events: the last ones. late: (3,) s, median, 99 % and largest of all ticks so far; skipped:
    ticks that were not made, beside `ticks` that were. stop: when the last one was decided and when it was on the wire,
    s. priority: what the system granted.
    """

    tick: Tick
    checkpoint: int
    total: int
    events: tuple[ArmEvent, ...]
    late: tuple[float, float, float]
    ticks: int
    skipped: int
    stop: tuple[float, float] | None
    priority: str


class _Reporter:
    """Puts a report after each tick."""

    def __init__(self, arm: Arm, motion: MotionStep, reports: Newest[MotionReport], real_time: bool) -> None:
        self._arm, self._motion, self._reports = arm, motion, reports
        self._priority = ask_for_real_time() if real_time else "nothing asked for"
        self._events: deque[ArmEvent] = deque(maxlen=EVENTS)
        self.loop: MotionLoop | None = None

    def __call__(self, tick: Tick) -> None:
        assert self.loop is not None
        self._events.extend(self._arm.events())
        progress, late = self._motion.progress, self.loop.lateness
        self._reports.put(
            MotionReport(
                tick,
                progress.checkpoint,
                progress.total,
                tuple(self._events),
                (late.percentile(50), late.percentile(99), late.most),
                late.count,
                self.loop.skipped,
                self._arm.stops[-1] if self._arm.stops else None,
                self._priority,
            )
        )


class _Orders:
    """The orders that have come; QUIT where nobody is left to give any, or a signal asked for the end."""

    def __init__(self, connection: Connection) -> None:
        self._connection = connection
        self._ended = False
        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, self._end)

    def __call__(self) -> list[Order]:
        taken: list[Order] = []
        try:
            while self._connection.poll():
                taken.append(self._connection.recv())
        except (EOFError, OSError):
            self._ended = True
        return [*taken, Order.QUIT] if self._ended else taken

    def _end(self, number: int, frame: FrameType | None) -> None:
        self._ended = True


def motion_process(
    plan: MotionPlan, poses: Newest[SurfacePose], reports: Newest[MotionReport], orders: Connection
) -> None:
    """Print until told to QUIT, or until whoever gives orders is gone; then the arm is stopped."""
    clock, device = WallClock(), Device(plan.url, plan.profile.baud)
    arm, motion = Arm(device, plan.profile, clock.now(), plan.settings), MotionStep(plan.path, plan.profile)
    reporter = _Reporter(arm, motion, reports, plan.real_time)
    loop = reporter.loop = MotionLoop(motion, arm, clock, poses.get, _Orders(orders), reporter)
    try:
        loop.run()
    finally:
        reporter.loop = None  # else the two would keep each other, and the planner's solver, until the very end
        arm.close()
        device.release()
