"""The motion process of a live run: arm, MotionLoop, reports, and what is recorded of them.

Loads nothing that holds Python's lock for long: no gtsam, cv2 or onnxruntime.
"""

from __future__ import annotations

import importlib
import math
import signal
from collections import deque
from dataclasses import replace
from logging import WARNING
from types import FrameType

from estimation.errors import StillbedError
from estimation.pose import SurfacePose
from hardware.arm.device import ArmEvent
from hardware.arm.profile import LinkSettings, open_arm
from hardware.files.dispenser_file import dispensers_from_text, drivers_of
from hardware.files.path_file import write_progress_durably
from hardware.live.prepared import Prepared
from hardware.live.recorder_process import RecorderSender
from hardware.live.records import (
    EXPOSURE_TO_WIRE_STAGE,
    FRAMES_TO_WIRE_STAGE,
    LATE_TICK_STAGE,
    EventEntry,
    LiveMotionReport,
    MotionChannels,
    StageHistograms,
    StageTiming,
    UsedPoses,
    WireEntry,
)
from hardware.live.trace import MOTION_LANE, ON_WIRE, TraceLane
from hardware.motion.loop import MaterialControl, MotionLoop, Order, RecordedTick, Tick
from hardware.motion.print_loop import LoopOrder, LoopSettings, PrintLoop
from hardware.motion.step import BeginPrint, PauseOrder, PoseHandover, PrintMotion
from hardware.process.clock import WallClock
from hardware.process.system import Bell, ask_for_real_time, set_up_process, take_messages
from hardware.recording.loop_record import RecordingSource
from planning.material import FlowShares
from planning.path import Path

MAX_REPORTED_EVENTS = 50  # the last ones
LAST_POSES = 8  # kept for the recording: more do not wait in the tracking process when it is killed
importlib.import_module("planning.motion.planner")  # now, and not when a path begins
INSTRUCTION_BYTE, MOVE_INSTRUCTION = 1, ord("1")  # place in a frame, and what stands there in a move


class _WakingClock(WallClock):
    """A clock whose waits also end once a pose or an order is there."""

    def __init__(self, bell: Bell) -> None:
        self._bell = bell

    def wait_until(self, instant: float) -> None:
        """Wait until `instant`, s, or for the bell."""
        self._bell.wait(instant - self.now())


class _OrderReceiver:
    """Takes the orders.

    orphaned: whether the process that gives the orders is gone. fingerprint: of the path that was begun, "" before.
    """

    def __init__(self, channels: MotionChannels) -> None:
        shared = channels.shared
        self._connection, self._requests, self._shares = channels.orders, shared.link.requests, shared.shares
        self._followed: FlowShares | None = None
        self._last_stop = self._requests.last_stop
        self.orphaned, self.fingerprint = False, ""
        self._terminated = False
        signal.signal(signal.SIGTERM, self._end)

    def __call__(self) -> list[LoopOrder]:
        orders: list[LoopOrder] = []
        if (stop := self._requests.last_stop) != self._last_stop:  # a stop of the page does not wait for the run's loop
            self._last_stop = stop
            orders.append(Order.STOP)
        messages, closed = take_messages(self._connection)
        for message in messages:
            shares = self._shares.get() if message is PauseOrder.MATERIAL_IN else None
            if shares is not None and shares is not self._followed:
                self._followed = shares
                orders.append(shares)
            orders.append(message)
        self.fingerprint = next((o.fingerprint for o in orders if isinstance(o, BeginPrint)), self.fingerprint)
        self.orphaned |= closed
        return [*orders, Order.QUIT] if self.orphaned or self._terminated else orders

    def _end(self, number: int, frame: FrameType | None) -> None:
        self._terminated = True


class _TickReporter:
    """Measures the latency from frames to the wire, records the bytes on the port, and reports each tick."""

    def __init__(self, channels: MotionChannels, sender: RecorderSender, priority: str, trace: bool) -> None:
        self._poses, self._reports, self._sender = channels.shared.poses, channels.shared.motion, sender
        self._clock, self._priority = WallClock(), priority
        self.times = StageHistograms()
        self._events: deque[ArmEvent] = deque(maxlen=MAX_REPORTED_EVENTS)
        self._handover: PoseHandover | None = None  # the newest
        self._used_poses = deque[SurfacePose](maxlen=LAST_POSES)
        self._pose_unsent = False  # whether no move computed from that pose was sent yet
        self._lane = TraceLane(MOTION_LANE, self._clock, sender.put) if trace else None
        self._receipt_time = math.nan  # s, when the handover was taken here
        self.loop: MotionLoop | None = None
        self.motion: PrintMotion | None = None

    def newest_pose(self) -> PoseHandover | None:
        """The newest pose."""
        handover = self._poses.get()
        if handover is not self._handover:
            self._handover, self._pose_unsent, self._receipt_time = handover, True, self._clock.now()
            if handover is not None:
                self._used_poses.append(handover.pose)
        return handover

    def record_bytes(self, data: bytes, sent: bool) -> None:
        """Record bytes of the port, and the latency of the first move computed from a pose."""
        now, frame = self._clock.now(), b"" if self.loop is None else self.loop.arm.command_frame
        from_pose = sent and data == frame and frame[INSTRUCTION_BYTE] == MOVE_INSTRUCTION  # the way home has no pose
        if from_pose and self._pose_unsent and self._handover is not None:
            self._pose_unsent = False
            self.times.add(FRAMES_TO_WIRE_STAGE, now - self._handover.handed)
            self.times.add(EXPOSURE_TO_WIRE_STAGE, now - self._handover.pose.stamp)
            if self._lane is not None and self.loop is not None:
                tick_start, handover = max(self.loop.tick_start, self._receipt_time), self._handover
                waited = "waits for its tick", self._receipt_time, tick_start
                spans = ("handed over", handover.sent, self._receipt_time), waited, (ON_WIRE, tick_start, now)
                self._lane.add(handover.pose.stamp, spans)
        self._sender.put(WireEntry(now, data, sent))

    def close(self) -> None:
        """Send the last used poses and the rest of the trace to the recorder."""
        self._sender.put(UsedPoses(tuple(self._used_poses)))
        if self._lane is not None:
            self._lane.close()

    def report(self, tick: Tick) -> None:
        """Record and report a tick that is done; StillbedError, which ends the loop, where recording has failed."""
        self._sender.check()
        loop, motion = self.loop, self.motion
        assert loop is not None and motion is not None
        self._events.extend(loop.arm.events())
        progress, ticks = motion.progress, loop.lateness
        pose_stamp = math.nan if self._handover is None else self._handover.pose.stamp
        if progress is not None:
            planned = motion.planned and motion.last.stamp == tick.stamp
            frame, place = loop.arm.command_frame if planned else b"", (progress.fraction, progress.phase)
            rows = None if tick.recalled is None else tick.recalled.rows
            self._sender.put(RecordedTick(tick.stamp, pose_stamp, planned, tick.command, frame, *place, rows))
        for record in () if loop.material is None else loop.material.records():
            self._sender.put(record)
        lateness = StageTiming(LATE_TICK_STAGE, ticks.count, ticks.percentile(50), ticks.percentile(99), ticks.most)
        events, timings, stops = tuple(self._events), (*self.times.timings(), lateness), loop.arm.stops
        counts = loop.skipped, len(stops), stops[-1] if stops else None, self._sender.dropped
        material = None if loop.material is None else loop.material.status
        link = self._priority, pose_stamp, motion.arm_lag
        self._reports.put(LiveMotionReport(tick, progress, material, events, timings, *counts, *link))


def material_control(path: Path, dispensers: str, start: float, now: float) -> MaterialControl | None:
    """The dispensers of a path, from the text of their file, prepared for `start`, in checkpoints; None without one."""
    if not dispensers:
        return None
    control = MaterialControl(drivers_of(dispensers_from_text(dispensers, "dispenser.toml")), path)
    control.begin(start, now)
    return control


def move(prepared: Prepared, channels: MotionChannels) -> None:
    """The body of the process: follow orders until QUIT, or until the process that gives them is gone.

    Then the arm is stopped; in the second case the place on the path is written here.
    """
    settings, profile = prepared.settings, prepared.task.profile
    set_up_process("motion", settings.cores_motion, outlives=True)
    priority = ask_for_real_time() if settings.real_time else "nothing asked for"
    clock, sender = WallClock(), RecorderSender(channels.recorder)  # its thread shares the interpreter: as urgent
    loop_settings = LoopSettings(LinkSettings(pause_frame=settings.pause_frame))
    material = material_control(prepared.task.path, prepared.task.dispensers, prepared.task.start, clock.now())
    reporter, orders = _TickReporter(channels, sender, priority, settings.trace), _OrderReceiver(channels)
    driver = open_arm(channels.url, profile, reporter.record_bytes)
    waking, pose = _WakingClock(channels.shared.bell), reporter.newest_pose
    source = RecordingSource(waking, driver, pose, orders, sender.put, profile, material, loop_settings)
    try:
        printing = PrintLoop(source, profile, loop_settings, clock, reporter.report, channels.shared.place)
        reporter.motion, reporter.loop = printing.motion, printing.loop
        try:
            printing.run()
        finally:
            reporter.loop = None
            printing.arm.close()
            for failure in [] if material is None else material.close(clock):
                sender.put(EventEntry(clock.now(), f"could not be switched off: {failure}", WARNING, "dispenser"))
    except StillbedError as error:  # the arm cannot be used, or nothing is recorded any more
        channels.shared.trouble.put(str(error))
    finally:
        driver.release()
        if orders.orphaned and orders.fingerprint:
            write_progress_durably(prepared.files.progress, orders.fingerprint, channels.shared.place.value)
        reporter.close()
        for entry in reporter.times.entries(clock.now()):
            sender.put(entry)
        sender.close()
        if (last := channels.shared.motion.get()) is not None:
            channels.shared.motion.put(replace(last, unrecorded=sender.dropped))
