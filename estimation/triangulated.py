"""A first map as the cameras themselves give it: landmarks triangulated from one frame set's observations."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estimation import se3
from estimation.mapping.triangulation import triangulate
from estimation.observations import Observations
from estimation.rig import Rig
from estimation.se3 import Array
from estimation.surface_map import SurfaceMap, local_normals, surface_frame

ASTRAY = 4.0  # sigmas of residual, RMS over its sightings: one of them is wrong


@dataclass(frozen=True, slots=True, eq=False)
class Triangulated:
    """A map and where it was seen.

    base_from_surface: (4, 4), which defines the surface frame. tracks: (N,) id of each landmark among observations.
    """

    map: SurfaceMap
    base_from_surface: Array
    tracks: NDArray[np.int64]


def triangulated(rig: Rig, seen: Observations) -> Triangulated:
    """The map of all landmarks that two cameras or more see alike, with the covariance that the pixels give.

    Origin in the landmarks' middle, z out of the surface, as a tracker lays it where there is no scan.
    """
    ids, point, count = np.unique(seen.track, return_inverse=True, return_counts=True)
    several = count[point] > 1
    ids, point = np.unique(seen.track[several], return_inverse=True)
    camera, pixels, sigma = seen.camera[several], seen.pixels[several], seen.sigma[several]
    points, covariance, residual = triangulate(rig, point, camera, pixels, len(ids))
    off = np.bincount(point, ((residual / sigma[:, None]) ** 2).sum(1)) / np.bincount(point) / 2
    good = np.isfinite(points).all(1) & (off < ASTRAY**2)
    widest = np.zeros(len(ids))
    np.maximum.at(widest, point, sigma)
    return _laid(rig, points[good], (covariance * widest[:, None, None] ** 2)[good], ids[good])


def _laid(rig: Rig, points: Array, covariance: Array, tracks: NDArray[np.int64]) -> Triangulated:
    """The map in its own frame."""
    poses = np.stack([c.base_from_camera for c in rig.cameras])
    base_from_surface = surface_frame(points, poses[:, :3, 3].mean(0), poses[:, :3, 0].mean(0))
    turn = base_from_surface[:3, :3].T
    own = se3.transform_points(se3.inverse(base_from_surface), points)
    joint = np.zeros((len(own), 3, len(own), 3))
    joint[np.arange(len(own)), :, np.arange(len(own))] = turn @ covariance @ turn.T
    normals = local_normals(own, np.array([0.0, 0.0, 1.0]))
    whole = SurfaceMap(own, normals, joint.reshape(3 * len(own), -1))
    return Triangulated(whole, base_from_surface, tracks)
