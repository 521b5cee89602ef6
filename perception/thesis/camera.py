"""One camera's part: its region carried along from picture to picture, and how far that has moved by now."""

from __future__ import annotations

import numpy as np

from estimation.rig import Camera
from estimation.se3 import Array
from perception.frames import Image
from perception.thesis.displacement import displacement, turn
from perception.thesis.kalman import velocity_at_rest, velocity_later, velocity_seen
from perception.thesis.pairs import Finder
from perception.thesis.region import corners_of, united
from perception.thesis.view import FlatView

LONGEST = 0.5  # s that a velocity is relied on without a measurement


class CameraTrack:
    """Follows the region in one camera's pictures: what a thread of the thesis does (`capture_frames`, Appendix A).

    motion: (3,) px, px, rad moved and turned since the start. covariance: (3, 3) of what the filter predicts of it, 0
    where it is measured: the thesis keeps no account of the errors that it adds up. measured: whether the newest
    picture took part. pixels: (N, 2) px of the features that did, undistorted and of the camera's own matrix.
    velocity: (3,) px/s, px/s, rad/s, as the filter believes it.

    Motion is the sum of the measured moves, as in the program; the Kalman filter (thesis 4.4) says where the region
    is to be looked for and what it did while it was not seen. Then the features last found are kept, so what follows
    an occlusion is measured from before it and the prediction is given up. Every frame set is used: every 30th, as in
    the program, or every third (4.6) was to save time.
    """

    def __init__(self, camera: Camera, finder: Finder) -> None:
        self.view = FlatView(camera)
        self._finder = finder

    def begin(self, stamp: float, image: Image, polygon: Array) -> None:
        """The first picture at `stamp`, s, and the region in it, (N, 2) px as imaged."""
        size = self.view.camera.size
        self._corners = corners_of(self.view.pixels(np.clip(polygon, 0, np.array(size) - 1.0)), size)
        found = self._finder.begin(self.view.flatten(image), united(self._corners, self._corners, size))
        self._seen, self._sum = stamp, np.zeros(3)
        self._velocity = velocity_at_rest()
        self.motion, self.covariance, self.measured = self._sum, np.zeros((3, 3)), True
        self.velocity = self._velocity
        self.pixels = self.view.ideal(found)

    def __call__(self, stamp: float, image: Image | None) -> None:
        """The next picture, at `stamp`, s; None where this camera has none."""
        dt = stamp - self._seen
        coasted = velocity_later(self._velocity, dt)
        ahead = min(dt, LONGEST)
        move = None if image is None else self._move(image, coasted.mean * ahead)
        self.measured = move is not None
        if move is None:
            self.motion = self._sum + coasted.mean * ahead
            self.covariance = coasted.covariance * ahead**2
            self.velocity, self.pixels = coasted, np.zeros((0, 2))
            return
        self.velocity = self._velocity = velocity_seen(self._velocity, move, dt)
        self._seen, self._sum = stamp, self._sum + move
        self.motion, self.covariance = self._sum, np.zeros((3, 3))

    def _move(self, image: Image, expected: Array) -> Array | None:
        """The move (3,) since the picture last measured, or None; the region is looked for at `expected` (3,) too."""
        here = self._corners + self._sum[:2]
        box = united(here, here + expected[:2], self.view.camera.size)
        pairs = self._finder.find(self.view.flatten(image), box)
        turned = turn(pairs)
        if turned is None:
            return None
        self._finder.keep()
        self.pixels = self.view.ideal(pairs.destination + box[:2])
        return np.append(displacement(pairs), turned)
