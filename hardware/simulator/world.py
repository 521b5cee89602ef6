"""The closed loop in virtual time: the wound moves, cameras expose, poses and commands travel, the arm executes.

Nothing here decides anything. Tracking, motion, the motion's loop and the arm's link are those of a live run: what
pacing, flow control, a stop or a call back do there, they do here. The world is the clock on which that loop waits, and
goes on meanwhile: the transport of a picture, the tracking, the bytes on the wire, the arm's interpolation and its
servo. Virtual time does not depend on how fast this runs, unless the scenario asks for measured tracking times.

A live run has an operator, and so has this one: he arms the arm once the path is placed, and again where it was
stopped; he puts material in and makes a dispenser ready that is not.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from functools import partial
from logging import INFO, WARNING
from typing import Protocol

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
from hardware.simulator.arm.ports import PortFaults, VirtualDevice
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
RUN_OUT = 0.3  # s that the run goes on after the path is finished
AFTER_KILL = 1.5  # s that the rest of the world goes on without the motion
ORDER_PERIOD = 0.3  # s between an operator's orders
SEEN_TO_AFTER = 0.3  # s until he makes a dispenser ready that is not, and tries again
LOOK_SECONDS = 2.5  # s that judging takes: two on a core without load


class WorldSink(PipelineSink, Protocol):
    """Receives everything that happens in a run."""

    def tick(self, tick: Tick, progress: PrintProgress | None) -> None:
        """A tick was made, and how far the print is by it; None before the path was placed."""

    def wire(self, stamp: float, data: bytes, sent: bool) -> None:
        """Bytes passed the arm's port, to the arm or from it."""

    def rows(self, log: NozzleLog) -> None:
        """The next rows of the truth at the nozzle."""

    def given(self, pose: SurfacePose) -> None:
        """A pose has reached the motion."""

    def registered(self, truth_from_estimate: Array) -> None:
        """The path was registered: truth_surface_from_estimated_surface (4, 4)."""

    def look(self, look: Look) -> None:
        """What was laid was looked at."""


class _Wire:
    """Tells the sink what passes the arm's port."""

    def __init__(self, sink: WorldSink, clock: Clock) -> None:
        self._sink, self._clock = sink, clock

    def from_host(self, data: bytes) -> None:
        self._sink.wire(self._clock.now(), data, True)

    def to_host(self, sent: bytes, read: bytes) -> None:
        self._sink.wire(self._clock.now(), read, False)

    def opened(self) -> None:
        pass

    def to_arm(self, data: bytes) -> None:
        pass


class _SimulatedOperator:
    """Gives the orders that an operator gives. seen_to: s, at which he made a dispenser ready or put material in."""

    def __init__(self, material: MaterialControl) -> None:
        self._material = material
        self._ordered, self._dry_since = -math.inf, -math.inf
        self._stands = False
        self.seen_to: list[float] = []

    def __call__(self, progress: PrintProgress | None, state: ArmState, tracking: bool, now: float) -> list[LoopOrder]:
        """state: of the arm. tracking: whether the newest pose is sure of itself."""
        if not self._stands:
            self._stands = True
            return [Order.AT_HOME]
        if progress is None:
            return []
        orders: list[LoopOrder] = []
        dry = self._material.reason
        self._dry_since = self._dry_since if dry else now
        if progress.wanted and progress.wanted != LOOK:
            self.seen_to.append(now)
            orders.append(PauseOrder.MATERIAL_IN)
        elif dry and now >= self._dry_since + SEEN_TO_AFTER:
            self._dry_since = now
            self.seen_to.append(now)
            orders.append(PauseOrder.RESUME)
        if state not in (ArmState.STOPPED, ArmState.DISARMED) or not tracking or now < self._ordered + ORDER_PERIOD:
            return orders
        self._ordered = now
        return [*orders, Order.ARM]


class _MotionKilledError(Exception):
    """The motion process has ended."""


class SimulatedWorld:
    """One run of one scenario; `run` lets its time pass. For its MotionLoop it is the clock.

    link: the arm, as the motion sees it. arm: as it is.
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
        exposures: filled with each picture's shot, for a step that may know. clock: of tracking. keeper: of the loop.
        store: pictures of earlier runs.
        """
        self.scenario, self._scene, self._path, self._sink = scenario, scene, path, sink
        if scene is not None:
            scene.gel = scenario.gel
        self._step, self._truth, self._exposures, self._keeper, self._time = step, truth, exposures, keeper, SimClock()
        self._events = EventQueue(self._time)
        profile, faults, self._commanded = scenario.profile, scenario.faults, CommandedPose(scenario.profile)
        self.arm = VirtualArm(scenario.arm, profile.dialect, profile.arm.home, faults, scenario.baud)
        self._device = VirtualDevice(self.arm, self._time, scenario.baud, listener=_Wire(sink, self._time))
        self._truth_log = TruthLog(path, scenario.true_arm, truth, profile.tick, profile.lag)
        pictures: PictureRenderer | None = None
        if scenario.tracking.pictures:
            assert scene is not None
            how = scenario.sensor, scenario.jpeg_quality, scenario.seed, threads, self._print_beads, store
            pictures = PictureRenderer(scene, TrueCameras(scenario.rig.cameras), *how)
        self._last_state: WorldState | None = None
        head = self._commanded.at if scenario.nozzle else lambda stamp: None
        told = sink, clock, self._on_pose, pictures, self._state_at, head
        self.pipeline = CameraPipeline(scenario, self._events, step, exposures, *told)
        self._hangs = faults_striking(faults, FaultPart.MOTION)
        self._lines = faults_striking(faults, FaultPart.DISPENSER, FaultKind.UNPLUG, FaultKind.BLOCK, FaultKind.DROP)
        self._handover: PoseHandover | None = None
        self._given: list[LoopOrder] = []  # since the loop last asked
        self.dispensers = SimulatedDispensers(path, scenario.dispenser, self._time, faults, scenario.path)
        (material := self.dispensers.control).begin(0.0, 0.0)
        self._operator = _SimulatedOperator(material)
        settings, put = LoopSettings(until=scenario.seconds), keeper.write if keeper else drop_record
        given = self, S6H4D(self._device, profile), lambda: self._handover, self._orders
        source = RecordingSource(*given, put, profile, material, settings)
        self._loop = PrintLoop(source, profile, settings, self._time, self._report)
        self.motion, self.link = self._loop.motion, self._loop.arm
        beads = scenario.gel is not None, scenario.bead, truth, self._truth_log
        self._beads = BeadDrawing(*beads, self._nozzle_at, self.dispensers)
        self._looks: SurfaceLooks | None = None
        self._rows_until, self._end, self._reported = 0.0, scenario.seconds, 0
        self._begun = self._killed = self._broken = False
        self._progress: ProgressReport = no_progress

    def run(self, progress: ProgressReport = no_progress) -> None:
        """Let the scenario's time pass; `progress` is called for each frame set tracked."""
        self._progress = progress
        self.pipeline.begin()
        try:
            with suppress(_MotionKilledError):
                self._loop.run()
            self._advance(self._end)  # of a motion that was killed
            self.pipeline.finish()
        finally:
            self._emit_rows(self.ended)

    def order(self, order: LoopOrder) -> None:
        """Give the motion an order."""
        self._given.append(order)

    def every(self, period: float, action: Callable[[float], None]) -> None:
        """Do `action` every `period` s from the beginning on; it is given the instant, s."""

        def act(now: float) -> None:
            self._events.at(now + period, TICK_EVENT, act)
            action(now)

        self._events.at(0.0, TICK_EVENT, act)

    @property
    def seen_to(self) -> list[float]:
        """Instants, s, at which the operator made a dispenser ready again or put material in."""
        return self._operator.seen_to

    @property
    def told_outside(self) -> float:
        """How long, s, a dispenser was told to be open until now while no move that prints was sent."""
        return self.dispensers.told_outside(self.ended, self._left_alone)

    @property
    def left_open(self) -> float:
        """How long, s, a dispenser stayed open at most after its line or the motion had ended."""
        return self.dispensers.open_after(self._left_alone, self.ended)

    @property
    def ended(self) -> float:
        """How far the run has come, s."""
        return min(self._time.now(), self._end)

    @property
    def _left_alone(self) -> list[tuple[float, float]]:
        """From, until, s: when nobody could tell a dispenser anything."""
        return [(fault.start, min(fault.end, self.scenario.seconds)) for fault in (*self._lines, *self._hangs)]

    # -- the clock of the motion: while it waits, the rest of the world goes on

    def now(self) -> float:
        """Instant, s."""
        return self._time.now()

    def wait_until(self, instant: float) -> None:
        """Let the world go on until `instant`, s, or for as long as the motion hangs."""
        if self.link.state is not ArmState.ARMED:
            self.dispensers.forbid(self._time.now())
        self._advance(instant)
        for fault in () if self._killed else self._hangs:
            now = self._time.now()
            if not fault.covers(now):
                continue
            if fault.kind is FaultKind.KILL or fault.end >= self.scenario.seconds:
                self._killed = True
                self.dispensers.cut()
                self._device.faults = PortFaults(away=[(now, math.inf)])
                self._end = min(self._end, now + AFTER_KILL)
                raise _MotionKilledError
            self._advance(fault.end)

    def _advance(self, instant: float) -> None:
        total, past = int(self.scenario.seconds / self.scenario.cameras.period), math.nextafter(instant, math.inf)

        def until() -> float:
            return -math.inf if self._broken else min(past, self._end)

        with self._ending():
            for _ in self._events.run(until):
                if self.pipeline.tracked > self._reported:
                    self._reported = self.pipeline.tracked
                    self._progress(self._reported, total)
        self._time.wait_until(instant)

    @contextmanager
    def _ending(self) -> Iterator[None]:
        """What is raised meanwhile ends the run: nothing more is rendered while the loop stops its arm."""
        try:
            yield
        except BaseException:
            self._broken, self._end = True, self.ended
            raise

    # -- what cameras see

    def _state_at(self, shot: Shot, now: float) -> WorldState:
        """The world as a shot meets it; the very same object for cameras that expose together."""
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

    # -- what the motion is given, and what it does

    def _on_pose(self, pose: SurfacePose, frames: FrameSet, observations: Observations) -> None:
        """Begin the print with the path in the tracker's surface frame, as soon as that frame can be measured."""
        now, scenario = self._time.now(), self.scenario
        self._handover = PoseHandover(pose, now, now)
        self._sink.given(pose)
        if self._begun:
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
        order, self._begun = BeginPrint(placed_path, scenario.profile, 0.0, self.dispensers.outlets, ""), True
        self.order(order if self._keeper is None else self._keeper.begun(order))
        self._sink.registered(change)
        if scenario.looks is not None:
            self._looks = SurfaceLooks(scenario.known_rig, placed_path, adapt=scenario.adapt)

    def _look_at(self, pose: SurfacePose, frames: FrameSet) -> None:
        looks, progress, last = self._looks, self.motion.progress, self.motion.last
        if looks is not None and progress is not None and looks.at(progress, last, frames, pose, self._step):
            self._events.at(self._time.now() + LOOK_SECONDS, TICK_EVENT, partial(self._looked, looks))

    def _looked(self, looks: SurfaceLooks, now: float) -> None:
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
        (given, self._given), last = (self._given, []), self._handover
        tracking = last is not None and last.pose.state is TrackState.TRACKING
        return [*given, *self._operator(self.motion.progress, self.link.state, tracking, now)]

    def _report(self, tick: Tick) -> None:
        now, progress = self._time.now(), self.motion.progress
        self.dispensers.note(tick.command, self.scenario.profile.tick)
        if progress is not None:
            self._truth_log.write(tick.command, progress)
            self._commanded.add(tick.command, now)
            if progress.phase is PrintPhase.FINISHED:
                self._end = min(self._end, now + RUN_OUT)
        with self._ending():
            self._sink.tick(tick, progress)
            for event in self.link.events():
                level = INFO if event.state in (None, ArmState.ARMED, ArmState.DISARMED) else WARNING
                self._sink.event(event.stamp, f"arm: {event.text}", level)
            if now - self._rows_until >= ROW_BLOCK:
                self._emit_rows(now)

    def _emit_rows(self, now: float) -> None:
        self._device.advance(self._time.now())
        self.dispensers.advance(self._time.now())
        times = row_instants(self._rows_until, now)
        if len(times):
            self._rows_until = now
            self._sink.rows(self._truth_log.rows(times, self.arm.axes_at, self.dispensers.flow))
