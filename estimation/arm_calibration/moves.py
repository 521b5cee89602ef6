"""Whether a set of moves tells what is sought: degenerate sets are named, and none is accepted."""

from __future__ import annotations

import numpy as np

from estimation import se3
from estimation.arm_calibration.set_point import SetPoint
from estimation.calibration.arm_model import Kinematics
from estimation.calibration.arm_start import FEWEST
from estimation.errors import InputError
from estimation.se3 import Array

LINE, PLANE = 10.0, 5.0  # mm, root mean square of places beside a line, or a plane, that they must not all lie in
TURNED = float(np.deg2rad(3.0))  # root mean square turn about the axis that is turned about least but one
MOVING, FAST, SWUNG = 20, 10.0, 400.0  # pictures on the way; mm/s; mm/s^2: see `check_latency`
WHERE = "arm calibration"


def check_places(points: Array) -> None:
    """InputError unless places (N, 3), mm, of the arm hold a pose in space."""
    if len(points) < FEWEST:
        raise InputError(WHERE, "places", len(points), f"{FEWEST} or more")
    spread = np.linalg.svd(points - points.mean(0), compute_uv=False) / np.sqrt(len(points))
    if spread[1] < LINE:
        allowed = f"{LINE:g} mm or more: places on one line leave the turn about it open"
        raise InputError(WHERE, "spread of the places across a line", f"{spread[1]:.1f} mm", allowed)
    if spread[2] < PLANE:
        allowed = f"{PLANE:g} mm or more: places in one plane do not show what the arm's axis across it does"
        raise InputError(WHERE, "spread of the places across a plane", f"{spread[2]:.1f} mm", allowed)


def check_turns(arm_from_nozzle: Array) -> None:
    """InputError unless the tool's turns (N, 4, 4) tell where its tip is: about two axes at least."""
    first = arm_from_nozzle[0, :3, :3].T
    turns = se3.log_rotation(first @ arm_from_nozzle[:, :3, :3])
    spread = np.linalg.svd(turns - turns.mean(0), compute_uv=False) / np.sqrt(len(turns))
    spread = np.concatenate([spread, np.zeros(3)])[:3]
    if spread[0] < TURNED:
        allowed = "moves that turn A, B and C by 10 degrees and more, or --keep-tool: without, the tip's place is open"
        raise InputError(WHERE, "turns of the tool", f"{np.rad2deg(spread[0]):.1f} degrees", allowed)
    if spread[1] < TURNED:
        axis = "xyz"[int(np.abs(np.linalg.svd(turns - turns.mean(0))[2][0]).argmax())]
        allowed = f"turns about a second axis too, or --keep-tool: along {axis} the tip is open"
        raise InputError(WHERE, "turns of the tool", f"about {axis} alone", allowed)


def check_latency(set_point: SetPoint, kinematics: Kinematics, stamps: Array) -> None:
    """InputError unless pictures at stamps (N,), s, show moves fast and lively enough to tell dead time from lag.

    A steady move shows only their sum; what tells them apart is acceleration, by lag^2 / 2 of it.
    """
    step = 0.01
    around = [kinematics(set_point.lagged(stamps + h, 0.0, step))[:, :3, 3] for h in (-step, 0.0, step)]
    speed = np.linalg.norm(around[2] - around[0], axis=1) / (2 * step)
    swung = np.linalg.norm(around[2] - 2 * around[1] + around[0], axis=1) / step**2
    moving = int((speed > FAST).sum())
    if moving < MOVING:
        allowed = f"{MOVING} or more at over {FAST:g} mm/s, or --keep-latency: how late it is shows on the way alone"
        raise InputError(WHERE, "pictures of the arm on its way", moving, allowed)
    if int((swung > SWUNG).sum()) < MOVING:
        allowed = f"{MOVING} or more at over {SWUNG:g} mm/s^2, or --keep-latency: steady moves show their sum alone"
        raise InputError(WHERE, "pictures of the arm changing its speed", int((swung > SWUNG).sum()), allowed)
