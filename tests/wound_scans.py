"""Scans of wounds of known shape, and damage to them: what planning is tested on."""

from __future__ import annotations

from functools import cache

import numpy as np
from numpy.typing import NDArray

from estimation.se3 import Array
from hardware.simulator.scene.shape import Wound as Carved
from hardware.simulator.scene.shape import body
from planning.layers.repair import repair_mesh
from planning.layers.slicing import Tissue
from planning.layers.wound import WoundVolume, find_wound

Index = NDArray[np.int64]
SKIN = (Tissue("hypodermis", None, "1"), Tissue("dermis", 1.6, "2"), Tissue("epidermis", 0.4, "3"))


@cache
def scan_of(kind: str = "forearm", size: tuple[float, float] = (24.0, 16.0), depth: float = 3.0) -> tuple[Array, Index]:
    """Vertices (V, 3) mm and triangles (T, 3) of a body with a wound, as a coarse scanner gives them."""
    return body(kind, Carved(size, depth), 3, 0.5).mesh(1.0)


@cache
def wound_of(kind: str = "forearm", size: tuple[float, float] = (24.0, 16.0), depth: float = 3.0) -> WoundVolume:
    """The wound found in it."""
    vertices, triangles = scan_of(kind, size, depth)
    return find_wound(repair_mesh(vertices, triangles, "scan")[0], 0.4, "scan")


def sheet(height: float = 0.0, size: float = 30.0, step: float = 1.0) -> tuple[Array, Index]:
    """A flat square at z = height."""
    n = round(size / step) + 1
    x, y = np.meshgrid(*[np.linspace(-size / 2, size / 2, n)] * 2)
    number = np.arange(n * n).reshape(n, n)
    a, b, c, d = (m.ravel() for m in (number[:-1, :-1], number[:-1, 1:], number[1:, 1:], number[1:, :-1]))
    triangles = np.concatenate([np.column_stack([a, b, c]), np.column_stack([a, c, d])])
    return np.column_stack([x.ravel(), y.ravel(), np.full(x.size, height)]), triangles
