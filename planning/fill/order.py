"""The order of runs: nearest neighbour first, then 2-opt and Or-opt on the way between them (thesis 2.1.3).

Printing itself takes as long in any order and direction, so the shortest travel is the shortest time.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from estimation.se3 import Array
from planning.fill.bead import Bead

Run = list[Bead]  # beads that follow one another
MOST = 300  # improvements: a bound on time, reached by no layer that a wound was seen to need
LEAST = 1e-6  # mm: a smaller gain is none


def ordered(runs: Sequence[Run], start: Array) -> list[Bead]:
    """The beads of all runs, runs in the order and direction that travel least from `start` (2,)."""
    if len(runs) < 2:
        near = min((math.dist(end, start), way) for way, end in enumerate(_ends(runs[0]))) if runs else (0.0, 0)
        return [bead for run in runs for bead in (_reversed(run) if near[1] else run)]
    ends = np.array([_ends(run) for run in runs])  # (M, entry or exit, 2)
    tour = _nearest(ends, start)
    for _ in range(MOST):
        better = _turned(tour, ends, start)
        better = _moved(tour, ends, start) if better is None else better
        if better is None:
            break
        tour = better
    return [bead for run, flipped in tour for bead in (_reversed(runs[run]) if flipped else runs[run])]


Tour = NDArray[np.intp]  # (M, 2): number of the run, and 1 where it is printed from its end


def _ends(run: Run) -> tuple[Array, Array]:
    return run[0].points[0], run[-1].points[-1]


def _reversed(run: Run) -> Run:
    return [bead.reversed for bead in reversed(run)]


def _nearest(ends: Array, start: Array) -> Tour:
    free = np.ones(len(ends), bool)
    tour, here = [], start
    for _ in range(len(ends)):
        far = np.linalg.norm(ends - here, axis=2)
        far[~free] = np.inf
        run, end = divmod(int(far.argmin()), 2)
        free[run] = False
        tour.append((run, end))
        here = ends[run, 1 - end]
    return np.array(tour)


def _places(tour: Tour, ends: Array, start: Array) -> tuple[Array, Array]:
    """Where each run of a tour begins (M, 2), and where the nozzle leaves before the first and after each (M+1, 2)."""
    run, flipped = tour.T
    return ends[run, flipped], np.concatenate([start[None], ends[run, 1 - flipped]])


def _turned(tour: Tour, ends: Array, start: Array) -> Tour | None:
    """The tour with its best stretch printed backwards (2-opt); None where none is better."""
    entry, leave = _places(tour, ends, start)
    hop = np.linalg.norm(entry - leave[:-1], axis=1)
    into = np.linalg.norm(leave[:-1, None] - leave[None, 1:], axis=2)  # (i, j): from before i to the end of j
    out = np.zeros_like(into)
    out[:, :-1] = np.linalg.norm(entry[:, None] - entry[None, 1:], axis=2)  # from the start of i to what follows j
    gain = into + out - hop[:, None] - np.append(hop[1:], 0.0)
    gain[np.tri(len(tour), k=-1, dtype=bool)] = 0.0
    i, j = divmod(int(gain.argmin()), len(tour))
    if gain[i, j] > -LEAST:
        return None
    better = tour.copy()
    better[i : j + 1] = tour[i : j + 1][::-1]
    better[i : j + 1, 1] ^= 1
    return better


def _moved(tour: Tour, ends: Array, start: Array) -> Tour | None:
    """The tour with one run moved to its best place, in its better direction (Or-opt); None where none is better."""
    if len(tour) < 3:
        return None
    entry, leave = _places(tour, ends, start)
    hop = np.linalg.norm(entry - leave[:-1], axis=1)
    skip = np.append(np.linalg.norm(entry[1:] - leave[:-2], axis=1), 0.0)  # from before i to what follows it
    saved = hop + np.append(hop[1:], 0.0) - skip
    best, found = -LEAST, None
    for flip in (0, 1):
        first, last = (leave[1:], entry) if flip else (entry, leave[1:])
        into = np.linalg.norm(leave[None] - first[:, None], axis=2)  # (i, place): after `place` runs
        out = np.zeros_like(into)
        out[:, :-1] = np.linalg.norm(entry[None] - last[:, None], axis=2)
        cost = into + out - np.append(hop, 0.0) - saved[:, None]
        i = np.arange(len(tour))
        cost[i, i] = cost[i, i + 1] = 0.0
        at = int(cost.argmin())
        if cost.flat[at] < best:
            best, found = float(cost.flat[at]), (*divmod(at, len(tour) + 1), flip)
    if found is None:
        return None
    run, place, flip = found
    moved = tour[run] ^ [0, flip]
    rest = np.delete(tour, run, axis=0)
    return np.insert(rest, place - (place > run), moved, axis=0)
