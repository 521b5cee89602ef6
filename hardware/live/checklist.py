"""The check before a run (cameras, calibration, arm, path, reach, recording), and the path placed on the surface."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path as File
from typing import TextIO

import numpy as np

from estimation import se3
from estimation.errors import InputError
from estimation.pose import SurfacePose, TrackState
from estimation.se3 import Array
from hardware.arm.device import ArmState
from hardware.arm.profile import AXIS_LETTERS, ArmProfile, placed
from hardware.live.records import LiveMotionReport, RecorderReport, RunReports, TrackingReport
from hardware.operator.view import MAX_MOVE_DEG, MAX_MOVE_MM, Check, CheckVerdict, MoveRequest
from hardware.process.progress import BAD, DOUBTFUL, GOOD, count_text, painted
from planning.clearance import GUARD_TOUCH, TissueGuard
from planning.command import AXIS_MARGIN, JOINT_MARGIN
from planning.kinematics import axes_from_nozzle, joints_from_axes
from planning.material import FlowShares, Outlets, with_offsets
from planning.path import Path, fingerprint
from planning.placement import NoSurfaceError, PathPlacement, PlacedBy, SurfaceMove, moved_along

MAX_PICTURE_AGE = 1.0  # s: a camera whose pictures are older does not deliver any more
FIRST_PICTURE_TIME = 30.0  # s in which first pictures come where all is well, on two busy cores
USUAL_START = "10 to 30 s are usual"
PASS, FAIL, BUSY, WARN = CheckVerdict.PASS, CheckVerdict.FAIL, CheckVerdict.BUSY, CheckVerdict.WARN
VERDICT_COLOURS = {PASS: GOOD, WARN: DOUBTFUL, FAIL: BAD}


@dataclass(frozen=True, slots=True, eq=False)
class PrintTask:
    """What is to be printed, and how."""

    path: Path  # in its own frame
    profile: ArmProfile
    start: float = 0.0  # where it goes on, counted in checkpoints
    place: bool = False  # put the arm where the surface lies below its home
    stands_home: bool = False  # the arm is taken to stand at home: the operator says so, or it is virtual
    virtual: bool = False  # the arm is virtual: it begins at home, and nobody has to say so
    lift: float | None = None  # mm above the path in a dry run; None for a real one
    unattended: bool = False  # nobody confirms and nobody resumes: what stops such a run ends it
    patience: float = 10.0  # s without pictures, after which the arm is stopped
    dispensers: str = ""  # text of the dispenser file; "": nothing is extruded
    looks: bool = False  # whether what is laid can be looked at: the path says how much it is
    outlets: Outlets = field(default_factory=dict)  # of the path's materials
    tissue: TissueGuard | None = None  # that the tool is kept out of, in the path's own frame; None without a scan
    flows: tuple[FlowShares, ...] = ()  # that looks of the run before asked for, in order

    @property
    def fingerprint(self) -> str:
        """Of the path as its file has it; "" in a dry run, of which no progress is kept."""
        return fingerprint(self.path) if self.lift is None else ""


def guarded_tissue(scan: File, path: Path, profile: ArmProfile) -> TissueGuard:
    """What the tool is kept out of, by the scan in a file, in the path's frame. InputError where that is not at it."""
    from hardware.files.arm_file import tool_body_of  # loads what the motion does not need
    from hardware.files.mesh_file import read_mesh
    from planning.layers.clearing import tissue_guard

    body = tool_body_of(profile, margin=0.0, touch=GUARD_TOUCH)
    try:
        return tissue_guard(read_mesh(scan), path, body)
    except InputError as error:
        raise InputError(scan, error.what, error.got, error.allowed) if error.where == "scan" else error from None


SILENT_INTERVALS, SILENCE_SLACK = 2, 0.01  # a process is silent after so many of its intervals, and so many s


def silence_text(name: str, last: float, interval: float, now: float) -> str:
    """The operator's message that a process is silent at `now`, s, long before it counts as hung; "" if it is not.

    last: s, of its last report. interval: s from report to report; NaN while unknown. Nothing is done about silence:
    the arm rests anyhow, as its queue is empty or the pose too old.
    """
    silent = now - last
    if silent > SILENT_INTERVALS * interval + SILENCE_SLACK:
        return f"the {name} process has said nothing for {silent:.2f} s"
    return ""


def silent_process(reports: RunReports, tick: float, now: float) -> str:
    """That motion or tracking says nothing, "" while both report. tick: s of the motion."""
    motion, tracking = reports.motion, reports.tracking
    silent = "" if motion is None else silence_text("motion", motion.tick.stamp, tick, now)
    if silent or tracking is None or tracking.ended:
        return silent
    return silence_text("tracking", tracking.stamp, tracking.interval, now)


@dataclass(frozen=True, slots=True, eq=False)
class PlacedPath:
    """A path placed on the surface, not begun yet."""

    path: Path  # in the tracker's surface frame
    profile: ArmProfile  # of the arm, with its place
    unreachable: str  # why the arm cannot print the path where the surface is now, "" if it can


def place_path(
    path: Path,
    surface_from_path: Array,
    pose: SurfacePose,
    profile: ArmProfile,
    place: bool,
    outlets: Outlets | None = None,
) -> PlacedPath:
    """The path on the surface as it is now.

    place: put the arm where the surface lies below its home, level. outlets: of the path's materials.
    """
    path = replace(path, surface_from_nozzle=surface_from_path @ path.surface_from_nozzle)
    profile = placed(profile, pose.base_from_surface) if place else profile
    return PlacedPath(path, profile, reach_problem(with_offsets(path, outlets or {}), pose, profile))


def moved_placement(
    placement: PathPlacement, path: Path, tracking: TrackingReport | None, move: MoveRequest | None
) -> PathPlacement | str:
    """Where a path lies after a move that the operator asked for, on the surface as it is mapped now; or why not."""
    if move is None or not move.allowed:
        return f"a path is moved by {MAX_MOVE_MM:g} mm and {MAX_MOVE_DEG:g} degrees at most"
    pose = None if tracking is None else tracking.pose
    if tracking is None or pose is None or not pose.state.measured or tracking.surface is None:
        return "the surface is not seen now"
    surface_move = SurfaceMove(move.x_mm, move.y_mm, float(np.deg2rad(move.turn_deg)))
    try:
        surface_from_path = moved_along(placement, path, tracking.surface, surface_move)
    except NoSurfaceError as error:
        return str(error)
    return replace(placement, surface_from_path=surface_from_path, by=PlacedBy.HAND, certain=False)


def raised_path(path: Path, lift: float) -> Path:
    """The path for a dry run: each checkpoint `lift` mm farther up along its own axis, nothing extruded or put in."""
    up = se3.make(np.eye(3), np.array([0.0, 0.0, lift]))
    zeros, extrude = np.zeros(len(path), np.int64), np.zeros(len(path), bool)
    return replace(path, surface_from_nozzle=path.surface_from_nozzle @ up, extrude=extrude, material=zeros)


def reach_problem(path: Path, pose: SurfacePose, profile: ArmProfile) -> str:
    """Why the arm cannot reach all checkpoints where the surface is now, with the planner's margins; "" if it can."""
    limits, arm = profile.limits, profile.arm
    axes = axes_from_nozzle(arm, pose.base_from_surface @ path.surface_from_nozzle)
    if not np.isfinite(axes).all():
        return f"checkpoint {int(np.argmin(np.isfinite(axes).all(axis=1)))}: {arm.beyond}"
    if reason := _outside(axes, limits.low + AXIS_MARGIN, limits.high - AXIS_MARGIN, AXIS_LETTERS):
        return reason
    if (model := arm.jointed) is None:
        return ""
    names = [f"J{i + 1}" for i in range(6)]
    return _outside(joints_from_axes(model, axes), model.low + JOINT_MARGIN, model.high - JOINT_MARGIN, names)


def _outside(values: Array, low: Array, high: Array, names: str | list[str]) -> str:
    """The first of values (N, 6) that is not within low and high (6,), in words."""
    rows, columns = np.nonzero(~((values >= low) & (values <= high)))
    if not len(rows):
        return ""
    row, column = int(rows[0]), int(columns[0])
    turns = column >= 3 or len(names[column]) > 1  # an angle of the arm's axes, or a joint
    figures = [values[row, column], low[column], high[column]]
    (got, least, most), unit = (np.rad2deg(figures), "degrees") if turns else (figures, "mm")
    return f"checkpoint {row}: {names[column]} = {got:.1f}, allowed {least:.1f} to {most:.1f} {unit}"


def run_checks(
    reports: RunReports, task: PrintTask, placed_path: PlacedPath | None, now: float, waited: float = 0.0
) -> tuple[Check, ...]:
    """The checks of a run at `now`, s. waited: s for which it has been checked."""
    path, start = task.path, task.start
    resume_text = f"; goes on at checkpoint {start:.2f}, {100 * start / max(len(path) - 1, 1):.0f} %" if start else ""
    layers = count_text(len(np.unique(path.layer)), "layer")
    return (
        *_camera_checks(reports.tracking, now, waited),
        _arm_check(reports.motion, task),
        Check("path", PASS, f"{len(path)} checkpoints, {layers}{resume_text}"),
        *_material_check(reports.motion),
        _reach_check(placed_path),
        _recorder_check(reports.recorder),
    )


def _camera_checks(report: TrackingReport | None, now: float, waited: float) -> tuple[Check, Check]:
    """Whether all cameras deliver, and what is known of their calibration. waited: s, so far."""
    if report is None or not report.cameras:
        loads = f"the tracker loads its libraries, for {waited:.0f} s: {USUAL_START}"
        return Check("cameras", BUSY, loads), Check("calibration", BUSY, "read once the tracker has started")
    calibration = Check("calibration", PASS, f"{len(report.cameras)} cameras, {', '.join(report.cameras)}")
    if report.pose is None:
        remedy = "plug in the cameras, or see who else uses them" if waited > FIRST_PICTURE_TIME else ""
        waiting_text = f"waits for the first pictures, for {waited:.0f} s: {USUAL_START}"
        return Check("cameras", BUSY, waiting_text, remedy), calibration
    if report.pose.state is TrackState.INITIALISING and (silent := now - report.stamp) > MAX_PICTURE_AGE:
        return Check("cameras", BUSY, f"the surface is looked for in their pictures, for {silent:.0f} s"), calibration
    if (age := now - report.pose.stamp) > MAX_PICTURE_AGE:
        return Check("cameras", FAIL, f"no pictures for {age:.1f} s", "plug in the cameras"), calibration
    if missing := [name for i, name in enumerate(report.cameras) if i not in report.delivering]:
        verdict, missing_text = WARN if len(report.delivering) >= 2 else FAIL, f"without {', '.join(missing)}"
        return Check("cameras", verdict, missing_text, "plug it in, or look at its lens"), calibration
    return Check("cameras", PASS, f"all {len(report.cameras)} deliver"), calibration


def _arm_check(report: LiveMotionReport | None, task: PrintTask) -> Check:
    """Whether the arm is there, and whether anybody knows where it stands."""
    if report is None:
        return Check("arm", BUSY, "its line is opened")
    status = report.tick.status
    if status.state is ArmState.UNPLUGGED:
        return Check("arm", FAIL, f"unplugged: {status.reason}", "plug it in and switch it on")
    if status.answered is None and not task.stands_home:
        remedy = "move it to its home by hand, then say so with --stands-home"
        return Check("arm", BUSY if not status.answers else FAIL, "nobody knows where it stands", remedy)
    home = "stands at home, where a virtual arm begins" if task.virtual else "stands at home by the operator's word"
    place_source = "answers" if status.answered is not None else home
    lag = f", lag {1000 * status.lag:.0f} ms" if np.isfinite(status.lag) else ""
    return Check("arm", PASS, f"{place_source}{lag}; {report.priority}")


def _material_check(report: LiveMotionReport | None) -> tuple[Check, ...]:
    """Whether the dispenser is ready; nothing of a run without one."""
    if report is None or report.material is None:
        return ()
    material = report.material
    verdict = FAIL if material.failed else PASS if material.ready else BUSY
    return (Check("material", verdict, material.text, "see to the dispenser and its line"),)


def _reach_check(placed_path: PlacedPath | None) -> Check:
    if placed_path is None:
        return Check("reach", BUSY, "the surface is not found yet")
    if placed_path.unreachable:
        return Check("reach", FAIL, placed_path.unreachable, "move the arm or the wound, or plan the path anew")
    return Check("reach", PASS, "every checkpoint is within the arm's range where the surface is now")


def _recorder_check(report: RecorderReport | None) -> Check:
    if report is None:
        return Check("recording", BUSY, "the recorder starts")
    if report.failed:
        return Check("recording", FAIL, report.failed, "free the disk, or record elsewhere")
    return Check("recording", PASS, "it writes")


def checks_table(checks: tuple[Check, ...], stream: TextIO | None = None) -> str:
    """The check as a table. stream: where it is written to, in colours if that is a terminal."""
    width = max(len(check.name) for check in checks)
    lines = []
    for check in checks:
        remedy = f": {check.remedy}" if check.remedy and check.verdict is not PASS else ""
        verdict = f"{check.verdict.value:<4}"
        if stream is not None and check.verdict in VERDICT_COLOURS:
            verdict = painted(verdict, VERDICT_COLOURS[check.verdict], stream)
        lines.append(f"  {check.name:<{width}}  {verdict}  {check.found}{remedy}")
    return "\n".join(lines)
