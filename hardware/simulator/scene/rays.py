"""One camera's rays: where each sample of its image looks, worked out once."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from estimation.rig import Camera
from estimation.se3 import Array, inverse
from hardware.simulator.field import Field
from hardware.simulator.sensor import Sensor, vignette
from perception.lens import undistort

SAMPLES = 2  # per pixel and axis
CELL = 8  # px: boxes are whole cells, and what varies slowly is worked out once a cell
SPARE = 3 * CELL  # px by which the rays kept reach beyond the box asked for, so that a moving box is found again
NODES = 8  # px between the rays that are traced through the lens; cubic between them, off by less than 1e-5 px


class Box(NamedTuple):
    """A part of an image, in whole cells: pixels x0..x1, y0..y1, the last excluded; it may reach beyond the image."""

    x0: int
    y0: int
    x1: int
    y1: int

    @property
    def size(self) -> tuple[int, int]:
        """(H, W) px."""
        return self.y1 - self.y0, self.x1 - self.x0


class Rays(NamedTuple):
    """Tangents x / z and y / z (H, W) each, camera frame."""

    x: Field
    y: Field


class View:
    """One camera, and the rays of the part of its image that was last needed."""

    def __init__(self, camera: Camera, base_from_rest: Array) -> None:
        """base_from_rest: (4, 4), of the scene's grid at rest."""
        self.camera = camera
        self.camera_from_base = inverse(camera.base_from_camera)
        at_rest = self.camera_from_base @ base_from_rest
        self.spacing = float(np.linalg.norm(at_rest[:3, 3])) / float(camera.matrix[0, 0]) / SAMPLES  # mm a sample
        self._box, self._rays = Box(0, 0, 0, 0), Rays(*np.zeros((2, 0, 0), np.float32))
        self._coarse: dict[int, Rays] = {}
        self._fall: dict[float, NDArray[np.float32]] = {}

    def fall(self, sensor: Sensor) -> NDArray[np.float32]:
        """Share of the light (H, W, 3) that reaches each pixel."""
        if sensor.vignetting not in self._fall:
            self._fall[sensor.vignetting] = vignette(self.camera, sensor)
        return self._fall[sensor.vignetting]

    @property
    def whole(self) -> Box:
        """The whole image in whole cells."""
        w, h = self.camera.size
        return Box(0, 0, -(-w // CELL) * CELL, -(-h // CELL) * CELL)

    def clip(self, low: Array, high: Array) -> Box | None:
        """The cells that hold pixels low to high (2,), None if they miss the image."""
        whole = self.whole
        x0, y0 = (int(v) for v in np.clip(np.floor(low / CELL) * CELL, 0, whole[2:]))
        x1, y1 = (int(v) for v in np.clip(np.ceil(high / CELL) * CELL, 0, whole[2:]))
        return Box(x0, y0, x1, y1) if x1 > x0 and y1 > y0 else None

    def rays(self, box: Box) -> Rays:
        """Rays (H, W) of all samples of a box."""
        held = self._box
        if not (held.x0 <= box.x0 and held.y0 <= box.y0 and held.x1 >= box.x1 and held.y1 >= box.y1):
            held = Box(box.x0 - SPARE, box.y0 - SPARE, box.x1 + SPARE, box.y1 + SPARE)
            x, y = ((np.arange((b - a) * SAMPLES) + 0.5) / SAMPLES + a - 0.5 for a, b in (held[::2], held[1::2]))
            self._rays, self._box = Rays(*rays_at(self.camera, x, y)), held
        rows = slice((box.y0 - held.y0) * SAMPLES, (box.y1 - held.y0) * SAMPLES)
        columns = slice((box.x0 - held.x0) * SAMPLES, (box.x1 - held.x0) * SAMPLES)
        return Rays(self._rays.x[rows, columns], self._rays.y[rows, columns])

    def coarse(self, step: int) -> Rays:
        """Rays through the middles of squares of `step` px over the whole image."""
        if step not in self._coarse:
            x, y = (np.arange(0.0, n, step) + (step - 1) / 2 for n in self.whole[2:])
            self._coarse[step] = Rays(*rays_at(self.camera, x, y))
        return self._coarse[step]


def rays_at(camera: Camera, x: Array, y: Array) -> NDArray[np.float32]:
    """Tangents (2, H, W) at the pixels x (W,) by y (H,)."""
    nodes = [np.arange(v[0] - 2 * NODES, v[-1] + 3 * NODES, NODES) for v in (x, y)]
    pixels = np.stack(np.meshgrid(*nodes), -1)
    ideal = undistort(camera, pixels.reshape(-1, 2)).reshape(pixels.shape)
    tangents = (ideal - camera.matrix[:2, 2]) / camera.matrix[[0, 1], [0, 1]]
    across, down = (_cubic(n, v) for n, v in zip(nodes, (x, y), strict=True))
    return np.stack([(down @ tangents[..., k] @ across.T).astype(np.float32) for k in range(2)])


def _cubic(nodes: Array, places: Array) -> Array:
    """Weights (places, nodes) of the cubic through the four nodes around each place."""
    u = (places - nodes[0]) / NODES
    first = np.floor(u).astype(int)
    t = u - first
    weights = np.zeros((len(places), len(nodes)))
    for k, w in enumerate(
        (
            -t * (t - 1) * (t - 2) / 6,
            (t + 1) * (t - 1) * (t - 2) / 2,
            -(t + 1) * t * (t - 2) / 2,
            (t + 1) * t * (t - 1) / 6,
        )
    ):
        weights[np.arange(len(places)), first - 1 + k] = w
    return weights
