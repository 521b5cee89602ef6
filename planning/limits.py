"""What arm and tissue can bear, and how much a pose must be worth before the arm follows it."""

from __future__ import annotations

from dataclasses import dataclass, field, fields

import numpy as np

from estimation.errors import InputError
from estimation.se3 import Array
from planning.no_go import NoGo

MARGIN = np.array([5.0, 5, 5, *np.deg2rad([2, 2, 2])])  # that targets keep from the bounds: braking needs room
JOINT_MARGIN = float(np.deg2rad(2))  # that joints keep from the ends of their ranges


def _six(length: float, angle_deg: float) -> Array:
    return np.array([length] * 3 + [np.deg2rad(angle_deg)] * 3)


@dataclass(frozen=True, slots=True, eq=False)
class Limits:
    """Limits of one run; axes are the machine's X Y Z A B C in mm and rad. InputError names one that makes no sense.

    speed, acceleration, jerk: (6,) per axis and s, s^2, s^3. The planner stays within all three, the guard checks
    the speed. jump: mm, and turn: rad, of one tick. low, high: (6,) where the axes may be. feed: mm/s.
    pose_age: s. pose_error: mm, one standard deviation of the place under the nozzle. surface_speed: mm/s, there.
    surface_turn: rad/s. stop_time: s, and stop_distance: mm, within which the arm comes to rest once it has no pose to
    trust. zones: where the nozzle's tip must not be. on_path: mm that the nozzle may be off its place and still print.
    pause: s of one hold.
    """

    speed: Array = field(default_factory=lambda: _six(150.0, 120.0))  # public drivers run the arm at 167 mm/s
    acceleration: Array = field(default_factory=lambda: _six(1500.0, 1200.0))  # a tenth of a second to full speed
    jerk: Array = field(default_factory=lambda: _six(30_000.0, 24_000.0))  # 50 ms to full acceleration
    jump: float = 3.0  # 150 mm/s along any direction at 50 ticks a second
    turn: float = float(np.deg2rad(2.4))  # 120 degrees/s at 50 ticks a second
    low: Array = field(default_factory=lambda: np.array([-650.0, -650, -200, *-np.deg2rad([60, 60, 60])]))  # reach
    high: Array = field(default_factory=lambda: np.array([650.0, 650, 500, *np.deg2rad([60, 60, 60])]))  # B < 90 deg
    feed: float = 250.0  # the arm's own top speed, 15,000 mm/min in public drivers
    pose_age: float = 0.3  # a camera at 6 fps and 50 ms on the way; what that costs is in pose_error
    pose_error: float = 0.5  # a bead is 0.4 to 1 mm wide
    surface_speed: float = 50.0  # thesis 6.3
    surface_turn: float = float(np.deg2rad(40.0))  # thesis 6.3, read as per second
    stop_time: float = 0.4  # from 150 mm/s under the limits above: 0.15 s
    stop_distance: float = 15.0  # from 150 mm/s under the limits above: 11.3 mm
    on_path: float = 0.5  # half a bead
    zones: tuple[NoGo, ...] = ()  # in the base frame: none is known before somebody has measured it
    pause: float = 0.001  # thesis 6.3: pauses of 1 ms, repeated

    def per_tick(self, tick: float) -> Array:
        """Speed of each axis (6,), per s, that keeps jump and turn of one tick of `tick` s whatever the others do."""
        return np.minimum(self.speed, np.repeat([self.jump / 3**0.5, self.turn], 3) / tick)

    def __post_init__(self) -> None:
        for name in (f.name for f in fields(self) if f.name != "zones"):
            value: Array = np.asarray(getattr(self, name), float)
            shape = (6,) if name in ("speed", "acceleration", "jerk", "low", "high") else ()
            if value.shape != shape or not np.isfinite(value).all():
                raise InputError("limits", name, value.tolist(), "6 finite numbers" if shape else "a finite number")
            if name not in ("low", "high") and (value <= 0).any():
                raise InputError("limits", name, value.tolist(), "> 0")
        if (self.low >= self.high).any():
            raise InputError("limits", "low", self.low.tolist(), "below high, axis by axis")
        if max(abs(self.low[4]), abs(self.high[4])) >= np.pi / 2:
            got = np.rad2deg([self.low[4], self.high[4]]).round(9).tolist()
            raise InputError("limits", "low, high of B", got, "within 90 degrees (gimbal lock)")
