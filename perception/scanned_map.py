"""Landmarks on a scan: each where its own camera's ray meets the scan's surface."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from estimation import se3
from estimation.mapping.bundle_adjustment import FREE, Anchors, of_frame
from estimation.ray_cast import cast, feet
from estimation.scan import Scan
from estimation.scans.registration import Registration
from estimation.se3 import Array
from estimation.surface_map import SurfaceMap
from perception.lens import Lenses

PIXEL_SIGMA = 0.2  # px, of a landmark's place in its reference picture
LEAST_SIGMA = 0.03  # mm across the surface: no scan and no match is better
APART = 5.0  # sigmas of a landmark and the scan together beyond which it does not lie on it: a drape, a hair, a mistake


def scanned(
    surface_map: SurfaceMap, camera: NDArray[np.int64], lenses: Lenses, scan: Scan, place: Registration
) -> tuple[SurfaceMap, Anchors]:
    """The map with its landmarks on the scan, and what holds them there.

    surface_map: in the scan's frame. camera: (N,) whose picture each landmark was taken from. place: of the scan where
    the cameras of `lenses` see it. Depth is the scan's, sideways the pixel's; the place's own error is in all alike,
    unless the shape leaves it open: that is no matter of millimetres.
    """
    points, normals = surface_map.points.copy(), surface_map.normals.copy()
    blocks = np.einsum("ninj->nij", surface_map.covariance.reshape(len(points), 3, len(points), 3)).copy()
    across = max(place.rms, LEAST_SIGMA)
    frame = place.covariance if place.sure else np.zeros((6, 6))
    sigma = np.full(len(points), FREE)
    for c in np.unique(camera):
        mine = np.flatnonzero(camera == c)
        lens = lenses.rig.cameras[c]
        surface_from_camera = se3.inverse(place.base_from_surface) @ lens.base_from_camera
        inner = se3.transform_points(se3.inverse(surface_from_camera), points[mine])
        hits = cast(scan, surface_from_camera, inner)
        off = np.einsum("ni,ni->n", hits.points - points[mine], hits.normals)
        own = np.einsum("ni,nij,nj->n", hits.normals, blocks[mine], hits.normals)
        on = hits.hit & (np.abs(off) < APART * np.sqrt(own + across**2))
        mine, rays = mine[on], inner[on] @ surface_from_camera[:3, :3].T
        points[mine], normals[mine], sigma[mine] = hits.points[on], hits.normals[on], across
        blocks[mine] = _spread(rays, hits.normals[on], across, PIXEL_SIGMA / float(lens.matrix[0, 0]))
    covariance = np.zeros((len(points), 3, len(points), 3))
    covariance[np.arange(len(points)), :, np.arange(len(points))] = blocks
    whole = covariance.reshape(3 * len(points), -1) + of_frame(points, frame)
    return SurfaceMap(points, normals, whole), Anchors(points, normals, sigma, frame)


def _spread(rays: Array, normals: Array, across: float, angle: float) -> Array:
    """Covariances (N, 3, 3) mm^2 of where rays (N, 3), from the camera, each known to `angle` rad, meet planes with
    `normals` (N, 3), each known to `across` mm."""
    shift, depth = feet(rays, normals)
    return np.asarray(
        (np.linalg.norm(rays, axis=1) * angle)[:, None, None] ** 2 * shift @ np.swapaxes(shift, 1, 2)
        + across**2 * depth[:, :, None] * depth[:, None]
    )
