"""What a run came to, counted while it goes: always the same few numbers, however long it lasts."""

from __future__ import annotations

import re
from dataclasses import dataclass, field

import numpy as np

from estimation import se3
from hardware.live.course import Course
from hardware.live.histograms import Histograms
from hardware.live.state_machine import Seen
from hardware.operator.view import Stage
from planning.command import Move
from planning.kinematics import SimpleArm, nozzle_from_axes
from planning.progress import Phase

_NUMBER = re.compile(r"(?<![\w.])-?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?")
KINDS = 40  # of reasons that are told apart
OTHERS = "other reasons"
ERROR_BIN, ERROR_BINS = 0.005, 400  # mm
LONGEST = 0.5  # s between two looks that count: beyond, nobody knows what was between


@dataclass(slots=True)
class Held:
    """Holds for one reason."""

    count: int = 0
    seconds: float = 0.0


@dataclass(slots=True)
class Tally:
    """Sums of a run. extruding, due: s in which material left, and in which it should have."""

    stages: dict[str, float] = field(default_factory=dict)
    states: dict[str, int] = field(default_factory=dict)
    holds: dict[str, Held] = field(default_factory=dict)
    extruding: float = 0.0
    due: float = 0.0
    times: Histograms = field(default_factory=Histograms)
    errors: np.ndarray = field(default_factory=lambda: np.zeros(ERROR_BINS, np.int64))
    most_error: float = 0.0
    last_error: float = float("nan")
    course: Course = field(default_factory=Course)
    _looked: float = float("nan")
    _ticked: float = float("nan")
    _sets: int = 0
    _reason: str = ""

    def look(self, now: float, stage: Stage, seen: Seen, arm: SimpleArm | None) -> None:
        """Count what is there at `now`, s. arm: where it stands, once that is known."""
        if not np.isnan(self._looked):
            self.stages[stage.value] = self.stages.get(stage.value, 0.0) + now - self._looked
        self._looked = now
        if (tracking := seen.tracking) is not None and tracking.pose is not None and tracking.sets != self._sets:
            self._sets = tracking.sets
            state = tracking.pose.state.value
            self.states[state] = self.states.get(state, 0) + 1
        if seen.motion is not None and seen.motion.tick.stamp != self._ticked:
            self._tick(seen, stage, arm)

    @property
    def duty(self) -> float:
        """Share of the time since printing began in which material left; NaN before."""
        return self.extruding / self.due if self.due > 0 else float("nan")

    def error(self, share: float) -> float:
        """Predicted error at the nozzle, mm, that `share` percent of the extruding ticks do not exceed; NaN of none."""
        total = self.errors.sum()
        if not total:
            return float("nan")
        return float((np.searchsorted(np.cumsum(self.errors), share / 100 * total) + 1) * ERROR_BIN)

    def _tick(self, seen: Seen, stage: Stage, arm: SimpleArm | None) -> None:
        assert seen.motion is not None
        motion, before = seen.motion, self._ticked
        self._ticked = motion.tick.stamp
        step = min(self._ticked - before, LONGEST) if not np.isnan(before) else 0.0
        command, progress = motion.tick.command, motion.progress
        if progress is None or stage not in (Stage.APPROACH, Stage.PRINT, Stage.PAUSED, Stage.STOPPED):
            return
        reason = _NUMBER.sub("…", command.reason)
        if reason:
            self._hold(reason, step)
        self._reason = reason
        if progress.place > 0 and progress.phase not in (Phase.LEAVING, Phase.FINISHED):
            self.due += step
        error = float("nan")
        if isinstance(command, Move) and command.extrude:
            self.extruding += step
            if arm is not None:
                error = self._error(seen, command, arm)
        self.course.add(self._ticked, error, step if reason else 0.0)

    def _hold(self, reason: str, step: float) -> None:
        if reason not in self.holds and len(self.holds) >= KINDS:
            reason = OTHERS
        held = self.holds.setdefault(reason, Held())
        held.count += reason != self._reason
        held.seconds += step

    def _error(self, seen: Seen, move: Move, arm: SimpleArm) -> float:
        """One standard deviation, mm, of the place under the nozzle, where it is to be after this move; NaN of none."""
        assert seen.tracking is not None
        if (pose := seen.tracking.pose) is None:
            return float("nan")
        then = pose.predict(max(move.stamp, pose.stamp), onwards=False)
        nozzle = se3.inverse(pose.base_from_surface) @ nozzle_from_axes(arm, move.axes)
        error = float(then.error_at(nozzle[None, :3, 3])[0])
        self.errors[min(int(error / ERROR_BIN), ERROR_BINS - 1)] += 1
        self.most_error, self.last_error = max(self.most_error, error), error
        return error
