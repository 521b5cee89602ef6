"""The closed loop in virtual time: the wound moves, cameras expose, poses and commands travel, the arm executes.

No decision is made here. Tracking, motion, the motion's loop and the arm's link are those of a live run, with its
pacing, flow control, stops and recalls. The world is the clock on which that loop waits, and advances meanwhile: the
transport of a picture, the tracking, the bytes on the wire, the arm's interpolation and its servo. Virtual time does
not depend on how fast this runs, unless the scenario asks for measured tracking times.

A simulated operator arms the arm once the path is placed, and again after a stop; he refills and resets dispensers.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from functools import partial
from logging import INFO, WARNING

import numpy as np

from estimation import se3
from estimation.observations import Observations
from estimation.pose import SurfacePose, TrackState
from estimation.se3 import Array
from hardware.arm.device import ArmState
from hardware.arm.s6h4d import S6H4D
from hardware.motion.loop import CommandedPose, MaterialControl, Order, Tick
from hardware.motion.print_loop import LoopOrder, LoopSettings, PrintLoop
from hardware.motion.step import BeginPrint, PauseOrder, PoseHandover
from hardware.offline.looks import SurfaceLooks
from hardware.offline.track import FrameSetStep
from hardware.process.clock import Clock, SimClock
from hardware.process.faults import FaultKind, FaultPart, faults_striking
from hardware.process.progress import ProgressReport, no_progress
from hardware.recording.loop_record import LoopKeeper, RecordingSource, drop_record
from hardware.simulator.arm.controller import VirtualArm
from hardware.simulator.arm.ports import VirtualDevice
from hardware.simulator.camera_pipeline import (
    TICK_EVENT,
    CameraPipeline,
    EventQueue,
    Exposures,
    PictureRenderer,
    PictureStore,
    PipelineSink,
)
from hardware.simulator.cameras import Shot, TrueCameras
from hardware.simulator.deposit import NozzleLog
from hardware.simulator.material import BeadDrawing, SimulatedDispensers
from hardware.simulator.scenario import Scenario
from hardware.simulator.scene.scene import Scene, WorldState
from hardware.simulator.truth import Truth, TruthLog, row_instants, truth_from_estimate
from perception.frames import FrameSet
from planning.kinematics import nozzle_from_axes
from planning.laid_beads import Look
from planning.path import LOOK, Path, PrintPhase, PrintProgress

ROW_BLOCK = 0.2  # s of truth rows handed to the sink at once
FINISH_TAIL = 0.3  # s of the run after the end of the path
KILL_TAIL = 1.5  # s of the run after the motion was killed
ORDER_PERIOD = 0.3  # s between an operator's orders
SERVICE_DELAY = 0.3  # s from a dispenser's fault until the operator resets it, and until the next try
LOOK_DURATION = 2.5  # s for the evaluation of a look: 2 s on an idle core


class WorldSink(PipelineSink):
    """Receives everything that happens in a run."""

    def tick(self, tick: Tick, progress: PrintProgress | None) -> None:
        """A tick, and the progress of the print by it; None before the path was placed."""

    def wire(self, stamp: float, data: bytes, sent: bool) -> None:
        """Bytes at the arm's port: sent to the arm, or received."""

    def rows(self, log: NozzleLog) -> None:
        """The next rows of the truth at the nozzle."""

    def pose_delivery(self, pose: SurfacePose) -> None:
        """A pose has reached the motion."""

    def registration(self, truth_from_estimate: Array) -> None:
        """The path's registration: truth_surface_from_estimated_surface (4, 4)."""

    def look(self, look: Look) -> None:
        """The result of a look at what was printed."""


class _SimulatedOperator:
    """The orders of an operator."""

    def __init__(self, material: MaterialControl) -> None:
        self._material = material
        self._last_order, self._unready_since = -math.inf, -math.inf
        self._homed = False

    def __call__(self, progress: PrintProgress | None, state: ArmState, tracking: bool, now: float) -> list[LoopOrder]:
        """state: of the arm. tracking: whether the newest pose is TRACKING."""
        if not self._homed:
            self._homed = True
            return [Order.AT_HOME]
        if progress is None:
            return []
        orders: list[LoopOrder] = []
        unready = self._material.reason
        self._unready_since = self._unready_since if unready else now
        if progress.wanted and progress.wanted != LOOK:
            orders.append(PauseOrder.MATERIAL_IN)
        elif unready and now >= self._unready_since + SERVICE_DELAY:
            self._unready_since = now
            orders.append(PauseOrder.RESUME)
        if state not in (ArmState.STOPPED, ArmState.DISARMED) or not tracking or now < self._last_order + ORDER_PERIOD:
            return orders
        self._last_order = now
        return [*orders, Order.ARM]


class _MotionKilledError(Exception):
    """The motion process has ended."""


class SimulatedWorld:
    """One run of one scenario, by `run`. It is the clock of its MotionLoop.

    link: the motion's model of the arm. arm: the simulated arm itself.
    """

    def __init__(
        self,
        scenario: Scenario,
        scene: Scene | None,
        path: Path,
        truth: Truth,
        step: FrameSetStep,
        exposures: Exposures,
        sink: WorldSink,
        clock: Clock,
        threads: int = 2,
        store: PictureStore | None = None,
        keeper: LoopKeeper | None = None,
    ) -> None:
        """scene: the scenario's, None without pictures; beads are drawn into it. path: in the true surface frame.
        exposures: filled with each picture's shot. clock: of tracking. store: of pictures. keeper: of the loop.
        """
        self.scenario, self._scene, self._path, self._sink = scenario, scene, path, sink
        if scene is not None:
            scene.gel = scenario.gel
        self._step, self._truth, self._exposures, self._keeper, self._time = step, truth, exposures, keeper, SimClock()
        self._events = EventQueue(self._time)
        profile, faults, self._commanded_pose = scenario.profile, scenario.faults, CommandedPose(scenario.profile)
        self.arm = VirtualArm(scenario.arm, profile.dialect, profile.arm.home, faults, scenario.baud)
        self._device = VirtualDevice(self.arm, self._time, scenario.baud, self._put_bytes)
        self._truth_log = TruthLog(path, scenario.true_arm, truth, profile.tick, profile.lag)
        pictures: PictureRenderer | None = None
        if scenario.tracking.pictures:
            assert scene is not None
            cameras, sensor = TrueCameras(scenario.rig.cameras), scenario.sensor
            quality, seed = scenario.jpeg_quality, scenario.seed
            pictures = PictureRenderer(scene, cameras, sensor, quality, seed, threads, self._print_beads, store)
        self._last_state: WorldState | None = None
        head = self._commanded_pose.at if scenario.nozzle else lambda stamp: None
        self.pipeline = CameraPipeline(
            scenario, self._events, step, exposures, sink, clock, self._on_pose, pictures, self._state_at, head
        )
        self._motion_faults = faults_striking(faults, FaultPart.MOTION)
        self._outages = faults_striking(faults, FaultPart.DISPENSER, FaultKind.UNPLUG, FaultKind.BLOCK, FaultKind.DROP)
        self._handover: PoseHandover | None = None
        self._queued_orders: list[LoopOrder] = []  # since the loop's last call
        self.dispensers = SimulatedDispensers(path, scenario.dispenser, self._time, faults, scenario.path)
        (material := self.dispensers.control).begin(0.0, 0.0)
        self._operator = _SimulatedOperator(material)
        settings, put = LoopSettings(until=scenario.seconds), keeper.write if keeper else drop_record
        arm = S6H4D(self._device, profile)
        source = RecordingSource(self, arm, lambda: self._handover, self._orders, put, profile, material, settings)
        self._loop = PrintLoop(source, profile, settings, self._time, self._report)
        self.motion, self.link = self._loop.motion, self._loop.arm
        gel, width, log = scenario.gel is not None, scenario.bead, self._truth_log
        self._beads = BeadDrawing(gel, width, truth, log, self._nozzle_at, self.dispensers)
        self._looks: SurfaceLooks | None = None
        self._rows_end, self._end, self._reported_sets = 0.0, scenario.seconds, 0
        self._started = self._killed = self._failed = False
        self._progress: ProgressReport = no_progress

    def run(self, progress: ProgressReport = no_progress) -> None:
        """Simulate the whole scenario; `progress` is called for each frame set tracked."""
        self._progress = progress
        self.pipeline.begin()
        try:
            with suppress(_MotionKilledError):
                self._loop.run()
            self._advance(self._end)  # of a motion that was killed
            self.pipeline.finish()
        finally:
            self._emit_rows(self.elapsed)

    def order(self, order: LoopOrder) -> None:
        """Give the motion an order."""
        self._queued_orders.append(order)

    @property
    def open_outside(self) -> float:
        """How long, s, a dispenser was commanded open until now while no move that prints was sent."""
        return self.dispensers.open_outside(self.elapsed, self._unattended)

    @property
    def elapsed(self) -> float:
        """Duration of the run so far, s."""
        return min(self._time.now(), self._end)

    @property
    def _unattended(self) -> list[tuple[float, float]]:
        """From, until, s: when no command could reach a dispenser."""
        return [(f.start, min(f.end, self.scenario.seconds)) for f in (*self._outages, *self._motion_faults)]

    # -- the clock of the motion: while it waits, the rest of the world advances

    def now(self) -> float:
        """Instant, s."""
        return self._time.now()

    def wait_until(self, instant: float) -> None:
        """Advance the world until `instant`, s, or for as long as the motion hangs."""
        if self.link.state is not ArmState.ARMED:
            self.dispensers.forbid(self._time.now())
        self._advance(instant)
        for fault in () if self._killed else self._motion_faults:
            now = self._time.now()
            if not fault.covers(now):
                continue
            if fault.kind is FaultKind.KILL or fault.end >= self.scenario.seconds:
                self._killed = True
                self.dispensers.disconnect()
                self._device.away = [(now, math.inf)]
                self._end = min(self._end, now + KILL_TAIL)
                raise _MotionKilledError
            self._advance(fault.end)

    def _advance(self, instant: float) -> None:
        total, end = int(self.scenario.seconds / self.scenario.cameras.period), math.nextafter(instant, math.inf)

        def until() -> float:
            return -math.inf if self._failed else min(end, self._end)

        with self._end_on_error():
            for _ in self._events.run(until):
                if self.pipeline.tracked > self._reported_sets:
                    self._reported_sets = self.pipeline.tracked
                    self._progress(self._reported_sets, total)
        self._time.wait_until(instant)

    @contextmanager
    def _end_on_error(self) -> Iterator[None]:
        """An exception ends the run: nothing more is rendered while the loop stops its arm."""
        try:
            yield
        except BaseException:
            self._failed, self._end = True, self.elapsed
            raise

    # -- the cameras' view

    def _state_at(self, shot: Shot, now: float) -> WorldState:
        """The world at a shot's exposure; one object for cameras that expose together."""
        last = self._last_state
        if last is not None and (last.stamp, last.gain) == (shot.exposed, shot.gain):
            return last
        times, truth, nozzle = np.array([shot.exposed]), self._truth, None
        if self.scenario.nozzle:
            self._device.advance(now)
            nozzle = self._nozzle_at(times)[0]
        pose, twist, strain = truth.base_from_surface(times)[0], truth.twist(times)[0], float(truth.amount(times)[0])
        self._last_state = WorldState(shot.exposed, shot.exposure, pose, twist, strain, nozzle, shot.gain)
        return self._last_state

    def _nozzle_at(self, times: Array) -> Array:
        return nozzle_from_axes(self.scenario.true_arm, self.arm.axes_at(times))

    def _print_beads(self, until: float) -> None:
        if self._scene is not None and self.scenario.beads:
            self._device.advance(self._time.now())
            if self.scenario.gel is not None:
                self.dispensers.advance(self._time.now())
            self._beads.draw(self._scene, until)

    # -- inputs and outputs of the motion

    def _put_bytes(self, data: bytes, sent: bool) -> None:
        self._sink.wire(self._time.now(), data, sent)

    def _on_pose(self, pose: SurfacePose, frames: FrameSet, observations: Observations) -> None:
        """Begin the print with the path in the tracker's surface frame, as soon as that frame can be measured."""
        now, scenario = self._time.now(), self.scenario
        self._handover = PoseHandover(pose, now, now)
        self._sink.pose_delivery(pose)
        if self._started:
            self._look_at(pose, frames)
            return
        if pose.state is not TrackState.TRACKING:
            return
        change: Array | None = np.eye(4)
        if self._scene is not None and scenario.tracking.pictures and not scenario.tracking.scan:
            exposed = np.full(len(scenario.rig), pose.stamp)
            for frame in frames.frames:
                exposed[frame.camera] = self._exposures[frame.camera, frame.stamp].exposed
            rigs = scenario.rig, scenario.known_rig
            change = truth_from_estimate(pose, observations, rigs, self._truth, self._scene.shape, exposed)
        if change is None:
            return
        placed_path = replace(self._path, surface_from_nozzle=se3.inverse(change) @ self._path.surface_from_nozzle)
        order, self._started = BeginPrint(placed_path, scenario.profile, 0.0, self.dispensers.outlets, ""), True
        self.order(order if self._keeper is None else self._keeper.begun(order))
        self._sink.registration(change)
        if scenario.looks is not None:
            self._looks = SurfaceLooks(scenario.known_rig, placed_path, adapt=scenario.adapt)

    def _look_at(self, pose: SurfacePose, frames: FrameSet) -> None:
        looks, progress, last = self._looks, self.motion.progress, self.motion.last
        if looks is not None and progress is not None and looks.at(progress, last, frames, pose, self._step):
            self._events.at(self._time.now() + LOOK_DURATION, TICK_EVENT, partial(self._finish_look, looks))

    def _finish_look(self, looks: SurfaceLooks, now: float) -> None:
        if (shares := looks.adapted()) is not None:
            self.order(shares)
            self._truth_log.adapt(shares)
        if (look := looks.last) is not None:
            look = replace(look, stamp=now, seconds=look.seconds + now - look.stamp)
            self._sink.look(look)
            self._sink.event(now, f"look: {look.text}", WARNING if look.laid.clogs else INFO)
        self.order(PauseOrder.MATERIAL_IN)

    def _orders(self) -> list[LoopOrder]:
        if (now := self._time.now()) >= self._end:
            return [Order.QUIT]
        (orders, self._queued_orders), handover = (self._queued_orders, []), self._handover
        tracking = handover is not None and handover.pose.state is TrackState.TRACKING
        return [*orders, *self._operator(self.motion.progress, self.link.state, tracking, now)]

    def _report(self, tick: Tick) -> None:
        now, progress = self._time.now(), self.motion.progress
        self.dispensers.add_command(tick.command, self.scenario.profile.tick)
        if progress is not None:
            self._truth_log.write(tick.command, progress)
            self._commanded_pose.add(tick.command, now)
            if progress.phase is PrintPhase.FINISHED:
                self._end = min(self._end, now + FINISH_TAIL)
        with self._end_on_error():
            self._sink.tick(tick, progress)
            for event in self.link.events():
                level = INFO if event.state in (None, ArmState.ARMED, ArmState.DISARMED) else WARNING
                self._sink.event(event.stamp, f"arm: {event.text}", level)
            if now - self._rows_end >= ROW_BLOCK:
                self._emit_rows(now)

    def _emit_rows(self, now: float) -> None:
        self._device.advance(self._time.now())
        self.dispensers.advance(self._time.now())
        times = row_instants(self._rows_end, now)
        if len(times):
            self._rows_end = now
            self._sink.rows(self._truth_log.rows(times, self.arm.axes_at, self.dispensers.flow))
