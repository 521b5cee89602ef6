"""The ledger: what was commanded for which instant, set beside what the arm did, millisecond by millisecond."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from estimation import se3
from estimation.se3 import Array
from hardware.simulator.nozzle_log import NozzleLog
from hardware.simulator.planned_line import planned_line
from hardware.simulator.truth import Truth
from planning.command import Command, Move
from planning.kinematics import SimpleArm, nozzle_from_axes
from planning.path import Path
from planning.progress import Phase, Progress

Index = NDArray[np.int64]

ROW = 0.001  # s between rows


class Ledger:
    """Remembers commands and gives the rows of a NozzleLog.

    A command of the tick at `now` says where the nozzle shall be one tick and the arm's known lag later. Between two
    such instants the place on the path runs evenly. Whatever else delays the arm is error.
    """

    def __init__(self, path: Path, arm: SimpleArm, truth: Truth, tick: float, lag: float) -> None:
        """path: in the true surface frame. arm: where it truly stands. tick, lag: s, as the motion knows them."""
        self._path, self._arm, self._truth, self._tick, self._lag = path, arm, truth, tick, lag
        self._places = planned_line(path).knots  # (N,) mm along the path of each checkpoint
        self._due: list[float] = []  # s, rising: when each command is to be fulfilled
        self._fraction: list[float] = []  # checkpoints, at `due`; NaN before printing began
        self._extrude: list[bool] = []
        self._reason: list[str] = []

    def write(self, command: Command, progress: Progress) -> None:
        """The command of one tick, and how far the print is by it."""
        begun = progress.place > 0 or progress.phase is Phase.PRINTING
        self._due.append(command.stamp + self._tick + self._lag)
        self._fraction.append(progress.fraction if begun else np.nan)
        self._extrude.append(isinstance(command, Move) and command.extrude)
        self._reason.append(command.reason)

    @property
    def known_until(self) -> float:
        """The last instant, s, for which something was commanded; minus infinity before any."""
        return self._due[-1] if self._due else -np.inf

    def extruding(self, times: Array) -> NDArray[np.bool_]:
        """Whether material leaves (N,) at times (N,), s."""
        return np.array([self._extrude[i] if 0 <= i < len(self._due) else False for i in self._rows(times)], bool)

    def rows(self, times: Array, executed: Callable[[Array], Array]) -> NozzleLog:
        """The log at times (N,), s; executed: machine axes (N, 6) at times (N,)."""
        index = self._rows(times)
        known = (index >= 0) & (index < len(self._due))
        fraction = self._fractions(times, index, known)
        target = np.full((len(times), 4, 4), np.nan)
        there = np.isfinite(fraction)
        target[there] = self._truth.checkpoints(times[there], self._between(fraction[there]))
        nozzle = nozzle_from_axes(self._arm, executed(times))
        place = np.interp(fraction, np.arange(len(self._places)), self._places)
        filled = np.where(there, fraction, 0.0)
        reasons = [self._reason[i] if ok else "no surface is followed yet" for i, ok in zip(index, known, strict=True)]
        return NozzleLog(
            stamps=times,
            base_from_surface=self._truth.base_from_surface(times),
            base_from_nozzle=nozzle,
            base_from_target=target,
            place=np.where(there, place, np.nan),
            checkpoint=np.where(there, np.minimum(np.ceil(filled), len(self._places) - 1), -1).astype(np.int64),
            extrude=self.extruding(times),
            reason=np.array(reasons, dtype=np.str_),
            surface_from_tip=self._truth.material(times, nozzle[:, :3, 3]),
        )

    def _rows(self, times: Array) -> Index:
        """Per instant (N,) the command that is being fulfilled, -1 before the first."""
        first = self._due[0] - self._tick if self._due else np.inf
        return np.array([-1 if t <= first else bisect_left(self._due, t) for t in times.tolist()], np.int64)

    def _fractions(self, times: Array, index: Index, known: NDArray[np.bool_]) -> Array:
        """Fractional checkpoint (N,) due at times (N,), NaN where there is none."""
        out = np.full(len(times), np.nan)
        for row, i in enumerate(index.tolist()):
            if known[row]:
                end = self._fraction[i]
                start = self._fraction[i - 1] if i > 0 and np.isfinite(self._fraction[i - 1]) else end
                share = 1.0 - (self._due[i] - times[row]) / self._tick
                out[row] = start + min(max(share, 0.0), 1.0) * (end - start)
        return out

    def _between(self, fraction: Array) -> Array:
        """surface_from_nozzle (N, 4, 4) at fractional checkpoints (N,): straight and evenly from one to the next."""
        poses = self._path.surface_from_nozzle
        i = np.minimum(fraction.astype(int), len(poses) - 2)
        share = (fraction - i)[:, None]
        places = poses[i, :3, 3] + share * (poses[i + 1, :3, 3] - poses[i, :3, 3])
        turn = se3.log_rotation(np.swapaxes(poses[i, :3, :3], -1, -2) @ poses[i + 1, :3, :3])
        return se3.make(poses[i, :3, :3] @ se3.exp_rotation(share * turn), places)


def executed_rows(start: float, end: float) -> Array:
    """Instants (N,) of the rows after `start` up to `end`, s, on whole milliseconds."""
    first, last = np.floor(start / ROW + 1e-6) + 1, np.floor(end / ROW + 1e-6)
    return np.minimum(np.arange(first, last + 1) * ROW, end)  # a product may be rounded to just beyond it
