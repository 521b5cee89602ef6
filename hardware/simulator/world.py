"""The closed loop in virtual time: the wound moves, cameras expose, poses and commands travel, the arm executes.

Nothing here decides anything: the tracking step and the motion step are those of the live run, and the loop only lets
time pass between them. Whatever takes time in a real run takes it here: the transport of a picture, the tracking, the
48 bytes on the wire, the arm's interpolation and its servo. Virtual time does not depend on how fast this runs, unless
the scenario asks for measured tracking times.

Without a scan the tracker chooses its own surface frame, and the path must be registered to it. Live, an operator does
that. Here every track of one frame set is cast along its true ray onto the true surface, and the pose of these points
is solved with the cameras and pixels that the tracker has. Calibration errors are in both poses and stay in the error.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from estimation import se3
from estimation.observations import Observations
from estimation.pose import SurfacePose, TrackState
from estimation.pose_solver import PointTracks, solve_pose
from estimation.rig import Rig
from estimation.se3 import Array
from hardware.arm.protocol import frame_from_command
from hardware.motion.loop import CommandedPose
from hardware.motion.step import MotionStep
from hardware.offline.track import FrameSetStep
from hardware.process.clock import Clock, SimClock
from hardware.process.faults import FaultPart, faults_striking
from hardware.process.progress import ProgressReport, no_progress
from hardware.simulator.arm.controller import VirtualArm
from hardware.simulator.arm.settings import SerialWire
from hardware.simulator.camera_pipeline import (
    ARRIVAL_EVENT,
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
from hardware.simulator.material import DispensedMotion, SimulatedDispensers
from hardware.simulator.scenario import Scenario
from hardware.simulator.scene.scene import Scene, WorldState
from hardware.simulator.scene.shape import Shape
from hardware.simulator.truth import Truth, TruthLog, row_instants
from perception.frames import FrameSet
from planning.command import Command, Move
from planning.kinematics import nozzle_from_axes
from planning.path import Path, PrintPhase, PrintProgress

ROW_BLOCK = 0.2  # s of truth rows handed to the sink at once
RUN_OUT = 0.3  # s that the run goes on after the path is finished
MATERIAL_POLL = 0.005  # s between looks at the dispensers' lines, as in a live run
BEAD_STEP = 0.01  # s between the ends of the pieces in which a bead is drawn
NEWTON_STEPS = 12  # from the mean plane onto the surface; a wound takes four
SLOPE_STEP = 1e-3  # mm, for the slope along the surface
MAX_RAY_MISS = 1e-3  # mm between ray and surface: such a track does not lie on it
MIN_REGISTRATION_TRACKS = 12


def truth_from_estimate(
    pose: SurfacePose, observations: Observations, rigs: tuple[Rig, Rig], truth: Truth, shape: Shape, exposed: Array
) -> Array | None:
    """truth_surface_from_estimated_surface (4, 4) from one frame set; None where too few tracks lie on the surface.

    rigs: the true one and the one that the tracker has. exposed: (C,) s, when each camera truly took its picture.
    """
    true_rig, known_rig = rigs
    points, hit = surface_points(observations, true_rig, truth, shape, exposed)
    if hit.sum() < MIN_REGISTRATION_TRACKS:
        return None
    start = truth.base_from_surface(np.array([pose.stamp]))[0]
    tracks = PointTracks.of(observations.only(hit), points[hit])
    solved = solve_pose(known_rig, tracks, start, tolerance=1e-9, iterations=20)
    return np.asarray(se3.inverse(solved.base_from_surface) @ pose.base_from_surface)


def surface_points(
    observations: Observations, rig: Rig, truth: Truth, shape: Shape, exposed: Array
) -> tuple[Array, NDArray[np.bool_]]:
    """Points (N, 3) mm of the undeformed surface under each track's pixel, and whether (N,) the ray truly meets one."""
    camera, amount = observations.camera, truth.amount(exposed)[observations.camera]
    base_from_camera = np.stack([c.base_from_camera for c in rig.cameras])[camera]
    surface_from_camera = se3.inverse(truth.base_from_surface(exposed)[camera]) @ base_from_camera
    matrices = rig.matrices[camera]
    focal, centre = matrices[:, [0, 1], [0, 1]], matrices[:, :2, 2]
    rays = np.column_stack([(observations.pixels - centre) / focal, np.ones(len(observations))])
    rays = (surface_from_camera[:, :3, :3] @ rays[..., None])[..., 0]
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    origin = surface_from_camera[:, :3, 3]

    def off(xy: Array) -> Array:  # (N, 3) mm, from the ray to the surface point
        points = shape.points(xy)
        from_origin = points + truth.displacement(points, amount) - origin
        return np.asarray(from_origin - np.sum(from_origin * rays, 1, keepdims=True) * rays)

    up, middle = shape.surface_from_grid[:3, 2], shape.surface_from_grid[:3, 3]
    reach = ((middle - origin) @ up) / (rays @ up)
    xy = shape.material(origin + reach[:, None] * rays)
    for _ in range(NEWTON_STEPS):
        now = off(xy)
        slope = np.stack([(off(xy + SLOPE_STEP * axis) - now) / SLOPE_STEP for axis in np.eye(2)], -1)  # (N, 3, 2)
        xy = xy - (np.linalg.pinv(slope) @ now[..., None])[..., 0]
    return shape.points(xy), shape.covers(xy) & (np.linalg.norm(off(xy), axis=1) < MAX_RAY_MISS)


class WorldSink(PipelineSink, Protocol):
    """Receives everything that happens in a run."""

    def command(self, command: Command, progress: PrintProgress, frame: bytes, received: bytes) -> None:
        """A command was sent, how far the print is by it, and what came from the arm since the last."""

    def rows(self, log: NozzleLog) -> None:
        """The next rows of the truth at the nozzle."""

    def registered(self, truth_from_estimate: Array) -> None:
        """The path was registered: truth_surface_from_estimated_surface (4, 4)."""


class SimulatedWorld:
    """One run of one scenario; `run` lets its time pass."""

    def __init__(
        self,
        scenario: Scenario,
        scene: Scene,
        path: Path,
        truth: Truth,
        step: FrameSetStep,
        exposures: Exposures,
        sink: WorldSink,
        clock: Clock,
        threads: int = 2,
        line: Callable[[bytes], bytes] = bytes,
        store: PictureStore | None = None,
    ) -> None:
        """scene: the scenario's; beads are drawn into it. path: in the true surface frame. clock: for tracking times.

        exposures: filled with the shot of each picture, for a step that may know. line: carries bytes from the
        motion to the arm, e.g. over a pty. store: pictures of earlier runs.
        """
        self.scenario, self._scene, self._path, self._sink = scenario, scene, path, sink
        self._truth, self._exposures = truth, exposures
        profile = scenario.profile
        self.arm = VirtualArm(scenario.arm, profile.dialect, profile.arm.home, scenario.faults, scenario.baud)
        self._wire, self._line = SerialWire(scenario.baud), line
        self._truth_log = TruthLog(path, scenario.true_arm, self._truth, profile.tick, profile.lag)
        pictures: PictureRenderer | None = None
        if scenario.tracking.pictures:
            encoding = scenario.sensor, scenario.jpeg_quality, scenario.seed
            how = *encoding, threads, self._print_beads, store
            pictures = PictureRenderer(scene, TrueCameras(scenario.rig.cameras), *how)
        self._last_state: WorldState | None = None
        self._events = EventQueue()
        self._commanded = CommandedPose(profile)
        head = self._commanded.at if scenario.nozzle else lambda stamp: None
        views = pictures, self._state_at, head
        self.pipeline = CameraPipeline(scenario, self._events, step, exposures, sink, clock, self._on_pose, *views)
        self._motion_stalls = faults_striking(scenario.faults, FaultPart.MOTION)
        self._pose: SurfacePose | None = None
        self._motion: DispensedMotion | None = None
        self._time, where = SimClock(), scenario.path
        self.dispensers = SimulatedDispensers(path, scenario.dispenser, self._time, scenario.faults, where)
        self.dispensers.control.begin(0.0, 0.0)
        self._ticks, self._rows_until, self._printed_until = 0, 0.0, 0.0
        self._bead_end: Array | None = None  # (2,) where the last piece of bead ended
        self._end = scenario.seconds

    def run(self, progress: ProgressReport = no_progress) -> None:
        """Let the scenario's time pass; `progress` is called for each frame set tracked."""
        total = int(self.scenario.seconds / self.scenario.cameras.period)
        self.pipeline.begin()
        self._events.at(0.0, TICK_EVENT, self._tick)
        self._events.at(MATERIAL_POLL, TICK_EVENT, partial(self._poll_material, again=True))
        reported, complete = 0, False
        try:
            for _ in self._events.run(lambda: self._end):
                if self.pipeline.tracked > reported:
                    reported = self.pipeline.tracked
                    progress(reported, total)
            complete = True
        finally:
            self._emit_rows(self._end if complete else max(self.arm.now, self._time.now()))

    @property
    def told_outside(self) -> float:
        """How long, s, a dispenser was told to be open until now while no move that prints was sent."""
        return self.dispensers.told_outside(self._time.now())

    def _state_at(self, shot: Shot, now: float) -> WorldState:
        """The world as a shot meets it; the very same object for cameras that expose together."""
        last = self._last_state
        if last is not None and (last.stamp, last.gain) == (shot.exposed, shot.gain):
            return last
        times, truth, nozzle = np.array([shot.exposed]), self._truth, None
        if self.scenario.nozzle:
            self.arm.advance(now)
            nozzle = nozzle_from_axes(self.scenario.true_arm, self.arm.axes_at(times)[0])
        pose, twist, strain = truth.base_from_surface(times)[0], truth.twist(times)[0], float(truth.amount(times)[0])
        self._last_state = WorldState(shot.exposed, shot.exposure, pose, twist, strain, nozzle, shot.gain)
        return self._last_state

    def _on_pose(self, pose: SurfacePose, frames: FrameSet, observations: Observations) -> None:
        """Start the motion with the path in the tracker's surface frame, as soon as that frame can be measured."""
        self._pose, scenario = pose, self.scenario
        if self._motion is not None or pose.state is not TrackState.TRACKING:
            return
        change: Array | None = np.eye(4)
        if scenario.tracking.pictures and not scenario.tracking.scan:
            exposed = np.full(len(scenario.rig), pose.stamp)
            for frame in frames.frames:
                exposed[frame.camera] = self._exposures[frame.camera, frame.stamp].exposed
            rigs = scenario.rig, scenario.known_rig
            change = truth_from_estimate(pose, observations, rigs, self._truth, self._scene.shape, exposed)
        if change is None:
            return
        placed_path = replace(self._path, surface_from_nozzle=se3.inverse(change) @ self._path.surface_from_nozzle)
        step = MotionStep(placed_path, scenario.profile, outlets=self.dispensers.outlets)
        self._motion = DispensedMotion(step, self.dispensers.control)
        self._sink.registered(change)

    def _tick(self, now: float) -> None:
        self._ticks += 1
        self._events.at(self._ticks * self.scenario.profile.tick, TICK_EVENT, self._tick)
        if self._motion is not None and not self._motion_hangs(now):
            self._time.wait_until(now)
            command = self._motion(self._pose, now)
            frame = frame_from_command(command, self.scenario.profile.dialect)
            arrival = float(self._wire.send(frame, now)[-1])
            self._events.at(arrival, ARRIVAL_EVENT, partial(self.arm.receive, self._line(frame)))
            self._truth_log.write(command, self._motion.progress)
            self._tell(command, now)
            self._commanded.add(command, now)
            self.arm.advance(now)
            self._sink.command(command, self._motion.progress, frame, self.arm.transmit(now))
            if self._motion.progress.phase is PrintPhase.FINISHED:
                self._end = min(self._end, now + RUN_OUT)
        if now - self._rows_until >= ROW_BLOCK:
            self._emit_rows(now)

    def _motion_hangs(self, now: float) -> bool:
        return any(fault.covers(now) for fault in self._motion_stalls)

    def _tell(self, command: Command, now: float) -> None:
        """Let the dispensers be told what a command asks for, at the instant in the tick that it says."""
        self.dispensers.note(command, self.scenario.profile.tick)
        self.dispensers.control.follow(command, now)
        if isinstance(command, Move) and command.flow_after:
            self._events.at(command.stamp + command.flow_after, TICK_EVENT, self._poll_material)

    def _poll_material(self, now: float, again: bool = False) -> None:
        if again:
            self._events.at(now + MATERIAL_POLL, TICK_EVENT, partial(self._poll_material, again=True))
        if not self._motion_hangs(now):
            self._time.wait_until(now)
            self.dispensers.control.poll(now)

    def _emit_rows(self, now: float) -> None:
        self.arm.advance(now)
        self.dispensers.advance(now)
        times = row_instants(self._rows_until, now)
        if len(times):
            self._rows_until = now
            self._sink.rows(self._truth_log.rows(times, self.arm.axes_at, self.dispensers.flow))

    def _print_beads(self, until: float) -> None:
        ends = np.arange(self._printed_until + BEAD_STEP, until, BEAD_STEP)
        if not self.scenario.beads or not len(ends):
            return
        self._printed_until = float(ends[-1])
        self.arm.advance(max(until, self.arm.now))
        laid = self.dispensers.flowing(ends) if self.scenario.dispenser else self._truth_log.extruding(ends)
        nozzle = nozzle_from_axes(self.scenario.true_arm, self.arm.axes_at(ends))
        places = self._scene.shape.material(self._truth.material(ends, nozzle[:, :3, 3]))
        for place, there in zip(places, laid, strict=True):
            if there and self._bead_end is not None:
                self._scene.ink.lay(self._bead_end, place, self.scenario.bead)
            self._bead_end = place if there else None
