"""What cameras see of landmarks at one instant, or each at its own."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from estimation import se3
from estimation.observations import Observations
from estimation.rig import Camera, Rig, pixels_from_points
from estimation.se3 import Array
from estimation.synthetic.calibration import undistorting
from estimation.synthetic.tracks import ASTRAY, Seen

LEAST_FACING = 0.17  # cosine: at 80 degrees a patch of skin is a line
LEAST_DEPTH = 1.0  # mm


def imaged(rig: Rig, points: Array, poses: Array, normals: Array | None = None) -> tuple[Array, Seen]:
    """Pixels (C, N, 2) of points (N, 3), surface frame, and which (C, N) each camera has in view.

    poses: (C, 4, 4) base_from_surface at each camera's instant. normals: (N, 3); without them all points face all
    cameras. Observations' pixels are those of a rig without distortion.
    """
    pixels, seen = zip(*(_imaged(rig.cameras[c], points, pose, normals) for c, pose in enumerate(poses)), strict=True)
    return np.stack(pixels), np.stack(seen)


def _imaged(camera: Camera, points: Array, pose: Array, normals: Array | None) -> tuple[Array, Seen]:
    points_base = se3.transform_points(pose, points)
    pixels, depth = pixels_from_points(camera, points_base)
    seen = (depth > LEAST_DEPTH) & (pixels > 0).all(1) & (pixels < np.array(camera.size) - 1).all(1)
    if normals is not None:
        to_camera = camera.base_from_camera[:3, 3] - points_base
        facing = ((normals @ pose[:3, :3].T) * to_camera).sum(1)
        seen &= facing > LEAST_FACING * np.linalg.norm(to_camera, axis=1)
    return pixels, seen


def gathered(stamp: float, pixels: Array, seen: Seen, sigma: float) -> Observations:
    """Observations of pixels (C, N, 2) where seen (C, N), all of `sigma` px; a track's id is its column."""
    camera, track = np.nonzero(seen)
    return Observations(stamp, camera, track, pixels[camera, track], np.full(len(camera), sigma))


def observations(
    rig: Rig,
    points: Array,
    base_from_surface: Array,
    stamp: float,
    rng: np.random.Generator,
    sigma: float = 0.3,
    outliers: float = 0.0,
    visible: NDArray[np.bool_] | None = None,
) -> Observations:
    """One look at points (N, 3), surface frame, of all cameras at one instant: white noise of `sigma` px.

    outliers: the share of observations that stand up to 40 px anywhere else instead. visible: (C, N), those that may be
    seen at all.
    """
    pixels, seen = imaged(undistorting(rig), points, np.broadcast_to(base_from_surface, (len(rig), 4, 4)))
    error = sigma * rng.standard_normal(pixels.shape)
    wrong = rng.random(seen.shape) < outliers
    error[wrong] = rng.uniform(-ASTRAY, ASTRAY, (int(wrong.sum()), 2))
    return gathered(stamp, pixels + error, seen if visible is None else seen & visible, sigma)
