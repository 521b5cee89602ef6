"""Where the material went: beads laid and beads planned, seen from above the surface, layer by layer.

A straight bead is 1 thick over its whole width and 0 beside it, so thickness is in units of the nominal bead. The
nozzle lays it as a disc whose density 1 / (pi sqrt(r^2 - d^2)) has that very profile in every direction (its chords all
weigh 1), so that neither a corner nor a trembling nozzle needs a direction of its own. Plan and deposit are laid in the
same way. Lengths count as seen from above: on a slope, where both get thicker, neither does here.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.signal import fftconvolve

from estimation.se3 import Array
from hardware.simulator.nozzle_log import NozzleLog, row_step
from hardware.simulator.planned_line import PlannedLine

CELL = 0.1  # mm
LEAST_CELLS = 4  # across a bead: fewer do not hold its profile, so cells shrink with thin beads
FAR = 20.0  # mm beyond the planned path where the map ends; what is laid further out is laid there
FINE = 5  # samples for each cell that a bead crosses
HALF = 0.5  # of a bead's thickness too much or too little: a gap or an overlap
_PARTS = 32  # of a cell, each way, over which the disc's density is summed


@dataclass(frozen=True, slots=True, eq=False)
class DepositMap:
    """Thickness of material, in nominal beads, on cells of the surface's x and y.

    low: (2,) mm, x and y of the outer corner of the first cell. cell: mm. layers: (L,) numbers, rising. planned,
    deposited: (L, H, W), rows along y, columns along x.
    """

    low: Array
    cell: float
    layers: NDArray[np.int64]
    planned: Array
    deposited: Array


@dataclass(frozen=True, slots=True)
class DepositFigures:
    """How the deposit compares with the plan: sums over the layers, each layer with its own plan; NaN without a plan.

    area: mm^2, planned, a cell counting by its thickness up to 1. coverage: share of it that got its material; a bead
    half as thick covers half. outside: area beyond the plan that got material, as a share of the planned. gaps,
    overlap: share of the planned cells (at least HALF thick in the plan) that lack HALF a bead of a single one, or have
    1.5 times what was planned, or HALF a bead more where that is less than one. material: all that was laid, as a share
    of all that was planned.
    """

    area: float
    coverage: float
    gaps: float
    overlap: float
    outside: float
    material: float


def deposit_map(log: NozzleLog, line: PlannedLine, bead: float) -> DepositMap:
    """The map of a run with beads `bead` mm wide.

    Between two extruding rows material leaves in proportion to the way that the path goes on meanwhile, and falls on
    the straight line between the nozzle's two tips; it belongs to the layer of the path's piece.
    """
    cell = min(CELL, bead / LEAST_CELLS)
    planned, laid = _planned(line, cell), _laid(log, line, cell)
    everything = np.concatenate([line.points[:, :2], laid.places])
    margin = bead / 2 + 3 * cell  # of these, 2 for the bead's blurred edge
    low = everything.min(axis=0) - margin
    columns, rows = np.ceil((everything.max(axis=0) + margin - low) / cell).astype(int)
    layers = np.unique(line.layer[line.printed])
    disc = _disc(bead / cell) / cell  # of 1 mm of bead

    def thickness(drops: _Drops) -> Array:
        places = (drops.places - low) / cell
        each = [_spread(places, drops.material * (drops.layer == n), (rows, columns), disc) for n in layers]
        return np.array(each).reshape(len(layers), rows, columns)

    return DepositMap(low, cell, layers, thickness(planned), thickness(laid))


def deposit_figures(found: DepositMap) -> DepositFigures:
    """The figures of a map."""
    planned, deposited = found.planned, found.deposited
    square = found.cell**2
    wanted, got = np.minimum(planned, 1.0), np.minimum(deposited, 1.0)
    area, cells = float(wanted.sum()) * square, int((planned >= HALF).sum())
    if not cells:
        return DepositFigures(area, *[float("nan")] * 5)
    lacking, double = gaps_and_overlaps(planned, deposited)
    return DepositFigures(
        area=area,
        coverage=float(np.minimum(wanted, got).sum()) * square / area,
        gaps=float(lacking.sum()) / cells,
        overlap=float(double.sum()) / cells,
        outside=float(np.maximum(got - wanted, 0.0).sum()) * square / area,
        material=float(deposited.sum() / planned.sum()),
    )


def gaps_and_overlaps(planned: Array, deposited: Array) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Which cells (...) are gaps and which overlap, as DepositFigures counts them, of thicknesses (...)."""
    there = planned >= HALF
    gaps = there & (deposited <= np.minimum(planned, 1.0) - HALF)
    return gaps, there & (deposited > np.maximum(1.5 * planned, planned + HALF))


@dataclass(frozen=True, slots=True, eq=False)
class _Drops:
    """Material in N small drops. places: (N, 2) mm. material: (N,) mm of bead. layer: (N,)."""

    places: Array
    material: Array
    layer: NDArray[np.int64]


def _planned(line: PlannedLine, cell: float) -> _Drops:
    start, end = line.points[:-1, :2][line.printed], line.points[1:, :2][line.printed]
    return _drops(start, end, np.linalg.norm(end - start, axis=1), line.layer[line.printed], cell)


def _laid(log: NozzleLog, line: PlannedLine, cell: float) -> _Drops:
    seen = np.linalg.norm(np.diff(line.points[:, :2], axis=0), axis=1)
    way = np.interp(log.place, line.knots, np.concatenate([[0.0], np.cumsum(seen)]))  # NaN stays NaN
    steady = np.diff(log.stamps) < 1.5 * row_step(log)
    on = log.extrude[:-1] & log.extrude[1:] & steady & (np.diff(way) > 0)
    on &= np.isfinite(log.surface_from_tip[:-1, 0]) & np.isfinite(log.surface_from_tip[1:, 0])
    start, end = log.surface_from_tip[:-1, :2][on], log.surface_from_tip[1:, :2][on]
    middle = (log.place[:-1] + np.diff(log.place) / 2)[on]
    low, high = line.points[:, :2].min(axis=0) - FAR, line.points[:, :2].max(axis=0) + FAR
    start, end = np.clip(start, low, high), np.clip(end, low, high)
    return _drops(start, end, np.diff(way)[on], line.layer[line.piece(middle)], cell)


def _drops(start: Array, end: Array, material: Array, layer: NDArray[np.int64], cell: float) -> _Drops:
    """Ways from start to end (M, 2), mm, each with its material (M,), as drops spread evenly along them."""
    length = np.linalg.norm(end - start, axis=1)
    count = np.maximum(np.ceil(length * FINE / cell), 1).astype(int)
    way = np.repeat(np.arange(len(start)), count)
    first = np.concatenate([[0], np.cumsum(count)[:-1]]).astype(int) if len(count) else count
    share = (np.arange(len(way)) - first[way] + 0.5) / count[way]
    places = start[way] + share[:, None] * (end - start)[way]
    return _Drops(places, (material / count)[way], layer[way])


def _spread(places: Array, material: Array, shape: tuple[int, int], disc: Array) -> Array:
    """Thickness (H, W) of material (N,) at places (N, 2) in cells: shared among the four nearest, then as discs."""
    at = places - 0.5  # in units of cell centres
    corner = np.floor(at).astype(int)
    part = at - corner
    dots = np.zeros(shape[0] * shape[1])
    for x in (0, 1):
        for y in (0, 1):
            weight = material * np.abs(1 - x - part[:, 0]) * np.abs(1 - y - part[:, 1])
            dots += np.bincount((corner[:, 1] + y) * shape[1] + corner[:, 0] + x, weight, len(dots))
    laid = fftconvolve(dots.reshape(shape), disc, mode="same")
    return np.asarray(np.where(laid > 1e-9, laid, 0.0))  # the transform leaves 1e-16 everywhere


def _disc(width: float) -> Array:
    """Weights (M, M), M odd, of a disc `width` cells wide: what 1 cell of bead gives to each cell around it."""
    reach = int(np.ceil(width / 2))
    fine = (np.arange((2 * reach + 1) * _PARTS) + 0.5) / _PARTS - reach - 0.5
    inside = (width / 2) ** 2 - fine[:, None] ** 2 - fine[None] ** 2
    density = np.where(inside > 0, 1 / np.sqrt(np.where(inside > 0, inside, 1.0)), 0.0)
    weights = density.reshape(2 * reach + 1, _PARTS, 2 * reach + 1, _PARTS).sum(axis=(1, 3))
    return np.asarray(width * weights / weights.sum())
