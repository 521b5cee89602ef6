"""How well beads begin and end where they are planned, and what is laid where none is.

A bead begins where half of what it needs leaves the nozzle, and ends where that is no longer so. Of each planned bead,
the rows count from half of the way without a bead before it to half of the way after it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from estimation.se3 import Array
from hardware.report.evaluation import Spread, spread
from hardware.simulator.deposit import NozzleLog, PlannedLine, row_pieces, row_step, row_volumes
from hardware.simulator.nozzle_error import END_TOLERANCE, RowErrors
from planning.motion.flow import MIN_FLOW_SPEED

HALF_FLOW = 0.5  # of what the bead needs
BLOB_RADIUS = 1.0  # mm about a bead's end, within which what is laid is held against the plan
PROFILE_REACH, PROFILE_STEP = 4.0, 0.2  # mm along the path about a bead's end, and the step of its profile
FLAT = np.array([1.0, 1.0, 0.0])


@dataclass(frozen=True, slots=True, eq=False)
class EndsOfBeads:
    """All beginnings, or all ends, of the B planned beads that the print has come past; NaN where nothing was laid."""

    error: Array  # (B,) mm along the path from the planned to the true one; above 0: too late, farther on
    speed: Array  # (B,) mm/s, at which the nozzle passed the planned one
    excess: Array  # (B,) mm^3 laid within BLOB_RADIUS of the planned one, less what is planned there
    profile: Array  # (B, M) laid per planned, along the path about the planned one; see profile_edges

    @property
    def size(self) -> Spread:
        """Of the errors without their sign, mm; a bead that was not laid counts as infinite."""
        return spread(np.nan_to_num(np.abs(self.error), nan=np.inf)) if len(self.error) else spread(self.error)

    @property
    def median(self) -> float:
        """mm, of the errors with their sign; NaN without any."""
        return float(np.nanmedian(self.error)) if np.isfinite(self.error).any() else float("nan")

    @property
    def blob(self) -> float:
        """Largest excess, mm^3; NaN without any."""
        return float(self.excess.max()) if len(self.excess) else float("nan")


def profile_edges() -> Array:
    """Edges (M + 1,), mm, of the parts of a profile."""
    return np.linspace(-PROFILE_REACH, PROFILE_REACH, round(2 * PROFILE_REACH / PROFILE_STEP) + 1)


@dataclass(frozen=True, slots=True, eq=False)
class MaterialFigures:
    """What was laid, and where it began and ended."""

    begins: EndsOfBeads
    stops: EndsOfBeads
    laid: float  # mm^3 that left the nozzle
    planned: float  # mm^3
    ooze: float  # mm^3 that fell beside the beads, farther than half a width from every printed line
    flowing: float  # s in which half of what a bead needs left the nozzle, or more, while the motion did not print
    told: float  # s in which a dispenser was open on its orders while no move that prints was sent; NaN: not known


def material_figures(log: NozzleLog, line: PlannedLine, errors: RowErrors, bead: float, told: float) -> MaterialFigures:
    """The figures of a log; bead: width, mm. told: s, as in the figures."""
    rows = _rows(log, line, errors)
    begins, ends, _ = _beads(line)
    reached = float(np.nanmax(log.place)) if np.isfinite(log.place).any() else -np.inf
    volume = row_volumes(log)
    flat = replace(line, points=line.points * FLAT)
    leaves = np.flatnonzero((volume > 0) & np.isfinite(log.surface_from_tip[:, 0]))
    beside = flat.distance(log.surface_from_tip[leaves] * FLAT) > bead / 2
    lengths = np.diff(line.knots)[line.printed]
    return MaterialFigures(
        begins=_ends(rows, log, line, np.flatnonzero(begins < reached - END_TOLERANCE), False),
        stops=_ends(rows, log, line, np.flatnonzero(ends <= reached + END_TOLERANCE), True),
        laid=float(volume.sum()),
        planned=float(lengths @ line.area[line.printed]),
        ooze=float(volume[leaves][beside].sum()),
        flowing=float((rows.flows & ~log.extrude).sum()) * row_step(log),
        told=told,
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Rows:
    """Each of N rows along the path."""

    place: Array  # (N,) mm along the path of the true nozzle
    speed: Array  # (N,) mm/s, at which the path goes on
    flows: NDArray[np.bool_]  # (N,) whether half of what a bead needs leaves, or more


def _rows(log: NozzleLog, line: PlannedLine, errors: RowErrors) -> _Rows:
    along = np.where(np.isfinite(log.place), log.place + np.nan_to_num(errors.split[:, 0]), np.nan)
    known = np.flatnonzero(np.isfinite(along))
    if not len(known):
        nothing = np.zeros(len(log))
        return _Rows(nothing, nothing, nothing > 0)
    following = known[np.minimum(np.searchsorted(known, np.arange(len(log))), len(known) - 1)]
    due = log.place[following]
    step = row_step(log)
    speed = np.maximum(np.gradient(due, step), 0.0) if len(log) > 1 else np.zeros(len(log))
    needed = line.area[row_pieces(log, line)] * np.maximum(speed, MIN_FLOW_SPEED)
    return _Rows(along[following], speed, log.flow > HALF_FLOW * needed)


def _beads(line: PlannedLine) -> tuple[Array, Array, Array]:
    """Where each planned bead begins and ends, (B,) mm of the path, rising; and its cross-section there, mm^2."""
    flips = np.diff(np.concatenate([[False], line.printed, [False]]).astype(np.int8))
    first, last = np.flatnonzero(flips > 0), np.flatnonzero(flips < 0)
    return line.knots[first], line.knots[last], line.area[first]


def _ends(rows: _Rows, log: NozzleLog, line: PlannedLine, which: NDArray[np.int64], stop: bool) -> EndsOfBeads:
    begins, ends, areas = _beads(line)
    planned, count = ends if stop else begins, len(which)
    between = (ends[:-1] + begins[1:]) / 2
    low, high = np.append(-np.inf, between), np.append(between, np.inf)
    error, speed = np.full(count, np.nan), np.full(count, np.nan)
    edges, volume = profile_edges(), row_volumes(log)
    profile = np.zeros((count, len(edges) - 1))
    for i, bead in enumerate(which.tolist()):
        inside = (rows.place > low[bead]) & (rows.place <= high[bead])
        flowing = np.flatnonzero(inside & rows.flows)
        if len(flowing):
            error[i] = rows.place[flowing[-1 if stop else 0]] - planned[bead]
        passed = int(np.argmax(rows.place >= planned[bead] - END_TOLERANCE))
        around = slice(max(passed - 50, 0), passed + 50)
        speed[i] = float(rows.speed[around].max(initial=0.0))
        laid = np.histogram((rows.place - planned[bead])[inside], edges, weights=volume[inside])[0]
        profile[i] = laid / (areas[bead] * PROFILE_STEP)
    piece = np.clip(
        np.searchsorted(line.knots, planned[which], "left" if stop else "right") - 1, 0, len(line.layer) - 1
    )
    at = np.stack([np.interp(planned[which], line.knots, line.points[:, axis]) for axis in (0, 1)], axis=1)
    return EndsOfBeads(error, speed, _excess(log, line, at, line.layer[piece]), profile)


def _excess(log: NozzleLog, line: PlannedLine, places: Array, layers: NDArray[np.int64]) -> Array:
    """Volume (B,), mm^3, laid within BLOB_RADIUS of places (B, 2) in their layers (B,), less the planned."""
    volume, layer = row_volumes(log), line.layer[row_pieces(log, line)]
    leaves = np.flatnonzero((volume > 0) & np.isfinite(log.surface_from_tip[:, 0]))
    tree = cKDTree(log.surface_from_tip[leaves, :2])
    found = np.zeros(len(places))
    for i, near in enumerate(tree.query_ball_point(places, BLOB_RADIUS) if len(places) else ()):
        near_rows = leaves[near]
        found[i] = volume[near_rows[layer[near_rows] == layers[i]]].sum() - _planned(line, places[i], layers[i])
    return found


def _planned(line: PlannedLine, place: Array, layer: int) -> float:
    """Planned volume, mm^3, within BLOB_RADIUS of a place (2,) in a layer: the chords of the circle, in their share."""
    keep = line.printed & (line.layer == layer)
    start = line.points[:-1, :2][keep] - place
    step = line.points[1:, :2][keep] - line.points[:-1, :2][keep]
    length = np.linalg.norm(step, axis=1)
    square = np.where(length > 0, length**2, 1.0)
    middle = -np.sum(start * step, axis=1) / square
    half = np.sqrt(np.maximum(BLOB_RADIUS**2 - np.sum(start**2, axis=1) + middle**2 * square, 0.0) / square)
    share = np.clip(middle + half, 0.0, 1.0) - np.clip(middle - half, 0.0, 1.0)
    return float(np.sum(share * np.diff(line.knots)[keep] * line.area[keep]))
