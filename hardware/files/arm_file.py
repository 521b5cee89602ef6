"""Arm files: an ArmProfile as TOML, in mm, degrees and s; keys that a file leaves out have their defaults.

home_mm_deg = [202.5, 225, 113, 0, 0, 0]      # X Y Z A B C
arm_from_base = [[...], ...]                  # 4x4, mm
arm_from_upright = [[...], ...]               # 3x3, the nozzle's rotation at A = B = C = 0
tool_offset_mm = [0, 0, 0]                    # tip in the nozzle frame that the arm believes in; `calibrate arm`
motion_byte = 1                               # byte 2 of a G1 frame, 1 or 0
slots = ["J4", "J5", "J6"]                    # which joint stands in each angle slot
origin_scale = 1                              # 10: the origin is sent in tenths of a millimetre
pwm = 0                                       # bytes 27 to 30 of a G1 frame: 0, or 1500 as one driver sends
pwm_on = 1500                                 # optional, in its place while material is to flow: switches a dispenser
baud = 115200                                 # or 9600, at which a frame takes 50 ms
tick_s = 0.02                                 # at least a frame's time on the wire, which is the default where longer
dead_time_s = 0.0                             # optional, that a command takes to an arm without such a line
flange_from_nozzle = [[...], ...]             # optional, 4x4, mm, for an arm that is told where its flange goes
max_lean_deg = 15                             # optional, of a machine that does not turn: how far its tool may lean
flight_s = 0.05                               # optional, motion that may be under way at once
lag_s = 0.024                                 # from the end of a tick until the arm is where it was sent in it
tool_mm = [[0, 0.5], [12.7, 0.5], [27, 4.8]]  # height above the tip and radius of what hangs on the arm, and turns
                                              # about the nozzle's axis; up to where it is 0.25 wider it is the needle
[[tool_part]]                                 # optional, what else hangs there: mm, nozzle frame, z back into the tool
name = "print head"
box = [[-20, -30, 60], [40, 30, 120]]         # or: cylinder or capsule = [[0, 0, 60], [0, 0, 120]] and radius = 12,
                                              # cone likewise and radii = [5, 12], or mesh = "head.stl" beside this file
[limits]                                      # as in planning/command.py; arrays are X Y Z in mm, A B C in degrees
speed = [150, 150, 150, 120, 120, 120]
turn = 2.4
[[no_go]]                                     # optional, a zone each, mm, base frame
name = "below the printing base"
half_space = [[0, 0, 1], [0, 0, -2]]          # outward normal, a place on the plane
[[no_go]]
name = "patient"
box = [[-300, 50, -100], [300, 150, 40]]      # or: cylinder = [[0, 0, 0], [0, 0, 100]] and radius = 80
[kinematics]                                  # optional: the arm's joints, and what its axes A B C are
name = "nominal six-axis desktop arm"
nominal = true                                # the numbers are made up, not a maker's
angles = "surface"                            # A B C are the surface's turn (thesis 6.3), or "joints": J4 J5 J6
dh_mm_deg = [[30, 90, 160, 0], ...]           # six rows a, alpha, d, theta: Rz(joint + theta) Tz(d) Tx(a) Rx(alpha)
low_deg, high_deg, speed_deg_s, acceleration_deg_s2 = [...] # six joints
arm_from_foot = [[...], ...]                  # 4x4, mm, from where the table starts to the arm's frame
flange_from_nozzle = [[...], ...]             # 4x4, mm
posture = ["front", "up", "negative"]
# or, of an arm of another build: name; urdf = "fr3.urdf", beside this file; flange = "link8", the link that carries the
# tool of flange_from_nozzle; ready_deg = [...], the posture that its joints keep near; urdf_text, in a recording: what
# that file held
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from estimation import se3
from estimation.errors import InputError
from estimation.se3 import Array
from hardware.arm.profile import (
    ARM_FROM_BENCH,
    AXIS_LIMITS,
    AXIS_UNITS,
    LIMIT_KEYS,
    LIMIT_RANGES,
    ArmProfile,
    at_baud,
    driver_kind,
    limit_unit,
    limit_unit_text,
    placed,
)
from hardware.arm.protocol import Dialect
from hardware.files.mesh_file import read_mesh
from hardware.process import checks
from perception import shipped_file
from perception.frames import check_profile
from planning.clearance import BASE_MARGIN, PART_KINDS, ToolBody, ToolPart, tool_body
from planning.command import MotionLimits, NoGo, box, cylinder, half_space
from planning.kinematics import AngleMode, JointModel, SimpleArm
from planning.urdf import UrdfArm

JOINT_KEYS = {"low_deg": "low", "high_deg": "high", "speed_deg_s": "speed", "acceleration_deg_s2": "acceleration"}
PLACE_KEYS = ("arm_from_foot", "flange_from_nozzle")
_RAD = float(np.deg2rad(1.0))  # rad a degree
_DH_UNITS = np.array([1.0, _RAD, 1.0, _RAD])  # mm and rad, of a row in mm and degrees


def _posture(where: object, key: str, value: object) -> tuple[str, ...]:
    if not (isinstance(value, list) and len(value) == 3):
        raise InputError(where, key, value, "three words, of shoulder, elbow and wrist")
    return tuple(map(str, value))


MODEL_KEYS: checks.Keys = {
    "name": ("name", checks.text),
    "dh_mm_deg": ("dh", checks.times(checks.array((6, 4)), _DH_UNITS)),
    **{key: (name, checks.times(checks.array((6,)), _RAD)) for key, name in JOINT_KEYS.items()},
    "nominal": ("nominal", checks.flag),
    "angles": ("angles", checks.member(AngleMode)),
    **{key: (key, checks.array((4, 4))) for key in PLACE_KEYS},
    "posture": ("posture", _posture),
}
URDF_KEYS: checks.Keys = {
    "name": ("name", checks.text),
    "urdf": ("file", lambda where, key, value: Path(str(where)).parent / checks.text(where, key, value)),
    "flange": ("flange", checks.text),
    "ready_deg": ("ready", checks.times(checks.array((None,), "degrees"), _RAD)),
    "urdf_text": ("text", checks.text),
}
URDF_REQUIRED = tuple(key for key in URDF_KEYS if key != "urdf_text")


def _kinematics(where: object, key: str, table: object) -> UrdfArm | tuple[JointModel, AngleMode]:
    """The arm's joints by a URDF file, which is not read here, or by their model, and what A B C are."""
    if not isinstance(table, dict):
        raise InputError(where, key, table, "a table [kinematics]")
    if "urdf" in table:
        return checks.record_from_table(where, "kinematics.", table, UrdfArm, URDF_KEYS, URDF_REQUIRED)
    required = ("name", "dh_mm_deg", *JOINT_KEYS)
    return checks.record_from_table(where, "kinematics.", table, _model, MODEL_KEYS, required)


def _model(angles: AngleMode = AngleMode.SURFACE, **model: Any) -> tuple[JointModel, AngleMode]:
    return JointModel(**model), angles


def _kinematics_lines(arm: SimpleArm) -> list[str]:
    """The table of an arm as lines of TOML; none where it has no model."""
    if (model := arm.joints) is None:
        return []
    joints = {key: np.rad2deg(getattr(model, name)) for key, name in JOINT_KEYS.items()}
    head = {"name": model.name, "nominal": model.nominal, "angles": arm.angles.value, "dh_mm_deg": model.dh / _DH_UNITS}
    places = {key: getattr(model, key) for key in PLACE_KEYS}
    return ["", "[kinematics]", *checks.toml_lines({**head, **joints, **places, "posture": model.posture})]


def _urdf_lines(arm: UrdfArm | None, whole: bool) -> list[str]:
    """The table of such an arm as lines of TOML. whole: with the text of the URDF file, and its name alone."""
    if arm is None:
        return []
    text = arm.text
    if whole and not text:
        with suppress(OSError, UnicodeError):  # a run that needs no kinematics did not read it either
            text = arm.file.read_text(encoding="utf-8")
    values = {
        "name": arm.name,
        "urdf": arm.file.name if text else str(arm.file.resolve()),
        "flange": arm.flange,
        "ready_deg": np.rad2deg(arm.ready),
        "urdf_text": text or None,
    }
    return ["", "[kinematics]", *checks.toml_lines(values)]


ZONE_KINDS = ("half_space", "box", "cylinder")


def _no_go_lines(zones: tuple[NoGo, ...]) -> list[str]:
    """The zones as `[[no_go]]` tables."""
    lines: list[str] = []
    for zone in zones:
        shape: dict[str, object] = {"cylinder": zone.axis, "radius": float(zone.radius)}
        if not zone.radius < float("inf") and len(zone.offsets) == 1:
            shape = {"half_space": zone.normals.repeat(2, axis=0) * [[1.0], [zone.offsets[0]]]}
        elif not zone.radius < float("inf"):
            shape = {"box": (zone.offsets.reshape(2, 3) * [[1.0], [-1.0]])[::-1]}
        lines += ["", "[[no_go]]", *checks.toml_lines({"name": zone.name, **shape})]
    return lines


def _zone(where: object, table: checks.Table) -> NoGo:
    checks.check_keys(where, "no_go.", table, ("name",), (*ZONE_KINDS, "radius"))
    name = checks.text(where, "no_go.name", table["name"])
    kinds = [kind for kind in ZONE_KINDS if kind in table]
    if len(kinds) != 1 or ("radius" in table) != (kinds == ["cylinder"]):
        raise InputError(where, f"no_go {name!r}", kinds, "half_space, box, or cylinder with radius")
    first, second = checks.numbers(where, f"no_go.{kinds[0]}", table[kinds[0]], (2, 3), "mm")
    if kinds == ["half_space"]:
        return half_space(name, first, second)
    radius = checks.number(where, "no_go.radius", table["radius"]) if kinds == ["cylinder"] else 0.0
    zone = cylinder(name, first, second, radius) if kinds == ["cylinder"] else box(name, first, second)
    if max(np.abs(second - first).max(), 2 * radius) < MIN_ZONE_SIZE:
        allowed = f"{MIN_ZONE_SIZE:g} mm or more along its longest side; the unit is mm, not m"
        raise InputError(where, f"no_go {name!r}", table[kinds[0]], allowed)
    return zone


MIN_ZONE_SIZE = 1.0  # mm, the largest side of what an arm must not enter: less was typed in metres


def read_arm(path: str | Path) -> ArmProfile:
    """The profile in an arm file; InputError names the key that makes no sense."""
    return _profile(Path(path), checks.read_toml(Path(path)))


def arm_for(address: str) -> ArmProfile:
    """The profile that stands in for the arm at an address where no arm file is given."""
    file = driver_kind(address).file
    return read_arm(shipped_file("arms", file)) if file else ArmProfile()


def arm_over(configured: ArmProfile, address: str) -> ArmProfile:
    """The profile at `address`, placed so that the `configured` arm's surface is below its home; or `configured`."""
    if not driver_kind(address).file:
        return configured
    profile = arm_for(address)
    base_from_surface = se3.inverse(configured.arm.arm_from_base) @ ARM_FROM_BENCH
    home_shift = profile.arm.home[:3] - ArmProfile().arm.home[:3]
    return placed(profile, base_from_surface, se3.make(np.eye(3), ARM_FROM_BENCH[:3, 3] + home_shift))


def arm_from_text(text: str, where: str | Path) -> ArmProfile:
    """The profile in the text of an arm file; InputError (where) as `read_arm`."""
    return _profile(Path(where), checks.toml_from_text(where, text))


def _profile(path: Path, table: checks.Table) -> ArmProfile:
    return checks.record_from_table(path, "", table, _made, ARM_KEYS)


def _made(
    baud: int = ArmProfile().baud,
    limits: MotionLimits | None = None,
    zones: tuple[NoGo, ...] = (),
    kinematics: UrdfArm | tuple[JointModel, AngleMode] | None = None,
    **values: Any,
) -> ArmProfile:
    """The profile of what the keys of an arm file give."""
    frame, dialect = (
        {name: values.pop(name) for name, _ in keys.values() if name in values} for keys in (FRAME_KEYS, DIALECT_KEYS)
    )
    urdf = kinematics if isinstance(kinematics, UrdfArm) else None
    if isinstance(kinematics, tuple):
        frame["joints"], frame["angles"] = kinematics
    return replace(
        at_baud(ArmProfile(), baud),
        arm=SimpleArm(**frame),
        limits=replace(limits or MotionLimits(), zones=zones),
        dialect=Dialect(**dialect),
        urdf=urdf,
        **values,
    )


def write_arm(path: str | Path, profile: ArmProfile, remark: str = "") -> None:
    """Write an arm file from which the same profile is read, to rounding of angles. remark: comment at its top."""
    Path(path).write_text(arm_text(profile, remark), encoding="utf-8")


def arm_text(profile: ArmProfile, remark: str = "", whole: bool = False) -> str:
    """The text of an arm file, as `write_arm` writes it. whole: it holds its URDF file, for other machines."""
    arm, dialect, limits = profile.arm, profile.dialect, profile.limits
    lean = arm.max_lean and float(np.rad2deg(arm.max_lean))
    values = {
        "home_mm_deg": arm.home / AXIS_UNITS,
        "arm_from_base": arm.arm_from_base,
        "arm_from_upright": arm.arm_from_upright,
        "tool_offset_mm": arm.tool_offset,
        "motion_byte": dialect.motion_byte,
        "slots": dialect.slots,
        "origin_scale": dialect.origin_scale,
        "pwm": float(dialect.pwm),
        "pwm_on": dialect.pwm_on,
        "baud": profile.baud,
        "tick_s": float(profile.tick),
        "lag_s": float(profile.lag),
        "flange_from_nozzle": profile.flange_from_nozzle,
        "dead_time_s": profile.dead_time,
        "flight_s": profile.flight,
        "max_lean_deg": lean,
        "tool_mm": profile.tool,
    }
    lines = [
        *(f"# {line}" for line in remark.splitlines()),
        *checks.toml_lines(values),
        "",
        "[limits] # X Y Z in mm, A B C in degrees",
        *checks.toml_lines({name: getattr(limits, name) / limit_unit(name) for name in LIMIT_KEYS}),
        *_part_lines(profile.parts),
        *_no_go_lines(limits.zones),
        *_kinematics_lines(arm),
        *_urdf_lines(profile.urdf, whole),
    ]
    return "\n".join(lines) + "\n"


def tool_from_value(where: object, key: str, value: object) -> Array:
    """A tool's profile (K, 2) of [height, radius], mm, from a file; InputError names the key."""
    profile = checks.numbers(where, key, value, (None, 2), "mm")
    check_profile(where, key, profile)
    return profile


def _parts(where: object, key: str, value: object) -> tuple[ToolPart, ...]:
    """The parts of the tool that no profile describes, in `[[tool_part]]` tables."""
    return tuple(_part(Path(str(where)), table) for table in checks.tables(where, key, value))


def _zones(where: object, key: str, value: object) -> tuple[NoGo, ...]:
    return tuple(_zone(where, table) for table in checks.tables(where, key, value))


def _part(path: Path, table: checks.Table) -> ToolPart:
    checks.check_keys(path, "tool_part.", table, ("name",), (*PART_KINDS, "radius", "radii"))
    name = checks.text(path, "tool_part.name", table["name"])
    kinds = [kind for kind in PART_KINDS if kind in table]
    shape_keys = {"cylinder": ["radius"], "capsule": ["radius"], "cone": ["radii"]}
    if len(kinds) != 1 or [key for key in ("radius", "radii") if key in table] != shape_keys.get(kinds[0], []):
        allowed = "one of box, cylinder and capsule with radius, cone with radii, mesh"
        raise InputError(path, f"tool_part {name!r}", [key for key in table if key != "name"], allowed)
    kind, key = kinds[0], f"tool_part.{kinds[0]}"
    if kind == "mesh":
        file = path.parent / checks.text(path, key, table[kind])
        return ToolPart(name, kind, np.zeros((2, 3)), np.zeros(2), str(file.resolve()))
    radii = [table["radius"]] * 2 if "radius" in table else table.get("radii", [0.0, 0.0])
    values = checks.numbers(path, key, table[kind], (2, 3), "mm"), checks.numbers(path, f"{key}: radii", radii, (2,))
    try:
        return ToolPart(name, kind, *values)
    except InputError as error:
        raise InputError(path, f"tool_part {name!r}", error.got, error.allowed) from None


def _part_lines(parts: tuple[ToolPart, ...]) -> list[str]:
    """The parts as `[[tool_part]]` tables; a mesh by the whole path of its file."""
    lines: list[str] = []
    for part in parts:
        shape: dict[str, object] = {part.kind: part.file if part.kind == "mesh" else part.ends}
        if part.kind in ("cylinder", "capsule"):
            shape["radius"] = float(part.radii[0])
        shape |= {"radii": part.radii} if part.kind == "cone" else {}
        lines += ["", "[[tool_part]]", *checks.toml_lines({"name": part.name, **shape})]
    return lines


def tool_body_of(profile: ArmProfile, margin: float = BASE_MARGIN, touch: float = 0.0) -> ToolBody:
    """The tool of an arm as a body; reads what meshes it has. InputError where one cannot be read."""
    return tool_body(profile.tool, profile.parts, margin, touch, _mesh_triangles)


def _mesh_triangles(file: str) -> Array:
    """Triangles (T, 3, 3), mm, of a part's mesh."""
    return read_mesh(file).corners


def _limit(name: str) -> checks.Check:
    low, high = LIMIT_RANGES[name]

    def check(where: object, key: str, value: object) -> Array | float:
        limit = checks.numbers(where, key, value, (6,) if name in AXIS_LIMITS else ())
        if limit.min() < low or limit.max() > high:
            raise InputError(where, key, value, f"{low:g} to {high:g}, {limit_unit_text(name)}")
        return limit * limit_unit(name) if name in AXIS_LIMITS else float(limit * limit_unit(name))

    return check


def _limits(where: object, key: str, value: object) -> MotionLimits:
    table, keys = checks.table_at(where, "", {key: value}, key), {name: (name, _limit(name)) for name in LIMIT_KEYS}
    return checks.record_from_table(where, "limits.", table, MotionLimits, keys)


def _slots(where: object, key: str, value: object) -> tuple[str, ...]:
    if not (isinstance(value, list) and len(value) == 3 and all(isinstance(joint, str) for joint in value)):
        raise InputError(where, key, value, 'three of "J4", "J5", "J6"')
    return tuple(value)


FRAME_KEYS: checks.Keys = {  # of SimpleArm
    "home_mm_deg": ("home", checks.times(checks.array((6,)), AXIS_UNITS)),
    "arm_from_base": ("arm_from_base", checks.array((4, 4))),
    "arm_from_upright": ("arm_from_upright", checks.array((3, 3))),
    "tool_offset_mm": ("tool_offset", checks.array((3,))),
    "max_lean_deg": ("max_lean", checks.times(checks.number, _RAD)),
}
DIALECT_KEYS: checks.Keys = {
    "motion_byte": ("motion_byte", checks.whole(0)),
    "slots": ("slots", _slots),
    "origin_scale": ("origin_scale", checks.whole(1)),
    "pwm": ("pwm", checks.number),
    "pwm_on": ("pwm_on", checks.number),
}
ARM_KEYS: checks.Keys = {
    **FRAME_KEYS,
    "flange_from_nozzle": ("flange_from_nozzle", checks.array((4, 4))),
    **DIALECT_KEYS,
    "baud": ("baud", checks.whole(1)),
    "tick_s": ("tick", checks.number),
    "lag_s": ("lag", checks.number),
    "tool_mm": ("tool", tool_from_value),
    "dead_time_s": ("dead_time", checks.number),
    "flight_s": ("flight", checks.number),
    "tool_part": ("parts", _parts),
    "limits": ("limits", _limits),
    "no_go": ("zones", _zones),
    "kinematics": ("kinematics", _kinematics),
}
