"""Between the pixels a lens images and the ideal pixels the estimator works in."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from estimation.rig import Camera, Rig, distort
from estimation.se3 import Array

_EXACT = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 40, 1e-9)  # the default 5 rounds leave 0.1 px at wide angles


def undistort(camera: Camera, pixels: Array) -> Array:
    """Ideal pixels (N, 2), of the same camera matrix, from imaged pixels (N, 2)."""
    if not len(pixels):
        return np.zeros((0, 2))
    raw = np.ascontiguousarray(pixels, np.float64).reshape(-1, 1, 2)
    ideal = cv2.undistortPoints(raw, camera.matrix, camera.distortion, P=camera.matrix, criteria=_EXACT)
    return np.asarray(ideal, np.float64).reshape(-1, 2)


def imaged_radius(camera: Camera) -> float:
    """Largest tangent of the angle to the axis at which the lens model can be trusted.

    That is the image's own corner with a tenth to spare, or where the radial polynomial stops growing, if sooner:
    beyond, a point far outside the view would be imaged back into it.
    """
    w, h = camera.size
    corners = undistort(camera, np.array([[0.0, 0.0], [w, 0.0], [0.0, h], [w, h]]))
    x = (corners - camera.matrix[:2, 2]) / camera.matrix[[0, 1], [0, 1]]
    limit = 1.1 * float(np.linalg.norm(x, axis=1).max())
    r = np.linspace(0, limit, 200)
    k1, k2, _, _, k3 = camera.distortion
    growth = 1 + r**2 * (3 * k1 + r**2 * (5 * k2 + r**2 * 7 * k3))
    falling = np.nonzero(growth <= 0.05)[0]
    return float(r[falling[0]]) if len(falling) else limit


class Lenses:
    """The rig's lenses, with what each needs worked out once."""

    def __init__(self, rig: Rig) -> None:
        self.rig = rig
        self.radius = np.array([imaged_radius(c) for c in rig.cameras])

    def image(self, camera: int, ideal: Array, depth: Array) -> tuple[Array, NDArray[np.bool_]]:
        """Imaged pixels (..., 2) of ideal ones and whether each is in front of and inside the lens's field (...)."""
        lens = self.rig.cameras[camera]
        tangent = (ideal - lens.matrix[:2, 2]) / lens.matrix[[0, 1], [0, 1]]
        seen = (depth > 1.0) & (np.einsum("...i,...i->...", tangent, tangent) < self.radius[camera] ** 2)
        return distort(lens, np.where(seen[..., None], ideal, lens.matrix[:2, 2])), seen
