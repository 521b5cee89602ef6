"""Where the arm should be by what it was sent: the print head that the tracker must not take for tissue."""

from __future__ import annotations

from bisect import bisect_left
from collections import deque

import numpy as np

from estimation.se3 import Array
from hardware.arm.profile import ArmProfile
from perception.frames import PrintHead
from planning.command import Command, Move
from planning.kinematics import nozzle_from_axes

REMEMBERED = 256  # commands, five seconds of them: frames are never that late


class Commanded:
    """The last commands and when the arm gets there: a tick and the arm's lag after each was sent."""

    def __init__(self, profile: ArmProfile) -> None:
        self._profile = profile
        self._stamps: deque[float] = deque(maxlen=REMEMBERED)
        self._axes: deque[Array] = deque(maxlen=REMEMBERED)
        self._extruding: deque[bool] = deque(maxlen=REMEMBERED)

    def add(self, command: Command, now: float) -> None:
        """A command that is sent at `now`, s; a hold leaves the arm where it was."""
        moves = isinstance(command, Move)
        if moves or self._axes:
            self._stamps.append(now + self._profile.tick + self._profile.lag)
            self._axes.append(command.axes if isinstance(command, Move) else self._axes[-1])
            self._extruding.append(isinstance(command, Move) and command.extrude)

    def at(self, stamp: float) -> PrintHead | None:
        """The print head at `stamp`, s; None before the first move, when nobody knows where the arm is."""
        if not self._stamps or stamp < self._stamps[0]:
            return None
        place = min(bisect_left(self._stamps, stamp), len(self._stamps) - 1)
        before = max(place - 1, 0)
        ends = self._stamps[before], self._stamps[place]
        share = min(1.0, (stamp - ends[0]) / (ends[1] - ends[0])) if ends[1] > ends[0] else 1.0
        axes = self._axes[before] + share * (self._axes[place] - self._axes[before])
        extruding = self._extruding[place] and stamp <= ends[1]
        return PrintHead(np.asarray(nozzle_from_axes(self._profile.arm, axes)), extruding)
