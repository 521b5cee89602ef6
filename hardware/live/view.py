"""The run as its operator's page shows it, made of the reports a few times a second."""

from __future__ import annotations

from dataclasses import dataclass, field
from math import nan

import numpy as np

from estimation.se3 import Array
from hardware.arm.profile import ArmProfile
from hardware.arm_status import ArmState
from hardware.live.motion_names import FRAMES_TO_WIRE
from hardware.live.prepared import Prepared
from hardware.live.records import LiveMotionReport, TrackingReport
from hardware.live.stages import QUESTIONS
from hardware.live.state_machine import Conductor, Seen
from hardware.live.tally import Tally
from hardware.live.true_error import TrueError
from hardware.operator.view import (
    Activity,
    CameraView,
    LatencyView,
    MotionView,
    OperatorView,
    ProgressView,
    Stage,
    TrackingView,
    Verdict,
    tracking_from_pose,
)
from planning.command import Hold, Move
from planning.kinematics import nozzle_from_axes
from planning.path import Path, lengths
from planning.progress import Phase

LATENCY = 0.035  # s from frames to the wire that 99 % are to keep
FLIGHT = 0.05  # s of motion that may be under way
FRESH = 1.0  # s without a picture, after which a camera counts as gone
RATE = 0.9  # share of the last rate that is kept when it is smoothed
ACTIVITIES = {
    Phase.ENTERING: Activity.ENTERING,
    Phase.LEAVING: Activity.LEAVING,
    Phase.RETREATING: Activity.LEAVING,
}


@dataclass(slots=True)
class Viewer:
    """Makes views; remembers what a rate needs."""

    prepared: Prepared
    _true: TrueError = field(init=False)
    _times: Array = field(default_factory=lambda: np.zeros(0))  # (N,) s from each checkpoint to the end
    _sets: tuple[float, int] = (nan, 0)
    _rate: float = nan

    def __post_init__(self) -> None:
        self._true = TrueError(self.prepared.task.path)

    def look(self, seen: Seen, profile: ArmProfile | None) -> None:
        """Note what only shows from one look to the next. profile: of the arm, as it is used."""
        self._true.look(seen.tracking, seen.motion, profile)

    def __call__(self, now: float, conductor: Conductor, seen: Seen, tally: Tally) -> OperatorView:
        """The view at `now`, s."""
        motion, tracking = seen.motion, seen.tracking
        return OperatorView(
            stamp=now,
            turn=conductor.turn,
            stage=conductor.stage,
            question=QUESTIONS.get(conductor.stage, ""),
            reason=conductor.missed or conductor.reason,
            offers=conductor.offers,
            checks=conductor.checks,
            tracking=None if tracking is None else _tracking(tracking, now),
            motion=None if motion is None else self._motion(motion, conductor, tally),
            progress=None if motion is None else self._progress(motion, tally),
            latency=None if motion is None else _latency(motion),
            cameras=() if tracking is None else self._cameras(tracking, now),
            answer=conductor.answer,
            notes=self.prepared.notes,
            events=() if motion is None else tuple(event.text for event in motion.events),
        )

    def _motion(self, motion: LiveMotionReport, conductor: Conductor, tally: Tally) -> MotionView:
        status, command = motion.tick.status, motion.tick.command
        laid, profile = conductor.laid, self.prepared.task.profile
        known = laid is not None and status.axes is not None
        return MotionView(
            activity=_activity(motion, conductor.stage),
            reason=conductor.missed or command.reason,
            error=tally.last_error,
            limit=profile.limits.pose_error,
            true_error=self._true.last,
            in_flight=status.in_flight,
            most_in_flight=FLIGHT,
            base_from_nozzle=nozzle_from_axes(laid.profile.arm, status.axes) if known else None,  # type: ignore[union-attr,arg-type]
            arm=f"{status.state.value}: {status.reason}",
            speed=command.feed if isinstance(command, Move) else 0.0,
        )

    def _progress(self, motion: LiveMotionReport, tally: Tally) -> ProgressView | None:
        progress, path = motion.progress, self.prepared.task.path
        if progress is None:
            return None
        if not len(self._times):
            self._times = _times_left(path)
        left = float(np.interp(progress.fraction, np.arange(len(path)), self._times))
        layers = np.unique(path.layer)
        layer = int(np.searchsorted(layers, path.layer[min(progress.checkpoint, len(path) - 1)])) + 1
        share = progress.place / progress.length if progress.length > 0 else nan
        return ProgressView(progress.fraction, progress.total - 1, share, left, tally.duty, layer, len(layers))

    def _cameras(self, tracking: TrackingReport, now: float) -> tuple[CameraView, ...]:
        stamp, sets = self._sets
        if tracking.sets > sets and tracking.stamp > stamp:
            rate = (tracking.sets - sets) / (tracking.stamp - stamp)
            self._rate = rate if np.isnan(self._rate) else RATE * self._rate + (1 - RATE) * rate
        if tracking.sets > sets or np.isnan(stamp):
            self._sets = tracking.stamp, tracking.sets
        late = tracking.pose is None or now - tracking.pose.stamp > FRESH
        views = []
        for camera, name in enumerate(tracking.cameras):
            there = camera in tracking.seen and not late
            tracks = tracking.used[camera] if camera < len(tracking.used) else 0
            verdict, words = (Verdict.PASS, "") if there else (Verdict.FAIL, "no pictures")
            views.append(CameraView(name, verdict, self._rate if there else 0.0, tracks, words))
        return tuple(views)


def _tracking(report: TrackingReport, now: float) -> TrackingView | None:
    return None if report.pose is None else tracking_from_pose(report.pose, now, sum(report.used))


def _latency(motion: LiveMotionReport) -> LatencyView | None:
    for span in motion.spans:
        if span.name == FRAMES_TO_WIRE:
            return LatencyView(span.median, span.p99, LATENCY)
    return None


def _activity(motion: LiveMotionReport, stage: Stage) -> Activity:
    if stage is Stage.HOMING:
        return Activity.HOMING
    if motion.tick.status.state is not ArmState.ARMED or motion.progress is None:
        return Activity.RESTING
    command = motion.tick.command
    if isinstance(command, Hold):
        return Activity.HOLDING
    if motion.progress.phase is Phase.PRINTING:
        return Activity.PRINTING if command.extrude else Activity.TRAVELLING
    return ACTIVITIES.get(motion.progress.phase, Activity.HOLDING)


def _times_left(path: Path) -> Array:
    """Seconds (N,) from each checkpoint to the end at the path's own speeds."""
    each = lengths(path.surface_from_nozzle) / path.speed[1:]
    return np.asarray(np.concatenate([np.cumsum(each[::-1])[::-1], [0.0]]))
