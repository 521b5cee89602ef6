"""What a run shows: views for the operator's page, and lines and keys of the terminal."""

from __future__ import annotations

import os
import sys
import termios
import tty
from collections import deque
from contextlib import suppress
from dataclasses import dataclass, field
from math import inf, nan
from typing import Any

import numpy as np

from estimation import se3
from estimation.pose import TrackState
from estimation.se3 import Array
from hardware.arm.device import ArmState
from hardware.arm.profile import ArmProfile
from hardware.live.checklist import MAX_PICTURE_AGE
from hardware.live.outcome import RunStatistics
from hardware.live.prepared import Prepared
from hardware.live.records import FRAMES_TO_WIRE_STAGE, LiveMotionReport, RunReports, TrackingReport
from hardware.live.state_machine import RunStateMachine
from hardware.operator.view import (
    DRAW_QUESTION,
    WISH_KEYS,
    WISH_WORDS,
    Activity,
    CameraView,
    CheckVerdict,
    LatencyView,
    LogLine,
    MotionView,
    OperatorView,
    PlacementView,
    ProgressView,
    RestView,
    RunResult,
    RunStage,
    TrackingView,
    Wish,
    hold_cause,
    tracking_from_pose,
)
from hardware.process.progress import TimeLeft
from hardware.report.page import open_in_browser
from planning.command import Hold, Move
from planning.kinematics import nozzle_from_axes
from planning.motion.retime import run_times
from planning.path import Path, PrintPhase, ways_along
from planning.placement import tangent_of

MAX_COMMANDS_KEPT = 64  # a second of them
MAX_COMMAND_GAP = 0.1  # s between two commands that a straight line joins
MAX_LATENCY = 0.035  # s from frames to the wire that 99 % are to keep
MAX_IN_FLIGHT = 0.05  # s of motion that may be under way
RATE_DECAY = 0.9  # share of the last rate that is kept when it is smoothed
MAX_KEYS_READ = 100  # at once
PHASE_ACTIVITIES = {
    PrintPhase.ENTERING: Activity.ENTERING,
    PrintPhase.LEAVING: Activity.LEAVING,
    PrintPhase.RETREATING: Activity.LEAVING,
}
OTHER_KEYS = {key: wish for wish, key in WISH_KEYS.items() if wish is not Wish.STOP}
ACTION_KEYS = dict.fromkeys(" \r\n", Wish.STOP) | OTHER_KEYS
KEYS_HELP = "   ".join(
    f"{'space or Enter' if wish is Wish.STOP else key}: {WISH_WORDS[wish]}" for wish, key in WISH_KEYS.items()
)
LOG_LINES = 16  # newest ones in each view: the page keeps what it was sent before
REST_SPAN = 10.0  # s over which the surface's movement under a resting nozzle is measured: two breaths
MIN_REST_POINTS = 4  # of it


@dataclass(slots=True)
class NozzleErrorEstimate:
    """The true error at the nozzle in a simulated world, by dead reckoning during the run.

    The truth comes with a picture, later than the commands for its instant: so the last commands are kept until then.
    """

    path: Path  # as its file has it, in the true surface frame
    last: float = nan  # mm, NaN while it is unknown or nothing is printed
    claimed: float = nan  # mm, its predicted 95 % bound; NaN without
    _commands: deque[tuple[float, Array, float, float]] = field(default_factory=lambda: deque(maxlen=MAX_COMMANDS_KEPT))
    compared: float = nan  # s, stamp of the last pose that it was compared at
    _tick_stamp: float = nan  # s, stamp of the last tick

    def update(self, reports: RunReports, profile: ArmProfile | None, claim: float = nan) -> None:
        """Take what is new. profile: of the arm since the path was begun; None before. claim: mm, of the last tick."""
        tracking, motion = reports.tracking, reports.motion
        if profile is None or motion is None or tracking is None or tracking.truth is None or tracking.pose is None:
            return
        if motion.tick.stamp != self._tick_stamp:
            self._tick_stamp, command = motion.tick.stamp, motion.tick.command
            if isinstance(command, Move) and command.extrude and motion.progress is not None:
                arrival = command.stamp + profile.tick + profile.lag
                self._commands.append((arrival, command.axes, motion.progress.fraction, claim))
        if tracking.pose.stamp != self.compared:
            self.compared = tracking.pose.stamp
            self.last = self._error(tracking.pose.stamp, tracking.truth, profile)

    def _error(self, stamp: float, base_from_surface: Array, profile: ArmProfile) -> float:
        """Distance, mm, from the nozzle to its place at `stamp`, s; NaN where it was not printing then."""
        self.claimed = nan
        number = next((i for i, (arrival, *_) in enumerate(self._commands) if arrival >= stamp), 0)
        if not number or self._commands[number][0] - self._commands[number - 1][0] > MAX_COMMAND_GAP:
            return nan
        (begin, axes, place, _), following = self._commands[number - 1], self._commands[number]
        end, next_axes, next_place, self.claimed = following
        share = (stamp - begin) / (end - begin)
        nozzle = nozzle_from_axes(profile.arm, axes + share * (next_axes - axes))
        position = (se3.inverse(base_from_surface) @ nozzle)[:3, 3]
        fraction, points = place + share * (next_place - place), self.path.surface_from_nozzle[:, :3, 3]
        target = [np.interp(fraction, np.arange(len(points)), points[:, k]) for k in range(3)]
        return float(np.linalg.norm(position - target))


@dataclass(slots=True)
class ViewBuilder:
    """Makes the views of a run for its operator's page."""

    prepared: Prepared
    _true_error: NozzleErrorEstimate = field(init=False)
    _remaining_times: Array = field(init=False)  # (N,) s from each checkpoint to the end
    _path_shares: Array = field(init=False)  # (N,) share of the path's length at each checkpoint
    _last_sets: tuple[float, int] = (nan, 0)  # stamp of the last report, s, and its frame sets
    _rate: float = nan  # frame sets per second, smoothed
    _time_left: TimeLeft = field(default_factory=TimeLeft)
    _log: deque[LogLine] = field(default_factory=lambda: deque(maxlen=LOG_LINES))
    _last_event: float = -inf  # s, stamp of the arm's last event that is in the log
    _rest_points: deque[tuple[float, Array, float]] = field(default_factory=deque)  # s, tip on the surface, height: mm

    def __post_init__(self) -> None:
        path, profile = self.prepared.task.path, self.prepared.task.profile
        self._true_error = NozzleErrorEstimate(path)
        times = run_times(path, profile.arm, profile.limits, profile.tick)  # 36,000 checkpoints take 1.5 s
        self._remaining_times = times[-1] - times
        ways = ways_along(path.surface_from_nozzle)
        self._path_shares = ways / max(float(ways[-1]), 1e-9)

    def update(self, reports: RunReports, profile: ArmProfile | None, claim: float) -> tuple[float, float]:
        """Take the newest reports; returns the true error at the nozzle and its claim, mm; NaN where none is new.

        profile: of the arm since the path was begun; None before. claim: mm, of the last tick.
        """
        for event in () if reports.motion is None else reports.motion.events:
            if event.stamp > self._last_event:
                self._last_event = event.stamp
                self.log(event.stamp, event.text)
        true_error, compared_before = self._true_error, self._true_error.compared
        true_error.update(reports, profile, claim)
        return (true_error.last, true_error.claimed) if true_error.compared != compared_before else (nan, nan)

    def log(self, stamp: float, text: str, warning: bool = False) -> None:
        """A line for the page's log."""
        number = self._log[-1].number + 1 if self._log else 1
        self._log.append(LogLine(number, stamp, warning, text))

    def __call__(
        self,
        now: float,
        machine: RunStateMachine,
        reports: RunReports,
        statistics: RunStatistics,
        result: RunResult | None = None,
    ) -> OperatorView:
        """The view at `now`, s. result: once the run is over."""
        motion, tracking = reports.motion, reports.tracking
        draws = tracking is not None and tracking.draws and machine.stage in (RunStage.CHECK, RunStage.FIND)
        estimate: TrackingView | None = None
        if tracking is not None and tracking.pose is not None:
            estimate = tracking_from_pose(tracking.pose, now, sum(tracking.used))
        return OperatorView(
            stamp=now,
            turn=machine.turn,
            stage=machine.stage,
            question=DRAW_QUESTION if draws else machine.question,
            reason=machine.silence or machine.reason,
            offers=machine.offers,
            checks=machine.checks,
            tracking=estimate,
            motion=None if motion is None else self._motion(now, motion, machine, reports, statistics),
            progress=self._progress(now, motion, machine, statistics),
            latency=None if motion is None else _latency(motion),
            cameras=() if tracking is None else self._cameras(tracking, now),
            answer=machine.answer,
            placement=self._placement(machine, tracking),
            notes=(*self.prepared.notes, *reports.gaps),
            log=tuple(self._log),
            result=result,
            draws=draws,
        )

    def _placement(self, machine: RunStateMachine, tracking: TrackingReport | None) -> PlacementView | None:
        placement = machine.placement
        if machine.stage is not RunStage.CONFIRM or placement is None:
            return None
        points = None if tracking is None else tracking.surface
        tangent = None if points is None else tangent_of(placement, self.prepared.task.path, points)
        validity = placement.certain, machine.moves > 0, machine.confirmable
        return PlacementView(placement.by.value, placement.verdict, *validity, tangent)

    def _motion(
        self,
        now: float,
        motion: LiveMotionReport,
        machine: RunStateMachine,
        reports: RunReports,
        statistics: RunStatistics,
    ) -> MotionView:
        status, command = motion.tick.status, motion.tick.command
        placed_path, base_from_nozzle = machine.placed_path, None
        if placed_path is not None and status.axes is not None:
            base_from_nozzle = nozzle_from_axes(placed_path.profile.arm, status.axes)
        return MotionView(
            activity=_activity(motion, machine.stage),
            reason=machine.silence or command.reason,
            error=statistics.last_error,
            sigma=statistics.last_sigma,
            limit=self.prepared.task.profile.limits.pose_error,
            true_error=self._true_error.last,
            in_flight=status.in_flight,
            most_in_flight=MAX_IN_FLIGHT,
            base_from_nozzle=base_from_nozzle,
            arm=f"{status.state.value}: {status.reason}",
            speed=command.feed if isinstance(command, Move) else 0.0,
            material="" if motion.material is None else motion.material.text,
            error_age=now - statistics.error_stamp,
            cause=hold_cause(command),
            rest=self._rest(motion, machine, reports.tracking, base_from_nozzle),
        )

    def _rest(
        self,
        motion: LiveMotionReport,
        machine: RunStateMachine,
        tracking: TrackingReport | None,
        base_from_nozzle: Array | None,
    ) -> RestView | None:
        """The surface's movement under a stopped or paused nozzle; None while the nozzle moves, or if unknown."""
        pose, placed_path = None if tracking is None else tracking.pose, machine.placed_path
        at_rest = machine.stage in (RunStage.STOPPED, RunStage.PAUSED) and isinstance(motion.tick.command, Hold)
        if not at_rest or pose is None or placed_path is None or base_from_nozzle is None:
            self._rest_points.clear()
            return None
        if pose.state.measured and (not self._rest_points or pose.stamp > self._rest_points[-1][0]):
            surface_from_nozzle, height = se3.inverse(pose.base_from_surface) @ base_from_nozzle, nan
            if motion.progress is not None:
                goal = placed_path.path.surface_from_nozzle[min(motion.progress.checkpoint, len(placed_path.path) - 1)]
                height = float((se3.inverse(goal) @ surface_from_nozzle)[2, 3])
            self._rest_points.append((pose.stamp, surface_from_nozzle[:3, 3], height))
        while self._rest_points and self._rest_points[-1][0] - self._rest_points[0][0] > REST_SPAN:
            self._rest_points.popleft()
        if len(self._rest_points) < MIN_REST_POINTS:
            return None
        places = np.array([place for _, place, _ in self._rest_points])
        excursion = (places - places.mean(0)) @ np.linalg.svd(places - places.mean(0), full_matrices=False)[2][0]
        seconds = self._rest_points[-1][0] - self._rest_points[0][0]
        return RestView(float(np.ptp(excursion)), seconds, float(np.mean([height for *_, height in self._rest_points])))

    def _progress(
        self, now: float, motion: LiveMotionReport | None, machine: RunStateMachine, statistics: RunStatistics
    ) -> ProgressView | None:
        """The progress; before a run that resumes goes on, the place where it will."""
        task, path = self.prepared.task, self.prepared.task.path
        progress = None if motion is None else motion.progress
        if progress is None and not task.start:
            return None
        fraction = task.start if progress is None else progress.fraction
        planned, checkpoint = float(np.interp(fraction, np.arange(len(path)), self._remaining_times)), int(fraction)
        self._time_left.add(now, planned, machine.stage in (RunStage.APPROACH, RunStage.PRINT))
        layers = np.unique(path.layer)
        layer = int(np.searchsorted(layers, path.layer[min(checkpoint + 1, len(path) - 1)])) + 1
        share = float(np.interp(fraction, np.arange(len(path)), self._path_shares))
        ink = statistics.ink if self.prepared.inked else nan
        time_left, spread = self._time_left(planned)
        place = fraction, len(path) - 1, share, time_left, spread
        return ProgressView(*place, statistics.duty, layer, len(layers), ink, task.start)

    def _cameras(self, tracking: TrackingReport, now: float) -> tuple[CameraView, ...]:
        stamp, sets = self._last_sets
        if tracking.sets > sets and tracking.stamp > stamp:
            rate = (tracking.sets - sets) / (tracking.stamp - stamp)
            self._rate = rate if np.isnan(self._rate) else RATE_DECAY * self._rate + (1 - RATE_DECAY) * rate
        if tracking.sets > sets or np.isnan(stamp):
            self._last_sets = tracking.stamp, tracking.sets
        outdated = tracking.pose is None or now - tracking.pose.stamp > MAX_PICTURE_AGE
        slow = tracking.pose is None or tracking.pose.state is TrackState.INITIALISING  # pictures are looked at slowly
        views = []
        for camera, name in enumerate(tracking.cameras):
            delivers = camera in tracking.delivering and not outdated
            tracks = tracking.used[camera] if camera < len(tracking.used) else 0
            verdict, text = (CheckVerdict.PASS, "") if delivers else (CheckVerdict.FAIL, "no pictures")
            if not delivers and slow:
                verdict, text = (
                    CheckVerdict.BUSY,
                    "first picture" if tracking.pose is None else "looking",
                )
            views.append(CameraView(name, verdict, self._rate if delivers else 0.0, tracks, text))
        return tuple(views)


def _latency(motion: LiveMotionReport) -> LatencyView | None:
    for timing in motion.timings:
        if timing.name == FRAMES_TO_WIRE_STAGE:
            return LatencyView(timing.median, timing.p99, MAX_LATENCY)
    return None


def _activity(motion: LiveMotionReport, stage: RunStage) -> Activity:
    if stage is RunStage.HOMING:
        return Activity.HOMING
    if motion.tick.status.state is not ArmState.ARMED or motion.progress is None:
        return Activity.RESTING
    command = motion.tick.command
    if isinstance(command, Hold):
        return Activity.HOLDING
    if motion.progress.phase is PrintPhase.PRINTING:
        return Activity.PRINTING if command.extrude else Activity.TRAVELLING
    return PHASE_ACTIVITIES.get(motion.progress.phase, Activity.HOLDING)


class Console:
    """Reads single keys of the terminal and writes lines; a closed or missing terminal is no error.

    file: to wait on, None where there is no terminal.
    """

    def __init__(self, opens: bool = False) -> None:
        """opens: whether the page is opened in a browser."""
        self._open_browser = opens
        self.file: int | None = None
        self._terminal_settings: list[Any] | None = None

    def __enter__(self) -> Console:
        with suppress(OSError, ValueError, termios.error):
            if sys.stdin is not None and os.isatty(sys.stdin.fileno()):
                self._terminal_settings = termios.tcgetattr(sys.stdin.fileno())
                tty.setcbreak(sys.stdin.fileno())
                self.file = sys.stdin.fileno()
        return self

    def __exit__(self, *_: object) -> None:
        if self._terminal_settings is not None:
            with suppress(OSError, ValueError, termios.error):
                termios.tcsetattr(sys.stdin.fileno(), termios.TCSADRAIN, self._terminal_settings)

    def wishes(self) -> list[Wish]:
        """The wishes of the keys that were pressed; a stop stands alone."""
        assert self.file is not None
        try:
            keys = os.read(self.file, MAX_KEYS_READ).decode(errors="replace")
        except OSError:
            keys = ""
        if not keys:  # the terminal is gone
            self.file = None
        wishes = [ACTION_KEYS[key] for key in keys if key in ACTION_KEYS]
        return [Wish.STOP] if Wish.STOP in wishes else wishes

    def offer_page(self, address: str) -> None:
        """Tell where the page is, and open it where that is wanted."""
        self.say(f"open {address} to see and operate the run")
        if self._open_browser and not open_in_browser(address):
            self.say("no browser could be opened: this system has no xdg-open")

    def say(self, text: str) -> None:
        """Write a line to standard error."""
        with suppress(OSError, ValueError):
            print(text, file=sys.stderr, flush=True)


def status_line(machine: RunStateMachine, reports: RunReports) -> str:
    """The run in one line: stage, place, state of the tracker and why the nozzle stands; in the check, what fails."""
    if machine.stage is RunStage.CHECK:
        unmet = [c for c in machine.checks if c.verdict in (CheckVerdict.BUSY, CheckVerdict.FAIL) and c.name != "reach"]
        return "check: " + "; ".join(f"{check.name}: {check.found}" for check in unmet)
    pose = None if reports.tracking is None else reports.tracking.pose
    state = "no pose" if pose is None else pose.state.value
    if machine.stage is RunStage.FIND and machine.placed_path is not None:
        return f"find: out of reach: {machine.placed_path.unreachable}"
    if reports.motion is None or reports.motion.progress is None:
        return f"{machine.stage.value}: {state}"
    progress, command = reports.motion.progress, reports.motion.tick.command
    suffix = f", holds: {command.reason}" if command.reason else ""
    if machine.silence:
        suffix = f", {machine.silence}"
    return f"{machine.stage.value}: {progress.fraction:.1f} of {progress.total - 1} checkpoints, {state}{suffix}"


def stage_line(stage: RunStage, reason: str) -> str:
    """The stage and its reason; a reason that begins with the stage's name says both."""
    if not reason or reason.startswith(stage.value):
        return reason or stage.value
    return f"{stage.value}: {reason}"
