"""Statistics of a run, and its outcome at the end: message, exit code, summary.json and report.html.

The statistics take the same memory however long the run lasts. The modules of reports are loaded once the arm rests.
"""

from __future__ import annotations

import json
import re
import signal
from collections import Counter, deque
from dataclasses import dataclass, field, replace
from html import escape
from math import nan
from shlex import quote
from typing import Any

import numpy as np

from estimation.pose import SurfacePose
from estimation.se3 import Array
from hardware.arm.profile import ArmProfile
from hardware.live import records
from hardware.live.checklist import checks_table
from hardware.live.prepared import Prepared
from hardware.live.state_machine import RunStateMachine
from hardware.motion.step import predicted_error
from hardware.operator.shared_state import PagePictures
from hardware.operator.view import NORMAL_95, HoldRow, RunResult, RunStage
from hardware.process.clock import Histogram
from hardware.process.system import provenance
from planning.command import Move
from planning.path import Path, PrintPhase, ways_along

_NUMBER_PATTERN = re.compile(r"(?<![\w.])-?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?")
MAX_REASONS, OTHER_REASONS = 40, "other reasons"  # kinds of holds that are counted apart, and the name of the rest
ERROR_BIN, ERROR_BINS = 0.005, 400  # mm of a bin, and how many
STRETCHES = 500  # of equal checkpoints, of each of which the largest error is kept: 0.2 % of the path
MAX_TICK_GAP = 0.5  # s from tick to tick that is counted: nobody knows what happened in a longer gap
MAX_SHOWN_HOLDS = 12  # reasons on the page's end, the longest first
EXIT_DONE, EXIT_CUT_SHORT, EXIT_SIGNAL = 0, 1, 128
BEADS_CAPTION = "The path from above, by the largest predicted error (95 %) of each stretch while material left."
TRACK_CAPTION = "Where the nozzle was led on the surface while material left, as it was tracked, over the path."
TIMELINE_CAPTION = """How far the nozzle was to be off at most, in 95 % of cases, over the seconds since the approach.
Beyond the limit the surface alone may be known too badly to print on."""
UNDER_WAY = RunStage.APPROACH, RunStage.PRINT, RunStage.PAUSED, RunStage.STOPPED  # whose time counts
POSES_KEPT = 4  # the motion's last pose is among so many of the newest


@dataclass(slots=True)
class RunStatistics:
    """Sums of a run."""

    stages: dict[str, float] = field(default_factory=dict)  # s in each stage
    states: Counter[str] = field(default_factory=Counter)  # frame sets in each state of the tracker
    holds: dict[str, HoldRow] = field(default_factory=dict)  # by reason, its numbers left out
    extruding: float = 0.0  # s in which material left
    printing: float = 0.0  # s in which it should have left
    times: records.StageHistograms = field(default_factory=records.StageHistograms)
    errors: Histogram = field(default_factory=lambda: Histogram(ERROR_BIN, ERROR_BINS))  # predicted at the nozzle, mm
    largest: float = nan  # mm, claim
    true_errors: Histogram = field(default_factory=lambda: Histogram(ERROR_BIN, ERROR_BINS))  # of a simulated world, mm
    claimed: int = 0  # true errors for which there was a claim
    covered: int = 0  # of those, within the claim
    claim: float = nan  # mm, of the last tick; NaN where no material left
    last_error: float = nan  # mm, the newest claim
    last_sigma: float = nan  # mm, of the surface alone, as the guard limits it
    error_stamp: float = nan  # s, of both
    ink: float = 0.0  # mm^3, commanded to the dispensers
    stretches: Array = field(default_factory=lambda: np.full(STRETCHES, np.nan))  # mm, largest error of each
    timeline: records.ErrorTimeline = field(default_factory=records.ErrorTimeline)
    track: records.NozzleTrack = field(default_factory=records.NozzleTrack)  # on the surface, while material left
    _followed: tuple[ArmProfile, Path] | None = None  # arm, and path that it follows, in the tracker's surface frame
    _poses: deque[SurfacePose] = field(default_factory=lambda: deque(maxlen=POSES_KEPT))
    _update_time: float = nan
    _tick_stamp: float = nan
    _sets: int = 0
    _reason: str = ""

    def begin(self, path: Path, profile: ArmProfile) -> None:
        """Judge moves by the path (tracker's surface frame) that the nozzle follows from now on."""
        self._followed = profile, path

    def update(self, now: float, stage: RunStage, reports: records.RunReports) -> None:
        """Count the newest reports at `now`, s."""
        if not np.isnan(self._update_time):
            self.stages[stage.value] = self.stages.get(stage.value, 0.0) + now - self._update_time
        self._update_time = now
        if (tracking := reports.tracking) is not None and tracking.pose is not None and tracking.sets != self._sets:
            self._sets = tracking.sets
            self._poses.append(tracking.pose)
            self.states[tracking.pose.state.value] += 1
        if reports.motion is not None and reports.motion.tick.stamp != self._tick_stamp:
            self._tick(reports.motion, stage)

    def add_true_error(self, error: float, claim: float = nan) -> None:
        """Count the true error at the nozzle in a simulated world, and its claim, both mm; NaN: unknown."""
        if not np.isnan(error):
            self.true_errors.add(error)
            self.claimed, self.covered = self.claimed + (not np.isnan(claim)), self.covered + (error <= claim)

    @property
    def coverage(self) -> float:
        """Share of the true errors that were within their claim; NaN where none is known."""
        return self.covered / self.claimed if self.claimed else nan

    @property
    def predicted(self) -> dict[str, float]:
        """The predicted error over the run, mm: median and 95 % of all cases, and the largest claim."""
        return self.errors.summary | {"max": self.largest}

    @property
    def active(self) -> float:
        """Seconds in the stages from the approach on: approaching, printing, paused or stopped."""
        return sum(self.stages.get(stage.value, 0.0) for stage in UNDER_WAY)

    @property
    def holds_by_time(self) -> list[HoldRow]:
        """The holds by reason, the longest first."""
        return sorted(self.holds.values(), key=lambda row: -row.seconds)

    @property
    def duty(self) -> float:
        """Share of the time since printing began in which material left; NaN before."""
        return self.extruding / self.printing if self.printing > 0 else nan

    def _tick(self, motion: records.LiveMotionReport, stage: RunStage) -> None:
        previous, self._tick_stamp, self.claim = self._tick_stamp, motion.tick.stamp, nan
        step = min(self._tick_stamp - previous, MAX_TICK_GAP) if not np.isnan(previous) else 0.0
        command, progress = motion.tick.command, motion.progress
        if progress is None or stage not in UNDER_WAY:
            return
        if reason := _NUMBER_PATTERN.sub("…", command.reason):
            hold_name = reason if reason in self.holds or len(self.holds) < MAX_REASONS else OTHER_REASONS
            hold = self.holds.setdefault(hold_name, HoldRow(hold_name))
            hold.count += hold_name != self._reason
            hold.seconds += step
        self._reason = reason
        if progress.place > 0 and progress.phase not in (PrintPhase.LEAVING, PrintPhase.FINISHED):
            self.printing += step
        if isinstance(command, Move) and command.extrude:
            self.extruding += step
            self.ink += command.flow * step
            self._claim(motion, command, progress.fraction)
            stretch = min(int(STRETCHES * progress.fraction / max(progress.total - 1, 1)), STRETCHES - 1)
            self.stretches[stretch] = np.fmax(self.stretches[stretch], self.claim)
        else:
            self.track.lift()
        self.timeline.add(self._tick_stamp, self.claim, step if reason else 0.0)

    def _claim(self, motion: records.LiveMotionReport, move: Move, fraction: float) -> None:
        """Enter the predicted error after this move, by the pose from which the move was computed."""
        pose = next((pose for pose in reversed(self._poses) if pose.stamp <= motion.pose_stamp), None)
        if pose is None or self._followed is None:
            return
        arrival = motion.tick.stamp + self._followed[0].tick + motion.lag
        prediction = predicted_error(move, arrival, pose, *self._followed, fraction)
        self.track.add(prediction.tip)
        for radius in prediction.radii.tolist():
            self.errors.add(radius)
        self.claim = self.last_error = prediction.within
        self.largest = float(np.fmax(self.largest, prediction.within))
        self.last_sigma, self.error_stamp = prediction.sigma, move.stamp


@dataclass(frozen=True, slots=True, eq=False)
class RunOutcome:
    """The outcome of a run."""

    prepared: Prepared
    machine: RunStateMachine
    statistics: RunStatistics
    reports: records.RunReports
    signal: int  # that ended it, 0 without
    fraction: float  # place on the path, counted in checkpoints, NaN before any
    pictures: PagePictures | None = None  # the last on the page
    written: bool = False  # whether the report is written

    @property
    def code(self) -> int:
        """0 where the path is printed, 128 and the signal's number where one ended it, else 1."""
        if self.machine.done:
            return EXIT_DONE
        return EXIT_SIGNAL + self.signal if self.signal else EXIT_CUT_SHORT

    @property
    def place(self) -> float:
        """Place up to which the path is printed, in checkpoints, earlier runs included."""
        return self.fraction if self.fraction == self.fraction else self.prepared.task.start

    @property
    def printed(self) -> float:
        """The same as a share of the path's length, 0 to 1; 0 in a dry run."""
        return self._share(self.place)

    @property
    def printed_before(self) -> float:
        """The share of it that earlier runs printed."""
        return self._share(self.prepared.task.start)

    def _share(self, place: float) -> float:
        """Share of the path's length, 0 to 1, up to a place in checkpoints; 0 in a dry run."""
        path, dry = self.prepared.task.path, self.prepared.task.lift is not None
        ways = ways_along(path.surface_from_nozzle)
        return 0.0 if dry or not ways[-1] > 0 else float(np.interp(place, np.arange(len(path)), ways) / ways[-1])

    @property
    def recorded(self) -> bool:
        """Whether there is a recording: a run that ended while its processes loaded has none."""
        return self.reports.recorder is not None and self.reports.recorder.written > 0

    @property
    def again(self) -> str:
        """The command that resumes the run; "" where nothing is left to print, nothing was recorded, or it was dry."""
        task = self.prepared.task
        resumable = not self.machine.done and task.lift is None and self.place < len(task.path) - 1 and self.recorded
        return f"stillbed live --resume {quote(str(self.prepared.files.record))}" if resumable else ""

    def result(self) -> RunResult:
        """For the operator's page."""
        task, statistics, files = self.prepared.task, self.statistics, self.prepared.files
        tails = [(p["p95"], p["max"]) for p in (statistics.predicted, statistics.true_errors.summary)]
        return RunResult(
            printed=self.printed,
            fraction=self.place,
            total=len(task.path) - 1,
            begun=task.start,
            seconds=statistics.active,
            duty=statistics.duty,
            error=tails[0],
            true_error=tails[1],
            ink=statistics.ink if self.prepared.inked else nan,
            holds=tuple(statistics.holds_by_time[:MAX_SHOWN_HOLDS]),
            stretches=tuple(statistics.stretches.tolist()),
            record=str(files.record),
            report=str(files.report) if self.written else "",
            again=self.again,
        )

    @property
    def words(self) -> str:
        """What happened, and how to go on."""
        total, files = len(self.prepared.task.path) - 1, self.prepared.files
        lines = [self.machine.ended]
        if not self.machine.done:
            dry = self.prepared.task.lift is not None
            state = "were passed by, none printed" if dry else "are printed"
            lines.append(f"{self.place:.2f} of {total} checkpoints {state}; the arm is at rest")
            if not dry:
                hint = "the path is printed; there is nothing to go on with"
                if not self.recorded:
                    hint = "nothing was recorded yet: begin it again as before"
                lines.append(f"go on with: {self.again}" if self.again else hint)
        return "\n".join([*lines, *self.reports.gaps, f"report: {files.report}"])

    def write(self) -> RunOutcome:
        """Write summary.json and report.html; returns the outcome with `written` set."""
        summary, files = self.summary(), self.prepared.files
        files.summary.write_text(json.dumps(summary, indent=2) + "\n", encoding="utf-8")
        files.report.write_text(self._page(summary), encoding="utf-8")
        return replace(self, written=True)

    def timings(self) -> tuple[records.StageTiming, ...]:
        """All stages that were timed."""
        tracking, motion = self.reports.tracking, self.reports.motion
        tracked = () if tracking is None else tracking.timings
        return (*tracked, *(() if motion is None else motion.timings), *self.statistics.times.timings())

    def summary(self) -> dict[str, Any]:
        """The figures as plain values."""
        from hardware.report.evaluation import finite

        statistics, reports, task = self.statistics, self.reports, self.prepared.task
        tracking, motion, recorder = reports.tracking, reports.motion, reports.recorder
        cleaned: dict[str, Any] = finite(
            {
                "ended": self.machine.ended,
                "done": self.machine.done,
                "signal": signal.Signals(self.signal).name if self.signal else None,
                "notes": list(self.prepared.notes),
                "checkpoints": len(task.path),
                "started_at": task.start,
                "fraction": self.fraction,
                "duty": statistics.duty,
                "extruding_s": statistics.extruding,
                "predicted_error_mm": statistics.predicted,
                "true_error_mm": statistics.true_errors.summary,
                "within_claim": statistics.coverage,
                "ink_mm3": statistics.ink if self.prepared.inked else None,
                "printed_share": self.printed,
                "stages_s": statistics.stages,
                "states": statistics.states,
                "holds": [
                    {"reason": row.reason, "count": row.count, "total_s": row.seconds}
                    for row in statistics.holds_by_time
                ],
                "latency_ms": {
                    t.name: {"count": t.count, "p50": 1000 * t.median, "p99": 1000 * t.p99, "max": 1000 * t.largest}
                    for t in self.timings()
                },
                "frame_sets": 0 if tracking is None else tracking.sets,
                "frame_sets_dropped": 0 if tracking is None else tracking.dropped,
                "ticks_skipped": 0 if motion is None else motion.skipped,
                "unrecorded": reports.unrecorded,
                "recorded_bytes": 0 if recorder is None else recorder.written,
                "recorder_share_of_core": None if recorder is None else recorder.share,
            }
        )
        return cleaned | {"provenance": provenance().table()}

    def _page(self, summary: dict[str, Any]) -> str:
        from hardware.report.evaluation import figure, percent
        from hardware.report.page import document, figures_table, row_of_tiles, section, tile
        from hardware.report.report import bead_map, error_timeline

        duty, task, timeline = self.statistics.duty, self.prepared.task, self.statistics.timeline
        limit, count, coverage = task.profile.limits.pose_error, len(timeline.stamps), self.statistics.coverage
        tiles = [
            tile(percent(self.printed), "", f"printed, checkpoint {self.place:.1f} of {len(task.path) - 1}"),
            tile(percent(duty) if duty == duty else "–", "", "duty cycle"),
        ]
        for name in ("true", "predicted"):
            if (error := summary[f"{name}_error_mm"])["p95"] is not None:
                values = f"{figure(error['p95'])} / {figure(error['max'])}"
                tiles.append(tile(values, "mm", f"{name} error, 95 % / largest"))
        coverage_tile = tile(percent(coverage), "", "of the true errors within the predicted 95 % bound")
        tiles += [coverage_tile] if coverage == coverage else []
        tiles += [tile(figure(self.statistics.ink), "mm³", "of ink")] if self.prepared.inked else []
        tiles += [tile(percent(self.printed_before), "", "printed by earlier runs")] if task.start else []
        rows = [
            [s.name, str(s.count), *(f"{1000 * seconds:.1f}" for seconds in (s.median, s.p99, s.largest))]
            for s in self.timings()
        ]
        holds = [[hold["reason"], str(hold["count"]), f"{hold['total_s']:.2f}"] for hold in summary["holds"]]
        stages = [[name, f"{seconds:.1f}"] for name, seconds in self.statistics.stages.items()]
        states = [[name, str(count)] for name, count in self.statistics.states.items()]
        checks = f"<pre>{escape(checks_table(self.machine.checks))}</pre>" if self.machine.checks else ""
        timings = figures_table(("stage", "times", "median", "99 %", "largest"), rows)
        reasons = figures_table(("what", "times", "s"), [*holds, *self._other_times()], last_total=True)
        bins = timeline.error[:count], timeline.held[:count] > timeline.width / 2, timeline.width
        timeline_chart = error_timeline(*bins, NORMAL_95 * limit)
        points = task.path.surface_from_nozzle[:, :3, 3]
        beads = bead_map(points, task.path.extrude, self.statistics.stretches, limit)
        body = [
            row_of_tiles(tiles),
            section("Error at the nozzle", TIMELINE_CAPTION, timeline_chart),
            section("Beads", BEADS_CAPTION, beads),
            *self._track_section(),
            *self._look_section(),
            *self._picture_section(),
            section("How long each stage took", "Milliseconds.", timings),
            section("Holds", "Why the nozzle stood, and all other time since the approach began.", reasons),
            section("Stages", "Of the run.", figures_table(("stage", "s"), stages)),
            section("States", "Of the tracked surface.", figures_table(("state", "frame sets"), states)),
            section("Check", "As it was last.", checks),
        ]
        lead = f"{self.machine.ended}. {'. '.join((*self.prepared.notes, *self.reports.gaps))}"
        return document("live run", self.prepared.files.record.stem, lead, body, "stillbed")

    def _track_section(self) -> list[str]:
        """The nozzle's track over the surface, where it printed and the path is placed."""
        from hardware.report.page import section
        from hardware.report.report import track_map

        track, placed_path = self.statistics.track.places, self.machine.placed_path
        if placed_path is None or not len(track):
            return []
        points, extrude = placed_path.path.surface_from_nozzle[:, :3, 3], placed_path.path.extrude
        return [section("Nozzle track", TRACK_CAPTION, track_map(track, points, extrude))]

    def _look_section(self) -> list[str]:
        """Results of the looks between layers and of those that the operator requested."""
        if not self.prepared.task.looks or self.machine.placed_path is None:
            return []
        from hardware.offline.looks import looks_section, read_looks

        section = looks_section(read_looks(self.prepared.files.record), self.machine.placed_path.path)
        return [section] if section else []

    def _picture_section(self) -> list[str]:
        from hardware.report.page import camera_pictures, section

        if self.pictures is None or not self.pictures.pictures:
            return []
        pictures = [(picture.camera, picture.near or picture.jpeg) for picture in self.pictures.pictures]
        return [section("What the cameras saw", "As the page showed it last.", camera_pictures(pictures))]

    def _other_times(self) -> list[list[str]]:
        """Rows of the time that is no hold, and of the sum."""
        statistics, hold_time = self.statistics, sum(row.seconds for row in self.statistics.holds_by_time)
        travel = max(statistics.active - hold_time - statistics.extruding, 0.0)
        times = {"material left": statistics.extruding, "on the way without material": travel}
        times["since the approach"] = hold_time + statistics.extruding + travel
        return [[name, "", f"{seconds:.2f}"] for name, seconds in times.items()]
