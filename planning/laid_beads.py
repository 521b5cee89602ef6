"""What was laid, judged by the surface before and after: volume and height of each piece of bead, gaps, blobs, a clog.

Between two height fields of one lattice lies the volume that came, whatever the surface's slope. A planned bead of
cross-section A and width w is taken for a parabola, 3 A / (2 w) high, which fills A; swept along the path with round
ends, where neighbours overlap they add up. Each node belongs to the nearest bead, planned and measured alike, so a
piece of bead is not wronged by its neighbours. What both fields are off by together, away from all beads, is taken off.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from estimation.errors import InputError
from estimation.se3 import Array, Index
from estimation.surface_map import SurfaceHeights
from planning.material import AS_PLANNED, FlowShares, bead_areas, is_metered
from planning.path import MIN_SPACING, Path, ways_along

STATION_LENGTH = 1.25  # mm of bead judged as one: a quarter of the shortest clog that must be found, to see its ends
BESIDE = 0.4  # mm beside a planned bead that count to it: how far a nozzle is off, and gel creeps
AWAY = 1.5  # mm from all planned beads, beyond which nothing can have come
MIN_AWAY_NODES = 50  # nodes from which the common offset is taken
SHARED_ERROR = 1.0  # mm within which nodes share their error: about half a patch of the matching
MIN_SEEN = 0.6  # share of a piece's nodes that must be measured
GAP_SHARE, BLOB_SHARE = 0.6, 1.6  # of the planned volume: less is a gap, more a blob
SURE = 2.0  # sigmas by which it is so
CLOG_LENGTH = 1.2  # mm of bead that pieces in a row lack together: good beads up to 0.3, clogs of 5.2 mm from 1.7 on
CLOG_REFERENCE = 0.2  # share that a piece lacks in vain: pieces of good beads are told to 0.05-0.08
CLOG_OVER = 0.7  # mm by which the sum falls back where a clog is over: three good pieces, so two clogs are not one
CLOG_END = 0.35  # of what the emptiest piece lacks, below which a piece at the end is no part of a clog
MIN_USUAL = 0.5  # of the planned: what most pieces have, below which most of them are clogged


@dataclass(frozen=True, slots=True, eq=False)
class BeadPieces:
    """P straight pieces of planned beads in the order in which they are laid, surface frame."""

    start: Array  # (P, 3) mm
    end: Array  # (P, 3) mm
    area: Array  # (P,) mm^2, cross-section
    width: Array  # (P,) mm
    bead: Index  # (P,) number of the bead, rising by one
    layer: Index  # (P,)
    place: Array  # (P,) mm along the path, of the start

    def __len__(self) -> int:
        return len(self.area)


def pieces_between(
    path: Path, first: float, last: float, where: object = "path", told: FlowShares = AS_PLANNED
) -> BeadPieces:
    """The beads that a path lays from `first` to `last`, in checkpoints, between which both may lie.

    told: shares of the planned that it is told to lay; with more a bead gets higher and wider, in the same form.
    InputError for a path that does not say how much material it needs.
    """
    if not is_metered(path):
        raise InputError(where, "look", "a path without amounts", "columns width_mm and height_mm, or volume_mm3")
    ways = np.arange(max(int(np.floor(first)), 0) + 1, min(int(np.ceil(last)), len(path) - 1) + 1)
    poses = path.surface_from_nozzle
    knots = ways_along(path.surface_from_nozzle)
    begins = path.extrude & ~np.concatenate([[False], path.extrude[:-1]])
    bead = np.cumsum(begins) - 1
    begun, done = np.clip(first - ways + 1, 0.0, 1.0), np.clip(last - ways + 1, 0.0, 1.0)  # shares of each way
    share = np.ones(len(ways))
    if told is not AS_PLANNED and len(ways):
        ways, begun, done, share = _cut_ways(ways, begun, done, told)
    moved = np.linalg.norm(np.diff(poses[:, :2, 3], axis=0), axis=1)[ways - 1] * (done - begun) > MIN_SPACING
    ways, begun, done, share = (column[path.extrude[ways] & moved] for column in (ways, begun, done, share))
    area = bead_areas(path, where)[ways]
    width = np.sqrt(2.5 * area)  # of a bead 0.4 as high as it is wide
    if "width_mm" in path.extra:
        width = path.extra["width_mm"][ways].astype(float)
    area, width = area * share, width * np.sqrt(share)
    way, whole = poses[ways, :3, 3] - poses[ways - 1, :3, 3], knots[ways] - knots[ways - 1]
    start, end = (poses[ways - 1, :3, 3] + share[:, None] * way for share in (begun, done))
    return BeadPieces(start, end, area, width, bead[ways], path.layer[ways], knots[ways - 1] + begun * whole)


def _cut_ways(ways: Index, begun: Array, done: Array, told: FlowShares) -> tuple[Index, Array, Array, Array]:
    """Ways (P,), from their `begun` to their `done`, cut where the flow changes, and the share that each is told."""
    low, high = ways - 1 + begun, ways - 1 + done
    edges = np.unique(np.concatenate([low, high, told.begin, told.end]))
    middle = (edges[1:] + edges[:-1]) / 2
    own = np.searchsorted(low, middle, "right") - 1
    inside = (own >= 0) & (middle < high[np.maximum(own, 0)])
    ways = ways[own[inside]]
    return ways, edges[:-1][inside] - ways + 1, edges[1:][inside] - ways + 1, told.at(middle[inside])


def bead_heights(pieces: BeadPieces, nodes: Array) -> Array:
    """How high (H, W) mm planned beads lie over nodes (H, W, 2) mm of a lattice, x and y; they keep their volume."""
    heights = np.zeros(nodes.shape[:2])
    x, y = nodes[0, :, 0], nodes[:, 0, 1]
    for a, b, area, width in zip(pieces.start, pieces.end, pieces.area, pieces.width, strict=True):
        radius, way = width / 2, b[:2] - a[:2]
        length = float(np.linalg.norm(way))
        low, high = np.minimum(a, b)[:2] - radius, np.maximum(a, b)[:2] + radius
        columns = slice(*np.searchsorted(x, (low[0], high[0])))
        rows = slice(*np.searchsorted(y, (low[1], high[1])))
        off = nodes[rows, columns] - a[:2]
        along = off @ way / length
        across = (off[..., 0] * way[1] - off[..., 1] * way[0]) / length
        chord = np.sqrt(np.maximum(radius**2 - across**2, 0.0))
        swept = _half_disc(along, chord) - _half_disc(along - length, chord)
        steep = float(np.linalg.norm(b - a)) / length  # more gel over the same ground on a slope
        heights[rows, columns] += 1.5 * area * steep / (np.pi * radius**3) * swept
    return heights


def _half_disc(at: Array, radius: Array) -> Array:
    """The integral (...) of sqrt(radius^2 - t^2) over t from 0 to `at`, of which only -radius to radius counts."""
    t = np.clip(at, -radius, radius)
    angle = np.arcsin(t / np.maximum(radius, 1e-12))
    return np.asarray(0.5 * (t * np.sqrt(np.maximum(radius**2 - t**2, 0.0)) + radius**2 * angle))


@dataclass(frozen=True, slots=True, eq=False)
class Stations:
    """S pieces of bead, each judged as one, in the order in which they are laid."""

    bead: Index  # (S,)
    layer: Index  # (S,)
    begin: Array  # (S,) mm along the path
    end: Array  # (S,) mm
    crest: Array  # (S,) mm, height of a single bead as planned
    width: Array  # (S,) mm


def stations_of(pieces: BeadPieces) -> Stations:
    """Beads cut evenly into stations of about STATION_LENGTH."""
    lengths, rows = np.linalg.norm(pieces.end - pieces.start, axis=1), []
    for bead in np.unique(pieces.bead):
        own = np.flatnonzero(pieces.bead == bead)
        begin, end = pieces.place[own[0]], pieces.place[own[-1]] + lengths[own[-1]]
        edges = np.linspace(begin, end, max(1, round((end - begin) / STATION_LENGTH)) + 1)
        middle = own[np.searchsorted(pieces.place[own], (edges[1:] + edges[:-1]) / 2, "right") - 1]
        crest = 1.5 * pieces.area[middle] / pieces.width[middle]
        rows.append((np.full(len(middle), bead), pieces.layer[middle], edges[:-1], edges[1:], crest, middle))
    if not rows:
        none, zero = np.zeros(0, np.int64), np.zeros(0)
        return Stations(none, none, zero, zero, zero, zero)
    bead, layer, begin, end, crest, middle = (np.concatenate(column) for column in zip(*rows, strict=True))
    return Stations(bead, layer, begin, end, crest, pieces.width[middle])


def nearest_station(pieces: BeadPieces, stations: Stations, nodes: Array) -> tuple[NDArray[np.int64], Array]:
    """Station (H, W) of the planned bead nearest to each node (H, W, 2) mm, and how far it is beside it, mm.

    -1 beyond BESIDE; below 0 the node lies on the bead.
    """
    flat = nodes.reshape(-1, 2)
    best, place, bead = np.full(len(flat), np.inf), np.zeros(len(flat)), np.full(len(flat), -1)
    for i in range(len(pieces)):
        a, way = pieces.start[i, :2], (pieces.end - pieces.start)[i, :2]
        share = np.clip((flat - a) @ way / float(way @ way), 0.0, 1.0)
        away = np.linalg.norm(flat - a - share[:, None] * way, axis=1) - pieces.width[i] / 2
        nearer = away < best
        best[nearer], bead[nearer] = away[nearer], pieces.bead[i]
        place[nearer] = pieces.place[i] + share[nearer] * float(np.linalg.norm(pieces.end[i] - pieces.start[i]))
    order = np.full(len(flat), -1, np.int64)
    near = best < BESIDE
    order[near] = np.searchsorted(stations.begin, place[near], "right") - 1
    order[near & (order < 0)] = 0
    wrong = near & (stations.bead[order] != bead) if len(stations.bead) else near
    order[wrong] += 1  # a bead's first place, rounded to just before it
    return order.reshape(nodes.shape[:2]), best.reshape(nodes.shape[:2])


@dataclass(frozen=True, slots=True, eq=False)
class LaidBeads:
    """The S stations of a look, as they were laid; NaN where too little was seen."""

    stations: Stations
    planned: Array  # (S,) mm^3
    volume: Array  # (S,) mm^3
    sigma: Array  # (S,) mm^3
    height: Array  # (S,) mm, of the crest that a single bead would have
    height_sigma: Array  # (S,) mm

    @property
    def share(self) -> Array:
        """Laid of the planned (S,)."""
        return np.asarray(self.volume / self.planned)

    @property
    def gap(self) -> NDArray[np.bool_]:
        """(S,) where surely too little lies."""
        with np.errstate(invalid="ignore"):
            return np.asarray(self.volume + SURE * self.sigma < GAP_SHARE * self.planned)

    @property
    def blob(self) -> NDArray[np.bool_]:
        """(S,) where surely too much lies."""
        with np.errstate(invalid="ignore"):
            return np.asarray(self.volume - SURE * self.sigma > BLOB_SHARE * self.planned)

    @property
    def clogs(self) -> list[tuple[float, float]]:
        """From, to, mm along the path: pieces in the order in which they were laid that lack CLOG_LENGTH of bead.

        By a cumulative sum (Page 1954) of what each lacks beside what pieces usually have, less CLOG_REFERENCE.
        """
        length = self.stations.end - self.stations.begin
        seen = np.isfinite(self.volume)
        usual = float(np.median(self.share[seen])) if seen.any() else 1.0
        usual = min(usual, 1.0) if usual > MIN_USUAL else 1.0
        lacks = np.where(seen, 1 - self.share / usual, CLOG_REFERENCE) * length  # what was not seen is passed over
        unsure = np.where(seen, self.sigma / self.planned / usual, 0.0) * length
        clogs, first, total, most, last = list[tuple[float, float]](), 0, 0.0, 0.0, 0
        for i, gain in enumerate([*(lacks - CLOG_REFERENCE * length).tolist(), -math.inf]):
            total += gain
            if total > most:
                most, last = total, i + 1
            if total > max(0.0, most - CLOG_OVER):
                continue
            own = first + np.flatnonzero(lacks[first:last] > CLOG_END * lacks[first:last].max(initial=0.0))
            if len(own) and lacks[own].sum() > max(CLOG_LENGTH, SURE * unsure[own].sum()):
                clogs.append((float(self.stations.begin[own[0]]), float(self.stations.end[own[-1]])))
            first, total, most, last = i + 1, 0.0, 0.0, 0
        return clogs

    @property
    def total(self) -> tuple[float, float, float]:
        """Laid, planned, mm^3, of what was seen, and the share of the planned that was."""
        seen = np.isfinite(self.volume)
        planned = float(self.planned[seen].sum())
        return float(self.volume[seen].sum()), planned, planned / max(float(self.planned.sum()), 1e-12)


def judge_beads(before: SurfaceHeights, after: SurfaceHeights, pieces: BeadPieces) -> LaidBeads:
    """What lies where beads were planned; both fields are of one lattice, surface frame."""
    assert before.heights.shape == after.heights.shape and before.step == after.step
    nodes, cell = after.nodes, after.step**2
    stations = stations_of(pieces)
    station, beside = nearest_station(pieces, stations, nodes)
    risen = after.heights - before.heights
    away = (beside > AWAY) & np.isfinite(risen)
    if away.sum() >= MIN_AWAY_NODES:
        risen = risen - np.median(risen[away])
    due, variance = bead_heights(pieces, nodes), before.sigma**2 + after.sigma**2
    count = len(stations.bead)
    own = station >= 0
    seen = own & np.isfinite(risen) & np.isfinite(variance)

    def total(values: Array, where: NDArray[np.bool_]) -> Array:
        return np.asarray(np.bincount(station[where], values[where], count)[:count], float)

    nodes_seen, squares = total(np.ones_like(due), seen), total(due**2, seen)
    enough = (nodes_seen >= MIN_SEEN * np.maximum(total(np.ones_like(due), own), 1)) & (nodes_seen > 0)
    with np.errstate(invalid="ignore", divide="ignore"):
        planned = total(due, own) * cell
        filled = planned / (total(due, seen) * cell)  # for what was not seen of a piece
        shared = np.minimum(nodes_seen, np.pi * (SHARED_ERROR / after.step) ** 2)
        volume = np.where(enough, total(risen, seen) * cell * filled, np.nan)
        sigma = np.sqrt(total(variance, seen) * shared) * cell * filled
        scale = np.where(enough, total(risen * due, seen) / squares, np.nan)
        scale_sigma = np.sqrt(total(variance * due**2, seen) * shared) / squares
    return LaidBeads(stations, planned, volume, sigma, scale * stations.crest, scale_sigma * stations.crest)


LOOK_BY_LAYER = "layer"
MIN_FLOW, MAX_FLOW = 0.7, 1.5  # of the planned, in an adapted layer: beads neither break nor run over their neighbours
MIN_LACK = 0.1  # share of the planned that pieces lack, and surely so, below which nothing is done
MAX_UNSURE = 0.25  # sigma by the planned of a piece, beyond which it counts for nothing
MIN_LOOK_SEEN = 0.6  # of the pieces that must be sure: else nothing is done; those that are not count for nothing
FILL_SIGMA = 0.7  # mm beside a place, over which what lies under it is averaged,
FILL_REACH = 2.0  # mm, and beyond which nothing is known of it
SHARE_SAMPLES = np.linspace(0.05, 0.95, 10)  # of a piece, at which what it was told is averaged


def beads_between_looks(where: object, key: str, value: object) -> int | None:
    """How many beads lie between looks, 0: a layer; None of None. InputError of what is neither."""
    if value is None or value == LOOK_BY_LAYER:
        return None if value is None else 0
    if isinstance(value, bool) or not isinstance(value, int) or value < 1:
        raise InputError(where, key, value, f'"{LOOK_BY_LAYER}", or a number of beads of 1 or more')
    return value


def with_looks(path: Path, beads: int = 0) -> Path:
    """The path with a look before all, and after each layer, or after every so many beads and the last one."""
    ends = np.flatnonzero(path.extrude & ~np.append(path.extrude[1:], False))
    if beads:
        ends = ends[np.append(np.arange(beads - 1, len(ends) - 1, beads), len(ends) - 1)] if len(ends) else ends
    else:
        ends = ends[np.append(path.layer[ends[1:]] != path.layer[ends[:-1]], True)] if len(ends) else ends
    looks = np.zeros(len(path), np.int64)
    looks[[0, *ends]] = 1
    return replace(path, extra={**path.extra, "look": looks})


def path_with_looks(path: Path, asked: object, dry: bool, where: object) -> tuple[Path, bool]:
    """The path of a run with the looks that are asked for, and whether there can be any. InputError where not."""
    beads, can = beads_between_looks(where, "look", asked), is_metered(path) and not dry
    if beads is not None:
        path = with_looks(path, beads)
    if not can and "look" in path.extra and (path.extra["look"] != 0).any():
        got, allowed = "a dry run" if dry else "a path without amounts", "columns width_mm and height_mm, or volume_mm3"
        raise InputError(where, "look", got, f"no dry run, and a path with {allowed}")
    return path, can


@dataclass(frozen=True, slots=True, eq=False)
class Look:
    """A look at what was laid."""

    stamp: float  # s, when it was done
    first: float  # checkpoints, of the path from where
    last: float  # to where it was laid
    seconds: float  # that the needle stood aside
    width: float  # of beads, by the planned
    laid: LaidBeads
    flow: FlowShares | None = None  # of the next layer, where it takes it from what lies here

    @property
    def text(self) -> str:
        """What was found, in a sentence or two."""
        volume, planned, seen = self.laid.total
        if not planned > 0:
            return "nothing could be judged: the beads are not seen"
        crest = self.laid.stations.crest
        off = self.laid.height - crest
        parts = [f"{volume:.1f} of {planned:.1f} mm³ lie there ({100 * volume / planned:.0f} %)"]
        parts.append(f"beads {np.nanmedian(self.laid.height):.2f} mm high (planned {np.median(crest):.2f})")
        parts.append(f"{np.nanmedian(self.laid.stations.width):.1f} mm wide, {np.nanstd(off):.2f} mm uneven")
        parts += [f"clogged from {a:.0f} to {b:.0f} mm of the path" for a, b in self.laid.clogs]
        gaps, blobs = int(self.laid.gap.sum()), int(self.laid.blob.sum())
        parts += [
            f"{n} of {len(crest)} pieces {word}" for n, word in ((gaps, "lack gel"), (blobs, "have too much")) if n
        ]
        parts += [f"{100 * (1 - seen):.0f} % not seen"] if seen < 0.99 else []
        return ", ".join(parts) + ("" if self.flow is None else f"; {self.flow.text}")


def adapted_flow(path: Path, looks: Sequence[Look], told: FlowShares = AS_PLANNED) -> FlowShares | None:
    """The flows of the next layer by what lies under it; None after uncertain looks, or where no new layer follows.

    looks: at one layer, the last one at its end. told: what it was told to lay, of which less than the planned is no
    lack, and more no surplus: so a gap is filled once, by the next layer, as far as the limits of its flow allow.
    Each piece of the next layer gets what the nearest pieces lack, or less where they have too much: MIN_FLOW to
    MAX_FLOW of what was planned.
    """
    place, knots = looks[-1].last, ways_along(path.surface_from_nozzle)
    later = np.arange(min(int(np.ceil(place)), len(path) - 1) + 1, len(path))
    later = later[path.extrude[later]]
    if not len(later) or path.layer[later[0]] == looks[-1].laid.stations.layer[-1:]:
        return None
    under = [_lacks(path, knots, look, told) for look in looks]
    points, lacks, sure = (np.concatenate(part) for part in zip(*under, strict=True))
    if not len(sure) or sure.mean() < MIN_LOOK_SEEN:
        return None
    other = np.flatnonzero(path.layer[later] != path.layer[later[0]])
    pieces = pieces_between(path, later[0] - 1, later[other[0] - 1] if len(other) else later[-1])
    stations = stations_of(pieces)
    if not len(stations.begin):  # a layer of dots without a way
        return None
    away = np.linalg.norm(_at(path, knots, (stations.begin + stations.end) / 2)[:, None] - points[sure], axis=2)
    weight = np.exp(-((away / FILL_SIGMA) ** 2) / 2)
    lack = (weight * lacks[sure]).sum(axis=1) / np.maximum(weight.sum(axis=1), 1e-12)
    share = np.where(away.min(axis=1) < FILL_REACH, 1 + lack / stations.crest, 1.0)
    begin, end = (np.interp(edge, knots, np.arange(len(path))) for edge in (stations.begin, stations.end))
    return FlowShares(begin, end, np.clip(share, MIN_FLOW, MAX_FLOW))


def _lacks(path: Path, knots: Array, look: Look, told: FlowShares) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Middles (S, 2) mm of the pieces of a look, how much lower than planned their crests are, mm, and who is sure."""
    laid = look.laid
    stations = stations_of(pieces_between(path, look.first, look.last))  # as they were planned
    samples = stations.begin[:, None] + (stations.end - stations.begin)[:, None] * SHARE_SAMPLES
    due = told.at(np.interp(samples, knots, np.arange(len(path)))).mean(axis=1)
    share = laid.share * due  # of the planned
    with np.errstate(invalid="ignore"):
        sure = np.isfinite(share) & (laid.sigma < MAX_UNSURE * laid.planned)
    lack = np.maximum(np.minimum(due, 1.0) - share, 0.0) - np.maximum(share - np.maximum(due, 1.0), 0.0)
    with np.errstate(invalid="ignore"):
        lack = np.where(np.abs(lack) < np.maximum(MIN_LACK, SURE * laid.sigma / laid.planned * due), 0.0, lack)
    return _at(path, knots, (stations.begin + stations.end) / 2), lack * stations.crest, sure


def _at(path: Path, knots: Array, place: Array) -> Array:
    """x and y (M, 2) mm at places (M,) mm along a path."""
    return np.column_stack([np.interp(place, knots, path.surface_from_nozzle[:, k, 3]) for k in (0, 1)])


def clogged(looks: Sequence[Look]) -> list[tuple[float, float]]:
    """From, to, mm along the path: the clogs of all looks."""
    return [clog for look in looks for clog in look.laid.clogs]
