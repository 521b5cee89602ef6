"""The closed loop in virtual time: the wound moves, cameras expose, poses and commands travel, the arm executes.

Nothing here decides anything: TrackingStep and MotionStep are those of the live run, and the loop only lets time pass
between them. Whatever takes time in a real run takes it here: the exposure's way to the computer, the tracking, the
48 bytes on the wire, the arm's interpolation and its servo. Virtual time does not depend on how fast this runs, unless
the scenario asks for measured tracking times.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Protocol

import numpy as np

from estimation import se3
from estimation.observations import Observations
from estimation.pose import SurfacePose, TrackState
from estimation.se3 import Array
from hardware.commanded import Commanded
from hardware.motion.step import MotionStep
from hardware.offline.track import Step
from hardware.process.clock import Clock
from hardware.process.faults import Part, struck
from hardware.process.progress import Report, silent
from hardware.simulator.agenda import ARRIVAL, TICK, Agenda
from hardware.simulator.arm.controller import VirtualArm
from hardware.simulator.camera_pipeline import Exposures, Sight, Watcher
from hardware.simulator.cameras import Shot
from hardware.simulator.instant import Instant
from hardware.simulator.ledger import Ledger, executed_rows
from hardware.simulator.lenses import Lenses
from hardware.simulator.nozzle_log import NozzleLog
from hardware.simulator.pictures import Pictures
from hardware.simulator.registering import truth_from_estimate
from hardware.simulator.scenario import Scenario
from hardware.simulator.scene.scene import Scene
from hardware.simulator.truth import Truth
from hardware.simulator.wire import Wire
from perception.frames import FrameSet, PrintHead
from planning.command import Command
from planning.kinematics import nozzle_from_axes
from planning.path import Path
from planning.progress import Phase
from planning.progress import Progress as Print

BLOCK = 0.2  # s of rows given out at once
REST = 0.3  # s that the run goes on after the path is finished
BEAD_STEP = 0.01  # s between the ends of the pieces in which a bead is drawn


class Sink(Watcher, Protocol):
    """What is told of everything that passes."""

    def command(self, command: Command, progress: Print, frame: bytes, received: bytes) -> None:
        """A command was sent, how far the print is by it, and what came from the arm since the last."""
        ...

    def rows(self, log: NozzleLog) -> None:
        """The next rows of the truth at the nozzle."""
        ...

    def registered(self, truth_from_estimate: Array) -> None:
        """The path was registered: truth_surface_from_estimated_surface (4, 4)."""
        ...


class World:
    """One run of one scenario; `run` lets its time pass."""

    def __init__(
        self,
        scenario: Scenario,
        scene: Scene,
        path: Path,
        truth: Truth,
        step: Step,
        exposures: Exposures,
        sink: Sink,
        clock: Clock,
        threads: int = 2,
        line: Callable[[bytes], bytes] = bytes,
    ) -> None:
        """scene: the scenario's, rendered into. path: in the true surface frame. clock: measures tracking times.

        exposures: filled with the shot of each picture, for a step that may know. line: carries bytes from the
        motion to the arm, e.g. over a pty.
        """
        self.scenario, self._scene, self._path, self._sink = scenario, scene, path, sink
        self._truth, self._exposed = truth, exposures
        profile = scenario.profile
        self.arm = VirtualArm(scenario.arm, profile.dialect, profile.arm.home, scenario.faults, scenario.baud)
        self._wire, self._line = Wire(scenario.baud), line
        self._ledger = Ledger(path, scenario.true_arm, self._truth, profile.tick, profile.lag)
        self._pictures: Pictures | None = None
        if scenario.tracking.pictures:
            quality = scenario.jpeg_quality
            self._pictures = Pictures(
                scene, Lenses(scenario.rig.cameras), scenario.sensor, quality, scenario.seed, threads, self._lay
            )
        self._instant_before: Instant | None = None
        self._agenda = Agenda()
        watched = self._pictures, self._instant, self._head
        self._sight = Sight(scenario, self._agenda, step, exposures, sink, clock, self._know, *watched)
        self._hangs = struck(scenario.faults, Part.MOTION)
        self._pose: SurfacePose | None = None
        self._motion: MotionStep | None = None
        self._commanded = Commanded(profile)
        self._ticks, self._given, self._laid = 0, 0.0, 0.0
        self._bead: Array | None = None  # (2,) where the last piece of bead ended
        self._end = scenario.seconds

    @property
    def tracked(self) -> int:
        """Frame sets that the tracker took."""
        return self._sight.tracked

    @property
    def skipped(self) -> int:
        """Frame sets that the tracker had no time for."""
        return self._sight.skipped

    def run(self, progress: Report = silent) -> None:
        """Let the scenario's time pass; progress is told of each frame set tracked. What was given out stays given."""
        total = int(self.scenario.seconds / self.scenario.cameras.period)
        self._sight.begin()
        self._agenda.at(0.0, TICK, self._tick)
        told, complete = 0, False
        try:
            for _ in self._agenda.run(lambda: self._end):
                if self.tracked > told:
                    told = self.tracked
                    progress(told, total)
            complete = True
        finally:
            self._give_rows(self._end if complete else self.arm.now)

    def _instant(self, shot: Shot, now: float) -> Instant:
        """The world as a shot meets it; the very same object for cameras that expose together."""
        last = self._instant_before
        if last is not None and (last.stamp, last.gain) == (shot.exposed, shot.gain):
            return last
        times, truth, nozzle = np.array([shot.exposed]), self._truth, None
        if self.scenario.nozzle:
            self.arm.advance(now)
            nozzle = nozzle_from_axes(self.scenario.true_arm, self.arm.axes_at(times)[0])
        self._instant_before = Instant(
            stamp=shot.exposed,
            exposure=shot.exposure,
            base_from_surface=truth.base_from_surface(times)[0],
            twist=truth.twist(times)[0],
            strain=float(truth.amount(times)[0]),
            base_from_nozzle=nozzle,
            gain=shot.gain,
        )
        return self._instant_before

    def _head(self, stamp: float) -> PrintHead | None:
        return self._commanded.at(stamp) if self.scenario.nozzle else None

    def _know(self, pose: SurfacePose, frames: FrameSet, seen: Observations) -> None:
        """A pose has reached the motion."""
        self._pose = pose
        if self._motion is None and pose.state is TrackState.TRACKING:
            self._register(pose, frames, seen)

    def _register(self, pose: SurfacePose, frames: FrameSet, seen: Observations) -> None:
        """Tell the motion where its path lies on the surface that the tracker follows, if that can be told yet."""
        scenario = self.scenario
        change: Array | None = np.eye(4)
        if scenario.tracking.pictures and not scenario.tracking.scan:
            exposed = np.full(len(scenario.rig), pose.stamp)
            for frame in frames.frames:
                exposed[frame.camera] = self._exposed[frame.camera, frame.stamp].exposed
            rigs = scenario.rig, scenario.told_rig
            change = truth_from_estimate(pose, seen, rigs, self._truth, self._scene.shape, exposed)
        if change is None:
            return
        moved = se3.inverse(change) @ self._path.surface_from_nozzle
        self._motion = MotionStep(replace(self._path, surface_from_nozzle=moved), scenario.profile)
        self._sink.registered(change)

    # -- motion and arm

    def _tick(self, now: float) -> None:
        self._ticks += 1
        self._agenda.at(self._ticks * self.scenario.profile.tick, TICK, self._tick)
        if self._motion is not None and not any(fault.covers(now) for fault in self._hangs):
            frame = self._motion(self._pose, now)
            arrival = float(self._wire.send(frame, now)[-1])
            self._agenda.at(arrival, ARRIVAL, partial(self._receive, self._line(frame)))
            self._ledger.write(self._motion.last, self._motion.progress)
            self._commanded.add(self._motion.last, now)
            self.arm.advance(now)
            self._sink.command(self._motion.last, self._motion.progress, frame, self.arm.transmit(now))
            if self._motion.progress.phase is Phase.FINISHED:
                self._end = min(self._end, now + REST)
        if now - self._given >= BLOCK:
            self._give_rows(now)

    def _receive(self, data: bytes, now: float) -> None:
        self.arm.receive(data, now)

    def _give_rows(self, now: float) -> None:
        """Give out the truth at the nozzle up to `now`, s."""
        self.arm.advance(now)
        times = executed_rows(self._given, now)
        if len(times):
            self._given = now
            self._sink.rows(self._ledger.rows(times, self.arm.axes_at))

    def _lay(self, until: float) -> None:
        """Bring the printed material in the pictures up to `until`, s."""
        ends = np.arange(self._laid + BEAD_STEP, until, BEAD_STEP)
        if not self.scenario.beads or not len(ends):
            return
        self._laid = float(ends[-1])
        self.arm.advance(max(until, self.arm.now))
        extruding = self._ledger.extruding(ends)
        nozzle = nozzle_from_axes(self.scenario.true_arm, self.arm.axes_at(ends))
        places = self._scene.shape.material(self._truth.material(ends, nozzle[:, :3, 3]))
        for place, extrude in zip(places, extruding, strict=True):
            if extrude and self._bead is not None:
                self._scene.ink.lay(self._bead, place, self.scenario.bead)
            self._bead = place if extrude else None
