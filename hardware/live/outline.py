"""The outline of the region that is followed: told in a camera's first picture, then carried along by the surface."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from estimation import se3
from estimation.rig import Rig, ideal_pixels, pixels_from_points
from estimation.se3 import Array
from perception.frames import Roi
from perception.lens import undistort

NEIGHBOURS = 3  # landmarks whose depth a corner of the outline is taken to have


class Outline:
    """Each camera's region on the surface, once that is known, in the surface frame."""

    def __init__(self, rig: Rig) -> None:
        self._rig = rig
        self._laid: dict[int, Array] = {}  # (K, 3) mm, by camera

    @property
    def laid(self) -> bool:
        """Whether any is known."""
        return bool(self._laid)

    def lay(self, rois: Sequence[Roi], points_surface: Array, base_from_surface: Array) -> None:
        """Put the regions onto a surface of landmarks (V, 3), mm; whole pictures are no outlines."""
        points_base = se3.transform_points(base_from_surface, points_surface)
        surface_from_base = se3.inverse(base_from_surface)
        for roi in rois:
            camera = self._rig.cameras[roi.camera]
            inside = ((roi.polygon > 0) & (roi.polygon < np.array(camera.size) - 1)).all(axis=1)
            if len(points_base) < NEIGHBOURS or not inside.any():
                continue
            corners = undistort(camera, roi.polygon)
            pixels, depths = ideal_pixels(camera, points_base)
            away = np.linalg.norm(corners[:, None] - pixels[None], axis=2)
            near = np.argsort(away, axis=1)[:, :NEIGHBOURS]
            seen = np.column_stack([corners, np.ones(len(corners))]) @ np.linalg.inv(camera.matrix).T
            corners_base = se3.transform_points(camera.base_from_camera, seen * depths[near].mean(axis=1)[:, None])
            self._laid[roi.camera] = se3.transform_points(surface_from_base, corners_base)

    def in_pixels(self, camera: int, base_from_surface: Array) -> tuple[Array, ...]:
        """The outline of a camera's region in its picture, (K, 2) px as the lens images it; none if none is known."""
        if camera not in self._laid:
            return ()
        points_base = se3.transform_points(base_from_surface, self._laid[camera])
        pixels, depth = pixels_from_points(self._rig.cameras[camera], points_base)
        return (pixels,) if (depth > 0).all() else ()
