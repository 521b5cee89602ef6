"""Landmarks from pixels: triangulated from several cameras at once, or refined look by look as the surface turns."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from estimation import se3
from estimation.errors import InputError
from estimation.observations import Observations
from estimation.pose_solver import project
from estimation.rig import Rig
from estimation.se3 import Array, Index, Mask
from estimation.surface_map import SurfaceMap, local_normals, surface_frame

MIN_MAP_LANDMARKS = 3  # landmarks: a plane's points, and no fewer span a frame
MAX_RESIDUAL_SIGMAS = 4.0  # RMS over the sightings of a landmark: beyond, one of them is wrong
MAX_LOOK_CHI2 = 16.0  # two degrees of freedom: beyond, it is another spot; one in three thousand by chance


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


@dataclass(frozen=True, slots=True, eq=False)
class TriangulatedMap:
    """A map from one frame set."""

    map: SurfaceMap
    base_from_surface: Array  # (4, 4), which defines the surface frame
    tracks: Index  # (N,) id of each landmark among the observations


def triangulated_map(rig: Rig, observations: Observations) -> TriangulatedMap:
    """The map of landmarks that two cameras or more see alike, in a frame in their middle, z out of the surface.

    InputError where they are fewer than MIN_MAP_LANDMARKS, which span no frame.
    """
    _, point, count = np.unique(observations.track, return_inverse=True, return_counts=True)
    several = count[point] > 1
    allowed = f"{MIN_MAP_LANDMARKS} or more that two cameras see alike"
    if int((count > 1).sum()) < MIN_MAP_LANDMARKS:
        raise InputError("observations", "landmarks", int((count > 1).sum()), allowed)
    ids, point = np.unique(observations.track[several], return_inverse=True)
    camera, pixels, sigma = observations.camera[several], observations.pixels[several], observations.sigma[several]
    points, covariance, residual = triangulate(rig, point, camera, pixels, len(ids))
    off = np.bincount(point, ((residual / sigma[:, None]) ** 2).sum(1)) / np.bincount(point) / 2
    good = np.isfinite(points).all(1) & (off < MAX_RESIDUAL_SIGMAS**2)
    if int(good.sum()) < MIN_MAP_LANDMARKS:
        raise InputError("observations", "landmarks", int(good.sum()), allowed)
    widest = np.zeros(len(ids))
    np.maximum.at(widest, point, sigma)
    points, covariance = points[good], (covariance * widest[:, None, None] ** 2)[good]
    # in its own frame
    poses = np.stack([c.base_from_camera for c in rig.cameras])
    base_from_surface = surface_frame(points, poses[:, :3, 3].mean(0), poses[:, :3, 0].mean(0))
    turn = base_from_surface[:3, :3].T
    own = se3.transform_points(se3.inverse(base_from_surface), points)
    joint = np.zeros((len(own), 3, len(own), 3))
    joint[np.arange(len(own)), :, np.arange(len(own))] = turn @ covariance @ turn.T
    normals = local_normals(own, np.array([0.0, 0.0, 1.0]))
    whole = SurfaceMap(own, normals, joint.reshape(3 * len(own), -1))
    return TriangulatedMap(whole, base_from_surface, ids[good])


def updated_by_looks(
    surface_map: SurfaceMap, track: Index, residuals: Array, jacobians: Array, sigma: Array, pose_covariance: Array
) -> tuple[SurfaceMap, Mask]:
    """The map after a look at some of its landmarks from known poses, and which looks (M,) agree with it.

    One joint Kalman update: the landmarks' errors are correlated, and all looks share the pose's. track: (M,) rows,
    residuals: (M, 2) px, predicted minus seen, jacobians: (M, 2, 6) by the pose, sigma: (M,) px. pose_covariance:
    (6, 6).
    """
    count, looks = len(surface_map), len(track)
    if not looks:
        return surface_map, np.zeros(0, bool)
    by_map = np.zeros((looks, 2, count, 3))
    by_map[np.arange(looks), :, track] = jacobians[:, :, 3:]
    design = by_map.reshape(2 * looks, -1)
    by_pose = jacobians.reshape(-1, 6)
    noise = by_pose @ pose_covariance @ by_pose.T + np.diag(np.repeat(sigma**2, 2))
    across = surface_map.covariance @ design.T
    spread = design @ across + noise
    own = np.einsum("minj->mnij", spread.reshape(looks, 2, looks, 2))[np.arange(looks), np.arange(looks)]
    agrees = np.einsum("mi,mij,mj->m", residuals, np.linalg.inv(own), residuals) < MAX_LOOK_CHI2
    rows = np.repeat(agrees, 2)
    gain = np.linalg.solve(spread[np.ix_(rows, rows)], across[:, rows].T).T
    covariance = surface_map.covariance - gain @ across[:, rows].T
    points = surface_map.points - (gain @ residuals[agrees].ravel()).reshape(-1, 3)
    return SurfaceMap(points, surface_map.normals, (covariance + covariance.T) / 2), agrees
