"""What the tests of the virtual arm share: where it stands, and frames for it."""

from __future__ import annotations

import numpy as np

from estimation.se3 import Array
from hardware.arm.driver import G1
from hardware.arm.protocol import THESIS_DIALECT, encode
from hardware.process.faults import Fault, FaultPart, fault_from_text
from hardware.simulator.arm.controller import VirtualArm
from hardware.simulator.arm.settings import ArmSettings

HOME = np.array([202.5, 225, 113, 0, 0, 0])
IDEAL = ArmSettings(servo_lag=0.0)


def virtual_arm(settings: ArmSettings = IDEAL, *faults: Fault) -> VirtualArm:
    return VirtualArm(settings, THESIS_DIALECT, HOME, faults)


def move(feed: float, **axes: float) -> bytes:
    """A frame that goes to home but for the named axes, x y z in mm and a b c in degrees, at `feed` mm/s."""
    target = HOME.copy()
    for name, value in axes.items():
        target["xyzabc".index(name)] = value if name in "xyz" else np.deg2rad(value)
    return encode(G1(target, feed))


def axes_at(arm: VirtualArm, *instants: float) -> Array:
    """Executed axes (N, 6), X Y Z in mm and A B C in degrees; time passes as far as needed."""
    arm.advance(max(arm.now, *instants))
    return arm.axes_at(np.array(instants)) * np.array([1, 1, 1, *np.rad2deg([1.0, 1, 1])])


def motion(arm: VirtualArm) -> tuple[Array, Array]:
    """Every millisecond so far: stamps (N,), s, and executed axes (N, 6), mm and rad."""
    stamps = np.minimum(np.arange(int(arm.now / 0.001 + 1e-6) + 1) * 0.001, arm.now)
    return stamps, arm.axes_at(stamps)


def arm_fault(text: str) -> Fault:
    """A fault of the arm by its text, which need not name the arm."""
    return fault_from_text("x.toml", "arm.faults", text, FaultPart.ARM)
