"""The table [kinematics] of an arm file: the joints of an arm, and what its axes A B C are.

name = "nominal six-axis desktop arm"
nominal = true                       # the numbers are made up, not a maker's
angles = "surface"                   # A B C are the surface's turn (thesis 6.3), or "joints": J4 J5 J6
dh_mm_deg = [[30, 90, 160, 0], ...]  # six rows a, alpha, d, theta: Rz(joint + theta) Tz(d) Tx(a) Rx(alpha)
low_deg, high_deg = [...]            # six joints
speed_deg_s, acceleration_deg_s2 = [...]
arm_from_foot = [[...], ...]         # 4x4, mm, from where the table starts to the arm's frame
flange_from_nozzle = [[...], ...]    # 4x4, mm
posture = ["front", "up", "negative"]
"""

from __future__ import annotations

import numpy as np

from estimation.errors import InputError
from estimation.se3 import Array
from hardware.process import checks
from planning.kinematics import Angles, SimpleArm
from planning.robot.kinematics import JointModel

REQUIRED = ("name", "dh_mm_deg", "low_deg", "high_deg", "speed_deg_s", "acceleration_deg_s2")
OPTIONAL = ("nominal", "angles", "arm_from_foot", "flange_from_nozzle", "posture")
_DH = np.array([1.0, np.deg2rad(1.0), 1.0, np.deg2rad(1.0)])  # of a row, in mm and rad
_DEG = float(np.deg2rad(1.0))


def kinematics_from_table(where: object, table: object) -> tuple[JointModel | None, Angles]:
    """The model in a table, and what A B C are; no model without a table. InputError names the key."""
    if table is None:
        return None, Angles.SURFACE
    if not isinstance(table, dict):
        raise InputError(where, "kinematics", table, "a table [kinematics]")
    checks.check_keys(where, "kinematics.", table, REQUIRED, OPTIONAL)

    def numbers(key: str, shape: tuple[int, ...], unit: Array | float = 1.0) -> Array:
        return np.asarray(checks.numbers(where, f"kinematics.{key}", table[key], shape) * unit)

    def place(key: str) -> Array:
        return numbers(key, (4, 4)) if key in table else np.eye(4)

    low, high, speed, acceleration = (numbers(key, (6,), _DEG) for key in REQUIRED[2:])
    nominal = table.get("nominal", True)
    if not isinstance(nominal, bool):
        raise InputError(where, "kinematics.nominal", nominal, "true or false")
    model = JointModel(
        checks.text(where, "kinematics.name", table["name"]),
        numbers("dh_mm_deg", (6, 4), _DH),
        low,
        high,
        speed,
        acceleration,
        place("arm_from_foot"),
        place("flange_from_nozzle"),
        _posture(where, table.get("posture", ["front", "up", "negative"])),
        nominal,
    )
    return model, _angles(where, table.get("angles", Angles.SURFACE.value))


def kinematics_lines(arm: SimpleArm) -> list[str]:
    """The table of an arm as lines of TOML; none where it has no model."""
    if (model := arm.joints) is None:
        return []
    degrees = {
        "low_deg": model.low,
        "high_deg": model.high,
        "speed_deg_s": model.speed,
        "acceleration_deg_s2": model.acceleration,
    }
    quoted = model.name.replace("\\", "\\\\").replace('"', '\\"')
    return [
        "",
        "[kinematics]",
        f'name = "{quoted}"',
        f"nominal = {str(model.nominal).lower()}",
        f'angles = "{arm.angles.value}"',
        f"dh_mm_deg = {checks.toml_numbers(model.dh / _DH)}",
        *(f"{key} = {checks.toml_numbers(np.rad2deg(value))}" for key, value in degrees.items()),
        f"arm_from_foot = {checks.toml_numbers(model.arm_from_foot)}",
        f"flange_from_nozzle = {checks.toml_numbers(model.flange_from_nozzle)}",
        "posture = [" + ", ".join(f'"{word}"' for word in model.posture) + "]",
    ]


def _posture(where: object, value: object) -> tuple[str, str, str]:
    if not (isinstance(value, list) and len(value) == 3):
        raise InputError(where, "kinematics.posture", value, "three words, of shoulder, elbow and wrist")
    return str(value[0]), str(value[1]), str(value[2])


def _angles(where: object, value: object) -> Angles:
    words = [angles.value for angles in Angles]
    if value not in words:
        raise InputError(where, "kinematics.angles", value, checks.meant(str(value), words))
    return Angles(value)
