"""Conversion between imaged pixels and the ideal pixels of the estimator; filters before detection."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
from numpy.typing import NDArray

from estimation.rig import Camera, Rig
from estimation.runtime import compiled, contiguous
from estimation.se3 import Array
from perception.frames import Image

# 40 rounds: the default 5 leave 0.1 px at wide angles
_UNDISTORT_CRITERIA = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 40, 1e-9)


def undistort(camera: Camera, pixels: Array) -> Array:
    """Ideal pixels (N, 2), of the same camera matrix, from imaged pixels (N, 2)."""
    if not len(pixels):
        return np.zeros((0, 2))
    raw = np.ascontiguousarray(pixels, np.float64).reshape(-1, 1, 2)
    ideal = cv2.undistortPoints(raw, camera.matrix, camera.distortion, P=camera.matrix, criteria=_UNDISTORT_CRITERIA)
    return np.asarray(ideal, np.float64).reshape(-1, 2)


def imaged_radius(camera: Camera) -> float:
    """Largest tangent of the angle to the axis at which the lens model can be trusted.

    That of the image's corner plus a tenth, or where the radial polynomial stops growing, if smaller: beyond, a point
    far outside the view would be imaged into it.
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
    """The rig's lenses with their precomputed parameters.

    sizes: (C, 2) px, width and height. radius: (C,) as `imaged_radius`. models: (C, 9) distortion, focal lengths and
    principal point, px.
    """

    def __init__(self, rig: Rig) -> None:
        self.rig = rig
        self.radius = np.array([imaged_radius(c) for c in rig.cameras])
        self.sizes = np.array([c.size for c in rig.cameras], float)
        self._focal, self._centre = rig.matrices[:, [0, 1], [0, 1]], rig.matrices[:, :2, 2]
        distortion = np.array([c.distortion for c in rig.cameras], float)
        self.models = np.ascontiguousarray(np.hstack([distortion, self._focal, self._centre]))

    def image(self, camera: int | NDArray[np.int64], ideal: Array, depth: Array) -> tuple[Array, NDArray[np.bool_]]:
        """Imaged pixels (..., 2) of ideal ones, and whether each is in front of and inside the lens's field (...).

        camera: of all of them, or of each (...).
        """
        tangent = (ideal - self._centre[camera]) / self._focal[camera]
        imaged, visible = self.bend(camera, tangent[..., 0], tangent[..., 1], depth)
        return np.moveaxis(imaged, 0, -1), visible

    def bend(
        self, camera: int | NDArray[np.int64], x: Array, y: Array, depth: Array
    ) -> tuple[Array, NDArray[np.bool_]]:
        """As `image`, of tangents x, y (...) of the angles to the axis; pixels (2, ...). camera: broadcast to them."""
        shape = np.broadcast_shapes(x.shape, depth.shape)
        cameras = contiguous(np.broadcast_to(camera, shape).ravel(), np.int64)
        x, y, depth = _flat(x, shape), _flat(y, shape), _flat(depth, shape)
        imaged, visible = bend_each(cameras, x, y, depth, self.models, self.radius)
        return imaged.reshape(2, *shape), visible.reshape(shape)


def _flat(values: Array, shape: tuple[int, ...]) -> Array:
    """Values broadcast to a shape, flat and contiguous for compiled loops."""
    return contiguous((values if values.shape == shape else np.broadcast_to(values, shape)).ravel())


@compiled("Tuple((f8, f8, b1))(f8, f8, f8, f8[::1], f8)")
def bend_one(x: float, y: float, depth: float, model: Array, radius: float) -> tuple[float, float, bool]:
    """The pixel of tangents x, y at a depth, mm, and whether it is in view. model (9,), radius: as in `Lenses`."""
    r2 = x * x + y * y
    visible = (depth > 1.0) and (r2 < radius**2)
    if not visible:
        x, y, r2 = x * 0.0, y * 0.0, r2 * 0.0
    k1, k2, p1, p2, k3 = model[0], model[1], model[2], model[3], model[4]
    radial, xy = 1 + r2 * (k1 + r2 * (k2 + r2 * k3)), 2 * x * y
    across = x * radial + p1 * xy + p2 * (r2 + 2 * x * x)
    down = y * radial + p1 * (r2 + 2 * y * y) + p2 * xy
    return across * model[5] + model[7], down * model[6] + model[8], visible


@compiled("Tuple((f8[:,::1], b1[::1]))(i8[::1], f8[::1], f8[::1], f8[::1], f8[:,::1], f8[::1])")
def bend_each(
    camera: NDArray[np.int64], x: Array, y: Array, depth: Array, models: Array, radius: Array
) -> tuple[Array, NDArray[np.bool_]]:
    """`bend_one` of N: pixels (2, N), and which are in view (N,). camera: (N,). models (C, 9), radius (C,)."""
    imaged, visible = np.empty((2, len(x))), np.empty(len(x), np.bool_)
    for n in range(len(x)):
        c = camera[n]
        imaged[0, n], imaged[1, n], visible[n] = bend_one(x[n], y[n], depth[n], models[c], radius[c])
    return imaged, visible


BILATERAL_DIAMETER, BILATERAL_SIGMA_GREY, BILATERAL_SIGMA_PX = 10, 75.0, 750.0  # thesis Appendix A


def bilateral(image: Image) -> Image:
    """The picture without reflections, with contours preserved (thesis 4.6, Fig. 4.9)."""
    smooth = cv2.bilateralFilter(image, BILATERAL_DIAMETER, BILATERAL_SIGMA_GREY, BILATERAL_SIGMA_PX)
    return np.asarray(smooth, np.uint8)


def unfiltered(image: Image) -> Image:
    """The picture unchanged."""
    return image


NO_PREFILTER, BILATERAL_PREFILTER = "none", "bilateral"
PREFILTERS: dict[str, Callable[[Image], Image]] = {NO_PREFILTER: unfiltered, BILATERAL_PREFILTER: bilateral}
