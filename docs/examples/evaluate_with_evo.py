"""Judge poses by evo: python docs/examples/evaluate_with_evo.py out/monday/poses.tum sessions/monday/truth.tum

Needs `pip install evo`. The two surface frames differ by a constant, which the first pose tells; nothing is fitted.
"""

from __future__ import annotations

import numpy as np
from evo.core import metrics, sync
from evo.core.trajectory import PosePath3D
from evo.tools import file_interface

from hardware.cli.parser import run_script


def main(estimated: str, reference: str) -> None:
    """Print the absolute errors, mm and degrees, and the relative ones from pose to pose."""
    true, found = (file_interface.read_tum_trajectory_file(file) for file in (reference, estimated))
    true, found = sync.associate_trajectories(true, found, max_diff=0.01)
    constant = np.linalg.inv(found.poses_se3[0]) @ true.poses_se3[0]
    pair = true, PosePath3D(poses_se3=[pose @ constant for pose in found.poses_se3])
    for name, metric in (
        ("off by", metrics.APE(metrics.PoseRelation.translation_part)),
        ("turned by, degrees", metrics.APE(metrics.PoseRelation.rotation_angle_deg)),
        ("from pose to pose", metrics.RPE(metrics.PoseRelation.translation_part, 1, metrics.Unit.frames)),
    ):
        metric.process_data(pair)
        told = metric.get_all_statistics()
        print(f"{name}: rmse {told['rmse']:.4f}, median {told['median']:.4f}, max {told['max']:.4f}")


if __name__ == "__main__":
    run_script(main, __doc__)
