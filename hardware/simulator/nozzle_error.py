"""The error at the nozzle: its distance from its target on the moving surface, its lag, and the reasons for holds.

Only extruding rows count: where no material leaves, a distance is no error. And the errors of the beads' beginnings
and ends: a bead begins where half of its planned flow leaves the nozzle, and ends where less does. The rows of a
planned bead are those from the middle of the way without a bead before it to the middle of the next such way.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from estimation.se3 import Array
from hardware.report.evaluation import Spread, spread
from hardware.report.page import stretches
from hardware.simulator.deposit import (
    NozzleLog,
    PlannedLine,
    excess_volumes,
    planned_beads,
    row_pieces,
    row_step,
    row_volumes,
)
from planning.material import MIN_FLOW_SPEED

_NUMBER = re.compile(r"(?<![\w.])-?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?")  # but not the 2 of a camera's name cam2
_VARYING_NUMBER = "…"


@dataclass(frozen=True, slots=True)
class HoldGroup:
    """Holds of one kind."""

    reason: str  # common to all, "…" for a number that differs
    count: int
    seconds: float  # s in all
    longest: float  # s
    first: float  # s, start of the first


@dataclass(frozen=True, slots=True)
class HoldSpan:
    """One hold: from `start` to `end`, s, and its first reason."""

    start: float
    end: float
    reason: str


def hold_spans(stamps: Array, reason: NDArray[np.str_], step: float) -> list[HoldSpan]:
    """The holds in rows `stamps` (N,) s with `reason` (N,), "" where the arm moves; a row lasts `step` s.

    A change of the numbers in a reason continues a hold; a change of its text begins another.
    """
    if not len(reason):
        return []
    reasons, index = np.unique(reason, return_inverse=True)
    kind = np.unique([_without_numbers(str(text)) for text in reasons], return_inverse=True)[1][index]
    changed = (np.diff(kind) != 0) | (np.diff(stamps) > 1.5 * step)
    starts = np.concatenate([[0], np.flatnonzero(changed) + 1])
    ends = np.append(starts[1:], len(reason)) - 1
    return [
        HoldSpan(float(stamps[a]), float(stamps[b]) + step, str(reason[a]))
        for a, b in zip(starts, ends, strict=True)
        if reason[a]
    ]


def group_holds(spans: list[HoldSpan]) -> tuple[HoldGroup, ...]:
    """Holds by kind, the longest total first."""
    groups: dict[str, list[HoldSpan]] = {}
    for span in spans:
        groups.setdefault(_without_numbers(span.reason), []).append(span)
    holds = []
    for group in groups.values():
        durations = [span.end - span.start for span in group]
        reason = _common_reason([span.reason for span in group])
        holds.append(HoldGroup(reason, len(group), float(sum(durations)), max(durations), group[0].start))
    return tuple(sorted(holds, key=lambda hold: (-hold.seconds, hold.first)))


def _without_numbers(reason: str) -> str:
    return _NUMBER.sub(_VARYING_NUMBER, reason)


def _common_reason(reasons: list[str]) -> str:
    columns = zip(*(_NUMBER.findall(reason) for reason in reasons), strict=True)
    numbers = iter([column[0] if len(set(column)) == 1 else _VARYING_NUMBER for column in columns])
    return _NUMBER.sub(lambda _: next(numbers), reasons[0])


MAX_LAG = 0.25  # s, the largest shift searched; a later loop cannot follow breathing
COARSE_STEP = 0.01  # s between the shifts of the first search
MIN_TARGET_SPEED = 1.0  # mm/s, root mean square: slower, 10 um of noise already are 10 ms of lag


@dataclass(frozen=True, slots=True, eq=False)
class NozzleLag:
    """The nozzle's lag behind the target."""

    seconds: float  # behind the target, below 0 ahead of it, NaN where unknown
    shifts: Array  # (M,) s, of the search
    distance: Array  # (M,) mm, RMS between the nozzle and the target so shifted


def nozzle_lag(log: NozzleLog) -> NozzleLag:
    """The shift tau that minimises the mean of |nozzle(t) - target(t - tau)|^2 over the extruding rows, in base.

    This is their cross-correlation in least squares: the two differ by a constant. The search is by whole rows, refined
    by a parabola through the best three. Only rows count that have a target for MAX_LAG on either side, without a gap
    in the stamps, so all shifts use the same rows. Only tau is fitted: on a surface at rest and a straight path an
    offset along the path cannot be distinguished from a lag. NaN where no row counts, the target moves slower than
    MIN_TARGET_SPEED, or the best shift is at the end of the search.
    """
    unknown = NozzleLag(float("nan"), np.empty(0), np.empty(0))
    if len(log) < 3:
        return unknown
    step = row_step(log)
    max_shift, stride = round(MAX_LAG / step), max(1, round(COARSE_STEP / step))
    rows = _comparable_rows(log, step, max_shift)
    nozzle, target = log.base_from_nozzle[:, :3, 3], log.base_from_target[:, :3, 3]
    velocity = (target[rows + 1] - target[rows - 1]) / (2 * step)
    if not len(rows) or np.sqrt(np.mean(np.sum(velocity**2, axis=1))) < MIN_TARGET_SPEED:
        return unknown
    offsets = np.arange(-max_shift, max_shift + 1, stride)
    squares = _squares(nozzle, target, rows, offsets)
    best = int(offsets[np.argmin(squares)])
    candidates = np.arange(max(best - stride, -max_shift), min(best + stride, max_shift) + 1)
    candidate_squares = _squares(nozzle, target, rows, candidates)
    i = int(np.argmin(candidate_squares))
    shifts, distance = np.asarray(offsets * step), np.asarray(np.sqrt(squares))
    if not 0 < i < len(candidates) - 1:
        return NozzleLag(float("nan"), shifts, distance)
    before, at, after = candidate_squares[i - 1 : i + 2]
    bend = before - 2 * at + after
    part = 0.5 * (before - after) / bend if bend > 0 else 0.0
    return NozzleLag(float((candidates[i] + part) * step), shifts, distance)


def _comparable_rows(log: NozzleLog, step: float, max_shift: int) -> NDArray[np.int64]:
    due = np.isfinite(log.base_from_target[:, 0, 3])
    gaps = np.flatnonzero(np.abs(np.diff(log.stamps) - step) > 0.5 * step) + 1
    inside = np.zeros(len(log), bool)
    for first, last in zip([0, *gaps], [*gaps, len(log)], strict=True):
        for part in stretches(due[first:last]):
            inside[first + part.start + max_shift : max(first + part.stop - max_shift, 0)] = True
    return np.flatnonzero(inside & log.extrude)


def _squares(nozzle: Array, target: Array, rows: NDArray[np.int64], shifts: NDArray[np.int64]) -> Array:
    return np.array([np.mean(np.sum((nozzle[rows] - target[rows - shift]) ** 2, axis=1)) for shift in shifts])


NEAR_ERROR = 0.5  # mm: the tolerance of a thin bead
END_TOLERANCE = 0.01  # mm short of its end, within which the path counts as finished


@dataclass(frozen=True, slots=True, eq=False)
class RowErrors:
    """The error in each of N rows of a log; NaN where no target was due."""

    vector: Array  # (N, 3) mm, nozzle less target, in the surface frame
    split: Array  # (N, 3) mm, along the path (ahead), across it (left), along the target's axis (into the tool)
    angle: Array  # (N,) rad between the nozzle's axis and the target's
    path: Array  # (N,) mm to the nearest printed place, with or without a target; NaN where none is printed

    @property
    def distance(self) -> Array:
        """(N,) mm, the length of the vector."""
        return np.asarray(np.linalg.norm(self.vector, axis=1))


def nozzle_errors(log: NozzleLog, line: PlannedLine) -> RowErrors:
    """The error in every row, each from its own row alone."""
    base_from_surface = log.base_from_surface[:, :3, :3]
    difference = log.base_from_nozzle[:, :3, 3] - log.base_from_target[:, :3, 3]
    vector = np.einsum("nji,nj->ni", base_from_surface, difference)
    axis, normal = log.base_from_nozzle[:, :3, 2], log.base_from_target[:, :3, 2]
    place = np.nan_to_num(log.place)
    direction = np.einsum("nij,nj->ni", base_from_surface, line.direction()[line.piece(place)])
    along = direction - np.sum(direction * normal, axis=1, keepdims=True) * normal
    length = np.linalg.norm(along, axis=1, keepdims=True)
    along = along / np.where(length > 1e-9, length, 1.0)
    split = np.einsum("nij,nj->ni", np.stack([along, np.cross(normal, along), normal], axis=1), difference)
    # the arc tangent is exact for small angles too
    angle = np.arctan2(np.linalg.norm(np.cross(axis, normal), axis=1), np.sum(axis * normal, axis=1))
    return RowErrors(vector, split, angle, line.distance(log.surface_from_tip))


@dataclass(frozen=True, slots=True, eq=False)
class NozzleFigures:
    """The figures of a run. Spreads are over the extruding rows with a target, parts of the error without sign.

    The path is finished in the last row that extrudes or has a place more than END_TOLERANCE short of the end; if no
    row comes that near to the end, in the last row of the log. Travel rows have their place on a piece that does not
    print; a row without a place has the last known one.
    """

    position: Spread  # mm, length of the error
    along: Spread  # mm
    across: Spread  # mm
    normal: Spread  # mm
    angle: Spread  # rad
    path: Spread  # mm from the printed line
    offset: Array  # (3,) mm, mean error in the surface frame
    near: float  # share of the extruding time with an error under NEAR_ERROR
    extruding: float  # s
    without_target: float  # s of it without a target, and so in no spread
    printing: float  # s from the first extruding row until the path is finished, without planned travel
    duty: float  # extruding share of `printing`; NaN where nothing was due, 0 where nothing was extruded
    finished: bool  # whether the path was
    lag: NozzleLag
    holds: tuple[HoldGroup, ...]  # until then, by kind
    spans: tuple[HoldSpan, ...]  # each of them


def nozzle_figures(log: NozzleLog, line: PlannedLine, errors: RowErrors) -> NozzleFigures:
    """The figures of a log and its errors."""
    step = row_step(log)
    with_target = log.extrude & np.isfinite(errors.distance)
    distance, split = errors.distance[with_target], np.abs(errors.split[with_target])
    printing, end, finished = _printing(log, line)
    extruding = int(log.extrude.sum())
    duty = 0.0 if len(log) and line.printed.any() else float("nan")
    if printing.any():
        duty = int((log.extrude & printing).sum()) / int(printing.sum())
    spans = hold_spans(log.stamps[:end], log.reason[:end], step)
    return NozzleFigures(
        position=spread(distance),
        along=spread(split[:, 0]),
        across=spread(split[:, 1]),
        normal=spread(split[:, 2]),
        angle=spread(errors.angle[with_target]),
        path=spread(errors.path[with_target & np.isfinite(errors.path)]),
        offset=errors.vector[with_target].mean(axis=0) if with_target.any() else np.full(3, np.nan),
        near=float(np.sum(distance < NEAR_ERROR) / extruding) if extruding else float("nan"),
        extruding=extruding * step,
        without_target=float(extruding - with_target.sum()) * step,
        printing=float(printing.sum()) * step,
        duty=duty,
        finished=finished,
        lag=nozzle_lag(log),
        holds=group_holds(spans),
        spans=tuple(spans),
    )


def _printing(log: NozzleLog, line: PlannedLine) -> tuple[NDArray[np.bool_], int, bool]:
    """(N,) rows with planned material; the first row after the end of the path; whether the path was finished."""
    placed = np.isfinite(log.place)
    unfinished = placed & (log.place < line.knots[-1] - END_TOLERANCE)
    finished = bool((placed & ~unfinished).any())
    active = np.flatnonzero(unfinished | log.extrude)
    end = int(active[-1]) + 1 if finished and len(active) else len(log)
    rows, first = np.arange(len(log)), int(np.argmax(log.extrude)) if log.extrude.any() else len(log)
    return line.printed[row_pieces(log, line)] & (rows >= first) & (rows < end), end, finished


HALF_FLOW = 0.5  # of the planned flow
PROFILE_REACH, PROFILE_STEP = 4.0, 0.2  # mm along the path about a bead's end, and the step of its profile
FLAT = np.array([1.0, 1.0, 0.0])


@dataclass(frozen=True, slots=True, eq=False)
class BeadEnds:
    """All beginnings, or all ends, of the B planned beads that the print has passed; NaN where nothing was laid."""

    error: Array  # (B,) mm along the path from the planned to the true one; above 0: too late
    speed: Array  # (B,) mm/s, at which the nozzle passed the planned one
    excess: Array  # (B,) mm^3 laid within BLOB_RADIUS of the planned one, less what is planned there
    profile: Array  # (B, M) volume by planned volume along the path about it; see profile_edges

    @property
    def size(self) -> Spread:
        """Of the absolute errors, mm; a bead that was not laid counts as infinite, which meets no limit."""
        with np.errstate(invalid="ignore"):  # between two infinite ones there is no known value
            return spread(np.nan_to_num(np.abs(self.error), nan=np.inf))

    @property
    def median(self) -> float:
        """mm, of the signed errors; NaN without any."""
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
    """The volume printed, and the beads' beginnings and ends."""

    beginnings: BeadEnds
    ends: BeadEnds
    volume: float  # mm^3 that left the nozzle
    planned_volume: float  # mm^3
    ooze: float  # mm^3 farther than half a width from every printed line
    flow_outside: float  # s with half of the planned flow or more while the motion did not print
    open_outside: float  # s in which a dispenser was commanded open while no move that prints was sent; NaN: unknown


def material_figures(
    log: NozzleLog, line: PlannedLine, errors: RowErrors, bead: float, open_outside: float
) -> MaterialFigures:
    """The figures of a log; bead: width, mm. open_outside: s, as in the figures."""
    rows = _rows(log, line, errors)
    begins, ends, _ = planned_beads(line)
    last_place = float(np.nanmax(log.place)) if np.isfinite(log.place).any() else -np.inf
    volume = row_volumes(log)
    flat = replace(line, points=line.points * FLAT)
    flow_rows = np.flatnonzero((volume > 0) & np.isfinite(log.surface_from_tip[:, 0]))
    outside = flat.distance(log.surface_from_tip[flow_rows] * FLAT) > bead / 2
    lengths = np.diff(line.knots)[line.printed]
    return MaterialFigures(
        beginnings=_ends(rows, log, line, np.flatnonzero(begins < last_place - END_TOLERANCE), False),
        ends=_ends(rows, log, line, np.flatnonzero(ends <= last_place + END_TOLERANCE), True),
        volume=float(volume.sum()),
        planned_volume=float(lengths @ line.area[line.printed]),
        ooze=float(volume[flow_rows][outside].sum()),
        flow_outside=float((rows.flowing & ~log.extrude).sum()) * row_step(log),
        open_outside=open_outside,
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Rows:
    """Each of N rows along the path."""

    place: Array  # (N,) mm along the path of the true nozzle
    speed: Array  # (N,) mm/s, along the path
    flowing: NDArray[np.bool_]  # (N,) whether half of the planned flow or more leaves


def _rows(log: NozzleLog, line: PlannedLine, errors: RowErrors) -> _Rows:
    along = np.where(np.isfinite(log.place), log.place + np.nan_to_num(errors.split[:, 0]), np.nan)
    placed = np.flatnonzero(np.isfinite(along))
    if not len(placed):
        zeros = np.zeros(len(log))
        return _Rows(zeros, zeros, zeros > 0)
    row_of = placed[np.minimum(np.searchsorted(placed, np.arange(len(log))), len(placed) - 1)]
    due = log.place[row_of]
    step = row_step(log)
    speed = np.maximum(np.gradient(due, step), 0.0) if len(log) > 1 else np.zeros(len(log))
    needed = line.area[row_pieces(log, line)] * np.maximum(speed, MIN_FLOW_SPEED)
    return _Rows(along[row_of], speed, log.flow > HALF_FLOW * needed)


def _ends(rows: _Rows, log: NozzleLog, line: PlannedLine, beads: NDArray[np.int64], stop: bool) -> BeadEnds:
    begins, ends, areas = planned_beads(line)
    planned, count = ends if stop else begins, len(beads)
    between = (ends[:-1] + begins[1:]) / 2
    low, high = np.append(-np.inf, between), np.append(between, np.inf)
    error, speed = np.full(count, np.nan), np.full(count, np.nan)
    place, edges, volume = planned[beads], profile_edges(), row_volumes(log)
    profile = np.zeros((count, len(edges) - 1))
    for i, bead in enumerate(beads.tolist()):
        inside = (rows.place > low[bead]) & (rows.place <= high[bead])
        flowing = np.flatnonzero(inside & rows.flowing)
        if len(flowing):
            error[i] = rows.place[flowing[-1 if stop else 0]] - planned[bead]
        row = int(np.argmax(rows.place >= planned[bead] - END_TOLERANCE))
        window = slice(max(row - 50, 0), row + 50)
        speed[i] = float(rows.speed[window].max(initial=0.0))
        volumes = np.histogram((rows.place - planned[bead])[inside], edges, weights=volume[inside])[0]
        profile[i] = volumes / (areas[bead] * PROFILE_STEP)
    piece = np.clip(np.searchsorted(line.knots, place, "left" if stop else "right") - 1, 0, len(line.layer) - 1)
    at = np.stack([np.interp(place, line.knots, line.points[:, axis]) for axis in (0, 1)], axis=1)
    return BeadEnds(error, speed, excess_volumes(log, line, at, line.layer[piece]), profile)
