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
# tool of flange_from_nozzle; ready_deg = [...], the posture that its joints keep near
"""

from __future__ import annotations

import json
from pathlib import Path

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

URDF_KEYS = ("name", "urdf", "flange", "ready_deg")
JOINT_KEYS = {"low_deg": "low", "high_deg": "high", "speed_deg_s": "speed", "acceleration_deg_s2": "acceleration"}
PLACE_KEYS = ("arm_from_foot", "flange_from_nozzle")
_RAD = float(np.deg2rad(1.0))  # rad a degree
_DH_UNITS = np.array([1.0, _RAD, 1.0, _RAD])  # mm and rad, of a row in mm and degrees


def _kinematics(where: object, table: object) -> tuple[JointModel | None, AngleMode]:
    """The model in the table, and what A B C are; no model without a table. InputError names the key."""
    if table is None:
        return None, AngleMode.SURFACE
    if not isinstance(table, dict):
        raise InputError(where, "kinematics", table, "a table [kinematics]")
    required, optional = ("name", "dh_mm_deg", *JOINT_KEYS), ("nominal", "angles", *PLACE_KEYS, "posture")
    checks.check_keys(where, "kinematics.", table, required, optional)

    def numbers(key: str, shape: tuple[int, ...], unit: Array | float = 1.0) -> Array:
        return np.asarray(checks.numbers(where, f"kinematics.{key}", table[key], shape) * unit)

    joints = {name: numbers(key, (6,), _RAD) for key, name in JOINT_KEYS.items()}
    nominal, posture = table.get("nominal", True), table.get("posture", ["front", "up", "negative"])
    if not isinstance(nominal, bool):
        raise InputError(where, "kinematics.nominal", nominal, "true or false")
    name, dh = checks.text(where, "kinematics.name", table["name"]), numbers("dh_mm_deg", (6, 4), _DH_UNITS)
    places = {key: numbers(key, (4, 4)) for key in PLACE_KEYS if key in table}
    if not (isinstance(posture, list) and len(posture) == 3):
        raise InputError(where, "kinematics.posture", posture, "three words, of shoulder, elbow and wrist")
    shoulder, elbow, wrist = map(str, posture)
    model = JointModel(name, dh, **joints, **places, posture=(shoulder, elbow, wrist), nominal=nominal)
    angles, modes = table.get("angles", AngleMode.SURFACE.value), [mode.value for mode in AngleMode]
    if angles not in modes:
        raise InputError(where, "kinematics.angles", angles, checks.one_of_text(str(angles), modes))
    return model, AngleMode(angles)


def _kinematics_lines(arm: SimpleArm) -> list[str]:
    """The table of an arm as lines of TOML; none where it has no model."""
    if (model := arm.joints) is None:
        return []
    quoted = model.name.replace("\\", "\\\\").replace('"', '\\"')
    return [
        "",
        "[kinematics]",
        f'name = "{quoted}"',
        f"nominal = {str(model.nominal).lower()}",
        f'angles = "{arm.angles.value}"',
        f"dh_mm_deg = {checks.toml_numbers(model.dh / _DH_UNITS)}",
        *(f"{key} = {checks.toml_numbers(np.rad2deg(getattr(model, name)))}" for key, name in JOINT_KEYS.items()),
        *(f"{key} = {checks.toml_numbers(getattr(model, key))}" for key in PLACE_KEYS),
        f"posture = {json.dumps(model.posture)}",
    ]


def _urdf(path: Path, table: checks.Table) -> UrdfArm:
    """The arm that a URDF file describes, which is not read here."""
    checks.check_keys(path, "kinematics.", table, URDF_KEYS, ())
    name, file, flange = (checks.text(path, f"kinematics.{key}", table[key]) for key in URDF_KEYS[:3])
    ready = checks.numbers(path, "kinematics.ready_deg", table["ready_deg"], (None,), "degrees") * _RAD
    return UrdfArm(name, path.parent / file, flange, np.asarray(ready))


def _urdf_lines(arm: UrdfArm | None) -> list[str]:
    """The table of such an arm as lines of TOML."""
    if arm is None:
        return []
    texts = {"name": arm.name, "urdf": str(arm.file.resolve()), "flange": arm.flange}
    ready = f"ready_deg = {checks.toml_numbers(np.rad2deg(arm.ready))}"
    return ["", "[kinematics]", *(f"{key} = {json.dumps(text)}" for key, text in texts.items()), ready]


ZONE_KINDS = ("half_space", "box", "cylinder")


def _no_go_lines(zones: tuple[NoGo, ...]) -> list[str]:
    """The zones as `[[no_go]]` tables."""
    lines: list[str] = []
    for zone in zones:
        lines += ["", "[[no_go]]", f'name = "{zone.name}"']
        if zone.radius < float("inf"):
            lines += [f"cylinder = {checks.toml_numbers(zone.axis)}", f"radius = {checks.toml_number(zone.radius)}"]
        elif len(zone.offsets) == 1:
            plane = zone.normals.repeat(2, axis=0) * [[1.0], [zone.offsets[0]]]
            lines.append(f"half_space = {checks.toml_numbers(plane)}")
        else:
            corners = (zone.offsets.reshape(2, 3) * [[1.0], [-1.0]])[::-1]
            lines.append(f"box = {checks.toml_numbers(corners)}")
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
_ARRAYS = {  # shapes
    **{"home_mm_deg": (6,), "arm_from_base": (4, 4), "arm_from_upright": (3, 3), "tool_offset_mm": (3,)},
    **{"flange_from_nozzle": (4, 4)},
}
ARM_KEYS = (
    *(*_ARRAYS, "motion_byte", "slots", "origin_scale", "pwm", "pwm_on", "baud", "tick_s", "lag_s", "tool_mm"),
    *("dead_time_s", "flight_s", "max_lean_deg", "tool_part", "limits", "no_go", "kinematics"),
)
# of errors about a part of the profile: the prefix of the part's keys in the file; keys that are not the fields' names
PART_PREFIXES = {"arm profile": "", "arm": "", "dialect": "", "limits": "limits.", "kinematics": "kinematics."}
FILE_KEYS = {
    **{"home": "home_mm_deg", "tool_offset": "tool_offset_mm", "tick": "tick_s", "lag": "lag_s", "tool": "tool_mm"},
    **{"dead_time": "dead_time_s", "flight": "flight_s", "max_lean": "max_lean_deg"},
    "kinematics.dh": "kinematics.dh_mm_deg",
    **{f"kinematics.{name}": f"kinematics.{key}" for key, name in JOINT_KEYS.items()},
}


def read_arm(path: str | Path) -> ArmProfile:
    """The profile in an arm file; InputError names the key that makes no sense."""
    return _profile(Path(path), checks.read_toml(Path(path)))


def arm_for(address: str) -> ArmProfile:
    """The profile that stands in for the arm at an address where no arm file is given."""
    file = driver_kind(address).file
    return read_arm(shipped_file("arms", file)) if file else ArmProfile()


def arm_over(known: ArmProfile, address: str) -> ArmProfile:
    """That profile, put so that the surface below the home of a `known` arm is below this one's; or the known one."""
    if not driver_kind(address).file:
        return known
    profile = arm_for(address)
    base_from_surface = se3.inverse(known.arm.arm_from_base) @ ARM_FROM_BENCH
    moved = profile.arm.home[:3] - ArmProfile().arm.home[:3]
    return placed(profile, base_from_surface, se3.make(np.eye(3), ARM_FROM_BENCH[:3, 3] + moved))


def arm_from_text(text: str, where: str | Path) -> ArmProfile:
    """The profile in the text of an arm file; InputError (where) as `read_arm`."""
    return _profile(Path(where), checks.toml_from_text(where, text))


def _profile(path: Path, table: checks.Table) -> ArmProfile:
    checks.check_keys(path, "", table, (), ARM_KEYS)
    try:
        kinematics = table.get("kinematics")
        by_urdf = isinstance(kinematics, dict) and "urdf" in kinematics
        default = at_baud(ArmProfile(), checks.integer(path, "baud", table.get("baud", ArmProfile().baud), 1))
        arrays = {key: checks.numbers(path, key, table[key], shape) for key, shape in _ARRAYS.items() if key in table}
        keys = "max_lean_deg", "dead_time_s", "flight_s"
        lean, dead_time, flight = (checks.number(path, k, table[k]) if k in table else None for k in keys)
        return ArmProfile(
            arm=SimpleArm(
                arrays.get("arm_from_base", default.arm.arm_from_base),
                arrays.get("arm_from_upright", default.arm.arm_from_upright),
                arrays["home_mm_deg"] * AXIS_UNITS if "home_mm_deg" in arrays else default.arm.home,
                *_kinematics(path, None if by_urdf else kinematics),
                tool_offset=arrays.get("tool_offset_mm", default.arm.tool_offset),
                max_lean=None if lean is None else lean * _RAD,
            ),
            limits=_limits(path, table.get("limits", {}), table.get("no_go")),
            dialect=_dialect(path, table),
            baud=default.baud,
            tick=checks.number(path, "tick_s", table.get("tick_s", default.tick)),
            lag=checks.number(path, "lag_s", table.get("lag_s", default.lag)),
            flange_from_nozzle=arrays.get("flange_from_nozzle"),
            urdf=_urdf(path, table["kinematics"]) if by_urdf else None,
            dead_time=dead_time,
            flight=flight,
            tool=tool_from_value(path, "tool_mm", table["tool_mm"]) if "tool_mm" in table else default.tool,
            parts=_parts(path, table.get("tool_part")),
        )
    except InputError as error:
        if error.where == str(path):
            raise
        raise _in_file(path, table, error) from None


def write_arm(path: str | Path, profile: ArmProfile, remark: str = "") -> None:
    """Write an arm file from which the same profile is read, to rounding of angles. remark: comment at its top."""
    Path(path).write_text(arm_text(profile, remark), encoding="utf-8")


def arm_text(profile: ArmProfile, remark: str = "") -> str:
    """The text of an arm file, as `write_arm` writes it."""
    arm, dialect, limits = profile.arm, profile.dialect, profile.limits
    lean = arm.max_lean and np.rad2deg(arm.max_lean)
    flange = [] if (at := profile.flange_from_nozzle) is None else [f"flange_from_nozzle = {checks.toml_numbers(at)}"]
    optional = {"dead_time_s": profile.dead_time, "flight_s": profile.flight, "max_lean_deg": lean}
    lines = [f"# {line}" for line in remark.splitlines()] + [
        f"home_mm_deg = {checks.toml_numbers(arm.home / AXIS_UNITS)}",
        f"arm_from_base = {checks.toml_numbers(arm.arm_from_base)}",
        f"arm_from_upright = {checks.toml_numbers(arm.arm_from_upright)}",
        f"tool_offset_mm = {checks.toml_numbers(arm.tool_offset)}",
        f"motion_byte = {dialect.motion_byte}",
        f"slots = {json.dumps(dialect.slots)}",
        f"origin_scale = {dialect.origin_scale}",
        f"pwm = {checks.toml_number(dialect.pwm)}",
        *([] if dialect.pwm_on is None else [f"pwm_on = {checks.toml_number(dialect.pwm_on)}"]),
        f"baud = {profile.baud}",
        f"tick_s = {checks.toml_number(profile.tick)}",
        f"lag_s = {checks.toml_number(profile.lag)}",
        *flange,
        *(f"{key} = {checks.toml_number(value)}" for key, value in optional.items() if value is not None),
        f"tool_mm = {checks.toml_numbers(profile.tool)}",
        "",
        "[limits] # X Y Z in mm, A B C in degrees",
        *(f"{name} = {checks.toml_numbers(getattr(limits, name) / limit_unit(name))}" for name in LIMIT_KEYS),
        *_part_lines(profile.parts),
        *_no_go_lines(limits.zones),
        *_kinematics_lines(arm),
        *_urdf_lines(profile.urdf),
    ]
    return "\n".join(lines) + "\n"


def _in_file(path: Path, table: checks.Table, error: InputError) -> InputError:
    """The error about a part of the profile with the key and the value in the file; of a default with its own value."""
    if error.where not in PART_PREFIXES:
        return InputError(path, f"{error.where}: {error.what}", error.got, error.allowed)
    key = PART_PREFIXES[error.where] + error.what
    key = FILE_KEYS.get(key, key)
    value: object = table
    for word in key.split("."):
        value = value.get(word) if isinstance(value, dict) else None
    whole = value is None or isinstance(error.got, str)  # one word of a list is what is wrong
    return InputError(path, key, error.got if whole else value, error.allowed)


def tool_from_value(where: object, key: str, value: object) -> Array:
    """A tool's profile (K, 2) of [height, radius], mm, from a file; InputError names the key."""
    profile = checks.numbers(where, key, value, (None, 2), "mm")
    check_profile(where, key, profile)
    return profile


def _parts(path: Path, tables: object) -> tuple[ToolPart, ...]:
    """The parts of the tool that no profile describes, in `[[tool_part]]` tables."""
    return tuple(_part(path, table) for table in ([] if tables is None else checks.tables(path, "tool_part", tables)))


def _part(path: Path, table: checks.Table) -> ToolPart:
    checks.check_keys(path, "tool_part.", table, ("name",), (*PART_KINDS, "radius", "radii"))
    name = checks.text(path, "tool_part.name", table["name"])
    kinds = [kind for kind in PART_KINDS if kind in table]
    wanted = {"cylinder": ["radius"], "capsule": ["radius"], "cone": ["radii"]}
    if len(kinds) != 1 or [key for key in ("radius", "radii") if key in table] != wanted.get(kinds[0], []):
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
        value = json.dumps(part.file) if part.kind == "mesh" else checks.toml_numbers(part.ends)
        lines += ["", "[[tool_part]]", f"name = {json.dumps(part.name)}", f"{part.kind} = {value}"]
        if part.kind in ("cylinder", "capsule"):
            lines.append(f"radius = {checks.toml_number(part.radii[0])}")
        lines += [f"radii = {checks.toml_numbers(part.radii)}"] if part.kind == "cone" else []
    return lines


def tool_body_of(profile: ArmProfile, margin: float = BASE_MARGIN, touch: float = 0.0) -> ToolBody:
    """The tool of an arm as a body; reads what meshes it has. InputError where one cannot be read."""
    return tool_body(profile.tool, profile.parts, margin, touch, _mesh_triangles)


def _mesh_triangles(file: str) -> Array:
    """Triangles (T, 3, 3), mm, of a part's mesh."""
    return read_mesh(file).scan.corners


def _limits(path: Path, table: object, zones: object) -> MotionLimits:
    if not isinstance(table, dict):
        raise InputError(path, "limits", table, "a table [limits]")
    checks.check_keys(path, "limits.", table, (), LIMIT_KEYS)
    limits: dict[str, Array | float] = {}
    for name, value in table.items():
        number = checks.numbers(path, f"limits.{name}", value, (6,) if name in AXIS_LIMITS else ()) * limit_unit(name)
        limits[name] = number if name in AXIS_LIMITS else float(number)
    no_go = [] if zones is None else [_zone(path, each) for each in checks.tables(path, "no_go", zones)]
    checked = MotionLimits(**limits, zones=tuple(no_go))  # type: ignore[arg-type]
    for name, value in table.items():
        low, high = LIMIT_RANGES[name]
        if np.min(value) < low or np.max(value) > high:
            raise InputError(path, f"limits.{name}", value, f"{low:g} to {high:g}, {limit_unit_text(name)}")
    return checked


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
        checks.number(path, "pwm_on", table["pwm_on"]) if "pwm_on" in table else None,
    )
