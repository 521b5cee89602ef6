"""The arm's settings: where it stands, what it can bear, how its wire speaks; by default the thesis's SEED S6H4D."""

from __future__ import annotations

import importlib
import math
from dataclasses import dataclass, field, fields, replace
from importlib.util import find_spec

import numpy as np

from estimation import se3
from estimation.errors import InputError
from estimation.se3 import Array
from hardware.arm.driver import ArmDriver, ByteListener
from hardware.arm.protocol import FRAME_LENGTH, THESIS_DIALECT, Dialect
from hardware.process.clock import tick_in_step
from perception.frames import SYRINGE, check_profile
from planning.clearance import ToolPart
from planning.command import MotionLimits
from planning.kinematics import JointModel, SimpleArm, joints_from_axes, nozzle_from_axes
from planning.motion.curve import LOOKAHEAD
from planning.urdf import UrdfArm

BITS_PER_BYTE = 10  # 8N1: a start bit, eight data bits, a stop bit
MAX_SERVO_LAG = 0.3  # s: a lag measured beyond this is no servo's
MAX_TICK = LOOKAHEAD / 2  # s: longer, and the planner's target would pass between two commands
MAX_LAG = 1.0  # s: nothing moving can be followed that far ahead
MAX_FLIGHT = 0.5  # s: what is under way cannot be called back by an arm without a stop of its own
AXIS_LETTERS = "XYZABC"
AXIS_UNITS = np.array([1.0, 1, 1, *np.deg2rad([1.0, 1, 1])])  # mm and rad, of X Y Z A B C in mm and degrees
UNIT_ROUNDING = 1e-9  # relative, of a number that has been degrees and rad
LIMIT_KEYS = tuple(f.name for f in fields(MotionLimits) if f.name != "zones")
LIMIT_RANGES = {  # in the file's units: beyond, a slip of the pen would switch a check off, or the arm would never move
    "speed": (0.1, 2000.0),  # the arm's own top speed is 250 mm/s; a large industrial arm's is 2 m/s
    "acceleration": (1.0, 100_000.0),  # 100 m/s^2 is ten times gravity
    "jerk": (10.0, 10_000_000.0),  # full acceleration within 10 ms
    "jump": (0.001, 40.0),  # 2 m/s at 50 ticks a second
    "turn": (0.001, 40.0),  # 2000 degrees/s likewise
    "low": (-3000.0, 3000.0),  # nothing on a bench reaches 3 m; angles are within two turns anyhow
    "high": (-3000.0, 3000.0),
    "feed": (0.1, 2000.0),  # as speed
    "pose_age": (0.01, 2.0),  # after 2 s a breathing chest is anywhere within its breath
    "pose_error": (0.001, 10.0),  # ten beads' width
    "surface_speed": (0.1, 1000.0),  # a cough moves a chest by 200 mm/s
    "surface_turn": (0.1, 720.0),
    "stop_time": (0.01, 2.0),  # five times what the slowest arm needs
    "stop_distance": (0.1, 200.0),
    "on_path": (0.001, 10.0),  # ten beads' width
    "pause": (0.0001, 1.0),
}
FAR_LIMIT = 3.0  # times the S6H4D's own: the operator is told of a limit beyond it
AXIS_LIMITS = ("speed", "acceleration", "jerk", "low", "high")  # (6,), the rest are single numbers
ANGLE_LIMITS = ("turn", "surface_turn")  # single numbers in rad
DISPLAY_UNITS = np.array([1.0, 1, 1, *np.rad2deg([1.0, 1, 1])])  # of axes, mm and rad
ARM_FROM_BENCH = se3.make(np.eye(3), [202.5, 225.0, 50.0])  # arm_from_surface under the thesis's home, z up


@dataclass(frozen=True, slots=True)
class Extruder:
    """An axis of the arm itself that pushes material as a part of its moves: it rests where they end."""

    area: float  # mm^2, cross-section of what it pushes
    max_flow: float  # mm^3/s that it pushes, and draws back
    retract_volume: float = 0.0  # mm^3 drawn back after a bead, and pushed again as the next one begins


@dataclass(frozen=True, slots=True, eq=False)
class ArmProfile:
    """One arm. InputError names a setting that makes no sense.

    lag: s from one tick after a command was sent until the arm is at its axes: wire, dead time, servo.
    """

    arm: SimpleArm = field(default_factory=SimpleArm)  # frame, home and joints
    limits: MotionLimits = field(default_factory=MotionLimits)
    dialect: Dialect = THESIS_DIALECT
    baud: int = 115_200  # bits/s, 8N1; thesis 6.2; one public driver uses 9600, at which a frame takes 50 ms
    tick: float = 0.02  # s, 50 commands a second: faster than any camera here, a fifth of what the wire carries
    lag: float = 0.024  # s, 4 ms of wire, and 20 ms that a hobby servo is taken to follow behind until it is measured
    tool: Array = field(default_factory=SYRINGE.copy)  # (K, 2) mm, of what hangs on it: height above the tip, radius
    dead_time: float | None = None  # s that a command takes to the arm; None: what a frame takes at `baud`
    flight: float | None = None  # s of motion that may be under way; None: the link's own limit
    parts: tuple[ToolPart, ...] = ()  # of the tool, beside what `tool` describes
    urdf: UrdfArm | None = None  # the joints of an arm that `arm` has no model of
    flange_from_nozzle: Array | None = None  # (4, 4) mm, for an arm that is told where its flange goes
    extruder: Extruder | None = None  # of a dispenser file; no arm file has one

    def __post_init__(self) -> None:
        if not self.baud > 0:
            raise InputError("arm profile", "baud", self.baud, "> 0 bits/s")
        if self.dead_time is not None and not 0 <= self.dead_time <= MAX_TICK:
            raise InputError("arm profile", "dead_time", self.dead_time, f"0 to {MAX_TICK} s, the longest tick")
        wire = self.frame_time
        if wire > MAX_TICK:
            least = math.ceil(FRAME_LENGTH * BITS_PER_BYTE / MAX_TICK)
            allowed = f"{least} bits/s or more: a frame takes {wire:.3g} s, and a tick is {MAX_TICK} s at most"
            raise InputError("arm profile", "baud", self.baud, allowed)
        if not wire <= self.tick <= MAX_TICK:
            allowed = f"{wire:.5f} s, one frame on the wire, to {MAX_TICK} s"
            raise InputError("arm profile", "tick", self.tick, allowed)
        if not 0 <= self.lag <= MAX_LAG:
            raise InputError("arm profile", "lag", self.lag, f"0 to {MAX_LAG} s")
        if self.flange_from_nozzle is not None and not se3.is_transform(self.flange_from_nozzle):
            got = self.flange_from_nozzle.tolist()
            raise InputError("arm profile", "flange_from_nozzle", got, "a finite 4x4 rigid motion, mm")
        if self.flight is not None and not self.tick <= self.flight <= MAX_FLIGHT:
            allowed = f"{self.tick} s, a tick, to {MAX_FLIGHT} s"
            raise InputError("arm profile", "flight", self.flight, allowed)
        check_profile("arm profile", "tool", self.tool)
        arm, limits = self.arm, self.limits
        if (arm.home < limits.low).any() or (arm.home > limits.high).any():
            low, high = (np.round(axes * DISPLAY_UNITS, 9).tolist() for axes in (limits.low, limits.high))
            allowed = f"X Y Z in mm, A B C in degrees, within {low} and {high}"
            raise InputError("arm profile", "home", np.round(arm.home * DISPLAY_UNITS, 9).tolist(), allowed)
        tip = nozzle_from_axes(arm, arm.home)[:3, 3] if limits.zones else np.zeros(3)
        for zone in limits.zones:
            if zone.depth(tip) > 0:
                raise InputError("arm profile", "home", arm.home.tolist(), f"outside the no-go zone {zone.name!r}")
        if arm.jointed is not None:
            _check_joints(arm, arm.jointed, limits)

    @property
    def frame_time(self) -> float:
        """Seconds that a command takes to the arm: the dead time, or a frame on the wire, 4.17 ms at 115200 bits/s."""
        if self.dead_time is not None:
            return self.dead_time
        return FRAME_LENGTH * BITS_PER_BYTE / self.baud


def at_baud(profile: ArmProfile, baud: int) -> ArmProfile:
    """The profile on a line of `baud` bits/s: no tick is shorter than a frame, and each comes later by what that takes.

    At 9600 bits/s that is 20 ticks a second of 50 ms. The limits of one tick stay: 3 mm of jump are 60 mm/s there.
    """
    wire = FRAME_LENGTH * BITS_PER_BYTE / baud if baud > 0 else 0.0
    return replace(profile, baud=baud, tick=max(profile.tick, wire), lag=profile.lag - profile.frame_time + wire)


def in_step(profile: ArmProfile, interval: float) -> ArmProfile:
    """The profile with a tick that is in step with poses `interval` s apart, if that is not much shorter than its own.

    NaN where nobody knows the interval. No tick is shorter than two frames on the wire.
    """
    shortest = max(profile.tick / 2, 2 * profile.frame_time)
    return replace(profile, tick=tick_in_step(profile.tick, interval, shortest))


def limit_unit(name: str) -> Array:
    """Factor from a limit in the file, in mm and degrees, to mm and rad."""
    return AXIS_UNITS if name in AXIS_LIMITS else np.asarray(np.deg2rad(1.0) if name in ANGLE_LIMITS else 1.0)


def limit_unit_text(name: str) -> str:
    """The unit of a limit in the file."""
    units = {"speed": "s", "acceleration": "s^2", "jerk": "s^3", "feed": "s", "surface_speed": "s", "surface_turn": "s"}
    length = "mm and degrees" if name in AXIS_LIMITS else "degrees" if name in ANGLE_LIMITS else "mm"
    length = "s" if name in ("pose_age", "stop_time", "pause") else length
    return f"{length} per {units[name]}" if name in units else length


def far_limits_text(limits: MotionLimits) -> str:
    """One line for the operator about limits of more than FAR_LIMIT times the S6H4D's own; "" where there are none."""
    usual, texts = MotionLimits(), list[str]()
    for name in LIMIT_KEYS:
        value, usual_value = (np.atleast_1d(getattr(each, name) / limit_unit(name)) for each in (limits, usual))
        times = np.abs(value) / np.abs(usual_value)
        axis = int(times.argmax())
        if times[axis] > FAR_LIMIT * (1 + UNIT_ROUNDING):
            of = f" of {AXIS_LETTERS[axis]}" if name in AXIS_LIMITS else ""
            texts.append(f"limits.{name} = {value[axis]:g}{of}, {times[axis]:.3g} times its {usual_value[axis]:g}")
    return f"limits far beyond a SEED S6H4D's: {'; '.join(texts)}. Does this arm bear them?" if texts else ""


def unreached_limits_text(profile: ArmProfile) -> str:
    """One line about speeds that the planner never reaches, as jump and turn in a tick allow less; "" without any."""
    limits, unit = profile.limits, limit_unit("speed")
    most = limits.per_tick(profile.tick)
    axes = np.flatnonzero(most < limits.speed * (1 - UNIT_ROUNDING)).tolist()
    groups: dict[str, list[str]] = {}
    for i in axes:
        groups.setdefault(f"{(limits.speed / unit)[i]:g}, at most {(most / unit)[i]:.1f}", []).append(AXIS_LETTERS[i])
    limits_text = "; ".join(f"{' '.join(letters)} {each}" for each, letters in groups.items())
    why = f"limits.jump and limits.turn of a tick of {profile.tick:g} s hold for all axes together"
    return f"limits.speed that is never reached: {limits_text}, as {why}" if limits_text else ""


def measured_lag(profile: ArmProfile, lag: float) -> float:
    """The profile's lag, s, or the measured one where that is known. lag: s from set-point to answer, NaN: unknown."""
    return lag + profile.frame_time if 0 < lag < MAX_SERVO_LAG else profile.lag


def _check_joints(arm: SimpleArm, model: JointModel, limits: MotionLimits) -> None:
    """That A B C may do no more than the joints that they are, and that home can be reached."""
    for name, most in (("speed", model.speed), ("acceleration", model.acceleration), ("high", model.high)):
        if (getattr(limits, name)[3:] > most[3:] + 1e-9).any():
            got, allowed = (np.rad2deg(value[3:]).tolist() for value in (getattr(limits, name), most))
            raise InputError("arm profile", f"limits.{name} of A B C", got, f"at most J4 J5 J6's, {allowed} degrees")
    if (limits.low[3:] < model.low[3:] - 1e-9).any():
        got, allowed = (np.rad2deg(value[3:]).tolist() for value in (limits.low, model.low))
        raise InputError("arm profile", "limits.low of A B C", got, f"at least J4 J5 J6's, {allowed} degrees")
    if not np.isfinite(joints_from_axes(model, arm.home)).all():
        raise InputError("arm profile", "home", arm.home.tolist(), "a place that the arm's posture reaches")


def placed(profile: ArmProfile, base_from_surface: Array, arm_from_surface: Array = ARM_FROM_BENCH) -> ArmProfile:
    """The profile with its arm put where the surface (4, 4), mm, then lies at `arm_from_surface`: below home, level."""
    arm_from_base = arm_from_surface @ se3.inverse(base_from_surface)
    return replace(profile, arm=replace(profile.arm, arm_from_base=arm_from_base))


@dataclass(frozen=True, slots=True)
class LinkSettings:
    """Limits of the link, the same for any arm that speaks the protocol. InputError names one that makes no sense."""

    flight: float = 0.05  # s of motion that may be under way, on the wire and in the arm's queue
    frames: int = 4  # that may be under way
    ease: float = 0.005  # share of a tick by which ticks are longer than their moves: more than clocks differ by, and
    # what a stall of 0.6 s has piled up is gone in 120 s
    poll: float = 0.002  # s between looks at the line: half a frame on the wire
    write_timeout: float = 0.2  # s that the port may take no bytes: ten ticks
    off: float = 1.0  # mm beside its way: a bead's width; answers count 0.1 mm, and come some ms late
    off_turn: float = float(np.deg2rad(2.0))  # rad beside its way
    slack: float = 0.05  # s later on its way than its lag: two ticks and what scheduling does to the stamp of an answer
    lost: float = 10.0  # mm beside its way, from which the arm is stopped: three times what one command may jump
    silence: float = 0.5  # s without an answer, after some have come: ten of 27 bytes on the slowest line
    patience: float = 2.0  # s of a hold by the link before it is a stop: three times the longest stall to be lived with
    reopen: float = 0.5  # s between looks for a device that is gone
    speed: float = 20.0  # mm/s of the link's own moves; one public driver homes at 1000 mm/min, 17 mm/s
    turning: float = float(np.deg2rad(20.0))  # rad/s of the link's own moves
    pause_frame: bool = True  # whether the arm understands the control frame that stops it; the thesis knows none

    def __post_init__(self) -> None:
        for name in (f.name for f in fields(self) if f.name != "pause_frame"):
            value = getattr(self, name)
            if not (math.isfinite(value) and (value > 0 or (name == "ease" and value == 0))):
                raise InputError("link", name, value, "a finite number > 0")
        if self.ease > 0.1:
            raise InputError("link", "ease", self.ease, "0 to 0.1")


@dataclass(frozen=True, slots=True)
class DriverKind:
    """One make of arm, by the addresses that lead to it.

    Its module has `open_arm(address, profile, listener) -> ArmDriver`, `emergency_stop(address, profile) ->
    (s, reason)` and `find_arms() -> [(address, description)]`, and is imported where it is used only.
    """

    name: str
    schemes: tuple[str, ...]  # what stands before :// in an address; () : all addresses that no other has
    module: str
    example: str  # an address
    extra: str = ""  # of stillbed, that brings what it imports; "": it needs none
    needs: str = ""  # what it imports, by which its extra is known to be there
    file: str = ""  # of data/arms, the arm file that stands in where none is given; "": the S6H4D's defaults
    dispenser: str = ""  # preset of a dispenser file, of one that this arm moves by itself; "": it moves none

    @property
    def installed(self) -> bool:
        """Whether what it imports is there."""
        return not self.needs or find_spec(self.needs) is not None

    @property
    def remedy(self) -> str:
        """How to install what it imports."""
        return f"pip install 'stillbed[{self.extra}]'"


DRIVERS = (
    DriverKind("SEED S6H4D", (), "hardware.arm.s6h4d", "/dev/ttyUSB0", dispenser="arm_pwm"),
    DriverKind(
        *("Franka FR3, Panda", ("franka",), "hardware.arm.franka", "franka://172.16.0.2"),
        *("franka", "franky", "fr3.toml"),
    ),
    DriverKind(
        *("G-code machine (Marlin)", ("gcode",), "hardware.arm.gcode", "gcode:///dev/ttyACM0"),
        file="gantry.toml",
        dispenser="arm_axis",
    ),
)


def driver_kind(address: str) -> DriverKind:
    """The driver of an address; InputError where its extra is not installed."""
    scheme = address.partition("://")[0] if "://" in address else ""
    kind = next((kind for kind in DRIVERS if scheme in kind.schemes), DRIVERS[0])
    if not kind.installed:
        raise InputError("arm", "address", address, f"stillbed with its extra: {kind.remedy}")
    return kind


def open_arm(address: str, profile: ArmProfile, listener: ByteListener | None = None) -> ArmDriver:
    """The driver of the arm at an address, not connected yet. listener: is told the bytes that pass, both ways."""
    driver: ArmDriver = importlib.import_module(driver_kind(address).module).open_arm(address, profile, listener)
    return driver


def emergency_stop(address: str, profile: ArmProfile) -> tuple[float, str]:
    """Stop an arm whose motion process is gone: when the stop was out, s, and why it could not be, "" if it was."""
    answer: tuple[float, str] = importlib.import_module(driver_kind(address).module).emergency_stop(address, profile)
    return answer


def find_arms(kind: DriverKind) -> list[tuple[str, str]]:
    """The arms that a driver finds now, as (address, description)."""
    arms: list[tuple[str, str]] = importlib.import_module(kind.module).find_arms()
    return arms
