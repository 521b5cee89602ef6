"""The error at the nozzle: how far it is from where it should be on the moving surface, and what that comes to.

Everything is told of the extruding rows: where no material leaves, being elsewhere is no error.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estimation.se3 import Array
from hardware.report.evaluation import Spread, spread
from hardware.simulator.hold_reasons import Holds, HoldSpan, hold_spans, holds_of
from hardware.simulator.lag import Lag, lag_of
from hardware.simulator.nozzle_log import NozzleLog, row_step
from hardware.simulator.planned_line import PlannedLine

NEAR = 0.5  # mm: what a thin bead forgives
ARRIVED = 0.01  # mm from the end of the path at which it counts as finished


@dataclass(frozen=True, slots=True, eq=False)
class NozzleErrors:
    """The error in each of N rows of a log; NaN where no target was due.

    vector: (N, 3) mm, nozzle less target, in the surface frame. split: (N, 3) mm, the same along the path (ahead is
    positive), across it (to the left) and along the target's axis (back into the tool), which is the surface's normal
    as far as the path says so. angle: (N,) rad between the nozzle's axis and the target's. path: (N,) mm from the tip
    to the nearest place that is printed, whenever that is due, and known without a target too; NaN where the path
    prints nothing.
    """

    vector: Array
    split: Array
    angle: Array
    path: Array

    @property
    def distance(self) -> Array:
        """(N,) mm, the length of the vector."""
        return np.asarray(np.linalg.norm(self.vector, axis=1))


def nozzle_errors(log: NozzleLog, line: PlannedLine) -> NozzleErrors:
    """The error in every row, each from nothing but its own row."""
    base_from_surface = log.base_from_surface[:, :3, :3]
    difference = log.base_from_nozzle[:, :3, 3] - log.base_from_target[:, :3, 3]
    vector = _turned(base_from_surface, difference)
    normal = log.base_from_target[:, :3, 2]
    place = np.nan_to_num(log.place)
    direction = np.einsum("nij,nj->ni", base_from_surface, line.direction()[line.piece(place)])
    along = _unit(direction - np.sum(direction * normal, axis=1, keepdims=True) * normal)
    across = np.cross(normal, along)
    split = np.einsum("nij,nj->ni", np.stack([along, across, normal], axis=1), difference)
    return NozzleErrors(
        vector, split, _between(log.base_from_nozzle[:, :3, 2], normal), line.distance(log.surface_from_tip)
    )


def _turned(base_from_surface: Array, vectors: Array) -> Array:
    """Vectors (N, 3) in base as seen in the surface frame."""
    return np.asarray(np.einsum("nji,nj->ni", base_from_surface, vectors))


def _unit(vectors: Array) -> Array:
    """Vectors (N, 3) at length 1; a vector of no length stays."""
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    return np.asarray(vectors / np.where(length > 1e-9, length, 1.0))


def _between(a: Array, b: Array) -> Array:
    """Angles (N,), rad, between vectors (N, 3); exact for small ones too."""
    return np.asarray(np.arctan2(np.linalg.norm(np.cross(a, b), axis=1), np.sum(a * b, axis=1)))


@dataclass(frozen=True, slots=True, eq=False)
class NozzleFigures:
    """What a run came to. Spreads are of lengths in mm and of the angle in rad, over the extruding rows with a target.

    position: the error's length. along, across, normal: of its parts, without sign. path: the distance from the
    printed line. offset: (3,) mm, mean error in the surface frame. near: share of the extruding time with an error
    under NEAR. extruding: s. untold: s of it without a target, and so in no spread.

    printing: s from the first extruding row until the path is finished, planned travel left out. The path is finished
    in the last row that extrudes or has a place more than ARRIVED short of the end; if no row comes that near to the
    end, in the last row of the log. Travel are the rows whose place lies on a piece that does not print; a row without
    a place has the last known one. duty: extruding rows among those of `printing`; NaN where nothing was due to print,
    0 where nothing was extruded of what was. finished: whether the path was. holds: until then, by kind; spans: each.
    """

    position: Spread
    along: Spread
    across: Spread
    normal: Spread
    angle: Spread
    path: Spread
    offset: Array
    near: float
    extruding: float
    untold: float
    printing: float
    duty: float
    finished: bool
    lag: Lag
    holds: tuple[Holds, ...]
    spans: tuple[HoldSpan, ...]


def nozzle_figures(log: NozzleLog, line: PlannedLine, errors: NozzleErrors) -> NozzleFigures:
    """The figures of a log and its errors."""
    step = row_step(log)
    told = log.extrude & np.isfinite(errors.distance)
    distance, split = errors.distance[told], np.abs(errors.split[told])
    printing, end, finished = _printing(log, line)
    extruding, extruded = int(log.extrude.sum()), int((log.extrude & printing).sum())
    spans = hold_spans(log.stamps[:end], log.reason[:end], step)
    return NozzleFigures(
        position=spread(distance),
        along=spread(split[:, 0]),
        across=spread(split[:, 1]),
        normal=spread(split[:, 2]),
        angle=spread(errors.angle[told]),
        path=spread(errors.path[told & np.isfinite(errors.path)]),
        offset=errors.vector[told].mean(axis=0) if told.any() else np.full(3, np.nan),
        near=float(np.sum(distance < NEAR) / extruding) if extruding else float("nan"),
        extruding=extruding * step,
        untold=float(extruding - told.sum()) * step,
        printing=float(printing.sum()) * step,
        duty=_duty(extruded, int(printing.sum()), len(log), line),
        finished=finished,
        lag=lag_of(log),
        holds=holds_of(spans),
        spans=tuple(spans),
    )


def _duty(extruded: int, printing: int, rows: int, line: PlannedLine) -> float:
    if printing:
        return extruded / printing
    return 0.0 if rows and line.printed.any() else float("nan")


def _printing(log: NozzleLog, line: PlannedLine) -> tuple[NDArray[np.bool_], int, bool]:
    """(N,) rows in which material was due; the row after the last before the end of the path; if it was finished."""
    known = np.isfinite(log.place)
    short = known & (log.place < line.end - ARRIVED)
    finished = bool((known & ~short).any())
    going = np.flatnonzero(short | log.extrude)
    end = int(going[-1]) + 1 if finished and len(going) else len(log)
    rows = np.arange(len(log))
    last_known = np.maximum.accumulate(np.where(known, rows, -1))
    place = np.where(last_known >= 0, log.place[last_known], 0.0)
    due = line.printed[line.piece(place)] & (rows < end)
    first = int(np.argmax(log.extrude)) if log.extrude.any() else len(log)
    return due & (rows >= first), end, finished
