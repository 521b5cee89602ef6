"""MotionStep: the newest surface pose in, the bytes for the arm out; no I/O and no clock of its own.

Planner, guard, protocol, in this order. The motion process imports this module; it must never need gtsam, cv2 or
onnxruntime: a call of gtsam was measured to stop every other thread for as long as it takes.
"""

from __future__ import annotations

from estimation.pose import SurfacePose
from estimation.se3 import Array
from hardware.arm.profile import ArmProfile
from hardware.arm.protocol import G1, G4, Dialect, encode
from planning.command import Command, Hold, Move
from planning.motion.guard import Guard
from planning.motion.planner import Planner
from planning.path import Path
from planning.progress import Progress


class MotionStep:
    """One arm printing one path; call it once a tick."""

    last: Command

    def __init__(self, path: Path, profile: ArmProfile | None = None, start: float = 0.0) -> None:
        """start: how much of the path is printed already, counted in checkpoints."""
        self.profile = ArmProfile() if profile is None else profile
        settings = self.profile.limits, self.profile.arm, self.profile.tick
        lag = self.profile.lag
        self._planner, self._guard = Planner(path, *settings, lag, start), Guard(*settings, path.zone, lag)

    def __call__(self, pose: SurfacePose | None, now: float) -> bytes:
        """One frame for the tick at `now`, s: G1 of a move, G4 of a hold. pose: the newest there is."""
        wanted = self._planner(pose, now)
        self.last = self._guard(wanted, pose, now)
        if isinstance(wanted, Move) and isinstance(self.last, Hold):
            self._planner.refused(self._guard.axes)
        return bytes_from_command(self.last, self.profile.dialect)

    def recalled(self, place: Array, stands: Array) -> None:
        """The arm was stopped at `place` (6,) on its way and stands at `stands` (6,): the path goes on from there."""
        self._planner.recalled(place, stands)
        self._guard.stands(stands)

    @property
    def paused(self) -> bool:
        """Whether the nozzle is to go up from the surface and stand there; it goes on where it left off."""
        return self._planner.paused

    @paused.setter
    def paused(self, value: bool) -> None:
        self._planner.paused = value

    @property
    def progress(self) -> Progress:
        """Which checkpoint is being printed, and in which phase the print is."""
        return self._planner.progress


def bytes_from_command(command: Command, dialect: Dialect) -> bytes:
    """The frame (48 bytes) of a command."""
    if isinstance(command, Move):
        return encode(G1(command.axes, command.feed), dialect)
    return encode(G4(command.duration), dialect)
