"""Which camera truly takes a picture: cables may be exchanged, and cameras bumped."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from estimation import se3
from estimation.rig import Camera
from estimation.se3 import Array
from hardware.process.faults import Fault, drawn
from hardware.simulator.cameras import Shot


class Lenses:
    """The true cameras of a rig; a bumped one is the same object for as long as its fault lasts."""

    def __init__(self, cameras: Sequence[Camera]) -> None:
        self._cameras = cameras
        self._bumped: dict[tuple[int, Fault], Camera] = {}

    def __call__(self, shot: Shot) -> Camera:
        """The camera that took a shot's picture."""
        number = shot.camera if shot.lens is None else shot.lens
        camera = self._cameras[number]
        if shot.bump is None:
            return camera
        key = number, shot.bump
        if key not in self._bumped:
            self._bumped[key] = replace(camera, base_from_camera=camera.base_from_camera @ bump(shot.bump))
        return self._bumped[key]


def bump(fault: Fault) -> Array:
    """camera_from_bumped (4, 4): aside by the fault's amount, mm, across the line of sight."""
    angle = drawn(fault).uniform(0, 2 * np.pi)
    return se3.make(np.eye(3), fault.amount * np.array([np.cos(angle), np.sin(angle), 0.0]))
