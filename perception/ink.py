"""Ink that the nozzle has laid on the surface: what it covers no longer looks like its reference picture."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from estimation.se3 import Array

REACH = 1.0  # mm from the bead's middle: half of a wide bead, as it spreads
STEP = 0.5  # mm between the points that stand for a bead
FRESH = 60.0  # s that gelling takes; what has set may carry landmarks of its own


class Ink:
    """The beads laid so far, in the surface frame."""

    def __init__(self) -> None:
        self._points: list[Array] = []
        self._stamps: list[float] = []
        self._tip: Array | None = None

    def __len__(self) -> int:
        return len(self._points)

    def lift(self) -> None:
        """The nozzle no longer extrudes: the next bead begins anew."""
        self._tip = None

    def lay(self, stamp: float, tip: Array) -> Array:
        """The bead goes on to the tip (3,) mm at `stamp`, s; the points (M, 3) that are new."""
        start = tip if self._tip is None else self._tip
        pieces = max(1, int(np.ceil(float(np.linalg.norm(tip - start)) / STEP)))
        new = start + (tip - start) * (np.arange(1, pieces + 1) / pieces)[:, None]
        self._points.extend(new)
        self._stamps.extend([stamp] * pieces)
        self._tip = tip.copy()
        return new

    def covers(self, points: Array, reach: Array, stamp: float) -> NDArray[np.bool_]:
        """Which points (N, 3) mm lie within their reach (N,) mm of ink that is still fresh at `stamp`, s."""
        fresh = np.searchsorted(self._stamps, stamp - FRESH)
        if fresh == len(self._points):
            return np.zeros(len(points), bool)
        away, _ = cKDTree(np.array(self._points[fresh:])).query(points)
        return np.asarray(away < REACH + reach)


def near_bead(points: Array, bead: Array, reach: Array) -> NDArray[np.bool_]:
    """Which points (N, 3) lie within REACH and their own reach (N,) of a bead's points (M, 3), all mm."""
    away = np.linalg.norm(points[:, None] - bead, axis=2).min(1)
    return np.asarray(away < REACH + reach)
