"""Picture loops: motions that end where they began, rendered once.

Rendering takes five times as long as tracking, so a loop gives hours of frame sets.
"""

from __future__ import annotations

import cv2
import numpy as np

from estimation import se3
from estimation.rig import Rig
from estimation.se3 import Array
from hardware.simulator.scene.appearance import Sensor
from hardware.simulator.scene.render import render
from hardware.simulator.scene.scene import Scene, WorldState
from perception.frames import Image
from perception.mapping.features import grey

NOISE_MARGIN_PX = 97  # px by which the stored noise is larger than an image, so that each image takes another cut of it
NOISE_SIGMA = 1.2  # grey levels, one sigma


def closed_motion(count: int, rest: Array, rng: np.random.Generator, lively: float) -> Array:
    """Poses (N, 4, 4) of one period of a breath about `rest`: `lively` times 3 mm and 2 degrees, two harmonics more."""
    phase = 2 * np.pi * np.arange(count) / count
    xi = np.zeros((count, 6))
    for harmonic, part in ((1, 1.0), (2, 0.35), (3, 0.12)):
        wave = np.sin(harmonic * phase[:, None] + rng.uniform(0, 2 * np.pi, 6))
        xi += part * wave * rng.normal(0, 1, 6) * lively * np.array([0.02] * 3 + [1.5, 1.5, 2.5])
    return np.asarray(rest @ se3.exp(xi))


class PictureLoop:
    """The grey pictures of one closed motion. poses: (N, 4, 4), base_from_surface."""

    def __init__(self, scene: Scene, rig: Rig, poses: Array, seed: int) -> None:
        self.poses, self._rng = poses, np.random.default_rng([seed, 47])
        clean, draws = Sensor(noise=0.0), self._rng.spawn(len(rig))
        self._images = []
        for pose in poses:
            instants = [WorldState(0.0, 0.0, pose, np.zeros(6))] * len(rig)
            self._images.append([grey(i) for i in render(scene, rig.cameras, instants, clean, draws)])
        w, h = rig.cameras[0].size
        grain = self._rng.standard_normal((h + NOISE_MARGIN_PX, w + NOISE_MARGIN_PX))
        self._grain = (NOISE_SIGMA * grain).astype(np.int16)

    def __len__(self) -> int:
        return len(self.poses)

    def images(self, number: int) -> list[Image]:
        """The noiseless pictures (H, W) at a place of the loop, which goes on for ever."""
        return self._images[number % len(self.poses)]

    def noisy(self, image: Image) -> Image:
        """The picture with noise that was not seen before."""
        h, w = image.shape
        y, x = self._rng.integers(0, NOISE_MARGIN_PX, 2)
        return np.asarray(cv2.add(image, self._grain[y : y + h, x : x + w], dtype=cv2.CV_8U), np.uint8)
