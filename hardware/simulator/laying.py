"""Lays a flat path onto the true surface: what a planner with a perfect scan would have done with it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from estimation.errors import InputError
from estimation.se3 import Array
from hardware.simulator.scene.shape import Shape
from planning.path import Path

PIECE = 1.0  # mm: beds of wounds are uneven over a few
STEPS = 12  # towards the surface along z; only where a scan's own frame is tilted against its mean plane one is not all
MISSED = 1e-3  # mm from the surface


def laid(path: Path, shape: Shape, clearance: float, where: object = "path") -> Path:
    """The path with its checkpoints `clearance` mm above the surface, stretches divided into pieces of about 1 mm.

    Tools keep the direction that the path gives them; a path's own height (z) is kept on top of the surface's.
    InputError with `where` for a checkpoint that lies beyond the surface's edge.
    """
    fine = divided(path, PIECE)
    places = fine.surface_from_nozzle.copy()
    points, there = surface_along_z(shape, places[:, :2, 3])
    if not there.all():
        x, y = places[~there][0, :2, 3]
        allowed = "on the surface, {:g} x {:g} mm about its middle".format(*shape.size)
        raise InputError(where, "a place on the path", f"x = {x:.2f}, y = {y:.2f} mm", allowed)
    places[:, 2, 3] += points[:, 2] + clearance
    return replace(fine, surface_from_nozzle=places)


def surface_along_z(shape: Shape, xy: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Points (N, 3) mm of the surface at x and y (N, 2) mm, surface frame, and whether (N,) there is one."""
    points, outwards = np.column_stack([xy, np.zeros(len(xy))]), shape.surface_from_grid[:3, 2]
    for _ in range(STEPS):
        off = shape.points(shape.material(points)) - points  # along the grid's own z
        points[:, 2] += (off @ outwards) / outwards[2]
    material = shape.material(points)
    return points, shape.covers(material) & (np.linalg.norm(shape.points(material) - points, axis=1) < MISSED)


def divided(path: Path, piece: float) -> Path:
    """The path with stretches longer than `piece` mm cut into equal ones; a new checkpoint takes after its next."""
    places = path.surface_from_nozzle
    counts = np.ceil(np.linalg.norm(np.diff(places[:, :3, 3], axis=0), axis=1) / piece).astype(int)
    counts = np.maximum(np.where(same_turn(places), counts, 1), 1)
    source = np.concatenate([[0], np.repeat(np.arange(1, len(places)), counts)])
    share = np.concatenate([[1.0], *(np.arange(1, n + 1) / n for n in counts)])
    cut = places[source].copy()
    before = places[np.maximum(source - 1, 0), :3, 3]
    cut[:, :3, 3] = before + share[:, None] * (places[source, :3, 3] - before)
    columns = {name: getattr(path, name)[source] for name in ("speed", "material", "temperature", "layer", "extrude")}
    extra = {name: column[source] for name, column in path.extra.items()}
    return replace(path, surface_from_nozzle=cut, extra=extra, **columns)


def same_turn(surface_from_nozzle: Array) -> NDArray[np.bool_]:
    """(N-1,) whether the tool keeps its direction from one of (N, 4, 4) to the next; others are left whole."""
    turns = surface_from_nozzle[:, :3, :3]
    return np.asarray(np.abs(np.diff(turns, axis=0)).max(axis=(1, 2)) < 1e-9)
