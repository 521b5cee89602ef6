"""Rigs that are not quite the true one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from estimation import se3
from estimation.rig import Camera, Rig, pixels_from_points
from estimation.se3 import Array

LENS = np.array([2e-3, 4e-3, 2e-4, 2e-4, 0.0])  # what a calibration leaves of k1 k2 p1 p2, before it is scaled
FOCAL, CENTRE = 1.0, 1.0  # px
TURN, SHIFT = 1e-3, 0.2  # rad, mm


def undistorting(rig: Rig) -> Rig:
    """The same cameras without distortion: what observations' pixels are of."""
    return Rig(tuple(replace(c, distortion=np.zeros(5)) for c in rig.cameras))


def miscalibrated(rig: Rig, points_base: Array, rms: float, rng: np.random.Generator) -> Rig:
    """A rig that sees points (N, 3) mm `rms` px away from where `rig`, without distortion, does, camera by camera.

    Lens, focal length, principal point and pose are all off, in proportions as a calibration with a board leaves them.
    """
    return Rig(tuple(_miscalibrated(c, points_base, rms, rng) for c in rig.cameras))


def _miscalibrated(camera: Camera, points_base: Array, rms: float, rng: np.random.Generator) -> Camera:
    draw = rng.standard_normal(14)
    size = 1.0
    for _ in range(6):  # nearly linear in the size
        moved = _moved(camera, size * draw)
        away = pixels_from_points(moved, points_base)[0] - pixels_from_points(camera, points_base)[0]
        size *= rms / float(np.sqrt((away**2).sum(1).mean() / 2))  # an axis, as the noise is
    return _moved(camera, size * draw)


def _moved(camera: Camera, draw: Array) -> Camera:
    matrix = camera.matrix.copy()
    matrix[[0, 1], [0, 1]] += FOCAL * draw[0]
    matrix[:2, 2] += CENTRE * draw[1:3]
    pose = camera.base_from_camera @ se3.exp(np.r_[TURN * draw[3:6], SHIFT * draw[6:9]])
    return replace(camera, matrix=matrix, distortion=camera.distortion + LENS * draw[9:14], base_from_camera=pose)
