"""Drive another arm: planner and guard as they are, the words of a Universal Robots controller instead of frames.

python docs/examples/other_arm.py PATH.csv > moves.script      Here the surface breathes by itself; a live
program takes `pose` from a tracking step, and sends each line when its tick comes.
"""

from __future__ import annotations

import numpy as np

from estimation import se3
from estimation.pose import SurfacePose, TrackState
from hardware.cli.parser import run_script
from hardware.files.path_file import read_path
from planning.command import Command, Hold, MotionLimits
from planning.kinematics import SimpleArm, nozzle_from_axes
from planning.motion.guard import Guard
from planning.motion.planner import Planner

TICK, LAG = 0.02, 0.03  # s between lines, and what the arm is later than they say
ARM = SimpleArm()


def line(command: Command) -> str:
    """A line of URScript: metres, and an axis times an angle."""
    if isinstance(command, Hold):
        return f"stopl(1.0)  # {command.reason}"
    place = nozzle_from_axes(ARM, command.axes)
    numbers = [*place[:3, 3] / 1000, *se3.log_rotation(place[:3, :3])]
    return f"servoj(get_inverse_kin(p[{', '.join(f'{n:.6f}' for n in numbers)}]), t={TICK})"


def main(path: str, seconds: float = 60.0) -> None:
    """Print the lines of a whole print, or of so many seconds of it."""
    limits, checkpoints = MotionLimits(), read_path(path)
    planner = Planner(checkpoints, limits, ARM, TICK, LAG)
    guard = Guard(limits, ARM, TICK, checkpoints.zone, LAG)
    for tick in range(round(float(seconds) / TICK)):
        now, breath = tick * TICK, 2 * np.pi * 0.25
        place = se3.make(np.eye(3), [202.5, 225.0, 50.0 + 3 * np.sin(breath * now)])
        twist = np.array([0, 0, 0, 0, 0, 3 * breath * np.cos(breath * now)])
        pose = SurfacePose(now, place, 1e-6 * np.eye(6), twist, TrackState.TRACKING)
        wanted = planner(pose, now)
        command = guard(wanted, pose, now)
        if isinstance(command, Hold) and not isinstance(wanted, Hold):
            planner.refused(guard.axes)
        print(line(command))


if __name__ == "__main__":
    run_script(main, __doc__)
