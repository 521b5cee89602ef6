"""Where the tracker laid its surface frame: the one thing about a run without a scan that must be measured to judge it.

Without a scan the tracker chooses its own surface frame, and a path in the true one means nothing to it until the two
are registered. Live, an operator does that; here it is done as well as pixels allow: every track of one frame set is
carried along its true ray onto the true surface, and the pose of the points so found is solved as the tracker sees
them, by the same cameras and pixels. What the cameras' calibration has wrong is in both poses and stays in the error.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from estimation import se3
from estimation.observations import Observations
from estimation.online.pose_solver import solve_pose
from estimation.pose import SurfacePose
from estimation.rig import Rig
from estimation.se3 import Array
from hardware.simulator.scene.shape import Shape
from hardware.simulator.truth import Truth

STEPS = 12  # Newton steps from the mean plane onto the surface; wounds are met in four
NUDGE = 1e-3  # mm, for the slope along the surface
MISSED = 1e-3  # mm between ray and surface: such a track does not lie on it
LEAST = 12  # tracks for a registration


def truth_from_estimate(
    pose: SurfacePose,
    observations: Observations,
    rigs: tuple[Rig, Rig],
    truth: Truth,
    shape: Shape,
    exposed: Array,
) -> Array | None:
    """truth_surface_from_estimated_surface (4, 4) from one frame set; None where too few tracks lie on the surface.

    rigs: the true one and the one the tracker was told. exposed: (C,) s, when each camera truly took its picture.
    """
    true, told = rigs
    points, met = surface_points(observations, true, truth, shape, exposed)
    if met.sum() < LEAST:
        return None
    start = truth.base_from_surface(np.array([pose.stamp]))[0]
    seen = solve_pose(
        told,
        observations.camera[met],
        points[met],
        observations.pixels[met],
        observations.sigma[met],
        start,
        tolerance=1e-9,
        iterations=20,
    )
    return np.asarray(se3.inverse(seen.base_from_surface) @ pose.base_from_surface)


def surface_points(
    observations: Observations, rig: Rig, truth: Truth, shape: Shape, exposed: Array
) -> tuple[Array, NDArray[np.bool_]]:
    """Points (N, 3) mm of the undeformed surface under each track's pixel, and whether (N,) the ray truly meets one."""
    poses = truth.base_from_surface(exposed)
    amount = truth.amount(exposed)[observations.camera]
    surface_from_camera = (
        se3.inverse(poses[observations.camera])
        @ np.stack([c.base_from_camera for c in rig.cameras])[observations.camera]
    )
    matrices = rig.matrices[observations.camera]
    focal, centre = matrices[:, [0, 1], [0, 1]], matrices[:, :2, 2]
    rays = np.column_stack([(observations.pixels - centre) / focal, np.ones(len(observations))])
    rays = (surface_from_camera[:, :3, :3] @ rays[..., None])[..., 0]
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    origin = surface_from_camera[:, :3, 3]

    def place(xy: Array) -> Array:
        points = shape.points(xy)
        return points + truth.displacement(points, amount)

    def off(xy: Array) -> Array:  # (N, 3) mm, from the ray to the surface point
        from_origin = place(xy) - origin
        return np.asarray(from_origin - np.sum(from_origin * rays, 1, keepdims=True) * rays)

    up, middle = shape.surface_from_grid[:3, 2], shape.surface_from_grid[:3, 3]
    reach = ((middle - origin) @ up) / (rays @ up)
    xy = shape.material(origin + reach[:, None] * rays)
    for _ in range(STEPS):
        now = off(xy)
        slope = np.stack([(off(xy + NUDGE * axis) - now) / NUDGE for axis in np.eye(2)], -1)  # (N, 3, 2)
        xy = xy - (np.linalg.pinv(slope) @ now[..., None])[..., 0]
    return shape.points(xy), shape.covers(xy) & (np.linalg.norm(off(xy), axis=1) < MISSED)
