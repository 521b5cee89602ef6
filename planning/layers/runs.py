"""Beads as checkpoints along their lines: as far apart as the ink can be laid, nearer where line or surface bends."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import shapely
from numpy.typing import NDArray

from estimation.se3 import Array
from planning.fill.bead import Bead

Index = NDArray[np.int64]
DENSEST = 0.25  # of the spacing: nearer checkpoints than that are not set for the surface's sake


@dataclass(frozen=True, slots=True, eq=False)
class Runs:
    """Points of many beads, one after another. points: (N, 2) mm. width: (N,) mm. bead: (N,) its number, ascending."""

    points: Array
    width: Array
    bead: Index

    @property
    def steps(self) -> Array:
        """Length (N,), mm, of the way to each point; 0 at the first of each bead."""
        step = np.r_[0.0, np.hypot(*np.diff(self.points, axis=0).T)]
        return np.where(self.first, 0.0, step)

    @property
    def first(self) -> NDArray[np.bool_]:
        """(N,) whether a bead begins there."""
        return np.asarray(np.r_[True, np.diff(self.bead) != 0])

    @property
    def last(self) -> NDArray[np.bool_]:
        """(N,) whether a bead ends there."""
        return np.asarray(np.r_[np.diff(self.bead) != 0, True])


def runs_of(beads: Sequence[Bead], chord: float) -> Runs:
    """Beads without the points that neither the line nor the half width to its edges needs, to `chord` mm each."""
    count = np.array([len(bead.points) for bead in beads])
    every = Runs(
        np.concatenate([bead.points for bead in beads]),
        np.concatenate([bead.width for bead in beads]),
        np.repeat(np.arange(len(beads)), count),
    )
    even = np.array([np.ptp(bead.width) < 1e-9 for bead in beads], bool)
    # points kept for the line cut the stretches found for the width, and the other way round: twice as far off at most
    within = np.where(even, chord, chord / 2)
    edge = np.column_stack([np.cumsum(every.steps), every.width / 2])
    needed = _needed(every.points, every.bead, within) | _needed(edge, every.bead, within)
    return _apart(Runs(every.points[needed], every.width[needed], every.bead[needed]))


def _needed(points: Array, owner: Index, within: Array) -> NDArray[np.bool_]:
    """Which points (N, 2) of lines, each of one `owner` (N,), Douglas and Peucker keep to `within` (lines,)."""
    numbered = np.column_stack([points, np.arange(len(points))])
    simple = shapely.simplify(shapely.linestrings(numbered, indices=owner), within, preserve_topology=False)
    kept = np.zeros(len(points), bool)
    kept[shapely.get_coordinates(simple, include_z=True)[:, 2].astype(np.int64)] = True
    return kept


def _apart(runs: Runs) -> Runs:
    """Without points that stand on the one before: they have no direction between them."""
    keep = runs.first | (runs.steps > 2e-3)
    end = runs.last & ~keep  # the end of a bead stays, what stood before it goes
    keep[np.flatnonzero(end)] = True
    before = np.flatnonzero(end) - 1
    keep[before[~runs.first[before]]] = False
    return Runs(runs.points[keep], runs.width[keep], runs.bead[keep])


def spaced(runs: Runs, spacing: Array) -> Runs:
    """With points between, so that none is more than spacing (N,) mm, of the way to it, from the one before."""
    count = np.maximum(np.ceil(runs.steps / spacing - 1e-9), 1).astype(np.int64)
    end = np.repeat(np.arange(len(count)), count)
    part = (np.arange(len(end)) - np.repeat(np.cumsum(count) - count, count) + 1) / count[end]
    start = np.maximum(end - 1, 0)
    part = np.where(runs.first[end], 1.0, part)
    points = runs.points[start] + part[:, None] * (runs.points[end] - runs.points[start])
    width = runs.width[start] + part * (runs.width[end] - runs.width[start])
    return Runs(points, width, runs.bead[end])


def spacing_over(curvature: Array, spacing: float, chord: float) -> Array:
    """Spacing (N,), mm, at which a chord over a curvature (N,), 1/mm, departs from it by `chord` mm at most."""
    bent = np.sqrt(8 * chord / np.maximum(curvature, 1e-9))
    return np.asarray(np.clip(bent, DENSEST * spacing, spacing))


def bends(runs: Runs) -> Array:
    """Radius (N,), mm, of the line at each point: how far it goes for each radian it turns; inf at ends."""
    step = np.diff(runs.points, axis=0, append=runs.points[-1:])
    into = np.r_[step[:1], step[:-1]]
    turn = np.abs(np.arctan2(into[:, 0] * step[:, 1] - into[:, 1] * step[:, 0], (into * step).sum(axis=1)))
    reach = (np.hypot(*into.T) + np.hypot(*step.T)) / 2
    radius = reach / np.maximum(turn, 1e-9)
    return np.where(runs.first | runs.last, np.inf, radius)
