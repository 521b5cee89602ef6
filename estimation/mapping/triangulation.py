"""Points from pixels of several cameras, all points at once."""

from __future__ import annotations

import numpy as np

from estimation import se3
from estimation.online.pose_solver import Index, project
from estimation.rig import Rig
from estimation.se3 import Array


def rays(rig: Rig, camera: Index, pixels: Array) -> tuple[Array, Array]:
    """Origins (N, 3) and unit directions (N, 3), base frame, of undistorted pixels (N, 2), each in its camera (N,)."""
    matrices = rig.matrices[camera]
    x = (pixels[:, 0] - matrices[:, 0, 2]) / matrices[:, 0, 0]
    y = (pixels[:, 1] - matrices[:, 1, 2]) / matrices[:, 1, 1]
    poses = np.stack([c.base_from_camera for c in rig.cameras])[camera]
    directions = np.einsum("nij,nj->ni", poses[:, :3, :3], np.stack([x, y, np.ones_like(x)], -1))
    return poses[:, :3, 3], directions / np.linalg.norm(directions, axis=1, keepdims=True)


def triangulate(
    rig: Rig, point: Index, camera: Index, pixels: Array, count: int, iterations: int = 6
) -> tuple[Array, Array, Array]:
    """Points (count, 3) in the base frame, covariances (count, 3, 3) at 1 px, residuals (M, 2) px.

    point, camera: (M,) and pixels: (M, 2) say which point stands where in which camera; each point needs two cameras.
    Start: nearest point to the rays in the least-squares sense; then Gauss-Newton on pixels.
    """
    origins, directions = rays(rig, camera, pixels)
    across = np.eye(3) - directions[:, :, None] * directions[:, None]
    normal, right = np.zeros((count, 3, 3)), np.zeros((count, 3))
    np.add.at(normal, point, across)
    np.add.at(right, point, np.einsum("mij,mj->mi", across, origins))
    ridge = 1e-12 * np.eye(3)
    points = np.asarray(np.linalg.solve(normal + ridge, right[..., None])[..., 0], float)
    identity = np.eye(4)
    for _ in range(iterations):
        predicted, _, jacobian = project(rig, camera, identity, points[point])
        jacobian = jacobian[:, :, 3:]
        residual = predicted - pixels
        normal, right = np.zeros((count, 3, 3)), np.zeros((count, 3))
        np.add.at(normal, point, np.swapaxes(jacobian, 1, 2) @ jacobian)
        np.add.at(right, point, np.einsum("mki,mk->mi", jacobian, residual))
        points = np.asarray(points - np.linalg.solve(normal + ridge, right[..., None])[..., 0], float)
    residual = project(rig, camera, identity, points[point])[0] - pixels
    return points, np.asarray(np.linalg.inv(normal + ridge), float), residual


def epipolar_distance(rig: Rig, a: int, b: int, pixels_a: Array, pixels_b: Array) -> Array:
    """Signed distance (N,), px in camera b, of pixels_b (N, 2) from the epipolar lines of pixels_a (N, 2)."""
    b_from_a = rig.camera_from_base[b] @ rig.cameras[a].base_from_camera
    essential = se3.hat(b_from_a[:3, 3]) @ b_from_a[:3, :3]
    fundamental = np.linalg.inv(rig.matrices[b]).T @ essential @ np.linalg.inv(rig.matrices[a])
    lines = np.c_[pixels_a, np.ones(len(pixels_a))] @ fundamental.T
    return np.asarray((np.c_[pixels_b, np.ones(len(pixels_b))] * lines).sum(1) / np.hypot(lines[:, 0], lines[:, 1]))
