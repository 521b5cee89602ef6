"""MotionStep: the newest surface pose in, the arm's next command out; no I/O and no clock of its own.

The planner proposes a command and the guard passes it or turns it into a Hold; the arm's link encodes it. The motion's
processes import this module: it must never load gtsam, cv2 or onnxruntime, as a call of gtsam was measured to stop
every other thread for as long as it takes.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from ctypes import c_double
from dataclasses import dataclass, replace
from enum import Enum

import numpy as np

from estimation import se3
from estimation.pose import SurfacePose
from estimation.se3 import Array
from hardware.arm.profile import ArmProfile, measured_lag
from hardware.motion.loop import MaterialControl
from hardware.process.clock import Clock
from planning.clearance import TissueGuard
from planning.command import LOOKS, Command, Hold, Move
from planning.kinematics import nozzle_from_axes
from planning.material import FlowShares, Outlets, with_offsets
from planning.motion.guard import Guard
from planning.path import Path, PrintProgress


class MotionStep:
    """One arm printing one path; call it once a tick."""

    def __init__(
        self,
        path: Path,
        profile: ArmProfile | None = None,
        start: float = 0.0,
        outlets: Outlets | None = None,
        tissue: TissueGuard | None = None,
    ) -> None:
        """start: place on the path where printing begins, in checkpoints. outlets: of the path's materials.

        tissue: that the tool has to avoid, as scanned; None without a scan.
        """
        from planning.motion.planner import Planner  # takes half a second: only loaded by processes that plan

        self.profile = ArmProfile() if profile is None else profile
        limits = self.profile.limits, self.profile.arm, self.profile.tick
        lag = self.profile.lag
        path = with_offsets(path, outlets or {})
        self._planner = Planner(path, *limits, lag, start, outlets)
        self._guard = Guard(*limits, path.zone, lag, tissue)

    def __call__(self, pose: SurfacePose | None, now: float) -> Command:
        """The command of the tick at `now`, s, as the guard lets it pass. pose: the newest there is."""
        proposal = self._planner(pose, now)
        command = self._guard(proposal, pose, now)
        if isinstance(proposal, Move) and isinstance(command, Hold):
            self._planner.refused(self._guard.axes)
        return command

    def recalled(self, place: Array, stands: Array) -> None:
        """Go on from `stands` (6,), the arm's axes after a stop at `place` (6,) on its way."""
        self._planner.recalled(place, stands)
        self._guard.stands(stands)

    def material_in(self) -> None:
        """Note that the material requested in `progress.wanted` is in."""
        self._planner.material_in()

    def adapt(self, shares: FlowShares) -> None:
        """Change the flow on some segments of the path."""
        self._planner.flow.adapt(shares)

    @property
    def lag(self) -> float:
        """The arm's lag, s, from a tick after sending until it is at a command's axes; by default the profile's."""
        return self._planner.lag

    @lag.setter
    def lag(self, value: float) -> None:
        self._planner.lag = self._guard.lag = value

    @property
    def paused(self) -> bool:
        """Whether the nozzle is to retract from the surface and wait; it then resumes at the same place."""
        return self._planner.paused

    @paused.setter
    def paused(self, value: bool) -> None:
        self._planner.paused = value

    @property
    def aside(self) -> bool:
        """Whether in a pause the nozzle is to wait beside the print, so that cameras see the print."""
        return self._planner.aside

    @aside.setter
    def aside(self, value: bool) -> None:
        self._planner.aside = value

    @property
    def progress(self) -> PrintProgress:
        """How far the print is, and in which phase."""
        return self._planner.progress


CLAIMED_SHARE = 0.95  # of cases in which the error is within the predicted one


@dataclass(frozen=True, slots=True, eq=False)
class PredictedError:
    """The predicted distance of the nozzle from its place on the path at the end of a move."""

    arrival: float  # s, of the end of the move
    tip: Array  # (3,) mm, commanded tip, surface frame
    sigma: float  # mm, standard deviation of the surface point under it along its worst direction; the guard limits it
    radii: Array  # mm, quantiles of the distance at `ERROR_SHARES`
    within: float  # mm, quantile at CLAIMED_SHARE


ERROR_SHARES = (np.arange(10) + 0.5) / 10  # tenths of the cases, each by its middle


def predicted_error(
    move: Move, arrival: float, pose: SurfacePose, profile: ArmProfile, path: Path, fraction: float
) -> PredictedError:
    """The error of `move`, computed from `pose`, at `arrival`, s: a tick and the arm's lag after it was sent.

    Its random part is the pose's uncertainty at `arrival`; its known part is the move's offset from the place at
    `fraction` of `path`, in checkpoints: the move's jerk is limited, and its prediction was older. The arm's own
    error beside its lag is not in it.
    """
    pose_then = pose.predict(max(arrival, pose.stamp), keep_forecast=False)
    tip = (se3.inverse(pose_then.base_from_surface) @ nozzle_from_axes(profile.arm, move.axes))[:3, 3]
    previous = min(int(fraction), len(path) - 2)
    start_point, end_point = path.surface_from_nozzle[previous : previous + 2, :3, 3]
    offset = (tip - start_point - (fraction - previous) * (end_point - start_point))[None]
    sigma, place = float(pose_then.error_at(tip[None])[0]), tip[None]
    radii = pose_then.radius_at(place, np.append(ERROR_SHARES, CLAIMED_SHARE), offset)
    return PredictedError(arrival, tip, sigma, radii[:-1], float(radii[-1]))


@dataclass(frozen=True, slots=True, eq=False)
class PoseHandover:
    """A pose on its way from the tracking to the motion process."""

    pose: SurfacePose
    handed: float  # s, when the newest of its frames was handed over
    sent: float  # s, when the pose left the tracking process


@dataclass(frozen=True, slots=True, eq=False)
class BeginPrint:
    """The order to print."""

    path: Path  # in the tracker's surface frame
    profile: ArmProfile  # with the current estimates of the arm's place and lag
    start: float  # place on the path, counted in checkpoints
    outlets: Outlets  # of its materials
    fingerprint: str  # of the path as its file has it
    tissue: TissueGuard | None = None  # that the tool has to avoid, in the same frame


class PauseOrder(Enum):
    """Orders of a live run to its motion; `Order` has those for the arm."""

    PAUSE = "pause"
    RESUME = "resume"
    MATERIAL_IN = "material in"  # the material that the motion requested is in, or the look that it waits for is done
    LOOK = "look"  # step aside in a pause, for a look at the print


PAUSED_REASON = "paused by the operator"
WAITING_REASON = "no path was confirmed yet"
LAG_STEP = 0.004  # s, difference of the measured lag from the one in use from which it is adopted: 0.04 mm at 10 mm/s


class PrintMotion:
    """The motion of a print: holds until a path is begun, then a MotionStep that can be paused, or begun at home.

    Where material cannot flow, the nozzle waits above the surface as in a pause.

    last: the last command.
    planned: whether planner and guard made it.
    aside: whether the nozzle is to wait beside the print, for a look.
    """

    last: Command

    def __init__(
        self,
        profile: ArmProfile,
        clock: Clock,
        place: c_double,
        material: MaterialControl | None = None,
        lag_source: Callable[[], float] = lambda: math.nan,
        dry_reason: Callable[[], str] = str,
    ) -> None:
        """clock: of the dispensers. place: kept up to date, in checkpoints.

        lag_source: gives the arm's lag from set-point to answer, s, NaN while unknown; it is followed in steps.
        dry_reason: gives why material cannot flow now, "" where it can.
        """
        self._profile, self._clock, self._place = profile, clock, place
        self._material, self._lag_source, self._dry_reason = material, lag_source, dry_reason
        self.last = Hold(clock.now(), profile.limits.pause, WAITING_REASON)
        self.aside = False
        self._shares: list[FlowShares] = []
        self._step: MotionStep | None = None
        self._begin: Callable[[float], MotionStep] | None = None  # the step at a place on the path
        self.paused = self.planned = False

    def begin(
        self, path: Path, profile: ArmProfile, start: float, outlets: Outlets, tissue: TissueGuard | None = None
    ) -> None:
        """Print this path, surface frame, from now on. start: place on it, in checkpoints. tissue: see `MotionStep`."""
        self._shares = []
        self._begin = lambda place: MotionStep(path, profile, place, outlets, tissue)
        self._start_step(start)

    def follow(self, order: PauseOrder | BeginPrint | FlowShares) -> None:
        """Follow an order for the motion."""
        if isinstance(order, BeginPrint):
            self.begin(order.path, order.profile, order.start, order.outlets, order.tissue)
        elif isinstance(order, FlowShares):
            self.adapt(order)
        elif order is PauseOrder.PAUSE:
            self.paused = True
        elif order is PauseOrder.RESUME:
            self.resume()
        elif order is PauseOrder.LOOK:
            self.look()
        else:
            self.put_in()

    def homed(self) -> None:
        """Begin again at the same place of the path: the arm is at home."""
        if self._step is not None:
            self._start_step(self._step.progress.fraction)

    def resume(self) -> None:
        """Go on after a pause, with the dispenser prepared again."""
        self.paused = self.aside = False
        self._prepare_material()

    def look(self) -> None:
        """Step aside in a pause for a look at the print, until `put_in` is called."""
        self.aside = self.paused

    def adapt(self, shares: FlowShares) -> None:
        """Change the flow on some segments, also if the path is begun again at home."""
        if self._step is not None:
            self._shares.append(shares)
            self._step.adapt(shares)

    def put_in(self) -> None:
        """The operator has put in the requested material, or the look is done."""
        if self.aside:
            self.aside = False
        elif self._step is not None and self._step.progress.wanted:
            self._step.material_in()
            self._prepare_material()

    def recalled(self, place: Array, stands: Array) -> None:
        """Go on from `stands` (6,), where the arm stands after a stop at `place` (6,) on its way."""
        if self._step is not None:
            self._step.recalled(place, stands)

    @property
    def arm_lag(self) -> float:
        """The arm's lag in use, s; NaN before a path was begun."""
        return math.nan if self._step is None else self._step.lag

    @property
    def progress(self) -> PrintProgress | None:
        """How far the print is; None before a path was begun."""
        return None if self._step is None else self._step.progress

    def __call__(self, pose: SurfacePose | None, now: float) -> Command:
        """The command of the tick at `now`, s."""
        self.planned = self._step is not None
        if self._step is None:
            self.last = Hold(now, self._profile.limits.pause, WAITING_REASON)
            return self.last
        dry_reason = self._dry_reason()
        self._step.paused = waiting = self.paused or bool(dry_reason)
        self._step.aside = self.aside
        measured = self._lag_source()
        lag = self._step.lag if math.isnan(measured) else measured_lag(self._profile, measured)
        if abs(lag - self._step.lag) > LAG_STEP:
            self._step.lag = lag
        self.last = self._step(pose, now)
        if waiting and isinstance(self.last, Hold) and self.last.reason != LOOKS:
            self.last = replace(self.last, reason=PAUSED_REASON if self.paused else dry_reason)
        self._place.value = self._step.progress.fraction
        return self.last

    def _start_step(self, start: float) -> None:
        assert self._begin is not None
        self._step = self._begin(start)
        for shares in self._shares:
            self._step.adapt(shares)
        self._place.value = start
        self._prepare_material()

    def _prepare_material(self) -> None:
        if self._step is not None and self._material is not None and not self._step.progress.wanted:
            self._material.begin(self._step.progress.fraction, self._clock.now())
