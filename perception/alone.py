"""New landmarks that one camera alone sees: on its rays, where the surface that is known goes on.

Cameras stand 36 to 84 degrees apart, so that a steep side, or anything while the others are covered, is seen by one.
What the local fit (`estimation.mapping.local_surface`) does not know of a landmark's depth is in its covariance, and
later looks from elsewhere reduce it.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from estimation import se3
from estimation.mapping.local_surface import meet
from estimation.mapping.triangulation import rays
from estimation.se3 import Array
from estimation.surface_map import SurfaceMap
from perception.features import Mask, corners
from perception.lens import Lenses, undistort
from perception.matching.patches import FLAT, Pyramid, Templates, project_squares, square_axes, take_templates

SQUARELY = 0.35  # cosine of the viewing angle from which a second camera's picture can be matched: there two tell more
BESIDE = 8  # px between landmarks
WORST = 2.0  # mm across the surface: a place less certain than this is none
PIXEL_SIGMA = 0.2  # px, of a landmark's place in its reference picture


@dataclass(frozen=True, slots=True, eq=False)
class Alone:
    """Landmarks of one camera, surface frame, with their reference pictures. sigma: (N,) mm across the surface."""

    map: SurfaceMap
    templates: Templates
    sigma: Array


def find_alone(
    lenses: Lenses,
    pyramids: dict[int, Pyramid],
    camera: int,
    others: list[int],
    mask: Mask,
    taken: Array,
    count: int,
    known: SurfaceMap,
    base_from_surface: Array,
) -> Alone | None:
    """Up to `count` corners of one camera that none of the `others` sees well, on the surface through `known`.

    mask: (H, W), where they are sought. taken: (N, 2) px as imaged, where there are new landmarks already. known: the
    map, surface frame. base_from_surface: (4, 4), where it is.
    """
    mask = mask.copy()
    for spot in np.round(taken).astype(np.int32):
        cv2.circle(mask, spot.tolist(), BESIDE, 0, -1)
    rig = lenses.rig
    pixels = undistort(rig.cameras[camera], corners(pyramids[camera][0], mask, count))
    origins, directions = rays(rig, np.full(len(pixels), camera), pixels)
    surface_from_base = se3.inverse(base_from_surface)
    angle = np.full(len(pixels), PIXEL_SIGMA / float(rig.cameras[camera].matrix[0, 0]))
    met = meet(
        known.points,
        known.covariance,
        se3.transform_points(surface_from_base, origins),
        directions @ surface_from_base[:3, :3].T,
        angle,
    )
    good = np.flatnonzero(met.good & (met.sigma < WORST))
    points, normals = met.points[good], met.normals[good]
    good = good[~_seen_by(lenses, others, base_from_surface, camera, points, normals)]
    points, normals = met.points[good], met.normals[good]
    if not len(good):
        return None
    templates = take_templates(lenses, pyramids[camera], camera, base_from_surface, points, normals)
    sharp = templates.contrast > FLAT
    rows = (3 * good[sharp][:, None] + np.arange(3)).ravel()
    found = SurfaceMap(points[sharp], normals[sharp], met.covariance[np.ix_(rows, rows)])
    return Alone(found, templates.take(sharp), met.sigma[good[sharp]])


def _seen_by(
    lenses: Lenses, others: list[int], base_from_surface: Array, camera: int, points: Array, normals: Array
) -> NDArray[np.bool_]:
    """Which points (N, 3) one of the other cameras sees well enough for a match."""
    seen = np.zeros(len(points), bool)
    axes = square_axes(lenses, camera, base_from_surface, points, normals)
    for other in others if len(points) else []:
        where = project_squares(lenses, other, base_from_surface, points, normals, axes)
        seen |= where.visible & (where.facing > SQUARELY)
    return seen
