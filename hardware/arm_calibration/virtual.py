"""`stillbed calibrate arm --virtual`: the whole of it before simulated cameras, in virtual time or at a port."""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np

from estimation import se3
from estimation.arm_calibration.set_point import SetPoint
from estimation.errors import InputError
from estimation.se3 import Array
from hardware.arm.link import Arm
from hardware.arm.port import Device
from hardware.arm_calibration.commanded import NAME, read_commanded
from hardware.arm_calibration.moves import MoveWishes
from hardware.arm_calibration.record import move_arm
from hardware.calibration.arm_run import ArmTruth
from hardware.calibration.arm_solve import ARM
from hardware.files.arm_file import write_arm
from hardware.process.clock import Clock, SimClock
from hardware.process.progress import Report
from hardware.simulator.arm.controller import VirtualArm
from hardware.simulator.arm.ports import VirtualDevice
from hardware.simulator.watched_arm import WatchedArm, served, take_pictures

AROUND, STEP = 0.03, 1e-4  # s about its own dead time in which a virtual arm's is looked for, and how finely
LOOKS = 0.005  # s between instants at which it is compared


def record_on_terminal(
    watched: WatchedArm, clock: Clock, folder: Path, wishes: MoveWishes, moves: Report, pictures: Report
) -> ArmTruth:
    """Move the arm over a pseudo-terminal in real time, then render what the cameras saw; what is true of the arm.

    Ctrl-C while it moves stops it, and what it did until then is recorded before the interrupt goes on.
    """
    write_arm(folder / ARM, watched.told, "the virtual arm as it is taken to be")
    with tempfile.TemporaryDirectory() as place, served(watched, Path(place) / "arm", clock) as device:
        port = Device(device.device, watched.told.baud)
        arm, begun = Arm(port, watched.told, clock.now()), clock.now()
        broken: BaseException | None = None
        try:
            move_arm(arm, clock, folder, watched.begin, wishes, moves)
        except (KeyboardInterrupt, InputError) as error:
            broken = error
        finally:
            span = begun, clock.now()
            arm.close()
            port.release()
    assert device.arm is not None
    take_pictures(watched, device.arm, device.begun, span, folder, pictures)
    if broken is not None:
        raise broken
    return _truth(watched, device.arm, device.begun, read_commanded(folder / NAME))


def record_in_virtual_time(
    watched: WatchedArm, folder: Path, wishes: MoveWishes, moves: Report, pictures: Report
) -> ArmTruth:
    """The same in virtual time: as exact as the wire, however busy the machine is, and the same each time."""
    write_arm(folder / ARM, watched.told, "the virtual arm as it is taken to be")
    clock = SimClock()
    virtual = VirtualArm(watched.settings, watched.told.dialect, watched.begin, (), watched.told.baud)
    arm = Arm(VirtualDevice(virtual, clock, watched.told.baud), watched.told, 0.0)
    move_arm(arm, clock, folder, watched.begin, wishes, moves)
    virtual.advance(clock.now())
    take_pictures(watched, virtual, 0.0, (0.0, clock.now()), folder, pictures)
    return _truth(watched, virtual, 0.0, read_commanded(folder / NAME))


def _truth(watched: WatchedArm, arm: VirtualArm, begun: float, set_point: SetPoint) -> ArmTruth:
    """What is true. The dead time is as executed: what threads and terminal add to the controller's is in it."""
    stamps = np.arange(set_point.instants[0] + 0.2, min(set_point.instants[-1], begun + arm.now) - 0.2, LOOKS)
    executed, lag = arm.axes_at(stamps - begun)[:, :3], watched.settings.servo_lag
    tried = watched.settings.dead_time + np.arange(-AROUND / 3, AROUND, STEP)
    off = [_mean_square(set_point.lagged(stamps, dead, lag)[:, :3] - executed) for dead in tried[::10]]
    near = tried[max(0, 10 * int(np.argmin(off)) - 10) : 10 * int(np.argmin(off)) + 11]
    fine = [_mean_square(set_point.lagged(stamps, dead, lag)[:, :3] - executed) for dead in near]
    dead = float(near[int(np.argmin(fine))])
    return ArmTruth(se3.inverse(watched.true.arm_from_base), watched.true.tool_offset, dead, lag)


def _mean_square(gap: Array) -> float:
    return float(np.mean(gap**2))
