"""Arm files: an ArmProfile as TOML, in mm, degrees and s; what a file leaves out keeps its default.

home_mm_deg = [202.5, 225, 113, 0, 0, 0]      # X Y Z A B C
arm_from_base = [[...], ...]                  # 4x4, mm
arm_from_upright = [[...], ...]               # 3x3, the nozzle's rotation at A = B = C = 0
tool_offset_mm = [0, 0, 0]                    # tip in the nozzle frame that the arm believes in; `calibrate arm`
motion_byte = 1                               # byte 2 of a G1 frame, 1 or 0
slots = ["J4", "J5", "J6"]                    # which joint stands in each angle slot
origin_scale = 1                              # 10: the origin is sent in tenths of a millimetre
pwm = 0                                       # bytes 27 to 30 of a G1 frame: 0, or 1500 as one driver sends
baud = 115200                                 # or 9600, at which a frame takes 50 ms
tick_s = 0.02                                 # at least a frame's time on the wire, which is the default where longer
lag_s = 0.024                                 # from the end of a tick until the arm is where it was sent in it
tool_mm = [[0, 0.5], [12.7, 0.5], [27, 4.8]]  # height above the tip and radius of what hangs on the arm
[limits]                                      # as in planning/limits.py; arrays are X Y Z in mm, A B C in degrees
speed = [150, 150, 150, 120, 120, 120]
turn = 2.4
[[no_go]]                                     # optional, see hardware/no_go_table.py
[kinematics]                                  # optional, see hardware/kinematics_table.py
"""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path

import numpy as np

from estimation.errors import InputError
from estimation.se3 import Array
from hardware.arm.profile import ArmProfile, at_baud
from hardware.arm.protocol import Dialect
from hardware.kinematics_table import kinematics_from_table, kinematics_lines
from hardware.no_go_table import no_go_lines, zones_from_tables
from hardware.process import checks
from perception.tool_profile import check_profile
from planning.kinematics import SimpleArm
from planning.limits import Limits

KEYS = (
    "home_mm_deg",
    "arm_from_base",
    "arm_from_upright",
    "tool_offset_mm",
    "motion_byte",
    "slots",
    "origin_scale",
    "pwm",
    "baud",
    "tick_s",
    "lag_s",
    "tool_mm",
    "limits",
    "no_go",
    "kinematics",
)
LIMITS = tuple(f.name for f in fields(Limits) if f.name != "zones")
_AXES = ("speed", "acceleration", "jerk", "low", "high")  # (6,), the rest are single numbers
_ANGLES = ("turn", "surface_turn")  # single numbers in rad
_SHAPES: dict[str, tuple[int | None, ...]] = {
    "home_mm_deg": (6,),
    "arm_from_base": (4, 4),
    "arm_from_upright": (3, 3),
    "tool_offset_mm": (3,),
}
PARTS = {"arm profile": "", "arm": "", "dialect": "", "limits": "limits.", "kinematics": "kinematics."}  # with tables
NAMED = {  # by what is wrong with them
    "home": "home_mm_deg",
    "tool_offset": "tool_offset_mm",
    "tick": "tick_s",
    "lag": "lag_s",
    "tool": "tool_mm",
    "kinematics.dh": "kinematics.dh_mm_deg",
    "kinematics.low": "kinematics.low_deg",
    "kinematics.speed": "kinematics.speed_deg_s",
    "kinematics.acceleration": "kinematics.acceleration_deg_s2",
}
_TO_RAD = np.array([1.0, 1, 1, *np.deg2rad([1.0, 1, 1])])


def read_arm(path: str | Path) -> ArmProfile:
    """The profile in an arm file; InputError names the key that makes no sense."""
    path = Path(path)
    table = checks.read_toml(path)
    checks.check_keys(path, "", table, (), KEYS)
    try:
        default = at_baud(ArmProfile(), checks.integer(path, "baud", table.get("baud", ArmProfile().baud), 1))
        given = {key: checks.numbers(path, key, table[key], shape) for key, shape in _SHAPES.items() if key in table}
        return ArmProfile(
            arm=SimpleArm(
                given.get("arm_from_base", default.arm.arm_from_base),
                given.get("arm_from_upright", default.arm.arm_from_upright),
                given["home_mm_deg"] * _TO_RAD if "home_mm_deg" in given else default.arm.home,
                *kinematics_from_table(path, table.get("kinematics")),
                tool_offset=given.get("tool_offset_mm", default.arm.tool_offset),
            ),
            limits=_limits(path, table.get("limits", {}), table.get("no_go")),
            dialect=_dialect(path, table),
            baud=default.baud,
            tick=checks.number(path, "tick_s", table.get("tick_s", default.tick)),
            lag=checks.number(path, "lag_s", table.get("lag_s", default.lag)),
            tool=tool_from_value(path, "tool_mm", table["tool_mm"]) if "tool_mm" in table else default.tool,
        )
    except InputError as error:
        if error.where == str(path):
            raise
        raise _in_file(path, table, error) from None


def write_arm(path: str | Path, profile: ArmProfile, remark: str = "") -> None:
    """Write an arm file that gives the profile back, to rounding of angles."""
    arm, dialect, limits = profile.arm, profile.dialect, profile.limits
    lines = [f"# {line}" for line in remark.splitlines()] + [
        f"home_mm_deg = {checks.toml_numbers(arm.home / _TO_RAD)}",
        f"arm_from_base = {checks.toml_numbers(arm.arm_from_base)}",
        f"arm_from_upright = {checks.toml_numbers(arm.arm_from_upright)}",
        f"tool_offset_mm = {checks.toml_numbers(arm.tool_offset)}",
        f"motion_byte = {dialect.motion_byte}",
        "slots = [" + ", ".join(f'"{joint}"' for joint in dialect.slots) + "]",
        f"origin_scale = {dialect.origin_scale}",
        f"pwm = {checks.toml_number(dialect.pwm)}",
        f"baud = {profile.baud}",
        f"tick_s = {checks.toml_number(profile.tick)}",
        f"lag_s = {checks.toml_number(profile.lag)}",
        f"tool_mm = {checks.toml_numbers(profile.tool)}",
        "",
        "[limits] # X Y Z in mm, A B C in degrees",
        *(f"{name} = {checks.toml_numbers(getattr(limits, name) / _unit(name))}" for name in LIMITS),
        *no_go_lines(limits.zones),
        *kinematics_lines(arm),
    ]
    Path(path).write_text("\n".join(lines) + "\n", encoding="utf-8")


def _in_file(path: Path, table: checks.Table, error: InputError) -> InputError:
    """What is wrong with a part of the profile, by its key and value in the file; of a default, its own value."""
    if error.where not in PARTS:
        return InputError(path, f"{error.where}: {error.what}", error.got, error.allowed)
    key = PARTS[error.where] + error.what
    key = NAMED.get(key, key)
    found: object = table
    for word in key.split("."):
        found = found.get(word) if isinstance(found, dict) else None
    whole = found is None or isinstance(error.got, str)  # one word of a list is what is wrong
    return InputError(path, key, error.got if whole else found, error.allowed)


def tool_from_value(where: object, key: str, value: object) -> Array:
    """A tool's profile (K, 2) of [height, radius], mm, from a file; InputError names the key."""
    profile = checks.numbers(where, key, value, (None, 2), "mm")
    check_profile(where, key, profile)
    return profile


def _unit(name: str) -> Array:
    """What the number in the file is times this, in mm and rad."""
    return _TO_RAD if name in _AXES else np.asarray(np.deg2rad(1.0) if name in _ANGLES else 1.0)


def _limits(path: Path, table: object, zones: object) -> Limits:
    if not isinstance(table, dict):
        raise InputError(path, "limits", table, "a table [limits]")
    checks.check_keys(path, "limits.", table, (), LIMITS)
    given: dict[str, Array | float] = {}
    for name, value in table.items():
        number = checks.numbers(path, f"limits.{name}", value, (6,) if name in _AXES else ()) * _unit(name)
        given[name] = number if name in _AXES else float(number)
    found = () if zones is None else zones_from_tables(path, zones)
    return Limits(**given, zones=found)  # type: ignore[arg-type]


def _dialect(path: Path, table: checks.Table) -> Dialect:
    default = Dialect()
    slots = table.get("slots", list(default.slots))
    if not (isinstance(slots, list) and len(slots) == 3 and all(isinstance(joint, str) for joint in slots)):
        raise InputError(path, "slots", slots, 'three of "J4", "J5", "J6"')
    return Dialect(
        checks.integer(path, "motion_byte", table.get("motion_byte", default.motion_byte), 0),
        tuple(slots),
        checks.integer(path, "origin_scale", table.get("origin_scale", default.origin_scale), 1),
        checks.number(path, "pwm", table.get("pwm", default.pwm)),
    )
