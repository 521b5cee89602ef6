"""What stands still in the view: the cameras, and path and surface in the surface frame. Sent when it changes."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from estimation.rig import Camera, Rig
from estimation.se3 import Array
from planning.path import Path

CAPACITY = 1 << 21  # bytes: ten times what the two limits below allow
PATH_POINTS = 4000  # what a browser without a graphics card draws ten times a second
TRIANGLES = 1500


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """The cameras as calibrated, the path and the surface.

    path: (K, 3) mm, places on the path in order, surface frame; checkpoint: (K,) their numbers; extrude: (K,) whether
    material flows on the way to each. surface: (V, 3) mm, surface frame; triangles: (T, 3) its corners, none where only
    points are known.
    """

    cameras: tuple[Camera, ...]
    path: Array = field(default_factory=lambda: np.zeros((0, 3)))
    checkpoint: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, np.int64))
    extrude: NDArray[np.bool_] = field(default_factory=lambda: np.zeros(0, bool))
    surface: Array = field(default_factory=lambda: np.zeros((0, 3)))
    triangles: NDArray[np.int64] = field(default_factory=lambda: np.zeros((0, 3), np.int64))


def scene_from(
    rig: Rig, path: Path | None = None, surface: Array | None = None, triangles: NDArray[np.int64] | None = None
) -> Scene:
    """The scene, thinned to what a browser draws with ease. surface: (V, 3) mm, triangles: (T, 3), surface frame."""
    empty = Scene(rig.cameras)
    kept = empty.checkpoint if path is None else _kept(path)
    points = empty.surface if surface is None else np.asarray(surface, float)
    corners = empty.triangles if triangles is None else np.asarray(triangles, np.int64)
    if len(corners) > TRIANGLES:
        points, corners = _coarser(points, corners)
    elif not len(corners) and len(points) > TRIANGLES:
        points = points[np.linspace(0, len(points) - 1, TRIANGLES).astype(np.int64)]
    if path is None:
        return Scene(rig.cameras, surface=points, triangles=corners)
    return Scene(rig.cameras, path.surface_from_nozzle[kept, :3, 3], kept, path.extrude[kept], points, corners)


def _kept(path: Path) -> NDArray[np.int64]:
    """Numbers of the checkpoints that are drawn: all, or evenly thinned ones and each where extrusion changes."""
    count = len(path)
    even = np.linspace(0, count - 1, min(count, PATH_POINTS)).astype(np.int64)
    if count <= PATH_POINTS:
        return even
    changes = np.flatnonzero(np.diff(path.extrude.astype(np.int8)))
    ends = np.concatenate([changes, changes + 1])
    return np.unique(np.concatenate([even, ends[: PATH_POINTS // 2]]))


def _coarser(points: Array, triangles: NDArray[np.int64]) -> tuple[Array, NDArray[np.int64]]:
    """The surface with the corners in each cell of a cube grid drawn together, the grid as fine as TRIANGLES allow."""
    low, high = points.min(axis=0), points.max(axis=0)
    cell = float((high - low).max()) / np.sqrt(TRIANGLES)
    while True:
        _, group = np.unique(np.floor((points - low) / cell).astype(np.int64), axis=0, return_inverse=True)
        group = group.reshape(-1)
        joined = group[triangles]
        whole = (joined != np.roll(joined, 1, axis=1)).all(axis=1)
        kept = np.unique(np.sort(joined[whole], axis=1), axis=0)
        if len(kept) <= TRIANGLES:
            break
        cell *= 1.2
    middles = np.stack([np.bincount(group, points[:, k]) for k in range(3)], axis=1) / np.bincount(group)[:, None]
    return middles, kept
