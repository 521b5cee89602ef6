"""The body of the motion process: opens the arm, builds the motion, and loops until it is told to end.

Imports nothing that holds Python's lock for long: no gtsam, cv2, open3d or onnxruntime. It is to be started by `spawn`,
as a forked child would have loaded all that its parent has.
"""

from __future__ import annotations

import signal
from collections import deque
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from types import FrameType

from estimation.pose import SurfacePose
from hardware.arm import Arm
from hardware.arm_port import Device
from hardware.arm_profile import ArmProfile
from hardware.arm_status import ArmEvent
from hardware.clock import WallClock
from hardware.link_settings import LinkSettings
from hardware.motion import MotionStep
from hardware.motion_loop import MotionLoop, Order, Tick, lateness_figures
from hardware.newest import Newest
from hardware.priority import ask_for_real_time
from planning.path import Path

EVENTS = 50  # of the last ones that a report holds


@dataclass(frozen=True, slots=True, eq=False)
class MotionPlan:
    """What is to be printed, and on which arm. url: of the arm's port, anything that pyserial opens."""

    path: Path
    profile: ArmProfile
    url: str
    settings: LinkSettings = field(default_factory=LinkSettings)


@dataclass(frozen=True, slots=True, eq=False)
class MotionReport:
    """What the motion process says after each tick.

    checkpoint, of `total`. events: the last ones. late: (3,) s, median, 99 % and largest of all ticks; skipped: ticks
    that were not made. priority: that the system granted.
    """

    tick: Tick
    checkpoint: int
    total: int
    events: tuple[ArmEvent, ...]
    late: tuple[float, float, float]
    skipped: int
    priority: str


class _Reporter:
    """Puts a report after each tick."""

    def __init__(self, arm: Arm, motion: MotionStep, reports: Newest[MotionReport]) -> None:
        self._arm, self._motion, self._reports = arm, motion, reports
        self._priority = ask_for_real_time()
        self._events: deque[ArmEvent] = deque(maxlen=EVENTS)
        self._late = lateness_figures([])
        self.loop: MotionLoop | None = None
        self._count = 0

    def __call__(self, tick: Tick) -> None:
        assert self.loop is not None
        self._events.extend(self._arm.events())
        self._count += 1
        if self._count % EVENTS == 0:  # takes as long as a pose
            self._late = lateness_figures(self.loop.lateness)
        progress, skipped = self._motion.progress, self.loop.skipped
        place = progress.checkpoint, progress.total
        self._reports.put(MotionReport(tick, *place, tuple(self._events), self._late, skipped, self._priority))


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
    reporter = _Reporter(arm, motion, reports)
    loop = reporter.loop = MotionLoop(motion, arm, clock, poses.get, _Orders(orders), reporter)
    try:
        loop.run()
    finally:
        arm.close()
        device.release()
