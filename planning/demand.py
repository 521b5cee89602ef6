"""What a path on a moving surface asks of the machine axes: how they change along it, and what the surface adds."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import maximum_filter1d

from estimation.pose import SurfacePose
from estimation.se3 import Array
from planning.kinematics import SimpleArm, limited_axes, most_change
from planning.motion.curve import Curve
from planning.stations import Stations

STEP = 0.05  # mm along the path, and
PAUSE = 0.02  # s, over which derivatives are taken: a tick, and what a tool goes in one at the slowest
AROUND = 3  # grid points of a horizon's 30, to each side: the place is passed later than its soonest instant


@dataclass(frozen=True, slots=True, eq=False)
class Demand:
    """At grid points (M,) of a curve, for the D numbers that the limits bind (`limited_axes`).

    axes: (M, D), there when each point is passed at the soonest. first, second: (M, D), derivatives by mm along the
    curve, the first beside a corner as large as it may be on any side. bend: (M, D), by how much the first changes a mm
    within any corner beside each point, at most, and swerve: (M, D), over all of them. speed, acceleration: (M, D), mm
    or rad per s and s^2, the largest that the surface's predicted motion alone asks about each point.
    """

    axes: Array
    first: Array
    second: Array
    bend: Array
    swerve: Array
    speed: Array
    acceleration: Array


def demand(arm: SimpleArm, pose: SurfacePose, curve: Curve, grid: Stations, begin: float) -> Demand:
    """What the curve asks where the surface moves as `pose` predicts, the grid being entered at `begin`, s.

    X Y Z change along the curve by its own derivatives, blends included, all else by differences.
    """
    places, times = grid.places, begin + grid.due
    count = len(places)
    nozzle = curve.poses(np.concatenate([places - STEP, places, places + STEP]))
    if pose.warp is not None:
        nozzle = pose.warp.carry(nozzle)
    base = pose.base_at(np.concatenate([times - PAUSE, times, times + PAUSE])).reshape(3, count, 4, 4)
    nozzle, now = nozzle.reshape(3, count, 4, 4), base[1]
    asked = limited_axes(arm, np.stack([now @ nozzle, base @ nozzle[1]])).reshape(2, 3, count, -1)
    first, second = _differences(asked[0], STEP)
    turn = arm.arm_from_base[:3, :3] @ now[:, :3, :3]
    along = turn @ np.stack(curve.derivatives(places), axis=-1)
    first[:, :3], second[:, :3] = along[..., 0], along[..., 1]
    moved = maximum_filter1d(np.abs(np.stack(_differences(asked[1], PAUSE))), 2 * AROUND + 1, axis=1)
    by_move, by_turn = most_change(arm, asked[0, 1])
    bend = by_move * grid.bend[:, None] + by_turn * grid.swing[:, None]
    most = by_move + by_turn * grid.spin[:, None]
    first = np.where(bend > 0, np.copysign(np.maximum(np.abs(first), most), first), first)
    return Demand(asked[0, 1], first, second, bend, 2 * most, *moved)


def _differences(values: Array, step: float) -> tuple[Array, Array]:
    """First and second derivative (M, D) of values (3, M, D) `step` apart."""
    before, here, after = values
    return (after - before) / (2 * step), (after - 2 * here + before) / step**2
