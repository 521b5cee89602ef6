"""A print in virtual time with faults: the live run's motion loop and link, its estimator on tracks, a virtual arm.

Between the faults and the arm is all that a live run has there but for the processes and the pictures: the pairing of
frames, the estimator, planner, guard, the arm's link with its model of the queue. An operator arms the arm again after
a stop.

For the subject `loop`, the gain by the planner's compensation of a late dispenser: a print in which the dispenser is
commanded over a line in virtual time, and material lies where its true flow left the true nozzle. Once the motion knows
the dispenser's delays, and once it assumes none.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path as File

import numpy as np

from estimation.pose import SurfacePose, TrackState
from estimation.se3 import Array
from hardware.arm.device import ArmState, LinkCode
from hardware.arm.profile import in_step
from hardware.bench.figures import Figure, at_most
from hardware.files.path_file import read_path
from hardware.live.checklist import silence_text
from hardware.motion.loop import Tick
from hardware.offline.track import FrameSetStep
from hardware.process.clock import SimClock
from hardware.process.faults import Fault
from hardware.simulator.arm.settings import ReplyMode
from hardware.simulator.camera_pipeline import Exposures
from hardware.simulator.cameras import Shot
from hardware.simulator.deposit import NozzleLog, join_logs, planned_line
from hardware.simulator.material import SimulatedDispenser
from hardware.simulator.nozzle_error import BeadEnds, MaterialFigures, material_figures, nozzle_errors
from hardware.simulator.scenario import Scenario, TrackingSettings, read_scenario
from hardware.simulator.scenario_tables import bare_scene
from hardware.simulator.scene.shape import Shape
from hardware.simulator.simulate import LandmarkTracker
from hardware.simulator.truth import Truth, disturbed_motion, drape_path, fold_deformation
from hardware.simulator.world import SimulatedWorld, WorldSink
from perception import shipped_file
from perception.frames import FrameSet
from perception.tracking.step import StepReport
from planning.command import MotionLimits, Move
from planning.kinematics import axes_from_nozzle
from planning.motion.planner import STALL_TICKS
from planning.path import Path, PrintProgress

AXES_LIMITS = "speed", "acceleration", "jerk", "jump", "turn"
LIMIT_SLACK = 1.001  # a sample counts as over a limit from 0.1 % on


class AxesOracle:
    """What each axis does tick by tick, by differences of the commands alone.

    samples: ticks judged. violations: (5,) ticks that broke each of AXES_LIMITS. max_shares: (5,) of each limit.
    """

    def __init__(self, axes: Array, limits: MotionLimits, tick: float) -> None:
        """axes: (6,) of the arm at first, at rest."""
        self._limits = limits
        self._bounds = np.stack([limits.speed, limits.acceleration, limits.jerk]) * tick ** np.arange(1, 4)[:, None]
        self.samples = 0
        self.violations, self.max_shares = np.zeros(len(AXES_LIMITS), np.int64), np.zeros(len(AXES_LIMITS))
        self._last = np.tile(axes, (4, 1))  # (4, 6), the newest last

    def rest(self) -> None:
        """The arm has come to rest by itself, at its last target."""
        self._last = np.tile(self._last[-1], (4, 1))

    def reset(self, axes: Array) -> None:
        """Commands were recalled: the arm rests at `axes` (6,)."""
        self._last = np.tile(axes, (4, 1))

    def __call__(self, axes: Array | None) -> None:
        """One tick: the axes (6,) at its end, None where the arm holds."""
        p = self._last = np.vstack([self._last[1:], self._last[-1] if axes is None else axes])
        step = p[3] - p[2]
        quotients = np.abs(np.stack([step, step - (p[2] - p[1]), p[3] - 3 * p[2] + 3 * p[1] - p[0]])) / self._bounds
        jump, turn = np.linalg.norm(step[:3]) / self._limits.jump, np.abs(step[3:]).max() / self._limits.turn
        shares = np.array([*quotients.max(axis=1), jump, turn])  # of each limit, that this tick uses
        self.samples += 1
        self.violations += ~(shares <= LIMIT_SLACK)  # NaN is over
        self.max_shares = np.maximum(self.max_shares, np.where(np.isfinite(shares), shares, np.inf))


MAIN_PERIOD = 0.02  # s between the main process's checks of the others
START_HEIGHT = 3.0  # mm of the nozzle's start over the first checkpoint
MAX_RUN_S = 30.0  # of a run at most
MISSED_TICK = 1.5  # ticks without a command: one is missing


@dataclass(frozen=True, slots=True, eq=False)
class PreparedScenario:
    """What all runs of one scenario share."""

    scenario: Scenario
    shape: Shape
    truth: Truth
    path: Path  # surface frame, draped on the shape


def prepare_scenario(file: File) -> PreparedScenario:
    """A scenario made ready for runs without pictures; its own arm answers."""
    scenario = read_scenario(file)
    shape, _, deformation = bare_scene(file, scenario.scene, file.parent, scenario.seed)
    path = read_path(scenario.path)
    if scenario.clearance is not None:
        path = drape_path(path, shape, scenario.clearance, scenario.path)
    truth = Truth(scenario.rest, scenario.motion, deformation, scenario.strain, shape.surface_from_grid)
    tracking = TrackingSettings(pictures=False, tracks=True)
    arm = replace(scenario.arm, replies=ReplyMode.STREAM)
    profile = in_step(scenario.profile, scenario.cameras.period)
    plain = replace(scenario, tracking=tracking, arm=arm, known_rig=scenario.rig, profile=profile)
    return PreparedScenario(replace(plain, seconds=MAX_RUN_S, nozzle=False, beads=False), shape, truth, path)


@dataclass(frozen=True, slots=True)
class Statement:
    """What was reported at one instant."""

    stamp: float  # s
    text: str  # a pose's reservation, a hold's reason, or why the arm does not move; "" if all is well
    moving: bool  # whether a move was sent
    own: bool  # whether the link moves the arm by itself
    pose_stamp: float  # s, of the newest pose, -inf before any; `stamp` where the report is not about a pose
    hold: LinkCode | None = None  # why the link sends nothing


@dataclass(slots=True, eq=False)
class FaultRunRecord:
    """What happened in one run."""

    statements: list[Statement] = field(default_factory=list)  # a tick each
    timeouts: list[Statement] = field(default_factory=list)  # the main process's, of a process that was silent
    log: NozzleLog | None = None  # of nozzle and target
    open_outside: float = 0.0  # s in which a dispenser was commanded open while no sent move printed, or unarmed
    open_unattended: float = 0.0  # s, the longest that a dispenser stayed open after its line or the motion failed
    violations: int = 0  # ticks of commands beyond a limit
    end: float = 0.0  # s
    stops: list[float] = field(default_factory=list)  # s, at which the arm stopped until an operator armed it
    service_times: list[float] = field(default_factory=list)  # s, at which an operator refilled or reset a dispenser


class FaultRun(WorldSink):
    """One run with faults, from the first frame until the path is printed, the motion is killed, or `MAX_RUN_S`."""

    def __init__(
        self,
        prepared: PreparedScenario,
        faults: Sequence[Fault],
        seed: int,
        dispenser: SimulatedDispenser | None = None,
        change: Callable[[SurfacePose], SurfacePose] | None = None,
    ) -> None:
        """dispenser: instead of the scenario's own. change: applied to each pose before the motion gets it."""
        fold = fold_deformation("faults", prepared.truth.deformation, faults)
        deformation, strain = (prepared.truth.deformation, prepared.truth.strain) if fold is None else fold
        motion = disturbed_motion(prepared.truth.motion, faults)
        truth = replace(prepared.truth, motion=motion, deformation=deformation, strain=strain)
        # home is over the first checkpoint: the approach is not judged
        start = prepared.path.surface_from_nozzle[:1].copy()
        start[:, :3, 3] += START_HEIGHT * start[:, :3, 2]
        arm = prepared.scenario.profile.arm
        home = axes_from_nozzle(arm, truth.base_from_surface(np.zeros(1)) @ start)[0]
        profile = replace(prepared.scenario.profile, arm=replace(arm, home=home))
        dispenser = prepared.scenario.dispenser if dispenser is None else dispenser
        scenario = replace(prepared.scenario, faults=tuple(faults), seed=seed, profile=profile, dispenser=dispenser)
        shots: Exposures = {}

        def shot(camera: int, stamp: float) -> Shot:
            return shots[camera, stamp]

        step: FrameSetStep = LandmarkTracker(scenario.rig, scenario.known_rig, truth, prepared.shape, shot, seed)
        if change is not None:
            step = _ChangedStep(step, change)
        self._world = SimulatedWorld(scenario, None, prepared.path, truth, step, shots, self, SimClock())
        self._world.every(MAIN_PERIOD, self._look_at_others)
        self._profile, self._interval = profile, scenario.cameras.period
        self._last_tick = self._last_pose = np.inf  # s, the last tick of the motion and pose of the tracking
        self._pose: SurfacePose | None = None  # the newest that reached the motion
        self._oracle, self._last_sent = AxesOracle(home, profile.limits, profile.tick), -np.inf
        self._record, self._logs = FaultRunRecord(), list[NozzleLog]()

    def __call__(self) -> FaultRunRecord:
        """Run it."""
        world, record = self._world, self._record
        world.run()
        record.end, record.log, record.service_times = world.elapsed, join_logs(self._logs), world.service_times
        record.open_outside, record.open_unattended = world.open_outside, world.open_unattended
        record.violations = int(self._oracle.violations.sum())
        return record

    def _look_at_others(self, now: float) -> None:
        """The checks of the other processes by a live run's main process."""
        motion = silence_text("motion", self._last_tick, self._profile.tick, now)
        if text := motion or silence_text("tracking", self._last_pose, self._interval, now):
            self._record.timeouts.append(Statement(now, text, False, False, now))

    # -- the world's sink

    def pose_delivery(self, pose: SurfacePose) -> None:
        """A pose has reached the motion."""
        self._pose, self._last_pose = pose, self._world.now()

    def tick(self, tick: Tick, progress: PrintProgress | None) -> None:
        """A tick, and the progress of the print by it."""
        record, pose, link = self._record, self._pose, self._world.link
        self._last_tick = self._world.now()
        armed, stops = bool(record.statements) and record.statements[-1].hold is not LinkCode.STOPPED, record.stops
        if tick.status.state is ArmState.STOPPED and (not stops or (armed and tick.stamp > stops[-1])):
            stops.append(tick.stamp)
        silent_ticks = (tick.stamp - self._last_sent) / self._profile.tick  # ticks since one was sent
        if link.travels or silent_ticks > STALL_TICKS or (silent_ticks > MISSED_TICK and self._queue_empty()):
            self._oracle.rest()
        if tick.recalled is not None:
            self._oracle.reset(tick.recalled.stands)
        axes = tick.command.axes if isinstance(tick.command, Move) else None
        if axes is not None or tick.frame:
            self._oracle(axes)
            self._last_sent = tick.stamp
        reservation, pose_stamp = "no pose", -np.inf
        if pose is not None:
            reservation = pose.reason or ("" if pose.state is TrackState.TRACKING else pose.state.value)
            pose_stamp = pose.stamp
        text, own = tick.command.reason or reservation, link.travels or tick.hold is LinkCode.RECALLED
        moving = isinstance(tick.command, Move)
        record.statements.append(Statement(tick.stamp, text, moving, own, pose_stamp, tick.hold))

    def _queue_empty(self) -> bool:
        """Whether the arm has executed all that was sent; one that lags goes on without a stop."""
        arm = self._world.arm
        return arm.now + arm.in_flight <= self._world.now()

    def rows(self, log: NozzleLog) -> None:
        """The next rows of the truth at the nozzle."""
        self._logs.append(log)


class _ChangedStep:
    """A tracking step whose poses are changed."""

    def __init__(self, step: FrameSetStep, change: Callable[[SurfacePose], SurfacePose]) -> None:
        self._step, self._change = step, change
        self.last: StepReport

    def __call__(self, frames: FrameSet) -> SurfacePose:
        pose = self._change(self._step(frames))
        self.last = self._step.last
        return pose

    def idle(self) -> None:
        self._step.idle()


LATE_DISPENSER = "dispenser_late"  # a scenario
DELAYS_KNOWN, DELAYS_ZERO = "delays known", "delays taken for 0"
MAX_END_ERROR = 0.5  # mm along the path, 95 %


@dataclass(frozen=True, slots=True, eq=False)
class BeadsPrint:
    """The result of a print."""

    material: MaterialFigures
    delay: float  # s, from a switch to half the flow


def print_beads(seed: int, delays: str) -> BeadsPrint:
    """Print the scenario once; delays: DELAYS_KNOWN or DELAYS_ZERO."""
    prepared = prepare_scenario(shipped_file("scenarios", f"{LATE_DISPENSER}.toml"))
    dispenser = prepared.scenario.dispenser
    assert dispenser is not None
    run = FaultRun(prepared, (), seed, replace(dispenser, delays_known=delays == DELAYS_KNOWN))()
    assert run.log is not None
    line, truth = planned_line(prepared.path), dispenser.truth
    errors = nozzle_errors(run.log, line)
    material = material_figures(run.log, line, errors, prepared.scenario.bead, run.open_outside)
    return BeadsPrint(material, truth.on_dead_time + float(np.log(2)) * truth.on_lag)


def bead_figures(prints: Mapping[str, BeadsPrint]) -> list[Figure]:
    """The figures of both prints, by DELAYS_KNOWN and DELAYS_ZERO."""
    known, zero, figures = prints[DELAYS_KNOWN].material, prints[DELAYS_ZERO].material, list[Figure]()
    for end, ours, other in (("begin", known.beginnings, zero.beginnings), ("end", known.ends, zero.ends)):
        reference, note = f"{DELAYS_ZERO}: {other.size.p95:.2f}", f"of {len(ours.error)}, by speed {_by_speed(ours)}"
        name = f"{LATE_DISPENSER}: beads {end} off the plan, 95 %"
        figures.append(Figure(name, ours.size.p95, "mm", at_most(MAX_END_ERROR), reference, note))
        other_note = f"{other.median:.2f} mm at the median; by speed {_by_speed(other)}"
        figures.append(Figure(f"{name}, {DELAYS_ZERO}", other.size.p95, "mm", None, "", other_note))
    open_ms = 1000 * max(known.open_outside, zero.open_outside)
    figures.append(Figure(f"{LATE_DISPENSER}: told to flow while not printing", open_ms, "ms", at_most(0)))
    return figures


def _by_speed(ends: BeadEnds) -> str:
    """The mean error at each speed, in whole mm/s."""
    laid = np.isfinite(ends.error)
    speeds, error = np.round(ends.speed[laid]), ends.error[laid]
    texts = (f"{speed:g} mm/s {error[speeds == speed].mean():+.2f}" for speed in np.unique(speeds))
    return ", ".join(texts)
