"""`stillbed bench link`: jitter, stops, and what arrives of a motion process on a pty, while others saturate the cores.

Three processes as in a live run: a virtual arm that serves a pty, the motion process, and this one, which gives poses
and orders; and some that only use up processor time. The motion process is halted now and then, as by a busy machine;
the device goes and comes back; the controller stalls and the wire loses frames.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import signal
import tempfile
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stdout
from dataclasses import dataclass, field
from io import StringIO
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from pathlib import Path
from types import FrameType

import numpy as np

from estimation import se3
from estimation.pose import SurfacePose, TrackState
from estimation.se3 import Array
from hardware.arm.device import ArmEvent, ArmState, LinkCode
from hardware.arm.link import Arm
from hardware.arm.profile import ARM_FROM_BENCH, ArmProfile, LinkSettings, open_arm
from hardware.bench.figures import Figure, at_least, at_most, milliseconds
from hardware.motion.loop import MotionLoop, Order, Tick
from hardware.motion.step import MotionStep
from hardware.process.clock import WallClock
from hardware.process.faults import Fault, FaultKind, FaultPart
from hardware.process.system import SharedLatest, ask_for_real_time, take_messages
from hardware.simulator.arm.ports import run_virtual_arm
from hardware.simulator.arm.settings import ArmSettings, ReplyMode
from planning.path import Path as Toolpath

MAX_REPORTED_EVENTS = 50


@dataclass(frozen=True, slots=True, eq=False)
class MotionPlan:
    """What is to be printed, and on which arm."""

    path: Toolpath
    profile: ArmProfile
    url: str  # of the arm's port, for pyserial
    settings: LinkSettings = field(default_factory=LinkSettings)


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
    priority = ask_for_real_time()
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


DEVICE_SPAN = 40.0  # s with one device, where it goes and comes back
POSE_RATE = 30.0  # Hz
STOP_PERIOD = 3.0  # s between the operator's stops
HALT_PERIOD, MAX_HALT = 6.0, 0.6  # s between halts of the motion process, and of the longest
START_TIMEOUT = 60.0  # s in which a process must have started, on a busy machine
NOT_MEASURED = float("nan")
# what goes wrong: nothing; host and port; the arm and its wire
LIVE_PARTS = "calm", "halted", "rough"
HALTED_PART, ROUGH_PART = LIVE_PARTS[1:]


@dataclass(frozen=True, slots=True)
class ArmReport:
    """What a virtual arm counted."""

    frames: int
    ignored: int
    refused: int
    garbage: int  # bytes
    deepest: float  # s, the most that was ever queued
    left: float  # s, queued at its end


@dataclass(slots=True)
class LivePart:
    """The measurements of one part. Times in s."""

    arms: list[ArmReport] = field(default_factory=list)
    flight: float = 0.0  # most under way, by the link's model
    stops: list[float] = field(default_factory=list)  # from the decision to the wire
    orders: list[float] = field(default_factory=list)  # from the order to the wire
    load: list[float] = field(default_factory=list)
    halts: int = 0
    report: MotionReport | None = None
    rate: float = NOT_MEASURED  # ticks a second


def run_link(options: argparse.Namespace) -> list[Figure]:
    """Three parts of equal length: a calm one, whose jitter counts, one with halts and returns, one with a bad arm."""
    seconds, seed, busy = 60 * options.minutes, options.seed, options.busy
    parts = [run_part(seconds / 3, seed + k, busy, part) for k, part in enumerate(LIVE_PARTS)]
    calm, halted, rough = parts
    name = f"real time {seconds / 60:.3g} min"
    arms = [arm for part in parts for arm in part.arms]
    obeying = calm.arms + halted.arms
    load, report = np.mean([*calm.load, *halted.load, *rough.load] or [NOT_MEASURED]), calm.report
    priority, late, skipped = "", (NOT_MEASURED,) * 3, 0
    if report is not None:
        priority, late, skipped = report.priority, report.late, report.skipped
    machine = f"{priority}; load {load:.1f} on {os.cpu_count()} cores, {busy} processes burn"
    stops, orders = calm.stops + halted.stops + rough.stops, calm.orders + rough.orders
    note = f"{halted.halts} halts up to 600 ms, {len(halted.arms) - 1} returns of the device"
    decided, moving = f"{name}: stop on the wire after its decision, 99 %", sum(p.arms[-1].left > 0 for p in parts[:2])
    return [
        Figure(f"{name}: ticks a second", calm.rate, "Hz", at_least(49.5), "thesis 30", machine),
        Figure(f"{name}: tick late, median", 1000 * late[0], "ms"),
        Figure(f"{name}: tick late, 99 %", 1000 * late[1], "ms", at_most(3), "8 in a process, 72 in a thread"),
        Figure(f"{name}: tick late, largest", 1000 * late[2], "ms", note=f"{skipped} ticks were skipped"),
        Figure(decided, milliseconds(stops, 99), "ms", at_most(10), note=f"{len(stops)} stops"),
        Figure(f"{name}: stop on the wire after the order, 99 %", milliseconds(orders, 99), "ms",
               note="from another process"),
        Figure(f"{name}: most under way, by the model", 1000 * max(p.flight for p in parts), "ms", at_most(50)),
        Figure(f"{name}: most queued in the arm", _queued(obeying), "ms", at_most(50), "", note),
        Figure(f"{name}: most queued, the arm stalls and loses frames", _queued(rough.arms), "ms"),
        Figure(f"{name}: commands that found the queue full", sum(a.ignored for a in arms), "", at_most(0)),
        Figure(f"{name}: bytes in no frame", sum(a.garbage for a in calm.arms), "", at_most(0), "", "calm part"),
        Figure(f"{name}: frames that the arm refused", sum(a.refused for a in obeying), "", at_most(0)),
        Figure(f"{name}: arms not at rest once the motion has ended", moving, "", at_most(0), "", "of 2"),
        Figure(f"{name}: frames taken", sum(a.frames for a in arms)),
    ]  # fmt: skip


def _queued(arms: list[ArmReport]) -> float:
    return 1000 * max((arm.deepest for arm in arms), default=NOT_MEASURED)


def run_part(seconds: float, seed: int, busy: int, part: str) -> LivePart:
    """Print on a breathing surface for so long."""
    context, clock = multiprocessing.get_context("spawn"), WallClock()
    poses, reports = SharedLatest[SurfacePose](), SharedLatest[MotionReport]()
    orders, theirs = context.Pipe()
    with tempfile.TemporaryDirectory() as folder, burning(busy):
        link = Path(folder) / "arm"
        arm = _VirtualArm(link, seed, part == ROUGH_PART)
        plan = MotionPlan(_toolpath(), ArmProfile(), str(link))
        motion = context.Process(target=motion_process, args=(plan, poses, reports, theirs))
        motion.start()
        theirs.close()
        operator = _Operator(orders, motion, np.random.default_rng(seed), part == HALTED_PART)
        try:
            poses.put(_pose(clock.now()))
            _wait(lambda: reports.get() is not None)
            begun = device = clock.now()
            while (now := clock.now()) < begun + seconds:
                poses.put(_pose(now))
                operator.act(reports.get(), now)
                if part == HALTED_PART and now > device + DEVICE_SPAN:
                    operator.measured.arms.append(arm.end())
                    arm, device = _VirtualArm(link, seed, False), clock.now()
                clock.wait_until(now + 1 / POSE_RATE)
            operator.end(reports.get())
            operator.measured.arms.append(arm.end())
        finally:
            _kill(motion, arm.process)
    return operator.measured


class _VirtualArm:
    """A virtual arm that serves a pty in a process of its own."""

    def __init__(self, link: Path, seed: int, bad: bool) -> None:
        context = multiprocessing.get_context("spawn")
        self._reports, theirs = context.Pipe()
        self.process = context.Process(target=_serve, args=(link, seed, bad, theirs))
        self.process.start()
        _wait(link.is_symlink)

    def end(self) -> ArmReport:
        """Have it end; its report."""
        self.process.terminate()
        assert self._reports.poll(START_TIMEOUT)
        report: ArmReport = self._reports.recv()
        self.process.join()
        return report


def _serve(link: Path, seed: int, bad: bool, reports: Connection) -> None:
    ask_for_real_time()  # a real controller shares no core with us
    settings = ArmSettings(replies=ReplyMode.STREAM, seed=seed)
    with redirect_stdout(StringIO()):
        arm = run_virtual_arm(settings, faults=_faults(seed) if bad else (), link=link)
    garbage = sum(len(data) for _, data in arm.garbage)
    reports.send(ArmReport(arm.frames, len(arm.ignored), len(arm.refused), garbage, arm.deepest, arm.in_flight))


def _faults(seed: int) -> list[Fault]:
    """Stalls, losses and cuts of the wire, each some seconds after the last, for an hour."""
    rng, now, faults = np.random.default_rng(seed), 5.0, list[Fault]()
    while now < 3600:
        kind = WIRE_FAULTS[rng.integers(len(WIRE_FAULTS))]
        length = 0.0 if kind is FaultKind.DROP else float(rng.uniform(0.05, MAX_HALT))
        faults.append(Fault(FaultPart.ARM, kind, now, length))
        now += float(rng.uniform(4, 10))
    return faults


WIRE_FAULTS = (FaultKind.STALL, FaultKind.STALL, FaultKind.DROP, FaultKind.UNPLUG)


class _Operator:
    """Arms, stops and arms again, halts the motion process, and collects what it reports."""

    def __init__(self, orders: Connection, motion: BaseProcess, rng: np.random.Generator, halts: bool) -> None:
        self.measured = LivePart()
        self._orders, self._motion, self._rng, self._halts = orders, motion, rng, halts
        self._stop = self._halt = self._arm = 0.0  # s, when each is due
        self._stop_sent: float | None = None
        self._first: MotionReport | None = None
        self._clock = WallClock()

    def act(self, report: MotionReport | None, now: float) -> None:
        """Read a report, and do what is due at `now`, s."""
        assert report is not None
        self._first = self._first or report
        status, measured = report.tick.status, self.measured
        measured.flight = max(measured.flight, status.in_flight)
        if report.stop is not None and self._stop_sent is not None and report.stop[0] > self._stop_sent:
            measured.stops.append(report.stop[1] - report.stop[0])
            measured.orders.append(report.stop[1] - self._stop_sent)
            self._stop_sent = None
        if status.state is ArmState.ARMED:
            self._disturb(now)
        elif now > self._arm:
            self._orders.send(Order.HOME if report.tick.answer.code is LinkCode.FAR_FROM_PATH else Order.ARM)
            self._arm = now + 0.5
            self._stop = max(self._stop, now + 1.0)

    def _disturb(self, now: float) -> None:
        if now > self._stop and self._stop_sent is None:
            self.measured.load.append(os.getloadavg()[0])
            self._stop_sent = self._clock.now()
            self._orders.send(Order.STOP)
            self._stop = now + STOP_PERIOD * self._rng.uniform(0.8, 1.2)
        elif self._halts and now > self._halt and self._motion.pid is not None:
            self._halt = now + HALT_PERIOD * self._rng.uniform(0.5, 1.5)
            os.kill(self._motion.pid, signal.SIGSTOP)
            self._clock.wait_until(now + self._rng.uniform(0.02, MAX_HALT))
            os.kill(self._motion.pid, signal.SIGCONT)
            self.measured.halts += 1

    def end(self, report: MotionReport | None) -> None:
        """Have the motion end, after its last report."""
        self._orders.send(Order.QUIT)
        self._motion.join(START_TIMEOUT)
        self.measured.report = report
        if report is not None and self._first is not None:
            seconds = report.tick.stamp - self._first.tick.stamp
            self.measured.rate = (report.ticks - self._first.ticks) / seconds


@contextmanager
def _running(*processes: BaseProcess) -> Iterator[None]:
    for process in processes:
        process.start()
    try:
        yield
    finally:
        _kill(*processes)


def _kill(*processes: BaseProcess) -> None:
    for process in processes:
        process.kill()
        process.join()


@contextmanager
def burning(count: int) -> Iterator[None]:
    """So many processes that want a core each, of ordinary priority, as another user's."""
    context = multiprocessing.get_context("spawn")
    with _running(*(context.Process(target=_burn, daemon=True) for _ in range(count))):
        yield


def _burn() -> None:
    os.setsid()  # Linux shares the processor among sessions
    matrix = np.random.default_rng(0).normal(size=(300, 300))
    while True:
        matrix = matrix @ matrix
        matrix /= np.abs(matrix).max()


def _wait(ready: Callable[[], bool]) -> None:
    clock = WallClock()
    until = clock.now() + START_TIMEOUT
    while not ready():
        assert clock.now() < until, "a process did not start"
        clock.wait_until(clock.now() + 0.02)


def _toolpath() -> Toolpath:
    """Lines of 20 mm that take a quarter of an hour to print."""
    across = np.linspace(-10, 10, 240)
    xy = np.array([[x, y] for i, y in enumerate(across) for x in np.array([-10.0, 10.0]) * (-1) ** i])
    count, ones = len(xy), np.ones(len(xy), np.int64)
    places = se3.make(np.eye(3), np.column_stack([xy, np.zeros(count)]))
    return Toolpath(places, np.full(count, 5.0), ones, np.full(count, 20.0), 0 * ones, np.ones(count, bool))


def _pose(now: float) -> SurfacePose:
    """A chest that breathes 10 mm, as the tracker would report it."""
    twist = (se3.log(se3.inverse(_base(now - 1e-4)) @ _base(now + 1e-4))) / 2e-4
    covariance = np.diag([1e-6] * 3 + [1e-4] * 3)
    return SurfacePose(now, _base(now), covariance, twist, TrackState.TRACKING)


def _base(now: float) -> Array:
    sine, cosine = np.sin(np.pi / 2 * now), np.cos(np.pi / 2 * now)  # 15 breaths a minute
    return np.asarray(ARM_FROM_BENCH @ se3.exp(np.array([0.03 * sine, 0.02 * cosine, 0, 0, 0, 5 * sine])))
