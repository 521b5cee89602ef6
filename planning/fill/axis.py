"""The medial axis of a region: where the middles of its largest inscribed discs lie, and how large those are.

From the Voronoi diagram of points along the boundary (Brandt and Algazi 1992). Kept is the part along which the
thickness changes slowly; the branches into corners, which every kink and all noise of a contour has, are not.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import shapely
from numpy.typing import NDArray
from scipy.spatial import QhullError, Voronoi

from estimation.se3 import Array
from planning.fill.region import Region

STEEP = 0.38  # mm per mm by which the radius may grow along the axis: cos 67.5 degrees, as Kuipers et al. 2020


@dataclass(frozen=True, slots=True, eq=False)
class Axis:
    """Middles (V, 2) mm and radii (V,) mm of inscribed discs; edges (E, 2) join them."""

    middles: Array
    radii: Array
    edges: NDArray[np.intp]


EMPTY = Axis(np.empty((0, 2)), np.empty(0), np.empty((0, 2), np.intp))


def axis_of(region: Region, step: float) -> Axis:
    """The medial axis of a region whose boundary is sampled every `step` mm."""
    sites = _sites(region, step)
    if len(sites) < 4:
        return EMPTY
    try:
        diagram = Voronoi(sites)
    except QhullError:  # all on one line: nothing inside
        return EMPTY
    ridge, pair = np.asarray(diagram.ridge_vertices), np.asarray(diagram.ridge_points)
    bounded = (ridge >= 0).all(axis=1)
    ridge, pair = ridge[bounded], pair[bounded]
    chord = np.linalg.norm(sites[pair[:, 0]] - sites[pair[:, 1]], axis=1)
    radius = np.linalg.norm(diagram.vertices[ridge] - sites[pair[:, :1]], axis=2)  # (E, 2)
    flat = chord / 2 >= np.sqrt(1 - STEEP**2) * radius.max(axis=1)
    ridge, radius = ridge[flat], radius[flat]
    shapely.prepare(region)
    inside = shapely.contains_xy(region, *diagram.vertices[ridge].reshape(-1, 2).T).reshape(-1, 2).all(axis=1)
    used, edges = np.unique(ridge[inside], return_inverse=True)
    edges = edges.reshape(-1, 2)
    radii = np.zeros(len(used))
    radii[edges] = radius[inside]
    return Axis(diagram.vertices[used], radii, edges)


def _sites(region: Region, step: float) -> Array:
    points, ring = shapely.get_coordinates(
        shapely.segmentize(shapely.get_rings(shapely.get_parts(region)), step), return_index=True
    )
    return np.asarray(points[np.diff(ring, prepend=-1) == 0])  # a ring repeats its first point
