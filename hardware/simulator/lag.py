"""How late the nozzle is: the shift in time under which its way lies best on the target's."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estimation.se3 import Array
from hardware.report.page import stretches
from hardware.simulator.nozzle_log import NozzleLog, row_step

SEARCH = 0.25  # s, the largest shift tried; a loop later than this follows nothing that breathes
COARSE = 0.01  # s between the shifts first tried
LEAST_SPEED = 1.0  # mm/s, root mean square: slower, 10 um of noise already are 10 ms of lag


@dataclass(frozen=True, slots=True, eq=False)
class Lag:
    """seconds: of the nozzle behind the target, below 0 ahead of it, NaN where it cannot be told.

    shifts: (M,) s that were tried. distance: (M,) mm, root mean square between the nozzle and the target so shifted.
    """

    seconds: float
    shifts: Array
    distance: Array


def lag_of(log: NozzleLog) -> Lag:
    """The shift tau that minimises the mean of |nozzle(t) - target(t - tau)|^2 over the extruding rows, in base.

    This is their cross-correlation in least squares: the two differ by what does not depend on tau. It is searched for
    by whole rows and refined by a parabola through the best three. Only rows count that have a target for SEARCH on
    either side, without a gap in the stamps, so each shift is judged by the same rows. Nothing is fitted but tau: on a
    surface at rest and a straight path an offset along the path is a lag, as no one can tell the two apart. NaN where
    no row counts, the target moves slower than LEAST_SPEED, or the best shift is at the end of the search.
    """
    if len(log) < 3:
        return _nothing()
    step = row_step(log)
    most, stride = round(SEARCH / step), max(1, round(COARSE / step))
    rows = _rows(log, step, most)
    nozzle, target = log.base_from_nozzle[:, :3, 3], log.base_from_target[:, :3, 3]
    if not len(rows) or _speed(target, rows, step) < LEAST_SPEED:
        return _nothing()
    tried = np.arange(-most, most + 1, stride)
    squares = _squares(nozzle, target, rows, tried)
    best = int(tried[np.argmin(squares)])
    near = np.arange(max(best - stride, -most), min(best + stride, most) + 1)
    around = _squares(nozzle, target, rows, near)
    i = int(np.argmin(around))
    shifts, distance = np.asarray(tried * step), np.asarray(np.sqrt(squares))
    if not 0 < i < len(near) - 1:
        return Lag(float("nan"), shifts, distance)
    before, at, after = around[i - 1 : i + 2]
    bend = before - 2 * at + after
    part = 0.5 * (before - after) / bend if bend > 0 else 0.0
    return Lag(float((near[i] + part) * step), shifts, distance)


def _nothing() -> Lag:
    return Lag(float("nan"), np.empty(0), np.empty(0))


def _rows(log: NozzleLog, step: float, most: int) -> NDArray[np.int64]:
    """The extruding rows that have a target for `most` rows on either side."""
    known = np.isfinite(log.base_from_target[:, 0, 3])
    gaps = np.flatnonzero(np.abs(np.diff(log.stamps) - step) > 0.5 * step) + 1
    inside = np.zeros(len(log), bool)
    for first, last in zip([0, *gaps], [*gaps, len(log)], strict=True):
        for part in stretches(known[first:last]):
            inside[first + part.start + most : max(first + part.stop - most, 0)] = True
    return np.flatnonzero(inside & log.extrude)


def _speed(target: Array, rows: NDArray[np.int64], step: float) -> float:
    """Root mean square speed of the target, mm/s."""
    velocity = (target[rows + 1] - target[rows - 1]) / (2 * step)
    return float(np.sqrt(np.mean(np.sum(velocity**2, axis=1))))


def _squares(nozzle: Array, target: Array, rows: NDArray[np.int64], shifts: NDArray[np.int64]) -> Array:
    """Mean squared distance (M,), mm^2, under each shift (M,), in rows."""
    there = nozzle[rows]
    return np.array([np.mean(np.sum((there - target[rows - shift]) ** 2, axis=1)) for shift in shifts])
