"""A run of a scenario without pictures under faults, and all that was reported meanwhile."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from estimation.pose import SurfacePose, TrackState
from estimation.se3 import Array
from hardware.arm.device import ArmState, LinkCode
from hardware.bench.loop_run import LoopRun, PreparedScenario
from hardware.live.checklist import silence_text
from hardware.motion.loop import Tick
from hardware.motion.print_loop import LoopOrder
from hardware.motion.step import PauseOrder
from hardware.process.faults import Fault
from hardware.simulator.camera_pipeline import TICK_EVENT
from hardware.simulator.deposit import NozzleLog
from hardware.simulator.material import SimulatedDispensers
from hardware.simulator.truth import disturbed_motion, fold_deformation
from hardware.simulator.world import SimulatedWorld
from planning.command import MotionLimits, Move
from planning.motion.planner import STALL_TICKS
from planning.path import PrintProgress

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
MISSED_TICK = 1.5  # ticks without a command: one is missing


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


class FaultRun(LoopRun):
    """One run with faults."""

    def __init__(self, prepared: PreparedScenario, faults: Sequence[Fault], seed: int) -> None:
        super().__init__(_with_faults(prepared, faults), seed)
        self._profile, self._interval = self.world.scenario.profile, self.world.scenario.cameras.period
        self._last_tick = self._last_pose = np.inf  # s, the last tick of the motion and pose of the tracking
        self._pose: SurfacePose | None = None  # the newest that reached the motion
        home, limits, tick = self._profile.arm.home, self._profile.limits, self._profile.tick
        self._oracle, self._last_sent = AxesOracle(home, limits, tick), -np.inf
        self._record = FaultRunRecord()
        self.world._operator = _WatchedOperator(self.world._operator, self._record.service_times)
        every(self.world, MAIN_PERIOD, self._look_at_others)

    def record(self) -> FaultRunRecord:
        """Run it."""
        record, world = self._record, self.world
        record.log, record.end = self(), world.elapsed
        record.open_outside = world.open_outside
        record.open_unattended = open_unattended(world.dispensers, world._unattended, world.elapsed)
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
        self._pose, self._last_pose = pose, self.world.now()

    def tick(self, tick: Tick, progress: PrintProgress | None) -> None:
        """A tick, and the progress of the print by it."""
        record, pose, link = self._record, self._pose, self.world.link
        self._last_tick = self.world.now()
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
        arm = self.world.arm
        return arm.now + arm.in_flight <= self.world.now()


def _with_faults(prepared: PreparedScenario, faults: Sequence[Fault]) -> PreparedScenario:
    """The same with faults, which move and fold its surface."""
    fold = fold_deformation("faults", prepared.truth.deformation, faults)
    deformation, strain = (prepared.truth.deformation, prepared.truth.strain) if fold is None else fold
    motion = disturbed_motion(prepared.truth.motion, faults)
    truth = replace(prepared.truth, motion=motion, deformation=deformation, strain=strain)
    return replace(prepared, scenario=replace(prepared.scenario, faults=tuple(faults)), truth=truth)


class _WatchedOperator:
    """A simulated operator, and the instants, s, at which he refills or resets a dispenser."""

    def __init__(self, operator: Callable[..., list[LoopOrder]], service_times: list[float]) -> None:
        self._operator, self._service_times = operator, service_times

    def __call__(self, progress: PrintProgress | None, state: ArmState, tracking: bool, now: float) -> list[LoopOrder]:
        orders = self._operator(progress, state, tracking, now)
        if any(order in (PauseOrder.MATERIAL_IN, PauseOrder.RESUME) for order in orders):
            self._service_times.append(now)
        return orders


def every(world: SimulatedWorld, period: float, action: Callable[[float], None]) -> None:
    """Call `action` with the instant, s, every `period` s of a world's time from 0 s on."""

    def act(now: float) -> None:
        world._events.at(now + period, TICK_EVENT, act)
        action(now)

    world._events.at(0.0, TICK_EVENT, act)


def open_unattended(dispensers: SimulatedDispensers, unattended: Sequence[tuple[float, float]], until: float) -> float:
    """The longest time, s, that a device stayed open since commands failed; unattended: from, until, s."""
    longest = 0.0
    for stamps, flows in map(dispensers._switches, dispensers.models):
        for lost, restored in unattended:
            if lost < until and flows[np.searchsorted(stamps, lost, "right") - 1] > 0:
                closed = stamps[(stamps > lost) & (flows == 0)]
                longest = max(longest, min(closed[0] if len(closed) else until, restored, until) - lost)
    return longest
