"""`stillbed bench link`: jitter, stops, and what arrives of a live run's motion process, while others saturate cores.

The processes are a live run's: motion, recorder, and a virtual arm on a pty. In place of the tracking one that tells
where a breathing chest is; this one gives the orders; and some only use up processor time. The motion process is halted
now and then, as by a busy machine; the device goes and comes back; the controller stalls and the wire loses frames.
"""

from __future__ import annotations

import argparse
import math
import multiprocessing
import os
import signal
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, fields
from pathlib import Path

import numpy as np

from estimation import se3
from estimation.pose import SurfacePose, TrackState
from estimation.se3 import Array
from estimation.synthetic.world import arc_rig
from hardware.arm.device import ArmState, LinkCode
from hardware.arm.profile import ARM_FROM_BENCH, ArmProfile
from hardware.bench.figures import Figure, at_least, at_most, milliseconds
from hardware.live.checklist import PrintTask
from hardware.live.ipc import RunChannels, start_arm, start_processes
from hardware.live.prepared import Prepared, RunFiles
from hardware.live.records import LATE_TICK_STAGE, LiveMotionReport, StageTiming, TrackingChannels
from hardware.live.settings import VIRTUAL_ARM, LiveSettings
from hardware.motion.loop import Order
from hardware.motion.step import BeginPrint, PoseHandover
from hardware.process.clock import WallClock
from hardware.process.faults import Fault, FaultKind, FaultPart
from hardware.process.system import set_up_process
from hardware.simulator.arm.settings import ArmSettings, ReplyMode, write_virtual_arm
from planning.path import Path as Toolpath

DEVICE_SPAN = 40.0  # s with one device, where it goes and comes back
POSE_RATE, ORDER_RATE = 30.0, 30.0  # Hz, and in which the operator looks at the reports
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

    frames: float
    ignored: float
    refused: float
    garbage: float  # bytes
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
    report: LiveMotionReport | None = None
    rate: float = NOT_MEASURED  # ticks a second


def run_link(options: argparse.Namespace) -> list[Figure]:
    """Three parts of equal length: a calm one, whose jitter counts, one with halts and returns, one with a bad arm."""
    seconds, busy = 60 * options.minutes, options.busy
    parts = [run_part(seconds / 3, options.seed + k, busy, part) for k, part in enumerate(LIVE_PARTS)]
    calm, halted, rough = parts
    name = f"real time {seconds / 60:.3g} min"
    arms = [arm for part in parts for arm in part.arms]
    healthy_arms = calm.arms + halted.arms
    load, report = np.mean([*calm.load, *halted.load, *rough.load] or [NOT_MEASURED]), calm.report
    priority, lateness, skipped = "", NOT_LATE, 0
    if report is not None:
        priority, lateness, skipped = report.priority, _lateness(report), report.skipped
    machine = f"{priority}; load {load:.1f} on {os.cpu_count()} cores, {busy} processes burn"
    stops, orders = calm.stops + halted.stops + rough.stops, calm.orders + rough.orders
    note = f"{halted.halts} halts up to 600 ms, {len(halted.arms) - 1} returns of the device"
    stop_name = f"{name}: stop on the wire after its decision, 99 %"
    moving = sum(p.arms[-1].left > 0 for p in parts[:2])
    return [
        Figure(f"{name}: ticks a second", calm.rate, "Hz", at_least(49.5), "thesis 30", machine),
        Figure(f"{name}: tick late, median", 1000 * lateness.median, "ms"),
        Figure(f"{name}: tick late, 99 %", 1000 * lateness.p99, "ms", at_most(3), "8 in a process, 72 in a thread"),
        Figure(f"{name}: tick late, largest", 1000 * lateness.largest, "ms", note=f"{skipped} ticks were skipped"),
        Figure(stop_name, milliseconds(stops, 99), "ms", at_most(10), note=f"{len(stops)} stops"),
        Figure(f"{name}: stop on the wire after the order, 99 %", milliseconds(orders, 99), "ms",
               note="from another process"),
        Figure(f"{name}: most under way, by the model", 1000 * max(p.flight for p in parts), "ms", at_most(50)),
        Figure(f"{name}: most queued in the arm", _queued(healthy_arms), "ms", at_most(50), "", note),
        Figure(f"{name}: most queued, the arm stalls and loses frames", _queued(rough.arms), "ms"),
        Figure(f"{name}: commands that found the queue full", sum(a.ignored for a in arms), "", at_most(0)),
        Figure(f"{name}: bytes in no frame", sum(a.garbage for a in calm.arms), "", at_most(0), "", "calm part"),
        Figure(f"{name}: frames that the arm refused", sum(a.refused for a in healthy_arms), "", at_most(0)),
        Figure(f"{name}: arms not at rest once the motion has ended", moving, "", at_most(0), "", "of 2"),
        Figure(f"{name}: frames taken", sum(a.frames for a in arms)),
    ]  # fmt: skip


def _queued(arms: list[ArmReport]) -> float:
    return 1000 * max((arm.deepest for arm in arms), default=NOT_MEASURED)


def run_part(seconds: float, seed: int, busy: int, part: str) -> LivePart:
    """Print on a breathing surface for so long."""
    clock = WallClock()
    with tempfile.TemporaryDirectory() as name, burning(busy):
        folder = Path(name)
        prepared = _prepared(folder, seed, part)
        run = start_processes(prepared, folder, tell_poses)
        operator = _Operator(run, np.random.default_rng(seed), part == HALTED_PART)
        try:
            run.sender.put(prepared.rig)
            run.order(BeginPrint(prepared.task.path, prepared.task.profile, 0.0, {}, ""))
            _wait(lambda: run.shared.motion.get() is not None)
            start = device = clock.now()
            while (now := clock.now()) < start + seconds:
                operator.act(run.shared.motion.get(), now)
                if part == HALTED_PART and now > device + DEVICE_SPAN:
                    run.processes.end("arm", 0.0)
                    operator.measured.arms.append(_arm_report(prepared))
                    run.arm_lifeline = start_arm(run.processes, prepared, Path(run.url))
                    device = clock.now()
                clock.wait_until(now + 1 / ORDER_RATE)
            operator.end(run.shared.motion.get())
            operator.measured.arms.append(_arm_report(prepared))
        finally:
            run.processes.kill_all()
    return operator.measured


def _prepared(folder: Path, seed: int, part: str) -> Prepared:
    """A live run with a virtual arm and no pictures."""
    virtual, faults = folder / "virtual.toml", _faults(seed) if part == ROUGH_PART else []
    write_virtual_arm(virtual, ArmSettings(replies=ReplyMode.STREAM, seed=seed), tuple(faults))
    record, rig, task = folder / "run.mcap", arc_rig(size=(64, 48), focal=60.0), PrintTask(_toolpath(), ArmProfile())
    settings = LiveSettings(arm=VIRTUAL_ARM, record=record)
    return Prepared(settings, folder / "rig.toml", rig, False, virtual, task, None, None, RunFiles(record), ())


def tell_poses(prepared: Prepared, channels: TrackingChannels) -> None:
    """In place of a tracking process: where a breathing chest is, until the run is gone."""
    set_up_process("tracking")
    clock = WallClock()
    while not channels.lifeline.poll():
        now = clock.now()
        channels.shared.poses.put(PoseHandover(_pose(now), now, now))
        channels.shared.bell.ring()
        clock.wait_until(now + 1 / POSE_RATE)


def _arm_report(prepared: Prepared) -> ArmReport:
    with np.load(prepared.files.executed) as executed:
        return ArmReport(*(float(executed[each.name]) for each in fields(ArmReport)))


def _lateness(report: LiveMotionReport) -> StageTiming:
    return next((timing for timing in report.timings if timing.name == LATE_TICK_STAGE), NOT_LATE)


NOT_LATE = StageTiming(LATE_TICK_STAGE, 0, math.nan, math.nan, math.nan)


def _faults(seed: int) -> list[Fault]:
    """Stalls, losses and cuts of the wire, each some seconds after the last, for an hour."""
    rng, now, faults = np.random.default_rng(seed), 5.0, list[Fault]()
    while now < 3600:
        kind = WIRE_FAULTS[rng.integers(len(WIRE_FAULTS))]
        length = 0.0 if kind is FaultKind.DROP else round(float(rng.uniform(0.05, MAX_HALT)), 3)
        faults.append(Fault(FaultPart.ARM, kind, round(now, 3), length))
        now += float(rng.uniform(4, 10))
    return faults


WIRE_FAULTS = (FaultKind.STALL, FaultKind.STALL, FaultKind.DROP, FaultKind.UNPLUG)


class _Operator:
    """Arms, stops and arms again, halts the motion process, and collects what it reports."""

    def __init__(self, run: RunChannels, rng: np.random.Generator, halts: bool) -> None:
        self.measured = LivePart()
        self._run, self._rng, self._halts = run, rng, halts
        self._stop = self._halt = self._arm = 0.0  # s, when each is due
        self._stop_sent: float | None = None
        self._first: LiveMotionReport | None = None
        self._clock = WallClock()

    def act(self, report: LiveMotionReport | None, now: float) -> None:
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
            self._run.order(Order.HOME if report.tick.answer.code is LinkCode.FAR_FROM_PATH else Order.ARM)
            self._arm = now + 0.5
            self._stop = max(self._stop, now + 1.0)

    def _disturb(self, now: float) -> None:
        if now > self._stop and self._stop_sent is None:
            self.measured.load.append(os.getloadavg()[0])
            self._stop_sent = self._clock.now()
            self._run.order(Order.STOP)
            self._stop = now + STOP_PERIOD * self._rng.uniform(0.8, 1.2)
        elif self._halts and now > self._halt and (pid := self._run.processes.members["motion"].pid) is not None:
            self._halt = now + HALT_PERIOD * self._rng.uniform(0.5, 1.5)
            os.kill(pid, signal.SIGSTOP)
            self._clock.wait_until(now + self._rng.uniform(0.02, MAX_HALT))
            os.kill(pid, signal.SIGCONT)
            self.measured.halts += 1

    def end(self, report: LiveMotionReport | None) -> None:
        """Have the run end, after the motion's last report."""
        self._run.order(Order.QUIT)
        self._run.processes.end("motion")
        self._run.processes.end("arm", 0.0)  # at once: what it still had queued counts
        self._run.end()
        self.measured.report = report
        if report is not None and self._first is not None:
            seconds = report.tick.stamp - self._first.tick.stamp
            self.measured.rate = (_lateness(report).count - _lateness(self._first).count) / seconds


@contextmanager
def burning(count: int) -> Iterator[None]:
    """So many processes that want a core each, of ordinary priority, as another user's."""
    context = multiprocessing.get_context("spawn")
    processes = [context.Process(target=_burn, daemon=True) for _ in range(count)]
    for process in processes:
        process.start()
    try:
        yield
    finally:
        for process in processes:
            process.kill()
            process.join()


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
