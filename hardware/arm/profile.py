"""The arm's settings: where it stands, what it can bear, how its wire speaks; by default the thesis's SEED S6H4D."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from estimation import se3
from estimation.errors import InputError
from estimation.se3 import Array
from hardware.arm.protocol import LENGTH, THESIS, Dialect
from perception.tool_profile import SYRINGE, check_profile
from planning.kinematics import SimpleArm, joints_from_axes, nozzle_from_axes
from planning.limits import Limits
from planning.motion.follow import LEAD
from planning.robot.kinematics import JointModel

BITS_PER_BYTE = 10  # 8N1: a start bit, eight data bits, a stop bit
LONGEST_LAG = 1.0  # s: nothing moving can be followed that far ahead
TO_DEG = np.array([1.0, 1, 1, *np.rad2deg([1.0, 1, 1])])  # of axes, mm and rad
BENCH = se3.make(np.eye(3), [202.5, 225.0, 50.0])  # arm_from_surface under the thesis's home, z up


@dataclass(frozen=True, slots=True, eq=False)
class ArmProfile:
    """One arm. InputError names a setting that makes no sense.

    arm: its frame and home. limits: what it bears. dialect: its frames. baud: bits/s, 8N1. tick: s between commands.
    lag: s that it is later at a command's axes than one tick after the command was sent: wire, dead time, servo.
    tool: (K, 2) mm, what hangs on it, turned about the nozzle: height above the tip, rising, and radius there.
    """

    arm: SimpleArm = field(default_factory=SimpleArm)
    limits: Limits = field(default_factory=Limits)
    dialect: Dialect = THESIS
    baud: int = 115_200  # thesis 6.2; one public driver uses 9600, at which a frame takes 50 ms
    tick: float = 0.02  # 50 commands a second: faster than any camera here, a fifth of what the wire carries
    lag: float = 0.024  # 4 ms of wire, and 20 ms that a hobby servo is taken to follow behind until it is measured
    tool: Array = field(default_factory=SYRINGE.copy)

    def __post_init__(self) -> None:
        if not self.baud > 0:
            raise InputError("arm profile", "baud", self.baud, "> 0 bits/s")
        wire = self.frame_time
        if not wire <= self.tick <= LEAD / 2:
            raise InputError("arm profile", "tick", self.tick, f"{wire:.5f} s, one frame on the wire, to {LEAD / 2} s")
        if not 0 <= self.lag <= LONGEST_LAG:
            raise InputError("arm profile", "lag", self.lag, f"0 to {LONGEST_LAG} s")
        check_profile("arm profile", "tool", self.tool)
        arm, limits = self.arm, self.limits
        if (arm.home < limits.low).any() or (arm.home > limits.high).any():
            low, high = (np.round(axes * TO_DEG, 9).tolist() for axes in (limits.low, limits.high))
            allowed = f"X Y Z in mm, A B C in degrees, within {low} and {high}"
            raise InputError("arm profile", "home", np.round(arm.home * TO_DEG, 9).tolist(), allowed)
        tip = nozzle_from_axes(arm, arm.home)[:3, 3] if limits.zones else np.zeros(3)
        for zone in limits.zones:
            if zone.depth(tip) > 0:
                raise InputError("arm profile", "home", arm.home.tolist(), f"outside the no-go zone {zone.name!r}")
        if arm.jointed is not None:
            _check_joints(arm, arm.jointed, limits)

    @property
    def frame_time(self) -> float:
        """Seconds that one frame takes on the wire: 4.17 ms at 115200 bits/s."""
        return LENGTH * BITS_PER_BYTE / self.baud


def at_baud(profile: ArmProfile, baud: int) -> ArmProfile:
    """The profile on a line of `baud` bits/s: no tick is shorter than a frame, and each comes later by what that takes.

    At 9600 bits/s that is 20 ticks a second of 50 ms. The limits of one tick stay: 3 mm of jump are 60 mm/s there.
    """
    wire = LENGTH * BITS_PER_BYTE / baud if baud > 0 else 0.0
    return replace(profile, baud=baud, tick=max(profile.tick, wire), lag=profile.lag - profile.frame_time + wire)


def _check_joints(arm: SimpleArm, model: JointModel, limits: Limits) -> None:
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


def placed(profile: ArmProfile, base_from_surface: Array, arm_from_surface: Array = BENCH) -> ArmProfile:
    """The profile with its arm put where the surface (4, 4), mm, then lies at `arm_from_surface`: below home, level."""
    arm_from_base = arm_from_surface @ se3.inverse(base_from_surface)
    return replace(profile, arm=replace(profile.arm, arm_from_base=arm_from_base))
