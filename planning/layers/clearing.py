"""Where the tool has no room over a bead: it is turned, as little as does, or the stretch is left out and told.

What a tool meets is the scan and what was laid before: all layers under the one that is printed.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from estimation import se3
from estimation.errors import InputError
from estimation.scans.scan import Scan
from estimation.se3 import Array
from planning.clearance import MAX_DEPTH, Envelope, TissueGuard, ToolBody, envelope_over, rooms
from planning.layers.checkpoints import BeadPoints, Checkpoints, CheckpointSettings, ToolLimits, tool_rotations
from planning.layers.grid import HeightMap, axes_along, height_map, interpolate, nodes_within
from planning.layers.slicing import LayerStack
from planning.layers.wound import WoundVolume
from planning.path import Path

Index = NDArray[np.int64]
Mask = NDArray[np.bool_]
Free = Callable[[Index, Array, float], Mask]  # whether points (M,) at tilts (M, 2) have so many mm of room: (M,)
STATION = 1.25  # mm between the places of a bead at which tilts are chosen
TILT_STEP = float(np.deg2rad(5.0))  # between the tilts that are tried; what is chosen is taken back as far as it goes
SURPLUS = 0.1  # mm of room that a tilt must have to be chosen: between two places it may be less
OUT_COST = float(np.deg2rad(60.0)) ** 2  # of leaving out a mm, against tilting it: dearer than the greatest tilt
ENTRY_COST = 5.0 * OUT_COST  # of beginning and ending a stretch that is left out
SHRINK_STEPS = 5  # halvings of how far a bead's tilts can be taken back: to a 32nd of them
MIN_STRETCH = 2.0  # mm of a bead, five widths: shorter pieces between stretches that are left out are left out too
RAISE_STEP, MAX_RAISES = 1.0, 30  # mm, of a travel: to 30 mm over where it was
TOOL_SIDEWAYS = 30.0  # mm beside a path that its tool reaches over: 96 mm of syringe, leaning 20 degrees
MIN_GRID_STEP, MAX_GRID_NODES = 0.5, 300_000  # mm, of an envelope; 40 ms to fill


@dataclass(frozen=True, slots=True)
class LeftOut:
    """A stretch of a bead over which the tool has no room."""

    layer: int
    length: float  # mm
    place: Array  # (3,) mm, its middle, scan frame
    part: str  # of the tool that would come too near
    short: float  # mm of room that it lacks at worst, where it stands as the layer asks for
    line: Array  # (N, 2) mm, in the chart


@dataclass(frozen=True, slots=True, eq=False)
class ToolClearance:
    """What was done to keep the tool clear."""

    turned: int  # points of beads at which the tool was turned away from the layer's normal
    most: float  # rad, the most
    left_out: tuple[LeftOut, ...]
    margin: float  # mm that was kept


class LaidTissue:
    """What a tool meets while each layer is printed, in the plane's frame: the scan, and the layers below."""

    def __init__(self, wound: WoundVolume, stack: LayerStack, body: ToolBody) -> None:
        self.body, grid = body, wound.grid
        low, high = float(wound.bed.min()), float(np.maximum(wound.bed, wound.skin).max())
        volume = float(np.prod(np.array(grid.shape) * grid.step)) * (high - low + body.reach + MAX_DEPTH)
        coarse = grid.coarser(max(MIN_GRID_STEP, (volume / MAX_GRID_NODES) ** (1 / 3), grid.step))
        inside, nodes = nodes_within(coarse, wound.outline), coarse.nodes.reshape(-1, 2)
        fields = np.stack([wound.bed, wound.skin, stack.lowest, stack.highest], axis=-1)
        bed, skin, lowest, highest = np.moveaxis(interpolate(grid, fields, nodes).reshape(*coarse.shape, 4), -1, 0)

        def over(heights: Array) -> Envelope:
            return envelope_over(np.eye(4), coarse.origin, coarse.step, heights, body.reach)

        self._scan = over(bed)
        self._laid: dict[int, tuple[Envelope, float]] = {}  # by layer, and how far under it its envelope's tissue is
        deep = float(bed.min()) - body.reach
        last = over(np.where(inside, highest, deep)) if stack.mode != "conformal" else None
        for below, layer in pairwise(stack.layers):
            if last is not None:  # all layers are the last one moved down
                down = (1 - below.share) * float((highest - lowest)[inside].mean())
                self._laid[layer.number] = last, down
            else:
                top = np.minimum(lowest + below.share * (highest - lowest), skin)
                self._laid[layer.number] = over(np.where(inside, np.maximum(top, bed), deep)), 0.0

    def rooms(
        self, tip: Array, tilt: Array, layer: Index, resolved: float = 0.0, sign: bool = False
    ) -> tuple[Array, Index]:
        """`rooms` of tips (N, 3) and tilts (N, 2) while layers (N,) are printed, and the tool's part (N,)."""
        pose = se3.make(tool_rotations(tilt, 0.0), tip)
        room, part = rooms(self.body, self._scan, pose, resolved, sign)
        for number, (envelope, down) in self._laid.items():
            rows = np.flatnonzero(layer == number)
            if len(rows):
                lifted = se3.make(np.eye(3), [0.0, 0.0, down]) @ pose[rows]
                laid, of = rooms(self.body, envelope, lifted, resolved, sign)
                part[rows] = np.where(laid < room[rows], of, part[rows])
                room[rows] = np.minimum(room[rows], laid)
        return room, part


def beads_with_room(
    runs: BeadPoints, printed: Checkpoints, laid: LaidTissue, way: CheckpointSettings, surface_from_plane: Array
) -> tuple[BeadPoints, Checkpoints, ToolClearance]:
    """Beads along which the tool has room: turned where it had none, and cut where it has none at any tilt."""
    before, part = laid.rooms(printed.tip, printed.tilt, printed.layer)

    def free(rows: Index, tilt: Array, least: float) -> Mask:
        return np.asarray(laid.rooms(printed.tip[rows], tilt, printed.layer[rows], least, sign=True)[0] >= least)

    tilt, out = tilts_with_room(printed.tip, printed.tilt, printed.bead, before, free, way.tool)
    turned = np.linalg.norm(tilt - printed.tilt, axis=1)
    turned[out] = 0.0
    stretches = _stretches(out, printed.bead)
    left = tuple(
        _left_out(runs, printed, a, b, before, [laid.body.names[k] for k in part], surface_from_plane)
        for a, b in stretches
    )
    clearance = ToolClearance(int((turned > 0).sum()), float(turned.max(initial=0.0)), left, laid.body.margin)
    printed = replace(printed, tilt=tilt)
    if not left:
        return runs, printed, clearance
    kept = np.flatnonzero(~out)
    begins = np.r_[True, (np.diff(kept) > 1) | (np.diff(printed.bead[kept]) > 0)][: len(kept)]
    number = np.cumsum(begins) - 1
    cut = {f.name: getattr(printed, f.name)[kept] for f in fields(Checkpoints)}
    cut |= {"bead": number, "extrude": ~begins, "volume": np.where(begins, 0.0, cut["volume"])}
    cut["speed"] = np.where(begins, way.travel, cut["speed"])
    return BeadPoints(runs.points[kept], runs.width[kept], number), Checkpoints(**cut), clearance


def _stretches(out: Mask, bead: Index) -> list[tuple[int, int]]:
    """Where stretches of points that are left out (N,) begin and end, within one bead each."""
    group = np.where(out, bead, -1)
    edges = np.flatnonzero(np.diff(np.r_[-1, group, -1]))
    return [(a, b) for a, b in pairwise(edges.tolist()) if group[a] >= 0]


def _left_out(
    runs: BeadPoints, printed: Checkpoints, a: int, b: int, room: Array, parts: Sequence[str], surface_from_plane: Array
) -> LeftOut:
    worst = a + int(room[a:b].argmin())
    length = float(runs.steps[a + 1 : b].sum())
    place = se3.transform_points(surface_from_plane, printed.tip[(a + b) // 2][None])[0]
    return LeftOut(int(printed.layer[a]), length, place, parts[worst], -float(room[worst]), runs.points[a:b])


def travels_with_room(points: Checkpoints, laid: LaidTissue) -> Checkpoints:
    """The same checkpoints, those of travels raised until the tool has room, where that helps."""
    tip, rows = points.tip.copy(), np.flatnonzero(points.width == 0)
    for _ in range(MAX_RAISES):
        rows = rows[laid.rooms(tip[rows], points.tilt[rows], points.layer[rows])[0] < 0]
        if not len(rows):
            break
        tip[rows, 2] += RAISE_STEP
    return replace(points, tip=tip)


def tilts_with_room(
    tip: Array, tilt: Array, bead: Index, before: Array, free: Free, limits: ToolLimits
) -> tuple[Array, Mask]:
    """Tilts (N, 2) at which beads' points, tips (N, 3) mm and tilts (N, 2), have room, and which points (N,) have none.

    bead: (N,) ascending; before: (N,) mm of room at `tilt`. Beads that have room all along are left as they are; along
    the others tilts change no faster than the limits, by the way of least tilt, found by dynamic programming over
    places STATION apart.
    """
    result, out = tilt.copy(), np.zeros(len(tip), bool)
    tight = np.unique(bead[before < 0])
    for number in tight.tolist():
        rows = np.arange(np.searchsorted(bead, number), np.searchsorted(bead, number, side="right"))
        result[rows], out[rows] = _bead_tilts(rows, tip[rows], tilt[rows], before[rows], free, limits)
    return result, out


def _bead_tilts(
    rows: Index, tip: Array, tilt: Array, before: Array, free: Free, limits: ToolLimits
) -> tuple[Array, Mask]:
    along = np.r_[0.0, np.cumsum(np.linalg.norm(np.diff(tip, axis=0), axis=1))]
    spacing = max(STATION, 1.05 * TILT_STEP / limits.turning)
    wanted = np.linspace(0, along[-1], max(2, int(along[-1] / spacing) + 1))
    station = np.unique(np.searchsorted(along, wanted - 1e-9).clip(max=len(along) - 1))
    tries = _tilts_to_try(limits)
    tries = np.broadcast_to(tries, (len(station), *tries.shape))
    tilts = np.concatenate([tilt[station][:, None], tries], axis=1)
    fits = free(np.repeat(rows[station], tilts.shape[1]), tilts.reshape(-1, 2), SURPLUS).reshape(tilts.shape[:2])
    fits[:, 0] |= before[station] >= 0
    if not fits.any():
        return tilt, np.ones(len(tip), bool)
    chosen = _least_tilt(along[station], tilts, fits, limits)
    inside = chosen >= 0
    off = np.where(inside[:, None], tilts[np.arange(len(station)), chosen] - tilt[station], 0.0)
    known = np.flatnonzero(inside)
    out = np.interp(along, along[station], (~inside).astype(float)) > 0
    if not len(known):
        return tilt, np.ones(len(tip), bool)
    turn = np.column_stack([np.interp(along, along[station[known]], off[known, k]) for k in range(2)])
    out |= ~free(rows, tilt + turn, 0.0)
    low, high = 0.0, 1.0
    for _ in range(SHRINK_STEPS):
        half = (low + high) / 2
        enough = bool(free(rows[~out], (tilt + half * turn)[~out], 0.0).all())
        low, high = (low, half) if enough else (half, high)
    out = _without_scraps(along, out)
    return np.where(out[:, None], tilt, tilt + high * turn), out


def _tilts_to_try(limits: ToolLimits) -> Array:
    """Tilts (C, 2) all over what is allowed, TILT_STEP apart."""
    count = int(limits.tilt / TILT_STEP) + 1
    grid = TILT_STEP * np.stack(np.meshgrid(*[np.arange(-count, count + 1)] * 2), axis=-1).reshape(-1, 2)
    return np.asarray(grid[np.linalg.norm(grid, axis=1) <= limits.tilt])


def _least_tilt(along: Array, tilts: Array, free: Mask, limits: ToolLimits) -> Index:
    """Which of tilts (S, C, 2) to take at S places, the first being what is wanted; -1: none, it is left out."""
    off = np.sum((tilts - tilts[:, :1]) ** 2, axis=2)
    cost = np.where(free[0], off[0], np.inf)
    out, came = OUT_COST, list[Index]()
    for k in range(1, len(along)):
        way = float(along[k] - along[k - 1])
        apart = np.linalg.norm(tilts[k - 1][:, None] - tilts[k][None], axis=2)
        step = np.where(apart <= limits.turning * way + 1e-9, cost[:, None] + apart**2 / way, np.inf)
        best = step.argmin(axis=0)
        before = step[best, np.arange(len(best))]
        best = np.where(out + ENTRY_COST < before, -1, best)
        cheapest = int(cost.argmin())
        came.append(np.r_[best, cheapest if cost[cheapest] + ENTRY_COST < out else -1])
        cost, out = (
            np.where(free[k], np.minimum(before, out + ENTRY_COST) + off[k] * way, np.inf),
            min(out, float(cost[cheapest]) + ENTRY_COST) + OUT_COST * way,
        )
    last = int(cost.argmin()) if cost.min() < out else -1
    chosen = [last]
    for each in reversed(came):
        chosen.append(int(each[chosen[-1]]))
    return np.array(chosen[::-1])


def _without_scraps(along: Array, out: Mask) -> Mask:
    """What is left out (N,), with the pieces between that are shorter than MIN_STRETCH."""
    if not out.any():
        return out
    out = out.copy()
    edges = np.flatnonzero(np.diff(np.r_[True, out, True]))
    for first, end in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True):
        if along[end - 1] - along[first] < MIN_STRETCH:
            out[first:end] = True
    return out


def plane_under(path: Path) -> Array:
    """surface_from_plane (4, 4), mm, of a plane in the middle of what a path extrudes, z as its tools stand."""
    own = path.surface_from_nozzle[path.extrude] if path.extrude.any() else path.surface_from_nozzle
    up = own[:, :3, 2].mean(axis=0)
    return se3.make(axes_along(up / np.linalg.norm(up), np.eye(3)[0]), own[:, :3, 3].mean(axis=0))


def scanned_heights(scan: Scan, path: Path) -> HeightMap:
    """The heights of a scan around a path, over the plane under it; InputError where there is none of it."""
    plane = plane_under(path)
    places = se3.transform_points(se3.inverse(plane), path.surface_from_nozzle[:, :3, 3])[:, :2]
    box = np.stack([places.min(axis=0) - TOOL_SIDEWAYS, places.max(axis=0) + TOOL_SIDEWAYS])
    points = se3.transform_points(se3.inverse(plane), scan.vertices)[:, :2]
    low, high = np.maximum(points.min(axis=0), box[0]), np.minimum(points.max(axis=0), box[1])
    if not (high - low > 2 * MIN_GRID_STEP).all():
        raise InputError("scan", "place", "nothing of it at the path", "the scan that the path was planned on")
    area = float(np.prod(high - low))
    return height_map(scan, plane, max(MIN_GRID_STEP, (area / MAX_GRID_NODES * 40) ** 0.5), box)


def tissue_guard(scan: Scan, path: Path, body: ToolBody) -> TissueGuard:
    """What a live run keeps the tool out of: the scan around a path, both in one frame."""
    heights = scanned_heights(scan, path)
    return TissueGuard(body, _over(heights, heights.heights, body.reach + heights.grid.step))  # that `clear` can tell


def path_rooms(scan: Scan, path: Path, body: ToolBody) -> tuple[Array, list[str]]:
    """The tool's room (N,), mm, at a path's checkpoints, as `rooms`, and the part there.

    It meets the scan, and what the layers before have laid.
    """
    lies = scanned_heights(scan, path)
    grid, heights = lies.grid, lies.heights.copy()
    tips = se3.transform_points(se3.inverse(lies.surface_from_plane), path.surface_from_nozzle[:, :3, 3])
    nodes = np.rint((tips[:, :2] - grid.origin) / grid.step).astype(np.int64).clip(0, np.array(grid.shape[::-1]) - 1)
    room, part = np.full(len(path), np.inf), np.full(len(path), -1)
    for layer in np.unique(path.layer):
        own = np.flatnonzero(path.layer == layer)
        envelope = _over(lies, heights, body.reach)
        room[own], part[own] = rooms(body, envelope, path.surface_from_nozzle[own])
        laid = own[path.extrude[own]]
        np.maximum.at(heights, (nodes[laid, 1], nodes[laid, 0]), tips[laid, 2])
    return room, [body.names[k] if k >= 0 else "" for k in part]


def _over(lies: HeightMap, heights: Array, reach: float) -> Envelope:
    return envelope_over(se3.inverse(lies.surface_from_plane), lies.grid.origin, lies.grid.step, heights, reach)
