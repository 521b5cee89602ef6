"""A print in virtual time with faults: the live run's motion loop and link, its estimator on tracks, a virtual arm.

What stands between the faults and the arm is all of what stands there in a live run but for the processes and the
pictures: the pairing of frames, the estimator, planner, guard, the arm's link with its model of the queue. An operator
arms the arm again where it was stopped.

For the subject `loop`, what the planner's lead of a late dispenser is worth: a scenario's print in which the dispenser
is told over a line in virtual time, and material lies where its true flow left the true nozzle. Once the motion knows
the dispenser's delays, and once it takes them for none.
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
from hardware.simulator.nozzle_error import EndsOfBeads, MaterialFigures, material_figures, nozzle_errors
from hardware.simulator.scenario import Scenario, TrackingSettings, read_scenario
from hardware.simulator.scenario_tables import bare_scene
from hardware.simulator.scene.shape import Shape
from hardware.simulator.simulate import LandmarkTracker
from hardware.simulator.truth import Truth, disturbed_motion, drape_path, fold_deformation
from hardware.simulator.world import SimulatedWorld
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

    samples: ticks judged. over: how many broke each of AXES_LIMITS. worst: (5,) shares.
    """

    def __init__(self, axes: Array, limits: MotionLimits, tick: float) -> None:
        """axes: (6,) where the arm stands at first, at rest."""
        self._limits = limits
        self._bounds = np.stack([limits.speed, limits.acceleration, limits.jerk]) * tick ** np.arange(1, 4)[:, None]
        self.samples = 0
        self.over, self.worst = np.zeros(len(AXES_LIMITS), np.int64), np.zeros(len(AXES_LIMITS))
        self._last = np.tile(axes, (4, 1))  # (4, 6), the newest last

    def rest(self) -> None:
        """The arm has come to rest by itself, where it was sent last."""
        self._last = np.tile(self._last[-1], (4, 1))

    def stands(self, axes: Array) -> None:
        """Commands were recalled: the arm stands at `axes` (6,)."""
        self._last = np.tile(axes, (4, 1))

    def __call__(self, axes: Array | None) -> None:
        """One tick: the axes (6,) that are reached by its end, None where the arm is held."""
        p = self._last = np.vstack([self._last[1:], self._last[-1] if axes is None else axes])
        step = p[3] - p[2]
        quotients = np.abs(np.stack([step, step - (p[2] - p[1]), p[3] - 3 * p[2] + 3 * p[1] - p[0]])) / self._bounds
        jump, turn = np.linalg.norm(step[:3]) / self._limits.jump, np.abs(step[3:]).max() / self._limits.turn
        shares = np.array([*quotients.max(axis=1), jump, turn])  # of each limit, that this tick uses
        self.samples += 1
        self.over += ~(shares <= LIMIT_SLACK)  # NaN is over
        self.worst = np.maximum(self.worst, np.where(np.isfinite(shares), shares, np.inf))


MAIN_PERIOD = 0.02  # s between the main process's checks of the others
START_HEIGHT = 3.0  # mm over its first checkpoint, where the nozzle begins
MAX_RUN_S = 30.0  # of a run at most
MISSED_TICK = 1.5  # ticks without a command: one was left out


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
    answering = replace(scenario.arm, replies=ReplyMode.STREAM)
    profile = in_step(scenario.profile, scenario.cameras.period)
    plain = replace(scenario, tracking=tracking, arm=answering, known_rig=scenario.rig, profile=profile)
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
    told_outside: float = 0.0  # s in which a dispenser was open on its orders while no sent move printed, or unarmed
    left_open: float = 0.0  # s for which a dispenser stayed open at most after its line or the motion had ended
    over: int = 0  # ticks of commands beyond a limit
    ended: float = 0.0  # s
    stopped: list[float] = field(default_factory=list)  # s, at which the arm was stopped and an operator was needed
    seen_to: list[float] = field(default_factory=list)  # s, at which an operator made a dispenser ready again


class FaultRun:
    """One run with faults, from the first frame until the path is printed, the motion is killed, or `MAX_RUN_S`."""

    def __init__(
        self,
        on: PreparedScenario,
        faults: Sequence[Fault],
        seed: int,
        dispenser: SimulatedDispenser | None = None,
        change: Callable[[SurfacePose], SurfacePose] | None = None,
    ) -> None:
        """dispenser: instead of the scenario's own. change: what the motion is given in place of each pose."""
        fold = fold_deformation("faults", on.truth.deformation, faults)
        deformation, strain = (on.truth.deformation, on.truth.strain) if fold is None else fold
        motion = disturbed_motion(on.truth.motion, faults)
        truth = replace(on.truth, motion=motion, deformation=deformation, strain=strain)
        # home is over the first checkpoint: the way there is not what is judged
        over = on.path.surface_from_nozzle[:1].copy()
        over[:, :3, 3] += START_HEIGHT * over[:, :3, 2]
        arm = on.scenario.profile.arm
        home = axes_from_nozzle(arm, truth.base_from_surface(np.zeros(1)) @ over)[0]
        profile = replace(on.scenario.profile, arm=replace(arm, home=home))
        dispenser = on.scenario.dispenser if dispenser is None else dispenser
        scenario = replace(on.scenario, faults=tuple(faults), seed=seed, profile=profile, dispenser=dispenser)
        shots: Exposures = {}

        def shot(camera: int, stamp: float) -> Shot:
            return shots[camera, stamp]

        step: FrameSetStep = LandmarkTracker(scenario.rig, scenario.known_rig, truth, on.shape, shot, seed)
        if change is not None:
            step = _ChangedStep(step, change)
        self._world = SimulatedWorld(scenario, None, on.path, truth, step, shots, self, SimClock())
        self._world.every(MAIN_PERIOD, self._look_at_others)
        self._profile, self._interval = profile, scenario.cameras.period
        self._ticked = self._posed = np.inf  # s, the last tick of the motion and pose of the tracking
        self._pose: SurfacePose | None = None  # the newest that the motion was given
        self._oracle, self._sent_at = AxesOracle(home, profile.limits, profile.tick), -np.inf
        self._record, self._logs = FaultRunRecord(), list[NozzleLog]()

    def __call__(self) -> FaultRunRecord:
        """Run it."""
        world, record = self._world, self._record
        world.run()
        record.ended, record.log, record.seen_to = world.ended, join_logs(self._logs), world.seen_to
        record.told_outside, record.left_open = world.told_outside, world.left_open
        record.over = int(self._oracle.over.sum())
        return record

    def _look_at_others(self, now: float) -> None:
        """What a live run's main process notices of the others."""
        motion = silence_text("motion", self._ticked, self._profile.tick, now)
        if text := motion or silence_text("tracking", self._posed, self._interval, now):
            self._record.timeouts.append(Statement(now, text, False, False, now))

    # -- what the world tells

    def given(self, pose: SurfacePose) -> None:
        """The motion was given a pose."""
        self._pose, self._posed = pose, self._world.now()

    def tick(self, tick: Tick, progress: PrintProgress | None) -> None:
        """A tick was made, and how far the print is by it."""
        record, pose, link = self._record, self._pose, self._world.link
        self._ticked = self._world.now()
        anew = bool(record.statements) and record.statements[-1].hold is not LinkCode.STOPPED
        if tick.status.state is ArmState.STOPPED and (not record.stopped or (anew and tick.stamp > record.stopped[-1])):
            record.stopped.append(tick.stamp)
        silent = (tick.stamp - self._sent_at) / self._profile.tick  # ticks since one was sent
        if link.travels or silent > STALL_TICKS or (silent > MISSED_TICK and self._ran_dry()):
            self._oracle.rest()
        if tick.recalled is not None:
            self._oracle.stands(tick.recalled.stands)
        axes = tick.command.axes if isinstance(tick.command, Move) else None
        if axes is not None or tick.frame:
            self._oracle(axes)
            self._sent_at = tick.stamp
        reservation, pose_stamp = "no pose", -np.inf
        if pose is not None:
            reservation = pose.reason or ("" if pose.state is TrackState.TRACKING else pose.state.value)
            pose_stamp = pose.stamp
        text, own = tick.command.reason or reservation, link.travels or tick.hold is LinkCode.RECALLED
        moving = isinstance(tick.command, Move)
        record.statements.append(Statement(tick.stamp, text, moving, own, pose_stamp, tick.hold))

    def _ran_dry(self) -> bool:
        """Whether the arm has done all that was sent before; one that is behind goes on without a stop."""
        arm = self._world.arm
        return arm.now + arm.in_flight <= self._world.now()

    def rows(self, log: NozzleLog) -> None:
        """The next rows of the truth at the nozzle."""
        self._logs.append(log)

    def _ignore(self, *data: object, **named: object) -> None:
        pass

    picture = head = pose = event = wire = registered = look = _ignore


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
LED, NOT_LED = "delays known", "delays taken for 0"
MAX_END_ERROR = 0.5  # mm along the path, 95 %


@dataclass(frozen=True, slots=True, eq=False)
class BeadsPrint:
    """What came of a print."""

    material: MaterialFigures
    delay: float  # s, from a switch to half the flow


def print_beads(seed: int, way: str) -> BeadsPrint:
    """Print the scenario once; way: LED or NOT_LED."""
    on = prepare_scenario(shipped_file("scenarios", f"{LATE_DISPENSER}.toml"))
    dispenser = on.scenario.dispenser
    assert dispenser is not None
    run = FaultRun(on, (), seed, replace(dispenser, led=way == LED))()
    assert run.log is not None
    line, truth = planned_line(on.path), dispenser.truth
    errors = nozzle_errors(run.log, line)
    material = material_figures(run.log, line, errors, on.scenario.bead, run.told_outside)
    return BeadsPrint(material, truth.on_dead_time + float(np.log(2)) * truth.on_lag)


def bead_figures(prints: Mapping[str, BeadsPrint]) -> list[Figure]:
    """The figures of both prints, by LED and NOT_LED."""
    led, not_led, figures = prints[LED].material, prints[NOT_LED].material, list[Figure]()
    for what, ours, without in (("begin", led.begins, not_led.begins), ("end", led.stops, not_led.stops)):
        other, note = f"{NOT_LED}: {without.size.p95:.2f}", f"of {len(ours.error)}, by speed {_by_speed(ours)}"
        name = f"{LATE_DISPENSER}: beads {what} off the plan, 95 %"
        figures.append(Figure(name, ours.size.p95, "mm", at_most(MAX_END_ERROR), other, note))
        unled = f"{without.median:.2f} mm at the median; by speed {_by_speed(without)}"
        figures.append(Figure(f"{name}, {NOT_LED}", without.size.p95, "mm", None, "", unled))
    told = 1000 * max(led.told, not_led.told)
    figures.append(Figure(f"{LATE_DISPENSER}: told to flow while not printing", told, "ms", at_most(0)))
    return figures


def _by_speed(ends: EndsOfBeads) -> str:
    """The mean error at each speed, in whole mm/s."""
    there = np.isfinite(ends.error)
    speeds, error = np.round(ends.speed[there]), ends.error[there]
    each = (f"{speed:g} mm/s {error[speeds == speed].mean():+.2f}" for speed in np.unique(speeds))
    return ", ".join(each)
