"""The motion of a live run: holds until a path is begun, then a MotionStep that can be paused, or begun at home."""

from __future__ import annotations

import math
from dataclasses import replace

from estimation.pose import SurfacePose
from estimation.se3 import Array
from hardware.arm.profile import ArmProfile
from hardware.live.place import Place
from hardware.live.records import Begin
from hardware.motion.step import MotionStep, bytes_from_command
from planning.command import Command, Hold
from planning.progress import Progress

PAUSED = "paused by the operator"
WAITING = "no path was confirmed yet"


class LiveMotion:
    """What a MotionLoop asks. asked: whether planner and guard were, in the last call; frame: that they gave.

    begun: where on the path they were begun anew since somebody last took note, counted in checkpoints; NaN: nowhere.
    """

    last: Command

    def __init__(self, profile: ArmProfile, place: Place) -> None:
        self._profile, self._place = profile, place
        self._step: MotionStep | None = None
        self._begun: Begin | None = None
        self.paused = self.asked = False
        self.begun, self.frame = math.nan, b""

    def begin(self, order: Begin) -> None:
        """Print this path from now on."""
        self._begun = order
        self._make(order.start)

    def homed(self) -> None:
        """The arm stands at home: the motion begins from there, at the same place of the path."""
        if self._step is not None:
            self._make(self._step.progress.fraction)

    def recalled(self, place: Array, stands: Array) -> None:
        """The arm was stopped at `place` (6,) on its way and stands at `stands` (6,): the path goes on from there."""
        if self._step is not None:
            self._step.recalled(place, stands)

    @property
    def progress(self) -> Progress | None:
        """How far the print is; None before a path was begun."""
        return None if self._step is None else self._step.progress

    def __call__(self, pose: SurfacePose | None, now: float) -> bytes:
        """The frame of the tick at `now`, s."""
        self.asked = self._step is not None
        if self._step is None:
            self.last = Hold(now, self._profile.limits.pause, WAITING)
            return bytes_from_command(self.last, self._profile.dialect)
        self._step.paused = self.paused
        self.frame = self._step(pose, now)
        self.last = self._step.last
        if self.paused and isinstance(self.last, Hold):
            self.last = replace(self.last, reason=PAUSED)
        self._place.fraction = self._step.progress.fraction
        return self.frame

    def _make(self, start: float) -> None:
        assert self._begun is not None
        self._step = MotionStep(self._begun.path, self._begun.profile, start)
        self._place.fraction = self.begun = start
