"""The planned path, the log of the nozzle's true motion, and the material: beads deposited and planned, layer by layer.

A straight bead has thickness 1 over its whole width and 0 beside it, so thickness is in units of the nominal bead. The
nozzle lays it as a disc whose density 1 / (pi sqrt(r^2 - d^2)) has this profile in every direction (the integral over
each chord is 1), so neither a corner nor a trembling nozzle needs a direction. Plan and deposit are drawn in the same
way. Lengths are as seen from above: on a slope, where both are thicker, neither is here.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from estimation.se3 import Array
from planning.material import bead_areas
from planning.path import MIN_SPACING, Path, way_lengths

DISTANCES_AT_ONCE = 2_000_000  # in memory


@dataclass(frozen=True, slots=True, eq=False)
class PlannedLine:
    """The K - 1 straight pieces between K checkpoints; a piece has the number of the checkpoint before it."""

    knots: Array  # (K,) mm along the path, as NozzleLog.place counts them (turns count too)
    points: Array  # (K, 3) mm, surface frame
    printed: NDArray[np.bool_]  # (K-1,) whether it is printed
    layer: NDArray[np.int64]  # (K-1,)
    area: Array  # (K-1,) mm^2, cross-section of the bead; of a piece that is not printed, that of the bead beside it

    def piece(self, place: Array) -> NDArray[np.int64]:
        """Piece (N,) of each place (N,), mm; a checkpoint belongs to the piece that leads to it."""
        return np.clip(np.searchsorted(self.knots, place, "left") - 1, 0, len(self.knots) - 2)

    def direction(self) -> Array:
        """Unit vector (K-1, 3) of each piece; a turn on the spot has that of the piece before it, or the next one's."""
        step = np.diff(self.points, axis=0)
        length = np.linalg.norm(step, axis=1)
        moving = np.flatnonzero(length >= MIN_SPACING)
        if not len(moving):
            return np.tile([1.0, 0.0, 0.0], (len(step), 1))  # no motion: any direction will do
        nearest = moving[np.maximum(np.searchsorted(moving, np.arange(len(step)), "right") - 1, 0)]
        return np.asarray(step[nearest] / length[nearest, None])

    def distance(self, points: Array) -> Array:
        """Distance (N,), mm, of points (N, 3) in the surface frame from the printed pieces; NaN without any."""
        if not len(points) or not self.printed.any():
            return np.full(len(points), np.nan)
        size = max(1, DISTANCES_AT_ONCE // int(self.printed.sum()))
        return np.concatenate([self._distance(points[i : i + size]) for i in range(0, len(points), size)])

    def _distance(self, points: Array) -> Array:
        start = self.points[:-1][self.printed]
        step = self.points[1:][self.printed] - start
        square = np.sum(step**2, axis=1)
        projection = points @ step.T - np.sum(start * step, axis=1)  # (N, P)
        share = np.clip(projection / np.where(square > 0, square, 1.0), 0.0, 1.0)
        # |point - start - share * step|^2 less |point|^2, which is the same for all pieces
        squares = np.sum(start**2, axis=1) - 2 * points @ start.T - 2 * share * projection + share**2 * square
        nearest = np.argmin(squares, axis=1)
        foot = start[nearest] + share[np.arange(len(points)), nearest][:, None] * step[nearest]
        return np.asarray(np.linalg.norm(points - foot, axis=1))


def planned_line(path: Path) -> PlannedLine:
    """The pieces of a path: each is printed, in a layer, as the checkpoint says to which it leads.

    InputError for a path whose volumes or beads make no sense.
    """
    poses, printed, area = path.surface_from_nozzle, path.extrude[1:], bead_areas(path)[1:]
    knots = np.concatenate([[0.0], np.cumsum(way_lengths(poses))])
    beads = np.flatnonzero(printed)
    if len(beads):
        area = area[beads[np.maximum(np.searchsorted(beads, np.arange(len(area)), "right") - 1, 0)]]
    return PlannedLine(knots, poses[:, :3, 3], printed, path.layer[1:], area)


@dataclass(frozen=True, slots=True, eq=False)
class NozzleLog:
    """The true motion of the nozzle, a row a millisecond, N rows; NaN where no checkpoint was due yet."""

    stamps: Array  # (N,) s
    base_from_surface: Array  # (N, 4, 4) mm
    base_from_nozzle: Array  # (N, 4, 4) mm, as executed by the arm
    base_from_target: Array  # (N, 4, 4) mm, the checkpoint on the true surface that was due
    place: Array  # (N,) mm along the path of that checkpoint
    checkpoint: NDArray[np.int64]  # (N,) its number, -1 for none
    extrude: NDArray[np.bool_]  # (N,) whether the motion prints
    reason: NDArray[np.str_]  # (N,) why the arm holds, "" while it moves
    surface_from_tip: Array  # (N, 3) mm, the tip in the surface frame, without the deformation
    flow: Array  # (N,) mm^3/s, the true flow

    def __len__(self) -> int:
        return len(self.stamps)


def row_step(log: NozzleLog) -> float:
    """Duration of a row, s; 0 with fewer than two."""
    return float(np.median(np.diff(log.stamps))) if len(log) > 1 else 0.0


def row_volumes(log: NozzleLog) -> Array:
    """Volume printed (N,), mm^3, since the row before; 0 in the first one and after a gap in the stamps."""
    since = np.diff(log.stamps, prepend=log.stamps[:1])
    return np.asarray(np.where(since < 1.5 * row_step(log), log.flow * since, 0.0))


def row_pieces(log: NozzleLog, line: PlannedLine) -> NDArray[np.int64]:
    """Piece (N,) of the line for each row: the last one known, before any the first."""
    rows = np.maximum.accumulate(np.where(np.isfinite(log.place), np.arange(len(log)), -1))
    return line.piece(np.where(rows >= 0, log.place[rows], 0.0))


def join_logs(logs: Sequence[NozzleLog]) -> NozzleLog:
    """One log of several consecutive ones."""
    columns = (np.concatenate([getattr(log, f.name) for log in logs]) for f in fields(NozzleLog))
    return NozzleLog(*columns)


MAP_CELL = 0.1  # mm
MIN_CELLS_PER_BEAD = 4  # across a bead, for its profile: cells shrink with thin beads
MAP_REACH = 20.0  # mm from the planned path to the map's edge; material beyond counts at the edge
SAMPLES_PER_CELL = 5  # along a bead
HALF_BEAD = 0.5  # of a bead's thickness too much or too little: a gap or an overlap
_DISC_SUBCELLS = 32  # of a cell along each axis, for the sum of the disc's density


@dataclass(frozen=True, slots=True, eq=False)
class DepositMap:
    """Thickness of material, in nominal beads, on cells of the surface's x and y."""

    low: Array  # (2,) mm, x and y of the outer corner of the first cell
    cell: float  # mm
    layers: NDArray[np.int64]  # (L,) numbers, rising
    planned: Array  # (L, H, W), rows along y, columns along x
    deposited: Array  # (L, H, W)


@dataclass(frozen=True, slots=True)
class DepositFigures:
    """How the deposit compares with the plan: sums over the layers, each with its own plan; NaN without a plan.

    Gaps and overlaps are shares of the planned cells, those at least HALF_BEAD thick in the plan.
    """

    area: float  # mm^2, planned, a cell counting by its thickness up to 1
    coverage: float  # share of the area with its material; a bead of half the thickness covers half
    gaps: float  # cells with a deficit of HALF_BEAD of a single bead
    overlap: float  # cells with 1.5 times the plan, or HALF_BEAD more where the plan is below one
    outside: float  # area with material beyond the plan, as a share of the planned
    material: float  # all deposited, as a share of all planned


def deposit_map(log: NozzleLog, line: PlannedLine, bead: float) -> DepositMap:
    """The map of a run with beads `bead` mm wide.

    The volume between two rows is spread along the straight line between the two places of the tip; its layer is that
    of the path's piece.
    """
    cell = min(MAP_CELL, bead / MIN_CELLS_PER_BEAD)
    start, end = line.points[:-1, :2][line.printed], line.points[1:, :2][line.printed]
    planned = _drops(start, end, np.linalg.norm(end - start, axis=1), line.layer[line.printed], cell)
    deposited = _deposited_drops(log, line, cell)
    places = np.concatenate([line.points[:, :2], deposited.places])
    margin = bead / 2 + 3 * cell  # of these, 2 for the bead's blurred edge
    low = places.min(axis=0) - margin
    columns, rows = np.ceil((places.max(axis=0) + margin - low) / cell).astype(int)
    layers = np.unique(line.layer[line.printed])
    disc = _disc(bead / cell) / cell  # of 1 mm of bead

    def thickness(drops: _Drops) -> Array:
        places = (drops.places - low) / cell
        each = [_spread(places, drops.material * (drops.layer == n), (rows, columns), disc) for n in layers]
        return np.array(each).reshape(len(layers), rows, columns)

    return DepositMap(low, cell, layers, thickness(planned), thickness(deposited))


def deposit_figures(thickness: DepositMap) -> DepositFigures:
    """The figures of a map."""
    planned, deposited = thickness.planned, thickness.deposited
    square = thickness.cell**2
    target, actual = np.minimum(planned, 1.0), np.minimum(deposited, 1.0)
    area, cells = float(target.sum()) * square, int((planned >= HALF_BEAD).sum())
    if not cells:
        return DepositFigures(area, *[float("nan")] * 5)
    gaps, overlaps = gaps_and_overlaps(planned, deposited)
    return DepositFigures(
        area=area,
        coverage=float(np.minimum(target, actual).sum()) * square / area,
        gaps=float(gaps.sum()) / cells,
        overlap=float(overlaps.sum()) / cells,
        outside=float(np.maximum(actual - target, 0.0).sum()) * square / area,
        material=float(deposited.sum() / planned.sum()),
    )


def gaps_and_overlaps(planned: Array, deposited: Array) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Which cells (...) are gaps and which overlap, as DepositFigures counts them, of thicknesses (...)."""
    in_plan = planned >= HALF_BEAD
    gaps = in_plan & (deposited <= np.minimum(planned, 1.0) - HALF_BEAD)
    return gaps, in_plan & (deposited > np.maximum(1.5 * planned, planned + HALF_BEAD))


@dataclass(frozen=True, slots=True, eq=False)
class _Drops:
    """Material in N small drops."""

    places: Array  # (N, 2) mm
    material: Array  # (N,) mm of bead
    layer: NDArray[np.int64]  # (N,)


def _deposited_drops(log: NozzleLog, line: PlannedLine, cell: float) -> _Drops:
    flat, length = np.linalg.norm(np.diff(line.points[:, :2], axis=0), axis=1), np.diff(line.knots)
    flat_share = np.where(length > MIN_SPACING, flat / np.maximum(length, MIN_SPACING), 1.0)  # of the path's length
    volume, piece = row_volumes(log)[1:], row_pieces(log, line)[1:]
    known = (volume > 0) & np.isfinite(log.surface_from_tip[:-1, 0]) & np.isfinite(log.surface_from_tip[1:, 0])
    start, end = log.surface_from_tip[:-1, :2][known], log.surface_from_tip[1:, :2][known]
    volume, piece = volume[known], piece[known]
    low, high = line.points[:, :2].min(axis=0) - MAP_REACH, line.points[:, :2].max(axis=0) + MAP_REACH
    start, end = np.clip(start, low, high), np.clip(end, low, high)
    return _drops(start, end, volume / line.area[piece] * flat_share[piece], line.layer[piece], cell)


def _drops(start: Array, end: Array, material: Array, layer: NDArray[np.int64], cell: float) -> _Drops:
    """Pieces from start to end (M, 2), mm, each with its material (M,), as drops spread evenly along them."""
    length = np.linalg.norm(end - start, axis=1)
    count = np.maximum(np.ceil(length * SAMPLES_PER_CELL / cell), 1).astype(int)
    piece = np.repeat(np.arange(len(start)), count)
    first = np.concatenate([[0], np.cumsum(count)[:-1]]).astype(int) if len(count) else count
    share = (np.arange(len(piece)) - first[piece] + 0.5) / count[piece]
    places = start[piece] + share[:, None] * (end - start)[piece]
    return _Drops(places, (material / count)[piece], layer[piece])


def _spread(places: Array, material: Array, shape: tuple[int, int], disc: Array) -> Array:
    """Thickness (H, W) of material (N,) at places (N, 2) in cells: shared among the four nearest, then as discs."""
    position = places - 0.5  # in units of cell centres
    corner = np.floor(position).astype(int)
    part = position - corner
    dots = np.zeros(shape[0] * shape[1])
    for x in (0, 1):
        for y in (0, 1):
            weight = material * np.abs(1 - x - part[:, 0]) * np.abs(1 - y - part[:, 1])
            dots += np.bincount((corner[:, 1] + y) * shape[1] + corner[:, 0] + x, weight, len(dots))
    thickness = cv2.filter2D(dots.reshape(shape), -1, disc, borderType=cv2.BORDER_CONSTANT)  # the disc is symmetric
    return np.asarray(np.where(thickness > 1e-9, thickness, 0.0))  # the transform has errors of 1e-16


def _disc(width: float) -> Array:
    """Weights (M, M), M odd, of a disc `width` cells wide: share of 1 cell of bead in each cell around it."""
    reach = int(np.ceil(width / 2))
    fine = (np.arange((2 * reach + 1) * _DISC_SUBCELLS) + 0.5) / _DISC_SUBCELLS - reach - 0.5
    inside = (width / 2) ** 2 - fine[:, None] ** 2 - fine[None] ** 2
    density = np.where(inside > 0, 1 / np.sqrt(np.where(inside > 0, inside, 1.0)), 0.0)
    weights = density.reshape(2 * reach + 1, _DISC_SUBCELLS, 2 * reach + 1, _DISC_SUBCELLS).sum(axis=(1, 3))
    return np.asarray(width * weights / weights.sum())


BLOB_RADIUS = 1.0  # mm about a bead's end, for the comparison of its volume with the plan


def planned_beads(line: PlannedLine) -> tuple[Array, Array, Array]:
    """Beginning and end of each planned bead, (B,) mm of the path, rising; and its cross-section there, mm^2."""
    flips = np.diff(np.concatenate([[False], line.printed, [False]]).astype(np.int8))
    first, last = np.flatnonzero(flips > 0), np.flatnonzero(flips < 0)
    return line.knots[first], line.knots[last], line.area[first]


def excess_volumes(log: NozzleLog, line: PlannedLine, places: Array, layers: NDArray[np.int64]) -> Array:
    """Volume (B,), mm^3, laid within BLOB_RADIUS of places (B, 2) in their layers (B,), less the planned."""
    volume, layer = row_volumes(log), line.layer[row_pieces(log, line)]
    flow_rows = np.flatnonzero((volume > 0) & np.isfinite(log.surface_from_tip[:, 0]))
    tree = cKDTree(log.surface_from_tip[flow_rows, :2])
    volumes = np.zeros(len(places))
    for i, indices in enumerate(tree.query_ball_point(places, BLOB_RADIUS) if len(places) else ()):
        near = flow_rows[indices]
        volumes[i] = volume[near[layer[near] == layers[i]]].sum() - _planned_volume(line, places[i], layers[i])
    return volumes


def _planned_volume(line: PlannedLine, place: Array, layer: int) -> float:
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
