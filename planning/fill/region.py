"""Regions of the plane: read from contours, checked, bumps taken out."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeAlias

import numpy as np
import shapely
from shapely.geometry import MultiPolygon, Polygon
from shapely.geometry.base import BaseGeometry

from estimation.errors import InputError
from estimation.se3 import Array

GRID = 1e-6  # mm to which corners are rounded where exact arithmetic finds no answer

Region: TypeAlias = Polygon | MultiPolygon


def region_of(contour: Array, where: object = "contour") -> Polygon:
    """The region inside a contour (N, 2), mm; InputError says where it crosses itself."""
    if contour.ndim != 2 or contour.shape[1] != 2 or len(contour) < 3:
        raise InputError(where, "shape", contour.shape, "(N, 2) with N >= 3")
    if not np.isfinite(contour).all():
        raise InputError(where, "point", contour[~np.isfinite(contour).all(axis=1)][0], "finite numbers")
    region = Polygon(contour)
    checked(region, where)
    return region


def checked(region: Region, where: object = "region") -> Region:
    """The region itself if its contours cross neither themselves nor one another; InputError says where they do."""
    if not isinstance(region, Polygon | MultiPolygon):
        raise InputError(where, "kind", type(region).__name__, "Polygon or MultiPolygon")
    if not np.isfinite(shapely.get_coordinates(region)).all():
        raise InputError(where, "points", "not finite", "finite numbers")
    if not region.is_valid:
        raise InputError(where, "contour", shapely.is_valid_reason(region), "contours that do not cross, x y in mm")
    return region


def around(region: Region, bumps: Region, clearance: float) -> Region:
    """The region without bumps that are too high to go over, and without `clearance` mm around them (thesis 5.2)."""
    return only_areas(shapely.difference(region, shapely.buffer(bumps, clearance)))


def roughness(region: Region, width: float) -> float:
    """Share of the area that a disc `width` mm wide does not reach: corners, and what is narrower."""
    radius = width / 2
    return 1 - float(shapely.buffer(shapely.buffer(region, -radius), radius).area / region.area)


def only_areas(shape: BaseGeometry) -> Region:
    """The areas of whatever a shapely operation returned; lines and points have none."""
    return MultiPolygon(areas(shape))


def areas(shape: BaseGeometry) -> list[Polygon]:
    """The non-empty polygons of a shape, one by one."""
    parts = shapely.get_parts(shapely.get_parts(shape))
    return [part for part in parts if isinstance(part, Polygon) and not part.is_empty]


def points_of(ring: BaseGeometry) -> Array:
    """Points (N, 2) of a line or ring."""
    return np.asarray(shapely.get_coordinates(ring))


def minus(a: BaseGeometry, b: BaseGeometry) -> BaseGeometry:
    """What lies in a and not in b, also where simplified outlines cross themselves by a micrometre."""
    try:
        return shapely.difference(a, b)
    except shapely.GEOSException:
        return shapely.difference(shapely.buffer(a, 0), shapely.buffer(b, 0), grid_size=GRID)


def joined(shapes: Sequence[BaseGeometry]) -> BaseGeometry:
    """What lies in any of the shapes, also where exact arithmetic finds no answer."""
    try:
        return shapely.union_all(shapes)
    except shapely.GEOSException:
        return shapely.union_all(shapely.buffer(shapes, 0), grid_size=GRID)
