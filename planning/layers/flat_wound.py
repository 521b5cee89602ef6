"""A contour alone as a wound: one flat layer, as the thesis analyses its patterns (5.3)."""

from __future__ import annotations

import numpy as np
import shapely
from shapely import MultiPolygon

from estimation.se3 import Array
from planning.fill.region import region_of
from planning.layers.grid import grid_over
from planning.layers.wound import Findings, Wound

STEP, MARGIN = 1.0, 5.0  # mm: a plane needs no fine grid
LARGEST = 1000.0  # nodes along a side


def flat_wound(contour: Array, thickness: float, where: object) -> Wound:
    """The wound inside a contour (N, 2), mm, with a flat bed at z = 0 and `thickness` mm to be laid on it."""
    outline = MultiPolygon([region_of(contour, where)])
    low, high = np.array(outline.bounds).reshape(2, 2)
    step = max(STEP, float((high - low).max()) / LARGEST)
    grid = grid_over(low - MARGIN, high + MARGIN, step)
    bed = np.zeros(grid.shape)
    area = float(shapely.area(outline))
    findings = Findings(
        given=True, area=area, volume=area * thickness, depth=thickness, level=0.0, noise=0.0, smoothing=0.0,
        scatter=0.0, closed=0.0, hidden=0.0, cut=0.0, others=0, notes=(),
    )  # fmt: skip
    return Wound(np.eye(4), grid, bed, bed + thickness, outline, findings)
