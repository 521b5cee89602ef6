"""The check before a run: cameras, calibration, arm, path, reach, recording; each passes, or says what to do."""

from __future__ import annotations

import numpy as np

from hardware.arm_status import ArmState
from hardware.live.laid import Laid
from hardware.live.records import LiveMotionReport, RecorderReport, TrackingReport
from hardware.operator.view import Check, Verdict
from hardware.process.progress import counted
from planning.path import Path

FRESH = 1.0  # s: pictures older than this do not come any more
PASS, FAIL, BUSY, WARN = Verdict.PASS, Verdict.FAIL, Verdict.BUSY, Verdict.WARN


def camera_checks(report: TrackingReport | None, now: float) -> tuple[Check, Check]:
    """Whether all cameras deliver, and what is known of their calibration."""
    if report is None or not report.cameras:
        return Check("cameras", BUSY, "the tracker starts"), Check("calibration", BUSY, "the tracker starts")
    calibration = Check("calibration", PASS, f"{len(report.cameras)} cameras, {', '.join(report.cameras)}")
    if report.pose is None:
        waits = "no pictures yet"
        return Check("cameras", BUSY, waits, "plug in the cameras, or see who else uses them"), calibration
    if (age := now - report.pose.stamp) > FRESH:
        return Check("cameras", FAIL, f"no pictures for {age:.1f} s", "plug in the cameras"), calibration
    missing = [name for i, name in enumerate(report.cameras) if i not in report.seen]
    if missing:
        verdict = WARN if len(report.seen) >= 2 else FAIL
        return Check(
            "cameras", verdict, f"without {', '.join(missing)}", "plug it in, or look at its lens"
        ), calibration
    return Check("cameras", PASS, f"all {len(report.cameras)} deliver"), calibration


def arm_check(report: LiveMotionReport | None, stands_home: bool) -> Check:
    """Whether the arm is there, and whether anybody knows where it stands."""
    if report is None:
        return Check("arm", BUSY, "its line is opened")
    status = report.tick.status
    if status.state is ArmState.UNPLUGGED:
        return Check("arm", FAIL, f"unplugged: {status.reason}", "plug it in and switch it on")
    if status.answered is None and not stands_home:
        remedy = "move it to its home by hand, then say so with --stands-home"
        return Check("arm", BUSY if not status.answers else FAIL, "nobody knows where it stands", remedy)
    known = "answers" if status.answered is not None else "stands at home by the operator's word"
    lag = f", lag {1000 * status.lag:.0f} ms" if np.isfinite(status.lag) else ""
    return Check("arm", PASS, f"{known}{lag}; {report.priority}")


def path_check(path: Path, start: float) -> Check:
    """What is to be printed."""
    begun = f", from checkpoint {start:.2f} on" if start else ""
    return Check("path", PASS, f"{len(path)} checkpoints, {counted(len(np.unique(path.layer)), 'layer')}{begun}")


def reach_check(laid: Laid | None) -> Check:
    """Whether the arm reaches the path where the surface is."""
    if laid is None:
        return Check("reach", BUSY, "the surface is not found yet")
    if laid.unreachable:
        return Check("reach", FAIL, laid.unreachable, "move the arm or the wound, or plan the path anew")
    return Check("reach", PASS, "every checkpoint is within the arm's range where the surface is now")


def recorder_check(report: RecorderReport | None) -> Check:
    """Whether the recorder writes."""
    if report is None:
        return Check("recording", BUSY, "the recorder starts")
    if report.failed:
        return Check("recording", FAIL, report.failed, "free the disk, or record elsewhere")
    return Check("recording", PASS, "it writes")


def table(checks: tuple[Check, ...]) -> str:
    """The check as a table for a terminal."""
    width = max(len(check.name) for check in checks)
    lines = []
    for check in checks:
        remedy = f": {check.remedy}" if check.remedy and check.verdict is not PASS else ""
        lines.append(f"  {check.name:<{width}}  {check.verdict.value:<4}  {check.found}{remedy}")
    return "\n".join(lines)
