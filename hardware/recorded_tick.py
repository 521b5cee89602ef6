"""A tick of the motion as it is recorded: what planner and guard were given, and what they made of it."""

from __future__ import annotations

from dataclasses import dataclass

from estimation.se3 import Array
from planning.command import Command
from planning.progress import Phase


@dataclass(frozen=True, slots=True, eq=False)
class RecordedTick:
    """A tick of the motion: s, the stamp of the pose that it was given (NaN: none), and what the loop came to.

    asked: whether planner and guard were asked, and the frame that they then gave. begun: where on the path they were
    begun anew before it, counted in checkpoints (NaN: they were not). paused: whether they were told to wait above the
    surface. fraction, phase: how far the print then is. recalled: (2, 6) mm and rad, where the arm came to rest and
    where it stands, if they were told that what was sent had been called back.
    """

    stamp: float
    pose_stamp: float
    asked: bool
    begun: float
    paused: bool
    command: Command
    frame: bytes
    fraction: float
    phase: Phase
    recalled: Array | None = None
