"""From nozzle pose to joints: all eight postures of an elbow arm with a spherical wrist, exactly (Pieper 1968).

The wrist's centre fixes joints 1 to 3, a triangle of upper arm and forearm in a vertical plane; the rotation that is
left fixes joints 4 to 6. What is out of reach is NaN.
"""

from __future__ import annotations

from itertools import product

import numpy as np

from estimation import se3
from estimation.se3 import Array
from planning.robot.kinematics import JointModel, link

POSTURES = np.array(list(product([1.0, -1.0], repeat=3)))  # (8, 3): shoulder, elbow, wrist; see JointModel.signs


def joints_from_nozzle(model: JointModel, arm_from_nozzle: Array, signs: Array | None = None) -> Array:
    """Joints (..., 6), rad, that bring the nozzle to arm_from_nozzle (..., 4, 4) in the posture `signs` (3,).

    Without signs in the model's own. Each joint is within half a turn of the middle of its range; NaN: out of reach.
    """
    shoulder, elbow, wrist = model.signs if signs is None else signs
    foot_from_flange = se3.inverse(model.arm_from_foot) @ arm_from_nozzle @ se3.inverse(model.flange_from_nozzle)
    centre = foot_from_flange[..., :3, 3] - model.dh[5, 2] * foot_from_flange[..., :3, 2]
    first = _triangle(model, centre, _centre_in_forearm(model), shoulder, elbow)
    last = _wrist(model, first, foot_from_flange[..., :3, :3], wrist)
    return _wound(model, np.concatenate([first, last], -1))


def joints_from_tip(model: JointModel, tip: Array, wrist: Array) -> Array:
    """Joints (..., 6), rad, that bring the nozzle's tip to `tip` (..., 3), mm, arm frame, the last three being `wrist`.

    The solution is of the model's own posture; NaN where there is none.
    """
    foot_from_arm = se3.inverse(model.arm_from_foot)
    place = tip @ foot_from_arm[:3, :3].T + foot_from_arm[:3, 3]
    angles = wrist + model.dh[3:, 3]
    rest = link(model, 3, angles[..., 0]) @ link(model, 4, angles[..., 1]) @ link(model, 5, angles[..., 2])
    in_forearm = _in_link_3(model, (rest @ model.flange_from_nozzle)[..., :3, 3])
    found = np.full((*wrist.shape[:-1], 6), np.nan)
    for shoulder, elbow in product([1.0, -1.0], repeat=2):  # of the triangle with the tip; the posture is the wrist's
        joints = _wound(model, np.concatenate([_triangle(model, place, in_forearm, shoulder, elbow), angles], -1))
        with np.errstate(invalid="ignore"):
            own = np.isnan(found[..., 0]) & (_posture(model, joints) == model.signs[:2]).all(axis=-1)
        found = np.where(own[..., None], joints, found)
    return found


def _centre_in_forearm(model: JointModel) -> Array:
    """The wrist's centre (3,), mm, in the forearm: see `_in_link_3`."""
    return _in_link_3(model, np.array([0.0, 0, model.dh[3, 2]]))


def _in_link_3(model: JointModel, points: Array) -> Array:
    """Points (..., 3) of frame 3, mm, seen from the elbow with x along the third row's a: joint 3 turns about z."""
    a, alpha, d, _ = model.dh[2]
    return np.asarray(points @ se3.exp_rotation([alpha, 0, 0]).T + [a, 0, d])


def _triangle(model: JointModel, place: Array, forearm: Array, shoulder: float, elbow: float) -> Array:
    """The table's angles (..., 3) that bring the point `forearm` (..., 3) of the forearm to `place` (..., 3), mm."""
    a, alpha, d, _ = model.dh.T
    side = np.sign(alpha[0])
    aside = -side * (d[1] + forearm[..., 2])
    with np.errstate(invalid="ignore"):  # the root of what is negative: out of reach
        ahead = shoulder * np.sqrt(place[..., 0] ** 2 + place[..., 1] ** 2 - aside**2)
        first = np.arctan2(place[..., 1], place[..., 0]) - np.arctan2(aside, ahead)
        x, y = ahead - a[0], side * (place[..., 2] - d[0])
        reach = np.hypot(forearm[..., 0], forearm[..., 1])
        bend = -side * shoulder * elbow * np.arccos((x**2 + y**2 - a[1] ** 2 - reach**2) / (2 * a[1] * reach))
        second = np.arctan2(y, x) - np.arctan2(reach * np.sin(bend), a[1] + reach * np.cos(bend))
    return np.stack([first, second, bend - np.arctan2(forearm[..., 1], forearm[..., 0])], -1)


def _posture(model: JointModel, joints: Array) -> Array:
    """Signs (..., 2) of shoulder and elbow of joints (..., 6)."""
    a, alpha, _, theta = model.dh.T
    x, y, _ = _centre_in_forearm(model)
    upper, bend = joints[..., 1] + theta[1], joints[..., 2] + theta[2] + np.arctan2(y, x)
    ahead = a[0] + a[1] * np.cos(upper) + np.hypot(x, y) * np.cos(upper + bend)
    shoulder = np.sign(ahead)
    return np.stack([shoulder, -np.sign(alpha[0]) * shoulder * np.sign(np.sin(bend))], -1)


def _wrist(model: JointModel, first: Array, foot_from_flange: Array, sign: float) -> Array:
    """The table's angles (..., 3) of the wrist for the rotation (..., 3, 3), the first three being `first` (..., 3)."""
    fourth_side, fifth_side = np.sign(model.dh[3:5, 1])
    foot_from_forearm = link(model, 0, first[..., 0]) @ link(model, 1, first[..., 1]) @ link(model, 2, first[..., 2])
    turn = np.swapaxes(foot_from_forearm[..., :3, :3], -1, -2) @ foot_from_flange
    axis = turn[..., 2]
    fifth = sign * np.arctan2(np.hypot(axis[..., 0], axis[..., 1]), -fourth_side * fifth_side * axis[..., 2])
    up = fifth_side * sign
    fourth = np.arctan2(up * axis[..., 1], up * axis[..., 0])
    bent = (link(model, 3, fourth) @ link(model, 4, fifth))[..., :3, :3]
    spun = np.swapaxes(bent, -1, -2) @ turn
    return np.stack([fourth, fifth, np.arctan2(spun[..., 1, 0], spun[..., 0, 0])], -1)


def _wound(model: JointModel, angles: Array) -> Array:
    """Joints (..., 6) of the table's angles, each within half a turn of the middle of its range."""
    middle = (model.low + model.high) / 2
    off = angles - model.dh[:, 3] - middle
    return np.asarray(middle + off - 2 * np.pi * np.round(off / (2 * np.pi)))
