"""A print in virtual time with faults: the live run's motion loop and link, its estimator on tracks, a virtual arm.

What stands between the faults and the arm is all of what stands there in a live run but for the processes and the
pictures: the pairing of frames, the estimator, planner, guard, the arm's link with its model of the queue. An operator
arms the arm again where it was stopped.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path as File

import numpy as np
from numpy.typing import NDArray

from estimation.pose import SurfacePose, TrackState
from estimation.se3 import Array
from hardware.arm.link import RECALLED, Arm
from hardware.arm.profile import ArmProfile
from hardware.arm_status import ArmState
from hardware.bench.axes_judge import AxesJudge
from hardware.files.path_file import read_path
from hardware.link_settings import LinkSettings
from hardware.live.silence import silence
from hardware.motion.loop import MotionLoop, Order, Tick
from hardware.motion.step import MotionStep
from hardware.process.clock import SimClock
from hardware.process.faults import Fault, Kind, Part, struck
from hardware.recording.schemas import WARNING
from hardware.simulator.agenda import Agenda
from hardware.simulator.arm.controller import VirtualArm
from hardware.simulator.arm.ports import PortFaults, VirtualDevice
from hardware.simulator.arm.settings import Replies
from hardware.simulator.camera_pipeline import Exposures, Sight
from hardware.simulator.cameras import Shot
from hardware.simulator.laying import laid
from hardware.simulator.ledger import Ledger, executed_rows
from hardware.simulator.nozzle_log import NozzleLog
from hardware.simulator.scenario import Scenario, Tracking
from hardware.simulator.scenario_file import read_scenario
from hardware.simulator.scene.shape import Shape
from hardware.simulator.scene_table import bare_scene
from hardware.simulator.struck_surface import folded, struck_motion
from hardware.simulator.track_tracker import TrackTracker
from hardware.simulator.truth import Truth
from perception.frames import FrameSet, PrintHead
from perception.tracking.step import StepReport
from planning.command import Move
from planning.kinematics import axes_from_nozzle
from planning.path import Path
from planning.progress import Phase

LOOK = 0.005  # s between looks at the line
CONDUCTED = 0.02  # s between looks of whoever conducts the run
ABOVE = 3.0  # mm over its first checkpoint, where the nozzle begins
WATCHED = 1.5  # s that the rest of the world goes on without the motion
AGAIN = 0.3  # s between an operator's words
BEFORE, SECONDS = 3.0, 30.0  # s: nothing goes wrong until then; of a run at most


@dataclass(frozen=True, slots=True, eq=False)
class Stage:
    """What all runs of one scenario share. path: in the surface frame, laid on its shape."""

    scenario: Scenario
    shape: Shape
    truth: Truth
    path: Path


def stage(file: File) -> Stage:
    """A scenario made ready for runs without pictures; its own arm answers."""
    scenario = read_scenario(file)
    shape, _, deformation = bare_scene(file, scenario.scene, file.parent, scenario.seed)
    path = read_path(scenario.path)
    if scenario.clearance is not None:
        path = laid(path, shape, scenario.clearance, scenario.path)
    truth = Truth(scenario.rest, scenario.motion, deformation, scenario.strain, shape.surface_from_grid)
    tracked = Tracking(pictures=False, tracks=True)
    answering = replace(scenario.arm, replies=Replies.STREAM)
    plain = replace(scenario, tracking=tracked, arm=answering, told_rig=scenario.rig, seconds=SECONDS)
    return Stage(plain, shape, truth, path)


@dataclass(frozen=True, slots=True)
class Word:
    """What was known at one instant, s.

    said: a reservation, a hold's reason, or why the arm does not move; "" if all is well. moving: whether a move was
    sent. own: whether the link moves the arm by itself. seen: stamp of the newest pose, s, -inf before any; of what no
    pose told, stamp.
    """

    stamp: float
    said: str
    moving: bool
    own: bool
    seen: float


@dataclass(slots=True, eq=False)
class Ran:
    """One run. words: a tick each. log: of nozzle and target. over: ticks of commands beyond a limit. ended: s.

    missed: what the conducting process said of one that was silent. stopped: instants, s, at which the arm was stopped
    and an operator was needed.
    """

    words: list[Word] = field(default_factory=list)
    missed: list[Word] = field(default_factory=list)
    log: NozzleLog | None = None
    over: int = 0
    ended: float = 0.0
    stopped: list[float] = field(default_factory=list)


class _KilledError(Exception):
    """The motion process is no more."""


class FaultRun:
    """One run with faults, from the first frame until the path is printed, the motion is killed, or `SECONDS`."""

    def __init__(self, on: Stage, faults: Sequence[Fault], seed: int) -> None:
        self._agenda, self._clock = Agenda(), SimClock()
        scenario = replace(on.scenario, faults=tuple(faults), seed=seed)
        fold = folded("faults", on.truth.deformation, faults)
        deformation, strain = (on.truth.deformation, on.truth.strain) if fold is None else fold
        motion = struck_motion(on.truth.motion, faults)
        self._truth = replace(on.truth, motion=motion, deformation=deformation, strain=strain)
        taken: Exposures = {}

        def shot(camera: int, stamp: float) -> Shot:
            return taken[camera, stamp]

        step = TrackTracker(scenario.rig, scenario.told_rig, self._truth, on.shape, shot, seed)
        self._sight = Sight(scenario, self._agenda, step, taken, self, SimClock(), self._know)
        self._profile = near(scenario.profile, self._truth, on.path)
        home = self._profile.arm.home
        self._virtual = VirtualArm(scenario.arm, self._profile.dialect, home, faults, self._profile.baud)
        self._device = VirtualDevice(self._virtual, self._clock, self._profile.baud)
        self._arm = Arm(self._device, self._profile, 0.0, LinkSettings(poll=LOOK))
        self._motion = MotionStep(on.path, self._profile)
        self._ledger = Ledger(on.path, scenario.true_arm, self._truth, self._profile.tick, self._profile.lag)
        self._hangs = struck(faults, Part.MOTION)
        self._pose: SurfacePose | None = None
        self._asked, self._stands = -np.inf, False
        self._interval = scenario.cameras.period
        self._ticked = self._heard = np.inf  # when motion and tracking last said something, s
        self._looks = 0.0  # when the conducting process looks next, s
        self._judge, self._sent = AxesJudge(home, self._profile.limits, self._profile.tick), -np.inf
        self._ran = Ran()

    def __call__(self) -> Ran:
        """Let it happen."""
        self._sight.begin()
        loop = MotionLoop(self._motion, self._arm, self, self._newest, self._orders, self._tell)
        try:
            loop.run(SECONDS)
        except _KilledError:
            self._device.faults = PortFaults(away=[(self._clock.now(), np.inf)])
            self._advance(self._clock.now() + WATCHED)
        ran = self._ran
        ran.ended = self._clock.now()
        self._virtual.advance(ran.ended)
        ran.log = self._ledger.rows(executed_rows(0.0, ran.ended), self._virtual.axes_at)
        ran.over = int(self._judge.over.sum())
        return ran

    # -- the clock of the motion: while it waits, the rest of the world goes on

    def now(self) -> float:
        """Instant, s."""
        return self._clock.now()

    def wait_until(self, instant: float) -> None:
        """Let the world go on until `instant`, s, or for as long as the motion stands still."""
        self._advance(instant)
        for fault in self._hangs:
            if fault.covers(self._clock.now()):
                if fault.kind is Kind.KILL or fault.end >= SECONDS:
                    raise _KilledError
                self._advance(fault.end)
        if self._motion.progress.phase is Phase.FINISHED:
            raise _KilledError

    def _advance(self, instant: float) -> None:
        while self._looks <= instant:
            self._pass(self._looks)
            self._conduct(self._looks)
            self._looks += CONDUCTED
        self._pass(instant)

    def _pass(self, instant: float) -> None:
        for _ in self._agenda.run(lambda: instant):
            pass
        self._clock.wait_until(instant)

    def _conduct(self, now: float) -> None:
        """What a live run's conducting process sees of the others, and says."""
        motion = silence("motion", self._ticked, self._profile.tick, now)
        if said := motion or silence("tracking", self._heard, self._interval, now):
            self._ran.missed.append(Word(now, said, False, False, now))

    # -- what the motion is given, and what becomes of it

    def _newest(self) -> SurfacePose | None:
        return self._pose

    def _know(self, pose: SurfacePose, frames: FrameSet, seen: object) -> None:
        self._pose, self._heard = pose, self._clock.now()

    def _orders(self) -> list[Order]:
        """An operator's: the arm stands at home, is armed once there is a pose, and again where it was stopped."""
        now = self._clock.now()
        if not self._stands:
            self._stands = True
            return [Order.AT_HOME]
        if self._pose is None or self._pose.state is not TrackState.TRACKING or now < self._asked + AGAIN:
            return []
        self._asked = now
        return [Order.ARM] if self._arm.state in (ArmState.STOPPED, ArmState.DISARMED) else []

    def _tell(self, tick: Tick) -> None:
        ran, pose, status = self._ran, self._pose, tick.status
        self._ticked = self._clock.now()
        said = tick.command.reason or reservation(pose)
        if status.state is ArmState.STOPPED and (not ran.stopped or now_stopped(ran, tick.stamp)):
            ran.stopped.append(tick.stamp)
        self._ledger.write(tick.command, self._motion.progress)
        if tick.stamp - self._sent > 1.5 * self._profile.tick or self._arm.travels:
            self._judge.rest()  # a tick that sends nothing, just after one that did, is no rest yet
        if tick.recalled is not None:
            self._judge.stands(tick.recalled.stands)
        axes = tick.command.axes if isinstance(tick.command, Move) else None
        if axes is not None or tick.frame:
            self._judge(axes)
            self._sent = tick.stamp
        own = self._arm.travels or said == RECALLED
        seen = -np.inf if pose is None else pose.stamp
        ran.words.append(Word(tick.stamp, said, isinstance(tick.command, Move), own, seen))

    # -- nobody looks at pictures

    def picture(self, shot: Shot, kind: str, data: bytes) -> None:
        """Nobody looks."""

    def head(self, stamp: float, head: PrintHead) -> None:
        """Nobody looks."""

    def pose(self, frames: FrameSet, pose: SurfacePose, report: StepReport, spent: float) -> None:
        """It is heard of once it is known."""

    def event(self, stamp: float, text: str, level: int = WARNING) -> None:
        """Nobody listens."""


def reservation(pose: SurfacePose | None) -> str:
    """What is to be said of a pose, "" of one without a reservation."""
    if pose is None:
        return "no pose"
    return pose.reason or ("" if pose.state is TrackState.TRACKING else pose.state.value)


def now_stopped(ran: Ran, stamp: float) -> bool:
    """Whether the arm is stopped anew: the tick before, it was not."""
    return bool(ran.words) and not ran.words[-1].said.startswith("the arm is stopped") and stamp > ran.stopped[-1]


def near(profile: ArmProfile, truth: Truth, path: Path) -> ArmProfile:
    """The arm with its home over the first checkpoint: the way there is not what is looked at."""
    over = path.surface_from_nozzle[:1].copy()
    over[:, :3, 3] += ABOVE * over[:, :3, 2]
    place = truth.base_from_surface(np.zeros(1)) @ over
    return replace(profile, arm=replace(profile.arm, home=axes_from_nozzle(profile.arm, place)[0]))


Rows = NDArray[np.bool_]


def speeds(log: NozzleLog) -> Array:
    """Of the nozzle (N,), mm/s, executed, over 10 ms."""
    places = log.base_from_nozzle[:, :3, 3]
    way = np.zeros(len(log))
    way[10:] = np.linalg.norm(places[10:] - places[:-10], axis=1) / np.maximum(log.stamps[10:] - log.stamps[:-10], 1e-9)
    return way
