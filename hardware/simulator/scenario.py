"""Scenario files: a simulated print as TOML, in mm, degrees, s and px; every key says its unit.

title = "..."                    # what the scenario is; a comment above it says what it proves
seconds = 20.0
seed = 1
path = "../paths/x.csv"          # checkpoints in the surface frame; files are relative to this one
clearance_mm = 0.4               # lays the path onto the true surface at this height; left out: the path as it is
bead_mm = 1.0
look = "layer"                   # or a number of beads: how often the needle steps aside and what was laid is looked at
faults = ["arm stall 600ms at 5s"]   # what goes wrong, as hardware/process/faults.py names it
[scene]                          # the body or a scan, the wound, its wetness
[[motion]]                       # composed in order; without any the surface is still
[strain]                         # a waveform: the amount of [scene.deformation] over time
[rig]                            # file, or angles_deg, distance_mm, focal_px, size, distortion
[cameras]                        # rate, exposure, way to the computer, clock offsets, lost and damaged frames
[sensor]                         # noise, vignetting, jpeg_quality (0 for lossless pictures)
[tracking]                       # by = "pictures", "thesis", "thesis-flow", "tracks" (the estimator, from tracks that
                                 # nobody has rendered) or "truth"; processing_s = 0.02 or "measured";
                                 # register = "texture" or "scan"
[arm]                            # file, assumed_lag_s, wire_baud, tool_mm (as in an arm file), and the virtual
                                 # controller: servo, dead time, replies
[dispenser]                      # what it does and what the motion knows of it (hardware/simulator/material.py); left
                                 # out: an ideal one
[gel]                            # how what is printed lies: aspect (height by width at rest), sag_s, gloss (0 matt to
                                 # 1); left out: beads are pictures without height
[planted]                        # rig_offset_mm, arm_offset_mm: errors of calibration that nothing in the loop knows of
[limits]                         # what the run must reach, for the exit code
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from estimation import se3
from estimation.errors import InputError
from estimation.rig import Rig
from estimation.se3 import Array
from estimation.synthetic.movements import ComposedMotion
from estimation.synthetic.world import BASE_FROM_REST, arc_rig
from hardware.arm.profile import BITS_PER_BYTE, MAX_LAG, ArmProfile, placed
from hardware.arm.protocol import FRAME_LENGTH
from hardware.files.arm_file import read_arm, tool_from_value
from hardware.files.rig_file import read_rig
from hardware.process import checks
from hardware.process.checks import Table
from hardware.process.faults import Fault, FaultRunner, check_faults, faults_from_texts
from hardware.simulator.arm.settings import ArmSettings, arm_settings_from_table
from hardware.simulator.cameras import CameraSettings, camera_settings_from_table
from hardware.simulator.material import SimulatedDispenser, dispenser_from_table
from hardware.simulator.motion_table import motion_from_tables, waveform_from_table
from hardware.simulator.nozzle_summary import RunLimits, limits_from_table
from hardware.simulator.scenario_tables import sensor_from_table
from hardware.simulator.scene.appearance import Sensor
from hardware.simulator.scene.fields import FRESH_ASPECT, Gel
from perception.tracking import MAP_METHOD, THESIS_FLOW_METHOD, THESIS_METHOD
from planning.kinematics import SimpleArm
from planning.laid_beads import beads_between_looks


@dataclass(frozen=True, slots=True)
class TrackingSettings:
    """How poses are made."""

    pictures: bool = True  # by a tracking step from rendered pictures; else exact ones at their instants
    tracks: bool = False  # without pictures: by the estimator from tracks that nobody has rendered
    processing: float | None = 0.02  # s a frame set, None: as measured; 15 ms of tracking, 5 ms of decoding
    scan: bool = False  # register to the scan; else the path is registered by the skin's texture
    method: str = MAP_METHOD  # of the tracking step, a key of METHODS


@dataclass(frozen=True, slots=True, eq=False)
class Scenario:
    """One simulated print: everything that is true of it and everything the loop knows."""

    file: Path  # where it was read
    title: str
    seconds: float
    seed: int
    path: Path  # file of the checkpoints
    clearance: float | None  # mm above the true surface, None for a path as it is
    bead: float  # width, mm
    scene: Table  # from which the scene is built when it is needed
    motion: ComposedMotion
    strain: Callable[[Array], Array] | None  # amount of the deformation over time, None for none
    rest: Array  # (4, 4) base_from_surface without motion
    rig: Rig  # the cameras as they are
    known_rig: Rig  # as the tracker knows them
    cameras: CameraSettings
    sensor: Sensor
    jpeg_quality: int | None
    tracking: TrackingSettings
    arm: ArmSettings  # the virtual controller
    dispenser: SimulatedDispenser | None  # None: an ideal one
    faults: tuple[Fault, ...]
    true_arm: SimpleArm  # where the arm stands
    baud: float  # bits/s of its line
    profile: ArmProfile  # what the motion knows of the arm
    limits: RunLimits  # what the run must reach
    nozzle: bool  # whether pictures show it
    beads: bool  # whether pictures show what was printed
    gel: Gel | None  # how it lies; None: it has no height
    adapt: bool  # whether each layer takes its flow from what a look found under it
    looks: int | None  # beads from one look at what was laid to the next, 0: a layer; None: nobody looks


SCENARIO_TABLES = (
    "scene",
    "strain",
    "rig",
    "cameras",
    "sensor",
    "tracking",
    "arm",
    "dispenser",
    "gel",
    "planted",
    "limits",
)
OPTIONAL_KEYS = ("seed", "clearance_mm", "bead_mm", "look", "adapt", "faults", "motion", *SCENARIO_TABLES)
MAX_CAMERAS = 8
WITHOUT_PICTURES = ("truth", "tracks")  # ways of tracking that need no pictures
PICTURE_SIDES = 64, 4096  # px of a picture
MAX_SECONDS = 3600.0  # s: an hour of pictures is 300,000 of them
STRAIN_STREAM = 11  # of random numbers, so that motions and strain do not share theirs


def read_scenario(path: str | Path, trace: Path | None = None) -> Scenario:
    """Read and check a scenario; InputError names the key that is wrong.

    trace: a recorded motion, as a [[motion]] of kind "trace" takes it, instead of the scenario's own.
    """
    path = Path(path)
    table = checks.read_toml(path)
    checks.check_keys(path, "", table, ("title", "seconds", "path"), OPTIONAL_KEYS)
    if trace is not None:
        table["motion"] = [{"kind": "trace", "file": str(trace.resolve())}]
    parts = {name: checks.table_at(path, "", table, name) for name in SCENARIO_TABLES}
    seed = checks.integer(path, "seed", table.get("seed", 1), 0)
    rig = _rig(path, parts["rig"])
    arm, profile, baud = _arm(path, parts["arm"])
    planted, keys = parts["planted"], ("rig_offset_mm", "arm_offset_mm")
    checks.check_keys(path, "planted.", planted, (), keys)
    shifts = [checks.numbers(path, f"planted.{key}", planted.get(key, [0, 0, 0]), (3,), "mm") for key in keys]
    rig_shift, arm_shift = (se3.make(np.eye(3), shift) for shift in shifts)
    quality = checks.integer(path, "sensor.jpeg_quality", parts["sensor"].pop("jpeg_quality", 90), 0)
    if quality > 100:
        raise InputError(path, "sensor.jpeg_quality", quality, "1 to 100, or 0 for lossless pictures")
    faults = faults_from_texts(path, "faults", table.get("faults", []))
    check_faults(faults, FaultRunner.SIMULATE, path, "faults", len(rig))
    strain_rng = np.random.default_rng([seed, STRAIN_STREAM])
    return Scenario(
        file=path,
        title=checks.text(path, "title", table["title"]),
        seconds=checks.within(0.1, MAX_SECONDS, "s")(path, "seconds", table["seconds"]),
        seed=seed,
        path=path.parent / checks.text(path, "path", table["path"]),
        clearance=checks.within(0, 50, "mm")(path, "clearance_mm", table["clearance_mm"])
        if "clearance_mm" in table
        else None,
        bead=checks.within(0.05, 20.0, "mm")(path, "bead_mm", table.get("bead_mm", 1.0)),
        nozzle=checks.flag(path, "scene.nozzle", parts["scene"].pop("nozzle", True)),
        beads=checks.flag(path, "scene.beads", parts["scene"].pop("beads", True)),
        scene=parts["scene"],
        motion=motion_from_tables(path, table.get("motion", []), path.parent, seed),
        strain=waveform_from_table(path, "strain", parts["strain"], strain_rng) if parts["strain"] else None,
        rest=BASE_FROM_REST,
        rig=rig,
        known_rig=Rig(tuple(replace(c, base_from_camera=rig_shift @ c.base_from_camera) for c in rig.cameras)),
        cameras=camera_settings_from_table(path, parts["cameras"], [camera.name for camera in rig.cameras]),
        sensor=sensor_from_table(path, parts["sensor"]),
        jpeg_quality=quality or None,
        tracking=checks.record_from_table(path, "tracking.", parts["tracking"], _tracking, TRACKING_KEYS),
        arm=arm,
        dispenser=dispenser_from_table(path, parts["dispenser"], path.parent),
        faults=faults,
        true_arm=profile.arm,
        baud=baud,
        profile=replace(profile, arm=replace(profile.arm, arm_from_base=profile.arm.arm_from_base @ arm_shift)),
        limits=limits_from_table(path, parts["limits"]),
        gel=checks.record_from_table(path, "gel.", parts["gel"], Gel, GEL_KEYS) if parts["gel"] else None,
        adapt=_adapt(path, table),
        looks=beads_between_looks(path, "look", table.get("look")),
    )


GEL_KEYS: checks.Keys = {
    "aspect": ("aspect", checks.within(0.05, FRESH_ASPECT, "of the width")),
    "sag_s": ("sag_time", checks.within(0.01, 1000, "s")),
    "gloss": ("gloss", checks.within(0, 1)),
}


def _adapt(path: Path, table: Table) -> bool:
    value = table.get("adapt", False)
    if not isinstance(value, bool) or (value and "look" not in table):
        raise InputError(path, "adapt", value, "true or false, and with look")
    return value


def _angles(where: object, key: str, value: object) -> Array:
    angles = checks.numbers(where, key, value, (None,), "degrees")
    if not 1 <= len(angles) <= MAX_CAMERAS:
        raise InputError(where, key, value, f"1 to {MAX_CAMERAS} angles")
    return angles


RIG_KEYS: checks.Keys = {  # of cameras on an arc
    "angles_deg": ("angles_deg", _angles),
    "distance_mm": ("distance", checks.within(100, 2000, "mm")),
    "focal_px": ("focal", checks.within(100, 10_000, "px")),
    "size": ("size", checks.whole_pair(*PICTURE_SIDES, "[width, height], whole px, {} to {}".format(*PICTURE_SIDES))),
    "distortion": ("distortion", checks.array((5,), "k1 k2 p1 p2 k3")),
}


def _rig(path: Path, table: Table) -> Rig:
    if "file" in table:
        checks.check_keys(path, "rig.", table, ("file",))
        return read_rig(path.parent / checks.text(path, "rig.file", table["file"])).rig
    return checks.record_from_table(path, "rig.", table, arc_rig, RIG_KEYS)


def _arm(path: Path, table: Table) -> tuple[ArmSettings, ArmProfile, float]:
    """The virtual controller, what the motion knows of it (all of its lag, unless told), and its line's baud."""
    file, assumed, baud, tool = (table.pop(key, None) for key in ("file", "assumed_lag_s", "wire_baud", "tool_mm"))
    settings = arm_settings_from_table(path, table)
    profile = ArmProfile() if file is None else read_arm(path.parent / checks.text(path, "arm.file", file))
    profile = placed(profile, BASE_FROM_REST)
    if baud is None:
        baud = profile.baud
    elif not isinstance(baud, (int, float)) or isinstance(baud, bool) or not baud >= profile.baud:
        allowed = f"{profile.baud} bits/s, the arm's own, or more; inf for no delay"
        raise InputError(path, "arm.wire_baud", baud, allowed)
    lag = settings.dead_time + settings.servo_lag + FRAME_LENGTH * BITS_PER_BYTE / baud
    if assumed is not None:
        lag = checks.within(0, MAX_LAG, "s")(path, "arm.assumed_lag_s", assumed)
    elif lag > MAX_LAG:
        raise InputError(path, "arm.dead_time_s + servo_lag_s", lag, f"at most {MAX_LAG:g} s, or assumed_lag_s")
    if tool is not None:
        profile = replace(profile, tool=tool_from_value(path, "arm.tool_mm", tool))
    return settings, replace(profile, lag=lag), float(baud)


def _tracking(by: str = "pictures", register: str = "texture", **timing: float | None) -> TrackingSettings:
    method = MAP_METHOD if by in ("pictures", *WITHOUT_PICTURES) else by
    pictures, scan = by not in WITHOUT_PICTURES, register == "scan"
    return TrackingSettings(pictures, by == "tracks", **timing, scan=scan, method=method)


def _processing(where: object, key: str, value: object) -> float | None:
    if isinstance(value, str) and value != "measured":
        raise InputError(where, key, value, '0 to 10 s, or "measured"')
    return None if value == "measured" else float(checks.within(0, 10, 's, or "measured"')(where, key, value))


TRACKING_KEYS: checks.Keys = {
    "by": ("by", checks.word(("pictures", THESIS_METHOD, THESIS_FLOW_METHOD, *WITHOUT_PICTURES))),
    "processing_s": ("processing", _processing),
    "register": ("register", checks.word(("texture", "scan"))),
}
