"""How far the nozzle truly is from its place, where the world is simulated: by dead reckoning, while a run goes on.

Truth comes with a picture, later than the commands for its instant: so what was commanded of late is kept, and looked
up once the truth is there.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from math import nan

import numpy as np

from estimation import se3
from estimation.se3 import Array
from hardware.arm.profile import ArmProfile
from hardware.live.records import LiveMotionReport, TrackingReport
from planning.command import Move
from planning.kinematics import nozzle_from_axes
from planning.path import Path

KEPT = 64  # commands: a second of them
LONGEST = 0.1  # s between two commands that a straight line joins


@dataclass(slots=True)
class TrueError:
    """path: as its file has it, in the true surface frame. last: mm, NaN while unknown, or while nothing is printed."""

    path: Path
    last: float = nan
    _due: deque[tuple[float, Array, float]] = field(default_factory=lambda: deque(maxlen=KEPT))
    _ticked: float = nan
    _told: float = nan

    def look(
        self, tracking: TrackingReport | None, motion: LiveMotionReport | None, profile: ArmProfile | None
    ) -> None:
        """Take what is new. profile: of the arm as the run uses it; None before it is known."""
        if profile is None or motion is None or tracking is None or tracking.truth is None or tracking.pose is None:
            return
        if motion.tick.stamp != self._ticked:
            self._ticked = motion.tick.stamp
            self._note(motion, profile)
        if tracking.pose.stamp != self._told:
            self._told = tracking.pose.stamp
            self.last = self._error(tracking.pose.stamp, tracking.truth, profile)

    def _note(self, motion: LiveMotionReport, profile: ArmProfile) -> None:
        command = motion.tick.command
        if isinstance(command, Move) and command.extrude and motion.progress is not None:
            due = command.stamp + profile.tick + profile.lag
            self._due.append((due, command.axes, motion.progress.fraction))

    def _error(self, stamp: float, base_from_surface: Array, profile: ArmProfile) -> float:
        """From the nozzle to its place at `stamp`, s, mm; NaN where it was not printing then."""
        after = next((i for i, (due, _, _) in enumerate(self._due) if due >= stamp), 0)
        if not after or self._due[after][0] - self._due[after - 1][0] > LONGEST:
            return nan
        (begin, axes, place), (end, later, next_place) = self._due[after - 1], self._due[after]
        share = (stamp - begin) / (end - begin)
        nozzle = nozzle_from_axes(profile.arm, axes + share * (later - axes))
        there = (se3.inverse(base_from_surface) @ nozzle)[:3, 3]
        fraction, points = place + share * (next_place - place), self.path.surface_from_nozzle[:, :3, 3]
        wanted = [np.interp(fraction, np.arange(len(points)), points[:, k]) for k in range(3)]
        return float(np.linalg.norm(there - wanted))
