"""The planned path as straight pieces in the surface frame: what was to be printed, and where it runs."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estimation.se3 import Array
from planning.path import NEAREST, Path, lengths

CHUNK = 2_000_000  # distances held at once


@dataclass(frozen=True, slots=True, eq=False)
class PlannedLine:
    """The K - 1 straight pieces between K checkpoints; a piece has the number of the checkpoint before it.

    knots: (K,) mm along the path, as NozzleLog.place counts them (turns count too). points: (K, 3) mm, surface frame.
    printed: (K-1,) whether material leaves on it. layer: (K-1,).
    """

    knots: Array
    points: Array
    printed: NDArray[np.bool_]
    layer: NDArray[np.int64]

    @property
    def end(self) -> float:
        """The place of the last checkpoint, mm."""
        return float(self.knots[-1])

    def piece(self, place: Array) -> NDArray[np.int64]:
        """Piece (N,) on which each place (N,), mm, lies; a checkpoint belongs to the piece that leads to it."""
        return np.clip(np.searchsorted(self.knots, place, "left") - 1, 0, len(self.knots) - 2)

    def direction(self) -> Array:
        """Unit vector (K-1, 3) of each piece; a turn on the spot has that of the piece before it, or the next one's."""
        step = np.diff(self.points, axis=0)
        length = np.linalg.norm(step, axis=1)
        moving = np.flatnonzero(length >= NEAREST)
        if not len(moving):
            return np.tile([1.0, 0.0, 0.0], (len(step), 1))  # nowhere to go: any direction serves
        nearest = moving[np.maximum(np.searchsorted(moving, np.arange(len(step)), "right") - 1, 0)]
        return np.asarray(step[nearest] / length[nearest, None])

    def distance(self, points: Array) -> Array:
        """Distance (N,), mm, of points (N, 3) in the surface frame from what is printed; NaN where nothing is."""
        if not self.printed.any():
            return np.full(len(points), np.nan)
        size = max(1, CHUNK // int(self.printed.sum()))
        parts = [self._distance(points[i : i + size]) for i in range(0, len(points), size)]
        return np.concatenate(parts) if parts else np.empty(0)

    def _distance(self, points: Array) -> Array:
        start = self.points[:-1][self.printed]
        step = self.points[1:][self.printed] - start
        square = np.sum(step**2, axis=1)
        reached = points @ step.T - np.sum(start * step, axis=1)  # (N, P)
        share = np.clip(reached / np.where(square > 0, square, 1.0), 0.0, 1.0)
        # |point - start - share * step|^2 less |point|^2, which does not say which piece is nearest
        far = np.sum(start**2, axis=1) - 2 * points @ start.T - 2 * share * reached + share**2 * square
        nearest = np.argmin(far, axis=1)
        foot = start[nearest] + share[np.arange(len(points)), nearest][:, None] * step[nearest]
        return np.asarray(np.linalg.norm(points - foot, axis=1))


def planned_line(path: Path) -> PlannedLine:
    """The pieces of a path: whether, how fast and in which layer is printed is said by the checkpoint they lead to."""
    poses = path.surface_from_nozzle
    knots = np.concatenate([[0.0], np.cumsum(lengths(poses))])
    return PlannedLine(knots, poses[:, :3, 3], path.extrude[1:], path.layer[1:])
