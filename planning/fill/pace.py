"""How long beads take: printing, travelling between them, and turning."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from estimation.se3 import Array
from planning.fill.bead import Bead

SHARP = np.deg2rad(30.0)  # a turn beyond costs time; as the other planners' figures were counted


@dataclass(frozen=True, slots=True)
class Pace:
    """printing, travel: mm/s. turn: s that each turn of more than SHARP costs."""

    printing: float = 20.0
    travel: float = 60.0
    turn: float = 0.05


@dataclass(frozen=True, slots=True)
class Spent:
    """What a list of beads costs. printed, travelled: mm. turns: of more than SHARP within beads. seconds: in all."""

    printed: float
    travelled: float
    turns: int
    seconds: float


def spent(beads: Sequence[Bead], pace: Pace) -> Spent:
    """Length, travel, turns and time of beads printed in this order."""
    printed = sum(bead.length for bead in beads)
    travelled = hops(beads)
    turns = sum(int((turning(bead.points) > SHARP).sum()) for bead in beads)
    seconds = printed / pace.printing + travelled / pace.travel + turns * pace.turn
    return Spent(printed, travelled, turns, seconds)


def hops(beads: Sequence[Bead]) -> float:
    """Length mm of the way from the end of each bead to the start of the next."""
    return sum(math.dist(a.points[-1], b.points[0]) for a, b in pairwise(beads))


def turning(points: Array) -> Array:
    """By how much a line through points (N, 2) turns at each inner one (N-2,), rad, 0 to pi."""
    x, y = (points[1:] - points[:-1]).T
    cross, dot = x[:-1] * y[1:] - y[:-1] * x[1:], x[:-1] * x[1:] + y[:-1] * y[1:]
    return np.asarray(np.abs(np.arctan2(cross, dot)))
