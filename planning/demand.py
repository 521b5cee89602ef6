"""What a path on a moving surface asks of the machine axes: how they change along it, and what the surface adds."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import maximum_filter1d

from estimation.pose import SurfacePose
from estimation.se3 import Array
from planning.curve import Curve
from planning.kinematics import SimpleArm, limited_axes
from planning.stations import Stations

STEP = 0.05  # mm along the path, and
PAUSE = 0.02  # s, over which derivatives are taken: a tick, and what a tool goes in one at the slowest
AROUND = 3  # grid points of a horizon's 30, to each side: the place is passed later than its soonest instant


@dataclass(frozen=True, slots=True, eq=False)
class Demand:
    """At grid points (M,) of a curve, for the D numbers that the limits bind (`limited_axes`).

    axes: (M, D), there when each point is passed at the soonest. first, second: (M, D), derivatives by mm along the
    curve. speed, acceleration: (M, D), mm or rad per s and s^2, the
    largest that the surface's predicted motion alone asks about each point.
    """

    axes: Array
    first: Array
    second: Array
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
    base = pose.base_at(np.concatenate([times - PAUSE, times, times + PAUSE]))
    now = base[count : 2 * count]
    along = limited_axes(arm, np.concatenate([now, now, now]) @ nozzle).reshape(3, count, -1)
    over = limited_axes(arm, base @ np.tile(nozzle[count : 2 * count], (3, 1, 1))).reshape(3, count, -1)
    first, second = _differences(along, STEP)
    turn = (arm.arm_from_base @ now)[:, :3, :3]
    first[:, :3] = (turn @ curve.slope(places)[..., None])[..., 0]
    second[:, :3] = (turn @ curve.curvature(places)[..., None])[..., 0]
    moved = [maximum_filter1d(np.abs(part), 2 * AROUND + 1, axis=0) for part in _differences(over, PAUSE)]
    return Demand(along[1], first, second, *moved)


def _differences(values: Array, step: float) -> tuple[Array, Array]:
    """First and second derivative (M, D) of values (3, M, D) `step` apart."""
    before, here, after = values
    return (after - before) / (2 * step), (after - 2 * here + before) / step**2
