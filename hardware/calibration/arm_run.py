"""`stillbed calibrate arm`: a recorded folder or touched points in; an arm file, its numbers and a report out."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from estimation import se3
from estimation.arm_calibration.touch import Touched, fit_touched
from estimation.calibration.arm_fit import Asked
from estimation.errors import InputError
from estimation.se3 import Array
from hardware.arm.profile import ArmProfile
from hardware.arm_calibration.moves import MoveWishes
from hardware.arm_calibration.touched_file import TouchedPoints, read_touched
from hardware.arm_calibration.verdict import LIMIT, judge, seen_words
from hardware.calibration.arm_report import page
from hardware.calibration.arm_solve import (
    ArmCalibration,
    calibrated,
    kinematics_of,
    numbers_text,
    solve_folder,
    tip_error,
)
from hardware.calibration.verdict import Verdict
from hardware.files.arm_file import write_arm
from hardware.files.rig_file import read_rig
from hardware.process.progress import Report

RIG_JSON = "rig.json"  # of a recorded calibration: what the rig's own calibration was worth
WORST = 4.0  # times its sigma that a touched point may lie beside


@dataclass(frozen=True, slots=True)
class Wishes:
    """limit: mm, one sigma of the tip. asked: what is sought. moves: that are made."""

    limit: float = LIMIT
    asked: Asked = field(default_factory=Asked)
    moves: MoveWishes = field(default_factory=MoveWishes)


@dataclass(frozen=True, slots=True, eq=False)
class Outcome:
    """What came of it: the arm with what was found, the verdict, and the text for the terminal."""

    profile: ArmProfile
    verdict: Verdict
    text: str


def check_out(out: Path) -> None:
    """InputError unless an arm file can be written there."""
    if out.suffix != ".toml":
        raise InputError(out, "--out", out.name, "a file that ends in .toml")
    if not out.parent.is_dir():
        raise InputError(out, "--out", "no such folder", "a file in a folder that exists")


def check_record(folder: Path) -> None:
    """InputError unless a recording can begin there."""
    if folder.exists() and any(folder.iterdir()) if folder.is_dir() else folder.exists():
        raise InputError(folder, "--record", "exists", "a new or empty folder")
    if not folder.parent.is_dir():
        raise InputError(folder, "--record", "no such folder", "a folder in one that exists")
    folder.mkdir(exist_ok=True)


def keep_rig_json(rig: Path, folder: Path) -> None:
    """Copy what a rig's calibration was worth into a recorded calibration, where it lies beside the rig."""
    beside = rig.with_suffix(".json")
    if beside.is_file():
        shutil.copyfile(beside, folder / RIG_JSON)


def run_folder(folder: Path, out: Path, wishes: Wishes, report: Report, truth: ArmTruth | None = None) -> Outcome:
    """Solve a recorded calibration; writes `out` and, beside it, .report.html and .json."""
    check_out(out)
    rig_json = folder / RIG_JSON
    found = solve_folder(folder, rig_json if rig_json.is_file() else None, wishes.asked, report)
    verdict = judge(found, wishes.limit)
    profile = calibrated(found.profile, found.fit.state, wishes.asked)
    against = () if truth is None else truth.rows(found)
    write_arm(out, profile, f"calibrated by what cameras saw of its tip\n{verdict.lines[0]}")
    out.with_suffix(".json").write_text(numbers_text(found), encoding="utf-8")
    text = page(folder.resolve().name, found, verdict, against)
    out.with_suffix(".report.html").write_text(text, encoding="utf-8")
    return Outcome(profile, verdict, _text(found, verdict, against, out))


@dataclass(frozen=True, slots=True, eq=False)
class ArmTruth:
    """What is exactly known of a simulated arm. late: s of dead time as executed; lag: s of its servos."""

    base_from_arm: Array
    tool: Array
    late: float
    lag: float

    def rows(self, found: ArmCalibration) -> tuple[tuple[str, str, str], ...]:
        """What, how far off, and the sigma stated."""
        state, sigma = found.fit.state, found.fit.sigma
        off = se3.log(se3.inverse(self.base_from_arm) @ state.base_from_arm)
        middle = found.places.mean(0)
        gap = se3.transform_points(state.base_from_arm @ se3.inverse(self.base_from_arm), middle[None])[0] - middle
        rows = [
            ("base_from_arm, in the middle of the places, mm", np.linalg.norm(gap), np.nan, 3),
            ("base_from_arm, at the arm's origin, mm", np.linalg.norm(off[3:]), np.linalg.norm(sigma[3:6]), 3),
            ("base_from_arm, degrees", np.degrees(np.linalg.norm(off[:3])), np.degrees(np.linalg.norm(sigma[:3])), 4),
        ]
        if found.asked.tool:
            tool = np.linalg.norm(np.asarray(state.tool) - self.tool)
            rows.append(("tip in the tool, mm", tool, np.linalg.norm(sigma[6:9]), 3))
        if found.asked.latency:
            rows.append(("dead time, ms", 1e3 * (state.dead_time - self.late), 1e3 * sigma[9], 2))
            rows.append(("servo's lag, ms", 1e3 * (state.lag - self.lag), 1e3 * sigma[10], 2))
        return tuple((w, f"{v:.{d}f}", "" if np.isnan(s) else f"{s:.{d}f}") for w, v, s, d in rows)


def _text(found: ArmCalibration, verdict: Verdict, against: Sequence[tuple[str, str, str]], out: Path) -> str:
    lines = ["PASS" if verdict.passed else "FAIL", *verdict.lines]
    for c, camera in enumerate(found.rig.cameras):
        lines.append(f"{camera.name}: tip {seen_words(found, c)}")
    lines += [f"beside the truth: {what}: {off} (stated {stated or '-'})" for what, off, stated in against]
    lines += list(verdict.hints)
    lines.append(f"arm file: {out}, report: {out.with_suffix('.report.html')}")
    return "\n".join(lines)


def run_touched(points_file: Path, rig_file: Path, profile: ArmProfile, out: Path, keep_tool: bool) -> Outcome:
    """The arm's place from points that its tip has touched; writes `out`."""
    check_out(out)
    points = read_touched(points_file, read_rig(rig_file).rig)
    poses = kinematics_of(profile.arm)(points.axes)
    found = fit_touched(poses, points.points, points.sigma, profile.arm.tool_offset, not keep_tool)
    verdict = _judge_touched(found, points, poses)
    arm = replace(profile.arm, arm_from_base=se3.inverse(found.base_from_arm), tool_offset=found.tool)
    made = replace(profile, arm=arm)
    write_arm(out, made, f"calibrated by {len(points.points)} touched points\n{verdict.lines[0]}")
    text = ["PASS" if verdict.passed else "FAIL", *verdict.lines, *verdict.hints, f"arm file: {out}"]
    return Outcome(made, verdict, "\n".join(text))


def _judge_touched(found: Touched, points: TouchedPoints, poses: Array) -> Verdict:
    away = np.linalg.norm(found.residuals, axis=1)
    worst = int((away / points.sigma).argmax())
    error = tip_error(found.base_from_arm, found.tool, found.covariance, poses)
    spare = 3 * len(away) - 6
    scatter = float(np.sqrt((away**2 / points.sigma**2).sum() / spare))
    bad = away[worst] > WORST * points.sigma[worst]
    typical, beside = (float(np.sqrt(np.mean(v**2))) for v in (error, away))
    lines = [
        f"the tip is where it is thought to be within {typical:.2f} mm (one sigma) at the points",
        f"the points lie {beside:.2f} mm beside where they should (RMS), point {worst + 1} the most, "
        f"{away[worst]:.2f} mm; {scatter:.1f} times what touching by hand leaves",
    ]
    hints = (f"touch point {worst + 1} again, or leave it out: was it the same one?",) if bad else ()
    return Verdict(not bad, tuple(lines), hints)
