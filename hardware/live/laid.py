"""The path as it lies on the tracked surface, and whether the arm can reach it there."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from estimation import se3
from estimation.pose import SurfacePose
from estimation.se3 import Array
from hardware.arm.profile import ArmProfile, placed
from planning.kinematics import axes_from_nozzle, joints_from_axes
from planning.limits import JOINT_MARGIN, MARGIN
from planning.path import Path

AXES = "XYZABC"


@dataclass(frozen=True, slots=True, eq=False)
class Laid:
    """A path that could be begun. path: in the tracker's surface frame. profile: of the arm, with its place.

    unreachable: why the arm cannot print it where the surface is now, "" if it can.
    """

    path: Path
    profile: ArmProfile
    unreachable: str


def laid_on(path: Path, surface_from_path: Array, pose: SurfacePose, profile: ArmProfile, place: bool) -> Laid:
    """The path on the surface as it is now. place: put the arm where the surface lies below its home, level."""
    moved = replace(path, surface_from_nozzle=surface_from_path @ path.surface_from_nozzle)
    there = placed(profile, pose.base_from_surface) if place else profile
    return Laid(moved, there, unreachable(moved, pose, there))


def lifted(path: Path, lift: float) -> Path:
    """The path for a dry run: each checkpoint `lift` mm farther up along its own axis, nothing extruded."""
    up = se3.make(np.eye(3), np.array([0.0, 0.0, lift]))
    return replace(path, surface_from_nozzle=path.surface_from_nozzle @ up, extrude=np.zeros(len(path), bool))


def unreachable(path: Path, pose: SurfacePose, profile: ArmProfile) -> str:
    """Why the arm cannot reach all checkpoints where the surface is now, with the planner's margins; "" if it can."""
    limits, arm = profile.limits, profile.arm
    axes = axes_from_nozzle(arm, pose.base_from_surface @ path.surface_from_nozzle)
    if reason := _outside(axes, limits.low + MARGIN, limits.high - MARGIN, AXES):
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
    shown = [values[row, column], low[column], high[column]]
    turns = column >= 3 or len(names[column]) > 1
    got, least, most = np.rad2deg(shown) if turns else shown
    unit = "degrees" if turns else "mm"
    return f"checkpoint {row}: {names[column]} = {got:.1f}, allowed {least:.1f} to {most:.1f} {unit}"
