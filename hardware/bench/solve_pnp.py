"""OpenCV's solvePnP, frame by frame and camera by camera: what is reached without cameras together, map or motion."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from estimation import se3
from estimation.rig import Camera
from estimation.se3 import Array
from estimation.synthetic.world import World

FEWEST = 6  # tracks that a pose is sought from
BESIDE = 8.0  # px: OpenCV's own gate of an outlier


def best_camera(worlds: Sequence[World]) -> tuple[float, float]:
    """RMSE, mm and degrees over the three axes together, of the camera that is nearest to the truth by itself.

    Of the frame sets in which it finds a pose. The landmarks are the world's own map, as in `follow(world, "told")`.
    """
    errors = [np.concatenate(of_camera) for of_camera in zip(*map(_errors, worlds), strict=True)]
    squares = [np.array([(e[:, 3:] ** 2).sum(1).mean(), (e[:, :3] ** 2).sum(1).mean()]) for e in errors if len(e)]
    if not squares:
        return np.nan, np.nan
    place, turn = np.sqrt(min(squares, key=lambda square: float(square[0])))
    return float(place), float(np.degrees(turn))


def _errors(world: World) -> list[Array]:
    """Errors (N, 6), rad and mm, of each camera's poses in one world."""
    found: list[list[Array]] = [[] for _ in world.rig.cameras]
    for seen, true in zip(world, world.truth.base_from_surface, strict=True):
        points = world.map.points[seen.track]
        for number, camera in enumerate(world.rig.cameras):
            mine = seen.camera == number
            pose = pnp_pose(camera, points[mine], seen.pixels[mine])
            if pose is not None:
                found[number].append(se3.log(se3.inverse(pose) @ true))
    return [np.reshape(errors, (-1, 6)) for errors in found]


def pnp_pose(camera: Camera, points: Array, pixels: Array) -> Array | None:
    """base_from_surface (4, 4) from points (N, 3) mm of the surface and their undistorted pixels (N, 2), or None."""
    if len(points) < FEWEST:
        return None
    ok, turn, shift, inliers = cv2.solvePnPRansac(
        points, pixels, camera.matrix, None, reprojectionError=BESIDE, flags=cv2.SOLVEPNP_SQPNP
    )
    if not ok or inliers is None or len(inliers) < FEWEST:
        return None
    kept = inliers[:, 0]
    turn, shift = cv2.solvePnPRefineLM(points[kept], pixels[kept], camera.matrix, None, turn, shift)
    return np.asarray(camera.base_from_camera @ se3.make(se3.exp_rotation(turn[:, 0]), shift[:, 0]))
