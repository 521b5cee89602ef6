"""Where an arm stands, from points that its tip has touched and that are known in the base frame."""

from __future__ import annotations

from dataclasses import dataclass

import gtsam
import numpy as np

from estimation import se3
from estimation.arm_calibration.moves import check_places, check_turns
from estimation.calibration.arm_fit import PLACE, TIP, TOOL
from estimation.se3 import Array


@dataclass(frozen=True, slots=True, eq=False)
class Touched:
    """base_from_arm: (4, 4) mm. tool: (3,) mm. covariance: (9, 9) of base_from_arm (right perturbation, rad and mm) and
    tool, zero for a tool that was not asked. residuals: (N, 3) mm, as predicted less known."""

    base_from_arm: Array
    tool: Array
    covariance: Array
    residuals: Array


def fit_touched(arm_from_nozzle: Array, points: Array, sigma: Array, tool: Array, seek_tool: bool) -> Touched:
    """From poses (N, 4, 4), mm, that the arm believes its nozzle had, and the points (N, 3), mm, base, that it touched.

    sigma: (N,) mm, of each point. tool: (3,) mm, where the tip is in the nozzle's frame, or is believed to be at first.
    InputError where the points do not hold what is sought: four or more, not in a plane, and turned for the tool.
    """
    check_places(arm_from_nozzle[:, :3, 3])
    if seek_tool:
        check_turns(arm_from_nozzle)
    keys = [PLACE, TIP] if seek_tool else [PLACE]

    def parts(values: gtsam.Values) -> tuple[Array, Array, Array]:
        pose = values.atPose3(PLACE).matrix()
        at = np.asarray(values.atVector(TIP)) if seek_tool else tool
        return pose, at, se3.transform_points(arm_from_nozzle, at[None])[:, 0]

    def error(_: object, values: gtsam.Values, slopes: list[Array] | None) -> Array:
        pose, _tool, inside = parts(values)
        left = (se3.transform_points(pose, inside) - points) / sigma[:, None]
        if slopes is not None:
            turn = pose[:3, :3]
            held = np.broadcast_to(turn, (len(inside), 3, 3))
            by = [np.concatenate([turn @ -se3.hat(inside), held], -1), turn @ arm_from_nozzle[:, :3, :3]]
            for i in range(len(keys)):
                slopes[i] = np.asfortranarray((by[i] / sigma[:, None, None]).reshape(3 * len(inside), -1))
        return np.asarray(left.ravel())

    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    graph.add(gtsam.CustomFactor(gtsam.noiseModel.Unit.Create(3 * len(points)), keys, error))
    tips = se3.transform_points(arm_from_nozzle, tool[None])[:, 0]
    values.insert(PLACE, gtsam.Pose3(se3.rigid_from_points(tips, points)))
    if seek_tool:
        values.insert(TIP, np.asarray(tool, float))
        graph.add(gtsam.PriorFactorVector(TIP, tool, gtsam.noiseModel.Isotropic.Sigma(3, TOOL)))
    values = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
    joint, covariance = gtsam.Marginals(graph, values).jointMarginalCovariance(keys), np.zeros((9, 9))
    for i, a in enumerate(keys):
        for j, b in enumerate(keys):
            covariance[6 * i : 6 * i + 6 - 3 * i, 6 * j : 6 * j + 6 - 3 * j] = joint.at(a, b)
    pose, at, inside = parts(values)
    return Touched(pose, at, covariance, se3.transform_points(pose, inside) - points)
