"""A recorded calibration of the arm, solved: which numbers come out, how sure they are, and the arm file they make."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from estimation import se3
from estimation.arm_calibration.moves import check_latency, check_places, check_turns
from estimation.arm_calibration.set_point import SetPoint
from estimation.calibration.arm_fit import ArmFit, Asked, fit_arm, held_out, widened
from estimation.calibration.arm_model import OWN, ArmState, Kinematics, Sightings, predict, tips
from estimation.calibration.arm_start import first_pose
from estimation.errors import InputError
from estimation.rig import Rig
from estimation.se3 import Array
from hardware.arm.profile import ArmProfile
from hardware.arm_calibration.commanded import NAME, read_commanded
from hardware.arm_calibration.tool_shadow import hidden_tips
from hardware.calibration.arm_sightings import Look, look
from hardware.files.arm_file import read_arm
from hardware.files.session_folder import open_folder
from hardware.process import checks
from hardware.process.progress import Report
from planning.kinematics import SimpleArm, nozzle_from_axes

ARM = "arm.toml"  # of a recorded calibration: the arm as it was taken to be
FOLDS = 8  # of held-out sightings: with fewer, each fit lacks so much that it tells of that


@dataclass(frozen=True, slots=True, eq=False)
class ArmCalibration:
    """rig, profile: as they were. look: what was seen. fit: the result. places: (P, 3) mm, base, that were rested at.
    error: (P,) mm, one sigma of the tip at them. held_px: (N,) px and held_mm: (N,) mm, by which sightings lie beside
    where fits that did not see them put them; nan where left out. asked: what was sought. hidden: (C,) pictures in
    which the tool itself stands before its tip."""

    rig: Rig
    profile: ArmProfile
    look: Look
    set_point: SetPoint
    fit: ArmFit
    places: Array
    error: Array
    held_px: Array
    held_mm: Array
    asked: Asked
    hidden: NDArray[np.int64]


def kinematics_of(arm: SimpleArm) -> Kinematics:
    """What an arm believes: arm_from_nozzle (N, 4, 4) at axes (N, 6)."""
    own = replace(arm, arm_from_base=np.eye(4), tool_offset=np.zeros(3))
    return lambda axes: nozzle_from_axes(own, axes)


def solve_folder(folder: Path, rig_json: Path | None, asked: Asked, report: Report) -> ArmCalibration:
    """Solve a recorded calibration; InputError says what is missing, or what its moves cannot tell."""
    for name in (NAME, ARM):
        if not (folder / name).is_file():
            allowed = "a folder that `stillbed calibrate arm` has recorded"
            raise InputError(folder, name, "missing", allowed)
    session, profile = open_folder(folder), read_arm(folder / ARM)
    set_point = read_commanded(folder / NAME)
    covariance = None if rig_json is None else read_covariance(rig_json, len(session.rig))
    seen = look(session, set_point, profile.tool, report)
    return solve(session.rig, profile, set_point, seen, asked, covariance)


def solve(
    rig: Rig, profile: ArmProfile, set_point: SetPoint, seen: Look, asked: Asked, rig_covariance: Array | None = None
) -> ArmCalibration:
    """Solve for what is asked from what was seen. rig_covariance: (16 C, 16 C), if it is known."""
    if not asked.latency:  # how late it is is then not known: where it was on its way is not, either
        seen = replace(seen, sightings=seen.sightings.take(seen.sightings.place >= 0))
    kinematics, sightings = kinematics_of(profile.arm), seen.sightings
    pose, axes, _ = first_pose(sightings, set_point, kinematics, rig)
    check_places(axes[:, :3])
    if asked.tool:
        check_turns(kinematics(axes))
    if asked.latency:
        check_latency(set_point, kinematics, sightings.stamp[sightings.place < 0])
    late = max(profile.lag - profile.frame_time, 0.0)
    start = ArmState(pose, profile.arm.tool_offset, late / 2, late / 2, float(profile.tool[0, 1]))

    def fit(some: Sightings, begin: ArmState = start) -> ArmFit:
        return fit_arm(some, set_point, kinematics, rig, begin, asked, rig_covariance)

    found = fit(sightings)
    again = replace(start, base_from_arm=found.state.base_from_arm)

    def left(state: ArmState, some: Sightings) -> Array:
        return predict(state, set_point, kinematics, rig, some.stamp, some.camera).pixels - some.pixels

    residuals, states = held_out(sightings, lambda some: fit(some, again), left, FOLDS)
    found, away = widened(found, states), np.linalg.norm(residuals, axis=1)
    held = np.where(found.used, away, np.nan)
    points = tips(found.state, set_point, kinematics, sightings.stamp)
    bases = np.stack([c.base_from_camera for c in rig.cameras])[sightings.camera]
    depth = np.einsum("ni,ni->n", points - bases[:, :3, 3], bases[:, :3, 2])
    in_mm = held * depth / rig.matrices[sightings.camera, 0, 0]
    arm_from_nozzle = kinematics(axes)
    at = se3.transform_points(found.state.base_from_arm @ arm_from_nozzle, found.state.tool[None])[:, 0]
    error = tip_error(found.state.base_from_arm, found.state.tool, found.covariance[:9, :9], arm_from_nozzle)
    shaded = hidden_tips(found.state, profile.tool, set_point, kinematics, rig, *seen.missed)
    hidden = np.bincount(seen.missed[1][shaded], minlength=len(rig))
    return ArmCalibration(rig, profile, seen, set_point, found, at, error, held, in_mm, asked, hidden)


def tip_error(base_from_arm: Array, tool: Array, covariance: Array, arm_from_nozzle: Array) -> Array:
    """One sigma in space (N,), mm, of the tip at arm_from_nozzle (N, 4, 4).

    covariance: (9, 9) of base_from_arm (right perturbation, rad and mm) and tool (3,), mm.
    """
    turn = base_from_arm[:3, :3]
    inside = se3.transform_points(arm_from_nozzle, tool[None])[:, 0]
    held = np.broadcast_to(turn, (len(inside), 3, 3))
    by = np.concatenate([turn @ -se3.hat(inside), held, turn @ arm_from_nozzle[:, :3, :3]], -1)
    return np.asarray(np.sqrt(np.einsum("nij,jk,nik->n", by, covariance, by)))


def calibrated(profile: ArmProfile, state: ArmState, asked: Asked) -> ArmProfile:
    """The profile with what was found: the arm's place, its tool's offset, and how late it is."""
    arm = replace(profile.arm, arm_from_base=se3.inverse(state.base_from_arm), tool_offset=np.array(state.tool))
    lag = profile.frame_time + state.dead_time + state.lag if asked.latency else profile.lag
    return replace(profile, arm=arm, lag=max(lag, 0.0))


def read_covariance(path: Path, cameras: int) -> Array:
    """The covariance (16 C, 16 C) in the .json that `calibrate cameras` wrote; InputError where it has none."""
    try:
        table = json.loads(path.read_text(encoding="utf-8"))
        value = table["covariance"]
    except (OSError, ValueError, KeyError, TypeError):
        raise InputError(path, "covariance", "missing", "the .json that `stillbed calibrate cameras` writes") from None
    size = OWN * cameras
    covariance = checks.numbers(path, "covariance", value, (size, size))
    return (covariance + covariance.T) / 2


def numbers_text(found: ArmCalibration) -> str:
    """All numbers with their doubts as JSON, mm, rad, s and px."""
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
