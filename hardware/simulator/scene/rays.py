"""Camera rays, and height fields z = Z(x, y)."""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from estimation.rig import Camera
from estimation.se3 import Array, inverse
from hardware.simulator.scene.appearance import Sensor, vignette
from hardware.simulator.scene.fields import Field, as_field, gradient
from hardware.simulator.scene.ray_kernels import CELL_PX, SAMPLES_PER_PIXEL
from perception.lens import undistort


class HeightField(NamedTuple):
    """A height field (H, W) mm, and bounds of its heights, mm."""

    height: Field
    slopes: Field  # (H, W, 4) per node along u and v, height, zero: OpenCV is fastest with four channels
    smooth_slopes: Field  # (H, W, 4) the same, of means over SMOOTH_NODES
    low: float
    high: float


def height_field(height: Field) -> HeightField:
    """A height field with its slopes."""
    low, high = float(height.min()) - 0.1, float(height.max()) + 0.1
    slopes = as_field(np.dstack([*gradient(height, 1.0), height, np.zeros_like(height)]))
    return HeightField(height, slopes, as_field(cv2.blur(slopes, (SMOOTH_NODES, SMOOTH_NODES))), low, high)


SMOOTH_NODES = 9  # nodes over which slopes are smooth


RAY_MARGIN_PX = 3 * CELL_PX  # margin of cached rays about a box, for a moving box
LENS_NODE_PX = 8  # px between rays through the lens model; cubic between them, error below 1e-5 px


class ImageBox(NamedTuple):
    """A part of an image, in whole cells: pixels x0..x1, y0..y1, the last excluded; it may reach beyond the image."""

    x0: int
    y0: int
    x1: int
    y1: int

    @property
    def size(self) -> tuple[int, int]:
        """(H, W) px."""
        return self.y1 - self.y0, self.x1 - self.x0

    @property
    def sample_size(self) -> tuple[int, int]:
        """(H, W) samples."""
        return self.size[0] * SAMPLES_PER_PIXEL, self.size[1] * SAMPLES_PER_PIXEL

    def samples(self, part: ImageBox) -> tuple[slice, slice]:
        """Rows and columns of a part's samples among those of this box."""
        n = SAMPLES_PER_PIXEL
        rows = slice((part.y0 - self.y0) * n, (part.y1 - self.y0) * n)
        return rows, slice((part.x0 - self.x0) * n, (part.x1 - self.x0) * n)

    def lattice(self, step: int) -> tuple[slice, slice]:
        """Rows and columns of its squares of `step` px among those of the whole image."""
        return slice(self.y0 // step, self.y1 // step), slice(self.x0 // step, self.x1 // step)


class Rays(NamedTuple):
    """Tangents x / z and y / z (H, W) each, camera frame."""

    x: Field
    y: Field


class RenderView:
    """One camera, and cached rays of a part of its image."""

    def __init__(self, camera: Camera, base_from_rest: Array) -> None:
        """base_from_rest: (4, 4), of the scene's grid at rest."""
        self.camera = camera
        rest_distance = float(np.linalg.norm((inverse(camera.base_from_camera) @ base_from_rest)[:3, 3]))
        self.spacing = rest_distance / float(camera.matrix[0, 0]) / SAMPLES_PER_PIXEL  # mm a sample
        self._box, self._rays = ImageBox(0, 0, 0, 0), Rays(*np.zeros((2, 0, 0), np.float32))
        self._coarse: dict[int, Rays] = {}
        self._fall: dict[float, NDArray[np.float32]] = {}
        w, h = camera.size
        self.whole = ImageBox(0, 0, -(-w // CELL_PX) * CELL_PX, -(-h // CELL_PX) * CELL_PX)  # the image in whole cells

    def fall(self, sensor: Sensor) -> NDArray[np.float32]:
        """Share of the light (H, W, 3) that reaches each pixel."""
        if sensor.vignetting not in self._fall:
            self._fall[sensor.vignetting] = vignette(self.camera, sensor)
        return self._fall[sensor.vignetting]

    def clip(self, low: Array, high: Array) -> ImageBox | None:
        """The cells with pixels low to high (2,), None outside the image."""
        x0, y0 = (int(v) for v in np.clip(np.floor(low / CELL_PX) * CELL_PX, 0, self.whole[2:]))
        x1, y1 = (int(v) for v in np.clip(np.ceil(high / CELL_PX) * CELL_PX, 0, self.whole[2:]))
        return ImageBox(x0, y0, x1, y1) if x1 > x0 and y1 > y0 else None

    def rays(self, box: ImageBox) -> Rays:
        """Rays (H, W) of all samples of a box."""
        cached = self._box
        if not (cached.x0 <= box.x0 and cached.y0 <= box.y0 and cached.x1 >= box.x1 and cached.y1 >= box.y1):
            margin = RAY_MARGIN_PX
            cached = ImageBox(box.x0 - margin, box.y0 - margin, box.x1 + margin, box.y1 + margin)
            x, y = (
                (np.arange((b - a) * SAMPLES_PER_PIXEL) + 0.5) / SAMPLES_PER_PIXEL + a - 0.5
                for a, b in (cached[::2], cached[1::2])
            )
            self._rays, self._box = Rays(*rays_at(self.camera, x, y)), cached
        return Rays(*(tangents[cached.samples(box)] for tangents in self._rays))

    def coarse(self, step: int) -> Rays:
        """Rays through the middles of squares of `step` px over the whole image."""
        if step not in self._coarse:
            x, y = (np.arange(0.0, n, step) + (step - 1) / 2 for n in self.whole[2:])
            self._coarse[step] = Rays(*rays_at(self.camera, x, y))
        return self._coarse[step]


def rays_at(camera: Camera, x: Array, y: Array) -> NDArray[np.float32]:
    """Tangents (2, H, W) at the pixels x (W,) by y (H,)."""
    nodes = [np.arange(v[0] - 2 * LENS_NODE_PX, v[-1] + 3 * LENS_NODE_PX, LENS_NODE_PX) for v in (x, y)]
    pixels = np.stack(np.meshgrid(*nodes), -1)
    ideal = undistort(camera, pixels.reshape(-1, 2)).reshape(pixels.shape)
    tangents = (ideal - camera.matrix[:2, 2]) / camera.matrix[[0, 1], [0, 1]]
    across, down = (_cubic(n, v) for n, v in zip(nodes, (x, y), strict=True))
    return np.stack([(down @ tangents[..., k] @ across.T).astype(np.float32) for k in range(2)])


def _cubic(nodes: Array, places: Array) -> Array:
    """Weights (places, nodes) of the cubic through the four nodes around each place."""
    u = (places - nodes[0]) / LENS_NODE_PX
    first = np.floor(u).astype(int)
    t = u - first
    weights, rows = np.zeros((len(places), len(nodes))), np.arange(len(places))
    weights[rows, first - 1] = -t * (t - 1) * (t - 2) / 6
    weights[rows, first] = (t + 1) * (t - 1) * (t - 2) / 2
    weights[rows, first + 1] = -(t + 1) * t * (t - 2) / 2
    weights[rows, first + 2] = (t + 1) * t * (t - 1) / 6
    return weights
