"""A recorded calibration of an arm, solved: parameters, their covariance, held-out residuals and the arm file.

commanded.csv holds the set-points that the arm's controller was sent, as knots of a polyline, by the computer's clock:

    stamp_s,x_mm,y_mm,z_mm,a_deg,b_deg,c_deg

A line is written once nothing can change it any more, so an interrupted recording is complete up to then.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from estimation import se3
from estimation.calibration.arm_fit import ArmFit, ArmUnknowns, cross_validate, fit_arm, jackknife
from estimation.calibration.arm_model import ArmParameters, Kinematics, SetPoint, Sightings, predict, tip_positions
from estimation.calibration.arm_start import check_latency, check_places, check_turns, first_pose
from estimation.calibration.lens_model import CAMERA_PARAMETERS
from estimation.errors import InputError
from estimation.rig import Rig
from estimation.se3 import Array
from hardware.arm.link import Arm
from hardware.arm.profile import ArmProfile
from hardware.arm.queue import QueuedCommand
from hardware.calibration.arm_sightings import TipObservations, find_tips, hidden_tips
from hardware.files.arm_file import read_arm
from hardware.files.session_folder import open_folder
from hardware.process import checks
from hardware.process.progress import ProgressReport
from planning.robot.kinematics import SimpleArm, nozzle_from_axes

ARM_FILE = "arm.toml"  # of a recorded calibration: the arm before it
HELD_OUT_FOLDS = 8  # with fewer, each fit lacks too many sightings
COMMANDED_FILE = "commanded.csv"
COMMANDED_HEADER = "stamp_s,x_mm,y_mm,z_mm,a_deg,b_deg,c_deg"
STAMP_RESOLUTION = 2e-6  # s: nearer knots are equal in six digits
_UNITS = np.array([1, 1, 1, *np.rad2deg([1.0, 1, 1])])


class CommandedFile:
    """Writes commanded.csv."""

    def __init__(self, path: Path) -> None:
        self._file = path.open("w", encoding="utf-8")
        self._file.write(COMMANDED_HEADER + "\n")
        self._last = self._until = -np.inf  # s: instant of the last knot, end of the last move

    def note(self, arm: Arm, now: float) -> None:
        """Write the moves that have ended at `now`, s."""
        for way in arm.ways(self._until):
            if way.end <= now:
                self._add(way)
                self._until = way.end

    def _add(self, way: QueuedCommand) -> None:
        for instant, axes in ((way.start, way.source), (way.end, way.target)):
            if instant >= self._last + STAMP_RESOLUTION:
                self._file.write(f"{instant:.6f}," + ",".join(f"{v:.6f}" for v in np.array(axes) * _UNITS) + "\n")
                self._last = instant

    def __enter__(self) -> CommandedFile:
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()


def read_commanded(path: Path) -> SetPoint:
    """The set-point in a commanded.csv; InputError if it is invalid."""
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError):
        allowed = f"a text file that begins with {COMMANDED_HEADER}"
        raise InputError(path, "file", "missing or not text", allowed) from None
    if not lines or lines[0].strip() != COMMANDED_HEADER:
        raise InputError(path, "line 1", lines[0][:60] if lines else "nothing", COMMANDED_HEADER)
    rows = [_row(path, number, line) for number, line in enumerate(lines[1:], 2) if line.strip()]
    if len(rows) < 2:
        raise InputError(path, "rows", len(rows), "two or more")
    table = np.array(rows)
    if (back := np.flatnonzero(np.diff(table[:, 0]) <= 0)).size:
        raise InputError(path, f"line {back[0] + 3}: stamp_s", table[back[0] + 1, 0], "stamps that rise")
    return SetPoint(np.ascontiguousarray(table[:, 0]), table[:, 1:] / _UNITS)


def _row(path: Path, number: int, line: str) -> Array:
    try:
        row = np.array([float(word) for word in line.split(",")])
    except ValueError:
        row = np.zeros(0)
    if row.shape != (7,) or not np.isfinite(row).all():
        raise InputError(path, f"line {number}", line[:60], "7 finite numbers: s, mm and degrees")
    return row


@dataclass(frozen=True, slots=True, eq=False)
class ArmCalibration:
    """A solved calibration of an arm."""

    rig: Rig
    profile: ArmProfile  # before the calibration
    tips: TipObservations
    set_point: SetPoint
    fit: ArmFit
    places: Array  # (P, 3) mm, base: the resting places
    error: Array  # (P,) mm, one sigma of the tip there
    held_px: Array  # (N,) px, residuals under fits without the sighting's place; nan for outliers
    held_mm: Array  # (N,) mm, the same at the tip's depth
    unknowns: ArmUnknowns
    hidden: NDArray[np.int64]  # (C,) number of pictures in which the tool hides its own tip


def kinematics_of(arm: SimpleArm) -> Kinematics:
    """An arm's own kinematics: arm_from_nozzle (N, 4, 4) at axes (N, 6)."""
    own = replace(arm, arm_from_base=np.eye(4), tool_offset=np.zeros(3))
    return lambda axes: nozzle_from_axes(own, axes)


def solve_folder(folder: Path, rig_json: Path | None, unknowns: ArmUnknowns, report: ProgressReport) -> ArmCalibration:
    """Solve a recorded calibration; InputError says what is missing, or what its moves do not determine."""
    for name in (COMMANDED_FILE, ARM_FILE):
        if not (folder / name).is_file():
            allowed = "a folder that `stillbed calibrate arm` has recorded"
            raise InputError(folder, name, "missing", allowed)
    session, profile = open_folder(folder), read_arm(folder / ARM_FILE)
    set_point = read_commanded(folder / COMMANDED_FILE)
    covariance = None if rig_json is None else read_covariance(rig_json, len(session.rig))
    tips = find_tips(session, set_point, profile.tool, report)
    return solve(session.rig, profile, set_point, tips, unknowns, covariance)


def solve(
    rig: Rig,
    profile: ArmProfile,
    set_point: SetPoint,
    tips: TipObservations,
    unknowns: ArmUnknowns,
    rig_covariance: Array | None = None,
) -> ArmCalibration:
    """Estimate the unknowns from the tips. rig_covariance: (16 C, 16 C), if known."""
    if not unknowns.latency:  # then the arm's position is unknown while it moves
        tips = replace(tips, sightings=tips.sightings.take(tips.sightings.place >= 0))
    kinematics, sightings = kinematics_of(profile.arm), tips.sightings
    pose, axes, _ = first_pose(sightings, set_point, kinematics, rig)
    check_places(axes[:, :3])
    if unknowns.tool:
        check_turns(kinematics(axes))
    if unknowns.latency:
        check_latency(set_point, kinematics, sightings.stamp[sightings.place < 0])
    late = max(profile.lag - profile.frame_time, 0.0)
    start = ArmParameters(pose, profile.arm.tool_offset, late / 2, late / 2, float(profile.tool[0, 1]))

    def fit(some: Sightings, begin: ArmParameters = start) -> ArmFit:
        return fit_arm(some, set_point, kinematics, rig, begin, unknowns, rig_covariance)

    whole = fit(sightings)
    near = replace(start, base_from_arm=whole.state.base_from_arm)

    def residuals_of(state: ArmParameters, some: Sightings) -> Array:
        return predict(state, set_point, kinematics, rig, some.stamp, some.camera).pixels - some.pixels

    residuals, states = cross_validate(sightings, lambda some: fit(some, near), residuals_of, HELD_OUT_FOLDS)
    whole = jackknife(whole, states)
    state, held = whole.state, np.where(whole.used, np.linalg.norm(residuals, axis=1), np.nan)
    points = tip_positions(state, set_point, kinematics, sightings.stamp)
    bases = np.stack([c.base_from_camera for c in rig.cameras])[sightings.camera]
    depth = np.einsum("ni,ni->n", points - bases[:, :3, 3], bases[:, :3, 2])
    in_mm = held * depth / rig.matrices[sightings.camera, 0, 0]
    arm_from_nozzle = kinematics(axes)
    at = se3.transform_points(state.base_from_arm @ arm_from_nozzle, state.tool[None])[:, 0]
    error = tip_error(state.base_from_arm, state.tool, whole.covariance[:9, :9], arm_from_nozzle)
    shaded = hidden_tips(state, profile.tool, set_point, kinematics, rig, *tips.missed)
    hidden = np.bincount(tips.missed[1][shaded], minlength=len(rig))
    return ArmCalibration(rig, profile, tips, set_point, whole, at, error, held, in_mm, unknowns, hidden)


def tip_error(base_from_arm: Array, tool: Array, covariance: Array, arm_from_nozzle: Array) -> Array:
    """One sigma in 3D (N,), mm, of the tip at arm_from_nozzle (N, 4, 4).

    covariance: (9, 9) of base_from_arm (right perturbation, rad and mm) and tool (3,), mm.
    """
    turn = base_from_arm[:3, :3]
    inside = se3.transform_points(arm_from_nozzle, tool[None])[:, 0]
    held = np.broadcast_to(turn, (len(inside), 3, 3))
    by = np.concatenate([turn @ -se3.hat(inside), held, turn @ arm_from_nozzle[:, :3, :3]], -1)
    return np.asarray(np.sqrt(np.einsum("nij,jk,nik->n", by, covariance, by)))


def calibrated_profile(profile: ArmProfile, state: ArmParameters, unknowns: ArmUnknowns) -> ArmProfile:
    """The profile with the estimated pose, tool offset and latency."""
    arm = replace(profile.arm, arm_from_base=se3.inverse(state.base_from_arm), tool_offset=np.array(state.tool))
    lag = profile.frame_time + state.dead_time + state.lag if unknowns.latency else profile.lag
    return replace(profile, arm=arm, lag=max(lag, 0.0))


def read_covariance(path: Path, cameras: int) -> Array:
    """The covariance (16 C, 16 C) in the .json of `calibrate cameras`; InputError where it has none."""
    try:
        table = json.loads(path.read_text(encoding="utf-8"))
        value = table["covariance"]
    except (OSError, ValueError, KeyError, TypeError):
        raise InputError(path, "covariance", "missing", "the .json that `stillbed calibrate cameras` writes") from None
    size = CAMERA_PARAMETERS * cameras
    covariance = checks.numbers(path, "covariance", value, (size, size))
    return (covariance + covariance.T) / 2


def numbers_text(found: ArmCalibration) -> str:
    """All parameters with their covariance as JSON, mm, rad, s and px."""
    state, sigma = found.fit.state, found.fit.sigma
    arm_from_base = se3.inverse(state.base_from_arm)
    table = {
        "arm_from_base": arm_from_base.tolist(),
        "tool_offset_mm": np.asarray(state.tool).tolist(),
        "dead_time_s": state.dead_time,
        "servo_lag_s": state.lag,
        "end_radius_mm": state.blunt,
        "arm_from_camera": {c.name: (arm_from_base @ c.base_from_camera).tolist() for c in found.rig.cameras},
        "numbers": ["rx", "ry", "rz", "tx", "ty", "tz", "tool x", "tool y", "tool z", "dead_time_s", "lag_s", "end_mm"],
        "sigma": sigma.tolist(),
        "covariance": found.fit.covariance.tolist(),
        "scatter": found.fit.scatter,
        "widened_by": found.fit.widened_by,
        "held_out_median_px": float(np.nanmedian(found.held_px)),
        "held_out_median_mm": float(np.nanmedian(found.held_mm)),
    }
    return json.dumps(table, indent=1, allow_nan=False) + "\n"
