"""What a run came to: its message, exit code, summary.json and report.html."""

from __future__ import annotations

import json
import signal
from dataclasses import dataclass
from html import escape
from typing import Any

import numpy as np

from hardware.live.checklist import table
from hardware.live.course import Course
from hardware.live.prepared import Prepared
from hardware.live.records import Span
from hardware.live.state_machine import Conductor, Seen
from hardware.live.tally import Tally
from hardware.page import area_key, document, figures_table, legend, line_key, row_of_tiles, section, tile
from hardware.report.page import Plot, spanning, stretches
from hardware.report.summary import figure, finite, percent

DONE, CUT_SHORT, SIGNALLED = 0, 1, 128
OVER = "Predicted, the largest of each moment while material left, over the seconds since the approach."


@dataclass(frozen=True, slots=True, eq=False)
class Outcome:
    """How a run ended. number: of the signal that ended it, 0 without. fraction: place on the path, NaN before any."""

    prepared: Prepared
    conductor: Conductor
    tally: Tally
    seen: Seen
    number: int
    fraction: float

    @property
    def code(self) -> int:
        """0 where the path is printed, 128 and the signal's number where one ended it, else 1."""
        if self.conductor.done:
            return DONE
        return SIGNALLED + self.number if self.number else CUT_SHORT

    @property
    def words(self) -> str:
        """What happened, and how to go on."""
        total, beside = len(self.prepared.task.path) - 1, self.prepared.beside
        lines = [self.conductor.ended]
        if not self.conductor.done:
            place = self.fraction if self.fraction == self.fraction else self.prepared.task.start
            dry = self.prepared.task.lift is not None
            done = "were passed by, none printed" if dry else "are printed"
            lines.append(f"{place:.2f} of {total} checkpoints {done}; the arm is at rest")
            if not dry:
                again = f"go on with: stillbed live --resume {beside.record}"
                lines.append("the path is printed; there is nothing to go on with" if place >= total else again)
        return "\n".join([*lines, f"report: {beside.report}"])

    def write(self) -> None:
        """Write summary.json and report.html."""
        summary, beside = self.summary(), self.prepared.beside
        beside.summary.write_text(json.dumps(summary, indent=2) + "\n", encoding="utf-8")
        beside.report.write_text(self._page(summary), encoding="utf-8")

    def spans(self) -> tuple[Span, ...]:
        """All stages that were timed."""
        tracking, motion = self.seen.tracking, self.seen.motion
        found = () if tracking is None else tracking.spans
        return (*found, *(() if motion is None else motion.spans), *self.tally.times.spans())

    def summary(self) -> dict[str, Any]:
        """The figures as plain values."""
        tally, seen, task = self.tally, self.seen, self.prepared.task
        tracking, motion, recorder = seen.tracking, seen.motion, seen.recorder
        cleaned: dict[str, Any] = finite(
            {
                "ended": self.conductor.ended,
                "done": self.conductor.done,
                "signal": signal.Signals(self.number).name if self.number else None,
                "notes": list(self.prepared.notes),
                "checkpoints": len(task.path),
                "started_at": task.start,
                "fraction": self.fraction,
                "duty": tally.duty,
                "extruding_s": tally.extruding,
                "predicted_error_mm": {"p50": tally.error(50), "p95": tally.error(95), "max": tally.most_error},
                "stages_s": tally.stages,
                "states": tally.states,
                "holds": [
                    {"reason": reason, "count": held.count, "total_s": held.seconds}
                    for reason, held in sorted(tally.holds.items(), key=lambda item: -item[1].seconds)
                ],
                "latency_ms": {
                    span.name: {
                        "count": span.count,
                        "p50": 1000 * span.median,
                        "p99": 1000 * span.p99,
                        "max": 1000 * span.most,
                    }
                    for span in self.spans()
                },
                "frame_sets": 0 if tracking is None else tracking.sets,
                "frame_sets_dropped": 0 if tracking is None else tracking.dropped,
                "ticks_skipped": 0 if motion is None else motion.skipped,
                "unrecorded": sum(report.unrecorded for report in (tracking, motion) if report is not None),
                "recorded_bytes": 0 if recorder is None else recorder.written,
                "recorder_share_of_core": None if recorder is None else recorder.share,
            }
        )
        return cleaned

    def _page(self, summary: dict[str, Any]) -> str:
        error, duty = summary["predicted_error_mm"], self.tally.duty
        tiles = [
            tile(f"{self.fraction:.1f}" if self.fraction == self.fraction else "0", "", "checkpoints printed"),
            tile(percent(duty) if duty == duty else "–", "", "of the time material left the nozzle"),
            tile(figure(error["p95"]) if error["p95"] is not None else "–", "mm", "predicted error, 95 %"),
        ]
        rows = [
            [s.name, str(s.count), *(f"{1000 * value:.1f}" for value in (s.median, s.p99, s.most))]
            for s in self.spans()
        ]
        holds = [[h["reason"], str(h["count"]), f"{h['total_s']:.2f}"] for h in summary["holds"]] or [
            ["none", "0", "0"]
        ]
        stages = [[name, f"{seconds:.1f}"] for name, seconds in self.tally.stages.items()]
        states = [[name, str(count)] for name, count in self.tally.states.items()]
        checks = f"<pre>{escape(table(self.conductor.checks))}</pre>" if self.conductor.checks else ""
        heads = ("stage", "times", "median", "99 %", "largest"), ("reason", "times", "s"), ("stage", "s")
        body = [
            row_of_tiles(tiles),
            section(
                "Error at the nozzle", OVER, _course(self.tally.course, self.prepared.task.profile.limits.pose_error)
            ),
            section("How long each stage took", "Milliseconds.", figures_table(heads[0], rows)),
            section("Holds", "Why the nozzle stood, and for how long.", figures_table(heads[1], holds)),
            section("Stages", "Of the run.", figures_table(heads[2], stages)),
            section("States", "Of the tracked surface.", figures_table(("state", "frame sets"), states)),
            section("Check", "As it was last.", checks),
        ]
        lead = f"{self.conductor.ended}. {'. '.join(self.prepared.notes)}"
        return document("live run", self.prepared.beside.record.stem, lead, body, "stillbed")


def _course(course: Course, limit: float) -> str:
    """The predicted error over the run, beside its limit, mm."""
    stamps = course.stamps
    error, held = course.error[: len(stamps)], course.held[: len(stamps)] > course.width / 2
    if not np.isfinite(error).any():
        return "<p>Nothing was extruded.</p>"
    end = len(stamps) * course.width
    plot = Plot(900, 220, (0.0, end), spanning([error, np.array([0.0, limit])]), label="predicted error, mm")
    runs = np.array([(run.start, run.stop) for run in stretches(held)], float).reshape(-1, 2) * course.width
    plot.shade(runs[:, 0], runs[:, 1], "holding")
    plot.level(limit, "limit", "limit")
    plot.line(stamps, error, "estimate")
    return legend([line_key("estimate", "predicted error"), area_key("holding", "held")]) + plot.svg()
