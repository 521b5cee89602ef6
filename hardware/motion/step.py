"""MotionStep: the newest surface pose in, the arm's next command out; no I/O and no clock of its own.

The planner proposes a command and the guard passes it or turns it into a Hold; the arm's link encodes it.
`motion_process` runs a MotionStep on an arm, without the recorder and the page of a live run. The motion's processes
import this module: it must never load gtsam, cv2 or onnxruntime, as a call of gtsam was measured to stop every other
thread for as long as it takes.
"""

from __future__ import annotations

import signal
from collections import deque
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from types import FrameType

from estimation.pose import SurfacePose
from estimation.se3 import Array
from hardware.arm.device import ArmEvent
from hardware.arm.link import Arm
from hardware.arm.profile import ArmProfile, LinkSettings, open_arm
from hardware.motion.loop import MotionLoop, Order, Tick
from hardware.process.clock import WallClock
from hardware.process.system import SharedLatest, ask_for_real_time, take_messages
from planning.command import Command, Hold, Move
from planning.material import Outlets, with_offsets
from planning.motion.guard import Guard
from planning.motion.planner import Planner
from planning.path import Path, PrintProgress


class MotionStep:
    """One arm printing one path; call it once a tick."""

    def __init__(
        self, path: Path, profile: ArmProfile | None = None, start: float = 0.0, outlets: Outlets | None = None
    ) -> None:
        """start: place on the path where printing begins, in checkpoints. outlets: of the path's materials."""
        self.profile = ArmProfile() if profile is None else profile
        settings = self.profile.limits, self.profile.arm, self.profile.tick
        lag = self.profile.lag
        path = with_offsets(path, outlets or {})
        self._planner = Planner(path, *settings, lag, start, outlets)
        self._guard = Guard(*settings, path.zone, lag)

    def __call__(self, pose: SurfacePose | None, now: float) -> Command:
        """The command of the tick at `now`, s, as the guard lets it pass. pose: the newest there is."""
        proposal = self._planner(pose, now)
        command = self._guard(proposal, pose, now)
        if isinstance(proposal, Move) and isinstance(command, Hold):
            self._planner.refused(self._guard.axes)
        return command

    def recalled(self, place: Array, stands: Array) -> None:
        """Go on from `stands` (6,), where the arm stands after a stop at `place` (6,) on its way."""
        self._planner.recalled(place, stands)
        self._guard.stands(stands)

    def material_in(self) -> None:
        """Note that the material that `progress.wanted` asks for is in."""
        self._planner.material_in()

    @property
    def lag(self) -> float:
        """Seconds from one tick after a command was sent until the arm is at its axes: the profile's until it is set.

        Whoever sets it records it with the tick, as the commands from then on depend on it.
        """
        return self._planner.lag

    @lag.setter
    def lag(self, value: float) -> None:
        self._planner.lag = self._guard.lag = value

    @property
    def paused(self) -> bool:
        """Whether the nozzle is to retract from the surface and wait there; it then goes on where it left off."""
        return self._planner.paused

    @paused.setter
    def paused(self, value: bool) -> None:
        self._planner.paused = value

    @property
    def progress(self) -> PrintProgress:
        """How far the print is, and in which phase."""
        return self._planner.progress


MAX_REPORTED_EVENTS = 50


@dataclass(frozen=True, slots=True, eq=False)
class MotionPlan:
    """What is to be printed, and on which arm."""

    path: Path
    profile: ArmProfile
    url: str  # of the arm's port, for pyserial
    settings: LinkSettings = field(default_factory=LinkSettings)
    real_time: bool = True  # ask for that priority


@dataclass(frozen=True, slots=True, eq=False)
class MotionReport:
    """The state of the motion process after a tick."""

    tick: Tick
    total: int  # checkpoints
    events: tuple[ArmEvent, ...]  # the last ones
    late: tuple[float, float, float]  # s, median, 99 % and largest lateness of all ticks so far
    ticks: int
    skipped: int  # ticks left out
    stop: tuple[float, float] | None  # s, when the last one was decided and when it was on the wire
    priority: str  # as the system granted it


class _Orders:
    """The orders received; QUIT where the other end is closed, or at SIGTERM and SIGINT."""

    def __init__(self, connection: Connection) -> None:
        self._connection = connection
        self._ended = False
        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, self._end)

    def __call__(self) -> list[Order]:
        orders, closed = take_messages(self._connection)
        self._ended |= closed
        return [*orders, Order.QUIT] if self._ended else orders

    def _end(self, number: int, frame: FrameType | None) -> None:
        self._ended = True


def motion_process(
    plan: MotionPlan, poses: SharedLatest[SurfacePose], reports: SharedLatest[MotionReport], orders: Connection
) -> None:
    """Print until an order to quit, or until the process that gives orders is gone; then stop the arm."""
    clock, driver = WallClock(), open_arm(plan.url, plan.profile)
    arm, motion = Arm(driver, plan.profile, clock.now(), plan.settings), MotionStep(plan.path, plan.profile)
    priority = ask_for_real_time() if plan.real_time else "nothing asked for"
    events: deque[ArmEvent] = deque(maxlen=MAX_REPORTED_EVENTS)

    loop: MotionLoop | None = None

    def report(tick: Tick) -> None:
        assert loop is not None
        events.extend(arm.events())
        late, total = loop.lateness, motion.progress.total
        lateness, stop = (late.percentile(50), late.percentile(99), late.most), arm.stops[-1] if arm.stops else None
        reports.put(MotionReport(tick, total, tuple(events), lateness, late.count, loop.skipped, stop, priority))

    loop = MotionLoop(motion, arm, clock, poses.get, _Orders(orders), report)
    try:
        loop.run()
    finally:
        loop = None  # report and loop refer to each other: the planner's solver would live until the process ends
        arm.close()
        driver.release()
