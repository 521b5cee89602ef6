"""The body of the motion process of a live run: arm, MotionLoop, reports, and what is recorded of them.

Loads nothing that holds Python's lock for long: no gtsam, cv2 or onnxruntime.
"""

from __future__ import annotations

import math
import signal
from collections import deque
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from pathlib import Path as File
from types import FrameType

from estimation.errors import InputError
from estimation.pose import SurfacePose
from hardware.arm.link import Arm
from hardware.arm.port import Device
from hardware.arm.profile import ArmProfile
from hardware.arm_status import ArmEvent
from hardware.bookmark_file import keep_bookmark
from hardware.link_settings import LinkSettings
from hardware.live.histograms import Histograms
from hardware.live.motion import LiveMotion
from hardware.live.motion_names import EXPOSURE_TO_WIRE, FRAMES_TO_WIRE, LATE
from hardware.live.outbox import Outbox
from hardware.live.place import Place
from hardware.live.records import Begin, Handed, LiveMotionReport, Pace, Span, WireEntry
from hardware.live.tap import Tap
from hardware.motion.loop import MotionLoop, Order, Tick
from hardware.operator.shared_state import RequestLine
from hardware.priority import ask_for_real_time
from hardware.process.clock import WallClock
from hardware.process.shared_latest import Newest
from hardware.process.system import settle
from hardware.process.ticks import InStep
from hardware.recorded_tick import RecordedTick

EVENTS = 50  # of the last ones that a report holds
SECOND_BYTE = 1  # of a frame: which instruction it is
MOVE = ord("1")


@dataclass(frozen=True, slots=True, eq=False)
class LiveMotionPlan:
    """On which arm is printed. url: of its port. bookmark: where the place is kept if whoever conducts the run is gone.

    real_time: ask for that priority. cores: to run on, all without any.
    """

    profile: ArmProfile
    url: str
    bookmark: File
    settings: LinkSettings = field(default_factory=LinkSettings)
    real_time: bool = True
    cores: tuple[int, ...] = ()


class _Orders:
    """Takes the orders; those of a live run are followed here, those of the arm are passed on."""

    def __init__(self, connection: Connection, motion: LiveMotion, wishes: RequestLine, rhythm: InStep) -> None:
        self._connection, self._motion, self._wishes, self._rhythm = connection, motion, wishes, rhythm
        self._stopped = wishes.last_stop
        self.alone, self.fingerprint = False, ""
        self._ended = False
        signal.signal(signal.SIGTERM, self._end)

    def __call__(self) -> list[Order]:
        taken: list[Order] = []
        if (stop := self._wishes.last_stop) != self._stopped:  # the page's stop takes no way through the conductor
            self._stopped = stop
            taken.append(Order.STOP)
        try:
            while self._connection.poll():
                order = self._connection.recv()
                if isinstance(order, Order):
                    taken.append(order)
                else:
                    self._follow(order)
        except (EOFError, OSError):
            self.alone = True
        return [*taken, Order.QUIT] if self.alone or self._ended else taken

    def _follow(self, order: Begin | Pace) -> None:
        if isinstance(order, Begin):
            self.fingerprint, self._rhythm.tick = order.fingerprint, order.profile.tick
            self._motion.begin(order)
        else:
            self._motion.paused = order is Pace.PAUSE

    def _end(self, number: int, frame: FrameType | None) -> None:
        self._ended = True


class _Watch:
    """Measures the way from frames to the wire, records what passes, reports each tick."""

    def __init__(
        self,
        plan: LiveMotionPlan,
        poses: Newest[Handed],
        reports: Newest[LiveMotionReport],
        outbox: Outbox,
        rhythm: InStep,
    ) -> None:
        self._poses, self._reports, self._outbox, self._rhythm = poses, reports, outbox, rhythm
        self._clock = WallClock()
        self.times = Histograms()
        self._priority = ask_for_real_time() if plan.real_time else "nothing asked for"
        self._events: deque[ArmEvent] = deque(maxlen=EVENTS)
        self._given: Handed | None = None  # the newest pose that was looked at
        self._first = False  # whether no move made of it went out yet
        self.loop: MotionLoop | None = None
        self.motion: LiveMotion | None = None

    def pose(self) -> SurfacePose | None:
        """The newest pose there is."""
        handed = self._poses.get()
        if handed is not self._given:
            self._given, self._first = handed, True
            if handed is not None:
                self._rhythm.arrived(handed.put)
        return None if handed is None else handed.pose

    def heard(self, data: bytes, sent: bool) -> None:
        """Bytes passed the port."""
        now, frame = self._clock.now(), b"" if self.motion is None else self.motion.frame
        made = sent and data == frame and frame[SECOND_BYTE] == MOVE  # the arm's own way home is made of no pose
        if made and self._first and self._given is not None:
            self._first = False
            self.times.add(FRAMES_TO_WIRE, now - self._given.handed)
            self.times.add(EXPOSURE_TO_WIRE, now - self._given.pose.stamp)
        self._outbox.put(WireEntry(now, data, sent))

    def told(self, tick: Tick) -> None:
        """A tick is done."""
        loop, motion = self.loop, self.motion
        assert loop is not None and motion is not None
        self._events.extend(loop.arm.events())
        progress, late = motion.progress, loop.lateness
        if progress is not None:
            stamp = math.nan if self._given is None else self._given.pose.stamp
            asked, begun = motion.asked and motion.last.stamp == tick.stamp, motion.begun
            motion.begun, frame = math.nan, motion.frame if asked else b""
            came_to = progress.fraction, progress.phase, None if tick.recalled is None else tick.recalled.rows
            self._outbox.put(
                RecordedTick(tick.stamp, stamp, asked, begun, motion.paused, tick.command, frame, *came_to)
            )
        spans = (*self.times.spans(), Span(LATE, late.count, late.percentile(50), late.percentile(99), late.most))
        stops = loop.arm.stops
        self._reports.put(
            LiveMotionReport(
                *(tick, progress, motion.paused, tuple(self._events), spans, loop.skipped, len(stops)),
                *(stops[-1] if stops else None, self._outbox.dropped, self._priority),
            )
        )


def live_motion_process(
    plan: LiveMotionPlan,
    place: Place,
    poses: Newest[Handed],
    reports: Newest[LiveMotionReport],
    orders: Connection,
    wishes: RequestLine,
    trouble: Newest[str],
    record: Connection,
) -> None:
    """Follow orders until told to QUIT, or until whoever gives them is gone; then the arm is stopped.

    trouble: is told why the arm cannot be used at all.
    """
    settle("motion", plan.cores)
    clock, device, outbox = WallClock(), Device(plan.url, plan.profile.baud), Outbox(record)
    rhythm = InStep(plan.profile.tick, plan.settings.ease, clock.now())
    motion, watch = LiveMotion(plan.profile, place), _Watch(plan, poses, reports, outbox, rhythm)
    told = _Orders(orders, motion, wishes, rhythm)
    try:
        arm = Arm(Tap(device, watch.heard), plan.profile, clock.now(), plan.settings)
        watch.motion = motion
        loop = watch.loop = MotionLoop(motion, arm, clock, watch.pose, told, watch.told, motion.homed, rhythm)
        try:
            loop.run()
        finally:
            watch.loop = None
            arm.close()
    except InputError as error:
        trouble.put(str(error))
    finally:
        device.release()
        if told.alone and told.fingerprint:
            keep_bookmark(plan.bookmark, told.fingerprint, place.fraction)
        for entry in watch.times.entries(clock.now()):
            outbox.put(entry)
        outbox.close()
