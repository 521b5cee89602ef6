"""How much of its needle a tool leaves for a camera to see: who looks along it sees a holder, and no tip."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from estimation.arm_calibration.set_point import SetPoint
from estimation.calibration.arm_model import ArmState, Kinematics, tips
from estimation.rig import Rig
from estimation.se3 import Array
from perception.boards.needle_tip import SHORTEST

THIN = 1.5  # times its radius at the tip that a tool is a needle


def needle_shown(profile: Array, along: Array) -> Array:
    """mm (N,) of the needle's length, as seen from afar, before the rest of the tool hides it; 0 where all is hidden.

    profile: (K, 2) [height, radius], mm. along: (N,) cosine between the tool's axis and the way from its tip to who
    looks. A disc of the tool at height h and radius r reaches down to h sin - r cos of the tip's picture.
    """
    height, radius = profile.T
    thick = radius > THIN * radius[0]
    if thick.any():
        first = int(np.argmax(thick))
        end = float(np.interp(THIN * radius[0], radius[first - 1 : first + 1], height[first - 1 : first + 1]))
        height, radius = np.append(end, height[first:]), np.append(THIN * radius[0], radius[first:])
    else:
        height, radius = height[-1:], radius[-1:]
    square = np.sqrt(np.clip(1 - along**2, 0.0, None))
    reach = square[:, None] * height - np.maximum(along, 0.0)[:, None] * radius
    return np.asarray(np.maximum(reach.min(1), 0.0))


def hidden_tips(
    state: ArmState,
    profile: Array,
    set_point: SetPoint,
    kinematics: Kinematics,
    rig: Rig,
    stamp: Array,
    camera: NDArray[np.int64],
) -> NDArray[np.bool_]:
    """Whether (N,) the tool itself hides so much of its needle that no tip can be found, at stamps (N,), s, by cameras.

    profile: (K, 2) [height, radius] of the tool, mm. camera: (N,) number of who looks.
    """
    axes = set_point.lagged(stamp, state.dead_time, state.lag)
    axis = (state.base_from_arm @ kinematics(axes))[:, :3, 2]
    poses = np.stack([c.base_from_camera for c in rig.cameras])[camera]
    way = poses[:, :3, 3] - tips(state, set_point, kinematics, stamp)
    far = np.linalg.norm(way, axis=1)
    shown = needle_shown(profile, np.sum(way * axis, 1) / far)
    return np.asarray(shown * rig.matrices[camera, 0, 0] / far < SHORTEST)
